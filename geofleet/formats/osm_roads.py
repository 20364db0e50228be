"""Drivable ways of an OpenStreetMap file, and the nearest one to each sign, which gives its road and facing."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import shapely

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

MAX_ROAD_DISTANCE_M = 50.0
_MAX_SEGMENT_M, _STEP_M = 100_000.0, 60.0
_ROWS_A_DEGREE, _COLUMNS_A_DEGREE, _COLUMN_BITS, _MAX_ROWS = 1000.0, 900.0, 20, 3
_POINTS_AT_ONCE = 1 << 11
_A_M, _E2 = 6_378_137.0, 6.694_379_990_141_33e-3  # WGS 84
_HALF_TURN_DEG = 180.0

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
    n_signed_ways
        Ways of any kind with a key of signs.
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
    n_signed_ways: int = 0

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


class RoadIndex:
    """Drivable ways, made ready to be asked for the nearest one of any points.

    Every segment is marked in cells of some 110 m, at most `_STEP_M` apart; the marks, sorted by cell, are the index.
    """

    def __init__(self, roads: Roads) -> None:
        self.roads = roads
        first, run = roads.segments()
        self._start, self._end = (np.column_stack((roads.lon[at], roads.lat[at])) for at in (first, first + 1))
        self._run = run.astype(np.int32)
        step_deg = self._end - self._start
        step_deg[:, 0] = _turn(step_deg[:, 0])
        east, north = _metres_per_degree(self._start[:, 1])
        length_m = np.hypot(east * step_deg[:, 0], north * step_deg[:, 1])
        # What is longer is a damaged file, not a road
        n_marks = np.where(length_m < _MAX_SEGMENT_M, np.ceil(length_m / _STEP_M).clip(1), 0).astype(np.int64)
        segment = np.repeat(np.arange(len(first), dtype=np.int32), n_marks)
        within = np.arange(len(segment)) - np.repeat(np.cumsum(n_marks) - n_marks, n_marks)
        share = ((within + 0.5) / n_marks[segment])[:, np.newaxis]
        marks = self._start[segment] + share * step_deg[segment]
        row = np.floor(marks[:, 1] * _ROWS_A_DEGREE).astype(np.int64)
        cell = _cell(row, marks[:, 0])
        order = np.argsort(cell, kind="stable")
        self._cell, self._segment = cell[order], segment[order]

    def nearest(self, lon: Floats, lat: Floats) -> NearestRoad:
        """Find the nearest way of each point, in metres of the plane that touches the ellipsoid there.

        Of equally near segments the first of the file counts.
        """
        parts = [slice(first, first + _POINTS_AT_ONCE) for first in range(0, max(len(lon), 1), _POINTS_AT_ONCE)]
        found = [self._nearest(lon[part], lat[part]) for part in parts]
        return NearestRoad(*(np.concatenate(column) for column in zip(*found, strict=True)))

    def _nearest(self, lon: Floats, lat: Floats) -> tuple[Ints, Floats, NDArray[np.bool_]]:
        query, segment = self._candidates(lon, lat)
        scale = np.column_stack(_metres_per_degree(lat))[query]
        start, end = (side[segment] - np.column_stack((lon, lat))[query] for side in (self._start, self._end))
        start[:, 0], end[:, 0] = _turn(start[:, 0]), _turn(end[:, 0])
        start, end = start * scale, end * scale
        along = end - start
        square = np.maximum((along**2).sum(axis=1), np.finfo(float).tiny)
        share = (-(start * along).sum(axis=1) / square)[:, np.newaxis].clip(0.0, 1.0)
        foot = np.where(share < 1.0, start + share * along, end)
        distance = np.hypot(foot[:, 0], foot[:, 1])
        near = np.flatnonzero(distance <= MAX_ROAD_DISTANCE_M)
        near = near[np.lexsort((segment[near], distance[near], query[near]))]
        at, one = np.unique(query[near], return_index=True)
        best = near[one]
        run, bearing, is_right = np.full(len(lon), -1, np.int64), np.full(len(lon), np.nan), np.zeros(len(lon), bool)
        run[at] = self._run[segment[best]]
        bearing[at] = np.degrees(np.arctan2(along[best, 0], along[best, 1])) % 360.0
        # The point is the origin: it lies to the right where the way turns about it to the left.
        is_right[at] = along[best, 0] * -start[best, 1] + along[best, 1] * start[best, 0] < 0
        return run, bearing, is_right

    def _candidates(self, lon: Floats, lat: Floats) -> tuple[Ints, Ints]:
        """Return pairs of a point and a segment marked near it."""
        east, north = _metres_per_degree(lat)
        reach_m = np.hypot(MAX_ROAD_DISTANCE_M, _STEP_M / 2.0) + 1.0
        low, high = (np.floor((lat + side * reach_m / north) * _ROWS_A_DEGREE).astype(np.int64) for side in (-1, 1))
        queries, marks = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
        for row in (low + step for step in range(_MAX_ROWS)):
            west, beside = (_cell(row, lon + side * reach_m / east) for side in (-1, 1))
            for cell, is_new in ((west, row <= high), (beside, (row <= high) & (beside != west))):
                begin = np.searchsorted(self._cell, cell)
                size = np.where(is_new, np.searchsorted(self._cell, cell, side="right") - begin, 0)
                queries.append(np.repeat(np.arange(len(lon)), size))
                marks.append(np.arange(size.sum()) - np.repeat(np.cumsum(size) - size - begin, size))
        return np.concatenate(queries), self._segment[np.concatenate(marks)].astype(np.int64)


def _cell(row: Ints, lon: Floats) -> Ints:
    """Return the number of a cell: rows are equally high, and cells of a row about as wide."""
    narrow = np.cos(np.radians((row + 0.5) / _ROWS_A_DEGREE)).clip(0.01)
    column = np.floor((lon + _HALF_TURN_DEG) % (2.0 * _HALF_TURN_DEG) * narrow * _COLUMNS_A_DEGREE).astype(np.int64)
    return np.asarray((row << _COLUMN_BITS) + column, np.int64)


def _metres_per_degree(lat: Floats) -> tuple[Floats, Floats]:
    """Return the length of a degree to the east and to the north on WGS 84, from its radii of curvature."""
    phi = np.radians(lat)
    flat = 1.0 - _E2 * np.sin(phi) ** 2
    prime_vertical = _A_M / np.sqrt(flat)
    return np.radians(prime_vertical * np.cos(phi)).clip(1.0), np.radians(prime_vertical * (1.0 - _E2) / flat)


def _turn(difference_deg: Floats) -> Floats:
    """Return differences of longitude the short way round."""
    return (difference_deg + _HALF_TURN_DEG) % (2.0 * _HALF_TURN_DEG) - _HALF_TURN_DEG


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
