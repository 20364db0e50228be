"""Degrees as columns of text hold them: decimal, with minutes and seconds, with hemispheres, or as whole numbers."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from geofleet.formats.drive_times import numbers_of
from geofleet.formats.inventory_columns import angle

if TYPE_CHECKING:
    from collections.abc import Mapping

    import pandas as pd
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

_PAIR = (
    r"^(?:SRID=\d+;)?\s*(?P<point>POINT\s*Z?M?\s*)?[(\[]?\s*"
    r"([+-]?\d+(?:\.\d+)?)[,;\s]\s*([+-]?\d+(?:\.\d+)?)(?:\s[^)]*)?\s*[)\]]?$"
)
_LON_FIRST = re.compile(r"\s*(lon|lng)", re.IGNORECASE)
_SEMICIRCLE = re.compile(r"position_?(?:lat|lon)", re.IGNORECASE)
_MAX_LON_DEG, _MAX_LAT_DEG, _MINUTES = 180.0, 90.0, 60.0
_E7, _LEAST_E7 = 1e-7, 1e5
_HALF_CIRCLE = 1 << 31
MINUTES = "positions read as degrees and minutes, ddmm.mmmm (guessed)"
SCALED = {
    unit: f"positions read as whole numbers of {unit} (guessed), heights not taken"
    for unit in ("1e-7 degrees", "semicircles")
}


def degrees_of(frame: pd.DataFrame, columns: Mapping[str, str]) -> tuple[Floats, Floats, list[str]]:
    """Return x and y of columns in degrees, NaN where there are none, and what was made of them, for the user.

    Parameters
    ----------
    frame
        Columns of text.
    columns
        Thing to column: `x` and `y`, with the hemisphere in `x_side` and `y_side` or in the text; or `lat_lon`, a pair
        with the latitude first unless the name begins with the longitude, or a point in well-known text.
    """
    if "lat_lon" in columns:
        return *_pairs(frame[columns["lat_lon"]], columns["lat_lon"]), []
    x, y = (_angles(frame[columns[thing]]) for thing in ("x", "y"))
    told = []
    scale = _scale(x, y, columns["y"])
    if scale != 1.0:
        told.append(SCALED["1e-7 degrees" if scale == _E7 else "semicircles"])
        x, y = x * scale, y * scale
    elif _is_minutes(x, y, frame, columns):
        told.append(MINUTES)
        x, y = _of_minutes(x), _of_minutes(y)
    for thing, letters in (("x_side", "W"), ("y_side", "S")):
        if thing in columns:
            is_minus = frame[columns[thing]].str.strip().str.upper().str.startswith(letters).fillna(value=False)
            x, y = (
                np.where(is_minus, -np.abs(side), side) if thing.startswith(name) else side
                for name, side in (("x", x), ("y", y))
            )
    return x, y, told


def _pairs(text: pd.Series[str], name: str) -> tuple[Floats, Floats]:
    """Return x and y of `48.1, 11.5`, `(48.1, 11.5)` or `POINT (11.5 48.1)`."""
    parts = text.str.strip().str.extract(_PAIR, flags=re.IGNORECASE)
    first, second = numbers_of(parts[1]), numbers_of(parts[2])
    is_xy = parts["point"].notna().to_numpy(bool) | bool(_LON_FIRST.match(name))
    return np.where(is_xy, first, second), np.where(is_xy, second, first)


def _angles(text: pd.Series[str]) -> Floats:
    """Return a column as numbers; what is none as degrees, minutes and seconds."""
    found = numbers_of(text)
    lost = np.flatnonzero(np.isnan(found) & text.notna().to_numpy(bool))
    found[lost] = [angle(one) for one in text.iloc[lost]]
    return found


def _scale(x: Floats, y: Floats, name: str) -> float:
    """Return what whole numbers too large for degrees are counted in; 1 of others."""
    known = np.isfinite(x) & np.isfinite(y)
    both = np.concatenate((x[known], y[known]))
    if not len(both) or np.median(np.abs(y[known])) < _LEAST_E7 or (both != np.round(both)).any():
        return 1.0
    scale = _MAX_LON_DEG / _HALF_CIRCLE if _SEMICIRCLE.match(name) else _E7
    is_place = np.abs(x[known] * scale).max() <= _MAX_LON_DEG and np.abs(y[known] * scale).max() <= _MAX_LAT_DEG
    return scale if is_place else 1.0


def _is_minutes(x: Floats, y: Floats, frame: pd.DataFrame, columns: Mapping[str, str]) -> bool:
    """Tell whether numbers are degrees times 100 plus minutes, as NMEA writes them.

    Such are too large for degrees, or beside hemispheres as long as NMEA's: four figures and five.
    """
    known = np.isfinite(x) & np.isfinite(y)
    if not known.any():
        return False
    is_long = max(np.median(np.abs(x[known])), np.median(np.abs(y[known]))) > _MAX_LON_DEG  # no axes swapped
    if not is_long and {"x_side", "y_side"} <= columns.keys():
        text_x, text_y = (frame[columns[thing]][known].str.strip() for thing in ("x", "y"))
        is_long = text_x.str.match(r"\d{5}\.").all() and text_y.str.match(r"\d{4}\.").all()
    return bool(
        is_long
        and all(
            (np.abs(_of_minutes(side[known])) <= limit).all() and (np.abs(side[known]) % 100.0 < _MINUTES).all()
            for side, limit in ((x, _MAX_LON_DEG), (y, _MAX_LAT_DEG))
        )
    )


def _of_minutes(value: Floats) -> Floats:
    whole = np.floor(np.abs(value) / 100.0)
    return np.sign(value) * (whole + (np.abs(value) - 100.0 * whole) / _MINUTES)
