"""geofleet's own `signs` and `lanes` tables back from GeoJSON, GeoPackage, FlatGeobuf or another export."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import shapely

from geofleet.errors import InputError
from geofleet.formats.datum import datum_of
from geofleet.formats.inventory_columns import numbers, parse_times, texts
from geofleet.formats.inventory_files import CRS84
from geofleet.formats.positions import to_lonlat
from geofleet.formats.reading import LayerRead
from geofleet.tables.schemas import LANES, SIGNS
from geofleet.tables.store import build_table

if TYPE_CHECKING:
    from pathlib import Path

    from geofleet.formats.inventory_files import Features
    from geofleet.tables.schemas import Column, Schema

_LINE = 1  # shapely.get_type_id


def is_own_layer(table: pa.Table, schema: Schema = SIGNS) -> bool:
    """Tell whether a table has every column that a `signs` table, or one of another schema, must have."""
    return {column.name for column in schema.columns if not column.nullable} <= set(table.column_names)


def own_lanes(path: Path, features: Features) -> LayerRead:
    """Return a `lanes` table exported before, as it was.

    Raises
    ------
    InputError
        The file is none, or a geometry is no line.
    """
    geometry = features.geometry
    if geometry is None or not is_own_layer(features.table, LANES):
        raise InputError(
            "holds no lanes.", where=str(path), todo="Give a map with roads, or lanes that geofleet wrote."
        )
    is_line = shapely.get_type_id(geometry) == _LINE
    if not is_line.all():
        raise InputError(
            f"a layer of lanes, but {int((~is_line).sum())} of {len(is_line)} rows are no lines.",
            where=str(path),
            todo="Export it again.",
        )
    x, y = shapely.get_coordinates(geometry).T
    crs = features.crs or CRS84
    lon, lat = to_lonlat(x, y, crs, where=str(path))
    if np.isnan(lon).any():
        raise InputError(
            f"{int(np.isnan(lon).sum())} positions are not valid.", where=str(path), todo="Export it again."
        )
    lines = shapely.set_coordinates(np.array(geometry, object), np.column_stack((lon, lat)))
    names = features.table.column_names
    columns = {c.name: _values(features.table, c) for c in LANES.all_columns if c.name in names}
    lanes = build_table(LANES, columns, lines)
    return LayerRead(lanes, features.file_format, features.skipped, features.found, datum_of(crs, lon, lat))


def own_layer(path: Path, features: Features, crs: Any = None) -> LayerRead:
    """Return a `signs` table exported before, as it was; columns that the schema does not know are left out.

    Raises
    ------
    InputError
        A geometry is no point or has no valid position: no export of ours has such.
    """
    geometry = features.geometry
    is_point = np.zeros(features.table.num_rows, bool)
    if geometry is not None:
        is_point = (shapely.get_type_id(geometry) == 0) & ~shapely.is_empty(geometry)
    if geometry is None or not is_point.all():
        raise InputError(
            f"a layer of signs, but {int((~is_point).sum())} of {len(is_point)} rows are no points.",
            where=str(path),
            todo="Export it again.",
        )
    place = (shapely.get_x(geometry), shapely.get_y(geometry))
    crs = crs or features.crs or CRS84
    lon, lat = to_lonlat(*place, crs, where=str(path))
    if np.isnan(lon).any():
        raise InputError(
            f"{int(np.isnan(lon).sum())} positions are not valid.", where=str(path), todo="Export it again."
        )
    names = features.table.column_names
    columns = {c.name: _values(features.table, c) for c in SIGNS.all_columns if c.name in names}
    left = sum(name not in columns for name in names)
    found = {"columns that are none of the signs table": left} if left else {}
    signs = build_table(SIGNS, columns, (lon, lat))
    return LayerRead(signs, features.file_format, features.skipped, features.found | found, datum_of(crs, lon, lat))


def _values(table: pa.Table, column: Column) -> Any:
    """Return a column in the type of the schema; formats without that type hold it as text."""
    if pa.types.is_timestamp(column.type):
        return pa.array(parse_times(table[column.name])[0], column.type)
    if pa.types.is_string(column.type):
        is_text = pa.types.is_string(table[column.name].type) or pa.types.is_large_string(table[column.name].type)
        text = table[column.name].to_pylist() if is_text else texts(table, column.name)
        return text if column.nullable else [value or "" for value in text]
    number = numbers(table, column.name)
    return pa.array(number, from_pandas=True).cast(column.type)
