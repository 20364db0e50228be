"""Signs and drivable roads of an OpenStreetMap file: PBF, XML, or XML packed with gzip or bzip2."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from geofleet.formats.osm_roads import LEFT_HAND, Roads, facing_of, nearest_road
from geofleet.formats.osm_scan import SignNodes, detect, explained, open_osm, read_roads, refuse_lanelet2, sign_nodes
from geofleet.formats.osm_tags import is_sign_key, node_signs
from geofleet.formats.reading import LayerRead
from geofleet.tables.schemas import LANES, SIGNS
from geofleet.tables.store import build_table

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

__all__ = ["FORMAT", "detect", "read_lanes", "read_signs"]

FORMAT = "osm"
EDGE = "way nodes beyond the edge of the file"
_MAPPED_TWICE_M = 25.0
_DEGREE_M = 111_195.0


@dataclass(frozen=True, slots=True)
class _Signs:
    """Signs in rows: node of each, place among the node's signs, position in degrees, and what the tags say."""

    node: NDArray[np.int64]
    place: NDArray[np.int64]
    lon: NDArray[np.float64]
    lat: NDArray[np.float64]
    said: NDArray[np.object_]

    def column(self, name: str) -> list[Any]:
        """Return an attribute of what the tags say, a row each."""
        return [getattr(sign, name) for sign in self.said]

    def meaning(self, name: str) -> list[Any]:
        """Return an attribute of the meaning of the code, a row each."""
        return [getattr(sign.meaning, name) for sign in self.said]

    def take(self, keep: NDArray[np.bool_]) -> _Signs:
        """Return some of the rows."""
        return _Signs(self.node[keep], self.place[keep], self.lon[keep], self.lat[keep], self.said[keep])


def read_signs(path: Path, *, roads: bool = True) -> LayerRead:
    """Read the signs of an OpenStreetMap file.

    Parameters
    ----------
    path
        PBF, XML, or packed XML; told apart by content.
    roads
        Read the drivable ways too, and give each sign the nearest one's id and, where its tags do not say, the facing
        that it implies.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or not OpenStreetMap's.
    """
    file = open_osm(path)
    with explained(path):
        nodes = sign_nodes(file)
        ways = read_roads(file) if roads else None
    if not len(nodes.node_id):
        refuse_lanelet2(path)
    signs, skipped = _signs(nodes)
    facing = np.array([np.nan if f is None else f for f in signs.column("facing_deg")], np.float64)
    found = {
        "unknown codes": signs.meaning("known").count(False),
        "facings in the tags": int((~np.isnan(facing)).sum()),
    }
    road_id = None
    if ways is not None:
        facing, road_id, told = _from_roads(ways, signs, facing)
        found |= told
    table = build_table(SIGNS, _columns(nodes, signs, facing, road_id, path.name), (signs.lon, signs.lat))
    return LayerRead(table, FORMAT, skipped, found)


def read_lanes(path: Path) -> LayerRead:
    """Read the drivable ways of an OpenStreetMap file as `lanes`; a way cut by the edge of the file gives its pieces.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or not OpenStreetMap's.
    """
    file = open_osm(path)
    with explained(path):
        ways = read_roads(file)
    if not len(ways.way_id):
        refuse_lanelet2(path)
    columns = {
        "lane_id": [f"w{way}" + (f"-{n}" if n else "") for way, n in zip(ways.way_id, ways.part, strict=True)],
        "road_id": [f"w{way}" for way in ways.way_id],
        "kind": ways.kind,
        "speed_limit_kmh": ways.speed_limit_kmh,
        "source": path.name,
    }
    return LayerRead(build_table(LANES, columns, ways.lines()), FORMAT, {}, {EDGE: ways.n_missing_nodes})


def _signs(nodes: SignNodes) -> tuple[_Signs, dict[str, int]]:
    """Return every sign of the nodes, and what was left out and why."""
    valid = ~np.isnan(nodes.lon)
    said = [node_signs(tags) if ok else [] for tags, ok in zip(nodes.tags, valid, strict=True)]
    sizes = np.array([len(signs) for signs in said], np.int64)
    node = np.repeat(np.arange(len(sizes)), sizes)
    place = np.arange(len(node)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    flat = np.empty(len(node), object)
    flat[:] = [sign for signs in said for sign in signs]
    signs = _Signs(node, place, nodes.lon[node], nodes.lat[node], flat)
    twice = _mapped_twice(signs, np.array([any(map(is_sign_key, tags)) for tags in nodes.tags], bool))
    skipped = {
        "nodes without a valid position": int((~valid).sum()),
        f"highway=stop, give_way within {_MAPPED_TWICE_M:.0f} m of the sign itself": int(twice.sum()),
    }
    return signs.take(~twice), {reason: n for reason, n in skipped.items() if n}


def _mapped_twice(signs: _Signs, has_key: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Tell which rows are a road's `highway=stop|give_way` point whose sign is mapped beside the road as well."""
    twice = np.zeros(len(signs.node), bool)
    own = has_key[signs.node]
    concept = np.array(signs.meaning("concept"), object)
    scale = np.cos(np.radians(signs.lat))
    for name in ("stop", "yield"):
        points, plates = np.flatnonzero(~own & (concept == name)), np.flatnonzero(own & (concept == name))
        if not len(points) or not len(plates):
            continue
        # A degree of longitude is shrunk at each latitude: right to 1e-5 over the few metres that matter.
        east, north = signs.lon * scale * _DEGREE_M, signs.lat * _DEGREE_M
        tree = shapely.STRtree(shapely.points(east[plates], north[plates]))
        near = tree.query(shapely.points(east[points], north[points]), predicate="dwithin", distance=_MAPPED_TWICE_M)
        twice[points[np.unique(near[0])]] = True
    return twice


def _from_roads(
    ways: Roads, signs: _Signs, facing_deg: NDArray[np.float64]
) -> tuple[NDArray[np.float64], list[str | None], dict[str, int]]:
    """Return facing with gaps filled, the road of each sign, and counts."""
    near = nearest_road(ways, signs.lon, signs.lat)
    is_left_hand = np.array([country in LEFT_HAND for country in signs.column("country")], bool)
    inferred = facing_of(ways, near, np.array(signs.column("side"), object), is_left_hand)
    filled = np.where(np.isnan(facing_deg), inferred, facing_deg)
    road_id = [f"w{ways.way_id[run]}" if run >= 0 else None for run in near.run]
    return (
        filled,
        road_id,
        {
            "facings from the road": int((np.isnan(facing_deg) & ~np.isnan(filled)).sum()),
            "signs without a road nearby": int((near.run < 0).sum()),
            EDGE: ways.n_missing_nodes,
        },
    )


def _columns(
    nodes: SignNodes, signs: _Signs, facing_deg: NDArray[np.float64], road_id: list[str | None] | None, source: str
) -> dict[str, Any]:
    """Return the columns of the `signs` table."""
    osm_id = nodes.node_id[signs.node]
    said: NDArray[np.object_] = signs.said
    parents = (sign.parent for sign in said)
    return {
        "sign_id": [f"n{number}-{place}" for number, place in zip(osm_id, signs.place, strict=True)],
        "kind": signs.column("kind"),
        "parent_id": [
            None if parent is None else f"n{number}-{parent}" for number, parent in zip(osm_id, parents, strict=True)
        ],
        "concept": signs.meaning("concept"),
        "value": signs.meaning("value"),
        "unit": signs.meaning("unit"),
        "sign_class": signs.meaning("sign_class"),
        "raw_code": signs.column("raw_code"),
        "country": signs.column("country"),
        "facing_deg": facing_deg,
        "support_id": [f"n{number}" for number in osm_id],
        "road_id": road_id,
        "source": source,
        "source_ref": [f"node/{number}" for number in osm_id],
    }
