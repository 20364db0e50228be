"""Coordinates of a trajectory as degrees: geographic, projected, Earth-centred, or metres from an origin in UTM."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.errors import ConfigError
from geofleet.formats.positions import to_lonlat, utm_around

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

LEAST_RADIUS_M = 6_300_000.0  # the poles lie 6 357 km from the centre


@dataclass(frozen=True, slots=True)
class LocalCrs:
    """A CRS, and easting and northing of x = y = 0 in it."""

    crs: str
    easting_m: float = 0.0
    northing_m: float = 0.0


def local_crs(crs: str | None, origin: tuple[float, float] | None, utm: tuple[str, float, float] | None) -> LocalCrs:
    """Return the CRS that a caller means: one by name, metres from an origin in its UTM zone, or a shifted one.

    Raises
    ------
    ConfigError
        Two are given, or the origin lies outside of UTM.
    """
    if (crs is not None) + (origin is not None) + (utm is not None) > 1:
        raise ConfigError("crs, origin and utm contradict each other.", todo="Give one of them.")
    if utm is not None:
        return LocalCrs(utm[0], float(utm[1]), float(utm[2]))
    if origin is None:
        return LocalCrs(crs or "OGC:CRS84")
    return LocalCrs(*utm_around(*origin))


def is_geographic(crs: str) -> bool:
    """Tell whether a CRS is in degrees; an unknown one is not."""
    from pyproj import CRS  # noqa: PLC0415  (takes a moment to load)
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    try:
        return bool(CRS.from_user_input(crs).is_geographic)
    except CRSError:
        return False


def to_places(x: Floats, y: Floats, z: Floats, local: LocalCrs, *, where: str) -> tuple[Floats, Floats, Floats]:
    """Return longitude and latitude in degrees and height in metres; NaN where there is no such place.

    Raises
    ------
    InputError
        The CRS is unknown or contradicts the numbers.
    """
    from pyproj import CRS, Transformer  # noqa: PLC0415  (takes a moment to load)
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    try:
        known = CRS.from_user_input(local.crs)
    except CRSError:
        raise ConfigError(f"unknown CRS {local.crs[:80]!r}.", todo="Give one such as EPSG:32617.") from None
    if not known.is_geocentric:
        return *to_lonlat(x + local.easting_m, y + local.northing_m, known, where=where), z
    if not np.isfinite(z).any():
        raise ConfigError(f"{known.name} needs a third coordinate.", where=where, todo="Name it: height=….")
    radius = np.sqrt(x**2 + y**2 + z**2)
    on_earth = np.isfinite(radius) & (radius > LEAST_RADIUS_M)
    x, y, z = (np.where(on_earth, side, np.nan) for side in (x, y, z))
    lon, lat, height = Transformer.from_crs(known, "EPSG:4979", always_xy=True).transform(x, y, z)
    lon, lat, height = (np.where(np.isfinite(side), side, np.nan) for side in (lon, lat, height))
    return lon, lat, height
