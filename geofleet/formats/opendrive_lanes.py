"""Lanes of OpenDRIVE roads as lines: lane sections with widths or borders, lane offset, speed limits."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
import shapely

from geofleet.algorithms.road_geometry import CubicProfile, reference_points, sample_stations
from geofleet.errors import InputError
from geofleet.formats.opendrive_xml import children, profile
from geofleet.formats.xml import number, place

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from geofleet.formats.opendrive_georef import Georeference
    from geofleet.formats.opendrive_xml import Road
    from geofleet.formats.xml import Element

    Floats = NDArray[np.float64]

BOUNDARY, REFERENCE_LINE = "boundary", "reference_line"
NO_LENGTH = "lane sections without length"
NO_LIMIT = "speed limits that are no number"
# A chord of half a metre is 4.5 mm off a curve of 7 m radius: together a line keeps within a centimetre of it
_STEP_M = 0.5
_TOLERANCE_M = 0.005
_SHORTEST_M = 1e-3
_FARTHEST_M = 1e9
_BREAKS = frozenset({"width", "border", "speed"})
_SIDES = {"left": 1.0, "right": -1.0}
_KMH = {"km/h": 1.0, "kmh": 1.0, "kph": 1.0, "mph": 1.609344, "m/s": 3.6, "": 3.6}
_NO_LIMIT = frozenset({"no limit", "undefined", "", "-1"})


@dataclass(slots=True)
class LaneLines:
    """Lines in metres of the file's coordinates, with the columns of the `lanes` table that belong to them."""

    lane_id: list[str] = field(default_factory=list)
    road_id: list[str] = field(default_factory=list)
    kind: list[str] = field(default_factory=list)
    speed_limit_kmh: list[float] = field(default_factory=list)
    xy_m: list[Floats] = field(default_factory=list)
    skipped: Counter[str] = field(default_factory=Counter)
    found: Counter[str] = field(default_factory=Counter)

    def add(self, lane_id: str, kind: str, stations: Stations, t: Floats, speed_kmh: float = np.nan) -> None:
        """Add the line at t of some stations of a road."""
        xy = stations.at(t)
        if not (np.abs(xy) < _FARTHEST_M).all():  # infinite and undefined ones too
            raise InputError(f"the numbers of lane line {lane_id} are too large to give a place.")
        self.xy_m.append(xy)
        self.lane_id.append(lane_id)
        self.road_id.append(stations.road_id)
        self.kind.append(kind)
        self.speed_limit_kmh.append(speed_kmh)

    def simplify(self, first: int) -> None:
        """Leave out points that lines from number `first` on do not need to stay in place."""
        raw = self.xy_m[first:]
        line = np.repeat(np.arange(len(raw)), [len(part) for part in raw])
        kept = shapely.simplify(shapely.linestrings(np.concatenate(raw), indices=line), _TOLERANCE_M)
        xy, line = shapely.get_coordinates(kept, return_index=True)
        self.xy_m[first:] = np.split(xy, np.flatnonzero(np.diff(line)) + 1)

    def to_degrees(self, georeference: Georeference) -> NDArray[np.object_]:
        """Return the lines in longitude and latitude."""
        if not self.xy_m:
            return np.empty(0, object)
        xy = np.concatenate(self.xy_m)
        lon, lat = georeference.to_lonlat(xy[:, 0], xy[:, 1])
        line = np.repeat(np.arange(len(self.xy_m)), [len(part) for part in self.xy_m])
        return np.asarray(shapely.linestrings(np.column_stack((lon, lat)), indices=line))


@dataclass(frozen=True, slots=True)
class Stations:
    """Points of a reference line, shape (n,): s and place in metres, heading in radians, and the slope's cosine."""

    road_id: str
    s: Floats
    x: Floats
    y: Floats
    heading: Floats
    flatness: Floats

    @classmethod
    def of(cls, road: Road, s: Floats) -> Stations:
        """Evaluate a road's reference line."""
        return cls(road.road_id, s, *reference_points(road.plan, s), np.cos(road.superelevation.at(s)))

    def at(self, t: Floats) -> Floats:
        """Return the places at t, shape (n, 2); t counts along the tilted cross section."""
        lateral = t * self.flatness
        return np.column_stack((self.x - lateral * np.sin(self.heading), self.y + lateral * np.cos(self.heading)))

    def part(self, rows: slice) -> Stations:
        """Return some of them."""
        return Stations(self.road_id, self.s[rows], self.x[rows], self.y[rows], self.heading[rows], self.flatness[rows])


@dataclass(frozen=True, slots=True)
class _Limits:
    """Speed limits along a road or lane: where each starts, m, and the limit in km/h, NaN for none."""

    s: Floats
    kmh: Floats

    def at(self, s: float) -> float:
        """Return the limit at s, NaN before the first."""
        index = int(np.searchsorted(self.s, s, side="right")) - 1
        return float(self.kmh[index]) if index >= 0 else np.nan


def read_lane_lines(element: Element, road: Road, lines: LaneLines) -> None:
    """Read the reference line and the lanes of a road.

    Raises
    ------
    InputError
        An attribute of a section, lane, width, border or offset is missing or no number.
    """
    first = len(lines.xy_m)
    limits = _road_limits(element, lines)
    whole = Stations.of(road, sample_stations(road.plan, 0.0, road.length_m, step_m=_STEP_M))
    same = np.unique(limits.kmh)
    limit = float(same[0]) if len(same) == 1 else np.nan
    lines.add(f"{road.road_id}/{REFERENCE_LINE}", REFERENCE_LINE, whole, np.zeros_like(whole.s), limit)
    offset = profile(children(element, "lanes", "laneOffset"))
    for index, side, start, end in _sections(element, road, lines):
        name = f"{road.road_id}/{index}"
        knots = [*_knots(side, offset, start), *limits.s]
        stations = Stations.of(road, sample_stations(road.plan, start, end, step_m=_STEP_M, extra=knots))
        middle = offset.at(stations.s)
        if side.tag == "center":
            lines.add(f"{name}/0/{BOUNDARY}", BOUNDARY, stations, middle)
        else:
            _add_side(side, name, lines, stations=stations, middle=middle, limits=limits)
    lines.simplify(first)


def _sections(element: Element, road: Road, lines: LaneLines) -> Iterator[tuple[int, Element, float, float]]:
    """Yield number, side, start and end of every side of every lane section.

    A section with `singleSide` holds for the sides that it has, and the other side's section goes on beside it.
    """
    sections = children(element, "lanes", "laneSection")
    starts = [number(section, "s") for section in sections]
    order = sorted(range(len(sections)), key=starts.__getitem__)
    for tag in ("left", "center", "right"):
        valid = [i for i in order if sections[i].get("singleSide") != "true" or sections[i].find(tag) is not None]
        if not valid:
            continue
        ends = [*(starts[i] for i in valid[1:]), road.length_m]
        for i, end in zip(valid, ends, strict=True):
            side = sections[i].find(tag)
            start, stop = max(starts[i], 0.0), min(end, road.length_m)
            if side is None:
                continue
            if stop - start < _SHORTEST_M:
                lines.skipped[NO_LENGTH] += 1
                continue
            yield i, side, start, stop


def _knots(side: Element, offset: CubicProfile, start_m: float) -> list[float]:
    """Return where cubics of offset and width begin, and limits of lanes: a line has a corner or an end there."""
    inner = [start_m + number(part, "sOffset", 0.0) for lane in side for part in lane if part.tag in _BREAKS]
    return [*offset.s, *inner]


def _add_side(
    side: Element, name: str, lines: LaneLines, *, stations: Stations, middle: Floats, limits: _Limits
) -> None:
    """Add centre lines and outer edges of the lanes of one side, from the middle outwards."""
    sign, s = _SIDES[side.tag], stations.s
    lanes = [(lane, int(number(lane, "id"))) for lane in side.findall("lane")]
    inner = middle
    for lane, lane_number in sorted(lanes, key=lambda pair: abs(pair[1])):
        outer = _outer_edge(lane, s=s, inner=inner, middle=middle, sign=sign)
        own = _lane_limits(lane, s[0], lines)
        valid = own if len(own.s) else limits
        kind = lane.get("type", "").strip() or "none"
        pieces = _pieces(s, valid.s)
        for n, (first, last) in enumerate(pieces):
            rows = slice(first, last + 1)
            suffix = f"/{n}" if len(pieces) > 1 else ""
            centre = (inner[rows] + outer[rows]) / 2
            lines.add(f"{name}/{lane_number}{suffix}", kind, stations.part(rows), centre, valid.at(s[first]))
        lines.add(f"{name}/{lane_number}/{BOUNDARY}", BOUNDARY, stations, outer)
        inner = outer


def _outer_edge(lane: Element, *, s: Floats, inner: Floats, middle: Floats, sign: float) -> Floats:
    """Return t of a lane's outer edge: its width beyond the inner one, or its border; widths win where both are given.

    Borders count from the lane offset and carry the sign of their side; files that leave it out are understood too.
    """
    widths, borders = lane.findall("width"), lane.findall("border")
    if widths or not borders:
        return inner + sign * profile(widths, "sOffset", s[0]).at(s)
    return middle + sign * np.abs(profile(borders, "sOffset", s[0]).at(s))


def _pieces(s: Floats, changes: Floats) -> list[tuple[int, int]]:
    """Return first and last station of the pieces between changes of the speed limit that fall on inner stations."""
    inner = np.unique(np.searchsorted(s, changes[(changes > s[0]) & (changes < s[-1])]))
    return list(pairwise([0, *(int(i) for i in inner if 0 < i < len(s) - 1), len(s) - 1]))


def _road_limits(road: Element, lines: LaneLines) -> _Limits:
    """Return the limits that the types of a road bring; a type without one ends the limit before it."""
    return _limits([(number(part, "s", 0.0), _limit(part.find("speed"), lines)) for part in road.findall("type")])


def _lane_limits(lane: Element, start_m: float, lines: LaneLines) -> _Limits:
    return _limits([(start_m + number(part, "sOffset", 0.0), _limit(part, lines)) for part in lane.findall("speed")])


def _limits(found: list[tuple[float, float]]) -> _Limits:
    """Return limits sorted by s, without those that repeat the one before."""
    s, kmh = np.array(sorted(found, key=itemgetter(0)), np.float64).reshape(-1, 2).T
    is_new = np.ones(len(s), bool)
    is_new[1:] = (kmh[1:] != kmh[:-1]) & ~(np.isnan(kmh[1:]) & np.isnan(kmh[:-1]))
    return _Limits(s[is_new], kmh[is_new])


def _limit(speed: Element | None, lines: LaneLines) -> float:
    """Return the limit of a `<speed>` in km/h (m/s without a unit), NaN when there is none or it is no number."""
    text = speed.get("max", "").strip().lower() if speed is not None else ""
    if speed is None or text in _NO_LIMIT:
        return np.nan
    factor = _KMH.get(speed.get("unit", "").strip().lower())
    if factor is None:
        raise InputError(f'unit="{speed.get("unit")}" is unknown.', where=place(speed), todo="Use km/h, mph or m/s.")
    try:
        return number(speed, "max") * factor
    except InputError:
        lines.found[NO_LIMIT] += 1
        return np.nan
