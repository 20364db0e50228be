"""Which column of a detections file means what, and its values as the schema wants them."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.errors import ConfigError
from geofleet.formats.drive_times import guess_format, times_of
from geofleet.formats.inventory_columns import numbers, parse_numbers, read_options
from geofleet.tables.arrays import sound_times
from geofleet.tables.schemas import TIME

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

# Thing to the names that people give it, most telling first; compared in lower case, letters and digits only
NAMES = {
    "sign_class": "signclass",
    "raw_code": "rawcode code trafficsigncode trafficsign signcode mutcdcode mutcd classname label value objectvalue "
    "class signtype zeichen verkehrszeichen vz type",
    "country": "country countrycode",
    "x": "lon longitude lng long länge laenge längengrad laengengrad x easting",
    "y": "lat latitude breite breitengrad y northing",
    "geometry": "wkt geometry geom",
    "run_id": "runid",
    "vehicle_id": "vehicleid vehicle carid car deviceid fahrzeug",
    "pass_id": "passid pass tripid trip driveid sequenceid",
    "track_id": "trackid track",
    "t_first": "tfirst firstseenat firstseen timestamp timestampms tutc time datetime ts zeit zeitstempel t",
    "t_last": "tlast lastseenat lastseen",
    "frame_first": "framefirst",
    "frame_last": "framelast",
    "n_frames": "nframes frames",
    "sigma_e_m": "sigmaem sigmae",
    "sigma_n_m": "sigmanm sigman",
    "cov_en_m2": "covenm2",
    "range_mean_m": "rangemeanm range",
    "view_deg": "viewdeg viewdirection",
    "class_confidence": "classconfidence confidence score probability konfidenz",
}
FLOATS = ("sigma_e_m", "sigma_n_m", "cov_en_m2", "range_mean_m", "view_deg", "class_confidence")
INTEGERS = ("frame_first", "frame_last", "n_frames")
TIMES = ("t_first", "t_last")
_OPTIONS = ("crs", "scheme", "country", "run_id")
_MAX_EXACT = 2.0**53
_ROUNDING = 1.0 + 1e-6


def given_columns(columns: Mapping[str, str] | Path | None) -> tuple[dict[str, str], dict[str, Any]]:
    """Return the columns and, from a TOML file, the options beside them.

    Raises
    ------
    ConfigError
        A thing or an option is unknown.
    """
    options: dict[str, Any] = {}
    if isinstance(columns, Path):
        options = read_options(columns)
        named = dict(options.pop("columns", {}))
    else:
        named = dict(columns or {})
    aliases = {"lon": "x", "lat": "y", "class": "sign_class", "code": "raw_code"}
    named = {aliases.get(thing, thing): column for thing, column in named.items()}
    unknown = sorted((set(named) - set(NAMES)) | (set(options) - set(_OPTIONS)))
    if unknown:
        raise ConfigError(
            f"unknown: {', '.join(unknown)}.",
            where="--columns",
            todo=f"Columns are for {', '.join(NAMES)}; options {', '.join(_OPTIONS)}.",
        )
    return {thing: str(column) for thing, column in named.items()}, options


def choose_columns(
    names: Sequence[str], given: Mapping[str, str], *, has_geometry: bool
) -> tuple[dict[str, str], list[str]]:
    """Choose a column for each thing: what is given, else by its name.

    Returns
    -------
    tuple of dict and list
        The choice, and the things that were guessed by another name than their own.

    Raises
    ------
    ConfigError
        A column that is given is not in the file.
    """
    for thing, name in given.items():
        if name not in names:
            raise ConfigError(
                f"there is no column {name!r} for {thing}.", todo=f"Columns are {', '.join(names)[:400]}."
            )
    plain = {re.sub(r"[\W_]+", "", name.lower()): name for name in reversed(names)}
    chosen, taken, guessed = dict(given), set(given.values()), []
    for thing, known in NAMES.items():
        if thing in chosen or (thing in {"x", "y", "geometry"} and has_geometry):
            continue
        if thing == "raw_code" and "sign_class" in chosen:
            known = "rawcode"  # noqa: PLW2901  (a class is told already: only what is called a raw code is one)
        name = next((plain[n] for n in known.split() if n in plain and plain[n] not in taken), "")
        if name:
            chosen[thing] = name
            taken.add(name)
            guessed += [thing] if name != thing else []
    return chosen, guessed


def text_column(table: pa.Table, name: str | None) -> pa.Array:
    """Return a column as text without blanks around it; empty text is null."""
    if not name:
        return pa.nulls(table.num_rows, pa.string())
    column = table[name].combine_chunks()
    if pa.types.is_dictionary(column.type):
        column = column.dictionary_decode()
    if pa.types.is_floating(column.type):
        whole = pc.equal(column, pc.round(column))
        as_integer = pc.if_else(pc.and_(whole, pc.less(pc.abs(column), _MAX_EXACT)), column, None)
        integers = as_integer.cast(pa.int64(), safe=False).cast(pa.string())
        column = pc.coalesce(integers, pc.if_else(pc.is_finite(column), column, None).cast(pa.string()))
    text = pc.utf8_trim_whitespace(column.cast(pa.string()))
    return pc.if_else(pc.equal(text, ""), None, text)


def number_column(table: pa.Table, name: str | None) -> Floats:
    """Return a column as numbers, NaN where it holds none."""
    values = numbers(table, name or "")
    return np.where(np.isfinite(values), values, np.nan)


def share_column(table: pa.Table, name: str | None) -> tuple[Floats, int]:
    """Return a column as numbers, `90%` as 0.9, and how many texts are neither."""
    values = number_column(table, name)
    if not name or not np.isnan(values).any() or pa.types.is_floating(table.schema.field(name).type):
        return values, 0
    text = text_column(table, name)
    share = pc.if_else(pc.ends_with(text, "%"), pc.utf8_rtrim(text, "% "), None)
    parsed = parse_numbers(share.to_pylist()) / 100.0
    values = np.where(np.isnan(values), parsed, values)
    return values, int((pc.is_valid(text).to_numpy(zero_copy_only=False) & np.isnan(values)).sum())


def integer_column(table: pa.Table, name: str | None) -> tuple[pa.Array, int]:
    """Return a column as whole numbers, and how many values are none."""
    if name and pa.types.is_integer(table.schema.field(name).type):
        return table[name].combine_chunks().cast(pa.int64(), safe=False), 0
    values = number_column(table, name)
    whole = np.isfinite(values) & (values == np.round(values)) & (np.abs(values) < _MAX_EXACT)
    bad = int((pc.is_valid(text_column(table, name)).to_numpy(zero_copy_only=False) & ~whole).sum()) if name else 0
    return pa.array(np.where(whole, values, 0.0).astype(np.int64), mask=~whole), bad


def number_of_track(table: pa.Table, name: str | None) -> pa.Array:
    """Return the track ids as whole numbers; text gets the number that its hash is, the same wherever it stands."""
    numbers_, n_other = integer_column(table, name)
    if not n_other:
        return numbers_
    text = text_column(table, name).dictionary_encode()
    hashes = [
        int.from_bytes(hashlib.blake2b(one.encode(), digest_size=8).digest(), "big") >> 1
        for one in text.dictionary.to_pylist()
    ]
    return pc.coalesce(numbers_, pa.array(hashes, pa.int64()).take(text.indices))


def leave_out_impossible(columns: dict[str, Any]) -> dict[str, int]:
    """Set what no detection can have to null, in place; return how many values by reason."""
    sigma_e, sigma_n, covariance = (
        columns[name].to_numpy(zero_copy_only=False) for name in ("sigma_e_m", "sigma_n_m", "cov_en_m2")
    )
    confidence = columns["class_confidence"].to_numpy(zero_copy_only=False)
    distance = columns["range_mean_m"].to_numpy(zero_copy_only=False)
    with np.errstate(invalid="ignore"):
        wrong = {
            "sigma_e_m": ("below zero", sigma_e < 0),
            "sigma_n_m": ("below zero", sigma_n < 0),
            "cov_en_m2": ("beyond what the sigmas allow", np.abs(covariance) > sigma_e * sigma_n * _ROUNDING),
            "class_confidence": ("outside of 0 to 1", (confidence < 0) | (confidence > 1)),
            "range_mean_m": ("below zero", distance < 0),
            "n_frames": ("below one", pc.fill_null(pc.less(columns["n_frames"], 1), fill_value=False)),
            "t_last": (
                "before t_first",
                pc.fill_null(pc.less(columns["t_last"], columns["t_first"]), fill_value=False),
            ),
        }
    counts = {}
    for name, (reason, flags) in wrong.items():
        is_wrong = pa.array(flags)
        columns[name] = pc.if_else(is_wrong, None, columns[name])
        counts[f"{name} {reason}, left out"] = int(pc.sum(is_wrong).as_py() or 0)
    return counts


def time_column(table: pa.Table, name: str | None) -> tuple[pa.Array, int]:
    """Return a column as times in UTC, and how many values are none.

    Timestamps, ISO 8601, counts since 1970 in any unit, or dates with day, month and year where they are unambiguous.
    """
    if not name:
        return pa.nulls(table.num_rows, TIME), 0
    column = table[name].combine_chunks()
    if pa.types.is_timestamp(column.type):
        times = sound_times(column)
        return times.cast(TIME), times.null_count - column.null_count
    text = pd.Series(text_column(table, name).to_numpy(zero_copy_only=False), dtype="string")
    known = text.notna()
    if not known.any():
        return pa.nulls(table.num_rows, TIME), 0
    t_utc, _ = times_of(text, guess_format(text[known]))
    lost = known.to_numpy(bool) & np.isnat(t_utc)
    return pa.array(t_utc, pa.timestamp("us")).cast(TIME), int(lost.sum())
