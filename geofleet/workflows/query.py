"""SQL over the tables of a folder."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb

from geofleet.errors import InputError, QueryError
from geofleet.tables.binding import bind_table, sql_kind
from geofleet.tables.database import connect, read_sql, sql_folder
from geofleet.tables.finding import find_tables
from geofleet.tables.scripts import script, tables_read

if TYPE_CHECKING:
    from collections.abc import Mapping

    from geofleet.tables.database import Statement
    from geofleet.tables.schemas import Schema

_SPATIAL = "INSTALL spatial;\n\nLOAD spatial;\n\nSET geometry_always_xy = true;\n\n"
_NO_PARAMETERS: Mapping[str, str] = {}


def query(
    statement: str, data: Path, params: Mapping[str, str] = _NO_PARAMETERS
) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
    """Run a statement, or a `.sql` file, with a view for every table below `data`.

    A file is seen by its own name (`fused`, `reference`), a hive-partitioned folder by the folder's (`detections`).
    What the header of a `.sql` file reads from other files (`@aggregate/judged`) is made first.

    Parameters
    ----------
    statement
        A statement in SQL, or the path of a file. Those of `sql/` are found without a checkout too.
    data
        Folder with tables.
    params
        Values of parameters of the file and of those that it reads; the others have the defaults of their headers.

    Returns
    -------
    Column names, and the rows.

    Raises
    ------
    InputError
        There are no tables below `data`, or the file does not exist.
    QueryError
        A parameter is missing or wrong, or DuckDB refuses the statement.
    """
    views, read, texts = _prepare(statement, data, params)
    connection = connect()
    try:
        for name, (schema, path) in views.items():
            bind_table(connection, schema, path, name=name, is_filled=name in read)
        for text in texts[:-1]:
            connection.execute(text)
        result = connection.execute(texts[-1])
        names = tuple(column[0] for column in result.description or ())
        return names, result.fetchall()
    except duckdb.Error as error:
        raise QueryError(f"{str(error).strip()}\n", todo=f"Tables here: {', '.join(views)}.") from None
    finally:
        connection.close()


def show_sql(statement: str, data: Path, params: Mapping[str, str] = _NO_PARAMETERS) -> str:
    """Return what `query` would run as a script for DuckDB's own shell, views of the tables included.

    Parameters and errors are those of `query`.
    """
    views, read, texts = _prepare(statement, data, params)
    wanted = read or set(views)
    tables = [_view(name, *views[name], is_filled=name in read) for name in views if name in wanted]
    code = [line for text in texts for line in text.splitlines() if not line.startswith("--")]
    return (_SPATIAL if any("ST_" in line for line in code) else "") + ";\n\n".join([*tables, *texts]) + ";\n"


def _prepare(
    statement: str, data: Path, params: Mapping[str, str]
) -> tuple[dict[str, tuple[Schema, Path]], set[str], list[str]]:
    """Return the tables by the names of their views, the views that headers name, and what is to be run."""
    views = find_tables(data)
    if not views:
        raise InputError("no tables below this folder.", where=str(data), todo="Run `make demo`, or give --data DIR.")
    if not statement.strip().endswith(".sql"):
        if params:
            raise QueryError("only a .sql file takes parameters.", where="--param", todo="Write them into the text.")
        return views, set(), [statement]
    found = _read(statement.strip())
    read = set()
    for name in tables_read(found):
        table, _, alias = name.partition(" AS ")
        of_kind = [view for view, (schema, _) in views.items() if schema.name == table]
        if alias and alias not in views and of_kind:
            views[alias] = views[of_kind[0]]
        read.add(alias or table)
    return views, read, script(found, params)


def _read(statement: str) -> Statement:
    path = Path(statement)
    if not path.is_file() and path.parts[0] == "sql":
        path = sql_folder().joinpath(*path.parts[1:])
    if not path.is_file():
        raise InputError("there is no such file.", where=statement, todo="Give a statement in quotes, or a .sql file.")
    parts = path.resolve().with_suffix("").parts
    return read_sql(path, "/".join(parts[-2:]))


def _view(name: str, schema: Schema, path: Path, *, is_filled: bool) -> str:
    """Return a view of a table for DuckDB's own shell; folders of partitions keep their values as text."""
    source = path.resolve().as_posix().replace("'", "''")
    folder = "/**/*.parquet', hive_partitioning = true, hive_types_autocast = false" if path.is_dir() else "'"
    columns = ["*"]
    if is_filled:
        present = set(_columns(path))
        columns += [f"NULL::{sql_kind(c.type)} AS {c.name}" for c in schema.optional if c.name not in present]
    return f"CREATE OR REPLACE TEMP VIEW {name} AS\nSELECT {', '.join(columns)}\nFROM read_parquet('{source}{folder})"


def _columns(path: Path) -> list[str]:
    file = next(iter(sorted(path.rglob("*.parquet")))) if path.is_dir() else path
    connection = duckdb.connect()
    try:
        return connection.read_parquet(str(file)).columns
    finally:
        connection.close()
