"""RTKLIB solution files (`.pos`): header, time, position and quality of every epoch.

The format as `solution.c` of RTKLIB 2.4.3 writes it (https://github.com/tomojitakasu/RTKLIB): times as date and time
or as GPS week and time of week, in GPST, UTC or JST; positions in decimal degrees, in degrees, minutes and seconds, or
Earth-centred; 15 columns, or 24 and more with velocities; separators blank, comma or semicolon; header or none.
Baseline (e/n/u) solutions are refused.
"""

from __future__ import annotations

import codecs
import io
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from geofleet.algorithms.geodesy import to_ecef
from geofleet.errors import InputError
from geofleet.formats.drive_epochs import NO_POSITION, Epochs
from geofleet.formats.drive_places import LEAST_RADIUS_M, LocalCrs, to_places
from geofleet.formats.gnss_time import gps_week_time, gpst_to_utc, microseconds
from geofleet.formats.reading import refuse_long_lines

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

QUALITY = {1: "fixed", 2: "float", 3: "sbas", 4: "dgps", 5: "single", 6: "ppp"}
DERIVED = "derived"
_JST_S = 9 * 3600.0
_N_COLUMNS = 32
_N_TIME = 2
_ESCAPE_MPS = 11_200.0  # what moves faster leaves the Earth

_DATED = re.compile(rb"\s*\d{4}/\d{1,2}/\d{1,2}[\s,;]+\d{1,2}:\d{2}:\d")
_WEEKLY = re.compile(rb"\s*\d{1,4}[\s,;]+\d{1,6}\.\d+[\s,;]+-?\d{1,3}\.\d+[\s,;]+-?\d{1,3}\.\d+[\s,;]")
_HEADER_MARKS = (b"RTKLIB", b"RTKPOST", b"% program", b"Q=1:fix", b"latitude(", b"-ecef(m)", b"-baseline(m)")
_HEADER_DATE = re.compile(r"(?:obs|sol) start\s*:\s*(\d{4}/\d{2}/\d{2})")


@dataclass(frozen=True, slots=True)
class _Header:
    """What the lines that begin with % say."""

    system: str
    is_baseline: bool
    is_ecef: bool
    is_sexagesimal: bool
    is_derived: bool
    is_above_sea: bool
    is_tokyo: bool
    start: np.datetime64 | None


@dataclass(frozen=True, slots=True)
class _Places:
    """Where each line is, its standard deviations, and how many columns the position takes."""

    lon: Floats
    lat: Floats
    height_m: Floats
    sigma_e_m: Floats
    sigma_n_m: Floats
    n_columns: int


def detect(head: bytes) -> bool:
    """Tell whether a file's first bytes are an RTKLIB solution's: its header, or epochs without one."""
    lines = head.removeprefix(codecs.BOM_UTF8).split(b"\n")
    if any(line.startswith(b"%") for line in lines) and any(mark in head for mark in _HEADER_MARKS):
        return True
    first = next((line for line in lines if line.strip() and not line.startswith(b"%")), b"")
    return bool(_DATED.match(first) or _WEEKLY.match(first))


def read_epochs(path: Path) -> tuple[Epochs, dict[str, int], dict[str, int]]:
    """Read every epoch of a solution, in the order of the file.

    Returns
    -------
    tuple
        The epochs with a time and a position, the number of lines left out by reason, and other counts.

    Raises
    ------
    InputError
        The solution is a baseline, or holds no epoch with a position.
    """
    refuse_long_lines(path)
    text = path.read_bytes().decode("utf-8-sig", errors="replace")
    header = _header([line for line in text.splitlines() if line.startswith("%")])
    if header.is_baseline:
        raise _baseline("a baseline solution (e/n/u metres from a base station)", path)
    if header.is_tokyo:
        raise InputError(
            "positions are in the Tokyo datum, some 400 m from WGS 84.", where=str(path), todo="Solve again in WGS84."
        )
    frame, n_lines = _columns(text)
    t_utc = _times(frame, header)
    place, readable = _places(frame, header)
    readable &= ~np.isnat(t_utc)
    at = place.n_columns + _N_TIME
    epochs = Epochs.of(
        place.lon,
        place.lat,
        t_utc=t_utc,
        height_m=np.full(len(t_utc), np.nan) if header.is_above_sea else place.height_m,
        quality=_qualities(_numbers(frame, at), header),
        sigma_e_m=_positive(place.sigma_e_m),
        sigma_n_m=_positive(place.sigma_n_m),
        n_satellites=_numbers(frame, at + 1),
    )
    placed = readable & epochs.is_placed()
    if not placed.any():
        raise InputError(
            f"holds no epoch with a time and a position ({n_lines} lines read).",
            where=str(path),
            todo="Give a solution in latitude, longitude and height.",
        )
    _refuse_unheaded_baseline(epochs.take(placed), path)
    skipped = {
        "lines that are no epoch": n_lines - int(readable.sum()),
        NO_POSITION: int((readable & ~placed).sum()),
    }
    found = {"heights above sea level, not taken": int(placed.sum())} if header.is_above_sea else {}
    return epochs.take(placed), skipped, found


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
        is_above_sea="=WGS84/geodetic" in text,
        is_tokyo="lat/lon/height=Tokyo" in text,
        is_derived=any("program" in line and DERIVED in line for line in lines),
        start=None if start is pd.NaT else start.to_datetime64(),
    )


def _baseline(what: str, path: Path) -> InputError:
    return InputError(
        f"{what}, which has no position on the Earth.",
        where=str(path),
        todo="Solve again with solution format Lat/Lon/Height (RTKLIB: out-solformat=llh).",
    )


def _refuse_unheaded_baseline(epochs: Epochs, path: Path) -> None:
    """Refuse metres that were taken for degrees, since no header says what they are: they move too fast by far."""
    step_m = np.linalg.norm(np.diff(to_ecef(epochs.lon, epochs.lat), axis=0), axis=1)
    step_s = np.abs(np.diff(epochs.seconds()))
    moved = (step_m > 0) & (step_s > 0)
    if moved.any() and np.median(step_m[moved] / step_s[moved]) > _ESCAPE_MPS:
        raise _baseline("positions that move by kilometres a second: a baseline solution (e/n/u), it seems", path)


def _places(frame: pd.DataFrame, header: _Header) -> tuple[_Places, Flags]:
    """Return the places of all lines, and which of them could be read."""
    first = [_numbers(frame, _N_TIME + i) for i in range(3)]
    with np.errstate(invalid="ignore", over="ignore"):
        radius = np.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2)
    readable = np.asarray(np.isfinite(radius))
    if header.is_ecef or (readable.any() and float(np.median(radius[readable])) > LEAST_RADIUS_M):
        sigmas = [_numbers(frame, _N_TIME + 5 + i) for i in range(6)]
        lon, lat, height_m = to_places(first[0], first[1], first[2], LocalCrs("EPSG:4978"), where="")
        sigma_e_m, sigma_n_m = _horizontal(lon, lat, sigmas)
        return _Places(lon, lat, height_m, sigma_e_m, sigma_n_m, 3), readable
    if header.is_sexagesimal:
        lat, lon = _sexagesimal(frame, _N_TIME), _sexagesimal(frame, _N_TIME + 3)
        n_columns = 7
    else:
        lat, lon = first[0], first[1]
        n_columns = 3
    at = _N_TIME + n_columns
    height_m, sigma_n_m, sigma_e_m = (_numbers(frame, i) for i in (at - 1, at + 2, at + 3))
    return _Places(lon, lat, height_m, sigma_e_m, sigma_n_m, n_columns), ~np.isnan(lat) & ~np.isnan(lon)


def _horizontal(lon: Floats, lat: Floats, sigmas: list[Floats]) -> tuple[Floats, Floats]:
    """Return standard deviations east and north of x, y, z and the signed roots of xy, yz, zx (RTKLIB's order)."""
    x, y, z, xy, yz, zx = (np.sign(sigma) * sigma**2 for sigma in sigmas)
    sin_lon, cos_lon, sin_lat, cos_lat = (f(np.radians(a)) for a in (lon, lat) for f in (np.sin, np.cos))
    east = sin_lon**2 * x + cos_lon**2 * y - 2 * sin_lon * cos_lon * xy
    north = (
        sin_lat**2 * (cos_lon**2 * x + sin_lon**2 * y + 2 * sin_lon * cos_lon * xy)
        + cos_lat**2 * z
        - 2 * sin_lat * cos_lat * (cos_lon * zx + sin_lon * yz)
    )
    return np.sqrt(np.maximum(east, 0.0)), np.sqrt(np.maximum(north, 0.0))


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
