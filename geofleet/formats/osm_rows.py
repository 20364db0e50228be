"""Nodes with signs to rows of the `signs` table, a piece at a time, in the order of the table's key.

What the tags of a node say is worked out once for all nodes with the same tags; a node is then a number, and its rows
are taken from those of its tags.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from geofleet.formats.osm_tags import is_sign_key, node_signs
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import arrow_numbers, arrow_texts, build_table

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from geofleet.formats.osm_roads import NearestRoad, Roads
    from geofleet.formats.osm_scan import SignNodes
    from geofleet.formats.osm_tags import NodeSign

    Ints = NDArray[np.int64]
    Floats = NDArray[np.float64]

_MAPPED_TWICE_M = 25.0
_DEGREE_M = 111_195.0
_ROWS_A_PIECE = 1 << 14
_DIGITS = 19
_E7 = 1e7
_HYPHEN, _NOTHING = arrow_texts(["-", ""])


@dataclass(frozen=True)
class SignRows:
    """The signs of nodes in the order of `sign_id`; a node's signs are those of its set of tags.

    Parameters
    ----------
    nodes
        Valid nodes, sorted by the text of their ids, shape (n,).
    source
        Name of the file.
    said
        The signs of each set of tags, in the order of their place as text.
    facing_deg
        Of every row, NaN when unknown, shape (r,); None: as the tags say.
    near, road_ids
        Nearest road of every node, and the ways that it counts in.
    """

    nodes: SignNodes
    source: str
    said: list[list[tuple[int, NodeSign]]]
    facing_deg: Floats | None = None
    near: NearestRoad | None = None
    road_ids: Ints | None = None

    @classmethod
    def of(cls, nodes: SignNodes, *, source: str) -> SignRows:
        """Work out what every set of tags says."""
        said = [sorted(enumerate(node_signs(tags)), key=lambda sign: str(sign[0])) for tags in nodes.tagsets]
        return cls(nodes, source, said)

    @cached_property
    def n_signs(self) -> Ints:
        """Signs of each node, shape (n,)."""
        return np.array([len(signs) for signs in self.said], np.int64)[self.nodes.tagset]

    @cached_property
    def n_unknown(self) -> int:
        """Rows whose code the taxonomy does not know."""
        unknown = [sum(not sign.meaning.known for _, sign in signs) for signs in self.said]
        return int(np.array(unknown, np.int64)[self.nodes.tagset].sum())

    @cached_property
    def n_facings(self) -> int:
        """Rows whose facing the tags state."""
        facings = [sum(sign.facing_deg is not None for _, sign in signs) for signs in self.said]
        return int(np.array(facings, np.int64)[self.nodes.tagset].sum())

    def with_roads(self, roads: Roads) -> tuple[SignRows, dict[str, int]]:
        """Return the rows with the nearest road of each, facings filled from it, and counts."""
        from geofleet.formats.osm_roads import LEFT_HAND, facing_of, nearest_road  # noqa: PLC0415  (brings shapely)

        near = nearest_road(roads, self.nodes.lon, self.nodes.lat)
        node, template = self._templates(0, len(self.nodes.node_id))
        rows = type(near)(near.run[node], near.bearing_deg[node], near.is_right[node])
        is_left_hand = np.array([sign.country in LEFT_HAND for _, sign in self._flat], bool)[template]
        side = np.array([sign.side for _, sign in self._flat], object)[template]
        inferred = facing_of(roads, rows, side, is_left_hand)
        stated = self._stated_deg[template]
        filled = np.where(np.isnan(stated), inferred, stated)
        told = {
            "facings from the road": int((np.isnan(stated) & ~np.isnan(filled)).sum()),
            "signs without a road nearby": int((rows.run < 0).sum()),
        }
        return replace(self, facing_deg=filled, near=near, road_ids=roads.way_id), told

    def pieces(self) -> Iterator[pa.Table]:
        """Yield the table, some ten thousand rows at a time; at least one piece."""
        ends = np.cumsum(self.n_signs)
        n_rows = int(ends[-1]) if len(ends) else 0
        cuts = np.unique(np.searchsorted(ends, np.arange(_ROWS_A_PIECE, n_rows, _ROWS_A_PIECE)))
        bounds = [0, *cuts.tolist(), len(ends)]
        for first, last in pairwise(bounds):
            yield self._piece(first, last, int(ends[first - 1]) if first else 0)

    @cached_property
    def _flat(self) -> list[tuple[int, NodeSign]]:
        """The signs of all sets of tags in one list."""
        return [sign for signs in self.said for sign in signs]

    @cached_property
    def _first(self) -> Ints:
        """Where the signs of each set of tags begin in that list."""
        return np.cumsum([0, *(len(signs) for signs in self.said)])[:-1]

    @cached_property
    def _stated_deg(self) -> Floats:
        return np.array([np.nan if s.facing_deg is None else s.facing_deg for _, s in self._flat], np.float64)

    @cached_property
    def _columns(self) -> dict[str, pa.Array]:
        """Columns that the tags alone decide, a row a sign of `_flat`; of ids the place among the node's signs."""
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

    def _templates(self, first: int, last: int) -> tuple[Ints, Ints]:
        """Return the node and the place in `_flat` of each row of some nodes."""
        sizes = self.n_signs[first:last]
        node = np.repeat(np.arange(first, last), sizes)
        within = np.arange(len(node)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        return node, self._first[self.nodes.tagset[node]] + within

    def _piece(self, first: int, last: int, first_row: int) -> pa.Table:
        node, template = self._templates(first, last)
        rows = arrow_numbers(template)
        number = arrow_numbers(self.nodes.node_id[node]).cast(pa.string())
        support = _headed("n", number)
        taken = {name: column.take(rows) for name, column in self._columns.items()}
        columns = taken | {
            "sign_id": pc.binary_join_element_wise(support, taken["sign_id"], _HYPHEN),
            "parent_id": pc.binary_join_element_wise(support, taken["parent_id"], _HYPHEN),
            "facing_deg": self._facing(template, first_row),
            "support_id": support,
            "road_id": self._road_id(node),
            "source": self.source,
            "source_ref": _headed("node/", number),
        }
        return build_table(SIGNS, columns, (self.nodes.lon_e7[node] / _E7, self.nodes.lat_e7[node] / _E7))

    def _facing(self, template: Ints, first_row: int) -> Floats:
        if self.facing_deg is None:
            return self._stated_deg[template]
        return self.facing_deg[first_row : first_row + len(template)]

    def _road_id(self, node: Ints) -> pa.Array | None:
        if self.near is None or self.road_ids is None:
            return None
        run = self.near.run[node]
        if not len(self.road_ids):
            return pa.nulls(len(run), pa.string())
        way = arrow_numbers(self.road_ids[np.maximum(run, 0)]).cast(pa.string())
        return pc.if_else(pa.array(run >= 0), _headed("w", way), None)


def _headed(head: str, texts: pa.Array) -> pa.Array:
    """Return texts with a head before each."""
    return pc.binary_join_element_wise(arrow_texts([head])[0], texts, _NOTHING)


def clean_nodes(nodes: SignNodes) -> tuple[SignNodes, dict[str, int]]:
    """Leave out nodes nowhere on Earth, given before, or mapped on the road as well as beside it; tell how many.

    The others come in the order of their ids as text.
    """
    valid = nodes.is_valid
    kept = nodes if valid.all() else nodes.take(valid)
    kept = kept.take(_text_order(kept.node_id))
    again = np.diff(kept.node_id, prepend=kept.node_id[:1] - 1) == 0
    kept = kept.take(~again) if again.any() else kept
    twice = _mapped_twice(kept)
    skipped = {
        "nodes without a valid position": int((~valid).sum()),
        "nodes that came before": int(again.sum()),
        f"highway=stop, give_way within {_MAPPED_TWICE_M:.0f} m of the sign itself": int(twice.sum()),
    }
    return kept.take(~twice) if twice.any() else kept, {reason: n for reason, n in skipped.items() if n}


def _mapped_twice(nodes: SignNodes) -> NDArray[np.bool_]:
    """Tell which nodes are a road's `highway=stop|give_way` point whose sign is mapped beside the road as well."""
    twice = np.zeros(len(nodes.node_id), bool)
    concepts = [{sign.meaning.concept for sign in node_signs(tags)} for tags in nodes.tagsets]
    is_own = np.array([any(map(is_sign_key, tags)) for tags in nodes.tagsets], bool)
    for name in ("stop", "yield"):
        has_it = np.array([name in found for found in concepts], bool)
        points = np.flatnonzero((has_it & ~is_own)[nodes.tagset])
        plates = np.flatnonzero((has_it & is_own)[nodes.tagset])
        if not len(points) or not len(plates):
            continue
        tree = shapely.STRtree(shapely.points(_metres(nodes.take(plates))))
        beside = shapely.points(_metres(nodes.take(points)))
        near = tree.query(beside, predicate="dwithin", distance=_MAPPED_TWICE_M)
        twice[points[near[0]]] = True
    return twice


def _metres(nodes: SignNodes) -> Floats:
    """Return places on a plane where a degree of longitude is shrunk at each latitude: right over a few metres."""
    return np.column_stack((nodes.lon * np.cos(np.radians(nodes.lat)), nodes.lat)) * _DEGREE_M


def _text_order(number: Ints) -> Ints:
    """Return the order of ids as text that goes on with a hyphen: -3, 1, 12, 2, as `n12-0` comes before `n2-0`."""
    size = np.abs(number).astype(np.uint64)
    digits = np.searchsorted(np.array([10**k for k in range(1, _DIGITS)], np.uint64), size, side="right") + 1
    padded = size * np.power(np.uint64(10), (_DIGITS - digits).astype(np.uint64))
    return np.lexsort((digits, padded, number >= 0)).astype(np.int64)
