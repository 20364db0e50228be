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
from geofleet.formats.drive_epochs import NO_EPOCH, NO_POSITION, Epochs
from geofleet.formats.drive_layout import detect, layout_of
from geofleet.formats.drive_places import LocalCrs, local_crs, to_places
from geofleet.formats.drive_times import guess_format, n_without_zone, numbers_of, times_of, times_of_velocity
from geofleet.formats.gnss_time import gps_week_time, gpst_to_utc
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
_CLOCK = r"\d{1,2}:\d{2}(:\d{1,2}([.,]\d*)?)?"


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
        Thing to column: `time`, or `week` and `tow`, with `date` where `time` is a time of day; `x`, `y` and `height`
        (or Earth-centred z); `speed`, `quality`, `satellites`, `sigma_e`, `sigma_n`; `drive` for a file of several
        drives; `time_format`, one of `TIME_FORMATS`. Or a TOML file with a table `columns` and, beside it, `crs`,
        `origin`, `time_format`, `day_first`, `delimiter` and `encoding`. In numbers a comma may be the decimal point.
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
    found = dict.fromkeys(notes, int(placed.sum())) | told
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


def _times(
    frame: pd.DataFrame, layout: Layout, lon: Floats, lat: Floats
) -> tuple[NDArray[np.datetime64], Floats | None, dict[str, int]]:
    """Return UTC, seconds where the file does not say since when, and what to tell."""
    names = layout.columns
    unknown = np.full(len(frame), "NaT", "datetime64[us]")
    if "week" in names and "tow" in names and "time" not in names:
        gpst = gps_week_time(_numbers(frame, names["week"]), _numbers(frame, names["tow"]))
        return gpst_to_utc(gpst), None, {}
    if "time" in names:
        text = _text_of_times(frame, names["time"], names.get("date"))
        told = {}
        chosen = layout.time_format
        if chosen in (None, "velocity"):
            chosen = guess_format(text)
            told[f"times read as {chosen} (guessed)"] = len(text)
        t_utc, elapsed_s = times_of(text, chosen, day_first=layout.day_first)
        if chosen == "iso":
            n_bad = int((text.notna() & np.isnat(t_utc)).sum())
            n_bare = 0 if "utc" in names["time"].lower() else n_without_zone(text[~np.isnat(t_utc)])
            told |= {"times without a zone, taken as UTC": n_bare, f"times that cannot be read{_DAY_OR_MONTH}": n_bad}
        return t_utc, elapsed_s, {name: n for name, n in told.items() if n}
    if "speed" in names:
        elapsed_s = times_of_velocity(lon, lat, _numbers(frame, names["speed"]))
        return unknown, elapsed_s, {"no times: seconds derived from the speeds": len(frame)}
    return unknown, None, {}


def _text_of_times(frame: pd.DataFrame, time: str, date: str | None) -> pd.Series[str]:
    """Return the column of times; with that of the dates before it where it holds but times of the day."""
    text = frame[time].str.strip()
    if date is None or not text.str.fullmatch(_CLOCK).all():
        return text
    return frame[date].str.strip() + " " + text


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
