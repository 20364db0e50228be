"""How a trajectory in columns of text is laid out: a packaged profile, columns that are named, or names that speak."""

from __future__ import annotations

import re
import tomllib
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from geofleet.errors import ConfigError, InputError
from geofleet.formats.drive_times import TIME_FORMATS
from geofleet.formats.inventory_columns import read_options
from geofleet.formats.reading import read_head
from geofleet.formats.text_tables import delimiter_of, encoding_of, header_line, text_of_head

if TYPE_CHECKING:
    from collections.abc import Mapping

THINGS = (
    *("time", "date", "week", "tow", "x", "y", "height", "speed", "quality", "satellites"),
    *("sigma_e", "sigma_n", "drive"),
)
_OPTIONS = ("crs", "origin", "time_format", "day_first", "delimiter", "encoding")
# Compared in lower case, letters and digits only; most telling first
_NAMES = {
    "time": "tutc utc utime timestamp timestampns unixtime datetime time gpstime timeutc epoch zeit zeitstempel heure "
    "t",
    "date": "date datum",
    "week": "week gpsweek weeknumber wn",
    "tow": "tow gpstow sow gpssow timeofweek",
    "x": "lon longitude lng long londeg lngdeg longitudedeg längengrad laengengrad länge laenge",
    "y": "lat latitude latdeg latitudedeg breitengrad breite",
    "height": "ellipsoidheight ellipsoidalheight heightellipsoidal heightm height",
    "quality": "fixquality quality fix q",
    "satellites": "nsatellites numsatellites satellites nsat nsats numsat numsats numsv ns",
    "sigma_e": "sigmaem sigmae sde sdem",
    "sigma_n": "sigmanm sigman sdn sdnm",
    "drive": "driveid drive tripid trip trackid vehicleid vehicle carid deviceid",
}
_BLANKS = r"\s+"
# What a name may have around it: `%time,field.latitude` of rostopic, and units that change nothing
_AROUND = re.compile(r"^(?:%|field\.)|\s*[(\[](?:s|sec|deg|degrees|°|m)[)\]]$", re.IGNORECASE)
# Of coordinates that are not degrees, which only a CRS can tell
_PROJECTED_NAMES = {"x": "x easting xm e rechtswert utmx utmeasting", "y": "y northing ym n hochwert utmy utmnorthing"}


@dataclass(frozen=True, slots=True)
class Layout:
    """How a file is to be read.

    Parameters
    ----------
    columns
        Thing to column.
    encoding, delimiter
        Of the text.
    n_before
        Lines before the header.
    names
        Of the columns of a file without a header.
    prefix
        What every line of such a file starts with.
    crs, origin
        Of the positions, where a profile or TOML says so.
    time_format
        One of `TIME_FORMATS`, None to guess it.
    day_first
        Whether 1/2/2022 is in February, None where the other dates show it.
    told
        What was guessed, for the user.
    """

    columns: dict[str, str]
    encoding: str
    delimiter: str
    n_before: int = 0
    names: tuple[str, ...] = ()
    prefix: str = ""
    crs: str | None = None
    origin: tuple[float, float] | None = None
    time_format: str | None = None
    day_first: bool | None = None
    told: tuple[str, ...] = field(default=())


def detect(head: bytes) -> bool:
    """Tell whether a file's first line fits a profile, or names a time and a position in degrees."""
    line, _ = _first_line(head)
    header, _ = _header(line)
    if _profile(line, header):
        return True
    guessed = _guess(header, {}, is_projected=False)
    return {"x", "y"} <= guessed.keys() and bool({"time", "tow"} & guessed.keys())


@cache
def profiles() -> dict[str, dict[str, Any]]:
    """Return the packaged profiles by name."""
    return tomllib.loads(resources.files("geofleet.formats").joinpath("drive_profiles.toml").read_text("utf-8"))


def columns_of(head: bytes) -> list[str]:
    """Return what the columns are called that a file's first bytes show."""
    return _split(_first_line(head)[0])


def layout_of(path: Path, columns: Mapping[str, str] | Path | None, *, is_projected: bool = False) -> Layout:
    """Return how to read a file: by what is given, its profile, and the names of its columns, in that order.

    Parameters
    ----------
    path
        The file.
    columns
        As in `drive_csv.read_epochs`.
    is_projected
        The caller knows a CRS or an origin: columns called x and y, or easting and northing, are a position.

    Raises
    ------
    InputError
        There are no columns of a position.
    ConfigError
        An option, a thing or a column is unknown.
    """
    given, options = _given(columns)
    line, n_before = _first_line(read_head(path))
    header, delimiter = _header(line, str(options.get("delimiter") or ""))
    name = _profile(line, header)
    profile = profiles()[name] if name else {}
    names = tuple(profile.get("names", ()))
    known = names or tuple(header)
    for thing, column in given.items():
        if column not in known:
            raise ConfigError(f"there is no column {column!r} for {thing}.", todo=f"Columns are {', '.join(known)}.")
    told = [f"profile {name} ({profile['about']})"] if name else []
    base = profile.get("columns", {})
    guessed = (
        {} if name else _guess(header, given, is_projected=is_projected or bool({"crs", "origin"} & options.keys()))
    )
    told += [f"{thing} read from column {column} (guessed)" for thing, column in guessed.items()]
    merged = {thing: column for thing, column in (guessed | base | given).items() if column in known}
    if not {"x", "y"} <= merged.keys():
        raise InputError(
            f"no columns that look like a position; there are {', '.join(known)[:300]}.",
            where=str(path),
            todo="Name them, and the CRS where they are not degrees: --columns time=…,x=…,y=… --crs ….",
        )
    origin = options.get("origin") or profile.get("origin")
    return Layout(
        columns=merged,
        encoding=str(options.get("encoding") or encoding_of(path)),
        n_before=n_before,
        delimiter=_BLANKS if profile.get("prefix") else delimiter,
        names=names,
        prefix=str(profile.get("prefix", "")),
        crs=options.get("crs") or (None if options.get("origin") else profile.get("crs")),
        origin=None if options.get("crs") or not origin else (float(origin[0]), float(origin[1])),
        time_format=options.get("time_format") or profile.get("time_format"),
        day_first=options.get("day_first"),
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
    named = {{"lon": "x", "lat": "y"}.get(thing, thing): column for thing, column in named.items()}
    unknown = sorted((set(named) - set(THINGS)) | (set(options) - set(_OPTIONS)))
    if unknown:
        raise ConfigError(
            f"unknown: {', '.join(unknown)}.",
            todo=f"Columns are for {', '.join(THINGS)}; options {', '.join(_OPTIONS)}.",
        )
    if options.get("time_format", "iso") not in TIME_FORMATS:
        raise ConfigError(
            f"unknown time_format {options['time_format']!r}.", todo=f"Choose of {', '.join(TIME_FORMATS)}."
        )
    return {thing: str(column) for thing, column in named.items()}, options


def _profile(line: str, header: list[str]) -> str:
    """Return the name of the one profile that a first line fits, or ""."""
    fitting = [
        name
        for name, profile in profiles().items()
        if (set(profile["header"]) <= set(header) if "header" in profile else line.split()[:1] == [profile["prefix"]])
    ]
    return fitting[0] if len(fitting) == 1 else ""


def _guess(header: list[str], given: Mapping[str, str], *, is_projected: bool) -> dict[str, str]:
    """Return a column for each thing that is not given, by its name; a date without a time of day beside it is one."""
    plain = {re.sub(r"[\W_]+", "", _AROUND.sub("", name.lower())): name for name in reversed(header)}
    taken = set(given.values())
    guessed = {}
    for thing, names in _NAMES.items():
        wanted = f"{names} {_PROJECTED_NAMES.get(thing, '')}" if is_projected else names
        name = next((plain[n] for n in wanted.split() if n in plain and plain[n] not in taken), "")
        if name and thing not in given and not (thing == "time" and "tow" in given):
            guessed[thing] = name
            taken.add(name)
    if "time" in guessed or not {"week", "tow"} <= guessed.keys() | given.keys():
        guessed = {thing: name for thing, name in guessed.items() if thing not in {"week", "tow"}}
    if "date" in guessed and not {"time", "tow"} & (guessed.keys() | given.keys()):
        guessed["time"] = guessed.pop("date")
    return guessed


def _header(line: str, delimiter: str = "") -> tuple[list[str], str]:
    """Return the names of a first line and what stands between them: blanks where nothing else does and a place is."""
    found = delimiter or delimiter_of(line)
    names, words = _split(line, found), line.split()
    if not delimiter and len(names) == 1 and {"x", "y"} <= _guess(words, {}, is_projected=True).keys():
        return words, _BLANKS
    return names, found


def _first_line(head: bytes) -> tuple[str, int]:
    return header_line(iter(text_of_head(head).splitlines()))


def _split(line: str, delimiter: str = "") -> list[str]:
    return [name.strip().strip('"') for name in line.split(delimiter or delimiter_of(line))]
