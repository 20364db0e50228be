"""What OpenStreetMap tags say about traffic signs: `traffic_sign=DE:274.1[30],1022-10;DE:240` and its relatives.

Grammar, as https://wiki.openstreetmap.org/wiki/Key:traffic_sign gives it and as the map really has it: `;` separates
signs, `,` adds supplementary plates to the sign before it, brackets hold a value or what a direction sign shows, and
neither separator counts inside brackets. A country prefix holds until the next one. `traffic_sign:2` … name further
plates of the same pole.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

from geofleet.taxonomy import load_taxonomy

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from geofleet.taxonomy import Meaning

POINT_HIGHWAYS = {"stop": "stop", "give_way": "give_way", "traffic_signals": "traffic_signals"}
_PLAIN_KEYS = frozenset({"highway", "direction", "city_limit", "traffic_signals:direction"})
_PAINTED = "road_marking"  # `road_marking=traffic_sign`: what `traffic_sign` names is painted on the road
KEY_STARTS = ("traffic_sign", "max", _PAINTED, *_PLAIN_KEYS)
_SIDE = "forward|backward|both|left|right"
_SIGN_KEY = re.compile(
    rf"traffic_sign(?::(?P<slot>\d{{1,3}}))?(?::(?P<side>{_SIDE}))?|traffic_sign:(?P<first>{_SIDE}):(?P<then>\d{{1,3}})"
)
_COUNTRY = re.compile(r"(?:traffic_sign=)?(?:([A-Za-z]{2})(?:-(?=[A-Z]{2,3}:)|:)\s*(?=\S))?(.*)", re.DOTALL)
_NUMBER = re.compile(r"\s*(-?\d+(?:\.\d+)?)\s*°?\s*")
_SPEED = re.compile(r"\s*(\d+(?:[.,]\d+)?)\s*(km/h|kmh|kph|mph|knots)?\s*")
_KMH = {"mph": 1.609344, "knots": 1.852}
_COMPASS = "N NNE NE ENE E ESE SE SSE S SSW SW WSW W WNW NW NNW"
COMPASS_DEG = {name: index * 22.5 for index, name in enumerate(_COMPASS.split())}

# `highway` values made for cars, links included; the word `road` is for those not surveyed yet
CAR_ROADS = frozenset(
    {
        *(
            f"{name}{link}"
            for name in ("motorway", "trunk", "primary", "secondary", "tertiary")
            for link in ("", "_link")
        ),
        *("unclassified", "residential", "living_street", "road"),
    }
)
_CLOSED = {"area": {"yes"}, "access": {"private", "no"}, "motor_vehicle": {"no"}, "motorcar": {"no"}}
# What `is_drivable`, `oneway_of` and `speed_kmh` look at
ROAD_KEYS = frozenset({"highway", "oneway", "junction", "maxspeed", *_CLOSED})


@dataclass(frozen=True, slots=True)
class TaggedSign:
    """One plate as a value names it.

    Parameters
    ----------
    code
        Code with its bracket as written, without country: `274.1[30]`.
    country
        ISO 3166-1 alpha-2 prefix, own or carried forward; "" without one.
    slot
        The n of `traffic_sign:n`; 1 for `traffic_sign`.
    group
        Number of the `;` group within the value: a plate belongs to the main sign of its group.
    follows
        Stands after a comma, where supplementary plates stand.
    side
        `forward`, `backward` or "".
    """

    code: str
    country: str
    slot: int
    group: int
    follows: bool
    side: str


@dataclass(frozen=True, slots=True)
class NodeSign:
    """One sign of a node, understood.

    Parameters
    ----------
    raw_code
        Code with country, as the source has it.
    country
        ISO 3166-1 alpha-2, or None.
    meaning
        What the taxonomy says.
    kind
        The taxonomy's kind; `plate` for an unknown code where plates stand.
    parent
        Place of a plate's main sign among the node's signs, or None.
    side
        `forward` or `backward` along the way it stands at, or "".
    facing_deg
        As the tags say, clockwise from north, or None.
    """

    raw_code: str
    country: str | None
    meaning: Meaning
    kind: str
    parent: int | None
    side: str
    facing_deg: float | None


@lru_cache(maxsize=65536)
def split_value(value: str) -> tuple[tuple[int, bool, str, str], ...]:
    """Split a `traffic_sign` value into (group, follows, country, code); empty parts are left out."""
    found = []
    country = ""
    for group, text in enumerate(split_outside_brackets(value, ";")):
        parts = [part.strip() for part in split_outside_brackets(text, ",")]
        for position, part in enumerate(part for part in parts if part):
            match = _COUNTRY.fullmatch(part)
            prefix, code = (match[1], match[2].strip()) if match else (None, part)
            country = prefix.upper() if prefix else country
            if code:
                found.append((group, position > 0, country, code))
    return tuple(found)


def split_outside_brackets(text: str, separator: str) -> list[str]:
    """Split at `separator` where no square bracket is open; in a text whose brackets do not pair, everywhere."""
    if separator not in text:
        return [text]
    if text.count("[") != text.count("]"):
        return text.split(separator)
    parts, start, depth = [], 0, 0
    for index, letter in enumerate(text):
        if letter == separator and depth <= 0:
            parts.append(text[start:index])
            start = index + 1
        depth += (letter == "[") - (letter == "]")
    return [*parts, text[start:]]


def is_sign_key(key: str) -> bool:
    """Tell whether a key names signs; `traffic_sign:note` and `traffic_signals` do not."""
    return _SIGN_KEY.fullmatch(key) is not None


def tells_of_signs(key: str) -> bool:
    """Tell whether a tag can change what the signs of a node are, or where they face."""
    return key in _PLAIN_KEYS or key.startswith(("traffic_sign:", "max", _PAINTED))


def tagged_signs(tags: Mapping[str, str]) -> list[TaggedSign]:
    """Return every plate that the `traffic_sign` keys of a node name, slot by slot."""
    values = []
    for key, value in tags.items():
        match = _SIGN_KEY.fullmatch(key)
        if match:
            side = match["side"] or match["first"] or ""
            values.append(
                (int(match["slot"] or match["then"] or 1), side if side in {"forward", "backward"} else "", value)
            )
    signs = []
    carried = ""
    for slot, side, value in sorted(values):
        for group, follows, country, code in split_value(value):
            carried = country or carried
            signs.append(TaggedSign(code, carried if _is_code(code) else country, slot, group, follows, side))
    return signs


def _is_code(text: str) -> bool:
    """Tell codes of a country from words, which hold for every country: codes have a digit before any bracket."""
    return any(letter.isdigit() for letter in text.partition("[")[0])


def node_signs(tags: Mapping[str, str]) -> list[NodeSign]:
    """Return the signs of a node, in the order of their slots.

    `highway=stop|give_way|traffic_signals` is a sign of its own when no `traffic_sign` key says so already. Beside
    `road_marking=traffic_sign`, of either direction, the signs are markings.
    """
    plates = tagged_signs(tags)
    meanings = [_meaning(plate, tags) for plate in plates]
    word = POINT_HIGHWAYS.get(tags.get("highway", ""))
    if word and load_taxonomy().meaning(word).concept not in {meaning.concept for meaning in meanings}:
        plates.append(TaggedSign(word, "", plates[-1].slot + 1 if plates else 1, 0, follows=False, side=""))
        meanings.append(load_taxonomy().meaning(word))
    if any(key.startswith(_PAINTED) and value == "traffic_sign" for key, value in tags.items()):
        meanings = [replace(meaning, kind="marking") for meaning in meanings]
    kinds = [
        "plate" if plate.follows and not meaning.known else meaning.kind
        for plate, meaning in zip(plates, meanings, strict=True)
    ]
    return [
        NodeSign(
            f"{plate.country}:{plate.code}" if plate.country else plate.code,
            plate.country or None,
            meaning,
            kind,
            _parent(index, plates, kinds) if kind == "plate" else None,
            plate.side or _side(tags),
            _facing(plate, tags),
        )
        for index, (plate, meaning, kind) in enumerate(zip(plates, meanings, kinds, strict=True))
    ]


def is_drivable(tags: Mapping[str, str]) -> bool:
    """Tell whether a way is a road that cars may use; service roads and private ones are not."""
    return tags.get("highway") in CAR_ROADS and not any(tags.get(key) in values for key, values in _CLOSED.items())


def oneway_of(tags: Mapping[str, str]) -> int:
    """Return 1 for a way that is one-way along its points, -1 against them, 0 else."""
    value = tags.get("oneway", "")
    if value in {"-1", "reverse"}:
        return -1
    implied = tags.get("junction") in {"roundabout", "circular"} or tags.get("highway") == "motorway"
    return int(value in {"yes", "true", "1"} or (implied and value != "no"))


def speed_kmh(value: str | None) -> float | None:
    """Return a `maxspeed` value in km/h; None for words such as `none`, `walk` and `DE:urban`."""
    match = _SPEED.fullmatch(value or "")
    return float(match[1].replace(",", ".")) * _KMH.get(match[2] or "", 1.0) if match else None


def _meaning(plate: TaggedSign, tags: Mapping[str, str]) -> Meaning:
    """Look a code up; a number or an end that the code leaves out comes from the tag of its name."""
    taxonomy = load_taxonomy()
    if plate.code == "city_limit" and tags.get("city_limit") == "end":
        return taxonomy.meaning("city_limit:end")
    if plate.code.startswith("max") and tags.get(plate.code):
        return taxonomy.meaning(f"{plate.code}[{tags[plate.code]}]", country=plate.country)
    meaning = taxonomy.meaning(plate.code, country=plate.country)
    is_limit = meaning.group == "prohibition" and taxonomy.concepts[meaning.concept].unit == "km/h"
    if is_limit and meaning.value is None and tags.get("maxspeed"):
        return taxonomy.meaning(f"{plate.code}[{tags['maxspeed']}]", country=plate.country)
    return meaning


def _parent(index: int, plates: Sequence[TaggedSign], kinds: Sequence[str]) -> int | None:
    """Return the main sign of a plate: of its own group, else the nearest before it, else the nearest after it."""
    own = (plates[index].slot, plates[index].group, plates[index].side)
    mains = [i for i, kind in enumerate(kinds) if kind not in {"plate", "other"}]
    same = [i for i in mains if (plates[i].slot, plates[i].group, plates[i].side) == own]
    before = [i for i in mains if i < index]
    return same[0] if same else before[-1] if before else mains[0] if mains else None


def _side(tags: Mapping[str, str]) -> str:
    for key in ("direction", "traffic_sign:direction", "traffic_signals:direction"):
        if tags.get(key) in {"forward", "backward"}:
            return tags[key]
    return ""


def _facing(plate: TaggedSign, tags: Mapping[str, str]) -> float | None:
    """Return the facing that a tag states in degrees or as a point of the compass."""
    slots = ("", ":1") if plate.slot == 1 else (f":{plate.slot}",)
    keys = [f"traffic_sign{slot}:{name}" for slot in slots for name in ("facing", "direction")]
    for value in (tags[key] for key in (*keys, "direction") if key in tags):
        parts = value.split(";")
        text = parts[plate.group] if plate.group < len(parts) else parts[0]
        number = _NUMBER.fullmatch(text)
        if number:
            return float(number[1]) % 360.0
        if text.strip().upper() in COMPASS_DEG:
            return COMPASS_DEG[text.strip().upper()]
    return None
