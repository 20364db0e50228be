"""Which signs of a layer belong to a study: those near the drive, equal classes at one point counted once."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from pyproj import Geod
from scipy.spatial import cKDTree

from geofleet.algorithms.compiled import kernel
from geofleet.algorithms.geodesy import to_ecef

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from geofleet.algorithms.geodesy import EnuFrame
    from geofleet.algorithms.trajectory import DriveLine

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]

SAME_POINT_M = 0.01


def within_corridor(lon_deg: Floats, lat_deg: Floats, frame: EnuFrame, line: DriveLine, corridor_m: float) -> Flags:
    """Return which points are at most `corridor_m` from a segment of the drive; gaps do not count.

    A tangent plane folds the far side of the Earth onto itself, so points there are left out before distances.
    """
    up = to_ecef([frame.origin_lon_deg], [frame.origin_lat_deg])[0]
    local: Flags = to_ecef(lon_deg, lat_deg) @ up > 0
    return local & _near_line(frame.to_enu(lon_deg, lat_deg), line.xy_m, line.starts, corridor_m)


def nearest_m(lon_deg: Floats, lat_deg: Floats, frame: EnuFrame, line: DriveLine) -> float:
    """Return the geodesic distance, in metres, of the point that is nearest to an epoch of the drive."""
    drive_lon, drive_lat = frame.to_lonlat(line.xy_m)
    chord_m, epoch = cKDTree(to_ecef(drive_lon, drive_lat)).query(to_ecef(lon_deg, lat_deg))
    chord_m, epoch = np.atleast_1d(chord_m), np.atleast_1d(epoch)
    point = int(np.argmin(chord_m))
    near = int(epoch[point])
    return float(Geod(ellps="WGS84").inv(lon_deg[point], lat_deg[point], drive_lon[near], drive_lat[near])[2])


def is_repeated(xy_m: Floats, sign_class: Sequence[str], support_id: Sequence[str | None]) -> Flags:
    """Return which signs have the class of one before them at the same point (1 cm) or on the same support."""
    repeated = np.zeros(len(xy_m), dtype=np.bool_)
    seen: set[tuple[str, str]] = set()
    for i, (class_, support) in enumerate(zip(sign_class, support_id, strict=True)):
        if support is not None:
            repeated[i] = (class_, support) in seen
            seen.add((class_, support))
    for first, second in cKDTree(xy_m).query_pairs(SAME_POINT_M):
        repeated[max(first, second)] |= sign_class[first] == sign_class[second]
    return repeated


@kernel
def _near_line(xy_m: Floats, line_xy_m: Floats, starts: Ints, corridor_m: float) -> Flags:
    near = np.zeros(len(xy_m), dtype=np.bool_)
    for part in range(len(starts) - 1):
        for k in range(starts[part], starts[part + 1] - 1):
            step_x, step_y = line_xy_m[k + 1, 0] - line_xy_m[k, 0], line_xy_m[k + 1, 1] - line_xy_m[k, 1]
            squared = step_x * step_x + step_y * step_y
            reach = corridor_m + np.sqrt(squared)
            for i in range(len(xy_m)):
                dx, dy = xy_m[i, 0] - line_xy_m[k, 0], xy_m[i, 1] - line_xy_m[k, 1]
                if abs(dx) <= reach and abs(dy) <= reach and not near[i]:
                    share = min(max((dx * step_x + dy * step_y) / squared, 0.0), 1.0)
                    near[i] = np.hypot(dx - share * step_x, dy - share * step_y) <= corridor_m
    return near
