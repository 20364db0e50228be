"""RTKLIB solution files (`.pos`): header, time, position and quality of every epoch.

The format as `solution.c` of RTKLIB 2.4.3 writes it (https://github.com/tomojitakasu/RTKLIB): times as date and time
or as GPS week and time of week, in GPST, UTC or JST; positions in decimal degrees or in degrees, minutes and seconds;
15 columns, or 24 and more with velocities; separators blank, comma or semicolon. Baseline (e/n/u) solutions are
refused.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from geofleet.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

QUALITY = {1: "fixed", 2: "float", 3: "sbas", 4: "dgps", 5: "single", 6: "ppp"}
DERIVED = "derived"
GPS_EPOCH = np.datetime64("1980-01-06", "us")
WEEK_S = 604_800.0
ROLLOVER_WEEKS = 1024
_RECENT_WEEKS = 2048  # the count of ten bits began again on 2019-04-07
_JST_S = 9 * 3600.0
_LONGEST_S = 1e11  # three thousand years; what is longer is no time
_N_COLUMNS = 32
_MAX_LAT, _MAX_LON = 90.0, 180.0

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

_DATED = re.compile(rb"\s*\d{4}/\d{1,2}/\d{1,2}[\s,;]+\d{1,2}:\d{2}:\d")
_WEEKLY = re.compile(rb"\s*\d{1,4}[\s,;]+\d{1,6}\.\d+[\s,;]+-?\d{1,3}\.\d+[\s,;]+-?\d{1,3}\.\d+[\s,;]")
_HEADER_MARKS = (b"RTKLIB", b"RTKPOST", b"% program", b"Q=1:fix", b"latitude", b"-ecef(m)", b"-baseline(m)")
_HEADER_DATE = re.compile(r"(?:obs|sol) start\s*:\s*(\d{4}/\d{2}/\d{2})")


@dataclass(frozen=True, slots=True)
class Epochs:
    """Epochs of a solution, all of shape (n,): UTC in microseconds, degrees, metres, name of the quality.

    Standard deviations and heights that the file does not declare are NaN.
    """

    t_utc: NDArray[np.datetime64]
    lon: Floats
    lat: Floats
    height_m: Floats
    quality: NDArray[np.object_]
    sigma_e_m: Floats
    sigma_n_m: Floats

    def take(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Epochs:
        """Return some of the epochs."""
        return Epochs(
            self.t_utc[rows],
            self.lon[rows],
            self.lat[rows],
            self.height_m[rows],
            self.quality[rows],
            self.sigma_e_m[rows],
            self.sigma_n_m[rows],
        )

    def seconds(self) -> Floats:
        """Return seconds since the first epoch of the arrays."""
        return np.asarray((self.t_utc - self.t_utc[0]) / np.timedelta64(1, "s"), np.float64)


@dataclass(frozen=True, slots=True)
class _Header:
    """What the lines that begin with % say."""

    system: str
    is_baseline: bool
    is_ecef: bool
    is_sexagesimal: bool
    is_derived: bool
    start: np.datetime64 | None


def detect(head: bytes) -> bool:
    """Tell whether a file's first bytes are an RTKLIB solution's: its header, or epochs without one."""
    lines = head.split(b"\n")
    if any(line.startswith(b"%") for line in lines):
        return any(mark in head for mark in _HEADER_MARKS)
    first = next((line for line in lines if line.strip()), b"")
    return bool(_DATED.match(first) or _WEEKLY.match(first))


def read_epochs(path: Path) -> tuple[Epochs, dict[str, int]]:
    """Read every epoch of a solution, in the order of the file.

    Returns
    -------
    tuple
        The epochs with a time and a position, and the number of lines left out by reason.

    Raises
    ------
    InputError
        The solution is a baseline or Earth-centred, or holds no epoch with a position.
    """
    text = path.read_bytes().decode("utf-8", errors="replace")
    header = _header([line for line in text.splitlines() if line.startswith("%")])
    _refuse(header, path)
    frame, n_lines = _columns(text)
    n_time = 2
    t_utc = _times(frame, header)
    if header.is_sexagesimal:
        lat, lon = _sexagesimal(frame, n_time), _sexagesimal(frame, n_time + 3)
        rest = n_time + 6
    else:
        lat, lon = _numbers(frame, n_time), _numbers(frame, n_time + 1)
        rest = n_time + 2
    epochs = Epochs(
        t_utc,
        lon,
        lat,
        _numbers(frame, rest),
        _qualities(_numbers(frame, rest + 1), header),
        _positive(_numbers(frame, rest + 4)),
        _positive(_numbers(frame, rest + 3)),
    )
    readable = ~np.isnat(t_utc) & ~np.isnan(lat) & ~np.isnan(lon)
    placed = readable & (np.abs(lat) <= _MAX_LAT) & (np.abs(lon) <= _MAX_LON) & ((lat != 0.0) | (lon != 0.0))
    if not placed.any():
        raise InputError(
            f"holds no epoch with a time and a position ({n_lines} lines read).",
            where=str(path),
            todo="Give a solution in latitude, longitude and height.",
        )
    skipped = {
        "lines that are no epoch": n_lines - int(readable.sum()),
        "epochs without a valid position": int((readable & ~placed).sum()),
    }
    return epochs.take(placed), skipped


def gpst_to_utc(t_gpst: NDArray[np.datetime64]) -> NDArray[np.datetime64]:
    """Take the leap seconds of its day off each GPS time."""
    leaps = np.searchsorted(_LEAPS_IN_GPST, t_gpst, side="right")
    return np.asarray(t_gpst - leaps.astype("timedelta64[s]"))


def _header(lines: list[str]) -> _Header:
    text = "\n".join(lines)
    titles = next((line for line in reversed(lines) if "Q" in line.split() or "latitude" in line), "")
    words = titles.lstrip("% ").replace(",", " ").split()
    system = words[0].upper() if words and words[0].upper() in {"GPST", "UTC", "JST"} else "GPST"
    date = _HEADER_DATE.search(text)
    start = pd.to_datetime(date[1] if date else "", format="%Y/%m/%d", errors="coerce")
    return _Header(
        system=system,
        is_baseline="baseline(m)" in text or "e/n/u-baseline" in text,
        is_ecef="x-ecef" in text or "x/y/z-ecef" in text,
        is_sexagesimal="latitude(d'" in titles,
        is_derived=any("program" in line and DERIVED in line for line in lines),
        start=None if start is pd.NaT else start.to_datetime64(),
    )


def _refuse(header: _Header, path: Path) -> None:
    if header.is_baseline:
        raise InputError(
            "a baseline solution (e/n/u metres from a base station), which has no position on the Earth.",
            where=str(path),
            todo="Solve again with solution format Lat/Lon/Height (RTKLIB: out-solformat=llh).",
        )
    if header.is_ecef:
        raise InputError(
            "an Earth-centred (x/y/z) solution, which is not read.",
            where=str(path),
            todo="Solve again with solution format Lat/Lon/Height (RTKLIB: out-solformat=llh).",
        )


def _columns(text: str) -> tuple[pd.DataFrame, int]:
    """Return the fields of all lines but comments as text, and the number of those lines."""
    n_lines = sum(1 for line in text.splitlines() if line.strip() and not line.startswith("%"))
    body = re.sub(r"[,;]", " ", text)
    if not n_lines:
        return pd.DataFrame({name: pd.Series(dtype=str) for name in range(_N_COLUMNS)}), 0
    frame = pd.read_csv(
        io.StringIO(body),
        sep=r"\s+",
        header=None,
        names=list(range(_N_COLUMNS)),
        dtype=str,
        comment="%",
        quoting=3,
        on_bad_lines="skip",
    )
    return frame, n_lines


def _numbers(frame: pd.DataFrame, column: int) -> Floats:
    values = pd.to_numeric(frame[column], errors="coerce").to_numpy(np.float64)
    return np.where(np.isfinite(values), values, np.nan)


def _positive(sigma_m: Floats) -> Floats:
    """Return standard deviations; one of zero declares nothing."""
    return np.where(sigma_m > 0, sigma_m, np.nan)


def _sexagesimal(frame: pd.DataFrame, column: int) -> Floats:
    degrees, minutes, seconds = (_numbers(frame, column + i) for i in range(3))
    negative = frame[column].str.startswith("-").fillna(value=False).to_numpy(bool)
    return np.where(negative, -1.0, 1.0) * (np.abs(degrees) + minutes / 60.0 + seconds / 3600.0)


def _qualities(number: Floats, header: _Header) -> NDArray[np.object_]:
    if header.is_derived:
        return np.full(len(number), DERIVED, object)
    names = np.array([QUALITY.get(q) for q in range(max(QUALITY) + 1)] + [None], object)
    index = np.where(np.isnan(number), len(QUALITY) + 1, np.round(np.nan_to_num(number, nan=-1.0)))
    return np.asarray(names[np.where((index >= 0) & (index <= len(QUALITY)), index, -1).astype(int)])


def _times(frame: pd.DataFrame, header: _Header) -> NDArray[np.datetime64]:
    """Return the time of each line in UTC, NaT where it has none."""
    dated = frame[0].str.contains("/", na=False).to_numpy(bool)
    days = pd.to_datetime(frame[0].where(dated), format="%Y/%m/%d", errors="coerce").to_numpy("datetime64[us]")
    clock = frame[1].where(dated).str.extract(r"^(\d{1,2}):(\d{2}):(\d{1,2}(?:\.\d*)?)$")
    hours, minutes, seconds = (pd.to_numeric(clock[i], errors="coerce").to_numpy(np.float64) for i in range(3))
    of_day = days + _microseconds(hours * 3600.0 + minutes * 60.0 + seconds)
    week = np.where(dated, np.nan, _numbers(frame, 0))
    week = week + _rollovers(week, header) * ROLLOVER_WEEKS
    of_week = GPS_EPOCH + _microseconds(week * WEEK_S) + _microseconds(np.where(dated, np.nan, _numbers(frame, 1)))
    time = np.where(dated, of_day, of_week)
    if header.system == "UTC":
        return np.asarray(time)
    if header.system == "JST":
        return np.asarray(time - _microseconds(np.array(_JST_S)))
    return gpst_to_utc(time)


def _rollovers(week: Floats, header: _Header) -> Floats:
    """Return how often ten bits of week count began again: by the date in the header, else since 2019."""
    if not np.nanmin(week, initial=np.inf) < ROLLOVER_WEEKS:
        return np.zeros(len(week))
    known = _RECENT_WEEKS if header.start is None else (header.start - GPS_EPOCH) / np.timedelta64(7, "D")
    return np.where(week < ROLLOVER_WEEKS, np.floor((known - week) / ROLLOVER_WEEKS + 0.5), 0.0)


def _microseconds(seconds: Floats) -> NDArray[np.timedelta64]:
    usable = np.abs(seconds) < _LONGEST_S
    span = np.round(np.where(usable, seconds, 0.0) * 1e6).astype("timedelta64[us]")
    return np.where(usable, span, np.timedelta64("NaT", "us"))
