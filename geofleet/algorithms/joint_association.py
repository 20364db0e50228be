"""Which tracks are one sign: pass by pass, one-to-one, each pass weighed against the map of all others.

A sign is the sum of its tracks: Λ = Σ W and η = Σ W z of their places, and the log-likelihood of every class. A sweep
takes each pass out of the map, assigns its tracks anew and puts it back. A track joins a sign at the cost

    ½ m² + ½ log |2πS| - log Σ_k π_k M[k, c]        with S the covariance of their difference, c the class read

or begins a new one at -log(λ / n_classes). Two tracks of a pass that share a frame are two signs; tracks that never
share one may be one. Assignment is exact within every pass (`assignment`), and coordinate descent over the passes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from geofleet.algorithms.assignment import _assign, _Graph

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

NO_SIGN = -1
GATE_CHI2 = 25.0
MISSED_NATS = 1.0
"""Evidence of each pass that reports the rarer of two places and not the other that they are one: passes miss little."""
REACH_M = 15.0
"""A track further than this from a sign is never weighed against it, however little it knows."""


class Places(NamedTuple):
    """Tracks as the sweeps see them, by pass: offset and bias of the pass taken out."""

    xy_m: Floats  # (n, 2)
    cov_m2: Floats  # (n, 3): ee, nn, en; what is not known of offset and bias of the pass is in it
    class_code: Ints  # (n,)
    kind_code: Ints  # (n,) kind of sensor
    frame_first: Ints
    frame_last: Ints
    first: Ints  # (n_passes + 1,)


class Signs(NamedTuple):
    """The map so far; a sign without tracks is free to be used again."""

    information: Floats  # (room, 3): ee, nn, en
    vector: Floats  # (room, 2), about `Places` as they are
    log_class: Floats  # (room, n_classes) log-likelihood of its tracks under every class
    count: Ints  # (room,) tracks
    cell: Ints  # (room,) where it is filed, -1 for nowhere
    following: Ints  # (room,) the next sign in its cell, -1 at the end


class _Grid(NamedTuple):
    """Signs filed by cells that some track lies in."""

    keys: Ints  # sorted
    head: Ints  # first sign of each cell
    low: Floats
    width: int


def sweep(
    places: Places, sign: Ints, log_confusion: Floats, log_prior: Floats, *, birth_cost: float
) -> tuple[Ints, int]:
    """Assign every pass anew against all others.

    Parameters
    ----------
    places
        Tracks, by pass.
    sign
        (n,) sign of each track so far, `NO_SIGN` for none yet.
    log_confusion
        (n_kinds, n_classes, n_classes) log M[k, c]: log-probability that a sign of class k is read as c.
    log_prior
        (n_classes,) log-probability of a class before anything is read.
    birth_cost
        Of a track that begins a sign, in nats: -log of new signs a square metre and class.

    Returns
    -------
    (n,) sign of each track, numbered from 0 by their first track, and how many tracks changed.
    """
    grid = _grid(places.xy_m)
    found: Ints = _sweep(places, sign.copy(), log_confusion, log_prior, birth_cost, grid)
    numbered = np.unique(found, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(numbered[1], kind="stable"), kind="stable")
    signs: Ints = rank[numbered[2]].astype(np.int64)
    before, after = _leaders(sign), _leaders(signs)
    return signs, int(np.count_nonzero(before != after))


def _leaders(sign: Ints) -> Ints:
    """Return the first track of each track's sign: a name that does not depend on numbering."""
    lead = np.arange(len(sign))
    known = sign >= 0
    _, first, inverse = np.unique(sign[known], return_index=True, return_inverse=True)
    lead[known] = np.flatnonzero(known)[first][inverse]
    return lead


def _grid(xy_m: Floats) -> _Grid:
    low = xy_m.min(axis=0) - 2 * REACH_M
    cell = np.floor((xy_m - low) / REACH_M).astype(np.int64)
    width = int(cell[:, 0].max()) + 3
    keys = np.unique(cell[:, 1] * width + cell[:, 0])
    return _Grid(keys, np.full(len(keys), NO_SIGN), low, width)


@njit(cache=True, nogil=True)
def _sweep(
    places: Places, sign: Ints, log_confusion: Floats, log_prior: Floats, birth_cost: float, grid: _Grid
) -> Ints:
    n, n_classes = len(sign), log_prior.size
    room = max(n, sign.max() + 1) + 1
    signs = Signs(
        np.zeros((room, 3)),
        np.zeros((room, 2)),
        np.zeros((room, n_classes)),
        np.zeros(room, np.int64),
        np.full(room, -1),
        np.full(room, NO_SIGN),
    )
    for i in range(n):
        if sign[i] != NO_SIGN:
            _add(signs, places, log_confusion, i, sign[i], 1)
    free = np.empty(room, np.int64)
    n_free = 0
    for k in range(room - 1, -1, -1):
        if signs.count[k] == 0:
            free[n_free] = k
            n_free += 1
        else:
            _file(signs, grid, k)
    local = np.full(room, -1)
    for v in range(places.first.size - 1):
        a, b = places.first[v], places.first[v + 1]
        for i in range(a, b):
            if sign[i] != NO_SIGN:
                _add(signs, places, log_confusion, i, sign[i], -1)
        given = _assign_pass(places, signs, grid, local, a, b, log_confusion, log_prior, birth_cost)
        for i in range(a, b):
            old = sign[i]
            if old != NO_SIGN and signs.count[old] == 0 and signs.cell[old] >= 0:
                _unfile(signs, grid, old)
                free[n_free] = old
                n_free += 1
        for i in range(a, b):
            k = given[i - a]
            if k == NO_SIGN:
                n_free -= 1
                k = free[n_free]
                signs.information[k], signs.vector[k], signs.log_class[k] = 0.0, 0.0, 0.0
            sign[i] = k
            _add(signs, places, log_confusion, i, k, 1)
            if signs.cell[k] < 0:
                _file(signs, grid, k)
    return sign


@njit(cache=True, nogil=True)
def _add(signs: Signs, places: Places, log_confusion: Floats, i: int, k: int, times: int) -> None:  # noqa: PLR0917
    """Add a track to a sign, or take it out again."""
    ee, nn, en = places.cov_m2[i]
    det = ee * nn - en * en
    wee, wnn, wen = nn / det, ee / det, -en / det
    signs.information[k, 0] += times * wee
    signs.information[k, 1] += times * wnn
    signs.information[k, 2] += times * wen
    signs.vector[k, 0] += times * (wee * places.xy_m[i, 0] + wen * places.xy_m[i, 1])
    signs.vector[k, 1] += times * (wen * places.xy_m[i, 0] + wnn * places.xy_m[i, 1])
    signs.log_class[k] += times * log_confusion[places.kind_code[i], :, places.class_code[i]]
    signs.count[k] += times


@njit(cache=True, nogil=True)
def _place(signs: Signs, k: int) -> tuple[float, float, float, float, float]:
    """Return east, north and the covariance (ee, nn, en) of a sign."""
    a, b, c = signs.information[k]
    det = a * b - c * c
    e, n = signs.vector[k]
    return (b * e - c * n) / det, (a * n - c * e) / det, b / det, a / det, -c / det


@njit(cache=True, nogil=True)
def _cell_of(grid: _Grid, east: float, north: float) -> int:
    column = int(np.floor((east - grid.low[0]) / REACH_M))
    row = int(np.floor((north - grid.low[1]) / REACH_M))
    key = row * grid.width + column
    at = np.searchsorted(grid.keys, key)
    return at if at < grid.keys.size and grid.keys[at] == key else -1


@njit(cache=True, nogil=True)
def _file(signs: Signs, grid: _Grid, k: int) -> None:
    """File a sign under the cell of its place; in a cell where no track lies, under the nearest file there is."""
    east, north, _, _, _ = _place(signs, k)
    column = int(np.floor((east - grid.low[0]) / REACH_M))
    row = int(np.floor((north - grid.low[1]) / REACH_M))
    at = min(np.searchsorted(grid.keys, row * grid.width + column), grid.keys.size - 1)
    signs.cell[k] = at
    signs.following[k] = grid.head[at]
    grid.head[at] = k


@njit(cache=True, nogil=True)
def _unfile(signs: Signs, grid: _Grid, k: int) -> None:
    at = signs.cell[k]
    signs.cell[k] = -1
    if grid.head[at] == k:
        grid.head[at] = signs.following[k]
        return
    other = grid.head[at]
    while signs.following[other] != k:
        other = signs.following[other]
    signs.following[other] = signs.following[k]


@njit(cache=True, nogil=True)
def class_cost(log_class: Floats, log_prior: Floats, log_read: Floats) -> float:
    """Return -log Σ_k π_k M[k, c] with π ∝ exp(log_class + log_prior)."""
    top, top_both = -np.inf, -np.inf
    for k in range(log_prior.size):
        value = log_class[k] + log_prior[k]
        top = max(top, value)
        top_both = max(top_both, value + log_read[k])
    alone, both = 0.0, 0.0
    for k in range(log_prior.size):
        value = log_class[k] + log_prior[k]
        alone += np.exp(value - top)
        both += np.exp(value + log_read[k] - top_both)
    return float(np.log(alone) + top - np.log(both) - top_both)


@njit(cache=True, nogil=True)
def _assign_pass(  # noqa: PLR0917
    places: Places,
    signs: Signs,
    grid: _Grid,
    local: Ints,
    a: int,
    b: int,
    log_confusion: Floats,
    log_prior: Floats,
    birth_cost: float,
) -> Ints:
    """Return the sign of each track of a pass (rows a to b), `NO_SIGN` for a new one."""
    start = np.zeros(b - a + 1, np.int64)
    column = np.empty(16 * (b - a) + 16, np.int64)
    cost = np.empty(column.size)
    known = np.empty(column.size, np.int64)
    n_pairs, n_known = 0, 0
    for i in range(a, b):
        for d_row in range(-1, 2):
            for d_column in range(-1, 2):
                at = _cell_of(grid, places.xy_m[i, 0] + d_column * REACH_M, places.xy_m[i, 1] + d_row * REACH_M)
                k = grid.head[at] if at >= 0 else NO_SIGN
                while k != NO_SIGN:
                    if signs.count[k] > 0:
                        value = _cost(places, signs, i, k, log_confusion, log_prior)
                        if value < birth_cost:
                            if n_pairs == column.size:
                                column, cost = _twice(column), _twice(cost)
                                known = _twice(known)
                            if local[k] < 0:
                                local[k] = n_known
                                known[n_known] = k
                                n_known += 1
                            column[n_pairs], cost[n_pairs] = local[k], value
                            n_pairs += 1
                    k = signs.following[k]
        start[i - a + 1] = n_pairs
    skip = np.full(b - a, birth_cost)
    given = _assign(_Graph(start, column[:n_pairs], cost[:n_pairs], skip), n_known)
    _adopt_fragments(given, start, column, cost, places, a, birth_cost)
    for r in range(b - a):
        given[r] = known[given[r]] if given[r] >= 0 else NO_SIGN
    for k in known[:n_known]:
        local[k] = -1
    return given


@njit(cache=True, nogil=True)
def _twice(values: NDArray) -> NDArray:
    grown = np.empty(2 * values.size, values.dtype)
    grown[: values.size] = values
    return grown


@njit(cache=True, nogil=True)
def _cost(places: Places, signs: Signs, i: int, k: int, log_confusion: Floats, log_prior: Floats) -> float:  # noqa: PLR0917
    east, north, ee, nn, en = _place(signs, k)
    de, dn = places.xy_m[i, 0] - east, places.xy_m[i, 1] - north
    if de * de + dn * dn > REACH_M**2:
        return np.inf
    ee, nn, en = ee + places.cov_m2[i, 0], nn + places.cov_m2[i, 1], en + places.cov_m2[i, 2]
    det = ee * nn - en * en
    chi2 = (nn * de * de - 2 * en * de * dn + ee * dn * dn) / det
    if chi2 > GATE_CHI2:
        return np.inf
    read = log_confusion[places.kind_code[i], :, places.class_code[i]]
    spatial = 0.5 * chi2 + np.log(2 * np.pi) + 0.5 * np.log(det)
    return spatial + class_cost(signs.log_class[k], log_prior, read)


@njit(cache=True, nogil=True)
def _adopt_fragments(
    given: Ints, start: Ints, column: Ints, cost: Floats, places: Places, a: int, birth_cost: float
) -> None:
    """Let tracks that stayed out join a sign whose tracks of this pass share no frame with them, the cheapest first."""
    for r in range(given.size):
        if given[r] >= 0 or places.frame_first[a + r] < 0:
            continue
        best, best_cost = NO_SIGN, birth_cost
        for pair in range(start[r], start[r + 1]):
            if cost[pair] < best_cost:
                is_free = True
                for other in range(given.size):
                    if given[other] == column[pair]:
                        i, j = a + r, a + other
                        is_free = is_free and (
                            places.frame_first[j] > places.frame_last[i] or places.frame_last[j] < places.frame_first[i]
                        )
                if is_free:
                    best, best_cost = column[pair], cost[pair]
        given[r] = best


def merge(places: Places, sign: Ints, log_confusion: Floats, log_prior: Floats, *, birth_cost: float) -> Ints:
    """Join signs that are likelier one than two.

    Two births cost more than one, passes report one of them only, and they agree in place and class; against it are the
    passes that hold both in one frame, of which one track would be cast out.

    Parameters and result are those of `sweep`; the cheapest pair is joined first.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415

    n_signs = int(sign.max(initial=-1)) + 1
    information, vector = np.zeros((n_signs, 3)), np.zeros((n_signs, 2))
    ee, nn, en = places.cov_m2.T
    det = ee * nn - en * en
    for at, weight in enumerate((nn / det, ee / det, -en / det)):
        information[:, at] = np.bincount(sign, weight, minlength=n_signs)
    east, north = places.xy_m.T
    vector[:, 0] = np.bincount(sign, (nn * east - en * north) / det, minlength=n_signs)
    vector[:, 1] = np.bincount(sign, (ee * north - en * east) / det, minlength=n_signs)
    log_class = np.zeros((n_signs, len(log_prior)))
    np.add.at(log_class, sign, log_confusion[places.kind_code, :, places.class_code])
    determinant = information[:, 0] * information[:, 1] - information[:, 2] ** 2
    cov = np.column_stack((information[:, 1], information[:, 0], -information[:, 2])) / determinant[:, None]
    xy = np.column_stack(
        (cov[:, 0] * vector[:, 0] + cov[:, 2] * vector[:, 1], cov[:, 2] * vector[:, 0] + cov[:, 1] * vector[:, 1])
    )
    pairs = cKDTree(xy).query_pairs(REACH_M / 2, output_type="ndarray")
    if not len(pairs):
        return sign
    one, two = pairs.T
    s = cov[one] + cov[two]
    d = xy[one] - xy[two]
    det = s[:, 0] * s[:, 1] - s[:, 2] ** 2
    chi2 = (s[:, 1] * d[:, 0] ** 2 - 2 * s[:, 2] * d[:, 0] * d[:, 1] + s[:, 0] * d[:, 1] ** 2) / det
    own = np.logaddexp.reduce(log_class + log_prior, axis=1)
    likely = chi2 < GATE_CHI2
    one, two, chi2, det = one[likely], two[likely], chi2[likely], det[likely]
    together = np.logaddexp.reduce(log_class[one] + log_class[two] + log_prior, axis=1)
    # the class share of a birth, 1 / n_classes, is in `own`
    saved = birth_cost - np.log(len(log_prior)) - (0.5 * chi2 + np.log(2 * np.pi) + 0.5 * np.log(det))
    saved -= own[one] + own[two] - together
    by_sign = np.argsort(sign, kind="stable")
    start = np.searchsorted(sign[by_sign], np.arange(n_signs + 1))
    owner = np.repeat(np.arange(len(places.first) - 1), np.diff(places.first))
    n_both, n_one = _passes_of_pairs(one, two, by_sign, start, owner, places.frame_first, places.frame_last)
    saved += MISSED_NATS * n_one - birth_cost * n_both
    worth = np.flatnonzero(saved > 0)
    order = worth[np.argsort(-saved[worth], kind="stable")]
    root = np.arange(n_signs)
    used = np.zeros(n_signs, np.bool_)
    for a, b in zip(one[order].tolist(), two[order].tolist(), strict=True):
        if not (used[a] or used[b]):
            root[b] = a
            used[a] = used[b] = True
    return np.unique(root[sign], return_inverse=True)[1].astype(np.int64)


@njit(cache=True, nogil=True)
def _passes_of_pairs(  # noqa: PLR0917
    one: Ints, two: Ints, by_sign: Ints, start: Ints, owner: Ints, first: Ints, last: Ints
) -> tuple[Ints, Ints]:
    """Count the passes that hold both signs of each pair in one frame, and those that hold only the rarer one."""
    n_both, n_one = np.zeros(one.size, np.int64), np.zeros(one.size, np.int64)
    lonely = np.zeros(2, np.int64)
    for p in range(one.size):
        at, other = start[one[p]], start[two[p]]
        lonely[:] = 0
        while at < start[one[p] + 1] or other < start[two[p] + 1]:  # tracks of a sign are sorted by pass
            a = owner[by_sign[at]] if at < start[one[p] + 1] else owner[-1] + 1
            b = owner[by_sign[other]] if other < start[two[p] + 1] else owner[-1] + 1
            v = min(a, b)
            at_end, other_end = at, other
            while at_end < start[one[p] + 1] and owner[by_sign[at_end]] == v:
                at_end += 1
            while other_end < start[two[p] + 1] and owner[by_sign[other_end]] == v:
                other_end += 1
            meet = False
            for i in by_sign[at:at_end]:
                for j in by_sign[other:other_end]:
                    meet = meet or first[i] < 0 or first[j] < 0 or (first[i] <= last[j] and first[j] <= last[i])
            n_both[p] += meet
            lonely[0] += other_end == other
            lonely[1] += at_end == at
            at, other = at_end, other_end
        n_one[p] = lonely.min()
    return n_both, n_one
