"""SQL over the tables of a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import duckdb
import pyarrow.parquet as pq

from geofleet.errors import InputError, QueryError
from geofleet.tables.binding import bind_table
from geofleet.tables.database import connect
from geofleet.tables.schemas import SCHEMAS, Schema

_MARK = b"geofleet:table"


def query(statement: str, data: Path) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
    """Run a statement, or a `.sql` file, with a view for every table below `data`.

    A file is seen by its own name (`fused`, `reference`), a hive-partitioned folder by the folder's (`detections`).

    Returns
    -------
    Column names, and the rows.

    Raises
    ------
    InputError
        There are no tables below `data`, or the file does not exist.
    QueryError
        DuckDB refuses the statement.
    """
    views = find_tables(data)
    if not views:
        raise InputError("no tables below this folder.", where=str(data), todo="Run `make demo`, or give --data DIR.")
    text = _read_statement(statement)
    connection = connect()
    try:
        for name, (schema, path) in views.items():
            bind_table(connection, schema, path, name=name)
        result = connection.execute(text)
        names = tuple(column[0] for column in result.description or ())
        return names, result.fetchall()
    except duckdb.Error as error:
        raise QueryError(f"{str(error).strip()}", todo=f"Tables here: {', '.join(views)}.") from None
    finally:
        connection.close()


def find_tables(data: Path) -> dict[str, tuple[Schema, Path]]:
    """Return schema and path of every geofleet table below a folder, by the name of its view."""
    views: dict[str, tuple[Schema, Path]] = {}
    for path in sorted(data.rglob("*.parquet")):
        mark = (pq.read_metadata(path).metadata or {}).get(_MARK, b"").decode()
        if mark not in SCHEMAS:
            continue
        levels = [parent for parent in path.parents if "=" in parent.name]
        root = levels[-1].parent if levels else path
        views.setdefault(root.stem, (SCHEMAS[mark], root))
    return views


def _read_statement(statement: str) -> str:
    if not statement.strip().endswith(".sql"):
        return statement
    path = Path(statement.strip())
    if not path.is_file():
        raise InputError("there is no such file.", where=statement, todo="Give a statement in quotes, or a .sql file.")
    return path.read_text(encoding="utf-8")
