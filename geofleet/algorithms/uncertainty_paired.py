"""Is map A better than map B on the same reference? Both resampled on the same blocks of the road.

What makes a stretch hard makes it hard for both maps and cancels in the difference, so a paired comparison shows much
smaller differences than two intervals side by side.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms import uncertainty_blocks as ub
from geofleet.algorithms.uncertainty import Comparison, Interval, direction, joined, two_sided_p
from geofleet.algorithms.uncertainty_road import (
    COMMON_OFFSET,
    MIN_BLOCKS,
    ROAD_SCORES,
    SHARES,
    Resampled,
    check_options,
    length_note,
    road_scores,
    why_none,
)
from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.road import RoadOutcomes

    Floats = NDArray[np.float64]


def compare_on_road(
    a: RoadOutcomes,
    b: RoadOutcomes,
    *,
    score: str = "gospa_m",
    gate_m: float = 2.0,
    level: float = 0.95,
    correlation_m: float = 100.0,
    block_m: float | None = None,
) -> Comparison:
    """Test whether map A scores better than map B against the same reference, paired by the blocks of the road.

    The interval is Student's t at the standard error of the block bootstrap. For precision, recall and F1 the variance
    of half an unseen error a map is added: two maps without an error are not proved equal.

    Parameters
    ----------
    a, b
        Of the two maps, with stations along the same road.
    score
        One of `ROAD_SCORES`.
    correlation_m, block_m
        As in `road_intervals`.

    Raises
    ------
    InputError
        The roads or the numbers of reference signs differ, or an option is out of range.
    """
    check_options(level=level, gate_m=gate_m, correlation_m=correlation_m, block_m=block_m)
    _check_same_reference(a, b, score)
    block_m = block_m or ub.block_length_m(a.length_m, correlation_m)
    maps = [ub.sum_blocks(m.station_m, m.sums(), length_m=m.length_m, block_m=block_m) for m in (a, b)]
    values = [road_scores(blocks, gate_m)[score] for blocks in maps]
    difference = values[0] - values[1]
    road = Resampled(maps[0], a.length_m, gate_m, level, 0, 0)
    words = f"{score} of map A minus that of map B on a longer road like this one"
    how = f"Student's t over {len(maps[0])} paired blocks of {road.block_m:.0f} m"
    notes = [length_note(a.length_m, maps[0]), COMMON_OFFSET]
    reasons = [why_none(blocks) for blocks, value in zip(maps, values, strict=True) if math.isnan(value)]
    if reasons or len(maps[0]) < MIN_BLOCKS:
        note = joined(*dict.fromkeys(reasons), notes[0])
        seen = None if math.isnan(difference) else difference
        return Comparison(Interval(None, None, level, words, how, note, seen), None, direction(score))
    effects, unseen = zip(*(_effect(blocks, score, gate_m) for blocks in maps), strict=True)
    error = math.hypot(road.error(effects[0] - effects[1]), *unseen)
    interval = Interval(
        difference - road.t * error, difference + road.t * error, level, words, how, joined(*notes), difference
    )
    return Comparison(interval, two_sided_p(difference, error, road.dof), direction(score))


def _check_same_reference(a: RoadOutcomes, b: RoadOutcomes, score: str) -> None:
    if score not in ROAD_SCORES:
        raise InputError(f"no comparison of {score!r} along a road", todo=f"Give one of {', '.join(ROAD_SCORES)}.")
    n_a, n_b = (int(np.count_nonzero(m.outcome != "FP")) for m in (a, b))
    if (a.length_m, n_a) != (b.length_m, n_b):
        raise InputError(
            f"A has {n_a} reference signs on {a.length_m} m and B {n_b} on {b.length_m} m",
            where="comparison",
            todo="Score both maps against one reference along one road.",
        )


def _effect(blocks: ub.Blocks, score: str, gate_m: float) -> tuple[Floats, float]:
    """Return what each moving block adds to a score, and the standard error of half an unseen error (shares alone)."""
    if score in SHARES:
        ratio = SHARES[score]
        slope = 2 / (1 + ub.estimate(blocks, ratio)) ** 2 if score == "f1" else 1.0
        return slope * ub.influence(blocks, ratio), slope * math.sqrt(0.5) / float(blocks.total @ ratio.below)
    of_mse = ub.influence(blocks, ub.MSE)
    if score == "mse_m2":
        return of_mse, 0.0
    value = road_scores(blocks, gate_m)[score]
    if value == 0:
        return np.zeros_like(of_mse), 0.0  # a map without any error has no spread either
    if score == "gospa_m":
        of_mse = of_mse - gate_m**2 / 2 * ub.influence(blocks, ub.JACCARD) / ub.estimate(blocks, ub.JACCARD) ** 2
    return of_mse / (2 * value), 0.0
