"""Local East-North-Up frames: storage is WGS 84 longitude and latitude, estimation is in metres.

A frame is the tangent plane at its origin with all heights set to zero (`proj=topocentric`): 100 m of height would
move a point by 1.6 cm at 1 km. Distances in it are true to 1 mm within 2 km and to 1.4 cm within 15 km, which is why a
frame belongs to a tile and not to a country.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from pyproj import Transformer

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]


_SEMI_MAJOR_M = 6378137.0
_FLATTENING = 1 / 298.257223563
_ECCENTRICITY_SQ = _FLATTENING * (2 - _FLATTENING)


def to_ecef(lon_deg: ArrayLike, lat_deg: ArrayLike) -> Floats:
    """Return Earth-centred coordinates in metres, shape (n, 3), of points on the WGS 84 ellipsoid.

    The straight distance between two of them is the distance on the ground to 1e-13 within metres and to 1 mm within
    1 km, anywhere on Earth: neighbours need no local frame.
    """
    lon, lat = np.radians(np.asarray(lon_deg, np.float64)), np.radians(np.asarray(lat_deg, np.float64))
    normal = _SEMI_MAJOR_M / np.sqrt(1 - _ECCENTRICITY_SQ * np.sin(lat) ** 2)
    return np.column_stack(
        (
            normal * np.cos(lat) * np.cos(lon),
            normal * np.cos(lat) * np.sin(lon),
            normal * (1 - _ECCENTRICITY_SQ) * np.sin(lat),
        )
    )


@lru_cache(maxsize=256)
def _transformer(origin_lon_deg: float, origin_lat_deg: float) -> Transformer:
    """Geodetic degrees and height to topocentric metres; building one costs about a millisecond."""
    return Transformer.from_pipeline(
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        f"+step +proj=topocentric +ellps=WGS84 +lon_0={origin_lon_deg:.10f} +lat_0={origin_lat_deg:.10f} +h_0=0"
    )


@dataclass(frozen=True, slots=True)
class EnuFrame:
    """A local East-North-Up frame on the WGS 84 ellipsoid.

    Parameters
    ----------
    origin_lon_deg, origin_lat_deg
        Where east and north are zero, degrees (OGC:CRS84).
    """

    origin_lon_deg: float
    origin_lat_deg: float

    @classmethod
    def around(cls, lon_deg: ArrayLike, lat_deg: ArrayLike) -> EnuFrame:
        """Place the origin in the middle of the extent of some points, rounded to 1e-6 degrees.

        Longitudes on both sides of the antimeridian give an origin beside it, not half a world away.
        """
        lon, lat = np.asarray(lon_deg, np.float64), np.asarray(lat_deg, np.float64)
        unwrapped = lon[0] + (lon - lon[0] + 180.0) % 360.0 - 180.0
        middle = (unwrapped.min() + unwrapped.max()) / 2
        return cls(round(float((middle + 180.0) % 360.0 - 180.0), 6), round(float((lat.min() + lat.max()) / 2), 6))

    def to_enu(self, lon_deg: ArrayLike, lat_deg: ArrayLike) -> Floats:
        """Return east and north in metres, shape (n, 2), of points on the ellipsoid."""
        lon, lat = np.asarray(lon_deg, np.float64), np.asarray(lat_deg, np.float64)
        east, north, _ = _transformer(self.origin_lon_deg, self.origin_lat_deg).transform(lon, lat, np.zeros_like(lon))
        return np.column_stack((east, north))

    def to_lonlat(self, xy_m: Floats) -> tuple[Floats, Floats]:
        """Return longitude and latitude in degrees of points given in metres, shape (n, 2).

        The height of the plane above the ellipsoid is solved for, so that `to_enu` gives the points back to 2 µm
        within 100 km.
        """
        east, north = np.ascontiguousarray(xy_m[:, 0]), np.ascontiguousarray(xy_m[:, 1])
        up = np.zeros_like(east)
        transformer = _transformer(self.origin_lon_deg, self.origin_lat_deg)
        for _ in range(3):  # each round divides the error by about (distance / earth radius)²
            lon, lat, height = transformer.transform(east, north, up, direction="INVERSE")
            up = up - height
        return lon, lat
