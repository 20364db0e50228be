"""Signs as OpenStreetMap's nodes: what its tags can say in its own grammar, and every column under `geofleet:`."""

from __future__ import annotations

import re
from collections import defaultdict
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.errors import InputError
from geofleet.formats.osm_tags import node_signs
from geofleet.formats.osm_value import MAX_CHARACTERS, sign_value
from geofleet.tables.schemas import BBOX, GEOMETRY
from geofleet.tables.store import lonlat

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pyarrow as pa

PREFIX = "geofleet:"
_NODE = re.compile(r"node/(-?[1-9]\d{0,17})")
_NOT_IN_XML = re.compile(r"[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

_TINY = 1e-20

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class OsmNode:
    """A node: its id (negative: new), degrees, tags."""

    node_id: int
    lon: float
    lat: float
    tags: dict[str, str]


def sign_nodes(signs: pa.Table) -> list[OsmNode]:
    """Return the nodes of a `signs` table: new ones first, from -1 down, then those that the map has, by id.

    Signs that come from one node of OpenStreetMap (`source_ref` = `node/123`) are one node again. Every other sign is a
    new node of its own, so that each keeps its place.

    Raises
    ------
    InputError
        A text is longer than OpenStreetMap allows, or has letters that XML cannot hold.
    """
    rows = signs.drop_columns([GEOMETRY, BBOX]).to_pylist()
    lon, lat = lonlat(signs)
    places: dict[tuple[int | None, float, float], list[Row]] = defaultdict(list)
    new: list[tuple[float, float, list[Row]]] = []
    for row, x, y in zip(rows, lon.tolist(), lat.tolist(), strict=True):
        match = _NODE.fullmatch(row["source_ref"])
        if match:
            places[int(match[1]), x, y].append(row)
        else:
            new.append((x, y, [row]))
    kept: dict[int, tuple[float, float, list[Row]]] = {}
    for (number, x, y), group in places.items():
        group.sort(key=lambda row: (len(row["sign_id"]), row["sign_id"]))  # n1-2 before n1-10
        together = [group] if _tags_of(group) is not None else [[row] for row in group]
        for part in together:
            if number is None or number in kept:
                new.append((x, y, part))
            else:
                kept[number] = (x, y, part)
    lowest = min(kept, default=0)
    found = [OsmNode(min(lowest, 0) - n, x, y, _tags(part)) for n, (x, y, part) in enumerate(new, start=1)]
    numbered = sorted(kept.items(), key=lambda item: (item[0] > 0, abs(item[0])))
    return found + [OsmNode(number, x, y, _tags(part)) for number, (x, y, part) in numbered]


def as_text(value: Any) -> str:
    """Return a value as a tag holds it: numbers in full, exponents for extremes only; times in ISO 8601."""
    if isinstance(value, float):
        is_plain = value == 0.0 or _TINY < abs(value) < 1.0 / _TINY
        return str(np.format_float_positional(value, trim="-")) if is_plain else repr(value)
    return value.isoformat() if isinstance(value, datetime) else str(value)


def checked(tags: dict[str, str], *, where: str) -> dict[str, str]:
    """Return tags that are valid in OpenStreetMap XML.

    Raises
    ------
    InputError
        One is too long or has letters that XML cannot hold.
    """
    for key, value in tags.items():
        if len(value) > MAX_CHARACTERS:
            raise InputError(
                f"{key} has {len(value)} letters, and OpenStreetMap allows {MAX_CHARACTERS}: {value[:40]!r}…",
                where=where,
                todo="Shorten it, or convert to another format, e.g. .gpkg.",
            )
        if _NOT_IN_XML.search(value):
            raise InputError(
                f"{key} has letters that XML cannot hold: {value[:40]!r}.",
                where=where,
                todo="Remove them, or convert to another format, e.g. .gpkg.",
            )
    return tags


def _tags(rows: list[Row]) -> dict[str, str]:
    """Return the tags of a node with some signs."""
    tags = _tags_of(rows) or _said([[row] for row in rows])
    for place, row in enumerate(rows, start=1):
        suffix = f":{place}" if place > 1 else ""
        own = {f"{PREFIX}{name}{suffix}": as_text(v) for name, v in row.items() if v is not None and v != ""}
        tags |= own
    return checked(tags, where=f"sign {rows[0]['sign_id'][:80]}")


def _tags_of(rows: list[Row]) -> dict[str, str] | None:
    """Return tags that say the classes and facings of all signs of a node, None where the grammar cannot."""
    for slots in (_stacks(rows), [[row] for row in rows]):
        tags = _said(slots)
        found = [(sign.meaning.sign_class, sign.facing_deg) for sign in node_signs(tags)]
        if found == [(row["sign_class"], row["facing_deg"]) for row in rows]:
            return tags
    return None


def _stacks(rows: Sequence[Row]) -> list[list[Row]]:
    """Put plates behind the main sign that they belong to, where they follow it and look the same way."""
    slots: list[list[Row]] = []
    for row in rows:
        main = slots[-1][0] if slots else None
        if main and row["parent_id"] == main["sign_id"] and row["facing_deg"] == main["facing_deg"]:
            slots[-1].append(row)
        else:
            slots.append([row])
    return slots


def _said(slots: Sequence[Sequence[Row]]) -> dict[str, str]:
    """Return `traffic_sign` and `direction` of the plates of a node."""
    facings = [slot[0]["facing_deg"] for slot in slots]
    tags = {}
    for place, slot in enumerate(slots, start=1):
        key = f"traffic_sign:{place}" if place > 1 else "traffic_sign"
        tags[key] = ",".join(_value(row) for row in slot)
        if facings[place - 1] is not None and len(set(facings)) > 1:
            tags[f"{key}:direction"] = as_text(facings[place - 1])
    if facings[0] is not None and len(set(facings)) == 1:
        tags["direction"] = as_text(facings[0])
    return tags


def _value(row: Row) -> str:
    return sign_value(**{name: row[name] for name in ("sign_class", "raw_code", "country", "value")})
