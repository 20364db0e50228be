from __future__ import annotations

import importlib.util
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from geofleet.algorithms import uncertainty_blocks as ub
from geofleet.algorithms.metrics import derive_scores
from geofleet.algorithms.road import (
    RoadOutcomes,
    _hilbert,
    road_outcomes,
    stations_along_curve,
    stations_along_drive,
)
from geofleet.algorithms.trajectory import drive_line
from geofleet.algorithms.uncertainty import (
    BETTER,
    Comparison,
    Interval,
    compare_replicates,
    replicate_interval,
)
from geofleet.algorithms.uncertainty_paired import compare_on_road
from geofleet.algorithms.uncertainty_road import COMMON_OFFSET, ROAD_SCORES, road_intervals
from geofleet.errors import InputError

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "interval_coverage.py"
MEANS = ["t", "bca", "bootstrap_t"]
SCORES = st.lists(st.floats(0.1, 10).map(lambda x: round(x, 3)), min_size=5, max_size=20, unique=True)


@pytest.fixture(scope="module")
def worlds():
    """The processes of the coverage benchmark."""
    spec = importlib.util.spec_from_file_location("interval_coverage", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def road(seed=0, n=60, length_m=3000.0, miss=0.15, sigma_m=0.5):
    rng = np.random.default_rng(seed)
    outcome = np.where(rng.random(n) < miss, rng.choice(["FN", "FP"], n), "TP")
    sq_m2 = np.minimum(rng.normal(0, sigma_m, n) ** 2 + rng.normal(0, sigma_m, n) ** 2, 3.9)
    return road_outcomes(rng.uniform(0, length_m, n), outcome, sq_m2, length_m=length_m)


# --- over runs


def test_t_interval_by_hand():
    # mean 3, standard deviation √2.5, standard error √0.5, t(0.975; 4) = 2.776445
    interval = replicate_interval([5.0, 1.0, 4.0, 2.0, 3.0], score="f1")
    assert (interval.low, interval.high) == pytest.approx((3 - 2.776445 * 0.5**0.5, 3 + 2.776445 * 0.5**0.5), abs=1e-6)
    assert interval.estimate == 3.0
    assert interval.estimand == "the expected f1 of a run of this procedure"
    assert "5 runs are few" in interval.note


def test_bca_is_scipys_at_the_widened_tail():
    runs = np.random.default_rng(4).lognormal(0, 0.6, 12)
    mine = replicate_interval(runs, method="bca", n_draws=40_000)
    tail = stats.norm.cdf(-math.sqrt(12 / 11) * stats.t.ppf(0.975, 11))
    theirs = stats.bootstrap(
        (runs,), np.mean, confidence_level=1 - 2 * tail, n_resamples=40_000, method="BCa", rng=np.random.default_rng(1)
    ).confidence_interval
    assert (mine.low, mine.high) == pytest.approx((theirs.low, theirs.high), abs=0.03 * runs.std())


def test_bootstrap_t_against_every_resample():
    runs = np.array([1.0, 1.2, 1.9, 2.3, 4.0])
    samples = runs[np.stack(np.meshgrid(*[np.arange(5)] * 5), axis=-1).reshape(-1, 5)]
    errors = samples.std(axis=1, ddof=1) / math.sqrt(5)
    away = samples.mean(axis=1) - runs.mean()
    roots = np.sort(np.divide(away, errors, out=np.copysign(np.inf, away), where=np.ptp(samples, axis=1) > 0))
    error = runs.std(ddof=1) / math.sqrt(5)
    exact = [runs.mean() - roots[int(q * roots.size)] * error for q in (0.95, 0.05)]
    mine = replicate_interval(runs, method="bootstrap_t", level=0.9, n_draws=200_000)
    assert (mine.low, mine.high) == pytest.approx(exact, rel=0.02)


def test_bootstrap_t_of_three_runs_has_no_ends():
    interval = replicate_interval([1.0, 2.0, 4.0], method="bootstrap_t")
    assert interval.low is interval.high is None
    assert "no spread" in interval.note


@pytest.mark.parametrize(("n", "ends"), [(6, (0, 5)), (10, (1, 8)), (20, (5, 14))])
def test_median_by_order_statistics(n, ends):
    # P(Binomial(10, 1/2) <= 1) = 11/1024: the second smallest and largest of ten hold the median with 97.9 %
    interval = replicate_interval(np.arange(n)[::-1] * 1.0, method="median")
    assert (interval.low, interval.high) == ends
    if n == 10:
        assert "97.9%" in interval.note


def test_median_of_five_runs_has_no_interval():
    interval = replicate_interval([1.0, 2.0, 3.0, 4.0, 5.0], method="median")
    assert interval.low is interval.high is None
    assert interval.estimate == 3.0
    assert "whole range" in interval.note


@pytest.mark.parametrize("method", [*MEANS, "median"])
def test_runs_without_a_score_are_counted_and_said(method):
    runs = [1.0, None, 2.0, math.nan, 1.5, 1.7, 1.1, 1.3, 1.2, 1.9]
    interval = replicate_interval(runs, score="gospa_m", method=method)
    defined = replicate_interval([r for r in runs if r is not None and not math.isnan(r)], method=method)
    assert (interval.low, interval.high) == (defined.low, defined.high)
    assert interval.n_null == 2
    assert interval.estimand.endswith("among runs in which it is defined")
    assert "2 of 10 runs have no score and are left out" in interval.note


@pytest.mark.parametrize("runs", [[], [1.0, 2.0], [None] * 9, [1.0, None, 2.0]])
def test_too_few_runs_have_no_interval_and_say_why(runs):
    interval = replicate_interval(runs)
    assert interval.low is interval.high is None
    assert "too few" in interval.note
    assert interval.n_null == sum(r is None for r in runs)


def test_equal_and_skewed_scores_are_said():
    assert "all 9 scores are equal" in replicate_interval([0.1] * 9).note
    assert replicate_interval([0.1] * 9).low == 0.1
    assert "skewed (+" in replicate_interval([1, 1.1, 0.9, 1, 1.05, 0.95, 1, 1, 1.02, 9]).note
    assert replicate_interval(np.linspace(0, 1, 29)).note.startswith("a bad run rarer than one in 29")
    assert replicate_interval(np.linspace(0, 1, 30)).note == ""


@given(SCORES, st.sampled_from(MEANS), st.randoms())
@settings(max_examples=25, deadline=None)
def test_intervals_hold_their_estimate_follow_units_and_ignore_order(runs, method, random):
    base = replicate_interval(runs, method=method, n_draws=499)
    wide = replicate_interval(runs, method=method, n_draws=499, level=0.99)
    shuffled = random.sample(runs, len(runs))
    assert replicate_interval(shuffled, method=method, n_draws=499) == base
    if base.low is not None:
        assert base.low <= base.estimate <= base.high
        scaled = replicate_interval([100 * r for r in runs], method=method, n_draws=499)
        assert (scaled.low, scaled.high) == pytest.approx((100 * base.low, 100 * base.high), rel=1e-6, abs=1e-6)
    if wide.low is not None:
        assert wide.low <= base.low <= base.high <= wide.high


@pytest.mark.parametrize(
    ("runs", "options", "message"),
    [
        ([1.0, math.inf], {}, "a score is infinite"),
        (["a", "b"], {}, "not numbers"),
        ([[1.0], [2.0]], {}, "shape"),
        ([1.0, 2.0, 3.0], {"level": 1.0}, "the level is 1.0"),
        ([1.0, 2.0, 3.0], {"method": "percentile"}, "method is 'percentile'"),
        ([1.0, 2.0, 3.0], {"n_draws": 10}, "10 bootstrap draws"),
    ],
)
def test_bad_runs_are_refused(runs, options, message):
    with pytest.raises(InputError, match=message):
        replicate_interval(runs, **options)


def test_paired_runs_are_scipys_paired_t_test():
    rng = np.random.default_rng(0)
    shared = rng.normal(1, 0.3, 12)
    a, b = shared + rng.normal(0.1, 0.1, 12), shared
    mine, theirs = compare_replicates(a, b, score="gospa_m"), stats.ttest_rel(a, b)
    ends = theirs.confidence_interval(0.95)
    assert mine.p_value == pytest.approx(theirs.pvalue)
    assert (mine.interval.low, mine.interval.high) == pytest.approx((ends.low, ends.high))
    assert mine.verdict == "B is better"
    assert compare_replicates(a, b, score="f1").verdict == "A is better"
    assert compare_replicates(b, a, score="gospa_m").verdict == "A is better"


def test_paired_runs_leave_out_pairs_without_both_scores():
    comparison = compare_replicates([1, None, 2, 3, 4.5], [1, 2, None, 2, 2], score="f1")
    assert comparison.interval.n_null == 2
    assert comparison.interval.estimate == pytest.approx(3.5 / 3)
    assert "2 of 5 pairs have no score" in comparison.interval.note
    few = compare_replicates([1.0, 2.0], [1.0, 1.0], score="f1")
    assert few.p_value is few.interval.low is None
    assert few.verdict == "no difference shown"


def test_equal_runs_are_no_difference():
    assert compare_replicates([1, 2, 3.0], [1, 2, 3.0], score="f1").p_value == 1.0
    assert compare_replicates([2, 3, 4.0], [1, 2, 3.0], score="f1").p_value == 0.0


def test_paired_runs_refuse_what_cannot_be_paired():
    with pytest.raises(InputError, match="3 runs of A and 2 of B"):
        compare_replicates([1, 2, 3], [1, 2], score="f1")
    with pytest.raises(InputError, match="no score 'speed'"):
        compare_replicates([1, 2, 3], [1, 2, 3], score="speed")


def test_every_score_has_a_direction():
    assert set(derive_scores(1, 1, 1, 1, 2)) == set(BETTER)


@given(st.floats(-5, 5), st.floats(0.01, 5))
def test_verdict_follows_the_interval(middle, half):
    comparison = Comparison(Interval(middle - half, middle + half, 0.95, "", ""), None, "lower")
    expected = "no difference shown" if abs(middle) <= half else "B is better" if middle > 0 else "A is better"
    assert comparison.verdict == expected


# --- blocks


def test_blocks_are_two_correlation_lengths_and_grow_with_the_cube_root():
    assert ub.block_length_m(600, 100) == ub.block_length_m(1200, 100) == 200
    assert ub.block_length_m(9600, 100) == pytest.approx(400)


def test_block_sums_against_a_plain_loop():
    outcomes = road()
    blocks = ub.sum_blocks(outcomes.station_m, outcomes.sums(), length_m=3000.0, block_m=290.0)
    assert len(blocks) == 10
    cell_m = 3000.0 / 80
    for start in range(80):
        begin = start * cell_m
        inside = ((outcomes.station_m - begin) % 3000.0) < 8 * cell_m
        assert blocks.moving[start] == pytest.approx(outcomes.sums()[inside].sum(axis=0))
    assert blocks.total == pytest.approx(outcomes.sums().sum(axis=0))
    assert blocks.apart == pytest.approx(blocks.moving[::8])


def test_the_closed_form_is_the_variance_of_many_draws():
    outcomes = road(n=400, length_m=8000.0)
    blocks = ub.sum_blocks(outcomes.station_m, outcomes.sums(), length_m=8000.0, block_m=200.0)
    starts = np.random.default_rng(0).integers(len(blocks.moving), size=(20_000, len(blocks)))
    tp, _, fn, _ = blocks.moving[starts].sum(axis=1).T
    closed = ub.standard_error(ub.influence(blocks, ub.RECALL), len(blocks))
    # the closed form makes up for the estimated mean; a linearised ratio leaves the rest
    assert closed == pytest.approx((tp / (tp + fn)).std() * math.sqrt(40 / 39), rel=0.03)


def test_log_roots_against_a_plain_loop():
    outcomes = road()
    blocks = ub.sum_blocks(outcomes.station_m, outcomes.sums(), length_m=3000.0, block_m=300.0)
    starts = next(ub._starts(80, 10, 200, 3))
    theta, roots = ub.estimate(blocks, ub.MSE), []
    for row in starts:
        above, below = blocks.moving[row, ub.SUM_SQ], blocks.moving[row, ub.TP]
        drawn = above.sum() / below.sum()
        error = math.sqrt(((above - drawn * below) ** 2).sum() * 10 / 9) / above.sum()
        roots.append(math.log(drawn / theta) / error)
    assert ub.log_roots(blocks, ub.MSE, n_draws=200, seed=3) == pytest.approx(np.sort(roots))


def test_draws_in_chunks_are_as_many_as_asked(monkeypatch):
    monkeypatch.setattr(ub, "_CHUNK", 50)
    assert [len(starts) for starts in ub._starts(80, 10, 12, 0)] == [5, 5, 2]


# --- single maps


def test_a_map_without_an_error_gets_wilsons_interval():
    # one sign a block: as many effective signs as signs
    outcomes = road_outcomes(np.arange(30) * 100.0 + 50, ["TP"] * 30, [0.04] * 15 + [0.09] * 15, length_m=3000.0)
    intervals = road_intervals(outcomes, block_m=100.0)
    wilson = stats.binomtest(30, 30).proportion_ci(method="wilson")
    assert (intervals["recall"].low, intervals["recall"].high) == pytest.approx((wilson.low, 1.0))
    assert "few errors, 0 among 30 signs" in intervals["recall"].note
    # the errors that 30 signs cannot show are in GOSPA_M's interval: Wilson's end alone lifts it
    assert intervals["gospa_m"].high ** 2 > 0.065 + 2 * (1 / wilson.low - 1)


def test_signs_that_fail_together_count_as_fewer():
    alone = road_outcomes(np.arange(100) * 30.0, (["TP"] * 9 + ["FN"]) * 10, [0.1] * 100, length_m=3000.0)
    together = road_outcomes(np.arange(100) * 30.0, ["FN"] * 10 + ["TP"] * 90, [0.1] * 100, length_m=3000.0)
    narrow, wide = (road_intervals(m)["recall"] for m in (alone, together))
    assert narrow.estimate == wide.estimate == 0.9
    wilson = stats.binomtest(90, 100).proportion_ci(method="wilson")
    assert (narrow.low, narrow.high) == pytest.approx((wilson.low, wilson.high))
    assert wide.high - wide.low > 2 * (narrow.high - narrow.low)


def test_every_interval_says_what_it_is_for_and_what_it_cannot_show():
    outcomes = road()
    intervals = road_intervals(outcomes)
    scores = derive_scores(*outcomes.sums().sum(axis=0), 2.0)
    assert tuple(intervals) == ROAD_SCORES
    for name, interval in intervals.items():
        assert interval.low < interval.estimate < interval.high
        assert interval.estimate == pytest.approx(float(scores[name]))
        assert interval.estimand == f"the {name} of the same procedure on a longer road like this one"
        assert COMMON_OFFSET in interval.note
        assert interval.method.endswith("11 circular blocks of 273 m")
    assert intervals["rmse_m"].high == pytest.approx(math.sqrt(intervals["mse_m2"].high))


@given(st.integers(0, 10_000), st.integers(8, 60))
@settings(max_examples=40, deadline=None)
def test_road_intervals_ignore_order_and_widen_with_the_level(seed, n):
    outcomes = road(seed=seed, n=n)
    order = np.random.default_rng(seed).permutation(n)
    shuffled = RoadOutcomes(
        outcomes.station_m[order], outcomes.outcome[order], outcomes.sq_distance_m2[order], outcomes.length_m
    )
    base, wide = road_intervals(outcomes, n_draws=199), road_intervals(outcomes, n_draws=199, level=0.99)
    assert road_intervals(shuffled, n_draws=199) == base
    for name, interval in base.items():
        if interval.low is not None:
            assert wide[name].low <= interval.low <= interval.estimate <= interval.high <= wide[name].high


def test_a_short_road_has_no_interval_and_a_few_blocks_a_warning():
    assert "400 m of road are 2 blocks, too few" in road_intervals(road(length_m=400.0))["f1"].note
    assert road_intervals(road(length_m=400.0))["f1"].low is None
    assert "6 blocks, few: coverage is approximate" in road_intervals(road(length_m=1200.0))["f1"].note


@pytest.mark.parametrize(
    ("outcome", "undefined"),
    [
        (["FN"] * 20, {"precision": "the map is empty", "gospa_m": "the map is empty"}),
        (["FP"] * 20, {"recall": "the reference is empty"}),
        (["FP", "FN"] * 10, {"rmse_m": "no point of the map matches the reference"}),
        ([], dict.fromkeys(ROAD_SCORES, "the map and the reference are empty")),
    ],
)
def test_an_undefined_score_has_its_reason(outcome, undefined):
    station = np.linspace(0, 3000, len(outcome))
    intervals = road_intervals(road_outcomes(station, outcome, np.full(len(outcome), np.nan), length_m=3000.0))
    for name, reason in undefined.items():
        assert intervals[name].low is intervals[name].estimate is None
        assert intervals[name].note == reason
    if "f1" not in undefined:
        assert intervals["f1"].low == intervals["f1"].estimate == 0
        assert intervals["f1"].high > 0.05


def test_a_map_equal_to_its_reference_is_not_proved_perfect():
    intervals = road_intervals(road_outcomes(np.linspace(0, 3000, 40), ["TP"] * 40, [0.0] * 40, length_m=3000.0))
    assert intervals["gospa_m"].low == intervals["gospa_m"].estimate == 0
    assert intervals["gospa_m"].high > 0.3
    assert "the localisation part has no interval" in intervals["gospa_m"].note
    assert intervals["rmse_m"].low is None
    assert "every matched distance is 0" in intervals["rmse_m"].note


def test_blocks_that_still_correlate_are_said():
    # 40 % missed on every other stretch of 3 km
    station = np.linspace(0, 60_000, 2000)
    bad = (station // 3000) % 2 == 1
    outcome = np.where(bad & (np.arange(2000) % 5 < 2), "FN", "TP")
    outcomes = road_outcomes(station, outcome, np.full(2000, 0.1), length_m=60_000.0)
    assert "neighbouring blocks still correlate" in road_intervals(outcomes)["recall"].note
    assert "neighbouring blocks" not in road_intervals(outcomes, block_m=3000.0)["recall"].note


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"station_m": [1.0]}, "1 stations, 2 outcomes"),
        ({"length_m": 0.0}, "0.0 m long"),
        ({"station_m": [1.0, 200.0]}, "1 of 2 stations are not within"),
        ({"station_m": [1.0, math.nan]}, "1 of 2 stations are not within"),
        ({"outcome": ["TP", "tp"]}, "outcome 'tp'"),
        ({"sq_distance_m2": [math.nan, 0.1]}, "a TP has no squared distance"),
    ],
)
def test_bad_outcomes_are_refused(change, message):
    columns = {"station_m": [1.0, 2.0], "outcome": ["TP", "FN"], "sq_distance_m2": [0.1, math.nan], "length_m": 100.0}
    with pytest.raises(InputError, match=message):
        road_outcomes(**(columns | change))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gate_m": 0.0}, "the gate is 0.0 m"),
        ({"gate_m": 0.2}, "farther from its sign than the gate of 0.2 m"),
        ({"correlation_m": -1.0}, "the correlation length is -1.0 m"),
        ({"block_m": math.nan}, "the block is nan m"),
        ({"n_draws": 5}, "5 bootstrap draws"),
        ({"level": 0.0}, "the level is 0.0"),
    ],
)
def test_bad_options_are_refused(options, message):
    with pytest.raises(InputError, match=message):
        road_intervals(road(), **options)


# --- two maps


def pair(n=200, length_m=8000.0):
    """B misses every fifth sign and is off by 0.4 m; A misses every tenth and is off by 0.2 m."""
    station, k = np.linspace(0, length_m, n), np.arange(n)
    wobble = 1 + 0.3 * np.sin(k)
    a = road_outcomes(station, np.where(k % 10 == 0, "FN", "TP"), 0.04 * wobble, length_m=length_m)
    b = road_outcomes(station, np.where(k % 5 == 0, "FN", "TP"), 0.16 * wobble, length_m=length_m)
    return a, b


@pytest.mark.parametrize("score", [s for s in ROAD_SCORES if s != "precision"])
def test_the_better_map_is_found_and_sides_can_be_exchanged(score):
    a, b = pair()
    there, back = compare_on_road(a, b, score=score), compare_on_road(b, a, score=score)
    assert there.verdict == "A is better"
    assert there.p_value == back.p_value < 0.05
    assert (there.interval.low, there.interval.high) == pytest.approx((-back.interval.high, -back.interval.low))
    assert there.interval.estimate == pytest.approx(
        road_intervals(a)[score].estimate - road_intervals(b)[score].estimate
    )


def test_pairing_shows_what_two_intervals_do_not():
    a, b = road(seed=1, n=300, length_m=6000.0), road(seed=1, n=300, length_m=6000.0)
    better = RoadOutcomes(a.station_m, a.outcome, a.sq_distance_m2 * 0.9, a.length_m)
    intervals = [road_intervals(m)["rmse_m"] for m in (better, b)]
    assert intervals[0].high > intervals[1].estimate > intervals[1].low
    assert compare_on_road(better, b, score="rmse_m").verdict == "A is better"


@pytest.mark.parametrize("score", ROAD_SCORES)
def test_a_map_is_no_better_than_itself(score):
    comparison = compare_on_road(road(), road(), score=score)
    assert comparison.interval.estimate == 0
    assert comparison.p_value == 1.0
    assert comparison.verdict == "no difference shown"


@given(st.integers(0, 1000), st.sampled_from(ROAD_SCORES))
@settings(max_examples=40, deadline=None)
def test_the_p_value_agrees_with_the_interval(seed, score):
    a = road(seed=seed, n=80)
    rng = np.random.default_rng(seed)
    outcome = np.where((a.outcome == "TP") & (rng.random(80) < 0.1), "FN", a.outcome)
    b = RoadOutcomes(a.station_m, outcome, a.sq_distance_m2 * 0.8, a.length_m)
    comparison = compare_on_road(a, b, score=score)
    assert (comparison.p_value < 0.05) == (comparison.verdict != "no difference shown")


def test_a_perfect_map_against_a_noisy_one():
    a, b = pair()
    perfect = road_outcomes(a.station_m, ["TP"] * 200, [0.0] * 200, length_m=a.length_m)
    assert compare_on_road(perfect, b, score="gospa_m").verdict == "A is better"
    assert compare_on_road(perfect, perfect, score="gospa_m").p_value == 1.0


def test_maps_without_an_error_are_not_proved_equal():
    a, _ = pair()
    perfect = road_outcomes(a.station_m, ["TP"] * 200, [0.0] * 200, length_m=a.length_m)
    interval = compare_on_road(perfect, perfect, score="recall").interval
    assert interval.low < -0.005 < 0.005 < interval.high


def test_what_cannot_be_compared_is_said():
    a, b = pair()
    with pytest.raises(InputError, match=r"A has 200 reference signs on 8000\.0 m and B 1 on"):
        compare_on_road(a, road_outcomes([1.0], ["FN"], [0.0], length_m=8000.0))
    with pytest.raises(InputError, match="no comparison of 'gospa' along a road"):
        compare_on_road(a, b, score="gospa")
    empty = road_outcomes(a.station_m, ["FN"] * 200, [0.0] * 200, length_m=8000.0)
    comparison = compare_on_road(a, empty, score="gospa_m")
    assert comparison.p_value is comparison.interval.low is comparison.interval.estimate is None
    assert comparison.interval.note == "the map is empty"
    short = road(length_m=300.0)
    assert "too few for an interval" in compare_on_road(short, short).interval.note


# --- along the road


def test_stations_along_a_drive_with_a_gap():
    xy = np.array([[0.0, 0], [100, 0], [100, 50], [500, 50], [600, 50]])
    line = drive_line(xy, np.array([0, 0, 0, 1, 1]))
    stations = stations_along_drive(np.array([[40.0, 5], [105, 30], [560, 45], [-20, 0]]), line)
    assert stations.length_m == 250.0
    assert stations.station_m == pytest.approx([40, 130, 210, 0], abs=1.0)
    assert stations_along_drive(np.empty((0, 2)), line).station_m.size == 0


def test_the_curve_visits_every_cell_by_single_steps():
    side = np.arange(16)
    cells = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    index = _hilbert(cells)
    assert np.array_equal(np.sort(index), np.arange(256))
    steps = np.abs(np.diff(cells[np.argsort(index)], axis=0)).sum(axis=1)
    assert np.array_equal(steps, np.ones(255))


def test_stations_along_the_curve_skip_empty_land():
    xy = np.array([[0.0, 0], [30, 0], [5000, 0], [5000, 40], [30, 0]])
    stations = stations_along_curve(xy, longest_gap_m=100.0)
    assert stations.length_m == 30 + 100 + 40
    assert stations.station_m[1] == stations.station_m[4]
    assert stations_along_curve(np.empty((0, 2))).length_m == 0.0
    moved = stations_along_curve(xy + 1e5, longest_gap_m=100.0)
    assert moved.station_m == pytest.approx(stations.station_m)


def test_bad_positions_are_refused():
    with pytest.raises(InputError, match="not \\(n, 2\\) finite"):
        stations_along_curve(np.array([[0.0, math.nan]]))
    with pytest.raises(InputError, match="longest gap is 0"):
        stations_along_curve(np.zeros((2, 2)), longest_gap_m=0.0)


# --- coverage: 500 repetitions a case (benchmarks/interval_coverage.py has more cases and repetitions)

REPETITIONS = 500


def within_bar(coverage):
    """A true coverage of 92 to 98 % leaves this range in fewer than one seed of a thousand (binomial)."""
    low = stats.binom.ppf(0.001, REPETITIONS, 0.92) / REPETITIONS
    high = stats.binom.ppf(0.999, REPETITIONS, 0.98) / REPETITIONS
    return low <= coverage <= high


@pytest.mark.parametrize("name", ["33 signs, stretches of 100 m, 0.3 shared", "33 signs, good map, 0.3 shared"])
def test_coverage_of_single_maps(worlds, name):
    tallies = worlds.road_coverage(worlds.ROADS[name], REPETITIONS, n_draws=299)
    for score in ("precision", "recall", "f1", "gospa_m"):
        assert tallies[score].none == 0
        assert within_bar(tallies[score].coverage), (score, tallies[score].coverage)


def test_coverage_of_a_long_road(worlds):
    long = worlds.World(200, 7200.0, shared=0.3)
    for score, tally in worlds.road_coverage(long, REPETITIONS, n_draws=299).items():
        assert within_bar(tally.coverage), (score, tally.coverage)


def test_a_common_offset_is_not_covered(worlds):
    tallies = worlds.road_coverage(worlds.World(200, 7200.0, common_offset_m=0.5), 100, n_draws=99)
    assert tallies["gospa_m"].coverage < 0.7


def test_coverage_and_size_of_the_paired_test(worlds):
    world = worlds.World(200, 7200.0, shared=0.3)
    for score, (tally, called) in worlds.pair_coverage(world, world, REPETITIONS).items():
        assert within_bar(tally.coverage), (score, tally.coverage)
        assert called == pytest.approx(1 - tally.coverage)


@pytest.mark.parametrize("n_runs", [10, 20])
@pytest.mark.parametrize("method", MEANS)
def test_coverage_over_runs(worlds, method, n_runs):
    tally = worlds.run_coverage(worlds.FLEETS["20 vehicles"], n_runs, method, REPETITIONS)
    assert within_bar(tally.coverage), tally.coverage
