"""What OpenStreetMap tags say about traffic signs: `traffic_sign=DE:274.1[30],1022-10;DE:240` and its relatives.

Grammar, as the OpenStreetMap wiki gives it and as the map really has it (https://wiki.openstreetmap.org/wiki/Key:traffic_sign):
`;` separates signs, `,` adds supplementary plates to the sign before it, brackets hold a value or what a direction
sign shows, and neither separator counts inside brackets. A country prefix holds until the next one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

SIGN_KEY = re.compile(r"traffic_sign(?::(?P<slot>\d+))?(?::(?P<side>forward|backward|both))?")
FACING_KEY = re.compile(r"traffic_sign(?::(?P<slot>\d+))?:(?:facing|direction)")
POINT_HIGHWAYS = {"stop": "stop", "give_way": "give_way"}
_COUNTRY = re.compile(r"\s*(?:([A-Za-z]{2})(?:[:_](?=\S)|:\s*))?(.*)", re.DOTALL)
_CLOSERS = {"]": "[", ")": "("}

COMPASS_DEG = {
    name: index * 22.5
    for index, name in enumerate(
        ("N", "NNE", "NE", "ENE", "E", "ESE", "SE", "SSE", "S", "SSW", "SW", "WSW", "W", "WNW", "NW", "NNW")
    )
}


@dataclass(frozen=True, slots=True)
class TaggedSign:
    """One plate read from a node's tags.

    Parameters
    ----------
    code
        Code with its bracket as written, without country: `274.1[30]`.
    country
        ISO 3166-1 alpha-2 prefix, own or carried forward; "" without one.
    slot
        The n of `traffic_sign:n`; 1 for `traffic_sign`.
    group
        Number of the `;` group within the value: plates belong to the main sign of their group.
    follows
        Stands after a comma, where plates stand.
    side
        `forward`, `backward` or "".
    """

    code: str
    country: str
    slot: int
    group: int
    follows: bool
    side: str

    @property
    def raw_code(self) -> str:
        """The code with its country."""
        return f"{self.country}:{self.code}" if self.country else self.code


@lru_cache(maxsize=65536)
def split_value(value: str) -> tuple[tuple[int, bool, str, str], ...]:
    """Split a `traffic_sign` value into (group, follows, country, code); empty parts are left out."""
    found = []
    country = ""
    for group, text in enumerate(split_outside_brackets(value, ";")):
        parts = [part for part in split_outside_brackets(text, ",") if part.strip()]
        for position, part in enumerate(parts):
            match = _COUNTRY.fullmatch(part.strip())
            prefix, code = (match[1], match[2]) if match else (None, part)
            country = prefix.upper() if prefix else country
            if code.strip():
                found.append((group, position > 0, country, code.strip()))
    return tuple(found)


def split_outside_brackets(text: str, separator: str) -> list[str]:
    """Split at `separator` where no bracket is open; a bracket that never closes opens nothing."""
    if separator not in text:
        return [text]
    parts, start, depth = [], 0, 0
    balanced = text.count("[") == text.count("]")
    for index, letter in enumerate(text):
        if letter == "[" and balanced:
            depth += 1
        elif letter == "]" and balanced:
            depth = max(0, depth - 1)
        elif letter == separator and not depth:
            parts.append(text[start:index])
            start = index + 1
    parts.append(text[start:])
    return parts


def tagged_signs(tags: Mapping[str, str]) -> Iterator[TaggedSign]:
    """Yield every plate that a node's tags name, slot by slot.

    `highway=stop|give_way` and a bare `maxspeed` count when no `traffic_sign` key says more.
    """
    keys = []
    for key, value in tags.items():
        match = SIGN_KEY.fullmatch(key)
        if match:
            keys.append((int(match["slot"] or 1), match["side"] or "", value))
    for slot, side, value in sorted(keys):
        for group, follows, country, code in split_value(value):
            yield TaggedSign(code, country, slot, group, follows, side.replace("both", ""))
