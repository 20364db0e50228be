"""Trajectories in columns of text: by a packaged profile, by columns that are named, or by names that speak.

A profile is recognised by the header when one only fits; whatever is given overrides it. Which one was taken, and each
guess, is told in the counts.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from geofleet.errors import InputError
from geofleet.formats.drive_dates import dated, n_without_zone
from geofleet.formats.drive_degrees import SCALED, degrees_of
from geofleet.formats.drive_epochs import NO_EPOCH, NO_POSITION, Epochs
from geofleet.formats.drive_layout import detect, layout_of
from geofleet.formats.drive_names import DATE_PARTS
from geofleet.formats.drive_places import LocalCrs, is_geographic, local_crs, to_places
from geofleet.formats.drive_times import (
    RELATIVE_S,
    guess_format,
    numbers_of,
    times_of,
    times_of_velocity,
    unit_by_speed,
)
from geofleet.formats.gnss_time import gps_week_time, gpst_to_utc, microseconds
from geofleet.formats.reading import refuse_long_lines

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.formats.drive_layout import Layout

    Floats = NDArray[np.float64]

__all__ = ["detect", "read_epochs", "stated_crs"]

_QUALITIES = {"fixed", "float", "sbas", "dgps", "single", "ppp", "derived"}
_DAY_OR_MONTH = ", or could have the day or the month first (say day_first in a TOML file)"
_MS_OF_WEEK = 604_800.0  # as seconds, none is larger


def stated_crs(
    path: Path,
    *,
    columns: Mapping[str, str] | Path | None = None,
    crs: str | None = None,
    origin: tuple[float, float] | None = None,
    utm: tuple[str, float, float] | None = None,
) -> str:
    """Return the CRS that `read_epochs` takes a file to be in; parameters and errors as there."""
    return _settled(path, columns, crs, origin, utm)[1].crs


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
        Thing to column: `time` (with `nanoseconds` beside whole seconds, and `date` where it is a time of day), or
        `week` and `tow`, or `year` to `second`; `x` and `y` (with `x_side` and `y_side` where the hemisphere is a
        column of its own), or `lat_lon`; `height` (or Earth-centred z), `speed`, `quality`, `satellites`, `sigma_e`,
        `sigma_n`; `drive` for a file of several drives; `time_format`, one of `TIME_FORMATS`. Or a TOML file with a
        table `columns` and, beside it, `crs`, `origin`, `time_format`, `day_first`, `delimiter` and `encoding`. In
        numbers a comma may be the decimal point.
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
    layout, local, notes = _settled(path, columns, crs, origin, utm)
    frame, n_broken = _read(path, layout)
    lost = sorted(set(layout.columns.values()) - set(frame.columns))
    if lost:
        raise InputError(
            f"the line of names cannot be read: {', '.join(lost)[:100]} is lost.",
            where=str(path),
            todo="Look at the quotes in it.",
        )
    x, y, made_of = _coordinates(frame, layout, local)
    has_heights = set(made_of).isdisjoint(SCALED.values())  # they may be in any unit then
    z = _numbers(frame, layout.columns.get("height") if has_heights else None)
    lon, lat, height_m = to_places(x, y, z, local, where=str(path))
    t_utc, elapsed_s, told = _times(frame, layout, lon, lat)
    has_clock = not {"time", "tow", "year"}.isdisjoint(layout.columns)
    epochs = Epochs.of(
        lon,
        lat,
        t_utc=t_utc,
        elapsed_s=elapsed_s,
        has_clock=has_clock,
        height_m=height_m,
        n_satellites=_numbers(frame, layout.columns.get("satellites")),
        quality=_qualities(frame, layout.columns.get("quality")),
        sigma_e_m=_positive(_numbers(frame, layout.columns.get("sigma_e"))),
        sigma_n_m=_positive(_numbers(frame, layout.columns.get("sigma_n"))),
    )
    readable, placed = np.isfinite(x) & np.isfinite(y), epochs.is_placed()
    if not placed.any():
        raise InputError(
            f"holds no epoch with a position ({len(frame)} lines read).",
            where=str(path),
            todo="Name the columns: --columns time=…,x=…,y=…." if len(frame) else "Export it again.",
        )
    skipped = {NO_EPOCH: n_broken + int((~readable).sum()), NO_POSITION: int((readable & ~placed).sum())}
    found = dict.fromkeys([*notes, *made_of], int(placed.sum())) | told
    return _split_drives(epochs, frame, layout.columns.get("drive"), placed), skipped, found


def _settled(
    path: Path,
    columns: Mapping[str, str] | Path | None,
    crs: str | None,
    origin: tuple[float, float] | None,
    utm: tuple[str, float, float] | None,
) -> tuple[Layout, LocalCrs, list[str]]:
    """Return how to read a file, its CRS, and what to tell about both; what the caller gives wins."""
    is_given = not (crs is None and origin is None and utm is None)
    layout = layout_of(path, columns, is_projected=is_given)
    if is_given:
        return layout, local_crs(crs, origin, utm), list(layout.told)
    start = layout.origin
    notes = [f"origin {start[0]}, {start[1]} of the profile or the TOML file"] if start else []
    return layout, local_crs(layout.crs, start, None), [*layout.told, *notes]


def _read(path: Path, layout: Layout) -> tuple[pd.DataFrame, int]:
    """Return the lines as text columns, and how many have more fields than there are columns."""
    try:
        with warnings.catch_warnings():  # of lines with more fields than the header the rest is left out
            warnings.simplefilter("ignore", pd.errors.ParserWarning)
            frame = pd.read_csv(
                path,
                sep=layout.delimiter,
                names=list(layout.names) or None,
                header=None if layout.names else 0,
                index_col=False,
                dtype=str,
                skiprows=layout.n_before,
                encoding="utf-8-sig" if layout.encoding == "utf-8" else layout.encoding,
                encoding_errors="replace",
                quoting=0,
                on_bad_lines="skip",
                skipinitialspace=True,
            )
    except (pd.errors.ParserError, pd.errors.EmptyDataError, ValueError, LookupError) as error:
        raise InputError(f"cannot be read as columns ({error}).", where=str(path), todo="Export it again.") from None
    frame.columns = [str(name).strip().strip('"') for name in frame.columns]
    if layout.prefix:
        frame = frame[frame.iloc[:, 0] == layout.prefix].reset_index(drop=True)
    with path.open("rb") as file:
        n_lines = sum(bool(line.strip(b"\0\r\n \t")) for line in file) - layout.n_before - (not layout.names)
    return frame, max(n_lines - len(frame), 0)


def _coordinates(frame: pd.DataFrame, layout: Layout, local: LocalCrs) -> tuple[Floats, Floats, list[str]]:
    """Return x and y, and what was made of them, for the user."""
    if "lat_lon" in layout.columns or is_geographic(local.crs):
        return degrees_of(frame, layout.columns)
    return _numbers(frame, layout.columns["x"]), _numbers(frame, layout.columns["y"]), []


def _times(
    frame: pd.DataFrame, layout: Layout, lon: Floats, lat: Floats
) -> tuple[NDArray[np.datetime64], Floats | None, dict[str, int]]:
    """Return UTC, seconds where the file does not say since when, and what to tell."""
    names = layout.columns
    unknown = np.full(len(frame), "NaT", "datetime64[us]")
    if "time" in names or set(DATE_PARTS) <= names.keys():
        return _of_time(frame, layout, lon, lat)
    if "week" in names and "tow" in names:
        tow = _numbers(frame, names["tow"])
        is_ms = bool(np.nanmax(tow, initial=0.0) > _MS_OF_WEEK)
        gpst = gps_week_time(_numbers(frame, names["week"]), tow / 1000.0 if is_ms else tow)
        return gpst_to_utc(gpst), None, {"times of week read as milliseconds (guessed)": len(frame)} if is_ms else {}
    if "speed" in names:
        elapsed_s = times_of_velocity(lon, lat, _numbers(frame, names["speed"]))
        return unknown, elapsed_s, {"no times: seconds derived from the speeds": len(frame)}
    return unknown, None, {}


def _of_time(
    frame: pd.DataFrame, layout: Layout, lon: Floats, lat: Floats
) -> tuple[NDArray[np.datetime64], Floats | None, dict[str, int]]:
    """Return UTC, or seconds, of the column of times, and what to tell."""
    names, chosen = layout.columns, layout.time_format
    text, told = _text_of_times(frame, names, day_first=layout.day_first)
    is_guessed = chosen in (None, "velocity")
    chosen = guess_format(text, names.get("time", "")) if is_guessed or chosen is None else chosen
    t_utc, elapsed_s = times_of(text, chosen, day_first=layout.day_first)
    if is_guessed and chosen == RELATIVE_S and elapsed_s is not None:
        chosen = unit_by_speed(elapsed_s, lon, lat)
        t_utc, elapsed_s = times_of(text, chosen)
    if is_guessed:
        told[f"times read as {chosen} (guessed)"] = len(text)
    if "nanoseconds" in names:
        rest_s = _numbers(frame, names["nanoseconds"]) * 1e-9
        t_utc, elapsed_s = t_utc + microseconds(rest_s), None if elapsed_s is None else elapsed_s + rest_s
    if chosen == "iso":
        is_lost = text.notna().to_numpy(bool) & np.isnat(t_utc)
        is_utc = any("utc" in names.get(thing, "").lower() for thing in ("time", "date"))
        n_bare = 0 if is_utc else n_without_zone(text[~np.isnat(t_utc)])
        told |= {"times without a zone, taken as UTC": n_bare}
        if is_lost.any():
            told[f"times that cannot be read, such as {text[is_lost].iloc[0][:40]!r}{_DAY_OR_MONTH}"] = int(
                is_lost.sum()
            )
    return t_utc, elapsed_s, {name: n for name, n in told.items() if n}


def _text_of_times(
    frame: pd.DataFrame, names: Mapping[str, str], *, day_first: bool | None
) -> tuple[pd.Series[str], dict[str, int]]:
    """Return the times as text, with their dates before them where those stand in other columns; and what to tell."""
    if "time" not in names:
        parts = [frame[names[part]].str.strip().str.replace(r"\.0*$", "", regex=True) for part in DATE_PARTS[:-1]]
        year, month, day, hour, minute = (part.str.zfill(2) for part in parts)
        second = frame[names["second"]].str.strip().str.replace(r"^(\d)(?=\.|$)", r"0\1", regex=True)
        return year + "-" + month + "-" + day + "T" + hour + ":" + minute + ":" + second, {}
    time = frame[names["time"]].str.strip()
    return dated(frame[names["date"]].str.strip(), time, day_first=day_first) if "date" in names else (time, {})


def _split_drives(
    epochs: Epochs, frame: pd.DataFrame, column: str | None, placed: NDArray[np.bool_]
) -> dict[str, Epochs]:
    if not column:
        return {"": epochs.take(placed)}
    number, names = pd.factorize(frame[column].fillna("").str.strip())  # numpy takes "a\0" for "a" where it compares
    return {names[n]: epochs.take(placed & (number == n)) for n in dict.fromkeys(number[placed].tolist())}


def _numbers(frame: pd.DataFrame, column: str | None) -> Floats:
    if not column:
        return np.full(len(frame), np.nan)
    return numbers_of(frame[column])


def _positive(sigma_m: Floats) -> Floats:
    return np.where(sigma_m > 0, sigma_m, np.nan)


def _qualities(frame: pd.DataFrame, column: str | None) -> NDArray[np.object_]:
    """Return names of fix qualities; a number means nothing without its receiver and is left out."""
    if not column:
        return np.full(len(frame), None, object)
    text = frame[column].fillna("").str.strip().str.lower()
    return text.where(text.isin(_QUALITIES), None).to_numpy(object)
