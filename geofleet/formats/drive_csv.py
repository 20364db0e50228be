"""Trajectories in columns of text: by a packaged profile, by columns that are named, or by names that speak.

A profile is recognised by the header when one only fits; whatever is given overrides it. Which one was taken, and each
guess, is told in the counts.
"""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from geofleet.errors import ConfigError, InputError
from geofleet.formats.drive_epochs import NO_EPOCH, NO_POSITION, Epochs
from geofleet.formats.drive_places import local_crs, to_places
from geofleet.formats.drive_times import TIME_FORMATS, guess_format, times_of, times_of_velocity
from geofleet.formats.gnss_time import gps_week_time, gpst_to_utc
from geofleet.formats.inventory_columns import read_options
from geofleet.formats.reading import read_head, refuse_long_lines

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

THINGS = ("time", "week", "tow", "x", "y", "height", "speed", "quality", "sigma_e", "sigma_n", "drive")
_OPTIONS = ("crs", "origin", "time_format", "delimiter")
# Compared in lower case, letters and digits only; most telling first
_NAMES = {
    "time": "tutc utc timestamp timestampns unixtime datetime time gpstime timeutc epoch t date",
    "x": "lon longitude lng long londeg lngdeg longitudedeg",
    "y": "lat latitude latdeg latitudedeg",
    "height": "ellipsoidheight ellipsoidalheight heightellipsoidal heightm height",
    "quality": "fixquality quality fix q",
    "sigma_e": "sigmaem sigmae sde sdem",
    "sigma_n": "sigmanm sigman sdn sdnm",
    "drive": "driveid drive tripid trackid",
}
_QUALITIES = {"fixed", "float", "sbas", "dgps", "single", "ppp", "derived"}
_DELIMITERS = ",;\t|"


@dataclass(frozen=True, slots=True)
class _Layout:
    """How a file is to be read."""

    columns: dict[str, str]
    delimiter: str
    names: tuple[str, ...] = ()  # of the columns of a file without a header
    prefix: str = ""
    crs: str | None = None
    origin: tuple[float, float] | None = None
    time_format: str | None = None
    told: tuple[str, ...] = field(default=())


def detect(head: bytes) -> bool:
    """Tell whether a file's first line fits a profile, or names a time and a position in degrees."""
    line = _first_line(head)
    if _profile(line, _split(line)):
        return True
    guessed = _guess(_split(line), {})
    return {"x", "y", "time"} <= guessed.keys()


def stated_crs(
    path: Path,
    *,
    columns: Mapping[str, str] | Path | None = None,
    crs: str | None = None,
    origin: tuple[float, float] | None = None,
    utm: tuple[str, float, float] | None = None,
) -> str:
    """Return the CRS that `read_epochs` takes a file to be in; parameters and errors as there."""
    layout = _layout(path, columns)
    if crs is None and origin is None and utm is None:
        crs, origin = layout.crs, layout.origin
    return local_crs(crs, origin, utm).crs


def read_epochs(
    path: Path,
    *,
    columns: Mapping[str, str] | Path | None = None,
    crs: str | None = None,
    origin: tuple[float, float] | None = None,
    utm: tuple[str, float, float] | None = None,
) -> tuple[dict[str, Epochs], dict[str, int], dict[str, int]]:
    """Read every epoch of a file, in its order.

    Parameters
    ----------
    path
        The file.
    columns
        Thing to column: `time`, or `week` and `tow`; `x`, `y` and `height` (or Earth-centred z); `speed`, `quality`,
        `sigma_e`, `sigma_n`; `drive` for a file of several drives; `time_format`, one of `TIME_FORMATS`. Or a TOML file
        with a table `columns` and, beside it, `crs`, `origin`, `time_format` and `delimiter`.
    crs
        CRS of x and y; OGC:CRS84 by default.
    origin
        Latitude and longitude that x and y count from, in the UTM zone of the origin.
    utm
        Projected CRS, easting and northing of x = y = 0.

    Returns
    -------
    tuple
        The epochs with a position by the name of their drive ("" without a column `drive`), the numbers left out by
        reason, and other counts.

    Raises
    ------
    InputError
        There are no columns of a position, no epoch with one, or the positions contradict the CRS.
    ConfigError
        An option, a thing or a column is unknown, or two options contradict each other.
    """
    refuse_long_lines(path)
    layout = _layout(path, columns)
    frame, n_broken = _read(path, layout)
    notes = list(layout.told)
    if crs is None and origin is None and utm is None:
        crs, origin = layout.crs, layout.origin
        notes += [f"origin {origin[0]}, {origin[1]} of the profile or the TOML file"] if origin else []
    local = local_crs(crs, origin, utm)
    x, y, z = (_numbers(frame, layout.columns.get(thing)) for thing in ("x", "y", "height"))
    lon, lat, height_m = to_places(x, y, z, local, where=str(path))
    t_utc, elapsed_s, told = _times(frame, layout, lon, lat)
    has_clock = not {"time", "tow"}.isdisjoint(layout.columns)
    epochs = Epochs.of(
        lon,
        lat,
        t_utc=t_utc,
        elapsed_s=elapsed_s,
        has_clock=has_clock,
        height_m=height_m,
        quality=_qualities(frame, layout.columns.get("quality")),
        sigma_e_m=_positive(_numbers(frame, layout.columns.get("sigma_e"))),
        sigma_n_m=_positive(_numbers(frame, layout.columns.get("sigma_n"))),
    )
    readable, placed = np.isfinite(x) & np.isfinite(y), epochs.is_placed()
    if not placed.any():
        raise InputError(
            f"holds no epoch with a position ({len(frame)} lines read).",
            where=str(path),
            todo="Name the columns: --columns time=…,x=…,y=….",
        )
    skipped = {NO_EPOCH: n_broken + int((~readable).sum()), NO_POSITION: int((readable & ~placed).sum())}
    found = dict.fromkeys((*notes, *told), int(placed.sum()))
    return _split_drives(epochs, frame, layout.columns.get("drive"), placed), skipped, found


@cache
def profiles() -> dict[str, dict[str, Any]]:
    """Return the packaged profiles by name."""
    return tomllib.loads(resources.files("geofleet.formats").joinpath("drive_profiles.toml").read_text("utf-8"))


def _layout(path: Path, columns: Mapping[str, str] | Path | None) -> _Layout:
    """Return how to read a file: by what is given, its profile, and the names of its columns, in that order."""
    given, options = _given(columns)
    line = _first_line(read_head(path))
    delimiter = str(options.get("delimiter") or _delimiter(line))
    header = _split(line, delimiter)
    name = _profile(line, header)
    profile = profiles()[name] if name else {}
    names = tuple(profile.get("names", ()))
    known = names or tuple(header)
    for thing, column in given.items():
        if column not in known:
            raise ConfigError(f"there is no column {column!r} for {thing}.", todo=f"Columns are {', '.join(known)}.")
    told = [f"profile {name} ({profile['about']})"] if name else []
    base = profile.get("columns", {})
    guessed = {} if name else _guess(header, given)
    told += [f"{thing} read from column {column} (guessed)" for thing, column in guessed.items()]
    merged = {thing: column for thing, column in (guessed | base | given).items() if column in known}
    if not {"x", "y"} <= merged.keys():
        raise InputError(
            f"no columns that look like a position; there are {', '.join(known)[:300]}.",
            where=str(path),
            todo="Name them: --columns time=…,x=…,y=….",
        )
    origin = options.get("origin") or profile.get("origin")
    return _Layout(
        columns=merged,
        delimiter=r"\s+" if profile.get("prefix") else delimiter,
        names=names,
        prefix=str(profile.get("prefix", "")),
        crs=options.get("crs") or (None if options.get("origin") else profile.get("crs")),
        origin=None if options.get("crs") or not origin else (float(origin[0]), float(origin[1])),
        time_format=options.get("time_format") or profile.get("time_format"),
        told=tuple(told),
    )


def _given(columns: Mapping[str, str] | Path | None) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the columns and the options that the caller gives, checked."""
    options: dict[str, Any] = {}
    named: dict[str, Any] = {}
    if isinstance(columns, Path):
        options = read_options(columns)
        named = dict(options.pop("columns", {}))
    elif columns:
        named = dict(columns)
    if "time_format" in named:
        options["time_format"] = named.pop("time_format")
    unknown = sorted((set(named) - set(THINGS)) | (set(options) - set(_OPTIONS)))
    if unknown:
        raise ConfigError(
            f"unknown: {', '.join(unknown)}.", todo=f"Columns are for {', '.join(THINGS)}; options {_OPTIONS}."
        )
    if options.get("time_format", "iso") not in TIME_FORMATS:
        raise ConfigError(
            f"unknown time_format {options['time_format']!r}.", todo=f"Choose of {', '.join(TIME_FORMATS)}."
        )
    return {thing: str(column) for thing, column in named.items()}, options


def _read(path: Path, layout: _Layout) -> tuple[pd.DataFrame, int]:
    """Return the lines as text columns, and how many have more fields than there are columns."""
    try:
        frame = pd.read_csv(
            path,
            sep=layout.delimiter,
            names=list(layout.names) or None,
            header=None if layout.names else 0,
            index_col=False,
            dtype=str,
            encoding="utf-8-sig",
            encoding_errors="replace",
            quoting=0,
            on_bad_lines="skip",
            skipinitialspace=True,
        )
    except (pd.errors.ParserError, pd.errors.EmptyDataError, ValueError) as error:
        raise InputError(f"cannot be read as columns ({error}).", where=str(path), todo="Export it again.") from None
    frame.columns = [str(name).strip() for name in frame.columns]
    if layout.prefix:
        frame = frame[frame.iloc[:, 0] == layout.prefix].reset_index(drop=True)
    with path.open("rb") as file:
        n_lines = sum(1 for line in file if line.strip()) - (not layout.names)
    return frame, max(n_lines - len(frame), 0)


def _times(
    frame: pd.DataFrame, layout: _Layout, lon: Floats, lat: Floats
) -> tuple[NDArray[np.datetime64], Floats | None, list[str]]:
    """Return UTC, seconds where the file does not say since when, and what to tell."""
    names = layout.columns
    unknown = np.full(len(frame), "NaT", "datetime64[us]")
    if "week" in names and "tow" in names and "time" not in names:
        gpst = gps_week_time(_numbers(frame, names["week"]), _numbers(frame, names["tow"]))
        return gpst_to_utc(gpst), None, []
    if "time" in names:
        text = frame[names["time"]]
        told = []
        chosen = layout.time_format
        if chosen in (None, "velocity"):
            chosen = guess_format(text)
            told = [f"times read as {chosen} (guessed)"]
        t_utc, elapsed_s = times_of(text, chosen)
        return t_utc, elapsed_s, told
    if "speed" in names:
        elapsed_s = times_of_velocity(lon, lat, _numbers(frame, names["speed"]))
        return unknown, elapsed_s, ["no times: seconds derived from the speeds"]
    return unknown, None, []


def _split_drives(
    epochs: Epochs, frame: pd.DataFrame, column: str | None, placed: NDArray[np.bool_]
) -> dict[str, Epochs]:
    if not column:
        return {"": epochs.take(placed)}
    names = frame[column].fillna("").astype(str).str.strip().to_numpy(object)
    return {name: epochs.take(placed & (names == name)) for name in dict.fromkeys(names[placed].tolist())}


def _profile(line: str, header: list[str]) -> str:
    """Return the name of the one profile that a first line fits, or ""."""
    fitting = [
        name
        for name, profile in profiles().items()
        if (set(profile["header"]) <= set(header) if "header" in profile else line.split()[:1] == [profile["prefix"]])
    ]
    return fitting[0] if len(fitting) == 1 else ""


def _guess(header: list[str], given: Mapping[str, str]) -> dict[str, str]:
    """Return a column for each thing that is not given, by its name."""
    plain = {re.sub(r"[\W_]+", "", name.lower()): name for name in reversed(header)}
    taken = set(given.values())
    guessed = {}
    for thing, names in _NAMES.items():
        name = next((plain[n] for n in names.split() if n in plain and plain[n] not in taken), "")
        if name and thing not in given and not (thing == "time" and "tow" in given):
            guessed[thing] = name
            taken.add(name)
    return guessed


def _first_line(head: bytes) -> str:
    text = head.decode("utf-8-sig", errors="replace")
    return next((line for line in text.splitlines() if line.strip()), "")


def _delimiter(line: str) -> str:
    return max(_DELIMITERS, key=line.count)


def _split(line: str, delimiter: str = "") -> list[str]:
    return [name.strip().strip('"') for name in line.split(delimiter or _delimiter(line))]


def _numbers(frame: pd.DataFrame, column: str | None) -> Floats:
    if not column:
        return np.full(len(frame), np.nan)
    values = pd.to_numeric(frame[column].str.strip(), errors="coerce").to_numpy(np.float64)
    return np.where(np.isfinite(values), values, np.nan)


def _positive(sigma_m: Floats) -> Floats:
    return np.where(sigma_m > 0, sigma_m, np.nan)


def _qualities(frame: pd.DataFrame, column: str | None) -> NDArray[np.object_]:
    """Return names of fix qualities; a number means nothing without its receiver and is left out."""
    if not column:
        return np.full(len(frame), None, object)
    text = frame[column].fillna("").str.strip().str.lower()
    return text.where(text.isin(_QUALITIES), None).to_numpy(object)
