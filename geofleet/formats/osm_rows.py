"""Nodes with signs to rows of the `signs` table, a piece at a time, in the order of the table's key.

What the tags of a node say is worked out once for all nodes with the same tags; a node is then a number, and its rows
are taken from those of its tags.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.formats.osm_spool import NODE
from geofleet.formats.osm_tags import is_sign_key, node_signs
from geofleet.formats.positions import PlaceCheck
from geofleet.tables.arrays import arrow_numbers, arrow_texts
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import build_table

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.formats.osm_roads import NearestRoad, RoadIndex, Roads
    from geofleet.formats.osm_scan import SignNodes
    from geofleet.formats.osm_spool import NodeSpool

    Ints = NDArray[np.int64]
    Nodes = NDArray[np.void]

_MAPPED_TWICE_M = 25.0
_DEGREE_M = 111_195.0
_POINTS_AT_ONCE = 1 << 12
_MAX_E7 = (1_800_000_000, 900_000_000)
_E7 = 1e7
INVALID, AGAIN = "nodes without a valid position", "nodes that came before"
TWICE = f"highway=stop, give_way within {_MAPPED_TWICE_M:.0f} m of the sign itself"
UNKNOWN, STATED = "unknown codes", "facings in the tags"
INFERRED, NO_ROAD = "facings from the road", "signs without a road nearby"
EDGE = "way nodes beyond the edge of the file"
SIGNED_WAYS = "ways tagged with signs, which say what holds there and not where a sign stands"
_HYPHEN, _NOTHING = arrow_texts(["-", ""])


class TagSigns:
    """The signs of each set of tags, as rows to take from.

    Parameters
    ----------
    tagsets
        The different tags that nodes with signs have.
    """

    def __init__(self, tagsets: list[dict[str, str]]) -> None:
        said = [sorted(enumerate(node_signs(tags)), key=lambda sign: str(sign[0])) for tags in tagsets]
        self.n_signs = np.array([len(signs) for signs in said], np.int64)
        self.n_unknown = np.array([sum(not sign.meaning.known for _, sign in signs) for signs in said], np.int64)
        self._first = np.cumsum([0, *self.n_signs])[:-1]
        self._flat = [sign for signs in said for sign in signs]
        self._concepts = [{sign.meaning.concept for _, sign in signs} for signs in said]
        self._is_own = np.array([any(map(is_sign_key, tags)) for tags in tagsets], bool)
        stated = [np.nan if sign.facing_deg is None else sign.facing_deg for _, sign in self._flat]
        self.facing_deg = np.array(stated, np.float64)
        self.side = np.array([sign.side for _, sign in self._flat], object)
        self.country = [sign.country for _, sign in self._flat]
        countries = [next((sign.country for _, sign in signs if sign.country), None) for signs in said]
        self.lands = list(dict.fromkeys(countries))
        self.land = np.array([self.lands.index(country) for country in countries], np.int64)

    def templates(self, tagset: Ints) -> tuple[Ints, Ints]:
        """Return of each row the place of its node, and that of its sign among those of all tags."""
        sizes = self.n_signs[tagset]
        node = np.repeat(np.arange(len(tagset)), sizes)
        within = np.arange(len(node)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return node, self._first[tagset[node]] + within

    @cached_property
    def columns(self) -> dict[str, pa.Array]:
        """Columns that the tags alone decide, a row a sign; of ids the place among the node's signs."""
        signs = [sign for _, sign in self._flat]
        columns: dict[str, list[Any]] = {
            name: [getattr(sign, name) for sign in signs] for name in ("kind", "raw_code", "country")
        }
        columns["sign_id"] = [str(place) for place, _ in self._flat]
        columns["parent_id"] = [None if sign.parent is None else str(sign.parent) for sign in signs]
        columns |= {
            name: [getattr(sign.meaning, name) for sign in signs] for name in ("concept", "value", "unit", "sign_class")
        }
        value = np.array([np.nan if v is None else v for v in columns.pop("value")], np.float64)
        return {"value": arrow_numbers(value)} | {name: arrow_texts(column) for name, column in columns.items()}

    def says(self, concept: str, *, own: bool) -> NDArray[np.bool_]:
        """Tell which sets of tags name a sign of a concept, by a key of signs (`own`) or by `highway` alone."""
        named = [concept in found for found in self._concepts]
        return np.asarray(np.logical_and(named, self._is_own == own), bool)


class SignRows:
    """The signs of nodes, a table at a time, in the order of `sign_id`.

    `skipped` and `found` count what was met once all pieces have been taken.

    Parameters
    ----------
    nodes
        Nodes and their tags.
    path
        The file.
    roads
        Drivable ways, which give each sign a road and, where its tags do not say, a facing.
    """

    def __init__(self, nodes: SignNodes, *, path: Path, roads: Roads | None = None) -> None:
        self.skipped: dict[str, int] = {}
        self.found: dict[str, int] = {}
        self._nodes, self._path, self._roads = nodes, path, roads
        self._tags = TagSigns(nodes.tagsets)

    def pieces(self) -> Iterator[pa.Table]:
        """Yield the table, some ten thousand rows at a time; at least one piece."""
        self.skipped.clear()
        self.found.update({UNKNOWN: 0, STATED: 0})
        index = None
        if self._roads is not None:
            from geofleet.formats.osm_roads import RoadIndex  # noqa: PLC0415  (not needed without roads)

            self.found.update({INFERRED: 0, NO_ROAD: 0, EDGE: self._roads.n_missing_nodes})
            if self._roads.n_signed_ways:
                self.skipped[SIGNED_WAYS] = self._roads.n_signed_ways
            index = RoadIndex(self._roads)
        twice = _mapped_twice(self._nodes.spool, self._tags)
        check = PlaceCheck(str(self._path))
        n_pieces = 0
        for nodes in self._nodes.spool.in_text_order():
            kept = self._kept(nodes, twice)
            if len(kept):
                n_pieces += 1
                self._look_at(kept, check)
                yield self._table(kept, index)
        if not n_pieces:
            yield self._table(np.zeros(0, NODE), index)
        self.found.update(check.doubts())

    def _look_at(self, nodes: Nodes, check: PlaceCheck) -> None:
        """Hold positions against the countries that the tags name."""
        lon, lat, land = nodes["lon_e7"] / _E7, nodes["lat_e7"] / _E7, self._tags.land[nodes["tagset"]]
        for number in np.flatnonzero(np.bincount(land)).tolist():  # np.unique imports numpy.ma, a tenth of a second
            there = land == number
            check.add(lon[there], lat[there], self._tags.lands[number])

    def _kept(self, nodes: Nodes, twice: Ints) -> Nodes:
        """Leave out nodes nowhere on Earth, given before, or mapped on the road as well as beside it."""
        valid = nodes[_is_valid(nodes)]
        new = np.diff(valid["node_id"], prepend=valid["node_id"][:1] - 1) != 0
        kept = valid[new]
        once: Nodes = kept[~_is_among(kept["node_id"], twice)]
        for reason, before, after in ((INVALID, nodes, valid), (AGAIN, valid, kept), (TWICE, kept, once)):
            if len(after) < len(before):
                self.skipped[reason] = self.skipped.get(reason, 0) + len(before) - len(after)
        return once

    def _table(self, nodes: Nodes, index: RoadIndex | None) -> pa.Table:
        node, template = self._tags.templates(nodes["tagset"])
        rows = arrow_numbers(template)
        number = arrow_numbers(nodes["node_id"][node]).cast(pa.string())
        support = _headed("n", number)
        taken = {name: column.take(rows) for name, column in self._tags.columns.items()}
        stated = self._tags.facing_deg[template]
        self.found[UNKNOWN] += int(self._tags.n_unknown[nodes["tagset"]].sum())
        self.found[STATED] += int((~np.isnan(stated)).sum())
        lon, lat = nodes["lon_e7"] / _E7, nodes["lat_e7"] / _E7
        columns = taken | {
            "sign_id": pc.binary_join_element_wise(support, taken["sign_id"], _HYPHEN),
            "parent_id": pc.binary_join_element_wise(support, taken["parent_id"], _HYPHEN),
            "facing_deg": stated,
            "support_id": support,
            "source": self._path.name,
            "source_ref": _headed("node/", number),
        }
        if index is not None:
            columns |= self._beside(index.roads, index.nearest(lon, lat), node, template)
        return build_table(SIGNS, columns, (lon[node], lat[node]), in_order=True)

    def _beside(self, roads: Roads, near: NearestRoad, node: Ints, template: Ints) -> dict[str, Any]:
        """Return road and facing of each row, and count them."""
        from geofleet.formats.osm_roads import LEFT_HAND, facing_of  # noqa: PLC0415  (as above)

        rows = type(near)(near.run[node], near.bearing_deg[node], near.is_right[node])
        is_left_hand = np.array([country in LEFT_HAND for country in self._tags.country], bool)[template]
        inferred = facing_of(roads, rows, self._tags.side[template], is_left_hand)
        stated = self._tags.facing_deg[template]
        self.found[INFERRED] += int((np.isnan(stated) & ~np.isnan(inferred)).sum())
        self.found[NO_ROAD] += int((rows.run < 0).sum())
        way = np.append(roads.way_id, 0)[rows.run]
        road_id = pc.if_else(pa.array(rows.run >= 0), _headed("w", arrow_numbers(way).cast(pa.string())), None)
        return {"road_id": road_id, "facing_deg": np.where(np.isnan(stated), inferred, stated)}


def _headed(head: str, texts: pa.Array) -> pa.Array:
    """Return texts with a head before each."""
    return pc.binary_join_element_wise(arrow_texts([head])[0], texts, _NOTHING)


def _is_valid(nodes: Nodes) -> NDArray[np.bool_]:
    """Tell which nodes lie on Earth."""
    return np.asarray((np.abs(nodes["lon_e7"]) <= _MAX_E7[0]) & (np.abs(nodes["lat_e7"]) <= _MAX_E7[1]), bool)


def _is_among(number: Ints, ascending: Ints) -> NDArray[np.bool_]:
    """Do as `np.isin`, which imports numpy.ma."""
    if not len(ascending):
        return np.zeros(len(number), bool)
    return np.asarray(ascending[np.searchsorted(ascending[:-1], number)] == number, bool)


def _mapped_twice(spool: NodeSpool, tags: TagSigns) -> Ints:
    """Return the nodes that are a road's `highway=stop|give_way` point whose sign is mapped beside it, ascending."""
    twice = []
    for concept in ("stop", "yield"):
        parts: dict[bool, list[Nodes]] = {True: [], False: []}
        for own, found in parts.items():
            says = tags.says(concept, own=own)
            if says.any():
                found.extend(chunk[says[chunk["tagset"]] & _is_valid(chunk)] for chunk in spool.chunks())
        if parts[True] and parts[False]:
            plates, points = (np.concatenate(parts[own]) for own in (True, False))
            twice.append(points["node_id"][_is_beside(points, plates)])
    return np.sort(np.concatenate([np.zeros(0, np.int64), *twice]))


def _is_beside(points: Nodes, plates: Nodes) -> NDArray[np.bool_]:
    """Tell which points have a plate within `_MAPPED_TWICE_M`, among those of about the same latitude."""
    plates = plates[np.argsort(plates["lat_e7"], kind="stable")]
    found = np.zeros(len(points), bool)
    reach_e7 = np.int64(_MAPPED_TWICE_M / _DEGREE_M * _E7) + 1
    for first in range(0, len(points), _POINTS_AT_ONCE):
        some = points[first : first + _POINTS_AT_ONCE]
        lat = some["lat_e7"].astype(np.int64)
        begin = np.searchsorted(plates["lat_e7"], lat - reach_e7)
        size = np.searchsorted(plates["lat_e7"], lat + reach_e7, side="right") - begin
        point = np.repeat(np.arange(len(some)), size)
        plate = np.arange(len(point)) - np.repeat(np.cumsum(size) - size - begin, size)
        east, north = ((plates[s][plate].astype(np.int64) - some[s][point]) / _E7 for s in ("lon_e7", "lat_e7"))
        near = np.hypot(east * np.cos(np.radians(lat[point] / _E7)), north) * _DEGREE_M <= _MAPPED_TWICE_M
        found[first + point[near]] = True
    return found
