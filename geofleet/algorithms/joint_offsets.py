"""The offset of a pass that brings most of its tracks onto points of a map, found among those that bring one there."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

NONE = -1
SIGN_DENSITY_M2 = 1e-3
"""Signs a square metre near a road: what a chance partner is weighed against."""
PARTNER_CHI2 = 18.0
"""A partner further away than this lends no weight."""
FEW_OFFSETS = 256
"""So many candidate offsets are all weighed; of more, those that most tracks vote for."""
VOTED_OFFSETS = 32
VOTE_CELL_M = 0.5
ENOUGH_ROWS = 200
"""So many tracks, evenly along the pass, tell offsets apart; all of them say where exactly the one chosen lies."""


class Partners(NamedTuple):
    """Points within reach of each track of a pass, as CSR."""

    start: Ints  # (n_rows + 1,)
    point: Ints  # (n_pairs,)
    apart_m: Floats  # (n_pairs, 2) the offset that brings the track onto the point
    is_same: NDArray[np.bool_]  # (n_pairs,) whether they have one class
    weight: Floats  # (n_pairs,) how much the point counts as a partner
    most: Floats  # (n_pairs,) the density that the track has there at most, against `SIGN_DENSITY_M2`
    var: Floats  # (n_rows,)


@kernel
def _gain(partners: Partners, east: float, north: float, step: int) -> tuple[float, float, float]:
    """Return the log-likelihood of an offset by every so many-th track, and the offset that their partners agree on."""
    value, weight, sum_e, sum_n = 0.0, 1e-12, 0.0, 0.0
    for r in range(0, partners.var.size, step):
        var = partners.var[r]
        best, chosen = 0.0, NONE
        for at in range(partners.start[r], partners.start[r + 1]):
            if partners.most[at] > best:
                chi2 = ((partners.apart_m[at, 0] - east) ** 2 + (partners.apart_m[at, 1] - north) ** 2) / var
                if chi2 < PARTNER_CHI2:
                    density = np.exp(-chi2 / 2) / (2 * np.pi * var * SIGN_DENSITY_M2) * partners.weight[at]
                    if density > best:
                        best, chosen = density, at
        if chosen != NONE:
            value += np.log1p(best)
            share = best / (1 + best) / var
            weight += share
            sum_e += share * partners.apart_m[chosen, 0]
            sum_n += share * partners.apart_m[chosen, 1]
    return value, sum_e / weight, sum_n / weight


@kernel
def best_offset(partners: Partners, sigma2: float, offset: Floats) -> tuple[float, float]:
    """Return the likeliest offset, among those that bring a track onto a point of its class and the present one."""
    best, found_e, found_n = -np.inf, offset[0], offset[1]
    candidates = _candidates(partners, offset)
    _put_likeliest_first(partners)
    step = 1 + partners.var.size // ENOUGH_ROWS
    for at in range(len(candidates)):
        east, north = candidates[at]
        for _ in range(2):  # as it stands, and where its partners pull it
            value, pulled_e, pulled_n = _gain(partners, east, north, step)
            value -= (east * east + north * north) / (2 * sigma2)
            if value > best:
                best, found_e, found_n = value, east, north
            east, north = pulled_e, pulled_n
    if step > 1:
        _, found_e, found_n = _gain(partners, found_e, found_n, 1)
    return found_e, found_n


@kernel
def _put_likeliest_first(partners: Partners) -> None:
    """Put the partner of each track that counts most first: few of the others can then be better."""
    for r in range(partners.var.size):
        begin = partners.start[r]
        first = begin
        for at in range(begin, partners.start[r + 1]):
            if partners.most[at] > partners.most[first]:
                first = at
        if first > begin:
            for values in (partners.weight, partners.most):
                values[begin], values[first] = values[first], values[begin]
            for axis in range(2):
                apart = partners.apart_m[first, axis]
                partners.apart_m[first, axis] = partners.apart_m[begin, axis]
                partners.apart_m[begin, axis] = apart
            partners.point[begin], partners.point[first] = partners.point[first], partners.point[begin]
            partners.is_same[begin], partners.is_same[first] = partners.is_same[first], partners.is_same[begin]


@kernel
def _candidates(partners: Partners, offset: Floats) -> Floats:
    """Return the present offset, and those that bring a track onto a point of its class, (n, 2).

    Of many, one each of the cells of offsets that most tracks vote for: a long pass costs no more than its tracks.
    """
    found = np.empty((partners.point.size + 1, 2))
    found[0, 0], found[0, 1] = offset[0], offset[1]
    n = 1
    for at in range(partners.point.size):
        if partners.is_same[at]:
            found[n, 0], found[n, 1] = partners.apart_m[at, 0], partners.apart_m[at, 1]
            n += 1
    return found[:n] if n <= FEW_OFFSETS else _voted(found[:n])


@kernel
def _voted(offsets: Floats) -> Floats:
    """Return the first offset, and the first one of each of the cells with most of the others in and beside it."""
    n = len(offsets)
    column, n_columns = _cells(offsets[:, 0])
    row, n_rows = _cells(offsets[:, 1])
    votes = np.zeros((n_columns, n_rows), np.int64)
    for at in range(1, n):  # a cell and those around it, so that no border parts those who agree
        for beside in range(column[at] - 1, column[at] + 2):
            for below in range(row[at] - 1, row[at] + 2):
                votes[beside, below] += 1
    chosen, n_chosen = np.empty((VOTED_OFFSETS + 1, 2)), 0
    pick = 0
    while pick >= 0:
        chosen[n_chosen] = offsets[pick]
        n_chosen += 1
        if pick > 0:
            votes[column[pick], row[pick]] = 0  # its other offsets are as good as this one
        pick, most = NONE, 0
        for at in range(1, n):
            if n_chosen <= VOTED_OFFSETS and votes[column[at], row[at]] > most:
                pick, most = at, votes[column[at], row[at]]
    return chosen[:n_chosen]


@kernel
def _cells(values: Floats) -> tuple[Ints, int]:
    """Return the cell of each value along one axis, none of them at the rim, and the number of cells."""
    low, cell, n = np.inf, np.empty(values.size, np.int64), 0
    for at in range(values.size):
        low = min(low, values[at] - 2 * VOTE_CELL_M)
    for at in range(values.size):
        cell[at] = int((values[at] - low) / VOTE_CELL_M)
        n = max(n, cell[at] + 3)
    return cell, n
