"""GeoParquet files: built to a schema, checked against it, sorted by key, and there whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import uuid
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import shapely

from geofleet.errors import InputError, TableError
from geofleet.tables.arrays import arrow_numbers, arrow_texts
from geofleet.tables.schemas import BBOX, BBOX_TYPE, GEOMETRY, SCHEMAS, Schema

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

    import pyarrow.dataset as ds
    from geopandas import GeoDataFrame
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """Yield a path beside `path` to write a file or folder at; on success it takes the place of `path`.

    On failure nothing is left behind and what stood at `path` is untouched.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"cannot write here: {error.strerror}.", where=str(path)) from None
    draft = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.tmp")
    try:
        yield draft
        if draft.is_dir() and path.is_dir():
            old = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.old")
            path.rename(old)
            draft.rename(path)
            shutil.rmtree(old)
        else:
            os.replace(draft, path)  # noqa: PTH105  (Path.replace cannot overwrite on Windows either; same call)
    finally:
        if draft.is_dir():
            shutil.rmtree(draft)
        else:
            draft.unlink(missing_ok=True)


def build_table(
    schema: Schema,
    columns: Mapping[str, Any],
    geometry: tuple[Floats, Floats] | Sequence[Any] | NDArray[Any] | None = None,
    *,
    in_order: bool = False,
) -> pa.Table:
    """Make a table of a schema from columns.

    Parameters
    ----------
    schema
        The table to make.
    columns
        Name to array, list, Arrow array or scalar. A scalar is repeated. A missing nullable column becomes null.
        Optional columns are in the table when they are given.
    geometry
        Longitudes and latitudes of points in degrees, or shapely geometries (None where the schema allows it).
    in_order
        The rows are in the order of the schema's key, and nobody will change the arrays: they are taken as they are.

    Raises
    ------
    TableError
        A column is missing, unknown, of the wrong type or length, or has nulls that the schema forbids.
    """
    known = {c.name: c for c in schema.all_columns}
    unknown = sorted(set(columns) - set(known))
    if unknown:
        raise TableError(f"unknown columns {', '.join(unknown)}.", where=f"table {schema.name}")
    n_rows = _n_rows(columns, geometry)
    arrow = schema.arrow(tuple(columns))
    arrays = []
    for field in arrow:
        if field.name in (GEOMETRY, BBOX):
            continue
        arrays.append(_column(schema, field, columns.get(field.name), n_rows))
    if schema.geometry:
        arrays.extend(_encode(schema, geometry, n_rows))
    table = pa.Table.from_arrays(arrays, schema=arrow)
    return table if in_order else sort_by_key(schema, table)


def sort_by_key(schema: Schema, table: pa.Table) -> pa.Table:
    """Return the rows in the order of the schema's key; files are written in it."""
    keys = [(name, "ascending") for name in schema.key if name in table.column_names]
    # `take` copies, also what is in order already: a column may be a view of an array that its owner goes on changing.
    return table.take(pc.sort_indices(table, sort_keys=keys)) if keys else table


def write_table(schema: Schema, table: pa.Table, path: Path) -> None:
    """Write a table made by `build_table` as GeoParquet 1.1 with a bbox covering, atomically.

    The same table gives the same bytes. Partition columns that are not in the table stay out of the file.
    """
    with atomic_path(path) as draft:
        metadata = geo_metadata(schema, table)
        pq.write_table(table.replace_schema_metadata(metadata), draft, **_encoding(schema, table.schema))


def write_pieces(schema: Schema, pieces: Iterator[pa.Table], path: Path) -> int:
    """Write tables one after the other into one file, a row group each, and return the number of rows.

    Each piece is sorted by key and all of it before the next; only one at a time is held. A single piece gives the
    bytes of `write_table`.
    """
    first = next(pieces)
    second = next(pieces, None)
    if second is None:
        write_table(schema, first, path)
        return int(first.num_rows)
    n_rows = 0
    extents = []
    plain = first.schema.with_metadata({b"geofleet:table": schema.name.encode()})
    with (
        atomic_path(path) as draft,
        pq.ParquetWriter(draft, plain, **_encoding(schema, plain)) as writer,
        ThreadPoolExecutor(1) as pool,
    ):
        writing = None
        for piece in chain((first, second), pieces):
            first = second = None  # what is written need not be held
            n_rows += piece.num_rows
            extents += [extent] if (extent := _extent(piece)) else []
            if writing:
                writing.result()
            # The next piece is made while this one is packed.
            writing = pool.submit(writer.write_table, piece.replace_schema_metadata(plain.metadata))
        if writing:
            writing.result()
        if schema.geometry:
            low, high = np.min(extents, axis=0), np.max(extents, axis=0)
            geo = _geo(schema, [*low[:2].tolist(), *high[2:].tolist()])
            writer.add_key_value_metadata({"geo": geo.decode()})
    return n_rows


def _encoding(schema: Schema, columns: pa.Schema) -> dict[str, Any]:
    """Return how columns are packed: only texts that repeat get a dictionary.

    For measured numbers, ids and references one is built in vain: half the time of a file, and a quarter more bytes.
    """
    ids = (*schema.key, "parent_id", "support_id", "source_ref") if len(schema.key) == 1 else ()
    texts = [field.name for field in columns if pa.types.is_string(field.type) and field.name not in ids]
    return {"compression": "zstd", "use_dictionary": texts or False}


def geo_metadata(schema: Schema, table: pa.Table) -> dict[bytes, bytes]:
    """Return the file metadata: `geo` of GeoParquet 1.1 (OGC:CRS84 by default) and the name of the table."""
    metadata = {b"geofleet:table": schema.name.encode()}
    if schema.geometry:
        metadata[b"geo"] = _geo(schema, _extent(table))
    return metadata


def _geo(schema: Schema, extent: list[float]) -> bytes:
    column: dict[str, Any] = {
        "encoding": "WKB",
        "geometry_types": [schema.geometry],
        "covering": {"bbox": {side: [BBOX, side] for side in ("xmin", "ymin", "xmax", "ymax")}},
    }
    if extent:
        column["bbox"] = extent
    geo = {"version": "1.1.0", "primary_column": GEOMETRY, "columns": {GEOMETRY: column}}
    return json.dumps(geo, sort_keys=True).encode()


def read_table(schema: Schema, path: Path, columns: Sequence[str] | None = None) -> pa.Table:
    """Read a table from a file, or from a hive-partitioned folder of files, and check it against its schema.

    Parameters
    ----------
    schema
        The table that the file must hold.
    path
        A Parquet file or a folder of them.
    columns
        Read only these (and fail if they are missing); all by default.

    Raises
    ------
    InputError
        The file does not exist or is not Parquet.
    TableError
        A column is missing or mistyped, or has nulls that the schema forbids.
    """
    dataset = _open(schema, Path(path))
    present = set(dataset.schema.names)
    arrow = schema.arrow(tuple(present))
    wanted = [f for f in arrow if columns is None or f.name in columns]
    missing = [f.name for f in wanted if f.name not in present]
    if missing:
        raise TableError(
            f"missing column {', '.join(missing)}.",
            where=f"{path}: table {schema.name}",
            todo=f"`geofleet schema {schema.name}` prints what it must hold.",
        )
    try:
        table = dataset.to_table(columns=[f.name for f in wanted])
    except (pa.ArrowInvalid, OSError) as error:
        raise InputError(f"cannot be read: {error}.", where=str(path), todo="Write the file anew.") from None
    return pa.Table.from_arrays(
        [_conform(schema, field, table[field.name], path) for field in wanted], schema=pa.schema(wanted)
    )


def lonlat(table: pa.Table) -> tuple[Floats, Floats]:
    """Return longitude and latitude, degrees, of a table of points, from its bbox column."""
    bbox = table[BBOX].combine_chunks()
    return bbox.field("xmin").to_numpy(zero_copy_only=False), bbox.field("ymin").to_numpy(zero_copy_only=False)


def to_geodataframe(table: pa.Table) -> GeoDataFrame:
    """Return the table as a GeoDataFrame in OGC:CRS84, without its bbox column."""
    import geopandas  # noqa: PLC0415  (a second of import that only this function needs)

    plain = table.drop_columns([GEOMETRY, BBOX])
    frame = plain.to_pandas(ignore_metadata=True)
    geometry = shapely.from_wkb(table[GEOMETRY].to_numpy(zero_copy_only=False))
    return geopandas.GeoDataFrame(frame, geometry=geometry, crs="OGC:CRS84")


def from_geodataframe(schema: Schema, frame: GeoDataFrame) -> pa.Table:
    """Return a GeoDataFrame in any CRS as a table of a schema; columns that the schema does not know are dropped.

    Raises
    ------
    InputError
        The frame has no CRS.
    TableError
        As `build_table`.
    """
    if frame.crs is None:
        raise InputError("the GeoDataFrame has no CRS.", todo="Set one with set_crs().")
    if not frame.crs.equals("OGC:CRS84"):
        frame = frame.to_crs("OGC:CRS84")
    names = [c.name for c in schema.all_columns if c.name in frame.columns]
    columns = {name: pa.array(frame[name], from_pandas=True) for name in names}
    return build_table(schema, columns, geometry=np.asarray(frame.geometry.array))


def schema_named(name: str) -> Schema:
    """Return the schema of a table by its name, or raise a TableError that lists the names."""
    if name not in SCHEMAS:
        raise TableError(f"there is no table {name!r}.", todo=f"Tables are {', '.join(SCHEMAS)}.")
    return SCHEMAS[name]


def _n_rows(columns: Mapping[str, Any], geometry: Any) -> int:
    if isinstance(geometry, tuple):
        return len(geometry[0])
    if geometry is not None:
        return len(geometry)
    lengths = [len(v) for v in columns.values() if _is_array(v)]
    return lengths[0] if lengths else 1


def _is_array(value: Any) -> bool:
    return not isinstance(value, str | bytes) and hasattr(value, "__len__")


def _column(schema: Schema, field: pa.Field, value: Any, n_rows: int) -> pa.Array:
    where = f"table {schema.name}"
    if value is None and not field.nullable:
        raise TableError(f"missing column {field.name}.", where=where)
    try:
        array = _cast(_array(value), field) if _is_array(value) else _repeated(value, field.type, n_rows)
    except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError) as error:
        raise TableError(f"column {field.name} is not {field.type}: {error}.", where=where) from None
    if len(array) != n_rows:
        raise TableError(f"column {field.name} has {len(array)} rows, not {n_rows}.", where=where)
    if array.null_count and not field.nullable:
        raise TableError(f"column {field.name} has {array.null_count} nulls of {n_rows}.", where=where)
    return array


def _array(values: Any) -> pa.Array | pa.ChunkedArray:
    """Return values as an Arrow array; NaN is null."""
    if isinstance(values, pa.Array | pa.ChunkedArray):
        return values
    if isinstance(values, np.ndarray) and values.dtype in (np.float64, np.int64):
        return arrow_numbers(values)
    return pa.array(values, from_pandas=True)


def _repeated(value: Any, kind: pa.DataType, n_rows: int) -> pa.Array:
    if value is None:
        return pa.nulls(n_rows, kind)
    is_text = isinstance(value, str) and pa.types.is_string(kind)
    return pa.repeat(arrow_texts([value])[0] if is_text else pa.scalar(value, type=kind), n_rows)


def _point_wkb(lon: Floats, lat: Floats) -> pa.Array:
    """Return points as WKB: little-endian, type 1, x, y."""
    rows = np.zeros(len(lon), np.dtype([("order", "u1"), ("type", "<u4"), ("x", "<f8"), ("y", "<f8")]))
    rows["order"], rows["type"], rows["x"], rows["y"] = 1, 1, lon, lat
    ends = np.arange(len(lon) + 1, dtype=np.int32) * rows.itemsize
    return pa.Array.from_buffers(pa.binary(), len(lon), [None, pa.py_buffer(ends), pa.py_buffer(rows)])


def _cast(array: pa.Array | pa.ChunkedArray, field: pa.Field) -> pa.Array | pa.ChunkedArray:
    """Cast to the type of a field within its family: numbers never turn into text, nor text into numbers or times."""
    values = array.type.value_type if pa.types.is_dictionary(array.type) else array.type
    if not (pa.types.is_null(values) or _family(values) == _family(field.type)):
        raise pa.ArrowTypeError(f"found {array.type}")
    return array.cast(field.type)


def _family(kind: pa.DataType) -> str:
    """Return what types may be cast into each other without a change of meaning."""
    families = {
        "text": pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind),
        "number": pa.types.is_integer(kind) or pa.types.is_floating(kind),
        "time": pa.types.is_timestamp(kind),
        "list": pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind),
        "bytes": pa.types.is_binary(kind) or pa.types.is_large_binary(kind),
    }
    return next((name for name, is_it in families.items() if is_it), str(kind))


def _encode(schema: Schema, geometry: Any, n_rows: int) -> list[pa.Array]:
    """Return the WKB and the bbox column."""
    if isinstance(geometry, tuple):
        lon, lat = (np.ascontiguousarray(side, np.float64) for side in geometry)
        bounds = [pa.Array.from_buffers(pa.float64(), n_rows, [None, pa.py_buffer(side)]) for side in (lon, lat)]
        return [_point_wkb(lon, lat), pa.StructArray.from_arrays([*bounds, *bounds], fields=list(BBOX_TYPE))]
    shapes = np.asarray([None] * n_rows if geometry is None else geometry, dtype=object)
    empty = np.asarray(shapely.is_missing(shapes))
    if empty.any() and not schema.geometry_nullable:
        raise TableError(f"{int(empty.sum())} of {n_rows} geometries are missing.", where=f"table {schema.name}")
    sides = [pa.array(side) for side in shapely.bounds(shapes).reshape(-1, 4).T]
    mask = pa.array(empty) if empty.any() else None
    wkb = pa.array(shapely.to_wkb(shapes), pa.binary())
    return [wkb, pa.StructArray.from_arrays(sides, fields=list(BBOX_TYPE), mask=mask)]


def _extent(table: pa.Table) -> list[float]:
    if table.num_rows == table[BBOX].null_count:
        return []
    box = pc.struct_field
    low = [pc.min(box(table[BBOX], side)).as_py() for side in ("xmin", "ymin")]
    high = [pc.max(box(table[BBOX], side)).as_py() for side in ("xmax", "ymax")]
    return [*low, *high]


def _open(schema: Schema, path: Path) -> ds.Dataset:
    import pyarrow.dataset as ds  # noqa: PLC0415  (takes 50 MB, which writing does without)

    if not path.exists():
        raise InputError("there is no such file.", where=str(path), todo="Check the path.")
    partitioning = ds.partitioning(pa.schema([(name, pa.string()) for name in schema.partitions]), flavor="hive")
    try:
        dataset = ds.dataset(path, format="parquet", partitioning=partitioning if path.is_dir() else None)
    except (pa.ArrowInvalid, OSError) as error:
        why = "" if "magic bytes" in str(error) else f" ({str(error).splitlines()[0]})"
        raise InputError(
            f"not a Parquet file{why}.",
            where=str(path),
            todo=f"A {schema.name} table is expected; `geofleet ingest` makes one from other formats.",
        ) from None
    if not dataset.files:
        raise InputError("the folder holds no Parquet file.", where=str(path), todo="Check the path.")
    return dataset


def _conform(schema: Schema, field: pa.Field, column: pa.ChunkedArray, path: Path) -> pa.ChunkedArray:
    where = f"{path}: table {schema.name}"
    try:
        column = _cast(column, field)
    except (pa.ArrowInvalid, pa.ArrowTypeError, pa.ArrowNotImplementedError):
        raise TableError(
            f"column {field.name} is {column.type}, not {field.type}.",
            where=where,
            todo=f"`geofleet schema {schema.name}` prints the types.",
        ) from None
    if column.null_count and not field.nullable:
        raise TableError(f"column {field.name} has {column.null_count} nulls of {len(column)}.", where=where)
    return column
