"""Positions of unknown origin as longitude and latitude, with the faults that a wrong CRS leaves in them named.

Nobody notices a layer in the wrong place until its scores are zero, so what cannot be true raises, and what can hardly
be true is counted under a text that starts with `SUSPICIOUS`.
"""

from __future__ import annotations

import json
from collections import Counter
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from geofleet.errors import SUSPICIOUS, ConfigError, InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

_MAX_LON_DEG, _MAX_LAT_DEG, _MAX_UTM_LAT_DEG = 180.0, 90.0, 84.0
_NULL_ISLAND_DEG, _EMPTY_SEA_DEG = 0.001, 1.5  # no land within 1.5 degrees of 0 N 0 E but for one buoy
_ALONE_M = 100_000.0
_SWAPPED = (
    "The axes look swapped: name x and y the other way round (--columns x=…,y=…), or say swap_xy = true in a TOML file "
    "of columns."
)
_ROW_BITS, _ROW_OFFSET = 12, 1024
_CELL_DEG = 0.1  # places are looked up by cell: the outlines have a margin of three of them
_AREA_MARGIN_DEG, _ANTARCTIC_DEG = 0.5, -60.0


class PlaceCheck:
    """Looks at positions, some at a time, for what can hardly be true of them.

    Parameters
    ----------
    where
        The file, for messages.
    """

    def __init__(self, where: str) -> None:
        self._where = where
        self._n_all = self._n_guinea = 0
        self._in_cell: dict[str | None, Counter[int]] = {}

    def add(self, lon: Floats, lat: Floats, country: str | None) -> None:
        """Look at valid positions of signs of one country, None where it is not known."""
        if not len(lon):
            return
        self._n_all += len(lon)
        self._n_guinea += int(((np.abs(lon) < _EMPTY_SEA_DEG) & (np.abs(lat) < _EMPTY_SEA_DEG)).sum())
        column, row = (np.floor(side / _CELL_DEG).astype(np.int64) for side in (lon, lat))
        every = np.sort((column << _ROW_BITS) + row + _ROW_OFFSET)  # np.unique imports numpy.ma
        first = np.flatnonzero(np.diff(every, prepend=every[0] - 1))
        n_each = np.diff(first, append=len(every))
        counts = self._in_cell.setdefault(country, Counter())
        counts.update(dict(zip(every[first].tolist(), n_each.tolist(), strict=True)))

    def _counted(self) -> tuple[int, Counter[str], int]:
        """Return how many points lie on no land, outside of their country, and inside with the axes exchanged."""
        n_sea = n_swapped = 0
        outside: Counter[str] = Counter()
        for country, counts in self._in_cell.items():
            cells, in_cell = (np.fromiter(side, np.int64) for side in (counts.keys(), counts.values()))
            x = np.asarray((cells >> _ROW_BITS) + 0.5, np.float64) * _CELL_DEG
            y = np.asarray((cells & ((1 << _ROW_BITS) - 1)) - _ROW_OFFSET + 0.5, np.float64) * _CELL_DEG
            n_sea += int(in_cell[~_is_on_land(x, y)].sum())
            if country in outlines():
                outside[country] = int(in_cell[~is_within(country, x, y)].sum())
                n_swapped += int(in_cell[is_within(country, y, x)].sum())
        return n_sea, outside, n_swapped

    def doubts(self) -> dict[str, int]:
        """Return what can hardly be true, with counts.

        Raises
        ------
        InputError
            Most points lie in the Gulf of Guinea; or outside of the country, and inside with the axes exchanged.
        """
        if 2 * self._n_guinea > self._n_all:
            raise _guinea(self._n_guinea, self._n_all, self._where)
        n_sea, outside, n_swapped = self._counted()
        n_outside = outside.total()
        lands = ", ".join(country for country, n in outside.items() if n)
        if 2 * n_outside > self._n_all and 2 * n_swapped > self._n_all:
            raise InputError(
                f"{n_outside} of {self._n_all} positions lie outside of {lands}, and inside with the axes swapped.",
                where=self._where,
                todo="Latitude and longitude are exchanged: swap them (swap_xy), or name the right x and y columns.",
            )
        found = {f"{SUSPICIOUS}outside of {lands}; is the CRS right?": n_outside} if n_outside else {}
        if 2 * n_sea > self._n_all:
            found[f"{SUSPICIOUS}over 30 km from any land; is the CRS right?"] = n_sea
        return found


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
        raise _guinea(int(sea.sum()), len(lon), where)
    return np.asarray(null, bool)


def doubts(lon: Floats, lat: Floats, country: str | None, *, where: str) -> dict[str, int]:
    """Return what can hardly be true of valid positions, with counts.

    Raises
    ------
    InputError
        Most points lie outside of the country, and inside when longitude and latitude are exchanged.
    """
    check = PlaceCheck(where)
    check.add(lon, lat, country)
    found = check.doubts()
    alone = int(_alone(lon, lat).sum())
    if alone:
        found[f"{SUSPICIOUS}over 100 km from any other; are these positions right?"] = alone
    return found


def country_at(lon: float, lat: float) -> set[str]:
    """Return the countries whose outline, with its margin, holds a point."""
    return {name for name in outlines() if is_within(name, np.array([lon]), np.array([lat]))[0]}


def is_within(country: str, lon: Floats, lat: Floats) -> Flags:
    """Tell which points lie in a country of `outlines`, or within a margin of some 30 km around it."""
    return np.asarray(shapely.contains_xy(outlines()[country], lon, lat), bool)


def area_doubt(crs: Any, lon: Floats, lat: Floats) -> dict[str, int]:
    """Return how many points lie far from where a CRS is meant to be used, when most do."""
    from pyproj import CRS  # noqa: PLC0415  (takes a moment to load)

    area = CRS.from_user_input(crs).area_of_use
    if area is None or not len(lon):
        return {}
    width = (area.east - area.west) % 360.0 or 360.0
    beyond = (lon - area.west + _AREA_MARGIN_DEG) % 360.0 > width + 2.0 * _AREA_MARGIN_DEG
    beyond |= (lat < area.south - _AREA_MARGIN_DEG) | (lat > area.north + _AREA_MARGIN_DEG)
    told = f"{SUSPICIOUS}outside of {area.name[:80]}, which the CRS is meant for; is the CRS right?"
    return {told: int(beyond.sum())} if 2 * beyond.sum() > len(lon) else {}


@cache
def outlines() -> dict[str, Any]:
    """Return outlines of countries, Natural Earth's with a margin, by ISO 3166-1 alpha-2."""
    text = resources.files("geofleet.formats").joinpath("country_outlines.json").read_text(encoding="utf-8")
    found = {
        code: shapely.multipolygons(list(map(shapely.polygons, rings))) for code, rings in json.loads(text).items()
    }
    for shape in found.values():
        shapely.prepare(shape)
    return found


def _is_on_land(lon: Floats, lat: Floats) -> Flags:
    """Tell which points lie in any country; most are in that of the first one."""
    is_there = np.zeros(len(lon), bool)
    for shape in outlines().values():
        open_ = np.flatnonzero(~is_there)
        if not len(open_):
            break
        is_there[open_] = shapely.contains_xy(shape, lon[open_], lat[open_])
    return is_there | (lat < _ANTARCTIC_DEG)


def _guinea(n_there: int, n_all: int, where: str) -> InputError:
    return InputError(
        f"{n_there} of {n_all} positions lie in the Gulf of Guinea, by 0° N 0° E: the CRS is wrong.",
        where=where,
        todo="Give the CRS of the coordinates with --crs.",
    )


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
            todo=_SWAPPED if swapped else "Give the CRS, e.g. --crs EPSG:31370.",
        )


def utm_around(lat: float, lon: float) -> tuple[str, float, float]:
    """Return the UTM zone of an origin in degrees, and its easting and northing in metres there.

    Raises
    ------
    ConfigError
        The origin lies outside of UTM.
    """
    from pyproj import Transformer  # noqa: PLC0415  (only local coordinates need PROJ)

    if not (abs(lat) <= _MAX_UTM_LAT_DEG and abs(lon) <= _MAX_LON_DEG):
        raise ConfigError(
            f"the origin {lat:g},{lon:g} lies outside of UTM.", todo="Give LAT,LON in degrees, latitude first."
        )
    zone = min(int((lon + 180.0) // 6.0) + 1, 60)
    crs = f"EPSG:{(32600 if lat >= 0 else 32700) + zone}"
    easting_m, northing_m = Transformer.from_crs("OGC:CRS84", crs, always_xy=True).transform(lon, lat)
    return crs, float(easting_m), float(northing_m)


def _alone(lon: Floats, lat: Floats) -> Flags:
    """Return which points have no other one within `_ALONE_M`, when most have."""
    from scipy.spatial import cKDTree  # noqa: PLC0415  (takes a moment to load)

    from geofleet.algorithms.geodesy import to_ecef  # noqa: PLC0415  (as above)

    place = np.unique(np.column_stack((lon, lat)), axis=0)
    if len(place) < 3:  # noqa: PLR2004  (of two, none is the odd one)
        return np.zeros(len(place), bool)
    ecef = to_ecef(place[:, 0], place[:, 1])
    distance, _ = cKDTree(ecef).query(ecef, k=2)
    alone = np.asarray(distance)[:, 1] > _ALONE_M
    return alone if 2 * alone.sum() < len(place) else np.zeros(len(place), bool)
