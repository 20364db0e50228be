"""How many signs a reference has of each class: the K that a real job does not know."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import pyarrow.parquet as pq

from geofleet.tables.schemas import REFERENCE, SIGNS
from geofleet.tables.store import read_table

if TYPE_CHECKING:
    from pathlib import Path


def reference_counts(path: Path, *, semantic: str) -> dict[tuple[str, str], int]:
    """Count the main signs of a `reference` table or of a `signs` layer.

    Returns
    -------
    Number by run and class; semantic `after` counts all classes together, under the class "". A layer without runs
    holds for every run, under the run "".

    Raises
    ------
    InputError
        The file cannot be read.
    TableError
        A column is missing or mistyped.
    """
    of_runs = path.is_file() and "n_passes_in_view" in _names(path)
    table = read_table(REFERENCE if of_runs else SIGNS, path).to_pylist()
    return dict(
        Counter(
            (row["run_id"] if of_runs else "", row["sign_class"] if semantic == "first" else "")
            for row in table
            if row["kind"] == "main"
        )
    )


def _names(path: Path) -> list[str]:
    """Return the columns of a file; what is no Parquet file is left for `read_table` to refuse."""
    try:
        return list(pq.read_schema(path).names)
    except (OSError, ValueError):
        return []
