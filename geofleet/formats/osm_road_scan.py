"""Drivable ways of an OpenStreetMap file and the nodes that they refer to, out of PBF, a block at a time."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.formats.osm_dense import DenseNodes
from geofleet.formats.osm_pbf import Block, read_blocks
from geofleet.formats.osm_roads import Roads
from geofleet.formats.osm_tags import CAR_ROADS, ROAD_KEYS, is_drivable, is_sign_key, oneway_of, speed_kmh
from geofleet.formats.protobuf import varints_of

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.formats.osm_strings import Strings

    Ints = NDArray[np.int64]

_E7 = 1e7
_MAX_E7 = (1_800_000_000, 900_000_000)
_NOWHERE = np.iinfo(np.int32).max
_NO_STRING = -1
_HIGHWAY, _SIGN = b"\n\x07highway", b"traffic_sign"
_CAR_ROADS, _ROAD_KEYS = ([word.encode() for word in words] for words in (CAR_ROADS, ROAD_KEYS))


def read_roads(pbf: Path) -> Roads:
    """Read the drivable ways: one pass for the ways, one for the nodes that they refer to.

    Raises
    ------
    InputError
        The file is damaged.
    """
    ways = _Ways.joined(
        [found for some in read_blocks(pbf, lambda blocks: blocks) for found in map(_ways_in, some) if found]
    )
    way_of = np.repeat(np.arange(len(ways.way_id)), ways.n_refs)
    wanted = np.unique(ways.refs)
    index = np.searchsorted(wanted, ways.refs).astype(np.int32)
    place = np.full((len(wanted), 2), _NOWHERE, np.int32)
    for rows, lon, lat in read_blocks(pbf, lambda blocks: _nodes_in(blocks, wanted), nodes_only=True):
        place[rows, 0], place[rows, 1] = lon, lat
    there = np.asarray((np.abs(place) <= _MAX_E7).all(axis=1), bool)
    is_there = there[index]
    kept, first, sizes = _runs(np.flatnonzero(is_there), way_of[is_there])
    run_way = way_of[is_there][first]
    points = place[index[is_there][kept]] / _E7
    new = np.flatnonzero(np.diff(run_way, prepend=-1))
    return Roads(
        way_id=ways.way_id[run_way],
        part=np.arange(len(run_way)) - np.repeat(new, np.diff(new, append=len(run_way))),
        oneway=ways.oneway[run_way],
        kind=ways.kind[run_way],
        speed_limit_kmh=ways.speed_limit_kmh[run_way],
        start=np.concatenate(([0], np.cumsum(sizes))),
        lon=points[:, 0],
        lat=points[:, 1],
        n_missing_nodes=int((~is_there).sum()),
        n_signed_ways=int(ways.n_signed.sum()),
    )


def _runs(position: Ints, way_of: Ints) -> tuple[NDArray[np.bool_], Ints, Ints]:
    """Find runs of two and more points that follow each other within a way.

    Returns which points belong to one, the first point of each and its size.
    """
    breaks = (np.diff(position, prepend=-2) != 1) | (np.diff(way_of, prepend=-1) != 0)
    first = np.flatnonzero(breaks)
    sizes = np.diff(first, append=len(position))
    is_long = sizes > 1
    return np.repeat(is_long, sizes), first[is_long], sizes[is_long]


@dataclass(frozen=True, slots=True)
class _Ways:
    """Drivable ways, shape (n,), the ids of their nodes, one way after the other, and of each block the signed ways."""

    way_id: Ints
    n_refs: Ints
    refs: Ints
    kind: NDArray[np.object_]
    oneway: NDArray[np.int8]
    speed_limit_kmh: NDArray[np.float64]
    n_signed: Ints

    @classmethod
    def joined(cls, parts: list[_Ways]) -> _Ways:
        kinds = (np.int64, np.int64, np.int64, object, np.int8, np.float64, np.int64)
        columns = [[getattr(part, name) for part in parts] for name in cls.__slots__]
        return cls(*(np.concatenate([np.zeros(0, k), *c]) for k, c in zip(kinds, columns, strict=True)))


def _ways_in(block: Block) -> _Ways | None:
    """Return the drivable ways of a block."""
    if not (block.holds_string(_HIGHWAY) or block.holds_string(_SIGN)):
        return None
    strings = block.strings
    highway = next(iter(strings.numbers([b"highway"])), _NO_STRING)
    signs = [n for n in strings.starting([_SIGN]) if is_sign_key(strings[n].decode(errors="replace"))]
    marks = [re.escape(_encoded(number)) for number in (highway, *signs) if number != _NO_STRING]
    if not marks:
        return None
    ways = list(block.ways(re.compile(b"|".join(marks)).search))
    keys, start = varints_of([way[1] for way in ways])
    values, values_start = varints_of([way[2] for way in ways])
    if not np.array_equal(start, values_start):
        raise ValueError("keys and values of a way differ in number")
    roads = _ways_at(_is_road(strings, highway, keys, values), start)
    drivable = {n: tags for n, tags in _tags(strings, keys, values, start, roads) if is_drivable(tags)}
    coded, begins = varints_of([ways[n][3] for n in drivable])
    speeds = [speed_kmh(tags.get("maxspeed")) for tags in drivable.values()]
    return _Ways(
        way_id=np.array([ways[n][0] for n in drivable], np.int64),
        n_refs=np.diff(begins),
        refs=_summed(coded, begins),
        kind=np.array([tags["highway"] for tags in drivable.values()], object),
        oneway=np.array([oneway_of(tags) for tags in drivable.values()], np.int8),
        speed_limit_kmh=np.array([np.nan if speed is None else speed for speed in speeds], np.float64),
        n_signed=np.array([len(_ways_at(np.isin(keys, signs), start))]),
    )


def _ways_at(is_told: NDArray[np.bool_], start: Ints) -> Ints:
    """Return the ways that have one of some tags."""
    return np.asarray(np.unique(np.searchsorted(start, np.flatnonzero(is_told), "right") - 1), np.int64)


def _is_road(strings: Strings, highway: int, keys: Ints, values: Ints) -> NDArray[np.bool_]:
    """Tell which tags make a way a road for cars."""
    is_road = np.zeros(len(strings), bool)
    is_road[strings.numbers(_CAR_ROADS)] = True
    return np.asarray((keys == highway) & is_road[values], bool)


def _tags(strings: Strings, keys: Ints, values: Ints, start: Ints, ways: Ints) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield some of the ways with those of their tags that matter to a car."""
    names = {number: strings[number].decode() for number in strings.numbers(_ROAD_KEYS)}
    for way, first, last in zip(ways.tolist(), start[ways].tolist(), start[ways + 1].tolist(), strict=True):
        pairs = zip(keys[first:last].tolist(), values[first:last].tolist(), strict=True)
        yield way, {names[key]: strings[value].decode(errors="replace") for key, value in pairs if key in names}


def _summed(coded: Ints, start: Ints) -> Ints:
    """Return zigzag-coded differences as the numbers themselves, each way's beginning from zero."""
    bits = coded.view(np.uint64)
    half = (bits >> np.uint64(1)).view(np.int64)
    total = np.concatenate(([0], np.cumsum(np.where(bits & np.uint64(1), ~half, half))))
    return np.asarray(total[1:] - np.repeat(total[start[:-1]], np.diff(start)), np.int64)


def _nodes_in(blocks: list[Block], wanted: Ints) -> tuple[Ints, Ints, Ints]:
    """Return index among the wanted ids, longitude and latitude of the nodes of some blocks that are wanted."""
    nodes = DenseNodes(blocks)
    index = np.searchsorted(wanted, nodes.node_id)
    hit = np.flatnonzero(wanted[np.minimum(index, len(wanted) - 1)] == nodes.node_id) if len(wanted) else index[:0]
    lon, lat = (np.clip(side, -_NOWHERE, _NOWHERE) for side in nodes.lonlat_e7(hit))
    return index[hit], lon, lat


def _encoded(number: int) -> bytes:
    """Return a number as PBF packs it."""
    packed = bytearray()
    while number > 0x7F:  # noqa: PLR2004 - seven bits a byte
        packed.append(number & 0x7F | 0x80)
        number >>= 7
    packed.append(number)
    return bytes(packed)
