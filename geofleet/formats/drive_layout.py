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
from geofleet.formats.drive_names import THINGS, guess_columns
from geofleet.formats.drive_times import TIME_FORMATS
from geofleet.formats.inventory_columns import read_options
from geofleet.formats.reading import read_head
from geofleet.formats.text_tables import delimiter_of, encoding_of, header_line, text_of_head

if TYPE_CHECKING:
    from collections.abc import Mapping

_OPTIONS = ("crs", "origin", "time_format", "day_first", "delimiter", "encoding")
_BLANKS = r"\s+"
_COMMENT = "#"
_VALUE = re.compile(r"[+-]?\d+(?:[.,]\d*)?(?:[eE][+-]?\d+)?|\d{4}-\d\d-\d\d.*")


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
    guessed = guess_columns(header, {}, is_projected=False)
    return {"x", "y"} <= guessed.keys() and bool({"time", "tow", "year"} & guessed.keys())


@cache
def profiles() -> dict[str, dict[str, Any]]:
    """Return the packaged profiles by name."""
    return tomllib.loads(resources.files("geofleet.formats").joinpath("drive_profiles.toml").read_text("utf-8"))


def columns_of(head: bytes) -> list[str]:
    """Return what the columns are called that a file's first bytes show."""
    return _header(_first_line(head)[0])[0]


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
    is_comment = line.startswith(_COMMENT)
    header, delimiter = _header(line, str(options.get("delimiter") or ""))
    name = _profile(line, header)
    profile = profiles()[name] if name else {}
    names = tuple(profile.get("names", ()))
    n_before += is_comment
    known = names or tuple(header)
    for thing, column in given.items():
        if column not in known:
            raise ConfigError(f"there is no column {column!r} for {thing}.", todo=f"Columns are {', '.join(known)}.")
    told = [f"profile {name} ({profile['about']})"] if name else []
    base = profile.get("columns", {})
    knows_crs = is_projected or bool({"crs", "origin"} & options.keys())
    guessed = {} if name else guess_columns(header, given, is_projected=knows_crs)
    told += [f"{thing} read from column {column} (guessed)" for thing, column in guessed.items()]
    merged = {thing: column for thing, column in (guessed | base | given).items() if column in known}
    if not ({"x", "y"} <= merged.keys() or "lat_lon" in merged):
        raise _no_position(path, known)
    origin = options.get("origin") or profile.get("origin")
    return Layout(
        columns=merged,
        encoding=str(options.get("encoding") or encoding_of(path)),
        n_before=n_before,
        delimiter=_BLANKS if profile.get("prefix") else delimiter,
        names=names or (tuple(header) if is_comment else ()),
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


def _no_position(path: Path, known: tuple[str, ...]) -> InputError:
    """Return what is wrong with a first line that names no position: it may be no line of names."""
    if 2 * sum(bool(_VALUE.fullmatch(name)) for name in known) >= len(known):
        return InputError(
            f"the first line names no columns, it holds values ({', '.join(known)[:100]}).",
            where=str(path),
            todo="Put a line of names above it, such as time,lat,lon,height.",
        )
    return InputError(
        f"no columns that look like a position; there are {', '.join(known)[:300]}.",
        where=str(path),
        todo="Name them, and the CRS where they are not degrees: --columns time=…,x=…,y=… --crs ….",
    )


def _header(line: str, delimiter: str = "") -> tuple[list[str], str]:
    """Return the names of a first line and what stands between them: blanks where nothing else does and a place is."""
    line = line.lstrip(_COMMENT + " ")
    found = delimiter or delimiter_of(line)
    names, words = _split(line, found), line.split()
    if not delimiter and len(names) == 1 and {"x", "y"} <= guess_columns(words, {}, is_projected=True).keys():
        return words, _BLANKS
    return names, found


def _first_line(head: bytes) -> tuple[str, int]:
    """Return the line that names the columns and how many come before it; a comment does where values follow it."""
    lines = text_of_head(head).splitlines()
    line, n_before = header_line(iter(lines))
    above = lines[n_before - 1] if n_before else ""
    if above.startswith(_COMMENT) and len(names := _header(above)[0]) > 1:
        values = line.split() if _header(above)[1] == _BLANKS else _split(line, _header(above)[1])
        if len(values) == len(names) and sum(bool(_VALUE.fullmatch(value)) for value in values) > 1:
            return above, n_before - 1
    return line, n_before


def _split(line: str, delimiter: str = "") -> list[str]:
    return [name.strip().strip('"') for name in line.split(delimiter or delimiter_of(line))]
