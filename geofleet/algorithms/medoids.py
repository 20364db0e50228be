"""K-Medoids as Partitioning Around Medoids: BUILD, then FasterPAM's swaps. No distance matrix is kept.

Kaufman, Rousseeuw: Finding Groups in Data, 1990 (BUILD); Schubert, Rousseeuw: Fast and eager k-medoids clustering,
Information Systems 2021, doi:10.1016/j.is.2021.101804 (FasterPAM).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.compiled import inlined_kernel, kernel
from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_ROUNDING = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Medoids:
    """Clusters around members.

    Parameters
    ----------
    rows
        (k,) the members that are centres.
    labels
        (n,) the place in `rows` of each point's nearest centre.
    loss_m
        Sum of the distances of all points to their centres, metres.
    """

    rows: Ints
    labels: Ints
    loss_m: float


class _State(NamedTuple):
    """The nearest and the second nearest medoid of every point, and their squared distances."""

    near: Ints
    second: Ints
    sq_near: Floats
    sq_second: Floats


def build(xy: Floats, k: int) -> Ints:
    """Choose k medoids one after the other, each the point that lowers the loss most; ties go to the first point.

    The first m of them are what `build(xy, m)` returns. What a point would gain never grows as medoids are added, so a
    gain worked out earlier is a bound, and only points whose bound is the largest are looked at again.

    Parameters
    ----------
    xy
        (n, 2) east and north, metres.
    k
        From 1 to n.

    Raises
    ------
    InputError
        `k` is out of range.
    """
    _check(xy, k)
    medoids: Ints = _build(np.ascontiguousarray(xy, np.float64), k)
    return medoids


def fasterpam(xy: Floats, start: Ints) -> Medoids:
    """Swap medoids for other points, each time at once when the loss falls, until no single swap lowers it.

    Parameters
    ----------
    xy
        (n, 2) east and north, metres. Time grows with n² a round, memory with n.
    start
        (k,) distinct rows to begin from: those of `build`.

    Raises
    ------
    InputError
        There is no start, or more medoids than points.
    """
    points = np.ascontiguousarray(xy, np.float64)
    _check(points, len(start))
    rows, labels, loss = _swap_all(points, np.array(start, np.int64))
    return Medoids(rows, labels, float(loss))


def _check(xy: Floats, k: int) -> None:
    if not 1 <= k <= len(xy):
        raise InputError(f"{k} medoids of {len(xy)} points.", where="k-medoids", todo="Give 1 to the number of points.")


@inlined_kernel
def _sq(xy: Floats, i: int, j: int) -> float:
    east, north = xy[i, 0] - xy[j, 0], xy[i, 1] - xy[j, 1]
    return float(east * east + north * north)


@kernel
def _most_central(xy: Floats) -> int:
    best, best_sum = 0, np.inf
    for i in range(len(xy)):
        total = 0.0
        for j in range(len(xy)):
            total += math.sqrt(_sq(xy, i, j))
        if total < best_sum:
            best, best_sum = i, total
    return best


@kernel
def _gain(xy: Floats, candidate: int, sq_near: Floats, near_m: Floats) -> float:
    total = 0.0
    for j in range(len(xy)):
        sq = _sq(xy, candidate, j)
        if sq < sq_near[j]:
            total += near_m[j] - math.sqrt(sq)
    return total


@kernel
def _build(xy: Floats, k: int) -> Ints:
    n = len(xy)
    medoids = np.empty(k, np.int64)
    sq_near, bound, is_new = np.full(n, np.inf), np.full(n, np.inf), np.zeros(n, np.bool_)
    medoids[0] = _most_central(xy)
    for place in range(1, k + 1):
        for j in range(n):
            sq_near[j] = min(sq_near[j], _sq(xy, medoids[place - 1], j))
        bound[medoids[place - 1]] = -1.0  # a medoid is no candidate
        if place == k:
            break
        near_m = np.sqrt(sq_near)
        is_new[:] = False
        best = int(np.argmax(bound))
        while not is_new[best]:
            bound[best], is_new[best] = _gain(xy, best, sq_near, near_m), True
            best = int(np.argmax(bound))
        medoids[place] = best
    return medoids


@kernel
def _settle(xy: Floats, medoids: Ints, state: _State, j: int) -> None:
    """Find the two nearest medoids of a point."""
    state.sq_near[j] = state.sq_second[j] = np.inf
    for m in range(medoids.size):
        sq = _sq(xy, medoids[m], j)
        if sq < state.sq_near[j]:
            state.second[j], state.sq_second[j] = state.near[j], state.sq_near[j]
            state.near[j], state.sq_near[j] = m, sq
        elif sq < state.sq_second[j]:
            state.second[j], state.sq_second[j] = m, sq


@kernel
def _removal_losses(state: _State, k: int) -> Floats:
    """Return how much the loss grows when a medoid is taken away."""
    losses = np.zeros(k)
    for j in range(state.near.size):
        losses[state.near[j]] += math.sqrt(state.sq_second[j]) - math.sqrt(state.sq_near[j])
    return losses


@kernel
def _best_swap(xy: Floats, candidate: int, state: _State, removal: Floats) -> tuple[float, int]:
    """Return the change of the loss, and the medoid to replace, when a point becomes a medoid."""
    change, own = removal.copy(), 0.0
    for j in range(len(xy)):
        sq = _sq(xy, candidate, j)
        if sq >= state.sq_second[j]:
            continue
        d, near, second = math.sqrt(sq), math.sqrt(state.sq_near[j]), math.sqrt(state.sq_second[j])
        if sq < state.sq_near[j]:
            own += d - near
            change[state.near[j]] += near - second
        else:
            change[state.near[j]] += d - second
    place = int(np.argmin(change))
    return change[place] + own, place


@kernel
def _replace(xy: Floats, medoids: Ints, state: _State, place: int) -> None:
    """Bring the state up to date after the medoid at `place` has been replaced."""
    for j in range(len(xy)):
        if state.near[j] == place or state.second[j] == place:
            _settle(xy, medoids, state, j)
            continue
        sq = _sq(xy, medoids[place], j)
        if sq < state.sq_near[j]:
            state.second[j], state.sq_second[j] = state.near[j], state.sq_near[j]
            state.near[j], state.sq_near[j] = place, sq
        elif sq < state.sq_second[j]:
            state.second[j], state.sq_second[j] = place, sq


@kernel
def _swap_all(xy: Floats, medoids: Ints) -> tuple[Ints, Ints, float]:
    n, k = len(xy), medoids.size
    state = _State(np.zeros(n, np.int64), np.zeros(n, np.int64), np.empty(n), np.empty(n))
    for j in range(n):
        _settle(xy, medoids, state, j)
    loss = np.sqrt(state.sq_near).sum()
    candidate, n_tried = 0, 0
    if k > 1:  # the one medoid of BUILD is the best there is
        removal = _removal_losses(state, k)
        while n_tried < n:
            change, place = _best_swap(xy, candidate, state, removal)
            n_tried += 1
            # a medoid and its one companion may change places for nothing: rounding must not count as a gain
            if change < -_ROUNDING * loss and medoids[state.near[candidate]] != candidate:
                medoids[place] = candidate
                _replace(xy, medoids, state, place)
                loss = np.sqrt(state.sq_near).sum()
                removal, n_tried = _removal_losses(state, k), 1
            candidate = (candidate + 1) % n
    return medoids, state.near, loss
