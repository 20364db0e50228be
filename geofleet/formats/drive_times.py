"""Times of a trajectory in columns: dates, counts since 1970, 1980 or 1899, or since the start; or none but speeds."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import pyarrow as pa
from pyproj import Geod

from geofleet.formats.drive_dates import CLOCK, COMPACT, COMPACT_CLOCK, EXCEL_DAYS, clock_seconds, parse_dates
from geofleet.formats.gnss_time import GPS_EPOCH, LONGEST_S, gpst_to_utc, microseconds
from geofleet.formats.inventory_columns import parse_numbers

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Times = NDArray[np.datetime64]

_UNIX = {"unix_s": 1.0, "unix_ms": 1e-3, "unix_us": 1e-6, "unix_ns": 1e-9}
_GPS = {"gps_s": 1.0, "gps_ms": 1e-3}
_RELATIVE = {"relative_s": 1.0, "relative_ms": 1e-3, "relative_us": 1e-6, "relative_ns": 1e-9}
RELATIVE_S, EXCEL, CLOCK_TIME = "relative_s", "excel_days", "clock"
TIME_FORMATS = ("iso", *_UNIX, *_GPS, EXCEL, CLOCK_TIME, *_RELATIVE, "velocity")
_UNIX_EPOCH = np.datetime64("1970-01-01", "us")
_EXCEL_EPOCH = np.datetime64("1899-12-30", "us")
_DAY_S, _HALF_DAY_S = 86_400.0, 43_200.0
_DAYS_APART = 0.01  # of two epochs of a drive: a quarter of an hour; as seconds, a hundred a second
_N_LOOKED_AT = 1000
_SLOWEST_MPS = 0.1  # a speed of zero between two places would take for ever
_LEAST_COUNT = {"unix_ns": 1e17, "unix_us": 1e14, "unix_ms": 1e11, "unix_s": 1e8}
_UNIT = re.compile(
    r"(?:[\W_]|time|stamp)(ms|msec|millis|milliseconds|us|µs|usec|micros|ns|nsec|nanos)[)\]]?$", re.IGNORECASE
)
_NO_CAR_MPS, _SLOW_CAR_MPS, _FAST_CAR_MPS, _MOVES_M = 0.05, 0.5, 80.0, 0.2


def numbers_of(text: pd.Series[str]) -> Floats:
    """Return texts as finite numbers, NaN where one is none; a comma may be the decimal point."""
    values = pd.to_numeric(text.str.strip(), errors="coerce").to_numpy(np.float64, na_value=np.nan)
    if np.isnan(values).any() and text.str.contains(",", na=False).any():
        values = parse_numbers(pa.array(text, pa.string(), from_pandas=True))
    return np.where(np.isfinite(values), values, np.nan)


def guess_format(text: pd.Series[str], name: str = "") -> str:
    """Return the format of a column of times by the size and steps of its numbers; what is no number is a date.

    `name` is that of the column, which may end in a unit.
    """
    number = numbers_of(text)
    if not len(number) or np.isnan(number).sum() * 2 > len(number):
        return CLOCK_TIME if _mostly(text, CLOCK) else "iso"
    if _mostly(text, COMPACT):
        return "iso"
    middle = float(np.nanmedian(np.abs(number)))
    step = np.diff(number[~np.isnan(number)])
    is_close = bool((step > 0).any()) and float(np.median(step[step > 0])) < _DAYS_APART
    if is_close and EXCEL_DAYS[0] <= middle < EXCEL_DAYS[1]:
        return EXCEL
    if _mostly(text, COMPACT_CLOCK) and not np.isnan(clock_seconds(text[text.notna()])).any():
        return CLOCK_TIME
    unit = _UNIT.search(name)
    relative = "relative_" + (unit[1][0].lower().replace("µ", "u") + "s" if unit else "s")
    return next((name for name, least in _LEAST_COUNT.items() if middle >= least), relative)


def times_of(text: pd.Series[str], time_format: str, *, day_first: bool | None = None) -> tuple[Times, Floats | None]:
    """Return UTC of a column of times, NaT where it is none; or seconds, where it does not say since when.

    Dates are those of `drive_dates.parse_dates`.
    """
    if time_format == "iso":
        return parse_dates(text, day_first=day_first), None
    nothing = np.full(len(text), "NaT", "datetime64[us]")
    if time_format == CLOCK_TIME:
        return nothing, _past_midnight(clock_seconds(text))
    number = numbers_of(text)
    if time_format in _GPS:
        return gpst_to_utc(GPS_EPOCH + microseconds(number * _GPS[time_format])), None
    if time_format in _UNIX:
        return np.asarray(_UNIX_EPOCH + microseconds(number * _UNIX[time_format])), None
    if time_format == EXCEL:
        return np.asarray(_EXCEL_EPOCH + microseconds(number * _DAY_S)), None
    seconds = number * _RELATIVE.get(time_format, 1.0)
    return nothing, np.where(np.abs(seconds) < LONGEST_S, seconds, np.nan)


def unit_by_speed(seconds: Floats, lon: Floats, lat: Floats) -> str:
    """Return the format of counts since some moment whose unit nobody states: seconds, unless no car is so slow."""
    known = np.isfinite(seconds) & np.isfinite(lon) & np.isfinite(lat)
    _, _, step_m = Geod(ellps="WGS84").inv(lon[known][:-1], lat[known][:-1], lon[known][1:], lat[known][1:])
    step, step_m = np.diff(seconds[known]), np.asarray(step_m)
    moves = (step > 0) & (step_m > _MOVES_M)
    if not moves.any():
        return RELATIVE_S
    speed = float(np.median(step_m[moves] / step[moves]))
    if speed >= _NO_CAR_MPS:
        return RELATIVE_S
    able = (name for name, unit in _RELATIVE.items() if _SLOW_CAR_MPS <= speed / unit <= _FAST_CAR_MPS)
    return next(able, RELATIVE_S)


def times_of_velocity(lon: Floats, lat: Floats, speed_mps: Floats) -> Floats:
    """Return seconds since the first epoch of a drive of which only places and speeds are known.

    From one epoch to the next it takes the distance over the mean of both speeds, of which none counts as less than
    0.1 m/s.
    """
    known = np.isfinite(lon) & np.isfinite(lat) & np.isfinite(speed_mps)
    elapsed = np.full(len(lon), np.nan)
    if not known.any():
        return elapsed
    speed = np.maximum(np.abs(speed_mps[known]), _SLOWEST_MPS)
    _, _, step_m = Geod(ellps="WGS84").inv(lon[known][:-1], lat[known][:-1], lon[known][1:], lat[known][1:])
    elapsed[known] = np.concatenate(([0.0], np.cumsum(np.asarray(step_m) / ((speed[:-1] + speed[1:]) / 2.0))))
    return elapsed


def _mostly(text: pd.Series[str], pattern: str) -> bool:
    """Tell whether more than half of the texts that are there, of many some, fit a pattern."""
    there = text.dropna()
    there = there.iloc[:: len(there) // _N_LOOKED_AT + 1].str.strip()
    return len(there) > 0 and 2 * int(there.str.fullmatch(pattern).sum()) > len(there)


def _past_midnight(second: Floats) -> Floats:
    """Return seconds of the day as ones that go on after midnight."""
    known = ~np.isnan(second)
    step = np.diff(second[known], prepend=second[known][:1])
    onward = second.copy()
    onward[known] += _DAY_S * np.cumsum((step < -_HALF_DAY_S).astype(np.int64) - (step > _HALF_DAY_S))
    return onward
