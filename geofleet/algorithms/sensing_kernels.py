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
    frames, signs = np.empty(1024, dtype=np.int64), np.empty(1024, dtype=np.int64)
    distances, bearings = np.empty(1024), np.empty(1024)
    n, cos_half = 0, np.cos(half_fov_rad)
    for frame in range(len(pose_xy_m)):
        x, y = pose_xy_m[frame, 0], pose_xy_m[frame, 1]
        ahead_x, ahead_y = np.cos(heading_rad[frame]), np.sin(heading_rad[frame])
        column = int(np.floor((x - origin_xy_m[0]) / cell_m))
        row = int(np.floor((y - origin_xy_m[1]) / cell_m))
        for r in range(max(row - 1, 0), min(row + 2, shape[0])):
            first, last = max(column - 1, 0), min(column + 2, shape[1])
            if first >= last:
                continue
            # cells of a row are neighbours in memory
            for k in range(cell_start[r * shape[1] + first], cell_start[r * shape[1] + last]):
                dx, dy = sign_xy_m[cell_sign[k], 0] - x, sign_xy_m[cell_sign[k], 1] - y
                distance = np.sqrt(dx * dx + dy * dy)
                forward = dx * ahead_x + dy * ahead_y
                if distance < range_m and forward > distance * cos_half:
                    if n == len(frames):
                        # room for twice as many
                        frames, signs = np.concatenate((frames, frames)), np.concatenate((signs, signs))
                        distances = np.concatenate((distances, distances))
                        bearings = np.concatenate((bearings, bearings))
                    frames[n], signs[n], distances[n] = frame, cell_sign[k], distance
                    bearings[n] = np.arctan2(dy * ahead_x - dx * ahead_y, forward)
                    n += 1
    return frames[:n], signs[:n], distances[:n], bearings[:n]
