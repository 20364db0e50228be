"""Signals and lanes of ASAM OpenDRIVE 1.1 to 1.8 (.xodr): `signs` and `lanes` tables."""

from __future__ import annotations

from collections import Counter, defaultdict
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from geofleet.algorithms.road_geometry import road_points
from geofleet.errors import InputError
from geofleet.formats.opendrive_georef import read_georeference
from geofleet.formats.opendrive_lanes import LaneLines, read_lane_lines
from geofleet.formats.opendrive_signals import BEYOND, NO_ROAD, TWICE, SignalReader, main_sign_of, read_pole
from geofleet.formats.opendrive_xml import ROOT, children, header_and_roads, in_road, read_road
from geofleet.formats.positions import doubts
from geofleet.formats.reading import LayerRead
from geofleet.formats.xml import explained, root_tag
from geofleet.tables.schemas import LANES, SIGNS
from geofleet.tables.store import build_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.formats.opendrive_georef import Georeference
    from geofleet.formats.opendrive_signals import Place, Signal
    from geofleet.formats.opendrive_xml import Road
    from geofleet.formats.xml import Element

    Floats = NDArray[np.float64]

__all__ = ["FORMAT", "detect", "read_lanes", "read_signs"]

FORMAT = "opendrive"
BARE_ROADS = "roads without a planView"
_POLE_WITHIN_M = 0.5
_BEYOND_M = 1.0
_NOT_FOR_SIGNS = ("lanes", "type", "repeat", "tunnel", "bridge", "objectReference")
_NOT_FOR_LANES = ("signals", "objects", "roadMark", "height", "access", "rule")


def detect(head: bytes) -> bool:
    """Tell whether a file's first bytes are those of OpenDRIVE."""
    return root_tag(head) == ROOT


def read_signs(
    path: Path, *, crs: str | None = None, origin: tuple[float, float] | None = None, country: str | None = None
) -> LayerRead:
    """Read the signals of an OpenDRIVE file.

    A signal that is repeated for other roads by `<signalReference>` is one sign. Memory grows with the reference lines
    and signals, not with lanes and other objects.

    Parameters
    ----------
    path
        The file, plain or packed with gzip.
    crs
        Projection of the file's x and y, instead of its geoReference.
    origin
        Latitude and longitude, degrees, of x = 0, y = 0, instead of its geoReference.
    country
        ISO 3166-1 alpha-2 of signals that name no country.

    Raises
    ------
    InputError
        The file is missing, damaged or not OpenDRIVE, does not say where it is, or a road of it has no valid geometry.
    ConfigError
        `crs` or `origin` is no such thing, or both are given.
    """
    reader, header = SignalReader(country=country), None
    roads: dict[str, Road] = {}
    poles: dict[str, Place] = {}
    with explained(path), np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused
        for element in header_and_roads(path, _NOT_FOR_SIGNS):
            if element.tag == "header":
                header = element
                continue
            if _has_line(element, reader.skipped):
                with in_road(element):
                    _read_signals(element, _new_road(element, roads), reader, poles)
        _refuse_all_bare(roads, reader.skipped)
        georeference = read_georeference(header, crs=crs, origin=origin)
        placed, x, y, height, heading = _placed(reader, roads)
        lon, lat = georeference.to_lonlat(x, y)
        facing = _facing_deg(georeference, x, y, heading)
        support = _supports(placed, x, y, poles, roads)
    columns = _columns(placed, path.name) | {"height_m": height, "facing_deg": facing, "support_id": support}
    counts = reader.found | {
        "signal references": len(reader.references),
        "signal references to a signal that the file does not hold": reader.n_dangling(),
        "unknown codes": sum(not signal.meaning.known for signal in placed.values()),
        "plates without a main sign": sum(
            signal.kind == "plate" and parent is None
            for signal, parent in zip(placed.values(), columns["parent_id"], strict=True)
        ),
    }
    countries = Counter(signal.country for signal in placed.values() if signal.country)
    usual = countries.most_common(1)[0][0] if countries else None
    counts |= doubts(lon, lat, usual, where=str(path))
    table = build_table(SIGNS, columns, (lon, lat))
    return LayerRead(table, FORMAT, dict(reader.skipped), _positive(counts), georeference.datum(lon, lat))


def read_lanes(path: Path, *, crs: str | None = None, origin: tuple[float, float] | None = None) -> LayerRead:
    """Read the lanes of an OpenDRIVE file, one row a line, all lines in the direction of s.

    A lane gives its centre line, of the lane's own kind (`driving`, `sidewalk`, …) and with its speed limit, and its
    outer edge, of kind `boundary`; the middle of the road is a `boundary` too. A road gives its `reference_line`.
    Lines keep within a centimetre of the curve.

    Parameters and errors as `read_signs`.
    """
    lines, header = LaneLines(), None
    roads: dict[str, Road] = {}
    with explained(path), np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused
        for element in header_and_roads(path, _NOT_FOR_LANES):
            if element.tag == "header":
                header = element
                continue
            if _has_line(element, lines.skipped):
                with in_road(element):
                    read_lane_lines(element, _new_road(element, roads), lines)
        _refuse_all_bare(roads, lines.skipped)
        geometry = lines.to_degrees(read_georeference(header, crs=crs, origin=origin))
    columns = {
        "lane_id": lines.lane_id,
        "road_id": lines.road_id,
        "kind": lines.kind,
        "speed_limit_kmh": np.array(lines.speed_limit_kmh, np.float64),
        "source": path.name,
    }
    return LayerRead(build_table(LANES, columns, geometry), FORMAT, dict(lines.skipped), dict(lines.found))


def _positive(counts: Mapping[str, int]) -> dict[str, int]:
    return {what: n for what, n in counts.items() if n}


def _has_line(road: Element, skipped: Counter[str]) -> bool:
    """Tell whether a road has a reference line; one without has no place, and is counted with its signals."""
    if children(road, "planView", "geometry"):
        return True
    skipped[BARE_ROADS] += 1
    n_signals = len(children(road, "signals", "signal"))
    if n_signals:
        skipped["signals of roads without a planView"] += n_signals
    return False


def _refuse_all_bare(roads: Mapping[str, Road], skipped: Counter[str]) -> None:
    if not roads and skipped[BARE_ROADS]:
        raise InputError(
            f"none of {skipped[BARE_ROADS]} roads has a planView with a geometry.", todo="Export it again."
        )


def _new_road(element: Element, roads: dict[str, Road]) -> Road:
    road = read_road(element)
    if road.road_id in roads:
        raise InputError("another road has the same id.", where=f"line {element.line}")
    roads[road.road_id] = road
    return road


def _read_signals(element: Element, road: Road, reader: SignalReader, poles: dict[str, Place]) -> None:
    for signal in children(element, "signals", "signal"):
        reader.add(signal, road.road_id)
    reader.references += [r.get("id", "").strip() for r in children(element, "signals", "signalReference")]
    for thing in children(element, "objects", "object"):
        pole = read_pole(thing, road.road_id)
        if pole is not None and thing.get("id"):
            poles[thing.get("id", "")] = pole


def _placed(
    reader: SignalReader, roads: Mapping[str, Road]
) -> tuple[dict[str, Signal], Floats, Floats, Floats, Floats]:
    """Return the signals that have a place, by unique id, with x, y, height above the road and heading."""
    usable = []
    for signal in reader.signals:
        road = roads.get(signal.place.road_id or signal.road_id)
        if road is None:
            reader.skipped[NO_ROAD] += 1
        elif signal.place.road_id is not None and not _is_on(road, signal.place):
            reader.skipped[BEYOND] += 1
        else:
            usable.append(signal)
    x, y, _, heading = _positions([signal.place for signal in usable], roads)
    height = np.array([signal.place.height_m for signal in usable], np.float64)
    free = [i for i, signal in enumerate(usable) if signal.place.road_id is None]
    if free:  # z is counted from sea level: the road is looked up where the signal belongs
        _, _, ground, _ = _positions([usable[i].logical for i in free], roads)
        height[free] -= ground
    return _by_unique_id(usable, reader), x, y, height, heading


def _is_on(road: Road, place: Place) -> bool:
    return -_BEYOND_M <= place.first <= road.length_m + _BEYOND_M


def _positions(places: Sequence[Place], roads: Mapping[str, Road]) -> tuple[Floats, Floats, Floats, Floats]:
    """Return x, y, z of the road and heading, radians from x, of places; each road is evaluated once."""
    x, y, heading = (np.array([getattr(p, n) for p in places], np.float64) for n in ("first", "second", "heading"))
    z = np.zeros_like(x)
    on_road = defaultdict(list)
    for i, place in enumerate(places):
        if place.road_id is not None:
            on_road[place.road_id].append(i)
    for road_id, rows in on_road.items():
        road = roads[road_id]
        points = road_points(road.plan, x[rows], y[rows], elevation=road.elevation, superelevation=road.superelevation)
        x[rows], y[rows], z[rows] = points.x, points.y, points.z
        heading[rows] += points.heading
    return x, y, z, heading


def _by_unique_id(signals: Sequence[Signal], reader: SignalReader) -> dict[str, Signal]:
    """Return the signals by id; a repeated id gets a number behind it that makes it unique."""
    taken = {signal.signal_id for signal in signals}
    named: dict[str, Signal] = {}
    for signal in signals:
        name, n = signal.signal_id, 1
        while name in named or (n > 1 and name in taken):
            n += 1
            name = f"{signal.signal_id}-{n}"
        if n > 1:
            reader.found[TWICE] += 1
        named[name] = signal
    return named


def _facing_deg(georeference: Georeference, x: Floats, y: Floats, heading: Floats) -> Floats:
    """Return the way faces look, degrees clockwise from true north: against the traffic; NaN without an orientation."""
    facing = np.full(len(x), np.nan)
    known = np.isfinite(heading)
    if known.any():
        facing[known] = georeference.bearing_deg(x[known], y[known], heading[known] + np.pi)
    return facing


def _supports(
    signals: Mapping[str, Signal], x: Floats, y: Floats, poles: Mapping[str, Place], roads: Mapping[str, Road]
) -> list[str | None]:
    """Return the pole of each signal: the one it refers to, or the nearest one within half a metre.

    Of equally near poles the first of the file counts. Markings lie on the road and have none.
    """
    stated = [next((p for p in signal.pole_ids if p), None) for signal in signals.values()]
    usable = {name: pole for name, pole in poles.items() if _is_on(roads[str(pole.road_id)], pole)}
    if not usable or not signals:
        return stated
    names = list(usable)
    pole_x, pole_y, _, _ = _positions(list(usable.values()), roads)
    distance, nearest = cKDTree(np.column_stack((pole_x, pole_y))).query(np.column_stack((x, y)))
    pairs = zip(np.atleast_1d(distance), np.atleast_1d(nearest), strict=True)
    near = [names[i] if d <= _POLE_WITHIN_M else None for d, i in pairs]
    return [
        own or (None if signal.kind == "marking" else found)
        for own, found, signal in zip(stated, near, signals.values(), strict=True)
    ]


def _columns(signals: Mapping[str, Signal], source: str) -> dict[str, Any]:
    """Return the columns of the `signs` table that need no geometry."""
    parents = main_sign_of(signals)
    rows = list(signals.values())
    return {
        "sign_id": list(signals),
        "kind": [signal.kind for signal in rows],
        "parent_id": [parents.get(name) for name in signals],
        "concept": [signal.meaning.concept for signal in rows],
        "value": np.array([np.nan if s.meaning.value is None else s.meaning.value for s in rows], np.float64),
        "unit": [signal.meaning.unit for signal in rows],
        "sign_class": [signal.meaning.sign_class for signal in rows],
        "raw_code": [signal.raw_code for signal in rows],
        "country": [signal.country for signal in rows],
        "country_revision": [signal.country_revision for signal in rows],
        "road_id": [signal.road_id for signal in rows],
        "source": source,
        "source_ref": [f"signal/{signal.signal_id}" for signal in rows],
    }
