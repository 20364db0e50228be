"""Signals of OpenDRIVE roads: read from XML, understood, placed.

**Facing.** A signal of orientation `+` is meant for traffic that drives with s, `-` for traffic against it. The heading
of that traffic is the road's heading, turned by 180° for `-`, and turned counterclockwise by `hOffset`; the face looks
the opposite way, back at it. Orientation `none` addresses both directions and has no facing. `<positionInertial>` gives
the heading itself.

**Kind.** Signals that are dynamic, or of a type that ASAM lists as a light, are lights; those without a type are
`other`; plates and markings are what the taxonomy says; all the rest are main signs.

**Boards** (OpenDRIVE 1.8). Each `<sign>` of a `<staticBoard>` is a signal of its own, at its v and z on the board; of
what it leaves out the board decides. The board itself stays a row: a variable or mixed one as a main sign, a static one
as `other`. **Semantics** say what a signal means whose code says nothing.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from geofleet.errors import InputError
from geofleet.formats.countries import country_code
from geofleet.formats.xml import Element, number
from geofleet.taxonomy import load_taxonomy

if TYPE_CHECKING:
    from collections.abc import Mapping

    from geofleet.taxonomy import Meaning

NO_ID = "signals without an id"
NO_PLACE = "signals whose position is missing or no number"
BEYOND = "signals beyond the ends of their road"
NO_ROAD = "signals placed on a road that the file does not hold"
NO_NUMBER = "values that are no number"
TWICE = "ids of signals given more than once"
ON_BOARDS = "signs on boards"

_NONE = frozenset({"", "-1", "none", "null"})
_YES = frozenset({"yes", "true", "1"})
_OWN_CATALOGUE = "DE"  # what RoadRunner and CARLA call the country OpenDRIVE has the numbers of the StVO
_STVO_PLATE = re.compile(r"10\d\d")
_DEPENDENCIES = ("dependency", "signalDependency")
_OF_BOARDS = ("orientation", "hOffset", "country", "countryRevision")  # and of the signs on them, unless they say so
_AGAINST = {"+": 0.0, "-": math.pi}
# To the units that codes are written with
_UNITS = {
    "km/h": (1.0, "km/h"),
    "kmh": (1.0, "km/h"),
    "kph": (1.0, "km/h"),
    "m/s": (3.6, "km/h"),
    "mph": (1.0, "mph"),
    "m": (1.0, "m"),
    "km": (1000.0, "m"),
    "ft": (0.3048, "m"),
    "mile": (1609.344, "m"),
    "t": (1.0, "t"),
    "kg": (0.001, "t"),
    "%": (1.0, "%"),
}


@dataclass(frozen=True, slots=True)
class Place:
    """Where a signal or a pole is: on a road, or, when `road_id` is None, at x and y.

    Parameters
    ----------
    road_id
        The road that s and t belong to.
    first, second
        s and t, or x and y, m.
    height_m
        Above the road, or z; NaN when not given.
    heading
        Of the traffic addressed, radians: counted from the road's, or from x; NaN without an orientation.
    """

    road_id: str | None
    first: float
    second: float
    height_m: float
    heading: float


@dataclass(frozen=True, slots=True)
class Signal:
    """A signal as its road has it, with the meaning of its code; `logical` is its place by s and t of that road."""

    signal_id: str
    road_id: str
    kind: str
    raw_code: str
    country: str | None
    country_revision: str | None
    meaning: Meaning
    place: Place
    logical: Place
    points_at: tuple[str, ...]
    pole_ids: tuple[str, ...]


@dataclass(slots=True)
class SignalReader:
    """Collects the signals of roads, and counts what is wrong with some of them.

    Parameters
    ----------
    country
        ISO 3166-1 alpha-2 for signals that name none.
    """

    country: str | None = None
    signals: list[Signal] = field(default_factory=list)
    skipped: Counter[str] = field(default_factory=Counter)
    found: Counter[str] = field(default_factory=Counter)
    references: list[str] = field(default_factory=list)

    def n_dangling(self) -> int:
        """Return how many references name a signal that the file does not hold."""
        known = {signal.signal_id for signal in self.signals}
        return sum(signal_id not in known for signal_id in self.references)

    def add(self, element: Element, road_id: str) -> None:
        """Read one `<signal>` of a road, and the signs on it when it is a board."""
        self._add(element, road_id)
        for board in element.findall("staticBoard"):
            for sign in board.findall("sign"):
                self.found[ON_BOARDS] += 1
                try:
                    self._add(_on_board(sign, element), road_id)
                except InputError:
                    self.skipped[NO_PLACE] += 1

    def _add(self, element: Element, road_id: str) -> None:
        signal_id = element.get("id", "").strip()
        if not signal_id:
            self.skipped[NO_ID] += 1
            return
        try:
            logical, physical = _places(element, road_id)
        except InputError:
            self.skipped[NO_PLACE] += 1
            return
        code, value, unit = self._code(element)
        named = element.get("country", "").strip()
        country = country_code(named) or (None if named else self.country)
        catalogue = _OWN_CATALOGUE if named.lower() == "opendrive" else country
        meaning, raw_code = _understood(code, value, unit, catalogue)
        if not code:
            raw_code = element.get("name", "").strip() or "untyped"
            meaning = load_taxonomy().meaning(raw_code, scheme="opendrive")
        stated = None if meaning.known else _semantics(element)
        meaning = stated or meaning
        is_dynamic = element.get("dynamic", "").strip().lower() in _YES and not code.endswith("Board")
        is_light = is_dynamic or meaning.kind == "light"
        references = [(r.get("elementType", ""), r.get("elementId", "").strip()) for r in element.findall("reference")]
        depends = [d.get("id", "").strip() for name in _DEPENDENCIES for d in element.findall(name)]
        self.signals.append(
            Signal(
                signal_id,
                road_id,
                "light" if is_light else meaning.kind if stated else _kind(code, country, meaning),
                raw_code,
                country,
                element.get("countryRevision", "").strip() or None,
                meaning,
                physical or logical,
                logical,
                tuple(depends + [other for what, other in references if what == "signal"]),
                tuple(other for what, other in references if what == "object"),
            )
        )

    def _code(self, element: Element) -> tuple[str, float | None, str]:
        """Return type and subtype in one, and value and unit if there are any: -1 and 0 mean none."""
        kind, sub = (element.get(name, "").strip() for name in ("type", "subtype"))
        if kind.lower() in _NONE:
            return "", None, ""
        code = kind if sub.lower() in _NONE else f"{kind}-{sub}"
        try:
            value = number(element, "value", -1.0)
        except InputError:
            value = -1.0
            if element.get("value", "").strip().lower() not in _NONE:
                self.found[NO_NUMBER] += 1
        factor, unit = _UNITS.get(element.get("unit", "").strip().lower(), (1.0, ""))
        return code, value * factor if value > 0 else None, unit


def read_pole(element: Element, road_id: str) -> Place | None:
    """Return the place of an `<object>` that can carry signs, None when it is another thing or has no usable place."""
    words = {element.get(name, "").strip().lower() for name in ("type", "name", "subtype")}
    if not words & {"pole", "gantry", "trafficsign", "signpost"} or any("delineator" in word for word in words):
        return None
    try:
        return Place(road_id, number(element, "s"), number(element, "t"), math.nan, math.nan)
    except InputError:
        return None


def main_sign_of(signals: Mapping[str, Signal]) -> dict[str, str]:
    """Return the main sign of plates and untyped signals by `<dependency>` and `<reference>`.

    Either side may point at the other: files differ in it. A plate that hangs on a plate has that one's main sign.
    """
    links: dict[str, list[str]] = {}
    for name, signal in signals.items():
        for other in signal.points_at:
            if other in signals:
                links.setdefault(name, []).append(other)
                links.setdefault(other, []).append(name)
    found: dict[str, str] = {}
    for name, signal in signals.items():
        if signal.kind not in {"plate", "other"}:
            continue
        seen, queue = {name}, [name]
        for link in queue:  # grows: breadth first, so the nearest main sign counts
            for other in links.get(link, ()):
                if signals[other].kind == "main":
                    found.setdefault(name, other)
                elif other not in seen and signals[other].kind == "plate":
                    seen.add(other)
                    queue.append(other)
    return found


def _places(element: Element, road_id: str) -> tuple[Place, Place | None]:
    """Return where a signal is by s and t of its road, and where it stands when the file says that it is elsewhere."""
    against = _AGAINST.get(element.get("orientation", "").strip(), math.nan)
    logical = Place(
        road_id,
        number(element, "s"),
        number(element, "t"),
        number(element, "zOffset", math.nan),
        against + number(element, "hOffset", 0.0),
    )
    inertial, other = element.find("positionInertial"), element.find("positionRoad")
    if inertial is not None:
        x, y, z = (number(inertial, key) for key in ("x", "y", "z"))
        return logical, Place(None, x, y, z, number(inertial, "hdg", math.nan))
    if other is None:
        return logical, None
    return logical, Place(
        other.get("roadId", "").strip(),
        number(other, "s"),
        number(other, "t"),
        number(other, "zOffset", logical.height_m),
        against + number(other, "hOffset", 0.0),
    )


def _on_board(sign: Element, board: Element) -> Element:
    """Return a sign of a board as a signal that stands by itself: what it leaves out is the board's."""
    own = {
        name[:1].lower() + name[1:]: value for name, value in sign.attrib.items()
    }  # the standard writes Country, too
    given = {name: board.get(name, "") for name in _OF_BOARDS if name in board.attrib}
    if given.get("country", "").strip().lower() == "opendrive":
        del given["country"]  # the catalogue of the board's type, not a country
    side, up = number(sign, "v", 0.0), number(sign, "z", 0.0)
    against = _AGAINST.get(board.get("orientation", "").strip(), 0.0)
    found = _moved(board, ("s", "t", "zOffset"), against + number(board, "hOffset", 0.0), side, up)
    placed = {name: found.get(name, "") for name in ("s", "t", "zOffset")}
    found.attrib.clear()
    found.attrib.update(given | {"dynamic": "no"} | own | placed)
    inertial, road = board.find("positionInertial"), board.find("positionRoad")
    if inertial is not None:
        found.append(_moved(inertial, ("x", "y", "z"), number(inertial, "hdg", 0.0), side, up))
    elif road is not None:
        found.append(_moved(road, ("s", "t", "zOffset"), against + number(road, "hOffset", 0.0), side, up))
    found.extend(sign)
    return found


def _moved(element: Element, names: tuple[str, str, str], heading: float, side_m: float, up_m: float) -> Element:
    """Return an element, without what is in it, whose place is moved to the left of a heading, and up."""
    along, beside, height = names
    moved = Element(element.tag, dict(element.attrib))
    moved.line = element.line
    if side_m or up_m:
        moved.set(along, repr(number(element, along) - side_m * math.sin(heading)))
        moved.set(beside, repr(number(element, beside) + side_m * math.cos(heading)))
        moved.set(height, repr(number(element, height, 0.0) + up_m))
    return moved


def _semantics(element: Element) -> Meaning | None:
    """Return what the `<semantics>` of a signal say, the first that has a concept; None without any."""
    for semantics in element.findall("semantics"):
        for said in semantics:
            value = said.get("value", "").strip()
            bracket = f"[{value} {said.get('unit', '').strip()}]" if value else ""
            meaning = load_taxonomy().meaning(f"{said.tag}:{said.get('type', '').strip()}{bracket}", scheme="opendrive")
            if meaning.known:
                return meaning
    return None


def _understood(code: str, value: float | None, unit: str, country: str | None) -> tuple[Meaning, str]:
    """Return the meaning of a code and the code with the value that it does not hold itself.

    The value of the file comes before a number in the subtype, as long as both are the same concept.
    """
    taxonomy = load_taxonomy()
    light = taxonomy.meaning(code.partition("-")[0], scheme="opendrive")
    if light.known or value is None:
        return (light if light.known else taxonomy.meaning(code, country=country or "")), code
    bracket = f"[{value:.10g}{' ' + unit if unit else ''}]"
    plain = taxonomy.meaning(code, country=country or "")
    if plain.value == value and not unit.startswith("mph"):
        return plain, code
    valued = taxonomy.meaning(code.partition("-")[0] + bracket, country=country or "")
    if valued.known and valued.concept == plain.concept:
        return valued, code + bracket
    return taxonomy.meaning(code + bracket, country=country or ""), code + bracket


def _kind(code: str, country: str | None, meaning: Meaning) -> str:
    """Return the kind of a signal that is no light.

    Barriers and beacons (StVO 6xx), which are not signs elsewhere, are typed signals here and count as main.
    """
    if not code:
        return "other"
    if meaning.kind in {"plate", "marking"} or code == "staticBoard":
        return meaning.kind
    if country is None and _STVO_PLATE.fullmatch(code.partition("-")[0]):
        return "plate"
    return "main"
