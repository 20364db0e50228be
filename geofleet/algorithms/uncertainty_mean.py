"""Ends of intervals of a mean, of sorted values of independent runs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


_TINY = 1e-9


def mean_of(values: Floats) -> float:
    """Return the mean, correctly rounded."""
    return math.fsum(values.tolist()) / values.size


def standard_error(values: Floats) -> float:
    """Return the standard error of the mean; 0 for equal values, whose mean may round away from them."""
    return 0.0 if np.ptp(values) == 0 else float(values.std(ddof=1) / math.sqrt(values.size))


def t_ends(values: Floats, level: float) -> tuple[float, float]:
    """Return Student's ends of the mean."""
    half = float(special.stdtrit(values.size - 1, (1 + level) / 2)) * standard_error(values)
    mean = mean_of(values)
    return mean - half, mean + half


def bca_ends(values: Floats, level: float, *, n_draws: int, seed: int) -> tuple[float, float]:
    """Return Efron's BCa ends of the mean of sorted values, its tails widened for few values (Hesterberg)."""
    n, mean = values.size, mean_of(values)
    if np.ptp(values) == 0:
        return mean, mean
    draws = np.sort(_resamples(n, n_draws, seed) @ values / n)
    deviation = values - mean
    acceleration = float((deviation**3).sum() / (6 * (deviation**2).sum() ** 1.5))
    # half of the draws that tie with the mean count as below it, also where rounding parts them
    tie = _TINY * np.ptp(values)
    below = (np.searchsorted(draws, mean - tie, "left") + np.searchsorted(draws, mean + tie, "right")) / 2
    bias = special.ndtri(np.clip(below, 0.5, n_draws - 0.5) / n_draws)
    tail = math.sqrt(n / (n - 1)) * special.stdtrit(n - 1, (1 + level) / 2)
    shifted = bias + np.array([-tail, tail])
    # extreme levels of very skewed values must stay on their side
    low, high = np.quantile(draws, special.ndtr(bias + shifted / np.maximum(1 - acceleration * shifted, _TINY)))
    return float(low), float(high)


def bootstrap_t_ends(values: Floats, level: float, *, n_draws: int, seed: int) -> tuple[float, float]:
    """Return the ends of the mean by the bootstrap's own distribution of Student's t; infinite for too few values."""
    n, mean = values.size, mean_of(values)
    if np.ptp(values) == 0:
        return mean, mean
    counts = _resamples(n, n_draws, seed)
    away = counts @ (values - mean) / n
    variance = counts @ (values - mean) ** 2 / n - away**2
    error = np.sqrt(np.maximum(variance, 0.0) / (n - 1))
    roots = np.copysign(math.inf, away)
    # a draw of one value n times has no spread, save for rounding
    np.divide(away, error, out=roots, where=(counts < n).all(axis=1) & (error > 0))
    least, most = tails(np.sort(roots), level)
    return mean - most * standard_error(values), mean - least * standard_error(values)


def tails(roots: Floats, level: float) -> tuple[float, float]:
    """Return the order statistics of sorted roots between which a share `level` lies; infinite ones stay infinite."""
    beyond = math.floor((1 - level) / 2 * roots.size)
    return float(roots[beyond]), float(roots[-1 - beyond])


def _resamples(n: int, n_draws: int, seed: int) -> NDArray[np.int64]:
    """Return how often each of n values occurs in each draw, (n_draws, n)."""
    rng = np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed)))
    return rng.multinomial(n, np.full(n, 1 / n), size=n_draws)
