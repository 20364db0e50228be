"""Rows as JSON: a list of objects, such a list under `data` as Mapillary's API answers, or one object a line."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING, Any

import pyarrow as pa

if TYPE_CHECKING:
    from pathlib import Path

_LIST = re.compile(rb'\[\s*\{|\{\s*"data"\s*:\s*\[')
_LINES = re.compile(rb"\{[^\n]*\}\s*\n\s*\{")
_FEATURE = re.compile(rb'"type"\s*:\s*"Feature')
_MAX_COLUMNS = 1000
_MAX_BYTES = 256 << 20  # held as a whole, in some ten times the room


def detect(text: bytes) -> bool:
    """Tell whether a text that begins so holds rows as JSON; GeoJSON, also one feature a line, is none."""
    return bool(_LIST.match(text) or _LINES.match(text)) and not _FEATURE.search(text)


def read_records(path: Path) -> pa.Table:
    """Return the rows of a file, all values as text; geometries and whatever is nested as the JSON that they are.

    OpenStreetMap's `tags` are columns of their own.

    Raises
    ------
    ValueError
        The file is not JSON in UTF-8, not made of objects, or too large to be held as a whole.
    """
    if path.stat().st_size > _MAX_BYTES:
        raise ValueError(f"larger than {_MAX_BYTES >> 20} MiB: give CSV or Parquet")
    text = path.read_text(encoding="utf-8-sig")
    try:
        content = _content(text)
    except RecursionError:
        raise ValueError("values nested too deeply") from None
    rows = content.get("data") if isinstance(content, dict) else content
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ValueError("not a list of objects")
    rows = [row | row["tags"] if isinstance(row.get("tags"), dict) else row for row in rows]
    names = list(dict.fromkeys(name for row in rows for name in row))
    if len(names) > _MAX_COLUMNS:
        raise ValueError(f"rows with {len(names)} different names of values")
    return pa.table({name: pa.array([_text(row.get(name)) for row in rows], pa.string()) for name in names})


def _content(text: str) -> Any:
    if _LINES.match(text.lstrip()[:4096].encode()):
        return [json.loads(line) for line in text.splitlines() if line.strip()]
    return json.loads(text)


def _text(value: Any) -> str | None:
    return value if value is None or isinstance(value, str) else json.dumps(value, ensure_ascii=False)
