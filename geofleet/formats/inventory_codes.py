"""The codes of an inventory as plates: stacks taken apart, schemes and countries told from the codes themselves."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any

from geofleet.formats.inventory_columns import NAMES
from geofleet.formats.osm_tags import node_signs
from geofleet.taxonomy import load_taxonomy

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from geofleet.taxonomy import Meaning

OSM, MAPILLARY = "osm", "mapillary"
NO_CODE = "unknown"  # what the vocabulary calls a plate of which nobody says what it shows
_STACK = re.compile(r"\s*[|;]\s*|\s+\+\s+")
_COUNTRY_PREFIX = re.compile(r"[A-Z]{2}:")
_NAMES_COUNTRY = re.compile(r"\s*[A-Za-z]{2}:\s*[^\s,;|]")
_PLAIN_NUMBER = re.compile(r"\d+(?:[.,]\d+)?(?:\s*(?:km/h|mph|t|m|%))?")
_ARRAY = re.compile(r"\{([^{}:]*)\}|\[([^\[\]{}:\"]*)\]")  # of PostgreSQL; a list of Python
_FAR_SHARE, _FAR_CODES = 0.8, 5  # of codes of a scheme that is not the one of the place
_ENOUGH = 0.5  # share of codes that a scheme must know to be taken for theirs


@dataclass(frozen=True, slots=True)
class Plate:
    """One plate of a feature.

    Parameters
    ----------
    raw_code
        As the source has it.
    country
        ISO 3166-1 alpha-2, or None.
    meaning
        What the taxonomy says.
    kind
        The taxonomy's kind.
    parent
        Place of a plate's main sign within the feature, or None.
    facing_deg
        As OpenStreetMap's tags say, or None.
    """

    raw_code: str
    country: str | None
    meaning: Meaning
    kind: str
    parent: int | None = None
    facing_deg: float | None = None


@dataclass(frozen=True, slots=True)
class Plates:
    """The plates of every feature, in their order; none for a feature that is no sign."""

    of_feature: list[tuple[Plate, ...]]
    skipped: dict[str, int] = field(default_factory=dict)

    def main_country(self) -> str | None:
        """Return the country that most plates have, None when most have none."""
        counted = Counter(plate.country for plates in self.of_feature for plate in plates)
        ((country, count),) = counted.most_common(1) or [(None, 0)]
        return country if 2 * count > counted.total() else None


def plain_codes(codes: Iterable[str | None]) -> list[str | None]:
    """Return codes that are nested in JSON, as a list of Python or an array of PostgreSQL as plain ones.

    Of an object that is what it calls a code, with its value; several stand as a stack. Others stay as they are.
    """
    return [_plain_code(code) if code and code[0] in "[{" else code for code in codes]


@cache
def _plain_code(text: str) -> str:
    if array := _ARRAY.fullmatch(text):
        parts = (array[1] or array[2] or "").split(",")
        return "|".join(part.strip().strip("'\"") for part in parts)
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return text
    parts = [_named_code(one) for one in (value if isinstance(value, list) else [value])]
    return "|".join(part for part in parts if part) if all(part is not None for part in parts) else text


def _named_code(value: Any) -> str | None:
    """Return the code that a value of JSON is or holds, "" for none, and None when it says something else."""
    if isinstance(value, dict):
        plain = {re.sub(r"[\W_]+", "", name.lower()): one for name, one in value.items()}
        names = [name for name in NAMES["code"].split() if isinstance(plain.get(name), str | int | float)]
        if not names:
            return None
        numbers = (plain.get(name) for name in (*NAMES["value"].split(), "value") if name != names[0])
        number = next((str(one) for one in numbers if one is not None), "")
        code = str(plain[names[0]])
        return f"{code}[{number}]" if _PLAIN_NUMBER.fullmatch(number) and "[" not in code else code
    return None if isinstance(value, list | bool) else "" if value is None else str(value)


def is_osm(column: str, codes: Iterable[str | None], country: str | None) -> bool:
    """Tell whether codes are values of OpenStreetMap's `traffic_sign`: by the column, or by country prefixes."""
    known = [code for code in codes if code]
    prefixed = sum(bool(_COUNTRY_PREFIX.match(code)) for code in known)
    return 2 * prefixed > len(known) or (column.lower() == "traffic_sign" and country is None)


def scheme_of(codes: Iterable[str | None]) -> str:
    """Return `mapillary` when most codes look like its classes, else ""."""
    known = [code for code in codes if code]
    return MAPILLARY if 2 * sum("--" in code for code in known) > len(known) else ""


def guess_country(codes: Iterable[str | None], here: set[str]) -> str | None:
    """Return the country whose national scheme knows most of the codes, and at least half of them.

    Parameters
    ----------
    codes
        Codes, None where there is none; those that name their country say nothing of the others.
    here
        Countries that the positions may lie in; one of them is preferred to one elsewhere, which must know more of
        more codes: `R1-1` alone, in Munich, is nobody's.
    """
    bare = (code for code in codes if code and not _NAMES_COUNTRY.match(code))
    counted = Counter(part for code in bare for part in split_stack(code, None))
    if not counted:
        return None
    taxonomy = load_taxonomy()
    shares = {
        country: sum(n for code, n in counted.items() if taxonomy.meaning(code, country=country).known)
        / counted.total()
        for country in sorted({rule.country for rule in taxonomy.rules if rule.country})
    }
    words = sum(n for code, n in counted.items() if taxonomy.meaning(code).known) / counted.total()
    able = {country: share for country, share in shares.items() if share >= max(_ENOUGH, words + 0.01)}
    near = {country: share for country, share in able.items() if country in here}
    far = {country: share for country, share in able.items() if share >= _FAR_SHARE and len(counted) >= _FAR_CODES}
    return max(near or far, key=lambda country: (near or far)[country], default=None)


def split_stack(code: str, separator: str | None) -> list[str]:
    """Split the codes of a stack of plates; empty parts are left out."""
    parts = code.split(separator) if separator else _STACK.split(code)
    return [part.strip() for part in parts if part.strip()]


def read_codes(
    codes: Sequence[str | None],
    values: Sequence[str | None],
    countries: Sequence[str | None],
    *,
    scheme: str,
    separator: str | None,
) -> Plates:
    """Return the plates of codes of one scheme, or of each code's country.

    Without a scheme, a code that names its country (`DE:274[30],1040`) is a value of OpenStreetMap.
    """

    @cache
    def plates(code: str, value: str, country: str | None) -> tuple[Plate, ...]:
        if not scheme and not separator and _NAMES_COUNTRY.match(code):
            return _osm_plates({"traffic_sign": code}, country)
        parts = split_stack(code, separator) or [""]
        meanings = [_meaning(part, value if len(parts) == 1 else "", country or "", scheme) for part in parts]
        kinds = [meaning.kind for meaning in meanings]
        return tuple(
            Plate(part, country, meaning, kind, _parent(index, kinds))
            for index, (part, meaning, kind) in enumerate(zip(parts, meanings, kinds, strict=True))
        )

    rows = zip(codes, values, countries, strict=True)
    return Plates([plates(code or "", value or "", country) for code, value, country in rows])


def read_osm(tags: Iterable[dict[str, str]], country: str | None) -> Plates:
    """Return the plates of features with OpenStreetMap's tags; those without a sign have none."""

    @cache
    def plates(items: tuple[tuple[str, str], ...]) -> tuple[Plate, ...]:
        return _osm_plates(dict(items), country)

    found = [plates(tuple(sorted(one.items()))) for one in tags]
    others = sum(not one for one in found)
    return Plates(found, {"other objects, without a sign": others} if others else {})


def _osm_plates(tags: dict[str, str], country: str | None) -> tuple[Plate, ...]:
    return tuple(
        Plate(sign.raw_code, sign.country or country, sign.meaning, sign.kind, sign.parent, sign.facing_deg)
        for sign in node_signs(tags)
    )


def _meaning(code: str, value: str, country: str, scheme: str) -> Meaning:
    """Look a code up; a plain number written on the sign counts where the code has none."""
    taxonomy = load_taxonomy()
    if not code:
        return taxonomy.meaning(NO_CODE)
    meaning = taxonomy.meaning(code, country=country, scheme=scheme)
    if meaning.known and meaning.value is None and _PLAIN_NUMBER.fullmatch(value):
        return taxonomy.meaning(f"{code}[{value}]", country=country, scheme=scheme)
    return meaning


def _parent(index: int, kinds: Sequence[str]) -> int | None:
    """Return the main sign of a plate in a stack: the nearest above it, else the first."""
    if kinds[index] != "plate":
        return None
    mains = [i for i, kind in enumerate(kinds) if kind == "main"]
    return next((i for i in reversed(mains) if i < index), mains[0] if mains else None)
