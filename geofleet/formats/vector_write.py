"""A `signs` or `lanes` table as a layer of a GIS format, by the suffix of the file, without loss."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import pyarrow as pa
import pyarrow.compute as pc

from geofleet.formats.geojson import write_geojson
from geofleet.formats.geopackage import write_geopackage
from geofleet.tables.store import atomic_path, to_geodataframe

if TYPE_CHECKING:
    from geopandas import GeoDataFrame

    from geofleet.tables.schemas import Schema

_EXACT_DECIMALS = 15  # of degrees: a double needs no more


def write_geojson_layer(schema: Schema, table: pa.Table, path: Path) -> None:  # noqa: ARG001  (as its sisters)
    """Write a table as RFC 7946 GeoJSON, atomically, its coordinates in full."""
    write_geojson(_frame(table), path, decimals=_EXACT_DECIMALS)


def write_geopackage_layer(schema: Schema, table: pa.Table, path: Path) -> None:
    """Write a table as the one layer of a GeoPackage, atomically."""
    write_geopackage({schema.name: (_frame(table), schema.geometry)}, path)


def write_flatgeobuf_layer(schema: Schema, table: pa.Table, path: Path) -> None:
    """Write a table as FlatGeobuf with a spatial index, atomically."""
    import pyogrio  # noqa: PLC0415  (loads GDAL, which only writing needs)

    with atomic_path(path) as draft, TemporaryDirectory(dir=path.parent) as folder:
        whole = Path(folder) / f"{schema.name}.fgb"  # under any other suffix GDAL makes a folder
        pyogrio.write_dataframe(
            _frame(table), whole, driver="FlatGeobuf", layer=path.stem, geometry_type=schema.geometry
        )
        whole.rename(draft)


def _frame(table: pa.Table) -> GeoDataFrame:
    """Return a table as a frame that GDAL can hold without loss.

    Whole numbers beside nulls stay whole. GDAL's times are of milliseconds: a column with finer ones goes as text.
    """
    for index, field in enumerate(table.schema):
        if pa.types.is_timestamp(field.type) and _is_finer(table[field.name]):
            table = table.set_column(index, field.name, _as_text(table[field.name]))
    frame = to_geodataframe(table)
    for field in table.schema:
        if pa.types.is_integer(field.type):
            frame[field.name] = frame[field.name].astype("Int64")
    return frame


def _is_finer(times: pa.ChunkedArray) -> bool:
    return bool(pc.any(pc.not_equal(pc.microsecond(times), 0)).as_py())


def _as_text(times: pa.ChunkedArray) -> pa.Array:
    return pa.array([None if time is None else time.isoformat() for time in times.to_pylist()], pa.string())
