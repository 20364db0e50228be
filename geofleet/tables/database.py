"""DuckDB with its spatial extension, and the statements in `sql/`.

Python binds logical table names (`con.register`, temporary views) and `$params`; a file holds one statement. Session
variables are not used: DuckDB fills a missing parameter from one silently.
"""

from __future__ import annotations

import os
import re
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import pyarrow.parquet as pq

from geofleet.errors import QueryError

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    import pyarrow as pa

_HEADER = re.compile(r"^--\s*(why|reads|params|writes):\s*(.*)$")
_PARAMETER = re.compile(r"\$([a-z_]\w*)")
_DECLARED = re.compile(r"\$([a-z_]\w*)\s*\((\w+),?\s*([^()]*?)(?:;\s*(\S+) if not given)?\)")


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter as a header declares it: type, meaning, and the text of its default, None where it must be given."""

    kind: str
    meaning: str
    default: str | None


@dataclass(frozen=True, slots=True)
class Statement:
    """One `.sql` file: its text and what its header says."""

    name: str
    text: str
    why: str
    reads: tuple[str, ...]
    params: tuple[str, ...]
    writes: tuple[tuple[str, str], ...]
    declared: Mapping[str, Parameter] = field(default_factory=dict)


def connect(
    *, threads: int | None = None, memory_limit: str | None = None, spatial: bool = True
) -> duckdb.DuckDBPyConnection:
    """Open an in-memory database, with spatial loaded and x before y unless no statement needs it (0.4 s).

    Raises
    ------
    QueryError
        The spatial extension is nowhere to be found.
    """
    # What does not fit in memory goes where temporary files go, not into the user's working folder.
    spill = Path(tempfile.gettempdir()) / f"geofleet-duckdb-{os.getpid()}"
    config: dict[str, Any] = {"autoinstall_known_extensions": False, "temp_directory": str(spill)}
    if threads:
        config["threads"] = threads
    if memory_limit:
        config["memory_limit"] = memory_limit
    connection = duckdb.connect(config=config)
    if spatial:
        _load_spatial(connection)
        connection.execute("SET geometry_always_xy = true")
    return connection


def _load_spatial(connection: duckdb.DuckDBPyConnection) -> None:
    """Load spatial from its wheel, from DuckDB's own folder, or from the net, in that order."""
    attempts = [
        *(f"LOAD '{path}'" for path in _packaged_spatial()),
        "LOAD spatial",
        "INSTALL spatial; LOAD spatial",
    ]
    faults = []
    for attempt in attempts:
        try:
            connection.execute(attempt)
        except duckdb.Error as error:
            faults.append(str(error).splitlines()[0])
        else:
            return
    raise QueryError(
        f"DuckDB's spatial extension cannot be loaded ({faults[0]}).",
        todo=f"Run: pip install duckdb-extension-spatial=={duckdb.__version__}",
    )


def _packaged_spatial() -> list[str]:
    try:
        import duckdb_extension_spatial  # noqa: PLC0415  (optional: an installed extension does as well)
    except ImportError:
        return []
    folder = Path(duckdb_extension_spatial.__file__).parent / "extensions" / f"v{duckdb.__version__}"
    return [str(path).replace("'", "''") for path in folder.glob("spatial.duckdb_extension")]


def sql_folder() -> Path:
    """Return the folder of the statements: inside the package when installed, else the checkout's `sql/`."""
    package = Path(__file__).resolve().parent.parent
    packed = package / "_sql"
    return packed if packed.is_dir() else package.parent / "sql"


@cache
def load_sql(name: str) -> Statement:
    """Read a statement by its path below `sql/` without the suffix, e.g. `tiles/assign`.

    Raises
    ------
    QueryError
        There is no such file, or its header does not name the parameters that its text uses.
    """
    path = sql_folder() / f"{name}.sql"
    if not path.is_file():
        raise QueryError(f"there is no statement {name!r}.", where=str(path))
    return read_sql(path, name)


def read_sql(path: Path, name: str) -> Statement:
    """Read any file that is written like those of `sql/`; one without a header reads, takes and writes nothing known.

    Raises
    ------
    QueryError
        Its header does not name the parameters that its text uses.
    """
    text = path.read_text(encoding="utf-8")
    header: dict[str, list[str]] = {"why": [], "reads": [], "params": [], "writes": []}
    current = ""
    for line in text.splitlines():
        match = _HEADER.match(line)
        if match:
            current, rest = match[1], match[2]
        elif line.startswith("--") and current:
            rest = line.removeprefix("--").strip()
        else:
            current = ""
            continue
        header[current].append(rest)
    params = " ".join(header["params"])
    declared = set(_PARAMETER.findall(params))
    body = "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("--"))
    used = set(_PARAMETER.findall(body))
    if declared != used:
        odd = ", ".join(sorted(f"${p}" for p in declared ^ used))
        raise QueryError(f"{odd} stands either in the header or in the text, not in both.", where=str(path))
    return Statement(
        name=name,
        text=text,
        why=" ".join(header["why"]),
        reads=tuple(word.strip() for word in ",".join(header["reads"]).split(",") if word.strip() not in {"", "none"}),
        params=tuple(sorted(declared)),
        writes=_parse_columns(" ".join(header["writes"])),
        declared={
            key: Parameter(kind, meaning, default or None) for key, kind, meaning, default in _DECLARED.findall(params)
        },
    )


def _parse_columns(text: str) -> tuple[tuple[str, str], ...]:
    """Split `a INTEGER, b DECIMAL(1, 2)` at the commas outside brackets."""
    parts = re.split(r",\s*(?![^(]*\))", text.strip().rstrip("."))
    return tuple((name, kind.strip()) for name, _, kind in (part.strip().partition(" ") for part in parts) if name)


def run(
    connection: duckdb.DuckDBPyConnection, name: str, params: Mapping[str, Any] | None = None
) -> duckdb.DuckDBPyConnection:
    """Execute the statement of a file with its parameters and return the connection that holds its result.

    Raises
    ------
    QueryError
        A parameter is missing or unknown, or DuckDB refuses the statement; the message names the file.
    """
    text, texts = _bound(name, params or {})
    with _naming(name):
        return connection.execute(text, *texts)


def _bound(name: str, given: Mapping[str, Any]) -> tuple[str, list[dict[str, str]]]:
    """Return the text of a statement with its numbers filled in, and the texts that stay parameters, if any."""
    statement = load_sql(name)
    if set(given) != set(statement.params):
        raise QueryError(
            f"takes the parameters {', '.join(statement.params) or 'none'}, got {', '.join(sorted(given)) or 'none'}.",
            where=f"sql/{name}.sql",
        )
    texts = {key: value for key, value in given.items() if isinstance(value, str)}
    return _fill_in(statement.text, given), [texts] if texts else []


@contextmanager
def _naming(name: str) -> Iterator[None]:
    """Raise what DuckDB raises as a QueryError that names the file."""
    try:
        yield
    except duckdb.Error as error:
        raise QueryError(f"{str(error).strip()}", where=f"sql/{name}.sql") from error


def _fill_in(text: str, given: Mapping[str, Any]) -> str:
    """Write numbers, truth values and nulls into a statement; texts stay parameters.

    DuckDB's client imports pandas to look at a parameter, whatever it is: half a second and 60 MB for every step.
    """
    literals = {key: _literal(value) for key, value in given.items() if not isinstance(value, str)}
    return _PARAMETER.sub(lambda match: literals.get(match[1], match[0]), text)


def _literal(value: float | None) -> str:
    """Return a number as SQL; one with a point would be a DECIMAL, with other rules of rounding."""
    if value is None:
        return "NULL"
    return f"'{float(value)!r}'::DOUBLE" if isinstance(value, float) else f"({value})".lower()


def create_view(connection: duckdb.DuckDBPyConnection, name: str, *, alias: str = "") -> None:
    """Make a view of a statement without parameters, named by its file or `alias`."""
    connection.sql(load_sql(name).text).create_view(alias or name.rpartition("/")[2])


def materialise(connection: duckdb.DuckDBPyConnection, name: str, params: Mapping[str, Any] | None = None) -> None:
    """Keep the result of a statement as a table of its file's name."""
    text, texts = _bound(name, params or {})
    with _naming(name):
        connection.sql(text, params=texts[0] if texts else None).create(name.rpartition("/")[2])


def make_empty(connection: duckdb.DuckDBPyConnection, name: str) -> None:
    """Make a table with the columns that a statement writes, and no row."""
    columns = ", ".join(f"{column} {kind}" for column, kind in load_sql(name).writes)
    connection.execute(f"CREATE TABLE {name.rpartition('/')[2]} ({columns})")


def keep_table(connection: duckdb.DuckDBPyConnection, table: pa.Table, name: str) -> None:
    """Copy a small table into the database, by way of a file: what comes from Arrow imports pandas too."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.parquet"
        pq.write_table(table, path)
        connection.read_parquet(str(path)).create(name)
