"""A statement of `sql/` with all that it reads, as a list of plain SQL that any DuckDB runs.

What a header names by `@folder/file` comes first, each once: what groups, ranks or makes distinct as a table, the rest
as a view. Parameters are written in; all statements of a script share them.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from geofleet.errors import QueryError
from geofleet.tables.database import load_sql

if TYPE_CHECKING:
    from collections.abc import Mapping

    from geofleet.tables.database import Parameter, Statement

_IS_KEPT = re.compile(r"\b(GROUP BY|DISTINCT|OVER|QUALIFY)\b")
_USED = re.compile(r"\$([a-z_]\w*)")
_WHOLE, _TRUE_FALSE = re.compile(r"[+-]?\d+"), {"true", "false"}


def script(statement: Statement, given: Mapping[str, str]) -> list[str]:
    """Return what makes everything that a statement reads, in order, and the statement itself at the end.

    Parameters
    ----------
    statement
        Its tables are expected under the names in its header.
    given
        Values of parameters, as text; the others have their defaults.

    Raises
    ------
    QueryError
        A parameter is missing, is unknown, or is not of its type.
    """
    chain = _chain(statement, {})
    declared = {key: parameter for one in [*chain, statement] for key, parameter in one.declared.items()}
    odd = sorted(set(given) - set(declared))
    if odd:
        raise QueryError(
            f"there is no parameter {', '.join(odd)}.", where=statement.name, todo=f"It takes {_listed(declared)}."
        )
    values = {key: _literal(statement.name, key, parameter, given) for key, parameter in declared.items()}
    made = [f"CREATE OR REPLACE TEMP {_kind(one)} {_name(one)} AS\n{_filled(one, values)}" for one in chain]
    return [*made, _filled(statement, values)]


def tables_read(statement: Statement) -> set[str]:
    """Return the tables that a statement and all that it reads are made from, as headers name them."""
    chain = [*_chain(statement, {}), statement]
    return {name for one in chain for name in one.reads if not name.startswith("@")}


def _chain(statement: Statement, found: dict[str, Statement]) -> list[Statement]:
    """Return what a statement reads, the first to be made first."""
    for name in statement.reads:
        if name.startswith("@") and name not in found:
            one = load_sql(name.removeprefix("@"))
            _chain(one, found)
            found[name] = one
    return list(found.values())


def _name(statement: Statement) -> str:
    return statement.name.rpartition("/")[2]


def _kind(statement: Statement) -> str:
    return "TABLE" if _IS_KEPT.search(statement.text) else "VIEW"


def _filled(statement: Statement, values: Mapping[str, str]) -> str:
    body = "\n".join(line for line in statement.text.splitlines() if not line.startswith("--"))
    return f"-- sql/{statement.name}.sql: {statement.why}\n{_USED.sub(lambda match: values[match[1]], body)}".strip()


def _literal(where: str, key: str, parameter: Parameter, given: Mapping[str, str]) -> str:
    """Return a parameter as SQL."""
    text = given.get(key, parameter.default)
    if text is None:
        raise QueryError(
            f"the parameter {key} is missing: {parameter.kind}, {parameter.meaning}.",
            where=where,
            todo=f"Give --param {key}=VALUE",
        )
    if text.lower() == "null":
        return "NULL"
    kind = parameter.kind.lower()
    if kind in {"text", "varchar"}:
        return "'" + text.replace("'", "''") + "'"
    try:
        if kind == "double":
            return f"'{float(text)!r}'::DOUBLE"
        if (kind == "boolean" and text.lower() in _TRUE_FALSE) or (kind != "boolean" and _WHOLE.fullmatch(text)):
            return f"({text.lower()})"
    except ValueError:
        pass
    raise QueryError(f"{text!r} is not {kind}.", where=f"--param {key}", todo=f"It is {parameter.meaning}.")


def _listed(declared: Mapping[str, Parameter]) -> str:
    return ", ".join(f"{key} ({one.kind}, {one.meaning})" for key, one in declared.items()) or "none"
