"""The tables below a folder, found by the mark that each file carries."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pyarrow.parquet as pq

from geofleet.tables.schemas import SCHEMAS, Schema

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

_MARK = b"geofleet:table"


def find_tables(data: Path) -> dict[str, tuple[Schema, Path]]:
    """Return schema and path of every geofleet table below a folder, by the name of its view.

    A file is known by its own name (`fused`, `reference`), a hive-partitioned folder by the folder's (`detections`).
    """
    views: dict[str, tuple[Schema, Path]] = {}
    for path in sorted(data.rglob("*.parquet")):
        schema = table_schema(path)
        if schema is None:
            continue
        levels = [parent for parent in path.parents if "=" in parent.name]
        root = levels[-1].parent if levels else path
        views.setdefault(root.stem, (schema, root))
    return views


def tables_of(schema: Schema, folders: Iterable[Path]) -> list[Path]:
    """Return the files in folders, not below them, that hold a table of a schema, sorted."""
    return sorted(path for folder in folders for path in folder.glob("*.parquet") if table_schema(path) is schema)


def table_schema(path: Path) -> Schema | None:
    """Return the schema that a Parquet file was written with; None for a file from elsewhere."""
    mark = (pq.read_metadata(path).metadata or {}).get(_MARK, b"").decode(errors="replace")
    return SCHEMAS.get(mark)
