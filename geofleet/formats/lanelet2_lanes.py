"""Lanelets as lines: centre lines in driving direction, speed limits, and which lanelets a sign addresses."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.geodesy import to_ecef
from geofleet.formats.lanelet2_map import REGULATION
from geofleet.taxonomy import load_taxonomy

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.formats.lanelet2_map import LaneletMap, Relation

    Floats = NDArray[np.float64]

SCHEME = "lanelet2"
_SPEED = re.compile(r"(\d+(?:[.,]\d+)?)\s*([a-z/]*)", re.IGNORECASE)
_KMH = {"": 1.0, "km/h": 1.0, "kmh": 1.0, "kph": 1.0, "mph": 1.609344, "mps": 3.6, "m/s": 3.6}
_SPEED_CONCEPTS = frozenset({"speed_limit", "speed_zone"})
_ACROSS_MIN = 0.5  # cosine of 60 degrees: a plate turned further from the lane does not show which side is its face


def enu_m(points: Floats, origin: Floats) -> Floats:
    """Return east and north in metres, shape (n, 2), of points in the tangent plane at an origin; lon and lat, degrees.

    Made for a few metres around an origin of their own each, where an `EnuFrame` would cost a millisecond.
    """
    lam, phi = np.radians(origin)
    gap = to_ecef(points[:, 0], points[:, 1]) - to_ecef(origin[:1], origin[1:])
    east = -np.sin(lam) * gap[:, 0] + np.cos(lam) * gap[:, 1]
    north = -np.sin(phi) * (np.cos(lam) * gap[:, 0] + np.sin(lam) * gap[:, 1]) + np.cos(phi) * gap[:, 2]
    return np.column_stack((east, north))


def centre_line(map_: LaneletMap, lanelet: Relation) -> Floats | None:
    """Return the centre line of a lanelet in its driving direction, lon and lat, shape (n, 2), or None without one.

    The line tagged `centerline` when the map has it; else the middle of both bounds at equal shares of their lengths.
    As in Lanelet2, bounds may be drawn in either direction: the lanelet runs so that its left bound is to the left.
    """
    left, right, drawn = (_line(map_, lanelet, role) for role in ("left", "right", "centerline"))
    if drawn is not None or left is None or right is None:
        return drawn
    left_m, right_m = enu_m(left, left[0]), enu_m(right, left[0])
    if _gap(left_m, right_m[::-1]) < _gap(left_m, right_m):
        right, right_m = right[::-1], right_m[::-1]
    if _area(np.concatenate((left_m, right_m[::-1]))) > 0.0:  # anticlockwise: the left bound would be to the right
        left, left_m, right, right_m = left[::-1], left_m[::-1], right[::-1], right_m[::-1]
    share_left, share_right = _shares(left_m), _shares(right_m)
    at = np.union1d(share_left, share_right)
    sides = [
        np.interp(at, share, line[:, axis])
        for share, line in ((share_left, left), (share_right, right))
        for axis in (0, 1)
    ]
    middle = np.column_stack(((sides[0] + sides[2]) / 2, (sides[1] + sides[3]) / 2))
    return middle[np.concatenate(([True], (np.diff(middle, axis=0) != 0.0).any(axis=1)))]


def speed_limit_kmh(map_: LaneletMap, lanelet: Relation) -> float:
    """Return the speed limit that a lanelet's tags or its speed_limit regulatory elements state; NaN without one.

    Of several the first in the order of the file; the default of a road type is not stated by the map.
    """
    tagged = parse_speed_kmh(lanelet.tags.get("speed_limit", ""))
    if not np.isnan(tagged):
        return tagged
    for ref in lanelet.refs("relation", REGULATION):
        rule = map_.regulations.get(ref)
        if rule is None or rule.tags.get("subtype") != "speed_limit":
            continue
        signs = [map_.lines[way].tags.get("subtype", "") for way in rule.refs("way", "refers") if way in map_.lines]
        stated = [parse_speed_kmh(rule.tags.get(name, "")) for name in ("sign_type", "speed_limit")]
        stated += [_sign_speed_kmh(code) for code in (rule.tags.get("sign_type", ""), *signs)]
        known = [speed for speed in stated if not np.isnan(speed)]
        if known:
            return known[0]
    return float("nan")


def parse_speed_kmh(text: str) -> float:
    """Return a speed such as `50`, `50 km/h`, `30 mph`, `13.9 mps` in km/h, NaN when it is none."""
    match = _SPEED.fullmatch(text.strip())
    factor = _KMH.get(match[2].lower()) if match else None
    return float(match[1].replace(",", ".")) * factor if match and factor else float("nan")


def addressed_lanelets(map_: LaneletMap) -> dict[str, list[str]]:
    """Return the lanelets that each way or node addresses through regulatory elements, by its id.

    A `right_of_way` element names those that yield and those that have the right of way: a sign of priority addresses
    the latter, any other sign and the stop line the former. In every other element it is the lanelets that refer to it.
    """
    users: dict[str, list[str]] = {}
    for identity, lanelet in map_.lanelets.items():
        for ref in lanelet.refs("relation", REGULATION):
            users.setdefault(ref, []).append(identity)
    found: dict[str, list[str]] = {}
    for ref, rule in map_.regulations.items():
        yielding, first = rule.refs("relation", "yield"), rule.refs("relation", "right_of_way")
        for member in rule.members:
            if member.kind not in {"way", "node"} or member.role not in {"refers", "cancels", "ref_line"}:
                continue
            lanelets = (first if _is_priority(map_, member.ref) else yielding) or users.get(ref, [])
            known = found.setdefault(member.ref, [])
            known += [lane for lane in lanelets if lane in map_.lanelets and lane not in known]
    return found


def facing_deg(plate: Floats, lanes: list[Floats]) -> tuple[float, int]:
    """Return the way a plate's face looks, degrees clockwise from north, and the place of its lane in the list.

    Parameters
    ----------
    plate
        Points of the plate's line, lon and lat, shape (n, 2).
    lanes
        Centre lines, in driving direction, of the lanelets that the plate addresses.

    Returns
    -------
    tuple of float and int
        The face is perpendicular to the line from its first to its last point and looks against the traffic of the
        nearest lane. NaN for a plate without width, or one that stands along that lane; -1 without any lane.
    """
    middle = plate.mean(axis=0)
    nearest, along = -1, np.zeros(2)
    best_m = np.inf
    for index, lane in enumerate(lanes):
        distance_m, direction = _nearest_direction(enu_m(lane, middle))
        if distance_m < best_m:
            nearest, along, best_m = index, direction, distance_m
    width = np.diff(enu_m(plate[[0, -1]], middle), axis=0)[0]
    if nearest < 0 or not np.hypot(*width) > 0.0:
        return float("nan"), nearest
    face = np.array([-width[1], width[0]]) / np.hypot(*width)
    cosine = float(face @ along)
    if abs(cosine) < _ACROSS_MIN:
        return float("nan"), nearest
    face = -face if cosine > 0.0 else face
    return float(np.degrees(np.arctan2(face[0], face[1])) % 360.0), nearest


def _line(map_: LaneletMap, lanelet: Relation, role: str) -> Floats | None:
    """Return a bound of a lanelet, lon and lat, from its one way of that role, or None."""
    ways = [map_.lines[ref] for ref in lanelet.refs("way", role) if ref in map_.lines]
    if len(ways) != 1 or len(ways[0].points) < 2:  # noqa: PLR2004  (a line has two ends)
        return None
    return np.column_stack((map_.lon[ways[0].points], map_.lat[ways[0].points]))


def _is_priority(map_: LaneletMap, ref: str) -> bool:
    line = map_.lines.get(ref) or map_.sign_nodes.get(ref)
    code = line.tags.get("subtype", "") if line else ""
    return load_taxonomy().meaning(code, scheme=SCHEME).concept.startswith("priority")


def _sign_speed_kmh(code: str) -> float:
    meaning = load_taxonomy().meaning(code, scheme=SCHEME)
    if meaning.concept not in _SPEED_CONCEPTS or meaning.value is None:
        return float("nan")
    return meaning.value * _KMH.get(meaning.unit or "", 1.0)


def _gap(one: Floats, other: Floats) -> float:
    return float(np.hypot(*(one[0] - other[0])) + np.hypot(*(one[-1] - other[-1])))


def _area(ring: Floats) -> float:
    """Return twice the signed area of a ring, positive when it runs anticlockwise."""
    following = np.roll(ring, -1, axis=0)
    return float(np.sum(ring[:, 0] * following[:, 1] - ring[:, 1] * following[:, 0]))


def _shares(line_m: Floats) -> Floats:
    """Return the share of the length passed at every point of a line, from 0 to 1."""
    passed = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(line_m, axis=0).T))))
    return passed / passed[-1] if passed[-1] > 0.0 else np.linspace(0.0, 1.0, len(line_m))


def _nearest_direction(line_m: Floats) -> tuple[float, Floats]:
    """Return the distance of a line from the origin and its unit direction at the nearest point."""
    start, step = line_m[:-1], np.diff(line_m, axis=0)
    length = np.hypot(*step.T)
    with np.errstate(invalid="ignore", divide="ignore"):
        at = np.clip(np.nan_to_num(-np.sum(start * step, axis=1) / length**2), 0.0, 1.0)
    distance = np.where(length > 0.0, np.hypot(*(start + at[:, None] * step).T), np.inf)
    best = int(np.argmin(distance))
    return float(distance[best]), step[best] / max(length[best], np.finfo(np.float64).tiny)
