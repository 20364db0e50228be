"""Where the nodes of a Lanelet2 map lie: local coordinates, from a given origin or in the squares of MGRS, to degrees.

Autoware's editors write `local_x` and `local_y`, metres from the corner of the square of 100 km that `mgrs_code` names,
beside `lat` and `lon` or in their place.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.errors import ConfigError, InputError
from geofleet.formats.mgrs import square_of
from geofleet.formats.positions import utm_around
from geofleet.formats.reading import WGS84, Datum

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from geofleet.formats.mgrs import Square

    Floats = NDArray[np.float64]

_NAMED_SQUARES = 4


@dataclass(frozen=True, slots=True)
class Projection:
    """Where local coordinates lie: a projected CRS, easting and northing of their zero."""

    crs: str
    easting_m: float
    northing_m: float

    @classmethod
    def of(cls, origin: tuple[float, float] | None, utm: tuple[str, float, float] | None) -> Projection | None:
        """Check what the caller gave.

        Raises
        ------
        ConfigError
            `origin` and `utm` are both given, or one of them makes no sense.
        """
        if origin is not None and utm is not None:
            raise ConfigError("origin and utm say the same thing in two ways.", todo="Give one of them.")
        if origin is not None:
            return cls(*utm_around(*origin))
        return None if utm is None else cls._named(*utm)

    @classmethod
    def _named(cls, crs: str, easting_m: float, northing_m: float) -> Projection:
        from pyproj import CRS  # noqa: PLC0415  (as above)
        from pyproj.exceptions import CRSError  # noqa: PLC0415

        try:
            known = CRS.from_user_input(crs)
        except CRSError:
            raise ConfigError(f"unknown CRS {crs!r}.", todo="Give one such as EPSG:32633.") from None
        if not known.is_projected:
            raise ConfigError(f"{crs} is not projected.", todo="Give a CRS in metres, such as EPSG:32633.")
        return cls(crs, float(easting_m), float(northing_m))

    def to_lonlat(self, x_m: Floats, y_m: Floats) -> tuple[Floats, Floats]:
        """Return longitude and latitude in degrees; NaN stays NaN and so does what lies outside of the CRS."""
        from pyproj import Transformer  # noqa: PLC0415  (as above)

        transformer = Transformer.from_crs(self.crs, "OGC:CRS84", always_xy=True)
        lon, lat = transformer.transform(x_m + self.easting_m, y_m + self.northing_m)
        return np.where(np.isfinite(lon), lon, np.nan), np.where(np.isfinite(lat), lat, np.nan)


@dataclass(frozen=True, slots=True)
class Placed:
    """Positions in degrees, NaN where there is none, how many MGRS gave, and what they were in."""

    lon: Floats
    lat: Floats
    n_by_square: int = 0
    datum: Datum = WGS84


def placed_by_squares(lon: Floats, lat: Floats, x_m: Floats, y_m: Floats, codes: Sequence[str]) -> Placed:
    """Give nodes without a position of their own that of `local_x`, `local_y` in the square that `mgrs_code` names.

    Nodes that name no square are in that of all others, where they are in one.

    Parameters
    ----------
    lon, lat
        Degrees, shape (n,), NaN where a node has none. When they are the same at every node, they are placeholders.
    x_m, y_m
        Local coordinates, shape (n,), NaN where a node has none.
    codes
        `mgrs_code` of every node, "" where it has none.

    Raises
    ------
    InputError
        Positions are local only, and nobody says where they count from.
    """
    without = np.isnan(lon) | np.isnan(lat)
    if np.isnan(x_m).all() or not (_are_placeholders(lon, lat) or without.any()):
        return Placed(lon, lat)
    if _are_placeholders(lon, lat):
        without[:] = True
    squares = {code: square_of(code) for code in sorted(set(codes))}
    known = list(dict.fromkeys(square for square in squares.values() if square))
    if not known:
        if without.all():
            raise InputError(
                "positions are in local_x and local_y only; lat and lon are missing or all the same, and no node has "
                f"an mgrs_code of MGRS{_example(codes)}.",
                todo="Say where they count from: --origin LAT,LON or --utm EPSG:32633,E0,N0.",
            )
        return Placed(lon, lat)
    lon, lat = (np.where(without, np.nan, side) for side in (lon, lat))
    place = {code: known.index(square) for code, square in squares.items() if square}
    nowhere = 0 if len(known) == 1 else -1
    number = np.array([place.get(code, nowhere) for code in codes], np.int64)
    number[~without | np.isnan(x_m) | np.isnan(y_m)] = -1
    for one, square in enumerate(known):
        rows = np.flatnonzero(number == one)
        lon[rows], lat[rows] = _in_square(square).to_lonlat(x_m[rows], y_m[rows])
    names = sorted(known[one].name for one in set(number[number >= 0].tolist()))
    more = f" and {len(names) - _NAMED_SQUARES} more" if len(names) > _NAMED_SQUARES else ""
    title = f"MGRS, square {', '.join(names[:_NAMED_SQUARES])}{more}"
    return Placed(lon, lat, int((number >= 0).sum()), Datum(title, "projection only (UTM)", 0.0))


def _in_square(square: Square) -> Projection:
    return Projection(square.crs, square.easting_m, square.northing_m)


def _example(codes: Sequence[str]) -> str:
    """Return the commonest of some codes that name no square, for a message."""
    said = Counter(code[:20] for code in codes if code).most_common(1)
    return f" ({said[0][0]!r} is none)" if said else ""


def _are_placeholders(lon: Floats, lat: Floats) -> bool:
    """Tell whether lat and lon are missing, or the same at every node."""
    no_place = bool(np.isnan(lon).all() or np.isnan(lat).all())
    return no_place or (len(lon) > 1 and np.ptp(lon) == 0.0 and np.ptp(lat) == 0.0)
