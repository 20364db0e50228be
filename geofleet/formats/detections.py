"""Detections of a real fleet as `detections`: any column names, CRS and class scheme; bad rows set apart.

A row needs a position and a class or code. Without a pass of its own a row is a pass by itself; a pass id counts within
its vehicle. What a file does not say stays null. Rows that cannot be used come back with the reason and their text.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from geofleet.errors import InputError
from geofleet.formats.datum import datum_of
from geofleet.formats.detection_columns import (
    FLOATS,
    INTEGERS,
    TIMES,
    choose_columns,
    given_columns,
    integer_column,
    leave_out_impossible,
    number_of_track,
    share_column,
    text_column,
    time_column,
)
from geofleet.formats.detection_files import read_batches
from geofleet.formats.inventory_codes import OSM, guess_country, scheme_of
from geofleet.formats.inventory_columns import coordinates
from geofleet.formats.inventory_places import geometry_reader
from geofleet.formats.positions import country_at, doubts, reject_null_island, to_lonlat
from geofleet.formats.reading import WGS84
from geofleet.tables.schemas import DETECTIONS
from geofleet.tables.store import build_table
from geofleet.taxonomy import load_taxonomy
from geofleet.taxonomy.reader import RAW_PREFIX

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.formats.detection_files import Batch
    from geofleet.formats.reading import Datum

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

NO_VEHICLE, NO_RUN = "fleet", "fleet"
REJECTED = pa.schema([("reason", pa.string()), ("source", pa.string()), ("row", pa.int64()), ("content", pa.string())])
_CRS84 = "OGC:CRS84"
_MAX_LAT_DEG = 85.05  # beyond it no tile owns a sign
_POINT = 0
_TRACK_AGAIN = "rows of a track that came before: one row a track is meant, aggregation takes the first"
_PREFIXED = re.compile(r"[A-Z]{2}:")


@dataclass(frozen=True, slots=True)
class DetectionsRead:
    """Some rows of a file: those that can be used as a `detections` table, the others as `REJECTED`."""

    table: pa.Table
    rejected: pa.Table
    skipped: dict[str, int] = field(default_factory=dict)
    found: dict[str, int] = field(default_factory=dict)
    datum: Datum = WGS84


@dataclass(frozen=True, slots=True)
class _Plan:
    """How the rows of a file are read; settled at its first batch."""

    columns: dict[str, str]
    crs: Any
    scheme: str
    country: str | None
    run_id: str
    rows_before: int


def read_detections(
    path: Path,
    *,
    columns: Mapping[str, str] | Path | None = None,
    crs: str | None = None,
    scheme: str | None = None,
    country: str | None = None,
    run_id: str | None = None,
    rows_before: int = 0,
) -> Iterator[DetectionsRead]:
    """Read detections, a batch at a time.

    Parameters
    ----------
    path
        CSV, GeoJSON, GeoJSON text sequence, Esri JSON, GeoPackage, FlatGeobuf, Shapefile or (Geo)Parquet.
    columns
        Thing to column: `x` and `y` or `geometry`; `sign_class` or `raw_code`; any other column of the table. Or a TOML
        file with a table `columns` and, beside it, `crs`, `scheme`, `country` and `run_id`. Columns not named are
        guessed by their names.
    crs
        Overrides what the file says; without either it is OGC:CRS84.
    scheme, country
        Of the codes: `mapillary`, `osm`, `vienna` or a national scheme; ISO 3166-1 alpha-2. By default what most codes
        of the first batch look like. A column `sign_class` holds classes of geofleet unless a scheme is given.
    run_id
        Of rows that do not name one.
    rows_before
        Rows of other files before this one: rows without a pass are numbered on.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or of another format, has no position or class, or its positions contradict
        the CRS.
    ConfigError
        A column that is given is unknown.
    """
    named, options = given_columns(columns)
    crs, scheme = crs or options.get("crs"), scheme or options.get("scheme")
    country, run_id = country or options.get("country"), run_id or options.get("run_id") or NO_RUN
    plan = None
    for batch in read_batches(path):
        found: Counter[str] = Counter()
        if plan is None:
            chosen, guessed = choose_columns(
                batch.table.column_names, named, has_geometry=batch.geometry is not None and "x" not in named
            )
            _require(chosen, batch, path)
            found.update(dict.fromkeys(batch.notes, 1))
            found.update({f"{thing} read from column {chosen[thing]} (guessed)": 1 for thing in guessed})
            plan = _Plan(chosen, crs or batch.crs or _CRS84, scheme or "", country, run_id, rows_before)
            plan = _settled(plan, batch, path, found)
            found[_TRACK_AGAIN] += _n_again(batch, plan)
        yield _read(batch, plan, path, found)
    if plan is None:
        raise InputError("the file holds no rows.", where=str(path), todo="Fetch or export it again.")


def _require(chosen: Mapping[str, str], batch: Batch, path: Path) -> None:
    names = ", ".join(batch.table.column_names)[:300]
    if batch.geometry is None and not ({"x", "y"} <= chosen.keys() or "geometry" in chosen):
        raise InputError(
            f"no column looks like a position; there are {names}.", where=str(path), todo="Name them: --columns x=…,y=…"
        )
    if not {"sign_class", "raw_code"} & chosen.keys():
        raise InputError(
            f"no column looks like a class or code; there are {names}.",
            where=str(path),
            todo="Name it: --columns code=…",
        )


def _settled(plan: _Plan, batch: Batch, path: Path, found: Counter[str]) -> _Plan:
    """Tell scheme and country from the first rows, and what is doubtful about their places."""
    lon, lat = _places(batch, plan, path)
    placed = ~np.isnan(lon)
    country, scheme = plan.country, plan.scheme
    codes = text_column(batch.table, plan.columns.get("raw_code")).to_pylist()
    if not (scheme or country or "country" in plan.columns) and "sign_class" not in plan.columns:
        scheme = scheme_of(codes)
        if scheme:
            found[f"codes read as {scheme} (guessed)"] = 1
        elif placed.any():
            here = country_at(float(np.median(lon[placed])), float(np.median(lat[placed])))
            country = guess_country(codes, here)
            found[f"codes read as of {country} (guessed from codes and place)"] = int(country is not None)
    stated = Counter(text_column(batch.table, plan.columns.get("country")).drop_null().to_pylist())
    usual = country or (stated.most_common(1)[0][0].upper() if stated else None)
    found.update(doubts(lon[placed], lat[placed], usual, where=str(path)))
    return replace(plan, scheme=scheme, country=country)


def _n_again(batch: Batch, plan: _Plan) -> int:
    """Return how many of the first rows are of a track that came before: frames, where tracks are meant."""
    if not {"pass_id", "track_id"} <= plan.columns.keys():
        return 0
    keys = pa.table(_keys(batch.table, plan, np.arange(batch.table.num_rows)))
    return int(keys.num_rows - keys.group_by(keys.column_names).aggregate([]).num_rows)


def _read(batch: Batch, plan: _Plan, path: Path, found: Counter[str]) -> DetectionsRead:
    """Return the rows of a batch as a table, and those that are none."""
    table, chosen = batch.table, plan.columns
    row = np.arange(batch.first_row, batch.first_row + table.num_rows)
    lon, lat = _places(batch, plan, path)
    classes, raw, country, n_unknown = _classes(table, plan)
    reason = _reasons(batch, plan, (lon, lat), classes, path)
    good = pc.is_null(reason).to_numpy(zero_copy_only=False)
    columns: dict[str, Any] = {"sign_class": classes, "raw_code": raw, "country": country}
    columns |= _keys(table, plan, row)
    for name in FLOATS:
        values, n_bad = share_column(table, chosen.get(name))
        columns[name] = pa.array(values, from_pandas=True)
        found[f"{name} that cannot be read, left out"] += n_bad
    for reader, names in ((integer_column, INTEGERS), (time_column, TIMES)):
        for name in names:
            columns[name], n_bad = reader(table, chosen.get(name))
            found[f"{name} that cannot be read, left out"] += n_bad
    found.update(leave_out_impossible(columns))
    found["codes that the vocabulary does not know"] += n_unknown
    columns = {name: values.filter(pa.array(good)) for name, values in columns.items()}
    skipped = Counter(value for value in reason.to_pylist() if value)
    rejected = _rejected(batch, path, reason, row)
    if batch.broken:
        skipped["another number of fields than the header"] += len(batch.broken)
    return DetectionsRead(
        build_table(DETECTIONS, columns, (lon[good], lat[good])),
        rejected,
        dict(skipped),
        {name: count for name, count in found.items() if count},
        datum_of(plan.crs, lon[good], lat[good]),
    )


def _coordinates(batch: Batch, plan: _Plan) -> tuple[Floats, Floats]:
    """Return x and y as the file has them; NaN where there is no point."""
    chosen = plan.columns
    shapes = batch.geometry
    if "x" in chosen and "y" in chosen:
        return _degrees(batch.table, chosen["x"]), _degrees(batch.table, chosen["y"])
    if shapes is None:
        column = text_column(batch.table, chosen.get("geometry"))
        first = next(iter(column.drop_null().slice(0, 1).to_pylist()), "")
        text = column.to_numpy(zero_copy_only=False)
        shapes = np.asarray(geometry_reader(first)(text, on_invalid="ignore"), object)
    is_place = (shapely.get_type_id(shapes) == _POINT) & ~shapely.is_empty(shapes)
    places = np.full(len(shapes), None, object)
    places[is_place] = shapes[is_place]
    return shapely.get_x(places), shapely.get_y(places)


def _degrees(table: pa.Table, name: str) -> Floats:
    """Return a column as numbers; of texts that are none, degrees with minutes, seconds or a hemisphere."""
    values = coordinates(table, name)
    return np.where(np.isfinite(values), values, np.nan)


def _places(batch: Batch, plan: _Plan, path: Path) -> tuple[Floats, Floats]:
    x, y = _coordinates(batch, plan)
    return to_lonlat(x, y, plan.crs, where=str(path))


def _classes(table: pa.Table, plan: _Plan) -> tuple[pa.Array, pa.Array, pa.Array, int]:
    """Return classes, codes and countries, null where missing, and the number of codes that are not known."""
    chosen = plan.columns
    country = text_column(table, chosen.get("country"))
    if plan.country:
        country = pc.fill_null(country, plan.country)
    country = pc.utf8_upper(country)
    given = text_column(table, chosen.get("sign_class"))
    raw = text_column(table, chosen.get("raw_code"))
    if "sign_class" in chosen and not plan.scheme:
        return given, raw, country, _n_unknown(given)
    raw = pc.coalesce(raw, given)
    # each distinct pair of code and country is looked up once
    key = pc.binary_join_element_wise(raw, pc.fill_null(country, ""), "\x1f").dictionary_encode()
    pairs = [str(pair).split("\x1f") for pair in key.dictionary.to_pylist()]
    scheme = plan.scheme
    if scheme in {"", OSM}:  # OpenStreetMap's values name their country: DE:274[50]; without one they are its words
        pairs = [[code[3:], code[:2]] if _PREFIXED.match(code) else [code, land] for code, land in pairs]
        scheme = ""
    known = load_taxonomy().classify(
        [code for code, _ in pairs], country=[land or None for _, land in pairs], scheme=scheme or None
    )
    classes = pa.array(known.sign_class.tolist(), pa.string()).take(key.indices)
    is_known = pa.array(known.known.tolist(), pa.bool_()).take(key.indices)
    return classes, raw, country, int(pc.sum(pc.equal(is_known, False)).as_py() or 0)  # noqa: FBT003  (a value)


def _n_unknown(sign_class: pa.Array) -> int:
    """Return how many classes name no concept of the vocabulary; raw codes are meant to be none."""
    concepts = load_taxonomy().concepts
    counted = pc.value_counts(sign_class.drop_null())
    named = zip(counted.field("values").to_pylist(), counted.field("counts").to_pylist(), strict=True)
    return sum(n for name, n in named if name.partition(":")[0] not in concepts and not name.startswith(RAW_PREFIX))


def _keys(table: pa.Table, plan: _Plan, row: NDArray[np.int64]) -> dict[str, pa.Array]:
    """Return run, vehicle, pass and track of each row; a row without a pass is one by itself."""
    chosen = plan.columns
    number = pa.array(row + plan.rows_before)
    run = pc.fill_null(text_column(table, chosen.get("run_id")), plan.run_id)
    vehicle = pc.fill_null(text_column(table, chosen.get("vehicle_id")), NO_VEHICLE)
    stated = text_column(table, chosen.get("pass_id"))
    if "vehicle_id" in chosen:
        stated = pc.binary_join_element_wise(vehicle, stated, "/")
    own = pc.binary_join_element_wise("row", pc.utf8_lpad(number.cast(pa.string()), 10, "0"), "-")
    track = number_of_track(table, chosen.get("track_id"))
    in_pass = pc.if_else(pc.is_valid(stated), number, 0)  # a row number tells the tracks of a pass apart
    track = pc.if_else(pc.is_valid(stated), pc.coalesce(track, in_pass), 0)
    return {"run_id": run, "vehicle_id": vehicle, "pass_id": pc.coalesce(stated, own), "track_id": track}


def _reasons(batch: Batch, plan: _Plan, lonlat: tuple[Floats, Floats], classes: pa.Array, path: Path) -> pa.Array:
    """Return why each row cannot be used, null where it can."""
    lon, lat = lonlat
    x, y = _coordinates(batch, plan)
    stated = np.isfinite(x) & np.isfinite(y)
    placed = np.isfinite(lon) & np.isfinite(lat)
    null = np.zeros(len(lon), bool)
    null[placed] = reject_null_island(lon[placed], lat[placed], where=str(path))
    reasons = {
        "position missing or no number": ~stated,
        "position out of range": ~placed | (np.abs(lat) > _MAX_LAT_DEG),
        "position at 0° N 0° E, in the Gulf of Guinea": null,
        "class missing": pc.is_null(classes).to_numpy(zero_copy_only=False),
    }
    first = np.argmax(np.column_stack([np.zeros(len(lon), bool), *reasons.values()]), axis=1)
    return pa.array([None, *reasons], pa.string()).take(pa.array(first))


def _rejected(batch: Batch, path: Path, reason: pa.Array, row: NDArray[np.int64]) -> pa.Table:
    """Return the rows that cannot be used, as text."""
    bad = np.flatnonzero(pc.is_valid(reason).to_numpy(zero_copy_only=False))
    content = [json.dumps(one, default=str, ensure_ascii=False) for one in batch.table.take(bad).to_pylist()]
    if batch.geometry is not None:
        places = shapely.to_wkt(batch.geometry[bad])
        content = [f"{place} {text}" for place, text in zip(places, content, strict=True)]
    columns = [
        [*reason.take(pa.array(bad)).to_pylist(), *["another number of fields than the header"] * len(batch.broken)],
        [path.name] * (len(bad) + len(batch.broken)),
        [*row[bad].tolist(), *(number for number, _ in batch.broken)],
        [*content, *(text for _, text in batch.broken)],
    ]
    return pa.Table.from_arrays(
        [pa.array(values, field.type) for values, field in zip(columns, REJECTED, strict=True)], schema=REJECTED
    )
