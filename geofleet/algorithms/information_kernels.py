"""Compiled loops of the information form: damped least squares for places, and the normal equations of each track."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

N_STEPS = 12
STEP_DONE_M = 1e-6
NEAREST_M = 0.1
"""On top of the camera a bearing means nothing: distances count as this at least."""


@kernel
def wrapped(angle_rad: float) -> float:
    """Return an angle between -π and π."""
    turned = angle_rad + np.pi
    if not 0.0 <= turned < 2 * np.pi:  # a remainder costs more than all the rest
        turned %= 2 * np.pi
    return turned - np.pi


@kernel
def expected(east_m: float, north_m: float, x: float, y: float) -> tuple[float, float, float, float]:
    """Return distance, direction and the unit vector (east, north) from a pose to a place."""
    dx, dy = east_m - x, north_m - y
    distance = max(np.sqrt(dx * dx + dy * dy), NEAREST_M)
    return distance, np.arctan2(dy, dx), dx / distance, dy / distance


class _Frames(NamedTuple):
    """The frames of one track side by side, its bias taken off; room for the longest track."""

    x: Floats
    y: Floats
    range_m: Floats
    azimuth_rad: Floats


@kernel
def _place_equations(
    frames: _Frames, n: int, east_m: float, north_m: float, sigma: Floats
) -> tuple[float, float, float, float, float, float]:
    """Return ee, en, nn of HᵀWH, both sums of HᵀWε and εᵀWε of the first n frames at a place."""
    ee, en, nn, ge, gn, square = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    along = 1.0 / sigma[0]
    for i in range(n):
        distance, angle, ux, uy = expected(east_m, north_m, frames.x[i], frames.y[i])
        er = (frames.range_m[i] - distance) / sigma[0]
        ea = wrapped(frames.azimuth_rad[i] - angle) / sigma[1]
        across = 1.0 / (distance * sigma[1])
        ee += (ux * along) ** 2 + (uy * across) ** 2
        nn += (uy * along) ** 2 + (ux * across) ** 2
        en += ux * uy * (along * along - across * across)
        ge += ux * along * er - uy * across * ea
        gn += uy * along * er + ux * across * ea
        square += er * er + ea * ea
    return ee, en, nn, ge, gn, square


@kernel
def locate(  # noqa: PLR0917 - numba takes no keyword-only arguments
    start: Ints,
    order: Ints,
    xy_m: Floats,
    range_m: Floats,
    azimuth_rad: Floats,
    pose_xy_m: Floats,
    sigma: Floats,
    bias: Floats,
) -> Floats:
    """Return the place of each track that its ranges and azimuths agree on, by damped Gauss-Newton steps.

    `bias` is that of the pass of each track, shape (n_tracks, 2).
    """
    place, longest = np.zeros((len(start) - 1, 2)), 0
    for t in range(len(place)):
        longest = max(longest, start[t + 1] - start[t])
    frames = _Frames(np.empty(longest), np.empty(longest), np.empty(longest), np.empty(longest))
    for t in range(len(place)):
        n, east, north = start[t + 1] - start[t], 0.0, 0.0
        for k in range(n):
            i = order[start[t] + k]
            frames.x[k], frames.y[k] = pose_xy_m[i, 0], pose_xy_m[i, 1]
            frames.range_m[k], frames.azimuth_rad[k] = range_m[i] - bias[t, 0], azimuth_rad[i] - bias[t, 1]
            east += xy_m[i, 0] / n
            north += xy_m[i, 1] / n
        place[t, 0], place[t, 1] = _settled(frames, n, east, north, sigma)
    return place


@kernel
def _settled(frames: _Frames, n: int, east: float, north: float, sigma: Floats) -> tuple[float, float]:
    """Return the place of one track, from a first guess."""
    damping = 1e-3
    ee, en, nn, ge, gn, square = _place_equations(frames, n, east, north, sigma)
    for _ in range(N_STEPS):
        a, b = ee * (1 + damping), nn * (1 + damping)
        det = a * b - en * en
        step_e, step_n = (b * ge - en * gn) / det, (a * gn - en * ge) / det
        tried = _place_equations(frames, n, east + step_e, north + step_n, sigma)
        if tried[5] <= square:
            east, north, damping = east + step_e, north + step_n, damping / 10
            ee, en, nn, ge, gn, square = tried
            if np.hypot(step_e, step_n) < STEP_DONE_M:
                break
        else:
            damping *= 10
    return east, north


@kernel
def normal_equations(  # noqa: PLR0917 - numba takes no keyword-only arguments
    start: Ints,
    order: Ints,
    range_m: Floats,
    azimuth_rad: Floats,
    pose_xy_m: Floats,
    sigma: Floats,
    bias: Floats,
    place: Floats,
) -> tuple[Floats, Floats, Floats]:
    """Return HᵀWH over place and bias, HᵀWε and εᵀWε of each track at its place, `bias` being (n_tracks, 2)."""
    n_tracks = len(start) - 1
    matrix, gradient, square = np.zeros((n_tracks, 4, 4)), np.zeros((n_tracks, 4)), np.zeros(n_tracks)
    row = np.empty((2, 4))
    for t in range(n_tracks):
        for k in range(start[t], start[t + 1]):
            i = order[k]
            distance, angle, ux, uy = expected(place[t, 0], place[t, 1], pose_xy_m[i, 0], pose_xy_m[i, 1])
            row[0, 0], row[0, 1], row[0, 2], row[0, 3] = ux, uy, 1.0, 0.0
            row[1, 0], row[1, 1], row[1, 2], row[1, 3] = -uy / distance, ux / distance, 0.0, 1.0
            error = (range_m[i] - bias[t, 0] - distance, wrapped(azimuth_rad[i] - bias[t, 1] - angle))
            for axis in range(2):
                weight = 1.0 / sigma[axis] ** 2
                square[t] += weight * error[axis] ** 2
                for p in range(4):
                    gradient[t, p] += weight * row[axis, p] * error[axis]
                    for q in range(4):
                        matrix[t, p, q] += weight * row[axis, p] * row[axis, q]
    return matrix, gradient, square


@kernel
def misfit(matrix: Floats, gradient: Floats, square: Floats, unit: Floats, tolerance: float) -> tuple[Floats, Ints]:
    """Return the least weighted sum of squares of each track, the bias free as well, and the rank of its matrix.

    By elimination with the largest pivot first, `unit` of each unknown being taken as one; what is below `tolerance` of
    the first pivot is not seen by the track. Far cheaper than eigenvalues, and as good unless the rank is in doubt.
    """
    n_tracks, n = len(square), len(unit)
    s0, rank, left, right = square.copy(), np.zeros(n_tracks, np.int64), np.empty((n, n)), np.empty(n)
    for t in range(n_tracks):
        for p in range(n):
            right[p] = gradient[t, p] / unit[p]
            for q in range(n):
                left[p, q] = matrix[t, p, q] / (unit[p] * unit[q])
        largest = 0.0
        for _ in range(n):
            p = 0
            for q in range(n):
                p = q if left[q, q] > left[p, p] else p
            pivot = left[p, p]
            largest = max(largest, pivot)
            if pivot <= tolerance * largest:
                break
            rank[t] += 1
            s0[t] -= right[p] ** 2 / pivot
            _eliminate(left, right, p)
        s0[t] = max(s0[t], 0.0)
    return s0, rank


@kernel
def _eliminate(left: Floats, right: Floats, p: int) -> None:
    """Take the unknown p out of the equations of the others; its own row and column become 0."""
    pivot = left[p, p]
    for q in range(len(right)):
        if q != p:
            share = left[q, p] / pivot
            right[q] -= share * right[p]
            for r in range(len(right)):
                if r != p:
                    left[q, r] -= share * left[p, r]
    for q in range(len(right)):
        left[p, q] = left[q, p] = 0.0
