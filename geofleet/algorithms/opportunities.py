"""How many passes had a place in view: what a sign's support is measured against.

A pass had a place in view when one vertex of its reported path is nearer than the range of its sensor and the place
lies within half the opening angle of the direction driven. Occlusion, and the error of the reported path, are not in
it: it counts who *could* have reported the place.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.compiled import kernel
from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_COS_ASIDE = -0.5  # 120 degrees
_REACH = 1  # cells are as wide as the longest range


def count_opportunities(xy: Floats, path_xy: Floats, first: Ints, *, range_m: Floats, fov_deg: Floats) -> Ints:
    """Count, for every place, the passes that had it in view.

    Parameters
    ----------
    xy
        (n, 2) places, east and north, metres.
    path_xy
        (m, 2) vertices of all paths in the same frame, in the order driven; a frame of the camera each, or denser.
    first
        (n_passes + 1,) `first[p]:first[p + 1]` are the vertices of pass p. A path of one vertex has no direction
        and saw nothing.
    range_m, fov_deg
        (n_passes,) of the sensor; the full opening angle.

    Returns
    -------
    (n,) int64.

    Raises
    ------
    InputError
        A coordinate or a sensor's value is not finite, or a range is not positive.
    """
    return view_chances(xy, path_xy, first, range_m=range_m, fov_deg=fov_deg, least_frames=0.0, full_frames=1.0)[1]


def view_chances(
    xy: Floats,
    path_xy: Floats,
    first: Ints,
    *,
    range_m: Floats,
    fov_deg: Floats,
    least_frames: float,
    full_frames: float,
    view_xy: Floats | None = None,
) -> tuple[Floats, Ints]:
    """Return, for every place, how many chances to report it passes had, and how many passes had it in view.

    Parameters
    ----------
    xy, path_xy, first, range_m, fov_deg
        As for `count_opportunities`, whose errors are raised too.
    least_frames, full_frames
        A pass with `least_frames` vertices or less in view had no chance, with `full_frames` or more a full one; in
        between in proportion.
    view_xy
        (n, 2) the way each place is looked at (east, north): only views within 120° of it count; (0, 0) for any.

    Returns
    -------
    (n,) float64, a chance counting in part where a pass saw the place briefly, and (n,) int64.
    """
    values = (xy, path_xy, range_m, fov_deg)
    if not all(np.isfinite(v).all() for v in values) or (np.asarray(range_m) <= 0).any():
        raise InputError(
            "a position, range or opening angle is not finite, or a range is not positive.", where="passes"
        )
    if len(xy) == 0 or len(path_xy) == 0:
        return np.zeros(len(xy)), np.zeros(len(xy), np.int64)
    side_m = float(np.max(range_m))
    low = xy.min(axis=0)
    cell = np.floor((xy - low) / side_m).astype(np.int64) + _REACH
    width = int(cell[:, 0].max()) + _REACH + 1
    keys = cell[:, 1] * width + cell[:, 0]
    order = np.argsort(keys, kind="stable")
    cells, starts = np.unique(keys[order], return_index=True)
    chances, counts = _count(
        np.ascontiguousarray(xy[order], np.float64),
        np.zeros((len(xy), 2)) if view_xy is None else np.ascontiguousarray(view_xy[order], np.float64),
        cells,
        np.append(starts, len(xy)),
        (np.floor((path_xy - low) / side_m).astype(np.int64) + _REACH, width),
        np.ascontiguousarray(path_xy, np.float64),
        first,
        np.asarray(range_m, np.float64),
        np.cos(np.radians(np.minimum(fov_deg, 360.0) / 2)),
        (least_frames, full_frames),
    )
    back = np.empty_like(order)
    back[order] = np.arange(len(order))
    return chances[back], counts[back]


@kernel
def _heading(path_xy: Floats, a: int, b: int, i: int) -> tuple[float, float]:
    """Return the unit vector from the vertex before to the vertex after, zero where the car did not move."""
    before, after = max(i - 1, a), min(i + 1, b - 1)
    east, north = path_xy[after, 0] - path_xy[before, 0], path_xy[after, 1] - path_xy[before, 1]
    length = math.hypot(east, north)
    return (east / length, north / length) if length > 0 else (0.0, 0.0)


@kernel
def _count(  # noqa: PLR0917  (numba inlines no keyword-only arguments)
    xy: Floats,
    view_xy: Floats,
    cells: Ints,
    starts: Ints,
    grid: tuple[Ints, int],
    path_xy: Floats,
    first: Ints,
    range_m: Floats,
    cos_half_fov: Floats,
    ramp: tuple[float, float],
) -> tuple[Floats, Ints]:
    vertex_cell, width = grid
    counts = np.zeros(len(xy), np.int64)
    chances, frames = np.zeros(len(xy)), np.zeros(len(xy), np.int64)
    seen = np.empty(len(xy), np.int64)
    for p in range(first.size - 1):
        n_seen = 0
        for i in range(first[p], first[p + 1]):
            east, north = _heading(path_xy, first[p], first[p + 1], i)
            column, row = vertex_cell[i]
            if (east == 0.0 and north == 0.0) or column < 0 or column > width:
                continue
            for key_row in range(row - _REACH, row + _REACH + 1):
                low = np.searchsorted(cells, key_row * width + max(column - _REACH, 0))
                high = np.searchsorted(cells, key_row * width + min(column + _REACH, width - 1), side="right")
                for j in range(starts[low], starts[high]):
                    de, dn = xy[j, 0] - path_xy[i, 0], xy[j, 1] - path_xy[i, 1]
                    d = math.hypot(de, dn)
                    is_from_front = de * view_xy[j, 0] + dn * view_xy[j, 1] >= _COS_ASIDE * d
                    if d < range_m[p] and de * east + dn * north > d * cos_half_fov[p] and is_from_front:
                        if frames[j] == 0:
                            seen[n_seen] = j
                            n_seen += 1
                        frames[j] += 1
        for j in seen[:n_seen]:
            chances[j] += min(max((frames[j] - ramp[0]) / (ramp[1] - ramp[0]), 0.0), 1.0)
            counts[j] += 1
            frames[j] = 0
    return chances, counts
