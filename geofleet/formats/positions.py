"""Positions of unknown origin as longitude and latitude, with the faults that a wrong CRS leaves in them named.

Nobody notices a layer in the wrong place until its scores are zero, so what cannot be true raises, and what can hardly
be true is counted under a text that starts with `SUSPICIOUS`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.algorithms.geodesy import to_ecef
from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

SUSPICIOUS = "SUSPICIOUS: "
_MAX_LON_DEG, _MAX_LAT_DEG = 180.0, 90.0
_NULL_ISLAND_DEG, _EMPTY_SEA_DEG = 0.001, 1.5  # no land within 1.5 degrees of 0 N 0 E but for one buoy
_ALONE_M = 100_000.0

# West, south, east, north of the land that a national scheme applies to, with a margin of some 10 km
COUNTRY_BOXES = {
    "AT": (9.4, 46.3, 17.3, 49.1),
    "BE": (2.4, 49.4, 6.5, 51.6),
    "CH": (5.8, 45.7, 10.6, 47.9),
    "CZ": (12.0, 48.5, 19.0, 51.2),
    "DE": (5.7, 47.2, 15.2, 55.2),
    "DK": (7.9, 54.4, 15.3, 57.9),
    "EE": (21.6, 57.4, 28.3, 59.8),
    "ES": (-18.3, 27.5, 4.5, 43.9),
    "FI": (19.0, 59.4, 31.7, 70.2),
    "FR": (-5.3, 41.2, 9.7, 51.2),
    "GB": (-8.8, 49.8, 1.9, 61.0),
    "IT": (6.5, 35.3, 18.7, 47.2),
    "LU": (5.6, 49.4, 6.6, 50.3),
    "NL": (3.2, 50.6, 7.4, 53.7),
    "NO": (4.3, 57.8, 31.3, 71.3),
    "PL": (14.0, 48.9, 24.3, 55.0),
    "SE": (10.8, 55.2, 24.3, 69.2),
    "US": (-179.5, 18.8, -66.8, 71.5),
}


def to_lonlat(x: Floats, y: Floats, crs: Any, *, where: str) -> tuple[Floats, Floats]:
    """Return longitude and latitude, degrees, of points in some CRS, x first; NaN where there is no such place.

    Raises
    ------
    InputError
        The CRS is unknown, or contradicts the numbers: degrees in a projected one, metres in a geographic one.
    """
    from pyproj import CRS, Transformer  # noqa: PLC0415  (takes a moment to load)
    from pyproj.exceptions import CRSError, ProjError  # noqa: PLC0415

    try:
        known = CRS.from_user_input(crs)
        transformer = Transformer.from_crs(known, "OGC:CRS84", always_xy=True)
    except (CRSError, ProjError) as error:
        raise InputError(
            f"the CRS {str(crs)[:80]!r} cannot be used ({error}).", where=where, todo="Give --crs."
        ) from None
    finite = np.isfinite(x) & np.isfinite(y)
    degrees = finite & (np.abs(x) <= _MAX_LON_DEG) & (np.abs(y) <= _MAX_LON_DEG)
    if finite.any():
        _refuse_contradiction(x[finite], y[finite], degrees[finite], known, where)
    lon, lat = transformer.transform(np.where(finite, x, np.nan), np.where(finite, y, np.nan))
    with np.errstate(invalid="ignore"):
        valid = (np.abs(lon) <= _MAX_LON_DEG) & (np.abs(lat) <= _MAX_LAT_DEG)
    return np.where(valid, lon, np.nan), np.where(valid, lat, np.nan)


def reject_null_island(lon: Floats, lat: Floats, *, where: str) -> Flags:
    """Return which points lie at 0 N 0 E, where files put what has no position.

    Raises
    ------
    InputError
        Most points lie in the sea around it: a CRS read as another one.
    """
    if not len(lon):
        return np.zeros(0, bool)
    sea = (np.abs(lon) < _EMPTY_SEA_DEG) & (np.abs(lat) < _EMPTY_SEA_DEG)
    null = (np.abs(lon) < _NULL_ISLAND_DEG) & (np.abs(lat) < _NULL_ISLAND_DEG)
    if 2 * sea.sum() > len(lon):
        raise InputError(
            f"{sea.sum()} of {len(lon)} positions lie in the Gulf of Guinea, by 0° N 0° E: the CRS is wrong.",
            where=where,
            todo="Give the CRS of the coordinates with --crs.",
        )
    return np.asarray(null, bool)


def doubts(lon: Floats, lat: Floats, country: str | None, *, where: str) -> dict[str, int]:
    """Return what can hardly be true of valid positions, with counts.

    Raises
    ------
    InputError
        Most points lie outside of the country, and inside when longitude and latitude are exchanged.
    """
    found = {}
    box = COUNTRY_BOXES.get(country or "")
    if box and len(lon):
        outside = int((~_inside(box, lon, lat)).sum())
        if 2 * outside > len(lon) and 2 * _inside(box, lat, lon).sum() > len(lon):
            raise InputError(
                f"{outside} of {len(lon)} positions lie outside of {country}, and inside with the axes swapped.",
                where=where,
                todo="Latitude and longitude are exchanged: swap them (swap_xy), or name the right x and y columns.",
            )
        if outside:
            found[f"{SUSPICIOUS}outside of {country}; is the CRS right?"] = outside
    alone = int(_alone(lon, lat).sum())
    if alone:
        found[f"{SUSPICIOUS}over 100 km from any other; are these positions right?"] = alone
    return found


def country_at(lon: float, lat: float) -> set[str]:
    """Return the countries whose box holds a point."""
    return {name for name, box in COUNTRY_BOXES.items() if _inside(box, np.array([lon]), np.array([lat]))[0]}


def _refuse_contradiction(x: Floats, y: Floats, degrees: Flags, crs: Any, where: str) -> None:
    span = f"x {x.min():g} to {x.max():g}, y {y.min():g} to {y.max():g}"
    if crs.is_projected and degrees.all():
        raise InputError(
            f"the coordinates look like degrees ({span}), but the CRS is {crs.name}, in metres.",
            where=where,
            todo="Give --crs OGC:CRS84.",
        )
    bad = ~degrees | (np.abs(y) > _MAX_LAT_DEG)
    if crs.is_geographic and 2 * bad.sum() > len(x):
        swapped = (np.abs(y) <= _MAX_LON_DEG).all() and (np.abs(x) <= _MAX_LAT_DEG).all()
        raise InputError(
            f"the coordinates are no longitudes and latitudes ({span}).",
            where=where,
            todo="The axes look swapped (swap_xy)." if swapped else "Give the CRS, e.g. --crs EPSG:31370.",
        )


def _inside(box: tuple[float, float, float, float], lon: Floats, lat: Floats) -> Flags:
    west, south, east, north = box
    return np.asarray((lon >= west) & (lon <= east) & (lat >= south) & (lat <= north), bool)


def _alone(lon: Floats, lat: Floats) -> Flags:
    """Return which points have no other one within `_ALONE_M`, when most have."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  (takes a moment to load)

    place = np.unique(np.column_stack((lon, lat)), axis=0)
    if len(place) < 3:  # noqa: PLR2004  (of two, none is the odd one)
        return np.zeros(len(place), bool)
    ecef = to_ecef(place[:, 0], place[:, 1])
    distance, _ = cKDTree(ecef).query(ecef, k=2)
    alone = np.asarray(distance)[:, 1] > _ALONE_M
    return alone if 2 * alone.sum() < len(place) else np.zeros(len(place), bool)
