"""Signs, lights, stop lines, zebra markings and lanes of a Lanelet2 map."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import shapely

from geofleet.algorithms.geodesy import to_ecef
from geofleet.errors import InputError
from geofleet.formats.lanelet2_lanes import SCHEME, addressed_lanelets, centre_line, facing_deg, speed_limit_kmh
from geofleet.formats.lanelet2_map import SIGN, is_lanelet2, load_map
from geofleet.formats.reading import LayerRead
from geofleet.tables.schemas import LANES, SIGNS
from geofleet.tables.store import build_table
from geofleet.taxonomy import load_taxonomy

if TYPE_CHECKING:
    from pathlib import Path
    from typing import Any

    from numpy.typing import NDArray

    from geofleet.formats.lanelet2_map import LaneletMap, Line
    from geofleet.taxonomy import Meaning

    Floats = NDArray[np.float64]

__all__ = ["is_lanelet2", "read_lanes", "read_signs"]

FORMAT = "lanelet2"
_MARKINGS = ("stop_line", "zebra_marking")
_TYPES = (SIGN, "traffic_light", *_MARKINGS)
_NO_CODE = "unknown"  # what the vocabulary calls a plate of which nobody says what it shows
_COUNTRY = re.compile(r"([a-z]{2}(?=_?[A-Z]*\d)|[A-Za-z]{2}(?=:[A-Z]*\d))")
_GROUND_RANGE_M = 30.0
_NOT_SIGNS = frozenset({"traffic_light", "right_of_way"})  # elements whose bare lines are no plates


@dataclass(frozen=True, slots=True)
class _Row:
    """A sign, light or marking: its line, type and code, and its meaning."""

    line: Line
    kind: str
    code: str
    meaning: Meaning
    country: str | None
    lanelets: tuple[str, ...]


def read_signs(
    path: Path, *, origin: tuple[float, float] | None = None, utm: tuple[str, float, float] | None = None
) -> LayerRead:
    """Read everything in a Lanelet2 map that stands at or lies on the road to be seen.

    Ways `traffic_sign` become rows of the kind that the vocabulary gives their subtype, `traffic_light` rows of kind
    light, `stop_line` and `zebra_marking` rows of kind marking. The position is the mean of a way's points. A way
    without type that a regulatory element refers to as its sign is one too; its code is the element's `sign_type`.
    A facing is stated where a regulatory element tells which lanelets a sign or light addresses. The height is the
    way's `ele` above that of the nearest lanelet bound, where the map has both and the way does not lie on the ground.

    Parameters
    ----------
    path
        OSM XML, or the same packed with gzip.
    origin
        Latitude and longitude, degrees, that `local_x` and `local_y` count from in the UTM zone of that place.
    utm
        Projected CRS, easting and northing where `local_x` and `local_y` are zero. With neither, `lat` and `lon` are
        used.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or no Lanelet2 map, or its positions are local and neither `origin` nor
        `utm` says where.
    ConfigError
        `origin` and `utm` are both given, or one of them makes no sense.
    """
    map_ = load_map(path, origin=origin, utm=utm)
    rows = _rows(map_)
    lon = np.array([map_.lon[row.line.points].mean() for row in rows], np.float64)
    lat = np.array([map_.lat[row.line.points].mean() for row in rows], np.float64)
    facing, road_id, found = _facings(map_, rows)
    columns: dict[str, Any] = {
        "sign_id": [_short(row.line.ref) for row in rows],
        "kind": [row.meaning.kind for row in rows],
        "concept": [row.meaning.concept for row in rows],
        "value": [row.meaning.value for row in rows],
        "unit": [row.meaning.unit for row in rows],
        "sign_class": [row.meaning.sign_class for row in rows],
        "raw_code": [row.code for row in rows],
        "country": [row.country for row in rows],
        "facing_deg": facing,
        "height_m": _heights(map_, rows, lon, lat),
        "road_id": road_id,
        "source": path.name,
        "source_ref": [row.line.ref for row in rows],
    }
    found |= {"unknown codes": sum(not row.meaning.known for row in rows)}
    found |= {"signs without a code": sum(row.kind == SIGN and not row.code for row in rows)}
    table = build_table(SIGNS, columns, (lon, lat))
    return LayerRead(table, FORMAT, map_.skipped, _told(map_.found | found), map_.datum)


def read_lanes(
    path: Path, *, origin: tuple[float, float] | None = None, utm: tuple[str, float, float] | None = None
) -> LayerRead:
    """Read the lanelets of a Lanelet2 map: centre line in driving direction, subtype and speed limit.

    Lanelet2 has no roads: a lanelet is its own. Options and errors as in `read_signs`.
    """
    map_ = load_map(path, origin=origin, utm=utm)
    skipped = Counter(map_.skipped)
    lines: dict[str, Floats] = {}
    for identity, lanelet in map_.lanelets.items():
        line = centre_line(map_, lanelet)
        if line is None or len(line) < 2:  # noqa: PLR2004  (a line has two ends)
            skipped["lanelets without a left and a right bound"] += 1
        else:
            lines[identity] = line
    if not lines:
        raise InputError("the map has no lanelet with both bounds.", where=str(path), todo="Check the export.")
    lanelets = [map_.lanelets[identity] for identity in lines]
    speeds = np.array([speed_limit_kmh(map_, lanelet) for lanelet in lanelets], np.float64)
    columns = {
        "lane_id": [f"r{identity}" for identity in lines],
        "road_id": [f"r{identity}" for identity in lines],
        "kind": [lanelet.tags.get("subtype") or "lane" for lanelet in lanelets],
        "speed_limit_kmh": speeds,
        "source": path.name,
    }
    table = build_table(LANES, columns, np.array([shapely.LineString(line) for line in lines.values()], object))
    found = map_.found | {"with a speed limit": int((~np.isnan(speeds)).sum())}
    return LayerRead(table, FORMAT, dict(skipped), _told(found), map_.datum)


def _rows(map_: LaneletMap) -> list[_Row]:
    """Return the signs, lights and markings, in the order of the file."""
    addressed = addressed_lanelets(map_)
    implied = _implied_signs(map_)
    rows = []
    for identity, line in (*map_.lines.items(), *map_.sign_nodes.items()):
        kind = line.tags.get("type") or (SIGN if identity in implied else "")
        if kind not in _TYPES:
            continue
        code = line.tags.get("subtype", "") or (implied.get(identity, "") if kind == SIGN else kind)
        lanelets = tuple(addressed.get(identity, ()))
        country = _country(map_, code, lanelets)
        asked = (code or _NO_CODE) if kind == SIGN else kind
        meaning = load_taxonomy().meaning(asked, country=country or "", scheme=SCHEME)
        rows.append(_Row(line, kind, code, meaning, country, lanelets))
    return rows


def _implied_signs(map_: LaneletMap) -> dict[str, str]:
    """Return the ways without a type that an element of signs refers to, with the code that the element states."""
    found = {}
    for rule in map_.regulations.values():
        if rule.tags.get("subtype") in _NOT_SIGNS:
            continue
        for ref in rule.refs("way", "refers"):
            if ref in map_.lines and not map_.lines[ref].tags.get("type"):
                found[ref] = rule.tags.get("sign_type", "")
    return found


def _country(map_: LaneletMap, code: str, lanelets: tuple[str, ...]) -> str | None:
    """Return the country that a code names, else the region that the lanelets it addresses are tagged with."""
    match = _COUNTRY.match(code)
    if match:
        return match[1].upper()
    regions = {map_.lanelets[lanelet].tags.get("region", "").upper() for lanelet in lanelets}
    named = sorted(region for region in regions if re.fullmatch("[A-Z]{2}", region))
    return named[0] if len(named) == 1 else None


def _facings(map_: LaneletMap, rows: list[_Row]) -> tuple[Floats, list[str | None], dict[str, int]]:
    """Return the facing and the lanelet of every row, and how many have none although a lanelet is known."""
    facing = np.full(len(rows), np.nan)
    road_id: list[str | None] = [None] * len(rows)
    along = 0
    for index, row in enumerate(rows):
        lanes = [(lane, centre_line(map_, map_.lanelets[lane])) for lane in row.lanelets]
        known = [(lane, line) for lane, line in lanes if line is not None and len(line) > 1]
        if not known:
            continue
        plate = np.column_stack((map_.lon[row.line.points], map_.lat[row.line.points]))
        looks, nearest = facing_deg(plate, [line for _, line in known])
        road_id[index] = f"r{known[nearest][0]}"
        if row.kind not in _MARKINGS:
            facing[index] = looks
            along += int(np.isnan(looks))
    return facing, road_id, {"signs and lights whose line does not show which way they face": along}


def _heights(map_: LaneletMap, rows: list[_Row], lon: Floats, lat: Floats) -> Floats:
    """Return metres above the ground, NaN where the map does not say; a way drawn on the ground does not."""
    height = np.full(len(rows), np.nan)
    bounds = [
        map_.lines[ref].points
        for lanelet in map_.lanelets.values()
        for ref in lanelet.refs("way", "left", "right")
        if ref in map_.lines
    ]
    ground = np.unique(np.concatenate(bounds)) if bounds else np.empty(0, np.int64)
    ground = ground[~np.isnan(map_.ele_m[ground])]
    above = np.array([_mean_known(map_.ele_m[row.line.points]) for row in rows], np.float64)
    at = np.flatnonzero(~np.isnan(above))
    if not (len(ground) and len(at)):
        return height
    from scipy.spatial import cKDTree  # noqa: PLC0415  (only maps with elevations need it)

    tree = cKDTree(to_ecef(map_.lon[ground], map_.lat[ground]))
    distance, found = tree.query(to_ecef(lon[at], lat[at]), distance_upper_bound=_GROUND_RANGE_M)
    near = np.isfinite(distance)
    nearest = ground[np.asarray(found)[near]]
    height[at[near]] = above[at[near]] - map_.ele_m[nearest]
    return np.where(height > 0.0, height, np.nan)


def _mean_known(values: Floats) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else float("nan")


def _short(ref: str) -> str:
    kind, _, identity = ref.partition("/")
    return kind[0] + identity


def _told(found: dict[str, int]) -> dict[str, int]:
    return {reason: count for reason, count in found.items() if count}
