"""Times of a trajectory in columns: dates, counts since 1970 or 1980, seconds since the start, or none but speeds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from pyproj import Geod

from geofleet.formats.gnss_time import GPS_EPOCH, gpst_to_utc, microseconds

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


def guess_format(text: pd.Series[str]) -> str:
    """Return the format of a column of times by the size of its numbers; text that is no number is a date."""
    number = pd.to_numeric(text, errors="coerce")
    if number.isna().sum() * 2 > len(number):
        return "iso"
    middle = float(number.abs().median())
    return next((name for name, least in _LEAST_COUNT.items() if middle >= least), "relative_s")


def times_of(text: pd.Series[str], time_format: str) -> tuple[Times, Floats | None]:
    """Return UTC of a column of times, NaT where it is none; or seconds, where it does not say since when."""
    if time_format == "iso":
        parsed = pd.to_datetime(text.str.strip(), format="ISO8601", utc=True, errors="coerce")
        return parsed.dt.tz_localize(None).to_numpy("datetime64[us]"), None
    number = pd.to_numeric(text.str.strip(), errors="coerce").to_numpy(np.float64)
    number = np.where(np.isfinite(number), number, np.nan)
    if time_format in _GPS:
        return gpst_to_utc(GPS_EPOCH + microseconds(number * _GPS[time_format])), None
    if time_format in _UNIX:
        return np.asarray(_UNIX_EPOCH + microseconds(number * _UNIX[time_format])), None
    return np.full(len(number), "NaT", "datetime64[us]"), number


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
