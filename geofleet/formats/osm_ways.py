"""Roads and lanes as OpenStreetMap's ways, joined where their lines meet."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import shapely

from geofleet.formats.osm_nodes import PREFIX, OsmNode, as_text, checked
from geofleet.formats.osm_tags import CAR_ROADS
from geofleet.tables.schemas import BBOX, GEOMETRY

if TYPE_CHECKING:
    import pyarrow as pa

_WAY = re.compile(r"w([1-9]\d{0,17})")
_UNKNOWN_ROAD = "road"  # https://wiki.openstreetmap.org/wiki/Tag:highway=road: of a class that nobody knows


@dataclass(frozen=True, slots=True)
class OsmWay:
    """A way: its id (negative: new), nodes and tags."""

    way_id: int
    node_ids: list[int]
    tags: dict[str, str]


def lane_ways(lanes: pa.Table) -> tuple[list[OsmNode], list[OsmWay]]:
    """Return nodes and ways of a `lanes` table.

    A lane of a kind that OpenStreetMap has for roads is a `highway` of it, any other `highway=road`; the table's own
    columns are under `geofleet:`. Ends at the same place are one node. Nodes are new; a way keeps the id that it had
    in OpenStreetMap (`lane_id` = `w123`).

    Raises
    ------
    InputError
        A text is longer than OpenStreetMap allows, or has letters that XML cannot hold.
    """
    numbers: dict[tuple[float, float], int] = {}
    ways = []
    shapes = shapely.from_wkb(lanes[GEOMETRY].to_numpy(zero_copy_only=False))
    n_new = 0
    for row, shape in zip(lanes.drop_columns([GEOMETRY, BBOX]).to_pylist(), shapes, strict=True):
        refs = [numbers.setdefault(place, -1 - len(numbers)) for place in map(tuple, shape.coords)]
        tags = {"highway": row["kind"] if row["kind"] in CAR_ROADS else _UNKNOWN_ROAD}
        if row["speed_limit_kmh"] is not None:
            tags["maxspeed"] = as_text(row["speed_limit_kmh"])
        tags |= {f"{PREFIX}{name}": as_text(value) for name, value in row.items() if value is not None and value != ""}
        match = _WAY.fullmatch(row["lane_id"])
        n_new += match is None
        way_id = int(match[1]) if match else -n_new
        ways.append(OsmWay(way_id, refs, checked(tags, where=f"lane {row['lane_id'][:80]}")))
    ways.sort(key=lambda way: (way.way_id > 0, abs(way.way_id)))
    return [OsmNode(number, lon, lat, {}) for (lon, lat), number in numbers.items()], ways
