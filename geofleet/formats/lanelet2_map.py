"""A Lanelet2 map (`.osm`) as points, lines, lanelets and regulatory elements, read in one streaming pass.

Ids are kept as text: maps are written with negative and with 19-digit ones. Tagging as in
https://github.com/fzi-forschungszentrum-informatik/Lanelet2/tree/master/lanelet2_core/doc.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.errors import InputError
from geofleet.formats.datum import datum_of
from geofleet.formats.lanelet2_places import Projection, placed_by_squares
from geofleet.formats.reading import WGS84, open_unpacked, read_head
from geofleet.formats.xml import explained, iter_elements

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import BinaryIO

    from numpy.typing import NDArray

    from geofleet.formats.reading import Datum
    from geofleet.formats.xml import Element

    Floats = NDArray[np.float64]

LANELET, REGULATION, SIGN = "lanelet", "regulatory_element", "traffic_sign"
_TYPES = rb"(?:lanelet|regulatory_element|traffic_sign)"
_KEY, _VALUE = rb"""k\s*=\s*["']type["']""", rb"""v\s*=\s*["']""" + _TYPES + rb"""["']"""
_MARK = re.compile(_KEY + rb"\s+" + _VALUE + rb"|" + _VALUE + rb"\s+" + _KEY)
_CHUNK_BYTES, _OVERLAP_BYTES = 1 << 20, 256
_MISFIT_M = 1.0
_MAX_LON_DEG, _MAX_LAT_DEG = 180.0, 90.0
_NUMBERS = ("local_x", "local_y", "ele")

MISSING_NODES = "nodes that ways refer to and the file does not hold"
BAD_POSITION = "nodes without a valid position"
BY_SQUARE = "nodes placed by mgrs_code, local_x and local_y"


@dataclass(frozen=True, slots=True)
class Line:
    """A way, or a lone tagged node: rows of its points in the map, its tags, and `way/<id>` or `node/<id>`."""

    points: NDArray[np.int64]
    tags: dict[str, str]
    ref: str


@dataclass(frozen=True, slots=True)
class Member:
    """A member of a relation: `node`, `way` or `relation`, its id and its role."""

    kind: str
    ref: str
    role: str


@dataclass(frozen=True, slots=True)
class Relation:
    """A lanelet or a regulatory element."""

    tags: dict[str, str]
    members: tuple[Member, ...]

    def refs(self, kind: str, *roles: str) -> list[str]:
        """Return the ids of the members of a kind in some roles, in their order."""
        return [member.ref for member in self.members if member.kind == kind and member.role in roles]


@dataclass(frozen=True, slots=True)
class LaneletMap:
    """A Lanelet2 map.

    Parameters
    ----------
    lon, lat
        Points, degrees, shape (n,); all valid.
    ele_m
        Elevations as the map has them, NaN without one, shape (n,).
    lines
        Ways by id; a way without any valid point is not among them.
    sign_nodes
        Lone nodes that are tagged as a sign, by id.
    lanelets, regulations
        Relations by id.
    skipped, found
        What was left out and why; what else is worth telling.
    datum
        What the positions were in, and how they came to WGS 84.
    """

    lon: Floats
    lat: Floats
    ele_m: Floats
    lines: dict[str, Line]
    sign_nodes: dict[str, Line]
    lanelets: dict[str, Relation]
    regulations: dict[str, Relation]
    skipped: dict[str, int]
    found: dict[str, int]
    datum: Datum = WGS84


def is_lanelet2(path: Path) -> bool:
    """Tell whether an OSM XML file is a Lanelet2 map: it has lanelets, regulatory elements or sign ways.

    Raises
    ------
    InputError
        The file is missing, empty, or breaks off before the first such element.
    """
    if not _has_mark(path):
        return False
    for element in iter_elements(path, ("way", "relation"), root="osm"):
        kind = _tags(element).get("type")
        if kind in {LANELET, REGULATION} if element.tag == "relation" else kind == SIGN:
            return True
    return False


def load_map(
    path: Path, *, origin: tuple[float, float] | None = None, utm: tuple[str, float, float] | None = None
) -> LaneletMap:
    """Read a Lanelet2 map.

    Parameters
    ----------
    path
        OSM XML, or the same packed with gzip or bzip2.
    origin
        Latitude and longitude, degrees, that `local_x` and `local_y` count from, as Lanelet2's UtmProjector does:
        easting and northing in the UTM zone of the origin, minus those of the origin.
    utm
        Projected CRS, easting and northing of `local_x` = `local_y` = 0. With neither, `lat` and `lon` are used or,
        where a node has none, `local_x`, `local_y` in the MGRS square of `mgrs_code`.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or no Lanelet2 map, or its positions are local and neither `origin` nor
        `utm` says where.
    ConfigError
        `origin` and `utm` are both given, or one of them makes no sense.
    """
    raw = _RawMap()
    projection = Projection.of(origin, utm)
    for element in iter_elements(path, ("node", "way", "relation"), root="osm"):
        raw.add(element)
    if not (
        raw.lanelets or raw.regulations or raw.sign_nodes or any(t.get("type") == SIGN for _, t in raw.ways.values())
    ):
        raise InputError(
            "no lanelets, regulatory elements or traffic_sign ways: not a Lanelet2 map.",
            where=str(path),
            todo="Use --format osm for a map of OpenStreetMap.",
        )
    with explained(path):
        return raw.finish(projection)


class _RawMap:
    """Collects the elements of a file; positions become final when all are known."""

    def __init__(self) -> None:
        self.row: dict[str, int] = {}
        self.numbers: list[tuple[float, ...]] = []  # lon, lat, local_x, local_y, ele
        self.codes: list[str] = []  # mgrs_code
        self.sign_nodes: dict[str, dict[str, str]] = {}
        self.ways: dict[str, tuple[list[str], dict[str, str]]] = {}
        self.lanelets: dict[str, Relation] = {}
        self.regulations: dict[str, Relation] = {}
        self.skipped: Counter[str] = Counter()
        self.found: Counter[str] = Counter()

    def add(self, element: Element) -> None:
        """Take one node, way or relation."""
        identity = element.get("id", "").strip()
        if element.get("action") == "delete" or element.get("visible") == "false":
            self.skipped["deleted elements"] += 1
        elif not identity:
            self.skipped["elements without an id"] += 1
        elif element.tag == "node":
            self._add_node(identity, element)
        elif element.tag == "way":
            if identity in self.ways:
                self.skipped["ways whose id the file has already"] += 1
            else:
                refs = [nd.get("ref", "").strip() for nd in element if nd.tag == "nd"]
                self.ways[identity] = (refs, _tags(element))
        else:
            self._add_relation(identity, element)

    def _add_node(self, identity: str, element: Element) -> None:
        if identity in self.row:
            self.skipped["nodes whose id the file has already"] += 1
            return
        tags = _tags(element)
        self.row[identity] = len(self.numbers)
        place = (_float(element.get("lon")), _float(element.get("lat")))
        self.numbers.append((*place, *(_float(tags.get(name)) for name in _NUMBERS)))
        self.codes.append(tags.get("mgrs_code", ""))
        if tags.get("type") == SIGN:
            self.sign_nodes[identity] = tags

    def _add_relation(self, identity: str, element: Element) -> None:
        tags = _tags(element)
        home = {LANELET: self.lanelets, REGULATION: self.regulations}.get(tags.get("type", ""))
        if home is None:
            return
        if identity in home:
            self.skipped["relations whose id the file has already"] += 1
            return
        members = (m for m in element if m.tag == "member")
        home[identity] = Relation(
            tags, tuple(Member(m.get("type", ""), m.get("ref", "").strip(), m.get("role", "")) for m in members)
        )

    def finish(self, projection: Projection | None) -> LaneletMap:
        """Return the map, its points in degrees."""
        numbers = np.array(self.numbers, np.float64).reshape(-1, 5)
        lon, lat, datum = self._positions(numbers, projection)
        with np.errstate(invalid="ignore"):
            valid = (np.abs(lon) <= _MAX_LON_DEG) & (np.abs(lat) <= _MAX_LAT_DEG)
        if len(valid) and not valid.any():
            raise InputError(
                f"none of {len(valid)} nodes has a valid position.",
                todo="Export the map again, with lat and lon in degrees.",
            )
        if not valid.all():
            self.skipped[BAD_POSITION] += int((~valid).sum())
        place = np.where(valid, np.cumsum(valid) - 1, -1)
        lines = {}
        for identity, (refs, tags) in self.ways.items():
            known = [self.row[ref] for ref in refs if ref in self.row]
            self.found[MISSING_NODES] += len(refs) - len(known)
            points = place[known][place[known] >= 0] if known else np.empty(0, np.int64)
            if len(points):
                lines[identity] = Line(points.astype(np.int64), tags, f"way/{identity}")
            elif tags.get("type"):
                self.skipped[f"{tags['type'][:40]} ways without a valid point"] += 1
        lone = {
            identity: Line(np.array([place[self.row[identity]]]), tags, f"node/{identity}")
            for identity, tags in self.sign_nodes.items()
            if valid[self.row[identity]]
        }
        return LaneletMap(
            lon[valid],
            lat[valid],
            numbers[valid, 4],
            lines,
            lone,
            self.lanelets,
            self.regulations,
            dict(self.skipped),
            {reason: count for reason, count in self.found.items() if count},
            datum_of(projection.crs, lon[valid], lat[valid]) if projection else datum,
        )

    def _positions(self, numbers: Floats, projection: Projection | None) -> tuple[Floats, Floats, Datum]:
        """Return longitude and latitude of all nodes, NaN where there is none, and what they were in."""
        lon, lat, x_m, y_m = numbers[:, :4].T
        if projection is None:
            placed = placed_by_squares(lon, lat, x_m, y_m, self.codes)
            self.found[BY_SQUARE] += placed.n_by_square
            return placed.lon, placed.lat, placed.datum
        if np.isnan(x_m).all():
            raise InputError("no node has local_x and local_y.", todo="Leave --origin and --utm away.")
        local_lon, local_lat = projection.to_lonlat(x_m, y_m)
        misfit = _distance_m(lon, lat, local_lon, local_lat)
        if (misfit > _MISFIT_M).any():
            self.found["nodes whose lat/lon lie over 1 m from where local_x/local_y put them"] = int(
                (misfit > _MISFIT_M).sum()
            )
        return local_lon, local_lat, WGS84


def _distance_m(lon: Floats, lat: Floats, other_lon: Floats, other_lat: Floats) -> Floats:
    from geofleet.algorithms.geodesy import to_ecef  # noqa: PLC0415  (only maps in local coordinates need it)

    known = np.isfinite(lon) & np.isfinite(lat) & np.isfinite(other_lon) & np.isfinite(other_lat)
    gap = to_ecef(lon[known], lat[known]) - to_ecef(other_lon[known], other_lat[known])
    return np.asarray(np.linalg.norm(gap, axis=1), np.float64)


def _tags(element: Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "").strip() for tag in element if tag.tag == "tag"}


def _float(text: str | None) -> float:
    try:
        return float(text) if text and "_" not in text else np.nan
    except ValueError:
        return np.nan


def _has_mark(path: Path) -> bool:
    """Tell whether any tag says so, whatever it belongs to: quick, and enough to leave OpenStreetMap's files alone."""
    read_head(path)  # says what is wrong with the file as such
    with explained(path), open_unpacked(path) as file:
        return any(_MARK.search(chunk) for chunk in _overlapping(file))


def _overlapping(file: BinaryIO) -> Iterator[bytes]:
    """Yield the bytes of a file, each chunk with the end of the one before it; of UTF-16 the ASCII characters."""
    tail = b""
    while chunk := file.read(_CHUNK_BYTES):
        if b"\0" in chunk:
            chunk = chunk.replace(b"\0", b"")
        yield tail + chunk
        tail = chunk[-_OVERLAP_BYTES:]
