"""Dates as loggers, phones and spreadsheets write them, rewritten as ISO 8601 where there is one way to read them."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
import pyarrow as pa

from geofleet.formats.inventory_columns import parse_times

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Times = NDArray[np.datetime64]

CLOCK = r"\d{1,2}:\d{2}(?::\d{1,2}(?:[.,]\d*)?)?(?: ?[AaPp]\.?[Mm]\.?)?"
COMPACT_CLOCK = r"\d{6}(?:\.\d*)?"
COMPACT = r"(?:19|20)\d{12}(?:\d{3}|\.\d*)?"
_NAMED_UTC = r"(?<=\d)\s*(?:UTC|GMT)$"
_ZONE = r"(?:Z|[+-]\d{2}(?::?\d{2})?|UTC|GMT)\s*$"
_WRITTEN_OUT = r"[A-Za-z]{3}"
_OFFSET = r"(?:\s*(?P<zone>Z|(?:UTC|GMT)?[+-]\d{2}:?\d{2}|UTC|GMT))?"
EXCEL_DAYS = (29_221.0, 73_050.0)  # 1980 to 2099
_HAS_CLOCK = r"\d[ T]\d{1,2}:\d{2}"
_DAY_S = 86_400.0
_MONTHS = {
    name: f"{number:02d}"
    for number, names in enumerate(
        (
            *("jan", "feb", "mar mär mrz maa", "apr avr", "may mai mei", "jun"),
            *("jul", "aug", "sep", "oct okt", "nov", "dec dez déc"),
        ),
        start=1,
    )
    for name in names.split()
}
_WEEKDAY = r"(?i)^(?:(?:mon|tue|wed|thu|fri|sat|sun)[a-z]*|mo|di|mi|do|fr|sa|so)\.?,? "
_MONTH = r"(?P<month>[A-Za-zäé]{3})[a-zäéû]*\.?"
# 21-Mar-2019 14:05:06.123; Mar 21, 2019 2:05:06 PM; Mar 21 14:05:06 GMT+01:00 2019
_WRITTEN = (
    rf"(?P<day>\d{{1,2}})[- ]{_MONTH}[- ](?P<year>\d{{4}}),?[ T](?P<clock>{CLOCK}){_OFFSET}",
    rf"{_MONTH} (?P<day>\d{{1,2}}),? (?P<year>\d{{4}}),? (?P<clock>{CLOCK}){_OFFSET}",
    rf"{_MONTH} (?P<day>\d{{1,2}}) (?P<clock>{CLOCK}){_OFFSET} (?P<year>\d{{4}})",
)
_HALF_DAY = re.compile(r"\b(\d{1,2})(:\d{2}(?::\d{2}(?:\.\d*)?)?) ?([AaPp])\.?[Mm]\.?")


def parse_dates(text: pd.Series[str], *, day_first: bool | None = None) -> Times:
    """Return dates as UTC, NaT where one is none or could be two; without a zone they are UTC.

    ISO 8601, `20240321130506`, months by name, either half of the day, or day, month and year in another order where
    it is clear.
    """
    plain = text.str.strip().str.replace(_NAMED_UTC, "Z", regex=True)
    t_utc = _iso(plain)
    lost = np.isnat(t_utc) & plain.notna().to_numpy(bool)
    if lost.any():
        rest = _rewritten(plain[lost])
        found = _iso(rest)
        still = np.isnat(found)
        if still.any():
            read, _ = parse_times(pa.chunked_array([pa.array(rest[still], pa.string())]), day_first=day_first)
            found[still] = np.array([None if t is None else t.replace(tzinfo=None) for t in read], "datetime64[us]")
        t_utc[lost] = found
    return t_utc


def n_without_zone(text: pd.Series[str]) -> int:
    """Return how many dates of a column do not say in which time zone they are."""
    plain = text.dropna()
    bare = plain[~plain.str.contains(_ZONE, regex=True)]
    is_written = bare.str.contains(_WRITTEN_OUT, regex=True)  # 14:05:06 GMT+01:00 2019
    return int((~is_written).sum()) + int((~_rewritten(bare[is_written]).str.contains(_ZONE, regex=True)).sum())


def clock_seconds(text: pd.Series[str]) -> NDArray[np.float64]:
    """Return `13:05:06.2` or `130506.2` as seconds of the day, NaN where a text is no time of day."""
    plain = text.str.strip().str.replace(",", ".", regex=False).str.replace(_HALF_DAY, _of_day, regex=True)
    plain = plain.str.replace(r"^(\d{2})(\d{2})(\d{2}(?:\.\d*)?)$", r"\1:\2:\3", regex=True)
    parts = plain.str.extract(r"^(\d{1,2}):(\d{2})(?::(\d{1,2}(?:\.\d*)?))?$")
    hours, minutes, seconds = (pd.to_numeric(parts[i], errors="coerce").to_numpy(np.float64) for i in range(3))
    seconds = np.where(np.isnan(seconds) & ~np.isnan(minutes), 0.0, seconds)
    with np.errstate(invalid="ignore"):
        valid = (hours < 24) & (minutes < 60) & (seconds < 61)  # noqa: PLR2004  (the clock; 60 is a leap second)
    return np.where(valid, hours * 3600.0 + minutes * 60.0 + seconds, np.nan)


def dated(
    date: pd.Series[str], time: pd.Series[str], *, day_first: bool | None
) -> tuple[pd.Series[str], dict[str, int]]:
    """Return times of the day with the dates of another column before them, and what to tell.

    Dates are texts, `20240321`, `210324` (which only `day_first` tells from `240321`) or a spreadsheet's days; times
    are `13:05:06`, `130506.2` or a fraction of a day. Times that hold more than a time of the day stay as they are, and
    dates that hold it stand alone.
    """
    if bool(date.str.contains(_HAS_CLOCK, na=True, regex=True).all()):
        return date, {}
    clock = time.where(time.str.fullmatch(CLOCK), time.str.replace(r"^(\d{5})(?=\.|$)", r"0\1", regex=True))
    fraction = pd.to_numeric(time.str.replace(",", ".", regex=False), errors="coerce")
    if bool((fraction < 1).all()):
        clock = _clocks(fraction.to_numpy(np.float64) * _DAY_S)
    is_clock = clock.isna() | ~np.isnan(clock_seconds(clock.fillna("")))
    if not is_clock.all():
        return time, {}
    days = pd.to_numeric(date, errors="coerce").to_numpy(np.float64, na_value=np.nan)
    if ((days >= EXCEL_DAYS[0]) & (days < EXCEL_DAYS[1]) & date.str.len().lt(len("210324"))).all():
        whole = np.datetime64("1899-12-30", "D") + np.floor(days).astype("timedelta64[D]")
        date = pd.Series(np.datetime_as_string(whole), index=date.index, dtype="string")
    date = date.str.replace(r"^((?:19|20)\d{2})(\d{2})(\d{2})$", r"\1-\2-\3", regex=True)
    is_short = date.str.fullmatch(r"\d{5,6}").fillna(value=False)
    if is_short.any() and day_first is None:
        return clock, {
            "times of the day only: of six figures of a date the day or the year may be first "
            "(say day_first in a TOML file)": len(time)
        }
    order = r"20\3-\2-\1" if day_first else r"20\1-\2-\3"
    date = date.where(~is_short, date.str.zfill(6).str.replace(r"^(\d{2})(\d{2})(\d{2})$", order, regex=True))
    colons = clock.str.replace(r"^(\d{2})(\d{2})(\d{2}(?:\.\d*)?)$", r"\1:\2:\3", regex=True)
    return date + " " + colons, {}


def _clocks(second: NDArray[np.float64]) -> pd.Series[str]:
    """Return seconds of the day as `13:05:06.200000`."""
    known = np.nan_to_num(second)
    times = np.datetime64("1970-01-01", "us") + np.round(known * 1e6).astype("timedelta64[us]")
    return pd.Series(pd.to_datetime(times).strftime("%H:%M:%S.%f"), dtype="string")


def _iso(text: pd.Series[str]) -> Times:
    parsed = pd.to_datetime(text, format="ISO8601", utc=True, errors="coerce")
    return parsed.dt.tz_localize(None).to_numpy("datetime64[us]").copy()


def _rewritten(text: pd.Series[str]) -> pd.Series[str]:
    """Return texts with what is not ISO 8601 but has one meaning rewritten as such; others as they are."""
    plain = text.str.strip().str.replace(r"\s+", " ", regex=True).str.replace(r"(:\d{2}),(\d+)", r"\1.\2", regex=True)
    plain = plain.str.replace(r"^(\d{4}):(\d{2}):(\d{2}) ", r"\1-\2-\3 ", regex=True)  # EXIF
    plain = plain.str.replace(r"^(\d{4})(\d{2})(\d{2})(\d{2})(\d{2})(\d{2})(?:\.(\d*)|(\d{3}))?$", _compact, regex=True)
    plain = plain.str.replace(_WEEKDAY, "", regex=True)
    for pattern in _WRITTEN:
        plain = plain.str.replace(rf"^{pattern}$", _by_month, regex=True)
    return plain.str.replace(_HALF_DAY, _of_day, regex=True)


def _compact(match: re.Match[str]) -> str:
    year, month, day, hour, minute, second, fraction, millis = match.groups()
    return f"{year}-{month}-{day} {hour}:{minute}:{second}.{fraction or millis or 0}"


def _by_month(match: re.Match[str]) -> str:
    """Return a date with the name of its month in ISO 8601; as it is when there is no such month."""
    number = _MONTHS.get(match["month"].lower())
    if number is None:
        return match[0]
    clock = _HALF_DAY.sub(_of_day, match["clock"])
    zone = re.sub(r"^(?:UTC|GMT)(?=.)", "", match["zone"] or "").replace("UTC", "Z").replace("GMT", "Z")
    return f"{match['year']}-{number}-{int(match['day']):02d} {clock if clock[1:2] != ':' else '0' + clock}{zone}"


def _of_day(match: re.Match[str]) -> str:
    """Return a time of either half of the day as one of 24 hours; as it is when the half has no such hour."""
    hour = int(match[1])
    if not 1 <= hour <= 12:  # noqa: PLR2004  (of half a day)
        return match[0]
    return f"{hour % 12 + (12 if match[3] in 'Pp' else 0):02d}{match[2]}"
