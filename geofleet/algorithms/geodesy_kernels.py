"""Compiled geodesy for many points at a time: Earth-centred coordinates, and the planes of tiles."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY_SQ = _FLATTENING * (2 - _FLATTENING)


@kernel
def ecef_points(lon_deg: Floats, lat_deg: Floats) -> Floats:
    """Return what `geodesy.to_ecef` does, (n, 3) metres, several times as fast and without holding the interpreter."""
    xyz = np.empty((lon_deg.size, 3))
    for i in range(lon_deg.size):
        lon, lat = math.radians(lon_deg[i]), math.radians(lat_deg[i])
        sin_lat, cos_lat = math.sin(lat), math.cos(lat)
        normal = _SEMI_MAJOR_M / math.sqrt(1 - _ECCENTRICITY_SQ * sin_lat * sin_lat)
        xyz[i, 0] = normal * cos_lat * math.cos(lon)
        xyz[i, 1] = normal * cos_lat * math.sin(lon)
        xyz[i, 2] = normal * (1 - _ECCENTRICITY_SQ) * sin_lat
    return xyz


@kernel
def tile_planes(xyz_m: Floats, tile: Ints, origin_m: Floats, axes: Floats) -> Floats:
    """Return east and north, (n, 2), of points in the plane that touches the ellipsoid at the origin of their tile.

    Parameters
    ----------
    xyz_m
        (n, 3) Earth-centred points.
    tile
        (n,) tile of each.
    origin_m, axes
        (n_tiles, 3) and (n_tiles, 3, 3): Earth-centred origin of every tile; its east, north and up.
    """
    xy = np.empty((len(xyz_m), 2))
    for i in range(len(xyz_m)):
        t = tile[i]
        for axis in range(2):
            total = 0.0
            for side in range(3):
                total += (xyz_m[i, side] - origin_m[t, side]) * axes[t, axis, side]
            xy[i, axis] = total
    return xy


def local_axes(lon_deg: Floats, lat_deg: Floats) -> Floats:
    """Return east, north and up at points of the ellipsoid as Earth-centred unit vectors, (n, 3, 3)."""
    lon, lat = np.radians(lon_deg), np.radians(lat_deg)
    return np.stack(
        (
            np.column_stack((-np.sin(lon), np.cos(lon), np.zeros_like(lon))),
            np.column_stack((-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat))),
            np.column_stack((np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat))),
        ),
        axis=1,
    )
