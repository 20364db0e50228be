"""GPS time and UTC: weeks and their rollover, leap seconds."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Times = NDArray[np.datetime64]

GPS_EPOCH = np.datetime64("1980-01-06", "us")
WEEK_S = 604_800.0
ROLLOVER_WEEKS = 1024
_RECENT_WEEKS = 2048  # the count of ten bits began again on 2019-04-07
LONGEST_S = 1e11  # three thousand years; what is longer is no time

# Days on which GPS time came to be one more second ahead of UTC (IERS Bulletin C)
LEAP_DAYS = np.array(
    [
        *("1981-07-01", "1982-07-01", "1983-07-01", "1985-07-01", "1988-01-01", "1990-01-01", "1991-01-01"),
        *("1992-07-01", "1993-07-01", "1994-07-01", "1996-01-01", "1997-07-01", "1999-01-01", "2006-01-01"),
        *("2009-01-01", "2012-07-01", "2015-07-01", "2017-01-01"),
    ],
    "datetime64[us]",
)
_LEAPS_IN_GPST = LEAP_DAYS + np.arange(1, len(LEAP_DAYS) + 1).astype("timedelta64[s]")


def gpst_to_utc(t_gpst: NDArray[np.datetime64]) -> NDArray[np.datetime64]:
    """Take the leap seconds of its day off each GPS time."""
    leaps = np.searchsorted(_LEAPS_IN_GPST, t_gpst, side="right")
    return np.asarray(t_gpst - leaps.astype("timedelta64[s]"))


def gps_week_time(week: Floats, of_week_s: Floats, *, near: np.datetime64 | None = None) -> Times:
    """Return the GPS time of weeks and seconds of the week, NaT where either is NaN.

    Weeks of ten bits are completed: to the date nearest to `near`, else to the time since 2019.
    """
    with np.errstate(over="ignore"):  # of a number that is no week
        whole_s = (week + _rollovers(week, near) * ROLLOVER_WEEKS) * WEEK_S
    return np.asarray(GPS_EPOCH + microseconds(whole_s) + microseconds(of_week_s))


def microseconds(seconds: Floats) -> NDArray[np.timedelta64]:
    """Return seconds as microseconds, NaT where they are NaN or beyond any clock."""
    usable = np.abs(seconds) < LONGEST_S
    span = np.round(np.where(usable, seconds, 0.0) * 1e6).astype("timedelta64[us]")
    return np.where(usable, span, np.timedelta64("NaT", "us"))


def _rollovers(week: Floats, near: np.datetime64 | None) -> Floats:
    """Return how often ten bits of week count began again."""
    if not np.nanmin(week, initial=np.inf) < ROLLOVER_WEEKS:
        return np.zeros(len(week))
    known = _RECENT_WEEKS if near is None else (near - GPS_EPOCH) / np.timedelta64(7, "D")
    return np.where(week < ROLLOVER_WEEKS, np.floor((known - week) / ROLLOVER_WEEKS + 0.5), 0.0)
