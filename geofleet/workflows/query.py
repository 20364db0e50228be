"""SQL over the tables of a folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import duckdb

from geofleet.errors import InputError, QueryError
from geofleet.tables.binding import bind_table
from geofleet.tables.database import connect
from geofleet.tables.finding import find_tables


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
        raise QueryError(f"{str(error).strip()}\n", todo=f"Tables here: {', '.join(views)}.") from None
    finally:
        connection.close()


def _read_statement(statement: str) -> str:
    if not statement.strip().endswith(".sql"):
        return statement
    path = Path(statement.strip())
    if not path.is_file():
        raise InputError("there is no such file.", where=statement, todo="Give a statement in quotes, or a .sql file.")
    return path.read_text(encoding="utf-8")
