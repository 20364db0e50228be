"""geofleet's own `signs` table back from the OpenStreetMap XML that it was written to, as it was.

A file that somebody has saved since, in an editor, names that editor as its generator: it is a map like any other.
"""

from __future__ import annotations

from datetime import datetime
from itertools import count
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from geofleet.errors import InputError
from geofleet.formats import osm
from geofleet.formats.osm_nodes import PREFIX
from geofleet.formats.reading import LayerRead
from geofleet.formats.xml import explained, iter_elements, number, place
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import build_table

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from geofleet.formats.xml import Element
    from geofleet.tables.schemas import Column

__all__ = ["FORMAT", "read_lanes", "read_signs"]

FORMAT = "geofleet-osm"
_MAX_LON_DEG, _MAX_LAT_DEG = 180.0, 90.0
read_lanes = osm.read_lanes  # in a map of roads nothing is said that OpenStreetMap's tags do not say


def read_signs(path: Path) -> LayerRead:
    """Read the signs that `write_osm` or `write_osc` wrote.

    Raises
    ------
    InputError
        The file is missing or damaged, or has been changed so that a row is not whole.
    """
    values: dict[str, list[Any]] = {column.name: [] for column in SIGNS.all_columns}
    lon: list[float] = []
    lat: list[float] = []
    n_others = 0
    with explained(path):
        for node in iter_elements(path, ("node",)):
            rows = list(_rows(node))
            n_others += not rows
            for row in rows:
                x, y = _position(node)
                lon.append(x)
                lat.append(y)
                for name, column in values.items():
                    column.append(row[name])
    required = {column.name for column in SIGNS.columns}
    columns = {
        column.name: pa.array(values[column.name], column.type)
        for column in SIGNS.all_columns
        if column.name in required or any(value is not None for value in values[column.name])
    }
    table = build_table(SIGNS, columns, (np.array(lon, np.float64), np.array(lat, np.float64)))
    return LayerRead(table, FORMAT, {"nodes that are no signs": n_others} if n_others else {})


def _rows(node: Element) -> Iterator[dict[str, Any]]:
    """Yield the rows of a node, as its tags number them."""
    tags = {tag.get("k", ""): tag.get("v", "") for tag in node if tag.tag == "tag"}
    for n in count(1):
        suffix = f":{n}" if n > 1 else ""
        if f"{PREFIX}sign_id{suffix}" not in tags:
            return
        yield {c.name: _value(tags.get(f"{PREFIX}{c.name}{suffix}"), c, node) for c in SIGNS.all_columns}


def _value(text: str | None, column: Column, node: Element) -> Any:
    """Return a tag in the type of its column; an absent one is null, or an empty text where nothing may be null."""
    if text is None:
        return None if column.nullable else ""
    try:
        if pa.types.is_timestamp(column.type):
            return datetime.fromisoformat(text)
        if pa.types.is_integer(column.type):
            return int(text)
        return float(text) if pa.types.is_floating(column.type) else text
    except ValueError:
        raise InputError(
            f"{PREFIX}{column.name} is {text[:40]!r}, which is no {column.type}.",
            where=place(node),
            todo="Convert the layer again.",
        ) from None


def _position(node: Element) -> tuple[float, float]:
    lon, lat = number(node, "lon"), number(node, "lat")
    if abs(lon) > _MAX_LON_DEG or abs(lat) > _MAX_LAT_DEG:
        raise InputError(f"lon {lon:g}, lat {lat:g} is nowhere on Earth.", where=place(node))
    return lon, lat
