"""Intervals of single maps: what would the same procedure score on a longer road like this one.

The road is resampled in blocks (`geofleet.algorithms.uncertainty_blocks`). How the bootstrap becomes an interval
decides whether it covers: on 33 signs a percentile interval of precision or recall covers 30 to 90 %, because a map
without an error resamples to maps without an error. Therefore

- precision, recall and F1 get Wilson's interval (doi:10.1080/01621459.1927.10502953) at the effective number of signs
  that the block variance shows, never more than there are; F1 by way of TP / (TP + FP + FN);
- MSE_M and RMSE_M get the bootstrap-t interval on the logarithm (doi:10.1007/978-1-4612-4384-7);
- GOSPA_M² = MSE_M + c²/2 (FN + FP)/TP gets the interval of a sum whose parts have one each, with their correlation
  (MOVER, doi:10.1002/sim.3095).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from geofleet.algorithms import uncertainty_blocks as ub
from geofleet.algorithms.metrics import null_reason
from geofleet.algorithms.uncertainty import MIN_DRAWS, Interval, check_level, joined
from geofleet.algorithms.uncertainty_mean import tails
from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.road import RoadOutcomes

    Floats = NDArray[np.float64]
    Ends = tuple[float, float]

ROAD_SCORES = ("precision", "recall", "f1", "mse_m2", "rmse_m", "gospa_m")
"""The scores that a longer road leaves as they are; GOSPA itself grows with the road."""

COMMON_OFFSET = (
    "an offset common to the whole map (datum, mean GNSS error) is in every block: no single map shows it; "
    "errors shared over more than a block make the interval too short"
)

MIN_BLOCKS = 3
_FEW_BLOCKS = 10
_FEW_ERRORS = 5
_ROUNDING = 1 + 1e-9
SHARES = {"precision": ub.PRECISION, "recall": ub.RECALL, "f1": ub.JACCARD}


@dataclass(frozen=True, slots=True)
class Resampled:
    """One map on its blocks, and how intervals are to be made of it."""

    blocks: ub.Blocks
    length_m: float
    gate_m: float
    level: float
    n_draws: int
    seed: int

    @property
    def block_m(self) -> float:
        """Length of a block, metres."""
        return self.length_m / len(self.blocks)

    @property
    def dof(self) -> float:
        """Degrees of freedom of the variance between blocks; overlapping ones have half as many again as blocks apart.

        Meketon and Schmeiser, "Overlapping batch means: something for nothing?", 1984.
        """
        return 1.5 * (len(self.blocks) - 1)

    @property
    def t(self) -> float:
        """Student's quantile of the level."""
        return float(special.stdtrit(self.dof, (1 + self.level) / 2))

    def error(self, influence: Floats) -> float:
        """Return the standard error of a score from what each block adds to it."""
        return ub.standard_error(influence, len(self.blocks))


def road_intervals(
    outcomes: RoadOutcomes,
    *,
    gate_m: float = 2.0,
    level: float = 0.95,
    correlation_m: float = 100.0,
    block_m: float | None = None,
    n_draws: int = 1999,
    seed: int = 0,
) -> dict[str, Interval]:
    """Give the interval of every score of a single map, by name (`ROAD_SCORES`).

    Parameters
    ----------
    outcomes
        Of the map; their order plays no part.
    gate_m
        c of GOSPA_M, metres.
    correlation_m
        How far along the road signs share what goes wrong; about the range of the sensor.
    block_m
        Length of a block; by default two correlation lengths on roads of up to twelve of them, and growing with the
        cube root of longer ones (`uncertainty_blocks.block_length_m`).
    n_draws, seed
        Of the bootstrap; equal arguments give equal intervals.

    Raises
    ------
    InputError
        A TP is farther than the gate, or an option is out of range.
    """
    check_options(level=level, gate_m=gate_m, correlation_m=correlation_m, block_m=block_m, n_draws=n_draws)
    block_m = block_m or ub.block_length_m(outcomes.length_m, correlation_m)
    blocks = ub.sum_blocks(outcomes.station_m, outcomes.sums(), length_m=outcomes.length_m, block_m=block_m)
    if outcomes.sq_distance_m2[outcomes.outcome == "TP"].max(initial=0.0) > gate_m**2 * _ROUNDING:
        raise InputError(f"a TP is farther from its sign than the gate of {gate_m} m", where="road")
    road = Resampled(blocks, outcomes.length_m, gate_m, level, n_draws, seed)
    estimates = road_scores(blocks, gate_m)
    few = length_note(outcomes.length_m, blocks)
    if len(blocks) < MIN_BLOCKS:
        return {name: _none(name, road, estimates[name], few) for name in ROAD_SCORES}
    shares = {name: _share_ends(road, ratio) for name, ratio in SHARES.items() if not math.isnan(estimates[name])}
    mse = _mse_ends(road) if estimates["mse_m2"] > 0 else None
    ends: dict[str, Ends] = {name: shares[name] for name in ("precision", "recall") if name in shares}
    if "f1" in shares:
        ends["f1"] = (f1_of(shares["f1"][0]), f1_of(shares["f1"][1]))
    if mse is not None:
        ends |= {"mse_m2": mse, "rmse_m": (math.sqrt(mse[0]), math.sqrt(mse[1]))}
    if blocks.total[ub.TP]:
        ends["gospa_m"] = _gospa_m_ends(road, mse or (0.0, 0.0), shares["f1"])
    return {
        name: _interval(name, road, estimates[name], ends[name], few)
        if name in ends
        else _none(name, road, estimates[name], why_none(blocks))
        for name in ROAD_SCORES
    }


def check_options(
    *, level: float, gate_m: float, correlation_m: float, block_m: float | None, n_draws: int = MIN_DRAWS
) -> None:
    """Raise InputError when an option of an interval along a road is out of range."""
    check_level(level)
    lengths = {"gate": gate_m, "correlation length": correlation_m, "block": 1.0 if block_m is None else block_m}
    for name, length_m in lengths.items():
        if not 0 < length_m < math.inf:
            raise InputError(f"the {name} is {length_m} m", where="road", todo="Give a positive distance.")
    if n_draws < MIN_DRAWS:
        raise InputError(f"{n_draws} bootstrap draws", where="road", todo=f"Give at least {MIN_DRAWS}, better 1999.")


def f1_of(jaccard: float) -> float:
    """Return F1 for TP / (TP + FP + FN)."""
    return 2 * jaccard / (1 + jaccard)


def road_scores(blocks: ub.Blocks, gate_m: float) -> dict[str, float]:
    """Return the scores of the whole road; NaN where undefined."""
    mse, jaccard = ub.estimate(blocks, ub.MSE), ub.estimate(blocks, ub.JACCARD)
    cardinality = gate_m**2 / 2 * (1 / jaccard - 1) if jaccard > 0 else math.nan
    return {
        "precision": ub.estimate(blocks, ub.PRECISION),
        "recall": ub.estimate(blocks, ub.RECALL),
        "f1": f1_of(jaccard),
        "mse_m2": mse,
        "rmse_m": math.sqrt(mse),
        "gospa_m": math.sqrt(mse + cardinality),
    }


def _share_ends(road: Resampled, ratio: ub.Ratio) -> Ends:
    """Return Wilson's ends of a share at the effective number of signs, never more than the signs themselves."""
    blocks = road.blocks
    share, n_signs = ub.estimate(blocks, ratio), float(blocks.total @ ratio.below)
    z_sq = float(special.ndtri((1 + road.level) / 2)) ** 2
    variance = share * (1 - share)
    if variance > 0:
        error = road.error(ub.influence(blocks, ratio))
        width = max(z_sq / n_signs, (road.t * error) ** 2 / variance)
    else:
        # without an error (or a hit) nothing shows how signs of a block hang together: take them for one
        width = z_sq / np.count_nonzero(blocks.apart @ ratio.below)
    half = math.sqrt(width * variance + width**2 / 4)
    high = min((share + width / 2 + half) / (1 + width), 1.0)
    # the two ends solve (1 + w) x² - (2 share + w) x + share² = 0: their product gives the low one without cancellation
    low = share**2 / ((1 + width) * high)
    # at a share of 0 or 1 one end is the share itself, which rounding must not miss
    return min(low, share), max(high, share)


def _mse_ends(road: Resampled) -> Ends:
    """Return the bootstrap-t ends of MSE_M on its logarithm."""
    mse = ub.estimate(road.blocks, ub.MSE)
    error = road.error(ub.influence(road.blocks, ub.MSE)) / mse
    roots = ub.log_roots(road.blocks, ub.MSE, n_draws=road.n_draws, seed=road.seed)
    least, most = tails(roots, road.level)
    # no pair is matched beyond the gate, so neither is a mean
    log_high = min(math.log(mse) - least * error, 2 * math.log(road.gate_m))
    return mse * math.exp(-most * error), max(math.exp(log_high), mse)


def _gospa_m_ends(road: Resampled, mse_ends: Ends, jaccard_ends: Ends) -> Ends:
    """Return the ends of GOSPA_M from those of its two parts, √(localisation + cardinality)."""
    blocks, penalty = road.blocks, road.gate_m**2 / 2
    mse, jaccard = ub.estimate(blocks, ub.MSE), ub.estimate(blocks, ub.JACCARD)
    cardinality = penalty * (1 / jaccard - 1)
    low_j, high_j = jaccard_ends
    together = -ub.correlation(ub.influence(blocks, ub.MSE), ub.influence(blocks, ub.JACCARD))
    down = _mover(mse - mse_ends[0], cardinality - penalty * (1 / high_j - 1), together)
    up = _mover(mse_ends[1] - mse, penalty * (1 / low_j - 1) - cardinality, together)
    total = mse + cardinality
    return math.sqrt(max(total - down, 0.0)), math.sqrt(total + up)


def _mover(a: float, b: float, correlation: float) -> float:
    """Return the reach of a sum of two correlated parts that reach `a` and `b`."""
    return math.sqrt(max(a * a + b * b + 2 * correlation * a * b, 0.0))


def _words(name: str, road: Resampled) -> tuple[str, str]:
    """Return the estimand and the method of an interval."""
    methods = {
        "mse_m2": "bootstrap-t on the logarithm",
        "rmse_m": "bootstrap-t on the logarithm",
        "gospa_m": "MOVER of localisation and cardinality",
    }
    n = len(road.blocks)
    how = methods.get(name, "Wilson's interval at the effective number of signs")
    return (
        f"the {name} of the same procedure on a longer road like this one",
        f"{how}, {n} circular blocks of {road.block_m:.0f} m",
    )


def _interval(name: str, road: Resampled, value: float, ends: Ends, few_blocks: str) -> Interval:
    estimand, method = _words(name, road)
    note = joined(few_blocks, _errors_note(name, road.blocks), _neighbours_note(name, road), COMMON_OFFSET)
    return Interval(*ends, road.level, estimand, method, note, value)


def _none(name: str, road: Resampled, value: float, reason: str) -> Interval:
    estimand, method = _words(name, road)
    return Interval(None, None, road.level, estimand, method, reason, None if math.isnan(value) else value)


def why_none(blocks: ub.Blocks) -> str:
    """Say why a score has no interval on a road with enough blocks."""
    tp, fp, fn, _ = blocks.total
    undefined = null_reason(int(tp), int(fp), int(fn))
    return undefined or "every matched distance is 0: nothing shows how far others would be off"


def length_note(length_m: float, blocks: ub.Blocks) -> str:
    """Say when the road is too short for the number of its blocks."""
    n = len(blocks)
    if n >= _FEW_BLOCKS:
        return ""
    what = "too few for an interval" if n < MIN_BLOCKS else "few: coverage is approximate"
    return f"{length_m:.0f} m of road are {n} block{'s' * (n != 1)}, {what}"


def _errors_note(name: str, blocks: ub.Blocks) -> str:
    """Say when there are too few errors for the blocks to show how they hang together."""
    tp, fp, fn, sum_sq = blocks.total
    if name in {"mse_m2", "rmse_m"}:
        return ""
    n_errors = int({"precision": fp, "recall": fn}.get(name, fp + fn))
    few = f"few errors, {n_errors} among {int(tp + n_errors)} signs" if n_errors < _FEW_ERRORS else ""
    exact = (
        "every matched distance is 0: the localisation part has no interval" if name == "gospa_m" and not sum_sq else ""
    )
    return joined(few, exact)


def _neighbours_note(name: str, road: Resampled) -> str:
    """Warn when neighbouring blocks still go wrong together, so that blocks ought to be longer."""
    blocks = road.blocks
    if len(blocks) < _FEW_BLOCKS:
        return ""
    ratio = SHARES.get(name, ub.JACCARD if name == "gospa_m" else ub.MSE)
    residual = blocks.apart @ (np.array(ratio.above) - ub.estimate(blocks, ratio) * np.array(ratio.below))
    spread = float(residual @ residual)
    lagged = float(residual[1:] @ residual[:-1]) / spread if spread else 0.0
    if lagged <= special.ndtri(0.95) / math.sqrt(len(blocks)):
        return ""
    return f"neighbouring blocks still correlate ({lagged:.2f}): the interval is too short, give a larger correlation_m"
