"""What goes wrong with a reported position along the way, beside its constant offset: drift, and wrong fixes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.compiled import kernel

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


def gauss_markov(elapsed_s: Floats, *, sigma_m: float, correlation_s: float, rng: Generator) -> Floats:
    """Draw a slow drift, east and north, shape (n, 2).

    A stationary first-order Gauss-Markov process an axis: N(0, sigma_m²) at any time, correlated by exp(-Δt / τ), exact
    for uneven steps. Over times short against τ it is a random walk of variance 2 sigma_m² Δt / τ.
    """
    unit = rng.standard_normal((len(elapsed_s), 2))
    keep = np.exp(-np.diff(elapsed_s, prepend=-np.inf) / correlation_s)
    drift: Floats = _recursion(keep, sigma_m * unit)
    return drift


def wrong_fixes(along_m: Floats, *, per_km: float, length_m: float, sigma_m: float, rng: Generator) -> Floats:
    """Draw episodes of a wrong fix and return the further offset of every frame, east and north, shape (n, 2).

    Episodes begin as a Poisson process along the way, last an exponential length of mean `length_m`, and shift the
    position by one N(0, sigma_m²) an axis for as long as they last; episodes that overlap add up.
    """
    first, last = along_m[0], along_m[-1]
    n = rng.poisson(per_km * (last - first) / 1000.0)
    begin = rng.uniform(first, last, n)
    end = begin + rng.exponential(length_m, n)
    jump = sigma_m * rng.standard_normal((n, 2))
    offset = np.zeros((len(along_m), 2))
    for i, j, step in zip(*np.searchsorted(along_m, (begin, end)), jump, strict=True):  # a few a pass
        offset[i:j] += step
    return offset


@kernel
def _recursion(keep: Floats, noise: Floats) -> Floats:
    """Return x_k = a_k x_(k-1) + √(1 - a_k²) w_k, a being `keep`; a_0 is 0."""
    state = np.empty_like(noise)
    for k in range(len(keep)):
        fresh = np.sqrt(1.0 - keep[k] ** 2)
        for axis in range(noise.shape[1]):
            before = keep[k] * state[k - 1, axis] if k else 0.0
            state[k, axis] = before + fresh * noise[k, axis]
    return state
