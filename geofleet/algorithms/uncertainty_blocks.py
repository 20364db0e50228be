"""Circular block bootstrap of ratios of sums along a road, on the sums of blocks alone.

Every score of a map is a function of ratios of four sums: TP, FP, FN and Σd². Neighbouring signs share what goes wrong
(the same passes, poses, crowding), so the road is resampled in blocks longer than that reaches: blocks start anywhere
and the road's end runs on into its start, so that every sign is drawn equally often (Politis and Romano, "A circular
block-resampling procedure for stationary data", 1992; moving blocks: Künsch, doi:10.1214/aos/1176347265).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

TP, FP, FN, SUM_SQ = range(4)  # columns of every array of sums

_STARTS_PER_BLOCK = 8
_SHORT_ROAD = 12  # correlation lengths; up to there a block is two of them
_CHUNK = 2_000_000  # numbers drawn at once


class Ratio(NamedTuple):
    """A score as a ratio of weighted sums, by the weights of TP, FP, FN and Σd² above and below the line."""

    above: tuple[float, float, float, float]
    below: tuple[float, float, float, float]


PRECISION = Ratio((1, 0, 0, 0), (1, 1, 0, 0))
RECALL = Ratio((1, 0, 0, 0), (1, 0, 1, 0))
JACCARD = Ratio((1, 0, 0, 0), (1, 1, 1, 0))
MSE = Ratio((0, 0, 0, 1), (1, 0, 0, 0))


@dataclass(frozen=True, slots=True)
class Blocks:
    """The sums of one map over all the blocks of a road.

    Parameters
    ----------
    moving
        (8 n, 4) sums over the blocks that start at each eighth of a block, circular.
    apart
        (n, 4) sums over the n blocks that follow one another without overlap.
    total
        (4,) sums over the road.
    """

    moving: Floats
    apart: Floats
    total: Floats

    def __len__(self) -> int:
        """Return n, how many blocks fill the road."""
        return len(self.apart)


def block_length_m(length_m: float, correlation_m: float) -> float:
    """Return the length of a block: two correlation lengths, growing with the cube root of roads over twelve.

    The cube root is the rate at which the error of a block bootstrap's variance is least (doi:10.1093/biomet/82.3.561).
    """
    return 2 * correlation_m * math.cbrt(max(length_m / (_SHORT_ROAD * correlation_m), 1.0))


def sum_blocks(station_m: Floats, sums: Floats, *, length_m: float, block_m: float) -> Blocks:
    """Sum rows of TP, FP, FN, Σd² over the blocks of a road.

    Parameters
    ----------
    station_m
        (n,) in 0 … length_m.
    sums
        (n, 4).
    block_m
        Length of a block; the nearest one that divides the road is taken.
    """
    n_blocks = max(round(length_m / block_m), 1)
    n_cells = n_blocks * _STARTS_PER_BLOCK
    order = np.lexsort((*sums.T, station_m))  # sums of Σd² must not depend on the order of the input
    station_m, sums = station_m[order], sums[order]
    cell = np.minimum((station_m / length_m * n_cells).astype(np.int64), n_cells - 1)
    cells = np.column_stack([np.bincount(cell, weights=column, minlength=n_cells) for column in sums.T])
    apart = cells.reshape(n_blocks, _STARTS_PER_BLOCK, -1).sum(axis=1)
    on = np.concatenate((cells, cells[: _STARTS_PER_BLOCK - 1]))
    moving = np.lib.stride_tricks.sliding_window_view(on, _STARTS_PER_BLOCK, axis=0).sum(axis=-1)
    return Blocks(moving, apart, apart.sum(axis=0))


def estimate(blocks: Blocks, ratio: Ratio) -> float:
    """Return the ratio over the whole road; NaN where it is undefined."""
    below = float(blocks.total @ ratio.below)
    return float(blocks.total @ ratio.above) / below if below else math.nan


def influence(blocks: Blocks, ratio: Ratio) -> Floats:
    """Return what each moving block adds to the ratio, to first order: (8 n,), of mean 0."""
    return (
        blocks.moving
        @ (np.array(ratio.above) - estimate(blocks, ratio) * np.array(ratio.below))
        / (blocks.total @ ratio.below)
    )


def standard_error(influences: Floats, n_blocks: int) -> float:
    """Return the bootstrap's standard error of a sum of influences, in closed form: no draws, so no noise of draws.

    A draw sums n blocks taken with equal chances, whose variance is n times the mean square; n / (n - 1) makes up for
    the mean that was estimated.
    """
    return float(n_blocks * math.sqrt(np.mean(influences**2) / (n_blocks - 1)))


def correlation(a: Floats, b: Floats) -> float:
    """Return the correlation of two scores over the bootstrap; 0 where one does not vary."""
    spread = math.sqrt(float(np.mean(a**2) * np.mean(b**2)))
    return float(np.clip(np.mean(a * b) / spread, -1.0, 1.0)) if spread else 0.0


def log_roots(blocks: Blocks, ratio: Ratio, *, n_draws: int, seed: int) -> Floats:
    """Draw (log θ* - log θ) / se*(log θ*) of a positive ratio θ: the studentised root of the bootstrap-t, sorted.

    Each draw has its own standard error, from the blocks that were drawn; a draw without spread counts as infinitely
    far out, and a draw in which the ratio is undefined or 0 is left out.
    """
    n = len(blocks)
    above, below = blocks.moving @ ratio.above, blocks.moving @ ratio.below
    columns = np.column_stack((above, below, above**2, above * below, below**2))
    sums = np.concatenate([columns[starts].sum(axis=1) for starts in _starts(len(columns), n, n_draws, seed)])
    sum_above, sum_below, above_sq, cross, below_sq = sums[(sums[:, 0] > 0) & (sums[:, 1] > 0)].T
    drawn = sum_above / sum_below
    residual_sq = np.maximum(above_sq - 2 * drawn * cross + drawn**2 * below_sq, 0.0)
    error = np.sqrt(residual_sq * n / (n - 1)) / sum_above
    away = np.log(drawn / estimate(blocks, ratio))
    far = np.copysign(math.inf, away)
    np.divide(away, error, out=far, where=error > 0)
    return np.sort(far)


def _starts(n_starts: int, n_blocks: int, n_draws: int, seed: int) -> Iterator[Ints]:
    """Yield the starts of the blocks of each draw, (draws, n_blocks), so many draws at once as memory likes."""
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    at_once = max(_CHUNK // n_blocks, 1)
    for first in range(0, n_draws, at_once):
        yield rng.integers(n_starts, size=(min(at_once, n_draws - first), n_blocks))
