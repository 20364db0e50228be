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
from geofleet.formats.drive_epochs import Epochs
from geofleet.formats.gnss_time import gps_week_time, gpst_to_utc, microseconds
from geofleet.formats.reading import refuse_long_lines

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

QUALITY = {1: "fixed", 2: "float", 3: "sbas", 4: "dgps", 5: "single", 6: "ppp"}
DERIVED = "derived"
_JST_S = 9 * 3600.0
_N_COLUMNS = 32
_MAX_LAT, _MAX_LON = 90.0, 180.0

_DATED = re.compile(rb"\s*\d{4}/\d{1,2}/\d{1,2}[\s,;]+\d{1,2}:\d{2}:\d")
_WEEKLY = re.compile(rb"\s*\d{1,4}[\s,;]+\d{1,6}\.\d+[\s,;]+-?\d{1,3}\.\d+[\s,;]+-?\d{1,3}\.\d+[\s,;]")
_HEADER_MARKS = (b"RTKLIB", b"RTKPOST", b"% program", b"Q=1:fix", b"latitude", b"-ecef(m)", b"-baseline(m)")
_HEADER_DATE = re.compile(r"(?:obs|sol) start\s*:\s*(\d{4}/\d{2}/\d{2})")


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
    refuse_long_lines(path)
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
    of_day = days + microseconds(hours * 3600.0 + minutes * 60.0 + seconds)
    week = np.where(dated, np.nan, _numbers(frame, 0))
    of_week = gps_week_time(week, np.where(dated, np.nan, _numbers(frame, 1)), near=header.start)
    time = np.where(dated, of_day, of_week)
    if header.system == "UTC":
        return np.asarray(time)
    if header.system == "JST":
        return np.asarray(time - microseconds(np.array(_JST_S)))
    return gpst_to_utc(time)
