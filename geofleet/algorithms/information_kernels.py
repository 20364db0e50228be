"""Compiled loops of the information form: damped least squares for places, and the normal equations of each track."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

N_STEPS = 12
STEP_DONE_M = 1e-6
NEAREST_M = 0.1
"""On top of the camera a bearing means nothing: distances count as this at least."""


@njit(cache=True, nogil=True)
def wrapped(angle_rad: float) -> float:
    """Return an angle between -π and π."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


@njit(cache=True, nogil=True)
def expected(east_m: float, north_m: float, pose_xy_m: Floats) -> tuple[float, float, float, float]:
    """Return distance, direction and the unit vector (east, north) from a pose to a place."""
    dx, dy = east_m - pose_xy_m[0], north_m - pose_xy_m[1]
    distance = max(np.sqrt(dx * dx + dy * dy), NEAREST_M)
    return distance, np.arctan2(dy, dx), dx / distance, dy / distance


@njit(cache=True, nogil=True)
def _place_equations(  # noqa: PLR0917 - numba takes no keyword-only arguments
    rows: Ints,
    east_m: float,
    north_m: float,
    range_m: Floats,
    azimuth_rad: Floats,
    pose_xy_m: Floats,
    sigma: Floats,
    bias: Floats,
) -> tuple[float, float, float, float, float, float]:
    """Return ee, en, nn of HᵀWH, both sums of HᵀWε and εᵀWε of one track at a place, the bias being given."""
    ee, en, nn, ge, gn, square = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in rows:
        distance, angle, ux, uy = expected(east_m, north_m, pose_xy_m[i])
        er = (range_m[i] - bias[0] - distance) / sigma[0]
        ea = wrapped(azimuth_rad[i] - bias[1] - angle) / sigma[1]
        along, across = 1.0 / sigma[0], 1.0 / (distance * sigma[1])
        ee += (ux * along) ** 2 + (uy * across) ** 2
        nn += (uy * along) ** 2 + (ux * across) ** 2
        en += ux * uy * (along * along - across * across)
        ge += ux * along * er - uy * across * ea
        gn += uy * along * er + ux * across * ea
        square += er * er + ea * ea
    return ee, en, nn, ge, gn, square


@njit(cache=True, nogil=True)
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
    place = np.zeros((len(start) - 1, 2))
    for t in range(len(place)):
        rows = order[start[t] : start[t + 1]]
        for i in rows:
            place[t] += xy_m[i] / len(rows)
        east, north, damping = place[t, 0], place[t, 1], 1e-3
        ee, en, nn, ge, gn, square = _place_equations(
            rows, east, north, range_m, azimuth_rad, pose_xy_m, sigma, bias[t]
        )
        for _ in range(N_STEPS):
            a, b = ee * (1 + damping), nn * (1 + damping)
            det = a * b - en * en
            step_e, step_n = (b * ge - en * gn) / det, (a * gn - en * ge) / det
            tried = _place_equations(
                rows, east + step_e, north + step_n, range_m, azimuth_rad, pose_xy_m, sigma, bias[t]
            )
            if tried[5] <= square:
                east, north, damping = east + step_e, north + step_n, damping / 10
                ee, en, nn, ge, gn, square = tried
                if np.hypot(step_e, step_n) < STEP_DONE_M:
                    break
            else:
                damping *= 10
        place[t, 0], place[t, 1] = east, north
    return place


@njit(cache=True, nogil=True)
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
            distance, angle, ux, uy = expected(place[t, 0], place[t, 1], pose_xy_m[i])
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
