from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.optimize import linear_sum_assignment

from geofleet.algorithms.assignment import assign_sparse
from geofleet.algorithms.matching import match_points
from geofleet.errors import InputError

GATE_M = 2.0


def gospa_sq(matching, n: int, m: int, gate_m: float = GATE_M) -> float:
    return matching.sum_sq_error_m2 + gate_m**2 / 2 * (n + m - 2 * len(matching))


def pair_costs(xy, ref_xy, gate_m, codes=None, ref_codes=None):
    """What each pair costs: its squared distance, or leaving both alone."""
    d = np.sqrt(((xy[:, None] - ref_xy[None]) ** 2).sum(-1))
    allowed = d < gate_m
    if codes is not None:
        allowed &= codes[:, None] == ref_codes[None]
    return np.where(allowed, d**2, gate_m**2)


def brute_force(cost, gate_m):
    """The least cost over every way to pair the smaller set with members of the larger one."""
    cost = cost if cost.shape[0] <= cost.shape[1] else cost.T
    n, m = cost.shape
    best = min(sum(cost[i, j] for i, j in enumerate(chosen)) for chosen in permutations(range(m), n))
    return best + gate_m**2 / 2 * (m - n)


def dense(cost, gate_m):
    i, j = linear_sum_assignment(cost)
    return cost[i, j].sum() + gate_m**2 / 2 * abs(cost.shape[0] - cost.shape[1])


def check_is_matching(matching, xy, ref_xy, gate_m=GATE_M):
    assert matching.index.dtype == matching.ref_index.dtype == np.int64
    assert len(np.unique(matching.index)) == len(matching)
    assert (np.diff(matching.ref_index) > 0).all()
    offset = np.asarray(xy)[matching.index] - np.asarray(ref_xy)[matching.ref_index]
    np.testing.assert_allclose(matching.distance_m, np.sqrt((offset**2).sum(axis=1)), rtol=1e-12)
    assert (matching.distance_m < gate_m).all()


def test_two_good_pairs_beat_one_perfect_pair():
    # On a line, reference at 0 and 1.5, map at 1.5 and 3. Greedy takes 1.5-1.5 (0 m²) and leaves 0 and 3: 0 + 2·2 = 4.
    # Shifted pairs cost 1.5² + 1.5² = 4.5 > 4, so the perfect pair wins; with map at 1.3 and 2.7 it is the other way:
    # 0.2² + 4 = 4.04 against 1.3² + 1.2² = 3.13.
    ref = [(0, 0), (1.5, 0)]
    first = match_points([(1.5, 0), (3, 0)], ref, gate_m=GATE_M)
    assert (first.index.tolist(), first.ref_index.tolist()) == ([0], [1])
    second = match_points([(1.3, 0), (2.7, 0)], ref, gate_m=GATE_M)
    assert (second.index.tolist(), second.ref_index.tolist()) == ([0, 1], [0, 1])
    np.testing.assert_allclose(second.distance_m, [1.3, 1.2])


def test_the_gate_is_exclusive():
    assert len(match_points([(0, 0)], [(2, 0)], gate_m=2.0)) == 0
    assert len(match_points([(0, 0)], [(np.nextafter(2, 0), 0)], gate_m=2.0)) == 1
    assert len(match_points([(0, 0)], [(0, -2)], gate_m=2.0)) == 0


def test_only_equal_codes_match():
    # The nearer point has another code; both sets have negative and large codes.
    xy, codes = [(0, 0), (1, 0)], [7, -3]
    matching = match_points(xy, [(0.1, 0), (5, 5)], gate_m=GATE_M, codes=codes, ref_codes=[-3, 2**62])
    assert (matching.index.tolist(), matching.ref_index.tolist()) == ([1], [0])
    assert matching.distance_m == pytest.approx([0.9])


def test_three_coordinates():
    # 1² + 1² + 1² = 3 < 4, but 1² + 1² + 1.5² = 4.25 > 4.
    xy, ref_xy = [(6e6, 1e6, 3e6), (6e6 + 50, 1e6, 3e6)], [(6e6 + 51, 1e6 + 1, 3e6 + 1.5), (6e6 - 1, 1e6 + 1, 3e6 - 1)]
    matching = match_points(xy, ref_xy, gate_m=GATE_M)
    assert (matching.index.tolist(), matching.ref_index.tolist()) == ([0], [1])
    assert matching.distance_m == pytest.approx([np.sqrt(3)])


@pytest.mark.parametrize(("n", "m"), [(0, 0), (0, 3), (3, 0)])
@pytest.mark.parametrize("codes", [False, True])
def test_empty_sets_have_no_pairs(n, m, codes):
    given_codes = {"codes": np.zeros(n, int), "ref_codes": np.zeros(m, int)} if codes else {}
    matching = match_points(np.zeros((n, 2)), np.zeros((m, 2)), gate_m=GATE_M, **given_codes)
    assert len(matching) == len(matching.distance_m) == 0
    assert matching.sum_sq_error_m2 == 0
    assert len(match_points([], [(1, 2)], gate_m=GATE_M)) == 0


def test_equals_brute_force():
    rng = np.random.default_rng(1)
    for _ in range(400):
        n, m = rng.integers(1, 7, 2)
        xy, ref_xy = rng.uniform(0, 4, (n, 2)), rng.uniform(0, 4, (m, 2))
        if rng.random() < 0.3:  # ties
            xy, ref_xy = np.round(xy), np.round(ref_xy)
        codes, ref_codes = rng.integers(0, 2, n), rng.integers(0, 2, m)
        matching = match_points(xy, ref_xy, gate_m=GATE_M, codes=codes, ref_codes=ref_codes)
        check_is_matching(matching, xy, ref_xy)
        assert (codes[matching.index] == ref_codes[matching.ref_index]).all()
        expected = brute_force(pair_costs(xy, ref_xy, GATE_M, codes, ref_codes), GATE_M)
        assert gospa_sq(matching, n, m) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("extent_m", [1.0, 8.0, 25.0, 60.0])
@pytest.mark.parametrize("dimensions", [2, 3])
def test_equals_dense_hungarian(extent_m, dimensions):
    rng = np.random.default_rng(2)
    for _ in range(6):
        n, m = rng.integers(1, 501, 2)
        xy, ref_xy = rng.uniform(0, extent_m, (n, dimensions)), rng.uniform(0, extent_m, (m, dimensions))
        matching = match_points(xy, ref_xy, gate_m=GATE_M)
        check_is_matching(matching, xy, ref_xy)
        expected = dense(pair_costs(xy, ref_xy, GATE_M), GATE_M)
        assert gospa_sq(matching, n, m) == pytest.approx(expected, abs=1e-9)


def test_coincident_points():
    # 300 points on one spot against 200 there: 200 pairs at 0 m.
    matching = match_points(np.zeros((300, 2)), np.zeros((200, 2)), gate_m=GATE_M)
    assert len(matching) == 200
    assert matching.sum_sq_error_m2 == 0


def test_crowded_scene_is_one_component_and_fast():
    # 20 candidates a point; the optimum is certified by the dense solver on a smaller copy in the tests above.
    rng = np.random.default_rng(3)
    side_m = np.sqrt(10_000 * np.pi * GATE_M**2 / 20)
    xy, ref_xy = rng.uniform(0, side_m, (2, 10_000, 2))
    matching = match_points(xy, ref_xy, gate_m=GATE_M)
    check_is_matching(matching, xy, ref_xy)
    assert len(matching) > 9_000


grid_points = st.integers(0, 12).flatmap(
    lambda n: arrays(np.float64, (n, 2), elements=st.integers(-6, 6).map(lambda k: k / 2))
)


@settings(deadline=None)
@given(xy=grid_points, ref_xy=grid_points, seed=st.integers(0, 2**32 - 1))
def test_input_order_changes_nothing_but_the_labels(xy, ref_xy, seed):
    # Half-metre grid: ties everywhere.
    rng = np.random.default_rng(seed)
    order, ref_order = rng.permutation(len(xy)), rng.permutation(len(ref_xy))

    def pairs(a, b):
        matching = match_points(a, b, gate_m=GATE_M)
        return sorted(np.hstack((a[matching.index], b[matching.ref_index])).tolist()), matching.sum_sq_error_m2

    assert pairs(xy, ref_xy) == pairs(xy[order], ref_xy[ref_order])


@settings(deadline=None)
@given(xy=grid_points, ref_xy=grid_points, axis=st.sampled_from([0, 1]))
def test_optimal_on_ties_and_strip_borders(xy, ref_xy, axis):
    xy, ref_xy = xy * (1, 20)[axis], ref_xy * (1, 20)[axis]
    matching = match_points(xy, ref_xy, gate_m=0.5)
    check_is_matching(matching, xy, ref_xy, 0.5)
    if len(xy) and len(ref_xy):
        expected = dense(pair_costs(xy, ref_xy, 0.5), 0.5)
        assert gospa_sq(matching, len(xy), len(ref_xy), 0.5) == pytest.approx(expected, abs=1e-9)


def test_pairs_just_inside_the_gate_are_found_wherever_strips_begin():
    rng = np.random.default_rng(4)
    xy = np.column_stack((rng.uniform(-1e7, 1e7, 20_000), rng.uniform(-10, 10, 20_000)))
    angle = rng.uniform(0, 2 * np.pi, 20_000)
    ref_xy = xy + (GATE_M - 1e-6) * np.column_stack((np.cos(angle), np.sin(angle)))
    alone = np.diff(np.sort(xy[:, 0]), prepend=-np.inf, append=np.inf)
    alone = np.minimum(alone[:-1], alone[1:])[np.argsort(np.argsort(xy[:, 0]))] > 3 * GATE_M
    matching = match_points(xy, ref_xy, gate_m=GATE_M)
    matched = np.isin(np.arange(20_000), matching.index[matching.index == matching.ref_index])
    assert alone.sum() > 10_000
    assert matched[alone].all()


@pytest.mark.parametrize(
    ("xy", "options", "message"),
    [
        ([(0, np.nan), (1, 1), (np.inf, 0)], {}, "2 of 3 points"),
        ([0, 1, 2], {}, r"shape \(3,\)"),
        ([(0, 1, 2, 3)], {}, r"shape \(1, 4\)"),
        ([("a", "b")], {}, "not numbers"),
        ([(0, 0, 0)], {}, "3 coordinates a point and the reference 2"),
        ([(0, 0)], {"gate_m": 0.0}, "gate is 0.0"),
        ([(0, 0)], {"gate_m": np.nan}, "gate is nan"),
        ([(0, 0)], {"gate_m": np.inf}, "gate is inf"),
        ([(0, 0)], {"gate_m": -1.0}, "gate is -1.0"),
        ([(1e9, 0)], {"gate_m": 1e-6}, "too far from the origin"),
        ([(0, 0)], {"codes": [1]}, "only one of the two"),
        ([(0, 0)], {"codes": [1, 2], "ref_codes": [1]}, r"shape \(2,\), not \(1,\)"),
        ([(0, 0)], {"codes": ["a"], "ref_codes": ["a"]}, "not integers"),
        ([(0, 0)], {"codes": [1.5], "ref_codes": [1.0]}, "not integers"),
    ],
)
def test_bad_input_is_refused(xy, options, message):
    with pytest.raises(InputError, match=message):
        match_points(xy, [(0.0, 0.0)], **({"gate_m": GATE_M} | options))


def test_sparse_assignment_with_any_costs():
    # Against a dense matrix in which every row also has a column of its own, at the cost of staying out.
    rng = np.random.default_rng(5)
    for _ in range(200):
        n, m = rng.integers(1, 12, 2)
        cost = np.where(rng.random((n, m)) < 0.6, rng.normal(0, 3, (n, m)), np.inf)
        skip = rng.normal(0, 2, n)
        kept = np.isfinite(cost)
        start = np.concatenate(([0], kept.sum(axis=1).cumsum()))
        column = assign_sparse(start, np.nonzero(kept)[1], cost[kept], n_columns=m, skip_cost=skip)
        total = sum(skip[i] if j < 0 else cost[i, j] for i, j in enumerate(column))
        own = np.where(np.eye(n, dtype=bool), skip[:, None], np.inf)
        padded = np.hstack((cost, own))
        i, j = linear_sum_assignment(np.where(np.isfinite(padded), padded, 1e6))
        assert total == pytest.approx(padded[i, j].sum(), abs=1e-9)
        taken = column[column >= 0]
        assert len(np.unique(taken)) == len(taken)


@pytest.mark.parametrize(
    ("start", "column", "cost", "message"),
    [
        ([0, 1], [0], [np.nan], "1 costs are not finite"),
        ([0, 2], [0], [1.0], "not one CSR graph"),
        ([0, 1], [3], [1.0], "outside 0"),
    ],
)
def test_a_broken_graph_is_refused(start, column, cost, message):
    with pytest.raises(InputError, match=message):
        assign_sparse(np.array(start), np.array(column), np.array(cost), n_columns=2, skip_cost=1.0)
