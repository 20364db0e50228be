"""A stored table as a view in DuckDB, read as it is queried and checked against its schema beforehand."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import duckdb
import pyarrow as pa

from geofleet.errors import InputError, TableError
from geofleet.tables.schemas import GEOMETRY

if TYPE_CHECKING:
    from geofleet.tables.schemas import Schema

_KINDS = {
    "string": "VARCHAR",
    "int64": "BIGINT",
    "double": "DOUBLE",
    "bool": "BOOLEAN",
    "binary": "BLOB",
    "timestamp[us, tz=UTC]": "TIMESTAMP WITH TIME ZONE",
}
_NUMBERS = ("INT", "DOUBLE", "FLOAT", "DECIMAL", "HUGEINT")


def bind_table(
    connection: duckdb.DuckDBPyConnection, schema: Schema, path: Path, *, name: str = "", is_filled: bool = False
) -> None:
    """Make a view of a Parquet file, or of a hive-partitioned folder of them, named `name` or after the schema.

    Partition values stay text: DuckDB's own hive reader would take vehicle `007` for the number 7. With `is_filled`,
    optional columns that the file lacks are there, and null.

    Raises
    ------
    InputError
        The file does not exist or is not Parquet.
    TableError
        A column is missing, or has a type that cannot stand for the one of the schema.
    """
    path = Path(path)
    if not path.exists():
        raise InputError("there is no such file.", where=str(path), todo="Check the path.")
    files = sorted(str(file) for file in path.rglob("*.parquet")) if path.is_dir() else [str(path)]
    if not files:
        raise InputError("the folder holds no Parquet file.", where=str(path), todo="Check the path.")
    try:
        view = connection.read_parquet(files, filename=True)
    except duckdb.Error as error:
        raise InputError(
            f"not a Parquet file ({str(error).splitlines()[0]}).",
            where=str(path),
            todo=f"A {schema.name} table is expected; `geofleet ingest` makes one from other formats.",
        ) from None
    absent = [key for key in schema.partitions if key not in view.columns] if path.is_dir() else []
    values = [f"url_decode(regexp_extract(filename, '/{key}=([^/]*)/', 1)) AS {key}" for key in absent]
    if is_filled:
        values += [f"NULL::{sql_kind(c.type)} AS {c.name}" for c in schema.optional if c.name not in view.columns]
    view = view.project(", ".join(["* EXCLUDE (filename)", *values]))
    _check(schema, view, path)
    view.create_view(name or schema.name, replace=True)


def sql_kind(kind: pa.DataType) -> str:
    """Return the type that DuckDB has for one of Arrow, of those that schemas use."""
    if pa.types.is_struct(kind):
        return f"STRUCT({', '.join(f'{field.name} {sql_kind(field.type)}' for field in kind)})"
    if pa.types.is_map(kind):
        return f"MAP({sql_kind(kind.key_type)}, {sql_kind(kind.item_type)})"
    if pa.types.is_fixed_size_list(kind):
        return f"{sql_kind(kind.value_type)}[{kind.list_size}]"
    return _KINDS[str(kind)]


def _check(schema: Schema, view: duckdb.DuckDBPyRelation, path: Path) -> None:
    where = f"{path}: table {schema.name}"
    todo = f"`geofleet schema {schema.name}` prints what it must hold."
    found = {name: str(kind) for name, kind in zip(view.columns, view.types, strict=True)}
    present = tuple(column.name for column in schema.optional if column.name in found)
    for field in schema.arrow(present):
        name, kind = field.name, sql_kind(field.type)
        if name == GEOMETRY:
            continue  # spatial reads it as GEOMETRY, not as the bytes it is stored in
        if name not in found:
            raise TableError(f"missing column {name}.", where=where, todo=todo)
        if not _can_stand_for(found[name], kind):
            raise TableError(f"column {name} is {found[name]}, not {kind}.", where=where, todo=todo)


def _can_stand_for(found: str, wanted: str) -> bool:
    """Return whether a column of one type may be read as another: any number is a number, a null column is anything."""
    if wanted == "BIGINT":
        return "INT" in found and "HUGE" not in found
    if wanted == "DOUBLE":
        return any(number in found for number in _NUMBERS) and "(" not in found.replace("DECIMAL(", "")
    if wanted.startswith("TIMESTAMP"):
        return found.startswith("TIMESTAMP")
    if wanted.endswith("]"):  # Parquet does not keep the length of a list
        return found.endswith("]") and _can_stand_for(found.rpartition("[")[0], wanted.rpartition("[")[0])
    return found == wanted
