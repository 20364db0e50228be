"""A sign as a value of OpenStreetMap's `traffic_sign`, chosen so that reading it gives the same class back."""

from __future__ import annotations

import re
from functools import lru_cache
from typing import TYPE_CHECKING

from geofleet.formats.osm_tags import node_signs
from geofleet.taxonomy import load_taxonomy
from geofleet.taxonomy.codes import codes_of
from geofleet.taxonomy.reader import RAW_PREFIX

if TYPE_CHECKING:
    from collections.abc import Iterator

GENERATOR = "geofleet"
MAX_CHARACTERS = 255  # https://wiki.openstreetmap.org/wiki/API_v0.6: of a key or value
_NOT_SAID = "unknown"  # a sign of which the tag does not tell what it shows
_COUNTRY = re.compile(r"[A-Za-z]{2}:")
_OWN_ROOT = re.compile(rb"""<osm(?:Change)?\s[^>]*\bgenerator=["']geofleet["']""")


def is_own_osm(head: bytes) -> bool:
    """Tell whether OpenStreetMap XML is one that geofleet wrote and nobody has saved since."""
    return _OWN_ROOT.search(head) is not None


@lru_cache(maxsize=65536)
def sign_value(*, sign_class: str, raw_code: str, country: str | None, value: float | None) -> str:
    """Return what `traffic_sign` has to be for a sign of some class, `unknown` when OpenStreetMap cannot say it.

    The sign's own code comes first, with its country; then the code of the concept in that country, OpenStreetMap's
    word for it, and its code elsewhere.

    Parameters
    ----------
    sign_class, raw_code, country, value
        As in the `signs` table.
    """
    for candidate in _candidates(sign_class, raw_code, country, value):
        if len(candidate) <= MAX_CHARACTERS and says(candidate) == [sign_class]:
            return candidate
    return _NOT_SAID


def says(value: str) -> list[str]:
    """Return the classes of the signs that a value of `traffic_sign` names."""
    return [sign.meaning.sign_class for sign in node_signs({"traffic_sign": value})]


def _candidates(sign_class: str, raw_code: str, country: str | None, value: float | None) -> Iterator[str]:
    numbered = () if value is None else tuple(f"[{value:g}{unit}]" for unit in _units(sign_class))
    for code in (*_own_codes(raw_code, country), *codes_of(sign_class.partition(":")[0], country=country, value=value)):
        yield code
        yield from (code + bracket for bracket in numbered)
    if sign_class.startswith(RAW_PREFIX):
        yield from _own_codes(sign_class.removeprefix(RAW_PREFIX), country)


def _own_codes(raw_code: str, country: str | None) -> list[str]:
    """Return a code with and without its country; words hold everywhere and go without one first."""
    if not raw_code:
        return []
    if country is None or _COUNTRY.match(raw_code):
        return [raw_code]
    named = f"{country}:{raw_code}"
    return [named, raw_code] if any(letter.isdigit() for letter in raw_code) else [raw_code, named]


def _units(sign_class: str) -> tuple[str, ...]:
    """Return how a class may write its unit: as it names it; if not, not at all, or as the concept has it."""
    name, _, number = sign_class.partition(":")
    concept = load_taxonomy().concepts.get(name)
    named = number.lstrip("0123456789.e+-") if concept else ""
    return (named,) if named or not concept else ("", f" {concept.unit}")
