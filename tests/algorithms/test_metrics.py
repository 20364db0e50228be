from __future__ import annotations

from datetime import UTC, datetime
from functools import reduce
from operator import add

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from geofleet.algorithms.metrics import MapScore, derive_scores, null_reason, score_points
from geofleet.errors import InputError

NULLABLE = ("precision", "recall", "f1", "mse_m2", "rmse_m", "gospa_m", "localisation_m2", "cardinality_m2")

# Table 2 of the paper, 33 signs: TP and clusters behind each row, and the printed P, R, F1 (percent) and GOSPA_M (m).
TABLE_2 = {
    "DBSCAN first": (29, 31, 93.5, 87.9, 90.6, 0.756331172),
    "K-Means first": (28, 32, 87.5, 84.8, 86.2, 0.927746939),
    "K-Means after": (26, 30, 86.7, 78.8, 82.5, 1.073600069),
    "HDBSCAN first": (23, 25, 92.0, 69.7, 79.3, 1.080425661),
    "HDBSCAN after": (23, 27, 85.2, 69.7, 76.7, 1.201992465),
    "DBSCAN after": (21, 26, 80.8, 63.6, 71.2, 1.314174608),
    "K-Medoids first": (14, 19, 73.7, 42.4, 53.8, 1.981584718),
    "K-Medoids after": (6, 14, 42.9, 18.2, 25.5, 3.588900265),
}


@st.composite
def point_maps(draw, max_size=10):
    n = draw(st.integers(0, max_size))
    xy = draw(arrays(np.float64, (n, 2), elements=st.floats(-5, 5, width=32)))
    return xy, draw(st.lists(st.sampled_from(["stop", "yield"]), min_size=n, max_size=n))


def score(a, b, **options) -> MapScore:
    return score_points(*a, *b, **options)


def test_scores_worked_out_by_hand():
    # Reference: stop (0, 0), stop (10, 0), yield (20, 0), yield (30, 0).
    # Map: stop (0.6, 0.8), 1 m off: TP. stop (10, 1.5), 1.5 m off: TP. stop (20, 0): wrong class, FP. yield (33, 0):
    # 3 m off, FP. So TP 2, FP 2, FN 2, Σd² = 1 + 2.25 = 3.25 and c²/2 (FN + FP) = 2·4 = 8.
    ref = [(0, 0), (10, 0), (20, 0), (30, 0)], ["stop", "stop", "yield", "yield"]
    found = [(0.6, 0.8), (10, 1.5), (20, 0), (33, 0)], ["stop", "stop", "stop", "yield"]
    s = score(found, ref)
    assert (s.tp, s.fp, s.fn, s.match_on) == (2, 2, 2, "class")
    assert s.sum_sq_error_m2 == pytest.approx(3.25)
    assert s.precision == s.recall == s.f1 == 0.5
    assert s.mse_m2 == s.localisation_m2 == pytest.approx(1.625)
    assert s.rmse_m == pytest.approx(1.2747548783981961)
    assert s.gospa == pytest.approx(3.3541019662496847)  # √11.25
    assert s.cardinality_m2 == pytest.approx(4)  # 8 / 2
    assert s.gospa_m == pytest.approx(2.3717082451262845)  # √5.625
    assert s.null_reason is None
    assert s.matches.ref_index.tolist() == [0, 1]

    # Without classes the third pair matches too, at 0 m: TP 3, FP 1, FN 1; GOSPA² = 3.25 + 4.
    free = score_points(found[0], None, ref[0], None)
    assert (free.tp, free.fp, free.fn, free.match_on) == (3, 1, 1, "none")
    assert free.gospa == pytest.approx(np.sqrt(7.25))

    # With c = 1.2 m only the first pair is left: TP 1, FP 3, FN 3; GOSPA² = 1 + 0.72·6 = 5.32.
    tight = score(found, ref, gate_m=1.2, match_on="concept")
    assert (tight.tp, tight.fp, tight.fn, tight.match_on) == (1, 3, 3, "concept")
    assert tight.gospa_m == tight.gospa == pytest.approx(np.sqrt(5.32))


@pytest.mark.parametrize("row", TABLE_2)
def test_table_2_of_the_paper(row):
    tp, n_clusters, precision, recall, f1, gospa_m = TABLE_2[row]
    fp, fn = n_clusters - tp, 33 - tp
    mse_m2 = gospa_m**2 - 2 * (fn + fp) / tp
    assert 0 < mse_m2 < 4  # c = 2 m
    s = MapScore(tp, fp, fn, mse_m2 * tp, gate_m=2.0)
    assert round(100 * s.precision, 1) == precision
    assert round(100 * s.recall, 1) == recall
    assert round(100 * s.f1, 1) == f1
    assert s.gospa_m == pytest.approx(gospa_m, abs=1e-12)
    assert s.mse_m2 == pytest.approx(mse_m2)


@pytest.mark.parametrize(
    ("counts", "defined", "reason"),
    [
        ((0, 0, 0), {}, "the map and the reference are empty"),
        ((0, 0, 5), {"recall": 0.0, "f1": 0.0}, "the map is empty"),
        ((0, 5, 0), {"precision": 0.0, "f1": 0.0}, "the reference is empty"),
        ((0, 2, 3), {"precision": 0.0, "recall": 0.0, "f1": 0.0}, "no point of the map matches the reference"),
    ],
)
def test_undefined_scores_are_none_with_a_reason(counts, defined, reason):
    s = MapScore(*counts, sum_sq_error_m2=0.0)
    assert {name: getattr(s, name) for name in NULLABLE} == dict.fromkeys(NULLABLE) | defined
    assert s.gospa == pytest.approx(np.sqrt(2 * (counts[1] + counts[2])))
    assert s.null_reason == null_reason(*counts) == reason


def test_a_map_against_itself_and_against_nothing():
    ref = np.array([(0, 0), (0, 0), (3, 4)]), ["stop", "stop", "yield"]
    same = score(ref, ref)
    assert (same.gospa_m, same.gospa, same.f1, same.null_reason) == (0, 0, 1, None)
    empty = score((np.empty((0, 2)), []), ref)
    assert (empty.gospa_m, empty.f1, empty.fn, empty.null_reason) == (None, 0, 3, "the map is empty")
    assert score(([], []), ([], [])).gospa == 0


@settings(deadline=None)
@given(a=point_maps())
def test_identity(a):
    s = score(a, a)
    assert (s.gospa, s.fp, s.fn) == (0, 0, 0)
    assert (s.gospa_m, s.f1) == ((0, 1) if len(a[0]) else (None, None))


@settings(deadline=None)
@given(a=point_maps(), b=point_maps())
def test_symmetry(a, b):
    forth, back = score(a, b), score(b, a)
    assert forth.gospa == pytest.approx(back.gospa, abs=1e-9)


@settings(deadline=None)
@given(a=point_maps(), b=point_maps(), seed=st.integers(0, 2**32 - 1))
def test_order_does_not_matter_and_motion_hardly(a, b, seed):
    rng = np.random.default_rng(seed)
    i, j = rng.permutation(len(a[0])), rng.permutation(len(b[0]))
    shuffled = score_points(a[0][i], np.array(a[1], str)[i], b[0][j], np.array(b[1], str)[j])
    expected = score(a, b)
    assert shuffled == expected

    angle = rng.uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    shift = rng.uniform(-1e4, 1e4, 2)
    moved = score_points(a[0] @ turn + shift, a[1], b[0] @ turn + shift, b[1])
    # A pair at the gate itself may come or go with rounding; it costs the same either way.
    assert moved.gospa == pytest.approx(expected.gospa, abs=1e-6)


@settings(deadline=None)
@given(a=point_maps(), b=point_maps(), c=point_maps(), gate_m=st.floats(0.1, 20))
def test_gospa_obeys_the_triangle_inequality(a, b, c, gate_m):
    ab, bc, ac = (score(p, q, gate_m=gate_m).gospa for p, q in ((a, b), (b, c), (a, c)))
    assert ac <= ab + bc + 1e-9


@settings(deadline=None)
@given(a=point_maps(), b=point_maps())
def test_parts_and_classes_sum_to_the_whole(a, b):
    whole = score(a, b)
    if whole.gospa_m is not None:
        assert whole.gospa_m**2 == pytest.approx(whole.localisation_m2 + whole.cardinality_m2)

    def of_class(points, name):
        keep = [k for k, c in enumerate(points[1]) if c == name]
        return points[0][keep], [name] * len(keep)

    total = reduce(add, (score(of_class(a, name), of_class(b, name)) for name in ("stop", "yield")))
    assert (total.tp, total.fp, total.fn) == (whole.tp, whole.fp, whole.fn)
    assert total.gospa == pytest.approx(whole.gospa)
    assert total.matches is None


def test_tables_and_single_scores_share_the_formula():
    counts = np.array([(2, 2, 2), (0, 0, 0), (0, 0, 3), (5, 1, 0)])
    sums = np.array([3.25, 0, 0, 1.0])
    table = derive_scores(*counts.T, sums, gate_m=2.0)
    for k, (row, sum_sq) in enumerate(zip(counts.tolist(), sums.tolist(), strict=True)):
        s = MapScore(*row, sum_sq)
        for name, column in table.items():
            assert getattr(s, name) == (None if np.isnan(column[k]) else column[k])


@pytest.mark.parametrize(
    "classes", [["a", "b"], [1, 2], np.array([1.5, 2.5]), [("a", 1), "b"], np.array(["a", 3], object)]
)
def test_classes_of_any_kind(classes):
    xy = [(0, 0), (0.5, 0)]
    s = score_points(xy, classes, xy[::-1], classes[::-1])
    assert (s.tp, s.gospa) == (2, 0)


@pytest.mark.parametrize(
    ("classes", "options", "message"),
    [
        (None, {}, "only one of the two sets has classes"),
        ([None], {}, "1 points have no class"),
        ([float("nan")], {}, "1 points have no class"),
        (np.array([[1, 2], 0], object)[:1], {}, "cannot be compared"),
        (["a", "b"], {}, r"shape \(2,\), not \(1,\)"),
        (["a"], {"match_on": "none"}, "match_on is 'none'"),
    ],
)
def test_bad_classes_are_refused(classes, options, message):
    with pytest.raises(InputError, match=message):
        score_points([(0, 0)], classes, [(0, 0)], ["a"], **options)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-1, 0, 0, 0.0), "negative"),
        ((0, 0, 0, 1.0), "impossible for 0 pairs"),
        ((1, 0, 0, 4.1), "impossible for 1 pairs"),
        ((1, 0, 0, float("nan")), "impossible"),
        ((1, 0, 0, 0.0, 0.0), "gate is 0.0"),
        ((1, 0, 0, 0.0, 2.0, "colour"), "match_on is 'colour'"),
    ],
)
def test_impossible_scores_are_refused(arguments, message):
    with pytest.raises(InputError, match=message):
        MapScore(*arguments)


def test_unlike_scores_do_not_add_up():
    one = MapScore(1, 0, 0, 0.5)
    with pytest.raises(InputError, match="don't add up"):
        one + MapScore(1, 0, 0, 0.5, gate_m=1.0)
    with pytest.raises(InputError, match="don't add up"):
        one + MapScore(1, 0, 0, 0.5, match_on="none")
    with pytest.raises(TypeError):
        one + 1


def test_agrees_with_stone_soup():
    pytest.importorskip("stonesoup")
    from stonesoup.metricgenerator.ospametric import GOSPAMetric  # noqa: PLC0415 (an optional oracle)
    from stonesoup.types.state import State  # noqa: PLC0415

    oracle, now = GOSPAMetric(p=2, c=2), datetime(2026, 1, 1, tzinfo=UTC)
    rng = np.random.default_rng(6)
    for _ in range(20):
        xy, ref_xy = (rng.uniform(0, 12, (k, 2)) for k in rng.integers(1, 40, 2))
        states, ref_states = ([State(p.reshape(2, 1), timestamp=now) for p in points] for points in (xy, ref_xy))
        metric, _ = oracle.compute_gospa_metric(states, ref_states)
        s = score_points(xy, None, ref_xy, None)
        assert s.gospa == pytest.approx(metric.value["distance"], abs=1e-9)
        assert s.sum_sq_error_m2 == pytest.approx(metric.value["localisation"], abs=1e-9)
        assert 2 * (s.fp + s.fn) == pytest.approx(metric.value["missed"] + metric.value["false"])


# Figures 3 to 5 of the paper, means over ten runs: fleet size, TP, FP, FN, F1, GOSPA_M.
FIGURES = (
    (5, 23.9, 6.7, 9.1, 0.7495, 1.5400),
    (10, 26.8, 4.4, 6.2, 0.8345, 1.2694),
    (15, 28.2, 3.8, 4.8, 0.8677, 1.1335),
    (20, 29.0, 2.9, 4.0, 0.8935, 1.1013),
    (25, 29.6, 2.1, 3.4, 0.9149, 1.0145),
    (30, 29.6, 2.1, 3.4, 0.9149, 0.9324),
    (35, 29.9, 1.7, 3.1, 0.9255, 0.9050),
    (40, 30.0, 1.7, 3.0, 0.9271, 0.8158),
    (45, 29.4, 1.9, 3.6, 0.9143, 0.8407),
    (50, 30.0, 1.5, 3.0, 0.9300, 0.7802),
)


@pytest.mark.parametrize("point", FIGURES, ids=lambda p: f"{p[0]} vehicles")
def test_the_figures_of_the_paper_agree_with_each_other(point):
    """The counts of Figure 4 are of 33 signs and give the F1 of Figure 3; with c = 2 m, Figure 5 leaves an MSE_M."""
    _, tp, fp, fn, f1, gospa_m = point
    assert tp + fn == pytest.approx(33.0)
    scores = derive_scores(tp, fp, fn, 0.0, 2.0)
    assert float(scores["f1"]) == pytest.approx(f1, abs=0.0025)  # the mean of ten F1 is not the F1 of mean counts
    mse_m2 = gospa_m**2 - float(scores["gospa_m"]) ** 2
    assert 0.3 < mse_m2 < 1.1
