"""Drivable ways of an OpenStreetMap file, and the nearest one to each sign, which gives its road and facing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import shapely

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

MAX_ROAD_DISTANCE_M = 50.0
_CELL_DEG = (0.1, 0.05)  # longitude, latitude: one ENU frame each, at most 11 km across

# ISO 3166-1 codes of countries that drive on the left
_LEFT_HAND = (
    "AG AI AU BB BD BM BN BS BT BW CC CK CX CY DM FJ FK GB GD GG GY HK ID IE IM IN JE JM JP KE KI KN KY LC LK LS MO "
    "MS MT MU MV MW MY MZ NA NF NP NR NU NZ PG PK PN SB SC SG SH SR SZ TC TH TK TL TO TT TV TZ UG VC VG VI WS ZA ZM ZW"
)
LEFT_HAND = frozenset(_LEFT_HAND.split())


@dataclass(frozen=True, slots=True)
class Roads:
    """Drivable ways as runs of points; a way that lost nodes at the edge of the extract is several runs.

    Parameters
    ----------
    way_id
        Way of each run, shape (r,).
    part
        Number of the run within its way, shape (r,).
    oneway
        1 with the direction of the way, -1 against it, 0 both ways, shape (r,).
    kind
        `highway` value, shape (r,).
    speed_limit_kmh
        NaN when the map does not say, shape (r,).
    start
        First point of each run, and the number of points last, shape (r + 1,).
    lon, lat
        Points, degrees, shape (p,).
    n_missing_nodes
        Nodes that ways refer to and the file does not hold.
    """

    way_id: Ints
    part: Ints
    oneway: NDArray[np.int8]
    kind: NDArray[np.object_]
    speed_limit_kmh: Floats
    start: Ints
    lon: Floats
    lat: Floats
    n_missing_nodes: int

    def lines(self) -> NDArray[np.object_]:
        """Return one line string a run, in degrees."""
        run_of_point = np.repeat(np.arange(len(self.way_id)), np.diff(self.start))
        return np.asarray(shapely.linestrings(np.column_stack((self.lon, self.lat)), indices=run_of_point))

    def segments(self) -> tuple[Ints, Ints]:
        """Return the first point and the run of every segment."""
        run_of_point = np.repeat(np.arange(len(self.way_id)), np.diff(self.start))
        first = np.flatnonzero(run_of_point[1:] == run_of_point[:-1])
        return first.astype(np.int64), run_of_point[first].astype(np.int64)


@dataclass(frozen=True, slots=True)
class NearestRoad:
    """The road of each sign.

    Parameters
    ----------
    run
        Run of the nearest way within `MAX_ROAD_DISTANCE_M`, -1 without one, shape (n,).
    bearing_deg
        Direction of the way there, clockwise from north, NaN without one, shape (n,).
    is_right
        The sign stands to the right of the way's direction, shape (n,).
    """

    run: Ints
    bearing_deg: Floats
    is_right: NDArray[np.bool_]


def nearest_road(roads: Roads, lon: Floats, lat: Floats) -> NearestRoad:
    """Find the nearest way of each point, in metres of a local ENU frame a cell of `_CELL_DEG`.

    Of equally near segments the first of the file counts.
    """
    from geofleet.algorithms.geodesy import EnuFrame  # noqa: PLC0415  (brings pyproj, which `--no-roads` spares)

    run = np.full(len(lon), -1, np.int64)
    bearing = np.full(len(lon), np.nan)
    is_right = np.zeros(len(lon), bool)
    first, run_of_segment = roads.segments()
    for points, near in _cells(roads, first, lon, lat):
        frame = EnuFrame.around(lon[points], lat[points])
        xy = frame.to_enu(lon[points], lat[points])
        start = frame.to_enu(roads.lon[first[near]], roads.lat[first[near]])
        end = frame.to_enu(roads.lon[first[near] + 1], roads.lat[first[near] + 1])
        tree = shapely.STRtree(shapely.linestrings(np.stack((start, end), axis=1)))
        query, hit = tree.query_nearest(shapely.points(xy), max_distance=MAX_ROAD_DISTANCE_M)
        order = np.lexsort((hit, query))
        query, one = np.unique(query[order], return_index=True)
        hit = hit[order][one]
        along, beside = end[hit] - start[hit], xy[query] - start[hit]
        at = points[query]
        run[at] = run_of_segment[near[hit]]
        bearing[at] = np.degrees(np.arctan2(along[:, 0], along[:, 1])) % 360.0
        is_right[at] = along[:, 0] * beside[:, 1] - along[:, 1] * beside[:, 0] < 0
    return NearestRoad(run, bearing, is_right)


def _cells(roads: Roads, first: Ints, lon: Floats, lat: Floats) -> Iterator[tuple[Ints, Ints]]:
    """Yield the points of each occupied cell with the segments whose box comes near to theirs."""
    if not len(first):
        return
    ends = np.stack((first, first + 1))
    x, y = roads.lon[ends], roads.lat[ends]
    tree = shapely.STRtree(shapely.box(x.min(axis=0), y.min(axis=0), x.max(axis=0), y.max(axis=0)))
    cell = np.stack((np.floor(lon / _CELL_DEG[0]), np.floor(lat / _CELL_DEG[1])), axis=1)
    _, label = np.unique(cell, axis=0, return_inverse=True)
    order = np.argsort(label, kind="stable")
    for points in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        west, south, east, north = lon[points].min(), lat[points].min(), lon[points].max(), lat[points].max()
        tall = MAX_ROAD_DISTANCE_M / 110_000.0
        wide = tall / max(np.cos(np.radians(np.abs(lat[points]).max())), 0.01)
        near = np.sort(tree.query(shapely.box(west - wide, south - tall, east + wide, north + tall)))
        if len(near):
            yield points.astype(np.int64), near.astype(np.int64)


def facing_of(roads: Roads, near: NearestRoad, side: NDArray[np.object_], is_left_hand: NDArray[np.bool_]) -> Floats:
    """Return the way each sign's face looks: against the traffic it is meant for.

    The traffic is that of `side` (`forward`, `backward`) where the tags say so, that of a one-way road, or else that
    of the lanes on the sign's own side of the road.
    """
    known = near.run >= 0
    oneway = np.zeros(len(side), np.int8)
    oneway[known] = roads.oneway[near.run[known]]
    with_way = near.is_right != is_left_hand
    with_way = np.where(oneway != 0, oneway > 0, with_way)
    with_way = np.where(side == "forward", True, np.where(side == "backward", False, with_way))  # noqa: FBT003 - arrays
    return np.asarray((near.bearing_deg + np.where(with_way, 180.0, 0.0)) % 360.0, np.float64)
