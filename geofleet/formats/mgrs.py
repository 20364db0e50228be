"""Squares of 100 km of the Military Grid Reference System, as UTM coordinates of their south-west corners.

After NGA.STND.0037, Universal Grids and the Transverse Mercator and Polar Stereographic Map Projections.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

_CODE = re.compile(r"(\d{1,2})\s*([C-HJ-NP-X])\s*([A-HJ-NP-Z])([A-HJ-NP-V])(?:[\d\s]|$)", re.IGNORECASE)
_SIDE_M, _ZONES = 100_000.0, 60
_BANDS = "CDEFGHJKLMNPQRSTUVWX"  # from south to north, 8 degrees each, X 12
# Northing, in squares, of the southernmost square of each band, and of what lies north of X (and of M: the equator).
_LOWEST = (11, 20, 28, 37, 46, 55, 64, 73, 82, 91, 0, 8, 17, 26, 35, 44, 53, 62, 70, 79, 93)
_EQUATOR, _ROWS = 100, 20
_COLUMNS = ("STUVWXYZ", "ABCDEFGH", "JKLMNPQR")  # by zone modulo 3; the first begins at 100 km
_ROW_LETTERS, _EVEN_ZONES_BEGIN = "ABCDEFGHJKLMNPQRSTUV", 5  # there the equator is at F


@dataclass(frozen=True, slots=True)
class Square:
    """A square of 100 km: its name, the EPSG code of its UTM zone, easting and northing of its corner."""

    name: str
    crs: str
    easting_m: float
    northing_m: float


def square_of(code: str) -> Square | None:
    """Return the square that a grid reference such as `54SUE815501` lies in; None when there is no such square.

    The digits, which say where in the square, are not looked at. Polar references (UPS) have no zone and give None.
    """
    match = _CODE.match(code.strip())
    if not match or not 1 <= int(match[1]) <= _ZONES:
        return None
    zone = int(match[1])
    band, column, row = (letter.upper() for letter in match.groups()[1:])
    number = _BANDS.index(band)
    lowest, beyond = _LOWEST[number], _LOWEST[number + 1] or _EQUATOR
    first = _ROW_LETTERS.index(row) - (0 if zone % 2 else _EVEN_ZONES_BEGIN)
    northing = lowest + (first - lowest) % _ROWS  # row letters come again after 2,000 km
    # Beside the central meridian a parallel bends towards the pole, in the wide zone 32V into the next row.
    if column not in _COLUMNS[zone % 3] or northing > beyond + 1:
        return None
    easting = _COLUMNS[zone % 3].index(column) + 1
    epsg = (32600 if band >= "N" else 32700) + zone
    return Square(f"{zone:02d}{band}{column}{row}", f"EPSG:{epsg}", easting * _SIDE_M, northing * _SIDE_M)
