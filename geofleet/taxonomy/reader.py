"""Reads `taxonomy.csv`: what every code of every scheme means, in one vocabulary.

A row ties a code pattern of one scheme to a concept. `code_pattern` is a regular expression that must match the whole
code, letters of either case, `{n}` standing for a number. The code is tried with its bracket first and without it
next. `value_rule` says where the number on the sign comes from: empty, none; `number`, from `{n}`, or else from the
bracket; `=30`, always that. The first row that matches wins.
"""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

RAW_PREFIX = "raw:"
OTHER_GROUP = "other"
NUMBER = r"(?P<value>\d+(?:[.,]\d+)?)"
_BEGIN = re.compile(r"(?:[\w ,:/-](?![?*+{]))*", re.ASCII)  # what stands for itself in a pattern
_UNITS = "km/h|mph|kg|lbs|ft|st|t|km|mi|m|%"
_NO_UNIT = r"(?!\s*(?:lb|cwt|in|cm|kN)\b)"  # what follows makes a number one that is not understood
_IN_BRACKET = re.compile(rf"(?<![\w:])(\d+(?:[.,]\d+)?)(?:\s*({_UNITS}))?(?![\w.:'\u2032-]){_NO_UNIT}")
_FEET = re.compile(
    r"""(?<![\w:.,])(\d+)\s*(?:'|\u2032|ft\b\.?)-?\s*(?:(\d+(?:\.\d+)?)\s*(?:"|''|\u2033|in\b)?)?"""
)  # 12'6"
_INCHES = 12.0
_USUAL = {"mph": "km/h", "ft": "m", "st": "t", "mi": "m"}  # a class names any other unit behind its number
_LANELET2 = re.compile(r"([a-z]{2}_?|[A-Za-z]{2}:)([A-Z]*\d.*)")
_REGION = re.compile(r"(?:[A-Z]{2,3}:\s*|§\s*)(?=\S)")  # a state or province, or the sign of a paragraph
# How inventories write the numbers of two codes of law: Zeichen 274-50, VZ 206; § 52 Z 10a, §52-10a
_WRITTEN = {
    "DE": (re.compile(r"^(?:VZ|Z|Zeichen|Verkehrszeichen|Zusatzzeichen|Nr)\.?\s*[:-]?\s*(?=\d)", re.IGNORECASE), ""),
    "AT": (re.compile(r"(?<=\d)\s*(?:[/-]|\bZ\.?|\blit\.?|\s)\s*(?=\d)", re.IGNORECASE), "."),
}
_SPEED = re.compile(r"(?:max|speed)[ _-]?(?:speed|limit)[ _:=-]*\(?(\d{1,3})\s*(km/?h|mph)?\)?", re.IGNORECASE)
_WORDS = re.compile(r"[A-Za-z]{2,}(?:[\s-]+[A-Za-z]+)+(?=\s*(?:[\[(]|\Z))")
_MILES = frozenset({"US", "GB"})
_CLASS = re.compile(r"([a-z][a-z_]+)(?::(\d+(?:\.\d+)?)([a-z/]*))?")
# What Mapillary finds beside signs
_OBJECTS = {"object": "other", "construction": "other", "marking": "marking"}
_NAMED = re.compile(r"([A-Za-z]{2}):\s*(\S.*)")  # a code that names its country, as OpenStreetMap has them
_MAPILLARY_VARIANT = re.compile(r"--g\d+$")


@dataclass(frozen=True, slots=True)
class Concept:
    """What a sign means: its name, group, kind and the unit of its number."""

    name: str
    group: str
    kind: str
    unit: str


@dataclass(frozen=True, slots=True)
class Meaning:
    """One code understood: concept, group, kind, value with unit, class; `known` is false for raw codes."""

    concept: str
    group: str
    kind: str
    value: float | None
    unit: str | None
    sign_class: str
    known: bool


@dataclass(frozen=True, slots=True)
class Classified:
    """Meanings of many codes as columns of the `signs` table, in the order of the codes.

    `value` is NaN and `unit` None where a sign carries no number.
    """

    concept: NDArray[np.object_]
    group: NDArray[np.object_]
    kind: NDArray[np.object_]
    value: NDArray[np.float64]
    unit: NDArray[np.object_]
    sign_class: NDArray[np.object_]
    known: NDArray[np.bool_]


@dataclass(frozen=True)
class _Rule:
    concept: Concept
    text: str
    value_rule: str
    unit: str
    scheme: str
    country: str

    @cached_property
    def pattern(self) -> re.Pattern[str]:
        """Compiled when a code is first held against it: most countries are in no file at hand."""
        return re.compile(self.text, re.IGNORECASE)


@dataclass(frozen=True)
class Taxonomy:
    """The vocabulary: concepts by name, and the rules that lead from codes to them."""

    concepts: dict[str, Concept]
    rules: tuple[_Rule, ...]

    @property
    def groups(self) -> tuple[str, ...]:
        """Names of all groups, sorted."""
        return tuple(sorted({concept.group for concept in self.concepts.values()}))

    def classify(
        self, codes: Sequence[str], *, country: str | Sequence[str | None] | None = None, scheme: str | None = None
    ) -> Classified:
        """Return what codes mean; each distinct code is looked at once.

        Parameters
        ----------
        codes
            Codes as their source has them, without country: `274.1[30]`, `regulatory--stop--g1`, `give_way`.
        country
            ISO 3166-1 alpha-2, one for all codes or one each: its national code, then OpenStreetMap's words.
        scheme
            `mapillary`, `lanelet2`, `opendrive`, `vienna`, `osm` or a national scheme: that scheme only. Codes of
            `lanelet2` may name their country themselves (`de274_1`).
        """
        lands = [country] * len(codes) if country is None or isinstance(country, str) else list(country)
        found = [_meaning(code, land or "", scheme or "") for code, land in zip(codes, lands, strict=True)]
        return Classified(
            concept=np.array([m.concept for m in found], object),
            group=np.array([m.group for m in found], object),
            kind=np.array([m.kind for m in found], object),
            value=np.array([np.nan if m.value is None else m.value for m in found], np.float64),
            unit=np.array([m.unit for m in found], object),
            sign_class=np.array([m.sign_class for m in found], object),
            known=np.array([m.known for m in found], bool),
        )

    def meaning(self, code: str, *, country: str = "", scheme: str = "") -> Meaning:
        """Return what one code means; an unknown one is its own concept, `raw:<code>`, of kind `main`.

        A code that names another country (`US:R1-1`) is looked up there when it means nothing in the one given.
        """
        return _meaning(code, country, scheme)

    def group_of(self, concepts: Sequence[str]) -> NDArray[np.object_]:
        """Return the group of each concept; raw and unknown concepts belong to `other`."""
        return np.array([self.concepts[c].group if c in self.concepts else OTHER_GROUP for c in concepts], dtype=object)

    def kind_of(self, concepts: Sequence[str]) -> NDArray[np.object_]:
        """Return the kind of each concept; raw and unknown concepts are `main`, but for objects of Mapillary."""
        kinds = [self.concepts[c].kind if c in self.concepts else _kind_of_raw(c) for c in concepts]
        return np.array(kinds, dtype=object)


@cache
def load_taxonomy() -> Taxonomy:
    """Read the packaged vocabulary, once."""
    text = resources.files("geofleet.taxonomy").joinpath("taxonomy.csv").read_text(encoding="utf-8")
    concepts: dict[str, Concept] = {}
    rules = []
    for row in csv.DictReader(text.splitlines()):
        unit = _USUAL.get(row["unit"], row["unit"])
        concept = concepts.setdefault(row["concept"], Concept(row["concept"], row["group"], row["kind"], unit))
        pattern = row["code_pattern"].replace("{n}", NUMBER, 1).replace("{n}", r"\d+")
        rules.append(_Rule(concept, pattern, row["value_rule"], row["unit"], row["scheme"], row["country"]))
    return Taxonomy(concepts, tuple(rules))


@lru_cache(maxsize=65536)
def _meaning(code: str, country: str, scheme: str) -> Meaning:
    code = code.strip()
    texts, land = _normalised(code, country.upper(), scheme)
    candidates = {_without_bracket(text): text for text in reversed(texts)} | {text: text for text in texts}
    for rule in _rules_for(land, scheme).that_may_match(tuple(candidates)):
        for candidate, text in candidates.items():
            match = rule.pattern.fullmatch(candidate)
            if match:
                return _understood(rule, match, text)
    named = _NAMED.fullmatch(code) if scheme in {"", "lanelet2"} else None
    if named and named[1].upper() != country.upper():
        theirs = _meaning(named[2], named[1], "")
        if theirs.known:
            return theirs
    own = _own_class(code) if not scheme else None
    if own:
        return own
    raw = RAW_PREFIX + code.removeprefix(RAW_PREFIX)  # which an earlier reading has put there
    return Meaning(raw, OTHER_GROUP, _kind_of_raw(raw), None, None, raw, known=False)


@dataclass(frozen=True, slots=True)
class _Rules:
    """Rules in the order in which they are tried.

    Most are one plain code each, which is looked up (`plain`: its place). A pattern is held against codes that begin as
    it does (`patterns`: place and beginning, in lower case), and only then compiled.
    """

    rules: tuple[_Rule, ...]
    plain: dict[str, int]
    patterns: tuple[tuple[int, str], ...]

    @classmethod
    def of(cls, rules: tuple[_Rule, ...]) -> _Rules:
        plain: dict[str, int] = {}
        patterns = []
        for place, rule in enumerate(rules):
            begin = _BEGIN.match(rule.text)
            text = begin[0].lower() if begin else ""
            if len(text) == len(rule.text):
                plain.setdefault(text, place)
            else:
                patterns.append((place, "" if "|" in rule.text else text))
        return cls(rules, plain, tuple(patterns))

    def that_may_match(self, codes: Sequence[str]) -> Iterator[_Rule]:
        """Yield what is to be held against some codes, in order."""
        if not all(map(str.isascii, codes)):  # a pattern that ignores case knows more letters than ours
            yield from self.rules
            return
        lower = [code.lower() for code in codes]
        first = min(self.plain.get(code, len(self.rules)) for code in lower)
        for place, begin in self.patterns:
            if place < first and any(code.startswith(begin) for code in lower):
                yield self.rules[place]
        yield from self.rules[first : first + 1]


@cache
def _rules_for(country: str, scheme: str) -> _Rules:
    """Return the rules to try, in order: one scheme; or a country's, then OpenStreetMap's words."""
    return _Rules.of(_rules_of(country, scheme))


def _rules_of(country: str, scheme: str) -> tuple[_Rule, ...]:
    rules = load_taxonomy().rules
    words = tuple(rule for rule in rules if rule.scheme == "osm")
    if scheme and scheme != "lanelet2":
        return tuple(rule for rule in rules if rule.scheme == scheme)
    national = tuple(rule for rule in rules if rule.country == country) if country else ()
    if scheme:
        return (*(rule for rule in rules if rule.scheme == scheme), *national, *words)
    return (*national, *words)


def _kind_of_raw(concept: str) -> str:
    """Return the kind of what the vocabulary does not know: a sign, or what Mapillary calls an object or a marking."""
    before, dashes, _ = concept.removeprefix(RAW_PREFIX).partition("--")
    return _OBJECTS.get(before, "main") if dashes else "main"


def _normalised(code: str, country: str, scheme: str) -> tuple[tuple[str, ...], str]:
    """Return the forms of a code to look for, the likeliest first, and the country whose it is."""
    if scheme == "mapillary":
        return (_MAPILLARY_VARIANT.sub("", code),), country
    match = _LANELET2.fullmatch(code) if scheme == "lanelet2" else None
    if match:
        # de274_1 is 274.1, frB14_50 is B14-50
        forms = (match[2].replace("_", "."), match[2].replace("_", "-"))
        return tuple(dict.fromkeys(forms)), match[1][:2].upper()
    region = _REGION.match(code) if country and not scheme else None
    text = code[region.end() :] if region else code
    if not scheme and country in _WRITTEN:
        pattern, sign = _WRITTEN[country]
        text = pattern.sub(sign, text, count=1)
    return ((text,) if scheme else tuple(dict.fromkeys((text, _worded(text, country))))), country


def _worded(text: str, country: str) -> str:
    """Return `No entry` as the word `no_entry`, `Speed limit (50km/h)` or `maxspeed:50` as `speed_limit[50 km/h]`.

    A speed without a unit is in that of the country.
    """
    speed = _SPEED.fullmatch(text)
    if speed:
        unit = (speed[2] or ("mph" if country in _MILES else "km/h")).lower().replace("kmh", "km/h")
        return f"speed_limit[{speed[1]} {unit}]"
    words = _WORDS.match(text)
    return re.sub(r"[\s-]+", "_", words[0].lower()) + text[words.end() :] if words else text


def _own_class(code: str) -> Meaning | None:
    """Return what a class of geofleet means, `speed_limit:50` or `speed_limit:25mph`; None for anything else."""
    match = _CLASS.fullmatch(code)
    concept = load_taxonomy().concepts.get(match[1]) if match else None
    if match is None or concept is None or (match[2] and not concept.unit):
        return None
    value, unit = (float(match[2]), match[3] or concept.unit) if match[2] else (None, None)
    return Meaning(concept.name, concept.group, concept.kind, value, unit, code, known=True)


def _without_bracket(code: str) -> str:
    """Return the code before its first bracket, where brackets may be round."""
    return re.split(r"\s*[\[(]", code, maxsplit=1)[0].rstrip(" _")


def _understood(rule: _Rule, match: re.Match[str], code: str) -> Meaning:
    value, unit = _value(rule, match, code)
    concept = rule.concept
    sign_class = concept.name
    if value is not None:
        sign_class += f":{value:g}" + ("" if unit in (None, concept.unit) else str(unit))
    return Meaning(concept.name, concept.group, concept.kind, value, unit, sign_class, known=True)


def _value(rule: _Rule, match: re.Match[str], code: str) -> tuple[float | None, str | None]:
    """Return the number on the sign and its unit, by the rule of the row."""
    if rule.value_rule.startswith("="):
        return float(rule.value_rule[1:]), rule.unit
    if rule.value_rule != "number":
        return None, None
    own: Any = match.groupdict().get("value")
    if own:
        return float(own.replace(",", ".")), rule.unit
    bracket = re.search(r"[\[(](.*)[\])]?", code)
    inside = bracket[1].rstrip("])") if bracket else ""
    feet = _FEET.search(inside)
    if feet:
        return float(feet[1]) + float(feet[2] or 0) / _INCHES, "ft"
    found = _IN_BRACKET.search(inside)
    if not found:
        return None, None
    return float(found[1].replace(",", ".")), found[2] or rule.unit
