"""Which tracks are one sign: pass by pass, one-to-one, each pass weighed against the map of all others.

A sign is the sum of its tracks: Λ = Σ W and η = Σ W z of their places, and the log-likelihood of every class. A sweep
takes each pass out of the map, assigns its tracks anew and puts it back. A track joins a sign at the cost

    ½ m² + ½ log |2πS| - log Σ_k π_k M[k, c] - log (n + 1) / (n̄ + 1)

with S the covariance of their difference, c the class read, n the tracks that the sign has and n̄ the passes around that
report it not: a sign that every pass reports would be missed by this one, and a chance neighbour of it would not. Or it
begins a new one at -log(λ / n_classes). Two tracks of a pass that share a frame are two signs; tracks that never
share one may be one. Assignment is exact within every pass (`assignment`), and coordinate descent over the passes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.assignment import _assign, _Graph  # the compiled core: one call a pass
from geofleet.algorithms.compiled import kernel
from geofleet.algorithms.joint_grid import Grid, file_thing, grid_around, longer, things_around, unfile_thing

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

NO_SIGN = -1
GATE_CHI2 = 25.0
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
    n_around: Ints  # (n,) passes that report anything around the track; 0 where that tells nothing


class Signs(NamedTuple):
    """The map so far; a sign without tracks is free to be used again."""

    information: Floats  # (room, 3): ee, nn, en
    vector: Floats  # (room, 2), about `Places` as they are
    log_class: Floats  # (room, n_classes) log-likelihood of its tracks under every class
    n_tracks: Ints  # (room,)
    place: Floats  # (room, 5): east, north and covariance (ee, nn, en) that follow from these


def sweep(places: Places, sign: Ints, log_confusion: Floats, log_prior: Floats, *, birth_cost: float) -> Ints:
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
    (n,) sign of each track, numbered from 0 by their first track.
    """
    room = max(len(sign), int(sign.max(initial=-1)) + 1) + 1
    grid = grid_around(places.xy_m, REACH_M, room)
    signs = _no_signs(room, len(log_prior))
    found: Ints = _sweep(places, sign.copy(), signs, log_confusion, log_prior, birth_cost, grid)
    numbered = np.unique(found, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(numbered[1], kind="stable"), kind="stable")
    renumbered: Ints = rank[numbered[2]].astype(np.int64)
    return renumbered


def leaders(sign: Ints) -> Ints:
    """Return the first track of each track's sign: a name that does not depend on numbering."""
    lead = np.arange(len(sign))
    known = sign >= 0
    _, first, inverse = np.unique(sign[known], return_index=True, return_inverse=True)
    lead[known] = np.flatnonzero(known)[first][inverse]
    return lead


def _no_signs(room: int, n_classes: int) -> Signs:
    """Return room for signs; of an array of zeros only what is written to takes memory."""
    return Signs(
        np.zeros((room, 3)),
        np.zeros((room, 2)),
        np.zeros((room, n_classes)),
        np.zeros(room, np.int64),
        np.zeros((room, 5)),
    )


class _Free(NamedTuple):
    """Signs without tracks, as a stack."""

    stack: Ints
    size: Ints  # (1,)


@kernel
def _sweep(  # noqa: PLR0917 - numba takes no keyword-only arguments
    places: Places, sign: Ints, signs: Signs, log_confusion: Floats, log_prior: Floats, birth_cost: float, grid: Grid
) -> Ints:
    free = _start(places, sign, signs, log_confusion, grid)
    local = np.full(signs.n_tracks.size, -1)
    for v in range(places.first.size - 1):
        a, b = places.first[v], places.first[v + 1]
        for i in range(a, b):
            if sign[i] != NO_SIGN:
                _add(signs, places, log_confusion, i, sign[i], -1)
        given = _assign_pass(places, signs, grid, local, a, b, log_confusion, log_prior, birth_cost)
        _give_up(signs, grid, free, sign[a:b])
        for i in range(a, b):
            k = given[i - a]
            if k == NO_SIGN:
                free.size[0] -= 1
                k = free.stack[free.size[0]]
                signs.information[k], signs.vector[k], signs.log_class[k] = 0.0, 0.0, 0.0
            sign[i] = k
            _add(signs, places, log_confusion, i, k, 1)
            if grid.cell[k] < 0:  # filed once: its tracks move it by less than what the cells around reach beyond them
                file_thing(grid, k, signs.place[k, 0], signs.place[k, 1])
    return sign


@kernel
def _start(places: Places, sign: Ints, signs: Signs, log_confusion: Floats, grid: Grid) -> _Free:
    """File the signs of the tracks that have one, and return the signs that are free."""
    for i in range(len(sign)):
        if sign[i] != NO_SIGN:
            _add(signs, places, log_confusion, i, sign[i], 1)
    room = signs.n_tracks.size
    free = _Free(np.empty(room, np.int64), np.zeros(1, np.int64))
    for k in range(room - 1, -1, -1):
        if signs.n_tracks[k] == 0:
            free.stack[free.size[0]] = k
            free.size[0] += 1
        else:
            file_thing(grid, k, signs.place[k, 0], signs.place[k, 1])
    return free


@kernel
def _give_up(signs: Signs, grid: Grid, free: _Free, before: Ints) -> None:
    """Free the signs that a pass was the only witness of."""
    for k in before:
        if k != NO_SIGN and signs.n_tracks[k] == 0 and grid.cell[k] >= 0:
            unfile_thing(grid, k)
            free.stack[free.size[0]] = k
            free.size[0] += 1


@kernel
def _add(signs: Signs, places: Places, log_confusion: Floats, i: int, k: int, times: int) -> None:  # noqa: PLR0917 - numba takes no keyword-only arguments
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
    signs.n_tracks[k] += times
    if signs.n_tracks[k] > 0:
        a, b, c = signs.information[k]
        det = a * b - c * c
        e, n = signs.vector[k]
        signs.place[k, 0], signs.place[k, 1] = (b * e - c * n) / det, (a * n - c * e) / det
        signs.place[k, 2], signs.place[k, 3], signs.place[k, 4] = b / det, a / det, -c / det


@kernel
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


class _Pairs(NamedTuple):
    """Tracks of a pass and the signs that each may join, as CSR; columns are places in `known`."""

    start: Ints
    column: Ints
    cost: Floats
    known: Ints


@kernel
def _assign_pass(  # noqa: PLR0917 - numba takes no keyword-only arguments
    places: Places,
    signs: Signs,
    grid: Grid,
    local: Ints,
    a: int,
    b: int,
    log_confusion: Floats,
    log_prior: Floats,
    birth_cost: float,
) -> Ints:
    """Return the sign of each track of a pass (rows a to b), `NO_SIGN` for a new one; `local` is -1 all over."""
    start = np.zeros(b - a + 1, np.int64)
    column, known, cost = np.empty(64, np.int64), np.empty(64, np.int64), np.empty(64)
    around, n_pairs, n_known = np.empty(64, np.int64), 0, 0
    for i in range(a, b):
        around, n_around = things_around(grid, places.xy_m[i, 0], places.xy_m[i, 1], around)
        for at in range(n_around):
            k = around[at]
            value = _cost(places, signs, i, k, log_confusion, log_prior, birth_cost)
            if value < birth_cost:
                if n_pairs == column.size:
                    column, known, cost = longer(column), longer(known), np.concatenate((cost, cost))
                if local[k] < 0:
                    local[k], known[n_known] = n_known, k
                    n_known += 1
                column[n_pairs], cost[n_pairs] = local[k], value
                n_pairs += 1
        start[i - a + 1] = n_pairs
    graph = _Graph(start, column[:n_pairs], cost[:n_pairs], np.full(b - a, birth_cost))
    given = _assign(graph, n_known)
    _adopt_fragments(given, _Pairs(start, column, cost, known), places, a, birth_cost)
    for r in range(b - a):
        given[r] = known[given[r]] if given[r] >= 0 else NO_SIGN
    local[known[:n_known]] = -1
    return given


@kernel
def _cost(  # noqa: PLR0917 - numba takes no keyword-only arguments
    places: Places, signs: Signs, i: int, k: int, log_confusion: Floats, log_prior: Floats, most: float
) -> float:
    """Return what it costs a track to join a sign, infinite where that is `most` or more whatever it is read as."""
    if signs.n_tracks[k] == 0:
        return np.inf
    east, north, ee, nn, en = signs.place[k]
    de, dn = places.xy_m[i, 0] - east, places.xy_m[i, 1] - north
    if de * de + dn * dn > REACH_M**2:
        return np.inf
    ee, nn, en = ee + places.cov_m2[i, 0], nn + places.cov_m2[i, 1], en + places.cov_m2[i, 2]
    det = ee * nn - en * en
    chi2 = (nn * de * de - 2 * en * de * dn + ee * dn * dn) / det
    if chi2 > GATE_CHI2:
        return np.inf
    spatial = 0.5 * chi2 + np.log(2 * np.pi) + 0.5 * np.log(det)
    usual = _usual(places.n_around[i], signs.n_tracks[k])
    if spatial - usual >= most:
        return np.inf
    read = log_confusion[places.kind_code[i], :, places.class_code[i]]
    return float(spatial + class_cost(signs.log_class[k], log_prior, read) - usual)


@kernel
def _usual(n_around: int, n_tracks: int) -> float:
    """Return the log-odds that a pass around reports a sign of so many tracks: Laplace's rule, of the other passes."""
    if n_around == 0:
        return 0.0
    return float(np.log((n_tracks + 1) / (max(n_around - 1 - n_tracks, 0) + 1)))


@kernel
def _adopt_fragments(given: Ints, pairs: _Pairs, places: Places, a: int, birth_cost: float) -> None:
    """Let tracks that stayed out join a sign whose tracks of this pass share no frame with them, the cheapest first."""
    for r in range(given.size):
        if given[r] >= 0 or places.frame_first[a + r] < 0:
            continue
        best, best_cost = NO_SIGN, birth_cost
        for pair in range(pairs.start[r], pairs.start[r + 1]):
            if pairs.cost[pair] < best_cost and _never_with(given, pairs.column[pair], places, a, r):
                best, best_cost = pairs.column[pair], pairs.cost[pair]
        given[r] = best


@kernel
def _never_with(given: Ints, column: int, places: Places, a: int, r: int) -> bool:
    """Return whether row r shares no frame with any row of the pass that has this sign."""
    for other in range(given.size):  # noqa: SIM110 - numba compiles no generator
        if given[other] == column and overlap(places, a + r, a + other):
            return False
    return True


@kernel
def overlap(places: Places, i: int, j: int) -> bool:
    """Return whether two tracks of a pass may share a frame; where frames are not told, they may."""
    first, last = places.frame_first, places.frame_last
    return bool(first[i] < 0 or first[j] < 0 or (first[i] <= last[j] and first[j] <= last[i]))
