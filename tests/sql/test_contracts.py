"""Every statement in `sql/` binds to the schemas and returns the columns that its header promises. No data needed."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import duckdb
import pyarrow as pa
import pytest

from geofleet.errors import QueryError
from geofleet.tables import database
from geofleet.tables.database import connect, load_sql, run, sql_folder
from geofleet.tables.schemas import SCHEMAS

if TYPE_CHECKING:
    from pathlib import Path

NAMES = sorted(p.relative_to(sql_folder()).with_suffix("").as_posix() for p in sql_folder().rglob("*.sql"))
SAMPLES: dict[str, Any] = {"integer": 1, "bigint": 1, "double": 1.0, "text": "", "varchar": "", "boolean": True}


@pytest.fixture
def connection():
    connection = connect()
    yield connection
    connection.close()


def bind_empty(connection: duckdb.DuckDBPyConnection, name: str) -> None:
    """Register an empty table for a schema name (`signs`, `signs AS fused`), or for a statement's result (`@a/b`)."""
    if name.startswith("@"):
        statement = load_sql(name.removeprefix("@"))
        columns = ", ".join(f"{column} {kind}" for column, kind in statement.writes)
        connection.execute(f"CREATE TABLE {name.rpartition('/')[2]} ({columns})")
    else:
        schema, _, alias = name.partition(" AS ")
        connection.register(alias or schema, SCHEMAS[schema].arrow().empty_table())


def sample_params(text: str, params: tuple[str, ...]) -> dict[str, Any]:
    kinds = dict(re.findall(r"\$(\w+)\s*\((\w+)", text))
    return {param: SAMPLES[kinds[param].lower()] for param in params}


@pytest.mark.parametrize("name", NAMES)
def test_statement_binds_and_returns_what_its_header_promises(name, connection):
    statement = load_sql(name)
    assert statement.why
    assert statement.writes
    for table in statement.reads:
        bind_empty(connection, table)
    run(connection, name, sample_params(statement.text, statement.params))
    found = [(column[0], str(column[1])) for column in connection.description]
    wanted = [(column, str(connection.sql(f"SELECT NULL::{kind} AS x").types[0])) for column, kind in statement.writes]
    assert found == wanted


def test_there_is_one_statement_a_file():
    for name in NAMES:
        assert len(duckdb.extract_statements(load_sql(name).text)) == 1, name


def test_a_header_that_does_not_name_a_parameter_is_refused(tmp_path: Path, monkeypatch):
    text = "-- why: nothing\n-- reads: none\n-- params: none\n-- writes: x INTEGER\nSELECT $x AS x"
    (tmp_path / "odd.sql").write_text(text)
    monkeypatch.setattr(database, "sql_folder", lambda: tmp_path)
    with pytest.raises(QueryError, match=r"\$x stands either in the header or in the text"):
        load_sql("odd")


def test_parameters_must_match(connection):
    connection.register("matches", SCHEMAS["matches"].arrow().empty_table())
    with pytest.raises(QueryError, match="takes the parameters none, got zoom"):
        run(connection, "evaluate/counts", {"zoom": 3})


def test_a_failing_statement_names_its_file(connection):
    connection.register("matches", pa.table({"run_id": ["a"]}))
    with pytest.raises(QueryError, match=r"sql/evaluate/counts\.sql"):
        run(connection, "evaluate/counts")


def test_spatial_is_loaded_with_x_before_y(connection):
    # Bing's own example: tile x 3, y 5 of level 3 is 213.
    quadkey, text = connection.execute(
        "SELECT ST_QuadKey(-20.0, -50.0, 3), ST_AsText(ST_Transform(ST_Point(24.94, 60.17), 'EPSG:4326', 'EPSG:3879'))"
    ).fetchone()
    assert quadkey == "213"
    east, north = map(float, re.findall(r"[\d.]+", text))
    assert 25_490_000 < east < 25_500_000
    assert 6_670_000 < north < 6_680_000
