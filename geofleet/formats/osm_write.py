"""OpenStreetMap XML (`.osm`) and osmChange (`.osc`) of signs, or of roads and lanes.

What is written is for editors and tools, and not for uploading: OpenStreetMap's other tags and versions of an element
are not known here, so `.osm` says so (`upload="never"`, which JOSM obeys), and known elements are of version 1, which
the server refuses unless nobody ever changed them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

from geofleet.formats.osm_nodes import OsmNode, as_text, sign_nodes
from geofleet.formats.osm_value import GENERATOR
from geofleet.formats.osm_ways import OsmWay, lane_ways
from geofleet.tables.schemas import LANES
from geofleet.tables.store import atomic_path

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    import pyarrow as pa

    from geofleet.tables.schemas import Schema

_DECLARATION = "<?xml version='1.0' encoding='UTF-8'?>\n"
_NEWLINES = {"\t": "&#9;", "\n": "&#10;", "\r": "&#13;"}


def write_osm(schema: Schema, table: pa.Table, path: Path) -> None:
    """Write a `signs` or `lanes` table as OpenStreetMap XML, atomically.

    New elements have negative ids; those that came from OpenStreetMap keep theirs.

    Raises
    ------
    InputError
        A text is longer than OpenStreetMap allows, or has letters that XML cannot hold.
    """
    elements = _elements(schema, table)
    with atomic_path(path) as draft, draft.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f'{_DECLARATION}<osm version="0.6" generator="{GENERATOR}" upload="never">\n')
        file.writelines(_lines(elements))
        file.write("</osm>\n")


def write_osc(schema: Schema, table: pa.Table, path: Path) -> None:
    """Write a `signs` or `lanes` table as the change that would bring it about: new elements created, others modified.

    Atomic; errors as `write_osm`.
    """
    elements = _elements(schema, table)
    parts = {
        "create": [element for element in elements if _id(element) < 0],
        "modify": [element for element in elements if _id(element) > 0],
    }
    with atomic_path(path) as draft, draft.open("w", encoding="utf-8", newline="\n") as file:
        file.write(f'{_DECLARATION}<osmChange version="0.6" generator="{GENERATOR}">\n')
        for action, chosen in parts.items():
            if chosen:
                file.write(f"<{action}>\n")
                file.writelines(_lines(chosen))
                file.write(f"</{action}>\n")
        file.write("</osmChange>\n")


def _elements(schema: Schema, table: pa.Table) -> list[OsmNode | OsmWay]:
    if schema is LANES:
        nodes, ways = lane_ways(table)
        return [*nodes, *ways]
    return list(sign_nodes(table))


def _id(element: OsmNode | OsmWay) -> int:
    return element.node_id if isinstance(element, OsmNode) else element.way_id


def _lines(elements: Iterable[OsmNode | OsmWay]) -> Iterator[str]:
    """Yield the XML of elements, one at a time."""
    for element in elements:
        number = _id(element)
        start = f'id="{number}"' + (' version="1"' if number > 0 else "")
        if isinstance(element, OsmNode):
            name, inside = "node", ""
            start += f' lat="{as_text(element.lat)}" lon="{as_text(element.lon)}"'
        else:
            name, inside = "way", "".join(f'  <nd ref="{ref}"/>\n' for ref in element.node_ids)
        inside += "".join(
            f"  <tag k={quoteattr(key, _NEWLINES)} v={quoteattr(value, _NEWLINES)}/>\n"
            for key, value in element.tags.items()
        )
        yield f" <{name} {start}>\n{inside} </{name}>\n" if inside else f" <{name} {start}/>\n"
