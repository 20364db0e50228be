"""Where each pass lies against the others: a vote over pairs of equal class, one pass after the other.

Signs repeat along a road, so a nearest-neighbour start can lock on shifted by one sign. Here every pass is laid on the
map that the passes before it made at each offset that brings one of its tracks onto a sign of its class, and takes the
most likely: with the GNSS prior and robust to tracks without a partner. Then each pass is taken out and laid again on
the map of all others, until nothing moves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.compiled import kernel
from geofleet.algorithms.joint_grid import NOTHING, Grid, file_thing, grid_around, longer, things_around, unfile_thing
from geofleet.algorithms.joint_offsets import SIGN_DENSITY_M2, Partners, best_offset

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

CORE_M = 0.5
"""Passes laid on each other fit to this, an axis, beside what their tracks declare."""
REACH_SIGMAS = 4.0
OTHER_CLASS = 0.01
"""A partner of another class counts this much: a misread class still holds the pass in place."""
N_ROUNDS = 3
MOVED_M = 0.25


def align_passes(
    xy_m: Floats, var_m2: Floats, class_code: Ints, first: Ints, sigma_m: Floats, *, cell_m: float
) -> Floats:
    """Return the offset of every pass against their common map, (n_passes, 2).

    Parameters
    ----------
    xy_m, var_m2, class_code
        (n, 2), (n,), (n,) places of the tracks (bias taken out), their variance an axis, their classes; by pass.
    first
        (n_passes + 1,) tracks `first[v]:first[v + 1]` are those of pass v.
    sigma_m
        (n_passes,) standard deviation an axis of the offset of each pass; the surest pass with most tracks comes first.
    cell_m
        Passes that share cells as wide are laid one after the other, so that each finds a map where it drove.
    """
    n_passes = len(first) - 1
    if n_passes == 0:
        return np.zeros((0, 2))
    order = _order(xy_m, first, sigma_m, cell_m)
    passes = _Passes(np.ascontiguousarray(xy_m), np.sqrt(var_m2 + CORE_M**2), class_code, first, sigma_m**2)
    var_m2_base = float(passes.sigma2[order[0]])
    reach_m = REACH_SIGMAS * float(np.sqrt(passes.sigma2.max() + var_m2_base))
    offset: Floats = _align(passes, order, var_m2_base, _no_points(len(xy_m)), grid_around(xy_m, reach_m, len(xy_m)))
    return offset


def _order(xy_m: Floats, first: Ints, sigma_m: Floats, cell_m: float) -> Ints:
    """Return the order in which passes are laid: the surest first, then whoever drove most where others drove."""
    n_passes = len(first) - 1
    cell = np.floor((xy_m - xy_m.min(axis=0)) / cell_m).astype(np.int64)
    _, key = np.unique(cell[:, 0] * (int(cell[:, 1].max()) + 1) + cell[:, 1], return_inverse=True)
    owner = np.repeat(np.arange(n_passes), np.diff(first))
    by_cell = np.argsort(key, kind="stable")
    start = np.searchsorted(key[by_cell], np.arange(int(key.max()) + 2))
    order: Ints = _walk(key, first, owner[by_cell], start, np.diff(first) / np.maximum(sigma_m, 1e-3) ** 2)
    return order


@kernel
def _walk(key: Ints, first: Ints, owner: Ints, start: Ints, worth: Floats) -> Ints:
    """Take the pass with the most tracks in cells that are taken already; ties and new beginnings by worth."""
    n = first.size - 1
    shared, is_laid, is_taken = np.zeros(n), np.zeros(n, np.bool_), np.zeros(start.size - 1, np.bool_)
    order = np.empty(n, np.int64)
    for step in range(n):
        best = -1
        for v in range(n):
            if not is_laid[v] and (
                best < 0 or shared[v] > shared[best] or (shared[v] == shared[best] and worth[v] > worth[best])
            ):
                best = v
        order[step], is_laid[best] = best, True
        for i in range(first[best], first[best + 1]):
            if not is_taken[key[i]]:
                is_taken[key[i]] = True
                for k in range(start[key[i]], start[key[i] + 1]):
                    shared[owner[k]] += 1
    return order


class _Passes(NamedTuple):
    """Tracks, by pass."""

    xy_m: Floats  # (n, 2)
    spread_m: Floats  # (n,)
    class_code: Ints  # (n,)
    first: Ints  # (n_passes + 1,)
    sigma2: Floats  # (n_passes,) variance an axis of the offset of each pass


class _Points(NamedTuple):
    """The map so far: means of tracks of one class. There are no more of them than tracks."""

    total: Floats  # (n, 2) sum of the places of its tracks, offsets taken out
    n_tracks: Ints  # (n,)
    class_code: Ints  # (n,)
    taken_in: Ints  # (n,) the last step in which a pass took it
    of_track: Ints  # (n,) point of each track
    free: Ints  # points that nobody has, as a stack
    n_free: Ints  # (1,)


def _no_points(n: int) -> _Points:
    zeros, nothing = np.zeros((3, n), np.int64), np.full((2, n), NOTHING)
    free = np.arange(n - 1, -1, -1)
    return _Points(np.zeros((n, 2)), zeros[0], zeros[1], nothing[0], nothing[1], free, np.full(1, n))


@kernel
def _align(passes: _Passes, order: Ints, base_var: float, points: _Points, grid: Grid) -> Floats:
    n_passes = order.size
    offset = np.zeros((n_passes, 2))
    for turn in range(1 + N_ROUNDS):
        n_moved = 0
        for step in range(n_passes):
            v = order[step]
            _take_out(passes, points, grid, v, offset[v])
            sigma2 = passes.sigma2[v] + base_var
            partners = _partners(passes, points, grid, v, REACH_SIGMAS * np.sqrt(sigma2))
            east, north = 0.0, 0.0
            if step > 0 or turn > 0:
                east, north = best_offset(partners, sigma2, offset[v])
            if (east - offset[v, 0]) ** 2 + (north - offset[v, 1]) ** 2 > MOVED_M**2:
                n_moved += 1
            offset[v, 0], offset[v, 1] = east, north
            _lay(passes, points, grid, partners, v, offset[v], turn * n_passes + step)
        if turn and n_moved == 0:
            break
    return offset


@kernel
def _take_out(passes: _Passes, points: _Points, grid: Grid, v: int, offset: Floats) -> None:
    """Take a pass out of the map; a point that only it had keeps its number until the pass is laid again."""
    for i in range(passes.first[v], passes.first[v + 1]):
        if points.of_track[i] != NOTHING:
            _add(passes, points, grid, i, offset, -1)


@kernel
def _add(passes: _Passes, points: _Points, grid: Grid, i: int, offset: Floats, times: int) -> None:  # noqa: PLR0917 - numba takes no keyword-only arguments
    """Add a track to its point, or take it out again."""
    k = points.of_track[i]
    points.n_tracks[k] += times
    points.total[k, 0] += times * (passes.xy_m[i, 0] - offset[0])
    points.total[k, 1] += times * (passes.xy_m[i, 1] - offset[1])
    if points.n_tracks[k] > 0:
        file_thing(grid, k, points.total[k, 0] / points.n_tracks[k], points.total[k, 1] / points.n_tracks[k])
    else:
        unfile_thing(grid, k)


@kernel
def _apart(passes: _Passes, points: _Points, i: int, k: int) -> tuple[float, float]:
    """Return the offset that brings a track onto a point."""
    return (
        passes.xy_m[i, 0] - points.total[k, 0] / points.n_tracks[k],
        passes.xy_m[i, 1] - points.total[k, 1] / points.n_tracks[k],
    )


@kernel
def _partners(passes: _Passes, points: _Points, grid: Grid, v: int, reach_m: float) -> Partners:
    """Return the points of the map within reach of each track of a pass, those of a track from west to east."""
    a, b = passes.first[v], passes.first[v + 1]
    start, point, found = np.zeros(b - a + 1, np.int64), np.empty(8 * (b - a) + 8, np.int64), np.empty(64, np.int64)
    n = 0
    for i in range(a, b):
        found, n_found = things_around(grid, passes.xy_m[i, 0], passes.xy_m[i, 1], found)
        for at in range(n_found):
            de, dn = _apart(passes, points, i, found[at])
            if de * de + dn * dn < reach_m * reach_m:
                if n == point.size:
                    point = longer(point)
                _put_by_east(points, point, start[i - a], n, found[at])
                n += 1
        start[i - a + 1] = n
    partners = Partners(
        start,
        point[:n],
        np.empty((n, 2)),
        np.empty(n, np.bool_),
        np.full(n, OTHER_CLASS),
        np.empty(n),
        passes.spread_m[a:b] ** 2,
    )
    for i in range(a, b):
        _weigh(passes, points, partners, i, i - a)
    return partners


@kernel
def _put_by_east(points: _Points, point: Ints, begin: int, end: int, new: int) -> None:
    """Insert a point into a part of the list that is sorted by east, of equals by number."""
    east, at = points.total[new, 0] / points.n_tracks[new], end
    while at > begin:
        k = point[at - 1]
        other = points.total[k, 0] / points.n_tracks[k]
        if other < east or (other == east and k < new):
            break
        point[at] = k
        at -= 1
    point[at] = new


@kernel
def _weigh(passes: _Passes, points: _Points, partners: Partners, i: int, r: int) -> None:
    """Say where the partners of a track are, and how much each counts.

    A point that has most of the tracks of the class around is the likelier partner: of two copies of one map, which
    half of the passes made each, the larger one grows, where both would last if all points were alike.
    """
    around = 0
    for at in range(partners.start[r], partners.start[r + 1]):
        k = partners.point[at]
        partners.apart_m[at, 0], partners.apart_m[at, 1] = _apart(passes, points, i, k)
        partners.is_same[at] = points.class_code[k] == passes.class_code[i]
        if partners.is_same[at]:
            around += points.n_tracks[k]
    for at in range(partners.start[r], partners.start[r + 1]):
        count = points.n_tracks[partners.point[at]]
        if partners.is_same[at]:
            partners.weight[at] = (count + 1) / (around - count + 1)
        partners.most[at] = 1 / (2 * np.pi * partners.var[r] * SIGN_DENSITY_M2) * partners.weight[at]


@kernel
def _lay(  # noqa: PLR0917 - numba takes no keyword-only arguments
    passes: _Passes, points: _Points, grid: Grid, partners: Partners, v: int, offset: Floats, step: int
) -> None:
    """Add the tracks of a pass to the map: to the nearest free point of their class, or as new points."""
    for r in range(partners.var.size):
        i = passes.first[v] + r
        k, own = _nearest_free(passes, points, partners, i, r, offset, step), points.of_track[i]
        is_own_left = own != NOTHING and points.n_tracks[own] == 0
        if k == NOTHING:
            if is_own_left:
                k = own
            else:
                points.n_free[0] -= 1
                k = points.free[points.n_free[0]]
            points.total[k, 0], points.total[k, 1] = 0.0, 0.0
            points.class_code[k] = passes.class_code[i]
        elif is_own_left:
            points.free[points.n_free[0]] = own
            points.n_free[0] += 1
        points.of_track[i], points.taken_in[k] = k, step
        _add(passes, points, grid, i, offset, 1)


@kernel
def _nearest_free(  # noqa: PLR0917 - numba takes no keyword-only arguments
    passes: _Passes, points: _Points, partners: Partners, i: int, r: int, offset: Floats, step: int
) -> int:
    """Return the nearest point of its class that no other track of the pass has, `NOTHING` without one."""
    best, reach2 = NOTHING, (3 * passes.spread_m[i]) ** 2
    for at in range(partners.start[r], partners.start[r + 1]):
        k = partners.point[at]
        if partners.is_same[at] and points.taken_in[k] != step:
            de = passes.xy_m[i, 0] - offset[0] - points.total[k, 0] / points.n_tracks[k]
            dn = passes.xy_m[i, 1] - offset[1] - points.total[k, 1] / points.n_tracks[k]
            if de * de + dn * dn < reach2:
                best, reach2 = k, de * de + dn * dn
    return best
