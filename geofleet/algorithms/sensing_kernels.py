"""Compiled loops of sensing: which signs are in the view cone at each frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

ROUNDING_M = 1e-6
"""A view cone is taken to be this much larger when cells are chosen: rounding must not lose a sign on its edge."""


@kernel
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

    Signs lie in a grid of square cells of `cell_m` (`cell_start`, `cell_sign`, by row; cells of a row are neighbours in
    memory), and a frame looks into those that the box around its view cone touches. The angle is compared by its
    cosine, which falls all the way from 0 to π.
    """
    # Room for every candidate: arrays that grow inside the loop make it three times as slow.
    ahead, cells, room = _cones(pose_xy_m, heading_rad, cell_start, origin_xy_m, shape, cell_m, range_m, half_fov_rad)
    frames, signs = np.empty(room, np.int64), np.empty(room, np.int64)
    distances, forwards, lefts = np.empty(room), np.empty(room), np.empty(room)
    n, cos_half = 0, np.cos(half_fov_rad)
    for frame in range(len(pose_xy_m)):
        x, y = pose_xy_m[frame, 0], pose_xy_m[frame, 1]
        ahead_x, ahead_y = ahead[frame, 0], ahead[frame, 1]
        for row in range(cells[frame, 2], cells[frame, 3]):
            first, last = row * shape[1] + cells[frame, 0], row * shape[1] + cells[frame, 1]
            for k in range(cell_start[first], cell_start[last]):
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


@kernel
def _cones(  # noqa: PLR0917 - numba takes no keyword-only arguments
    pose_xy_m: Floats,
    heading_rad: Floats,
    cell_start: Ints,
    origin_xy_m: Floats,
    shape: tuple[int, int],
    cell_m: float,
    range_m: float,
    half_fov_rad: float,
) -> tuple[Floats, Ints, int]:
    """Return the direction of each frame, the cells that its view cone touches, and how many signs these hold in all.

    Cells are first and last column and first and last row, half-open; none where the cone touches none.
    """
    ahead, cells, n = np.empty((len(pose_xy_m), 2)), np.zeros((len(pose_xy_m), 4), np.int64), 0
    cos_half, sin_half = np.cos(half_fov_rad), np.sin(half_fov_rad)
    for frame in range(len(pose_xy_m)):
        ahead_x, ahead_y = np.cos(heading_rad[frame]), np.sin(heading_rad[frame])
        ahead[frame, 0], ahead[frame, 1] = ahead_x, ahead_y
        x, y = pose_xy_m[frame, 0] - origin_xy_m[0], pose_xy_m[frame, 1] - origin_xy_m[1]
        left, right = _cells(x, ahead_x, ahead_y, cell_m, shape[1], range_m, cos_half, sin_half)
        low, high = _cells(y, ahead_y, ahead_x, cell_m, shape[0], range_m, cos_half, sin_half)
        if left < right and low < high:
            cells[frame, 0], cells[frame, 1], cells[frame, 2], cells[frame, 3] = left, right, low, high
            for row in range(low, high):
                n += cell_start[row * shape[1] + right] - cell_start[row * shape[1] + left]
    return ahead, cells, n


@kernel
def _cells(  # noqa: PLR0917 - numba takes no keyword-only arguments
    place_m: float,
    ahead: float,
    aside: float,
    cell_m: float,
    n_cells: int,
    range_m: float,
    cos_half: float,
    sin_half: float,
) -> tuple[int, int]:
    """Return the first and the last cell, half-open, that a view cone touches along one axis.

    `place_m` is its tip and `ahead` the component of its direction on the axis, `aside` that on the other.
    """
    one, two = ahead * cos_half - aside * sin_half, ahead * cos_half + aside * sin_half  # the two edges
    most = 1.0 if ahead >= cos_half else max(0.0, one, two)
    least = -1.0 if -ahead >= cos_half else min(0.0, one, two)
    first = int(np.floor((place_m + least * range_m - ROUNDING_M) / cell_m))
    last = int(np.floor((place_m + most * range_m + ROUNDING_M) / cell_m))
    return max(first, 0), max(min(last + 1, n_cells), 0)


@kernel
def by_frame(first: Ints, second: Ints) -> Ints:
    """Return the order that merges two runs of rows by frame, numbered through both; of equals, `first` comes first."""
    order = np.empty(len(first) + len(second), np.int64)
    i, j = 0, 0
    for k in range(len(order)):
        if j == len(second) or (i < len(first) and first[i] <= second[j]):
            order[k], i = i, i + 1
        else:
            order[k], j = len(first) + j, j + 1
    return order


@kernel
def project(
    frame: Ints, range_m: Floats, bearing_rad: Floats, pose_xy_m: Floats, heading_rad: Floats
) -> tuple[Floats, Floats]:
    """Return pose + R(heading) d (cos θ, sin θ), shape (n, 2), and the directions heading + θ, shape (n,)."""
    xy_m, azimuth_rad = np.empty((len(frame), 2)), np.empty(len(frame))
    for i in range(len(frame)):
        at, azimuth = frame[i], heading_rad[frame[i]] + bearing_rad[i]
        xy_m[i, 0] = pose_xy_m[at, 0] + range_m[i] * np.cos(azimuth)  # sine and cosine come from one call
        xy_m[i, 1] = pose_xy_m[at, 1] + range_m[i] * np.sin(azimuth)
        azimuth_rad[i] = azimuth
    return xy_m, azimuth_rad
