"""Lanes of OpenDRIVE roads as lines: lane sections with widths or borders, lane offset, speed limits."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import shapely

from geofleet.algorithms.road_geometry import CubicProfile, road_points, sample_stations
from geofleet.errors import InputError
from geofleet.formats.opendrive_xml import children, profile
from geofleet.formats.xml import number, place

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from geofleet.formats.opendrive_georef import Georeference
    from geofleet.formats.opendrive_xml import Road
    from geofleet.formats.xml import Element

    Floats = NDArray[np.float64]

BOUNDARY, REFERENCE_LINE = "boundary", "reference_line"
NO_LENGTH = "lane sections without length"
NO_LIMIT = "speed limits that are no number"
_STEP_M = 1.0
_TOLERANCE_M = 0.01
_SHORTEST_M = 1e-3
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

    def add(self, lane_id: str, road: Road, kind: str, *, s: Floats, t: Floats, speed_kmh: float = np.nan) -> None:
        """Add the line through s and t of a road, without the points that it does not need to stay within 1 cm."""
        points = road_points(road.plan, s, t, superelevation=road.superelevation)
        line = shapely.simplify(shapely.linestrings(np.column_stack((points.x, points.y))), _TOLERANCE_M)
        self.xy_m.append(shapely.get_coordinates(line))
        self.lane_id.append(lane_id)
        self.road_id.append(road.road_id)
        self.kind.append(kind)
        self.speed_limit_kmh.append(speed_kmh)

    def to_degrees(self, georeference: Georeference) -> NDArray[np.object_]:
        """Return the lines in longitude and latitude."""
        if not self.xy_m:
            return np.empty(0, object)
        xy = np.concatenate(self.xy_m)
        lon, lat = georeference.to_lonlat(xy[:, 0], xy[:, 1])
        line = np.repeat(np.arange(len(self.xy_m)), [len(part) for part in self.xy_m])
        return np.asarray(shapely.linestrings(np.column_stack((lon, lat)), indices=line))


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
    limits = _road_limits(element, lines)
    whole = sample_stations(road.plan, 0.0, road.length_m, step_m=_STEP_M)
    same = np.unique(limits.kmh)
    lines.add(
        f"{road.road_id}/{REFERENCE_LINE}",
        road,
        REFERENCE_LINE,
        s=whole,
        t=np.zeros_like(whole),
        speed_kmh=float(same[0]) if len(same) == 1 else np.nan,
    )
    offset = profile(children(element, "lanes", "laneOffset"))
    for index, side, start, end in _sections(element, road, lines):
        name = f"{road.road_id}/{index}"
        s = sample_stations(road.plan, start, end, step_m=_STEP_M, extra=_knots(side, offset, start))
        middle = offset.at(s)
        if side.tag == "center":
            lines.add(f"{name}/0/{BOUNDARY}", road, BOUNDARY, s=s, t=middle)
        else:
            _add_side(side, name, road, lines, s=s, middle=middle, limits=limits)


def _sections(element: Element, road: Road, lines: LaneLines) -> Iterator[tuple[int, Element, float, float]]:
    """Yield number, side, start and end of every side of every lane section.

    A section with `singleSide` holds for the sides that it has, and the other side's section goes on beside it.
    """
    sections = children(element, "lanes", "laneSection")
    starts = [number(section, "s") for section in sections]
    order = sorted(range(len(sections)), key=starts.__getitem__)
    for tag in ("left", "center", "right"):
        valid = [i for i in order if sections[i].get("singleSide") != "true" or sections[i].find(tag) is not None]
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
    """Return where cubics of offset and width begin: a line may have a corner there."""
    inner = [
        start_m + number(part, "sOffset", 0.0) for lane in side for part in lane if part.tag in {"width", "border"}
    ]
    return [*offset.s, *inner]


def _add_side(
    side: Element, name: str, road: Road, lines: LaneLines, *, s: Floats, middle: Floats, limits: _Limits
) -> None:
    """Add centre lines and outer edges of the lanes of one side, from the middle outwards."""
    sign = _SIDES[side.tag]
    lanes = [(lane, int(number(lane, "id"))) for lane in side.findall("lane")]
    inner = middle
    for lane, lane_number in sorted(lanes, key=lambda pair: abs(pair[1])):
        outer = _outer_edge(lane, s=s, inner=inner, middle=middle, sign=sign)
        own = _lane_limits(lane, s[0], lines)
        kind = lane.get("type", "").strip() or "none"
        pieces = _pieces(s, (own if len(own.s) else limits).s)
        for n, (first, last) in enumerate(pieces):
            part = slice(first, last + 1)
            limit = own.at(s[first]) if len(own.s) else limits.at(s[first])
            suffix = f"/{n}" if len(pieces) > 1 else ""
            centre = (inner[part] + outer[part]) / 2
            lines.add(f"{name}/{lane_number}{suffix}", road, kind, s=s[part], t=centre, speed_kmh=limit)
        lines.add(f"{name}/{lane_number}/{BOUNDARY}", road, BOUNDARY, s=s, t=outer)
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
    found = sorted((number(type_, "s", 0.0), _limit(type_.find("speed"), lines)) for type_ in road.findall("type"))
    return _limits(found)


def _lane_limits(lane: Element, start_m: float, lines: LaneLines) -> _Limits:
    found = sorted((start_m + number(speed, "sOffset", 0.0), _limit(speed, lines)) for speed in lane.findall("speed"))
    return _limits(found)


def _limits(found: Sequence[tuple[float, float]]) -> _Limits:
    return _Limits(np.array([s for s, _ in found], np.float64), np.array([kmh for _, kmh in found], np.float64))


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
