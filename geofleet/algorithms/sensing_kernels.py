"""Compiled loops of sensing: which signs are in the view cone at each frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]


@njit(cache=True, nogil=True)
def in_view(  # noqa: PLR0917 - numba takes no keyword-only arguments
    pose_xy_m: Floats,
    heading_rad: Floats,
    sign_xy_m: Floats,
    cell_start: Ints,
    cell_sign: Ints,
    origin_xy_m: Floats,
    shape: tuple[int, int],
    cell_m: float,
    range_m: float,
    half_fov_rad: float,
) -> tuple[Ints, Ints, Floats, Floats]:
    """Return frame, sign, distance in metres and bearing in radians of every sign in the cone, by frame.

    Signs lie in a grid of square cells of `cell_m`, at least `range_m` wide (`cell_start`, `cell_sign`, by row), so a
    frame looks at nine cells. The angle is compared by its cosine, which falls all the way from 0 to π.
    """
    # Room for every candidate: arrays that grow inside the loop make it three times as slow.
    room = _n_candidates(pose_xy_m, cell_start, origin_xy_m, shape, cell_m)
    frames, signs = np.empty(room, np.int64), np.empty(room, np.int64)
    distances, forwards, lefts = np.empty(room), np.empty(room), np.empty(room)
    n, cos_half = 0, np.cos(half_fov_rad)
    for frame in range(len(pose_xy_m)):
        x, y = pose_xy_m[frame, 0], pose_xy_m[frame, 1]
        ahead_x, ahead_y = np.cos(heading_rad[frame]), np.sin(heading_rad[frame])
        rows, columns = _around(x, y, origin_xy_m, shape, cell_m)
        for row in range(rows[0], rows[1]):
            for k in range(cell_start[row * shape[1] + columns[0]], cell_start[row * shape[1] + columns[1]]):
                dx, dy = sign_xy_m[cell_sign[k], 0] - x, sign_xy_m[cell_sign[k], 1] - y
                square = dx * dx + dy * dy
                if square < range_m * range_m:
                    distance, forward = np.sqrt(square), dx * ahead_x + dy * ahead_y
                    if forward > distance * cos_half:
                        frames[n], signs[n], distances[n] = frame, cell_sign[k], distance
                        forwards[n], lefts[n] = forward, dy * ahead_x - dx * ahead_y
                        n += 1
    bearings = np.empty(n)
    for i in range(n):
        bearings[i] = np.arctan2(lefts[i], forwards[i])
    return frames[:n].copy(), signs[:n].copy(), distances[:n].copy(), bearings


@njit(cache=True, nogil=True)
def _around(
    x_m: float, y_m: float, origin_xy_m: Floats, shape: tuple[int, int], cell_m: float
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the rows and columns, half-open, of the cells around a place; cells of a row are neighbours in memory."""
    column, row = int(np.floor((x_m - origin_xy_m[0]) / cell_m)), int(np.floor((y_m - origin_xy_m[1]) / cell_m))
    columns = max(column - 1, 0), min(column + 2, shape[1])
    rows = max(row - 1, 0), min(row + 2, shape[0])
    return rows if columns[0] < columns[1] else (0, 0), columns


@njit(cache=True, nogil=True)
def _n_candidates(
    pose_xy_m: Floats, cell_start: Ints, origin_xy_m: Floats, shape: tuple[int, int], cell_m: float
) -> int:
    """Return how many pairs of a frame and a sign lie in cells next to each other."""
    n = 0
    for frame in range(len(pose_xy_m)):
        rows, columns = _around(pose_xy_m[frame, 0], pose_xy_m[frame, 1], origin_xy_m, shape, cell_m)
        for row in range(rows[0], rows[1]):
            n += cell_start[row * shape[1] + columns[1]] - cell_start[row * shape[1] + columns[0]]
    return n
