"""Times of a trajectory in columns: dates, counts since 1970 or 1980, seconds since the start, or none but speeds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import pyarrow as pa
from pyproj import Geod

from geofleet.formats.gnss_time import GPS_EPOCH, gpst_to_utc, microseconds
from geofleet.formats.inventory_columns import parse_numbers, parse_times

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Times = NDArray[np.datetime64]

_UNIX = {"unix_s": 1.0, "unix_ms": 1e-3, "unix_us": 1e-6, "unix_ns": 1e-9}
_GPS = {"gps_s": 1.0, "gps_ms": 1e-3}
TIME_FORMATS = ("iso", *_UNIX, *_GPS, "relative_s", "velocity")
_UNIX_EPOCH = np.datetime64("1970-01-01", "us")
_SLOWEST_MPS = 0.1  # a speed of zero between two places would take for ever
_LEAST_COUNT = {"unix_ns": 1e17, "unix_us": 1e14, "unix_ms": 1e11, "unix_s": 1e8}


_NAMED_UTC = r"(?<=\d)\s*(?:UTC|GMT)$"
_ZONE = r"(?:Z|[+-]\d{2}(?::?\d{2})?|UTC|GMT)\s*$"


def numbers_of(text: pd.Series[str]) -> Floats:
    """Return texts as finite numbers, NaN where one is none; a comma may be the decimal point."""
    values = pd.to_numeric(text.str.strip(), errors="coerce").to_numpy(np.float64, na_value=np.nan)
    if np.isnan(values).any() and text.str.contains(",", na=False).any():
        values = parse_numbers(pa.array(text, pa.string(), from_pandas=True))
    return np.where(np.isfinite(values), values, np.nan)


def guess_format(text: pd.Series[str]) -> str:
    """Return the format of a column of times by the size of its numbers; text that is no number is a date."""
    number = numbers_of(text)
    if not len(number) or np.isnan(number).sum() * 2 > len(number):
        return "iso"
    middle = float(np.nanmedian(np.abs(number)))
    return next((name for name, least in _LEAST_COUNT.items() if middle >= least), "relative_s")


def times_of(text: pd.Series[str], time_format: str, *, day_first: bool | None = None) -> tuple[Times, Floats | None]:
    """Return UTC of a column of times, NaT where it is none; or seconds, where it does not say since when.

    Dates are in ISO 8601, or have day, month and year in another order where it is clear; without a zone they are UTC.
    """
    if time_format == "iso":
        return _dates(text.str.strip().str.replace(_NAMED_UTC, "Z", regex=True), day_first=day_first), None
    number = numbers_of(text)
    if time_format in _GPS:
        return gpst_to_utc(GPS_EPOCH + microseconds(number * _GPS[time_format])), None
    if time_format in _UNIX:
        return np.asarray(_UNIX_EPOCH + microseconds(number * _UNIX[time_format])), None
    return np.full(len(number), "NaT", "datetime64[us]"), number


def n_without_zone(text: pd.Series[str]) -> int:
    """Return how many dates of a column do not say in which time zone they are."""
    return int((text.notna() & ~text.str.contains(_ZONE, na=True, regex=True)).sum())


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


def _dates(text: pd.Series[str], *, day_first: bool | None) -> Times:
    """Return dates as UTC; those that are not ISO 8601 are looked at one by one."""
    parsed = pd.to_datetime(text, format="ISO8601", utc=True, errors="coerce")
    t_utc = parsed.dt.tz_localize(None).to_numpy("datetime64[us]").copy()
    lost = np.isnat(t_utc) & text.notna().to_numpy(bool)
    if lost.any():
        rest = pa.chunked_array([pa.array(text[lost], pa.string(), from_pandas=True)])
        read, _ = parse_times(rest, day_first=day_first)
        t_utc[lost] = np.array([None if t is None else t.replace(tzinfo=None) for t in read], "datetime64[us]")
    return t_utc
