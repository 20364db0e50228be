"""Where each pass lies against the others: a vote over pairs of equal class, one pass after the other.

Signs repeat along a road, so a nearest-neighbour start can lock on shifted by one sign. Here every pass is laid on the
map that the passes before it made at each offset that brings one of its tracks onto a sign of its class, and takes the
most likely: with the GNSS prior and robust to tracks without a partner. Then each pass is taken out and laid again on
the map of all others, until nothing moves.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

CORE_M = 0.5
"""Passes laid on each other fit to this, an axis, beside what their tracks declare."""
REACH_SIGMAS = 4.0
SIGN_DENSITY_M2 = 1e-3
"""Signs a square metre near a road: what a chance partner is weighed against."""
OTHER_CLASS = 0.01
"""A partner of another class counts this much: a misread class still holds the pass in place."""
PARTNER_CHI2 = 18.0
"""A partner further away than this lends no weight."""
FEW_OFFSETS = 256
"""So many candidate offsets are all weighed; of more, those that most rows vote for."""
VOTED_OFFSETS = 32
VOTE_CELL_M = 0.5
ENOUGH_ROWS = 200
"""So many rows, evenly along the pass, tell offsets apart; all of them say where exactly the one chosen lies."""
N_ROUNDS = 3
MOVED_M = 0.25
NO_POINT = -1


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
    offset: Floats = _align(
        np.ascontiguousarray(xy_m),
        np.sqrt(var_m2 + CORE_M**2),
        class_code,
        first,
        sigma_m,
        _order(xy_m, first, sigma_m, cell_m),
    )
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


@njit(cache=True, nogil=True)
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


@njit(cache=True, nogil=True)
def _align(xy_m: Floats, spread_m: Floats, class_code: Ints, first: Ints, sigma_m: Floats, order: Ints) -> Floats:  # noqa: PLR0917
    n, n_passes = len(xy_m), first.size - 1
    offset = np.zeros((n_passes, 2))
    point_of = np.full(n, NO_POINT)
    room = n * (N_ROUNDS + 2)  # a round makes n new points at most
    total, count, of_class = np.zeros((room, 2)), np.zeros(room, np.int64), np.zeros(room, np.int64)
    n_points, base_var = 0, sigma_m[order[0]] ** 2
    for turn in range(1 + N_ROUNDS):
        n_moved = 0
        for step in range(n_passes):
            v = order[step]
            rows = np.arange(first[v], first[v + 1])
            for i in rows:
                if point_of[i] != NO_POINT:
                    count[point_of[i]] -= 1
                    total[point_of[i]] -= xy_m[i] - offset[v]
            near, near_start = _near(
                xy_m, rows, total, count, n_points, REACH_SIGMAS * np.sqrt(sigma_m[v] ** 2 + base_var)
            )
            sigma2 = sigma_m[v] ** 2 + base_var
            found = _best(xy_m, spread_m, class_code, rows, total, count, of_class, near, near_start, sigma2, offset[v])
            if step == 0 and turn == 0:
                found = (0.0, 0.0)
            if (found[0] - offset[v, 0]) ** 2 + (found[1] - offset[v, 1]) ** 2 > MOVED_M**2:
                n_moved += 1
            offset[v, 0], offset[v, 1] = found
            n_points = _lay(
                xy_m,
                spread_m,
                class_code,
                rows,
                offset[v],
                total,
                count,
                of_class,
                near,
                near_start,
                point_of,
                n_points,
            )
        if turn and n_moved == 0:
            break
    return offset


@njit(cache=True, nogil=True)
def _near(xy_m: Floats, rows: Ints, total: Floats, count: Ints, n_points: int, reach_m: float) -> tuple[Ints, Ints]:  # noqa: PLR0917
    """Return the points of the map within reach of each row, as CSR."""
    low_e, low_n = xy_m[rows, 0].min() - reach_m, xy_m[rows, 1].min() - reach_m
    high_e, high_n = xy_m[rows, 0].max() + reach_m, xy_m[rows, 1].max() + reach_m
    inside = np.empty(n_points, np.int64)
    n_inside = 0
    for k in range(n_points):
        if count[k] > 0:
            east, north = total[k, 0] / count[k], total[k, 1] / count[k]
            if low_e <= east <= high_e and low_n <= north <= high_n:
                inside[n_inside] = k
                n_inside += 1
    inside = inside[:n_inside]
    east_of = np.array([total[k, 0] / count[k] for k in inside])
    by_east = np.argsort(east_of, kind="mergesort")
    inside, east_of = inside[by_east], east_of[by_east]
    begin = np.searchsorted(east_of, xy_m[rows, 0] - reach_m)
    start = np.zeros(rows.size + 1, np.int64)
    near = np.empty(rows.size * 8 + 8, np.int64)
    n_near = 0
    for r in range(rows.size):
        for at in range(begin[r], n_inside):
            east = east_of[at] - xy_m[rows[r], 0]
            if east > reach_m:
                break
            north = total[inside[at], 1] / count[inside[at]] - xy_m[rows[r], 1]
            if east * east + north * north < reach_m * reach_m:
                if n_near == near.size:
                    grown = np.empty(2 * near.size, np.int64)
                    grown[:n_near] = near
                    near = grown
                near[n_near] = inside[at]
                n_near += 1
        start[r + 1] = n_near
    return near[:n_near], start


@njit(cache=True, nogil=True)
def _around(class_code: Ints, rows: Ints, count: Ints, of_class: Ints, near: Ints, near_start: Ints) -> Ints:  # noqa: PLR0917
    """Return how many tracks of its class lie around each row.

    A point that has most of them is the likelier partner: of two copies of one map, which half of the passes made each,
    the larger one grows, where both would last if all points were alike.
    """
    around = np.zeros(rows.size, np.int64)
    for r in range(rows.size):
        for k in near[near_start[r] : near_start[r + 1]]:
            if of_class[k] == class_code[rows[r]]:
                around[r] += count[k]
    return around


@njit(cache=True, nogil=True)
def _gain(  # noqa: PLR0917
    east: float,
    north: float,
    xy_m: Floats,
    spread_m: Floats,
    class_code: Ints,
    rows: Ints,
    total: Floats,
    count: Ints,
    of_class: Ints,
    near: Ints,
    near_start: Ints,
    around: Ints,
    step: int,
) -> tuple[float, float, float]:
    """Return the log-likelihood of an offset by every so many-th row, and the offset that their partners agree on."""
    value, weight, sum_e, sum_n = 0.0, 1e-12, 0.0, 0.0
    for r in range(0, rows.size, step):
        i = rows[r]
        var = spread_m[i] ** 2
        best, best_e, best_n = 0.0, 0.0, 0.0
        for at in range(near_start[r], near_start[r + 1]):
            k = near[at]
            de = xy_m[i, 0] - total[k, 0] / count[k]
            dn = xy_m[i, 1] - total[k, 1] / count[k]
            chi2 = ((de - east) ** 2 + (dn - north) ** 2) / var
            if chi2 < PARTNER_CHI2:
                density = np.exp(-chi2 / 2) / (2 * np.pi * var * SIGN_DENSITY_M2)
                if of_class[k] == class_code[i]:
                    density *= (count[k] + 1) / (around[r] - count[k] + 1)
                else:
                    density *= OTHER_CLASS
                if density > best:
                    best, best_e, best_n = density, de, dn
        value += np.log1p(best)
        share = best / (1 + best) / var
        weight += share
        sum_e += share * best_e
        sum_n += share * best_n
    return value, sum_e / weight, sum_n / weight


@njit(cache=True, nogil=True)
def _best(  # noqa: PLR0917
    xy_m: Floats,
    spread_m: Floats,
    class_code: Ints,
    rows: Ints,
    total: Floats,
    count: Ints,
    of_class: Ints,
    near: Ints,
    near_start: Ints,
    sigma2: float,
    offset: Floats,
) -> tuple[float, float]:
    """Return the likeliest offset, among those that bring a row onto a point of its class and the present one."""
    best, found_e, found_n = -np.inf, offset[0], offset[1]
    candidates = _candidates(xy_m, class_code, rows, total, count, of_class, near, near_start, offset)
    around = _around(class_code, rows, count, of_class, near, near_start)
    step = 1 + rows.size // ENOUGH_ROWS
    for at in range(len(candidates)):
        east, north = candidates[at]
        for _ in range(2):  # as it stands, and where its partners pull it
            value, pulled_e, pulled_n = _gain(
                east, north, xy_m, spread_m, class_code, rows, total, count, of_class, near, near_start, around, step
            )
            value -= (east * east + north * north) / (2 * sigma2)
            if value > best:
                best, found_e, found_n = value, east, north
            east, north = pulled_e, pulled_n
    if step > 1:
        _, found_e, found_n = _gain(
            found_e, found_n, xy_m, spread_m, class_code, rows, total, count, of_class, near, near_start, around, 1
        )
    return found_e, found_n


@njit(cache=True, nogil=True)
def _candidates(  # noqa: PLR0917
    xy_m: Floats,
    class_code: Ints,
    rows: Ints,
    total: Floats,
    count: Ints,
    of_class: Ints,
    near: Ints,
    near_start: Ints,
    offset: Floats,
) -> Floats:
    """Return the present offset, and those that bring a row onto a point of its class, (n, 2).

    Of many, one each of the cells of offsets that most rows vote for: a long pass costs no more than its rows.
    """
    found = np.empty((near.size + 1, 2))
    found[0] = offset
    n = 1
    for r in range(rows.size):
        for at in range(near_start[r], near_start[r + 1]):
            k, i = near[at], rows[r]
            if of_class[k] == class_code[i]:
                found[n, 0] = xy_m[i, 0] - total[k, 0] / count[k]
                found[n, 1] = xy_m[i, 1] - total[k, 1] / count[k]
                n += 1
    found = found[:n]
    if n <= FEW_OFFSETS:
        return found
    low_e, low_n = found[:, 0].min() - 2 * VOTE_CELL_M, found[:, 1].min() - 2 * VOTE_CELL_M
    column = ((found[:, 0] - low_e) / VOTE_CELL_M).astype(np.int64)
    row = ((found[:, 1] - low_n) / VOTE_CELL_M).astype(np.int64)
    votes = np.zeros((row.max() + 3, column.max() + 3), np.int64)
    for at in range(1, n):  # a cell and those around it, so that no border parts those who agree
        votes[row[at] - 1 : row[at] + 2, column[at] - 1 : column[at] + 2] += 1
    kept = [0]
    for at in np.argsort(np.array([-votes[row[at], column[at]] for at in range(n)]), kind="mergesort"):
        if votes[row[at], column[at]] > 0 and at > 0:
            kept.append(at)
            votes[row[at], column[at]] = 0  # its other offsets are as good as this one
        if len(kept) > VOTED_OFFSETS:
            break
    chosen: Floats = found[np.array(kept)]
    return chosen


@njit(cache=True, nogil=True)
def _lay(  # noqa: PLR0917
    xy_m: Floats,
    spread_m: Floats,
    class_code: Ints,
    rows: Ints,
    offset: Floats,
    total: Floats,
    count: Ints,
    of_class: Ints,
    near: Ints,
    near_start: Ints,
    point_of: Ints,
    n_points: int,
) -> int:
    """Add the rows of a pass to the map: to the nearest free point of their class, or as new points."""
    is_taken = np.zeros(n_points + rows.size, np.bool_)  # a point that a row of this pass has is not free
    for r in range(rows.size):
        i = rows[r]
        best, reach2 = NO_POINT, (3 * spread_m[i]) ** 2
        for at in range(near_start[r], near_start[r + 1]):
            k = near[at]
            if of_class[k] == class_code[i] and not is_taken[k]:
                de = xy_m[i, 0] - offset[0] - total[k, 0] / count[k]
                dn = xy_m[i, 1] - offset[1] - total[k, 1] / count[k]
                if de * de + dn * dn < reach2:
                    best, reach2 = k, de * de + dn * dn
        if best == NO_POINT:
            if point_of[i] != NO_POINT and count[point_of[i]] == 0:
                best = point_of[i]
            else:
                best, n_points = n_points, n_points + 1
            total[best] = 0.0
            of_class[best] = class_code[i]
        is_taken[best] = True
        point_of[i] = best
        total[best] += xy_m[i] - offset
        count[best] += 1
    return n_points
