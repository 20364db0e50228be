"""Which column of an inventory means what, guessed from its name or given by the user, and how its text is read."""

from __future__ import annotations

import json
import re
import tomllib
from dataclasses import dataclass, fields
from datetime import UTC, date, datetime
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.errors import ConfigError, InputError
from geofleet.formats.osm_tags import COMPASS_DEG
from geofleet.tables.arrays import sound_times

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class InventoryColumns:
    """The column of an inventory that holds each thing; "" = no column.

    Parameters
    ----------
    code
        What the sign shows: a code of a national or other scheme.
    value
        The number on the sign, where the code does not hold it.
    sign_id
        Id of the sign.
    facing
        The way the sign's face looks: degrees clockwise from north or a point of the compass.
    country
        ISO 3166-1 alpha-2.
    x, y
        Coordinates, for a file whose rows have no geometry.
    geometry
        Well-known text, for the same.
    lat_lon
        Both coordinates in one text, `60.17, 24.94`, for the same; longitude first when the column's name says so.
    first_seen, last_seen
        Dates or times.
    height
        Metres above the ground.
    support
        Id of the pole.
    """

    code: str = ""
    value: str = ""
    sign_id: str = ""
    facing: str = ""
    country: str = ""
    x: str = ""
    y: str = ""
    geometry: str = ""
    lat_lon: str = ""
    first_seen: str = ""
    last_seen: str = ""
    height: str = ""
    support: str = ""


# What people call these columns, most telling first; compared in lower case, letters and digits only
NAMES = {
    "code": "rawcode trafficsigncode trafficsign signcode code osmtrafficsign objectvalue mutcdcode mutcd bordkode "
    "bordcode rvvcode devicetypecode tyyppi verkehrszeichen "
    "vznummer vznr vz zeichen codepanneau panneau merkkikoodi signtype signclass "
    "sign signs schild zeichennummer stvo value class type",
    "value": "signvalue textonsign opschrift speedlimit maxspeed extratext blackcode arvo",
    "sign_id": "signid id osmid objectid gid fid uuid ogcfid featureid",
    "facing": "facingdeg facing direction azimuth bearing orientation compassangle kijkrichting richtung heading "
    "suuntima",
    "country": "country countrycode isocountry",
    "x": "lon longitude lng long wgs84lon längengrad laengengrad länge x easting xcoord coordx locatiex pointx "
    "rechtswert",
    "y": "lat latitude wgs84lat breitengrad breite y northing ycoord coordy locatiey pointy hochwert",
    "geometry": "wkt geom geometry thegeom wktgeom shape",
    "lat_lon": "latlon latlng latlong lonlat lnglat longlat latitudelongitude coordinates coordinate coords "
    "koordinaten geopoint geopoint2d gps gpscoordinates gpsposition position location",
    "first_seen": "firstseen firstseenat dateinstalled installdate installed placedat",
    "last_seen": "lastseen lastseenat lastinspected inspectiondate",
    "height": "heightm mountingheight",
    "support": "supportid poleid",
}
_PLACES = ("x", "y", "geometry", "lat_lon")
_PAIR = re.compile(
    r"\s*[(\[]?\s*(?:([+-]?\d+(?:\.\d+)?)\s*,\s*([+-]?\d+(?:\.\d+)?)"
    r"|([+-]?\d+(?:[.,]\d+)?)\s*[;/|\s]\s*([+-]?\d+(?:[.,]\d+)?))\s*[)\]]?\s*"
)
_LON_FIRST = re.compile(r"\s*(lon|lng)", re.IGNORECASE)
_COMPASS_WORDS = {
    "north": 0.0, "nord": 0.0, "noord": 0.0, "east": 90.0, "ost": 90.0, "est": 90.0, "oost": 90.0, "south": 180.0,
    "süd": 180.0, "sud": 180.0, "zuid": 180.0, "west": 270.0, "ouest": 270.0, "o": 90.0, "z": 180.0,
}  # fmt: skip
_NUMBER = r"^[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?$"
_DATE = re.compile(r"(\d{1,4})[-/.](\d{1,2})[-/.](\d{1,4})(?:[ T](.+))?")
# The O of a German east is that of a French west, the s of seconds that of the south: left out
_ANGLE = re.compile(
    r"(?P<before>[NSEW+-])?\s*(?P<degrees>\d{1,3}(?:\.\d+)?)(?P<degree>\s*[°º:]?\s*)"
    r"(?:(?<=[\s°º:])(?P<minutes>\d{1,2}(?:\.\d+)?)\s*['\u2032\u2019:]?\s*"
    r"(?:(?P<seconds>\d{1,2}(?:\.\d+)?)\s*(?:[\"\u2033\u201d]|'')?)?)?\s*"
    r"(?P<after>[NSEW])?"
)
# Four or five figures before the point are degrees and minutes of NMEA: 4806.1234N is no 480 degrees
_NMEA_ANGLE = re.compile(
    r"(?P<before>[NSEW])?\s*(?P<degrees>\d{2,3})(?P<degree>)(?P<minutes>\d{2}(?:\.\d*)?)(?P<seconds>)\s*(?P<after>[NSEW])?"
)
_EPOCH_MS, _EPOCH_S = 1e11, 1e8
_MONTHS, _LAST_YEAR = 12, 9999
_PREVAILING = 0.95
_MAX_TEXT_BYTES, _MAX_WHOLE = 1 << 20, 1e18
_SHAPEFILE_NAME = 10  # letters of a column name


def read_options(path: Path) -> dict[str, Any]:
    """Read reading options from TOML: a table `columns`, and beside it any option of the reader, such as `crs`.

    Raises
    ------
    ConfigError
        There is no such file or it is not TOML.
    """
    try:
        if path.stat().st_size > _MAX_TEXT_BYTES:
            raise ConfigError("larger than any column mapping.", where=str(path))
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise ConfigError(
            f"cannot be read as TOML ({error}).", where=str(path), todo="Check path and syntax."
        ) from None


def choose_columns(
    names: Sequence[str], given: Mapping[str, str], *, has_geometry: bool
) -> tuple[InventoryColumns, tuple[str, ...]]:
    """Choose a column for each thing: what is given, else by its name; coordinates only where geometry is missing.

    Returns
    -------
    tuple of InventoryColumns and tuple of str
        The choice, and which things were guessed.

    Raises
    ------
    ConfigError
        Something given is not a thing to map, or not a column of the file.
    """
    things = [field.name for field in fields(InventoryColumns)]
    asked = {"sign_id" if thing == "id" else thing: name for thing, name in given.items()}
    for thing, name in asked.items():
        if thing not in things:
            raise ConfigError(f"{thing!r} is nothing that a column can mean.", todo=f"Choose of {', '.join(things)}.")
        if name and name not in names:
            raise ConfigError(
                f"there is no column {name!r} for {thing}.", todo=f"Columns are {', '.join(map(str, names))[:400]}."
            )
    plain = {re.sub(r"[\W_]+", "", name.lower()): name for name in reversed(names)}
    taken = set(asked.values())
    guessed: dict[str, str] = {}
    for thing in things:
        if thing in asked or (has_geometry and thing in _PLACES):
            continue
        found = asked | guessed
        if thing == "lat_lon" and (found.get("geometry") or (found.get("x") and found.get("y"))):
            continue
        wanted = [*NAMES[thing].split(), *_cut_names(NAMES[thing].split(), plain)]
        free = (plain[name] for name in wanted if name in plain and plain[name] not in taken)
        name = next(free, "")
        if name:
            guessed[thing] = name
            taken.add(name)
    return InventoryColumns(**asked, **guessed), tuple(guessed)


def _cut_names(wanted: Sequence[str], plain: Mapping[str, str]) -> list[str]:
    """Return the columns that a Shapefile, which keeps ten letters, may have cut one of the wanted names to."""
    cut = [key for key, name in plain.items() if len(name) == _SHAPEFILE_NAME]
    return [key for key in cut if any(name.startswith(key) for name in wanted)]


def texts(table: pa.Table, name: str) -> list[str | None]:
    """Return a column as text, stripped; whole numbers without a decimal point; all None without a column.

    Raises
    ------
    InputError
        The column holds lists or the like.
    """
    if not name:
        return [None] * table.num_rows
    column = table[name]
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if pa.types.is_floating(column.type):
        return [None if v is None or v != v else _plain(v) for v in column.to_pylist()]  # noqa: PLR0124  (NaN)
    if pa.types.is_list(column.type) and pa.types.is_string(column.type.value_type):
        column = pc.binary_join(column.cast(pa.list_(pa.string())), "|")  # the plates of a stack
    elif pa.types.is_nested(column.type):
        return [None if v is None else json.dumps(v, ensure_ascii=False, default=str) for v in column.to_pylist()]
    try:
        column = pc.utf8_trim_whitespace(column.cast(pa.string()))
        return list(column.to_pylist())
    except (pa.ArrowInvalid, pa.ArrowNotImplementedError, UnicodeDecodeError) as error:
        raise InputError(f"column {name} cannot be read as text ({error}).", todo="Choose another one.") from None


def _plain(value: float) -> str:
    """Return a number as people write it: whole ones without a point, 274.1 as that and not as its binary neighbour."""
    return f"{value:.0f}" if value.is_integer() and abs(value) < _MAX_WHOLE else repr(value)


def numbers(table: pa.Table, name: str) -> Floats:
    """Return a column as numbers, NaN where there is none; a comma may be the decimal point."""
    if not name:
        return np.full(table.num_rows, np.nan)
    column = table[name]
    if pa.types.is_integer(column.type) or pa.types.is_floating(column.type):
        return np.asarray(column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False), np.float64)
    return parse_numbers(texts(table, name))


def coordinates(table: pa.Table, name: str) -> Floats:
    """Return a column as numbers, or degrees, minutes and seconds with a sign or a hemisphere as degrees, else NaN."""
    found = numbers(table, name)
    lost = np.flatnonzero(np.isnan(found))
    if len(lost) and not pa.types.is_floating(table[name].type):
        text = texts(table, name)
        found = found.copy()
        found[lost] = [angle(text[row] or "") for row in lost]
    return found


def paired_coordinates(table: pa.Table, name: str) -> tuple[Floats, Floats]:
    """Return x and y of a column of `lat, lon`, or `lon, lat` where its name begins so; NaN where it holds others."""
    found = [_PAIR.fullmatch(text) if text else None for text in texts(table, name)]
    pairs = [tuple(part for part in match.groups() if part) if match else ("", "") for match in found]
    first, second = (parse_numbers([pair[side] for pair in pairs]) for side in (0, 1))
    return (first, second) if _LON_FIRST.match(name) else (second, first)


def angle(text: str) -> float:
    """Return `52°30'36.5" N`, `52 30.61 N`, `N 52:30:36`, `52.51 N`, `5230.61N` or the like as degrees, else NaN."""
    plain = text.strip().upper().replace(",", ".")
    match = _NMEA_ANGLE.fullmatch(plain) or _ANGLE.fullmatch(plain)
    if not match or not (match["degree"].strip() or match["before"] or match["after"]):
        return np.nan
    degrees, minutes, seconds = (float(match[part] or 0.0) for part in ("degrees", "minutes", "seconds"))
    if minutes >= 60.0 or seconds >= 60.0:  # noqa: PLR2004  (of a circle)
        return np.nan
    side = match["before"] or match["after"] or ""
    return (-1.0 if side in {"S", "W", "-"} else 1.0) * (degrees + minutes / 60.0 + seconds / 3600.0)


def parse_numbers(values: Sequence[str | None]) -> Floats:
    """Return texts as numbers, NaN where one is none: `12.5`, `12,5`, `1.234,5` and `1 234,5` are."""
    text = pa.array(values, pa.string())
    text = pc.replace_substring_regex(text, r"[\s\x{00a0}\x{202f}']", "")
    # The last of point and comma is the decimal one when both are there; a lone comma always is
    text = pc.replace_substring_regex(text, r"^([^,]*\.[^,]*),(\d*)$", r"\1;\2")
    grouped = pc.match_substring(text, ";")
    text = pc.if_else(grouped, pc.replace_substring(pc.replace_substring(text, ".", ""), ";", "."), text)
    english = pc.match_substring_regex(text, r",.*\.")
    text = pc.if_else(english, pc.replace_substring(text, ",", ""), pc.replace_substring(text, ",", "."))
    known = pc.match_substring_regex(text, _NUMBER)
    number = pc.if_else(known, text, None).cast(pa.float64())
    return np.asarray(number.to_numpy(zero_copy_only=False), np.float64)


def parse_facings(values: Sequence[str | None]) -> tuple[Floats, int]:
    """Return facings in degrees, clockwise from north, and how many texts were none; missing ones are NaN."""
    known = {value: _facing(value) for value in set(values) if value}
    facing = np.array([known[value] if value else np.nan for value in values], np.float64)
    return facing, sum(1 for value in values if value and np.isnan(known[value]))


def parse_times(
    column: pa.ChunkedArray, *, day_first: bool | None = None
) -> tuple[list[datetime | None], dict[str, int]]:
    """Return a column of dates as UTC times, and what could not be told.

    Parameters
    ----------
    column
        Dates, timestamps, seconds or milliseconds since 1970, or text: ISO 8601, or day, month and year with either
        first.
    day_first
        Whether `1/2/2022` is in February. By default what the other dates of the column show: those that can be read
        in one way only, when at least 95 % of these agree; else such a date is left out and counted.
    """
    values = _values(column)
    unique = {value for value in values if value is not None}
    dated = {value: _DATE.fullmatch(value.strip()) for value in unique if isinstance(value, str)}
    order = _order(values, dated) if day_first is None else day_first
    read = {value: _time(value, dated.get(value), day_first=order) for value in unique}
    times = [None if value is None else read[value] for value in values]
    bad = sum(value is not None and read[value] is None and value != "" for value in values)
    return times, {"dates that cannot be read or could be day or month first": bad} if bad else {}


def _values(column: pa.ChunkedArray) -> list[Any]:
    """Return a column as Python's values; a timestamp that is no time of a clock as a text that is none either."""
    if not pa.types.is_timestamp(column.type) and not pa.types.is_date(column.type):
        return list(column.to_pylist())
    sound = sound_times(column)
    lost = pc.and_(pc.is_valid(column), pc.is_null(sound)).to_pylist()
    return ["no time" if is_lost else value for value, is_lost in zip(sound.to_pylist(), lost, strict=True)]


def _facing(text: str) -> float:
    plain = text.strip().rstrip("°").strip()
    if plain.upper() in COMPASS_DEG:
        return COMPASS_DEG[plain.upper()]
    if plain.lower() in _COMPASS_WORDS:
        return _COMPASS_WORDS[plain.lower()]
    number = float(parse_numbers([plain])[0])
    return number % 360.0 if -360.0 <= number <= 360.0 else np.nan  # noqa: PLR2004  (a full turn)


def _order(values: Sequence[Any], dated: Mapping[str, re.Match[str] | None]) -> bool | None:
    """Return whether days come first in a column, None when its dates do not say."""
    matches = [dated.get(value) for value in values if isinstance(value, str)]
    pairs = [(int(m[1]), int(m[2])) for m in matches if m and len(m[1]) <= 2]  # noqa: PLR2004  (no year first)
    days = sum(first > _MONTHS for first, _ in pairs)
    months = sum(second > _MONTHS for _, second in pairs)
    if not days + months:
        return None
    share = days / (days + months)
    return True if share >= _PREVAILING else False if share <= 1 - _PREVAILING else None


def _time(value: Any, match: re.Match[str] | None, *, day_first: bool | None) -> datetime | None:
    """Return one value as a time in UTC, None when it is none."""
    try:
        if match:
            return _written(match, day_first=day_first)
        if isinstance(value, int | float):
            return _epoch(float(value))
        if isinstance(value, date) and not isinstance(value, datetime):
            return datetime(value.year, value.month, value.day, tzinfo=UTC)
        return _utc(value) if isinstance(value, datetime) else _stated(str(value).strip())
    except (ValueError, OverflowError, OSError):
        return None


def _stated(text: str) -> datetime | None:
    """Return a text without separators of day, month and year: a count since 1970, or ISO 8601."""
    is_count = text.isdigit() and len(text) > len("20220131")
    return _epoch(float(text)) if is_count else _utc(datetime.fromisoformat(text))


def _written(match: re.Match[str], *, day_first: bool | None) -> datetime | None:
    one, two, three = (int(match[group]) for group in (1, 2, 3))
    if len(match[1]) == 4:  # noqa: PLR2004  (a year)
        year, month, day = one, two, three
    elif one > _MONTHS or two > _MONTHS:
        year, month, day = three, min(one, two), max(one, two)
        month, day = (two, one) if one > _MONTHS else (one, two)
    elif one == two:
        year, month, day = three, one, two
    elif day_first is None and "." not in match.string[: match.end(3)]:  # with points the day comes first anywhere
        return None
    else:
        year, month, day = (three, one, two) if day_first is False else (three, two, one)
    if year < 100:  # noqa: PLR2004  (of this century)
        year += 2000
    clock = f"T{match[4].strip()}" if match[4] else ""
    return _utc(datetime.fromisoformat(f"{year:04d}-{month:02d}-{day:02d}{clock}"))


def _utc(time: datetime) -> datetime:
    return time.astimezone(UTC) if time.tzinfo else time.replace(tzinfo=UTC)


def _epoch(number: float) -> datetime | None:
    if not abs(number) >= _EPOCH_S:
        return None
    return datetime.fromtimestamp(number / 1000.0 if abs(number) >= _EPOCH_MS else number, tz=UTC)
