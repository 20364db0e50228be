"""Where an OpenDRIVE file lies on Earth: its geoReference and header offset, or what the user says instead."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import CRSError, ProjError

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.errors import ConfigError, InputError
from geofleet.formats.datum import datum_of, local_datum
from geofleet.formats.xml import number, place

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.formats.reading import Datum
    from geofleet.formats.xml import Element

    Floats = NDArray[np.float64]

_GIVE = "Give the projection with --crs (e.g. EPSG:25832), or the place of x = 0, y = 0 with --origin LAT,LON."
_NOWHERE_DEG = 0.5
_OLD_EPSG = re.compile(r"\+init=epsg:(\d+)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Georeference:
    """How to come from the x and y of a file to longitude and latitude.

    Parameters
    ----------
    frame
        Projected CRS, or a local frame whose origin the user gave.
    offset_x_m, offset_y_m, offset_heading
        `<offset>` of the header: the place of the file's origin in the CRS, m, and the direction of its x axis,
        radians counterclockwise.
    is_from_file
        The file said so, and not the user.
    """

    frame: CRS | EnuFrame
    offset_x_m: float = 0.0
    offset_y_m: float = 0.0
    offset_heading: float = 0.0
    is_from_file: bool = False

    def to_lonlat(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return longitude and latitude, degrees (OGC:CRS84), of points in the file's coordinates.

        The offset turns and then shifts, as ASAM OpenDRIVE 1.8, 8.4, and ASAM OSI (`proj_frame_offset`) define it.

        Raises
        ------
        InputError
            A point lies outside of what the projection can express, or the geoReference is the template around
            0° N, 0° E that editors write before a place is set.
        """
        cos, sin = np.cos(self.offset_heading), np.sin(self.offset_heading)
        east, north = x * cos - y * sin + self.offset_x_m, x * sin + y * cos + self.offset_y_m
        if isinstance(self.frame, EnuFrame):
            lon, lat = self.frame.to_lonlat(np.column_stack((east, north)))
        else:
            lon, lat = _transformer(self.frame).transform(east, north)
        bad = ~(np.isfinite(lon) & np.isfinite(lat))
        if bad.any():
            first = np.flatnonzero(bad)[0]
            raise InputError(
                f"{bad.sum()} points, the first at x={x[first]:.1f}, y={y[first]:.1f}, are outside of the projection "
                f"({self.name}).",
                todo="Check geoReference and <offset>, or give the right projection with --crs.",
            )
        if self.is_from_file and len(lon) and max(np.abs(lon).max(), np.abs(lat).max()) < _NOWHERE_DEG:
            raise InputError(
                f"geoReference ({self.name}) puts the map at 0° N, 0° E, in the Gulf of Guinea: the template of an "
                "editor, not a place.",
                todo=_GIVE,
            )
        return lon, lat

    @property
    def name(self) -> str:
        """What the coordinates are in, for people."""
        if isinstance(self.frame, EnuFrame):
            return f"local frame at {self.frame.origin_lat_deg:.7f}, {self.frame.origin_lon_deg:.7f}"
        return str(self.frame.srs if self.frame.name in {"", "unknown"} else self.frame.name)[:120]

    def datum(self, lon: Floats, lat: Floats) -> Datum:
        """Return how points came to WGS 84, by their result, degrees."""
        return local_datum(self.name) if isinstance(self.frame, EnuFrame) else datum_of(self.frame, lon, lat)

    def bearing_deg(self, x: Floats, y: Floats, direction: Floats) -> Floats:
        """Return directions in the file, radians counterclockwise from x, as degrees clockwise from true north.

        A projection's north is not true north away from its central meridian, so a point a metre on is looked at.
        """
        lon, lat = self.to_lonlat(x, y)
        lon_on, lat_on = self.to_lonlat(x + np.cos(direction), y + np.sin(direction))
        # Degrees of longitude are shorter by cos(lat), and the ellipsoid's radii differ by up to 0.7 %
        shrink = np.cos(np.radians(lat)) * (1 + 0.00673949674 * np.cos(np.radians(lat)) ** 2)
        return np.asarray(np.degrees(np.arctan2((lon_on - lon) * shrink, lat_on - lat)) % 360.0, np.float64)


def _transformer(crs: CRS) -> Transformer:
    try:
        return Transformer.from_crs(crs, "OGC:CRS84", always_xy=True)
    except ProjError as error:
        raise InputError(f"no way from {crs.name} to WGS 84 ({error}).", where="geoReference", todo=_GIVE) from None


def read_georeference(
    header: Element | None, *, crs: str | None = None, origin: tuple[float, float] | None = None
) -> Georeference:
    """Return the georeference of a file.

    Parameters
    ----------
    header
        Its header; None when it has none.
    crs
        Projection to use instead of the file's, in any form that PROJ knows.
    origin
        Latitude and longitude, degrees, of x = 0, y = 0: the file's coordinates are east and north of it in metres.

    Raises
    ------
    InputError
        The file says no place that PROJ understands, and neither option was given; or it is a place by degrees.
    ConfigError
        Both options are given, or one is no projection or place.
    """
    if crs is not None and origin is not None:
        raise ConfigError("--crs and --origin contradict each other.", todo="Give one of them.")
    if origin is not None:
        return Georeference(_local_frame(origin))
    offset = _offset(header)
    if crs is not None:
        return Georeference(_checked(_parse_option(crs), "--crs"), *offset)
    element = header.find("geoReference") if header is not None else None
    text = "".join(element.itertext()).strip() if element is not None else ""
    if element is None or not text:
        where = place(header) if header is not None else ""
        raise InputError("the file does not say where on Earth it is: no geoReference.", where=where, todo=_GIVE)
    return Georeference(_parse(text, place(element)), *offset, is_from_file=True)


def _local_frame(origin: tuple[float, float]) -> EnuFrame:
    lat, lon = origin
    if not (abs(lat) <= 90 and abs(lon) <= 180):  # noqa: PLR2004 - degrees; also refuses NaN
        raise ConfigError(f"{lat}, {lon} is no latitude and longitude.", where="--origin", todo="Give LAT,LON.")
    return EnuFrame(lon, lat)


def _parse_option(crs: str) -> CRS:
    try:
        return CRS.from_user_input(crs)
    except CRSError:
        raise ConfigError(f"{crs!r} is no coordinate system.", where="--crs", todo="Give e.g. EPSG:25832.") from None


def _parse(text: str, where: str) -> CRS:
    """Return the CRS of a geoReference: a PROJ string, WKT, PROJ JSON or an authority's code."""
    shown = f"{text[:120]}…" if len(text) > 120 else text  # noqa: PLR2004 - enough to recognise it by
    old = _OLD_EPSG.search(text)
    if text.startswith("+") and not old and "+proj" not in text:
        raise InputError(
            f'geoReference "{shown}" is not a projection: it has no +proj=….',
            where=where,
            todo="Where it means a transverse Mercator projection (RoadRunner and CARLA leave that out), give --crs "
            f'"+proj=tmerc {text} +datum=WGS84". Otherwise: {_GIVE}',
        )
    try:
        crs = CRS.from_epsg(int(old[1])) if old else CRS.from_user_input(text)
    except (CRSError, ProjError, OverflowError, RecursionError) as error:
        reason = str(error).split(": (", maxsplit=1)[0][:160]
        raise InputError(f'geoReference "{shown}" is not understood ({reason}).', where=where, todo=_GIVE) from None
    return _checked(crs, where)


def _checked(crs: CRS, where: str) -> CRS:
    """Refuse what x and y in metres cannot be in."""
    if crs.is_geographic or crs.is_geocentric:
        raise InputError(
            f"coordinates of OpenDRIVE are metres east and north, but the geoReference ({crs.name}) is "
            f"{'geographic, in degrees' if crs.is_geographic else 'geocentric'}.",
            where=where,
            todo=_GIVE,
        )
    if not (crs.is_projected or crs.is_bound or crs.is_compound):
        raise InputError(f"{crs.name} is no projection of the Earth.", where=where, todo=_GIVE)
    return crs


def _offset(header: Element | None) -> tuple[float, float, float]:
    """Return x, y and heading of the header's `<offset>`, 0 without one."""
    element = header.find("offset") if header is not None else None
    if element is None:
        return 0.0, 0.0, 0.0
    return number(element, "x", 0.0), number(element, "y", 0.0), number(element, "hdg", 0.0)
