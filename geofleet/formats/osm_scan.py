"""One pass over an OpenStreetMap file at a time, through pyosmium: sign-like nodes, drivable ways, nodes by id.

Filters run in C++, so Python sees what is kept and little else; memory grows with that and not with the file.
"""

from __future__ import annotations

import re
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
import osmium
from osmium.osm import NODE, WAY

from geofleet.errors import InputError
from geofleet.formats.osm_roads import Roads
from geofleet.formats.osm_tags import POINT_HIGHWAYS, SIGN_KEYS, is_drivable, is_sign_key, oneway_of, speed_kmh
from geofleet.formats.reading import BZIP2, GZIP, read_head

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

_PBF_MARK = b"OSMHeader"
_MARK_WITHIN = 1024
_LANELET = re.compile(rb"""v=["']lanelet["']""")
_CHUNK, _OVERLAP = 1 << 20, 64


@dataclass(frozen=True, slots=True)
class SignNodes:
    """Nodes that carry signs: id, longitude and latitude in degrees (NaN when invalid), tags; all of length n."""

    node_id: NDArray[np.int64]
    lon: NDArray[np.float64]
    lat: NDArray[np.float64]
    tags: list[dict[str, str]]


def detect(head: bytes) -> str:
    """Return pyosmium's name of the format that a file's first bytes show, or "" when it is not OpenStreetMap's."""
    if _PBF_MARK in head[:32]:
        return "pbf"
    if head.startswith(GZIP):
        return "osm.gz"
    if head.startswith(BZIP2):
        return "osm.bz2"
    return "osm" if b"<osm" in head[:_MARK_WITHIN] else ""


def open_osm(path: Path) -> osmium.io.File:
    """Open a file by its content; its name does not matter.

    Raises
    ------
    InputError
        The file is missing, empty or not OpenStreetMap's.
    """
    found = detect(read_head(path))
    if not found:
        raise InputError(
            "not an OpenStreetMap file.",
            where=str(path),
            todo="Give a .osm.pbf, .osm, .osm.gz or .osm.bz2 file.",
        )
    return osmium.io.File(str(path), found)


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Turn what pyosmium raises on a damaged file into an InputError."""
    try:
        yield
    except InputError as error:
        raise InputError(error.what, where=str(path), todo=error.todo) from None
    except (osmium.InvalidLocationError, RuntimeError, ValueError, OSError, OverflowError, MemoryError) as error:
        reason = str(error).strip().rstrip(".") or type(error).__name__
        raise InputError(
            f"damaged, or not an OpenStreetMap file ({reason}).",
            where=str(path),
            todo="Fetch or export it again.",
        ) from None


def refuse_lanelet2(path: Path) -> None:
    """Refuse a Lanelet2 map, which is OpenStreetMap XML in form only; asked when a file gave nothing.

    Raises
    ------
    InputError
        The file holds lanelets.
    """
    with path.open("rb") as file:
        tail = b""
        while chunk := file.read(_CHUNK):
            if _LANELET.search(tail + chunk):
                raise InputError(
                    "a Lanelet2 map, which is not read.",
                    where=str(path),
                    todo="Give an OpenStreetMap extract: .osm.pbf, .osm, .osm.gz or .osm.bz2.",
                )
            tail = chunk[-_OVERLAP:]


def sign_nodes(file: osmium.io.File) -> SignNodes:
    """Read every node with a `traffic_sign` key or a `highway` value that stands for a sign or light.

    Raises
    ------
    InputError
        The file holds no node at all.
    """
    if next(iter(osmium.FileProcessor(file, NODE)), None) is None:
        raise InputError("the file holds no nodes.", todo="Check that it is the extract you mean.")
    stream: Any = osmium.FileProcessor(file, NODE).with_filter(osmium.filter.KeyFilter(*SIGN_KEYS, "highway"))
    found = []
    for node in stream:
        tags = dict(node.tags)
        if node.deleted or not (tags.get("highway") in POINT_HIGHWAYS or any(map(is_sign_key, tags))):
            continue
        place = (node.location.lon, node.location.lat) if node.location.valid() else (np.nan, np.nan)
        found.append((node.id, *place, tags))
    return SignNodes(
        np.array([row[0] for row in found], np.int64),
        np.array([row[1] for row in found], np.float64),
        np.array([row[2] for row in found], np.float64),
        [row[3] for row in found],
    )


def read_roads(file: osmium.io.File) -> Roads:
    """Read the drivable ways: one pass for the ways, one for the nodes that they refer to."""
    ways: list[tuple[int, list[int], dict[str, str]]] = []
    stream: Any = osmium.FileProcessor(file, WAY).with_filter(osmium.filter.KeyFilter("highway"))
    for way in stream:
        tags = dict(way.tags)
        if is_drivable(tags) and not way.deleted:
            ways.append((way.id, [node.ref for node in way.nodes], tags))
    place = _locations(file, {ref for _, refs, _ in ways for ref in refs})
    n_missing = 0
    runs: list[tuple[int, int, list[int], dict[str, str]]] = []
    for way_id, refs, tags in ways:
        n_missing += sum(ref not in place for ref in refs)
        pieces = [list(run) for there, run in groupby(refs, place.__contains__) if there]
        runs += [(way_id, part, run, tags) for part, run in enumerate(p for p in pieces if len(p) > 1)]
    points = np.array([place[ref] for _, _, run, _ in runs for ref in run], np.float64).reshape(-1, 2)
    return Roads(
        way_id=np.array([way_id for way_id, *_ in runs], np.int64),
        part=np.array([part for _, part, *_ in runs], np.int64),
        oneway=np.array([oneway_of(tags) for *_, tags in runs], np.int8),
        kind=np.array([tags["highway"] for *_, tags in runs], object),
        speed_limit_kmh=np.array([speed_kmh(tags.get("maxspeed")) for *_, tags in runs], np.float64),
        start=np.cumsum([0, *(len(run) for _, _, run, _ in runs)], dtype=np.int64),
        lon=points[:, 0],
        lat=points[:, 1],
        n_missing_nodes=n_missing,
    )


def _locations(file: osmium.io.File, wanted: set[int]) -> dict[int, tuple[float, float]]:
    """Return longitude and latitude of the nodes wanted that the file holds."""
    # pyosmium's IdFilter would be faster, but its bit set takes 400 MB for the ids of today whatever their number.
    nodes: Any = osmium.FileProcessor(file, NODE)
    found = ((node.id, node.location) for node in nodes if node.id in wanted)
    return {number: (place.lon, place.lat) for number, place in found if place.valid()}
