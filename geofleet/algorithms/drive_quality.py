"""Which epochs of a recorded drive can be true: the longest chain that one car can have driven, and where it stood.

A receiver that calls a fix certain may still be tens of metres off, for one epoch or for a minute. Two neighbouring
epochs are torn apart where the step between them fits neither the step before nor the step after; what lies between two
tears hangs together, and of these pieces the chain with the most epochs is kept whose links a car could have driven.
A wrong stretch that slides into the right one within the noise cannot be told from it and stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]

MAX_SPEED_MPS = 100.0
MAX_ACCELERATION_MPS2 = 10.0  # full braking on a dry road
JUMP_M = 5.0  # steps off by less than this are noise
TEAR_S = 30.0  # a chain may hold an impossible step where leaving it out would cost more than this much recording
HOLD_S = 5.0
BACKING_SATELLITES = 8
STANDING_RADIUS_M = 0.3
STANDING_S = 2.0
_MAX_STANDING_RADIUS_M = 3.0
_NOISE_FACTOR = 3.0
_JUMP_NOISE_FACTOR = 6.0
_LINKS = 256  # pieces before a piece that are tried as the one it follows, beside the best of all
_NORMAL = 1.4826  # standard deviation of a normal variable over the median of its absolute value
_SECOND_DIFFERENCE = np.sqrt(6.0)  # standard deviation of the second difference of white noise over that of the noise


@dataclass(frozen=True, slots=True)
class Stops:
    """Stretches of epochs where the car stands: the first and the last epoch of each, shape (n,) both."""

    first: Ints
    last: Ints

    def is_standing(self, n_epochs: int) -> Flags:
        """Tell which epochs belong to a stop."""
        edges = np.zeros(n_epochs + 1, np.int64)
        edges[self.first] += 1
        edges[self.last + 1] -= 1
        return np.asarray(np.cumsum(edges[:-1]) > 0)

    def is_inside(self, n_epochs: int) -> Flags:
        """Tell which epochs stand between the first and the last of a stop."""
        inside = self.is_standing(n_epochs)
        inside[self.first] = False
        inside[self.last] = False
        return inside


def find_jumps(t_s: Floats, xyz_m: Floats) -> Flags:
    """Tell which epochs are not on the longest chain that a car can have driven.

    Parameters
    ----------
    t_s
        Seconds, strictly ascending, shape (n,).
    xyz_m
        Cartesian positions, shape (n, k) with any number of axes.

    Returns
    -------
    ndarray of bool
        The epochs to leave out, shape (n,). Of chains with as many epochs the earlier one is kept. A chain may hold an
        impossible step, at the price of `TEAR_S` of epochs: `find_tears` finds what is left of them.
    """
    if len(t_s) < 2:  # noqa: PLR2004 - a jump needs a place to jump from
        return np.zeros(len(t_s), np.bool_)
    jump_m = max(JUMP_M, _JUMP_NOISE_FACTOR * noise_m(t_s, xyz_m))
    torn = _torn(t_s, xyz_m, jump_m)
    if not torn.any():
        return np.zeros(len(t_s), np.bool_)
    starts = np.concatenate(([0], np.flatnonzero(torn) + 1, [len(t_s)])).astype(np.int64)
    tear_cost = TEAR_S / float(np.median(np.diff(t_s)))
    kept = _longest_chain(t_s, np.ascontiguousarray(xyz_m), starts, jump_m, tear_cost)
    return np.asarray(np.repeat(~kept, np.diff(starts)))


def find_tears(t_s: Floats, xyz_m: Floats) -> Flags:
    """Tell which steps, from each epoch to the next, no car can have driven, shape (n - 1,); they start a segment."""
    return _torn(t_s, xyz_m, max(JUMP_M, _JUMP_NOISE_FACTOR * noise_m(t_s, xyz_m)))


def hasty_fixes(t_s: Floats, is_fixed: Flags, segment: Ints) -> Flags:
    """Tell which epochs are called fixed in a run of less than `HOLD_S` that epochs of lower quality adjoin.

    A gap ends a run.

    Integers that are right hold; those that come and go are often wrong. In Nagoya's drive 25 % of such fixes are
    more than 1 m off, up to 41.8 m, and none of the others is more than 0.11 m off.
    """
    n = len(t_s)
    change = np.flatnonzero((is_fixed[1:] != is_fixed[:-1]) | (segment[1:] != segment[:-1])) + 1
    first, stop = np.concatenate(([0], change)), np.concatenate((change, [n]))
    before, after = np.maximum(first - 1, 0), np.minimum(stop, n - 1)
    adjoined = ~is_fixed[before] | ~is_fixed[after]
    hasty = is_fixed[first] & adjoined & (t_s[stop - 1] - t_s[first] < HOLD_S)
    return np.asarray(np.repeat(hasty, stop - first))


def unbacked_fixes(is_hasty: Flags, n_satellites: Floats) -> Flags:
    """Tell which of the fixes that do not hold are backed by fewer than `BACKING_SATELLITES` satellites.

    Four satellites give a position that nothing checks, and each one more checks little of it. In Nagoya's drive 85 of
    89 such fixes are more than 1 m off, the one of 41.8 m among them, at an agreeing float position; of the other 356
    that do not hold 28 are. A fix that holds may have few satellites. NaN satellites are taken for enough.
    """
    return np.asarray(is_hasty & (n_satellites < BACKING_SATELLITES))


def noise_m(t_s: Floats, xyz_m: Floats) -> float:
    """Return a robust standard deviation, an axis, of the noise between neighbouring epochs, metres."""
    if len(t_s) < 3:  # noqa: PLR2004 - a second difference needs three epochs
        return 0.0
    share = ((t_s[1:-1] - t_s[:-2]) / (t_s[2:] - t_s[:-2]))[:, None]
    off = xyz_m[1:-1] - xyz_m[:-2] - share * (xyz_m[2:] - xyz_m[:-2])
    per_axis = np.sqrt((off**2).sum(axis=1) / 2.0)  # motion and its noise lie in the horizontal plane
    return float(2.0 * _NORMAL * np.median(per_axis) / _SECOND_DIFFERENCE)


def find_stops(t_s: Floats, xyz_m: Floats, segment: Ints) -> Stops:
    """Find where the car stays within a circle for `STANDING_S`; its radius grows with the noise of the receiver.

    Parameters
    ----------
    t_s, xyz_m
        As in `find_jumps`.
    segment
        Number of the segment of each epoch, shape (n,); no stop reaches over two.
    """
    radius_m = standing_radius_m(t_s, xyz_m)
    first, last = _stops(t_s, np.ascontiguousarray(xyz_m), segment, radius_m, STANDING_S)
    return Stops(first, last)


def standing_radius_m(t_s: Floats, xyz_m: Floats) -> float:
    """Return the distance below which two epochs show no motion, metres."""
    return min(max(STANDING_RADIUS_M, _NOISE_FACTOR * noise_m(t_s, xyz_m)), _MAX_STANDING_RADIUS_M)


def _torn(t_s: Floats, xyz_m: Floats, jump_m: float) -> Flags:
    """Tell which steps, from each epoch to the next, fit neither of their neighbours, shape (n - 1,)."""
    dt = np.diff(t_s)
    step = np.diff(xyz_m, axis=0)
    torn: Flags = np.asarray(np.linalg.norm(step, axis=1) > jump_m + MAX_SPEED_MPS * dt)
    if len(dt) < 2:  # noqa: PLR2004 - one step has no neighbour
        return torn
    with np.errstate(over="ignore", invalid="ignore"):  # steps of next to no time
        change = np.linalg.norm(np.diff(step / dt[:, None], axis=0), axis=1)
    both = dt[1:] + dt[:-1]
    fits_before = np.append(False, change * dt[1:] <= _allowed_m(dt[1:], both, jump_m))
    fits_after = np.append(change * dt[:-1] <= _allowed_m(dt[:-1], both, jump_m), False)
    return np.asarray(torn | ~(fits_before | fits_after))


def _allowed_m(dt_s: Floats, both_s: Floats, jump_m: float) -> Floats:
    """Return how far off a step may be from what its neighbour says: noise, or what an acceleration brings about."""
    return np.maximum(jump_m, 0.5 * MAX_ACCELERATION_MPS2 * dt_s * both_s)


@kernel
def _longest_chain(t_s: Floats, xyz_m: Floats, starts: Ints, jump_m: float, tear_cost: float) -> Flags:
    """Return which pieces are on the best chain; piece p holds epochs starts[p] to starts[p + 1].

    A chain is worth its epochs, less `tear_cost` for every link that no car can have driven.
    """
    n = len(starts) - 1
    score = np.empty(n, np.float64)
    parent = np.full(n, -1)
    best = 0
    for p in range(n):
        size = starts[p + 1] - starts[p]
        score[p] = size
        for q in range(max(0, p - _LINKS) - 1, p):
            before = best if q == max(0, p - _LINKS) - 1 else q
            if before == p or score[before] + size <= score[p]:
                continue
            through = score[before] + size
            if not _follows(
                t_s, xyz_m, (starts[before], starts[before + 1] - 1), (starts[p], starts[p + 1] - 1), jump_m
            ):
                through -= tear_cost
            if through > score[p]:
                score[p] = through
                parent[p] = before
        if score[p] > score[best]:
            best = p
    kept = np.zeros(n, np.bool_)
    while best >= 0:
        kept[best] = True
        best = parent[best]
    return kept


@kernel
def _follows(t_s: Floats, xyz_m: Floats, before: tuple[int, int], after: tuple[int, int], jump_m: float) -> bool:
    """Tell whether a car can have come from the end of one piece to the start of a later one: first, last epoch."""
    i, j = before[1], after[0]
    dt = t_s[j] - t_s[i]
    gap = xyz_m[j] - xyz_m[i]
    if np.sqrt((gap**2).sum()) > jump_m + MAX_SPEED_MPS * dt:
        return False
    has_before, has_after = i > before[0], j < after[1]
    if has_before and _fits(gap, dt, xyz_m[i] - xyz_m[i - 1], t_s[i] - t_s[i - 1], jump_m):
        return True
    if has_after and _fits(gap, dt, xyz_m[j + 1] - xyz_m[j], t_s[j + 1] - t_s[j], jump_m):
        return True
    return not (has_before or has_after)


@kernel
def _fits(gap: Floats, dt: float, step: Floats, step_s: float, jump_m: float) -> bool:
    """Tell whether a gap of dt seconds goes on at the speed of a step, within what an acceleration brings about."""
    off = gap - step * (dt / step_s)
    return bool(np.sqrt((off**2).sum()) <= max(jump_m, 0.5 * MAX_ACCELERATION_MPS2 * dt * (dt + step_s)))


@kernel
def _stops(t_s: Floats, xyz_m: Floats, segment: Ints, radius_m: float, least_s: float) -> tuple[Ints, Ints]:
    """Return first and last epoch of each stretch that stays near its first epoch for long enough."""
    n = len(t_s)
    first, last = np.empty(n, np.int64), np.empty(n, np.int64)
    n_stops = i = 0
    while i < n:
        j = i + 1
        while j < n and segment[j] == segment[i] and np.sqrt(((xyz_m[j] - xyz_m[i]) ** 2).sum()) <= radius_m:
            j += 1
        if t_s[j - 1] - t_s[i] >= least_s:
            first[n_stops], last[n_stops] = i, j - 1
            n_stops += 1
            i = j
        else:
            i += 1
    return first[:n_stops], last[:n_stops]
