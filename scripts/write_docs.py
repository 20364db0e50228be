"""Write the parts of the documentation that say what the code says, between marks in the pages that hold them.

Run: python scripts/write_docs.py     (a test compares the pages with what this would write)
"""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import TYPE_CHECKING

from geofleet.algorithms.metrics import MapScore
from geofleet.tables.database import load_sql, sql_folder

if TYPE_CHECKING:
    from collections.abc import Callable

    from geofleet.tables.database import Parameter

DOCS = Path(__file__).resolve().parents[1] / "docs"
METRICS = (
    "gospa_m",
    "localisation_m2",
    "cardinality_m2",
    "gospa",
    "precision",
    "recall",
    "f1",
    "mse_m2",
    "rmse_m",
    "null_reason",
)
_DOI = "doi:10.23919/ICIF.2017.8009645"


def metrics() -> str:
    """Return a section a metric, from the docstrings of `MapScore`."""
    sections = []
    for name in METRICS:
        text = inspect.getdoc(getattr(MapScore, name)) or ""
        head, _, rest = text.partition("\n\n")
        body = " ".join(rest.split()).replace(_DOI, f"[{_DOI}](https://doi.org/{_DOI.removeprefix('doi:')})")
        sections.append(f"### `{name}`\n\n{' '.join(head.split())}" + (f"\n\n{body}" if body else ""))
    return "\n\n".join(sections)


def statements(folder: str) -> str:
    """Return a section a statement of a folder of `sql/`, from the headers of the files."""
    sections = []
    for path in sorted((sql_folder() / folder).glob("*.sql")):
        statement = load_sql(f"{folder}/{path.stem}")
        columns = ", ".join(f"`{name}`" for name, _ in statement.writes)
        reads = ", ".join(f"`{name}`" for name in statement.reads) or "nothing"
        lines = [f"- reads: {reads}", f"- gives: {columns}"]
        if statement.params:
            lines.insert(1, f"- parameters: {', '.join(_parameter(*item) for item in statement.declared.items())}")
        sections.append(f"### `sql/{folder}/{path.name}`\n\n{statement.why}\n\n" + "\n".join(lines))
    return "\n\n".join(sections)


def _parameter(name: str, parameter: Parameter) -> str:
    default = f"; {parameter.default} if not given" if parameter.default else ""
    return f"`${name}` ({parameter.kind}, {parameter.meaning}{default})"


PARTS: dict[str, dict[str, Callable[[], str]]] = {
    "evaluation.md": {"metrics": metrics},
    "sql.md": {
        "analysis": lambda: statements("analysis"),
        "checks": lambda: statements("checks"),
        "tiles": lambda: statements("tiles"),
        "aggregate": lambda: statements("aggregate"),
        "evaluate": lambda: statements("evaluate"),
    },
}


def fill(page: str, text: str) -> str:
    """Return a page with the text between each pair of marks made anew."""
    for name, render in PARTS[page].items():
        begin, end = f"<!-- {name}: written by scripts/write_docs.py -->", f"<!-- end of {name} -->"
        head, found_begin, rest = text.partition(begin)
        _, found_end, tail = rest.partition(end)
        if not found_begin or not found_end:
            raise SystemExit(f"docs/{page} has no place for {name}")
        text = f"{head}{begin}\n\n{render()}\n\n{end}{tail}"
    return text


def main() -> None:
    """Write every page anew."""
    for page in PARTS:
        path = DOCS / page
        path.write_text(fill(page, path.read_text(encoding="utf-8")), encoding="utf-8")


if __name__ == "__main__":
    main()
