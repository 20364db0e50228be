"""The vocabulary read backwards: codes that mean a concept, as the patterns of `taxonomy.csv` show them.

A pattern stands for many codes; the example made of it is the shortest one: the first of alternatives, nothing that may
be left out, the first letter of a set.
"""

from __future__ import annotations

import re
from functools import cache

from geofleet.taxonomy.reader import NUMBER, load_taxonomy

_TOKEN = re.compile(r"\\(?P<escaped>.)|\[(?P<set>(?:\\.|[^\]])+)\]|(?P<open>\((?:\?:)?)|(?P<plain>[^\\\[(])", re.DOTALL)
_STANDS_FOR = {"d": "1", "s": " ", "w": "a"}
_OPTIONAL = ("?", "*")


def codes_of(concept: str, *, country: str | None = None, value: float | None = None) -> tuple[str, ...]:
    """Return OpenStreetMap values that may name a concept, the likeliest first: `DE:206`, `stop`, `FI:B6`.

    Codes of the country come first, then words that hold everywhere, then codes of other countries. Whether a reader
    takes one for the concept is for the caller to try: an earlier rule of the vocabulary may claim it.

    Parameters
    ----------
    concept
        A concept of the taxonomy; others have no codes.
    country
        ISO 3166-1 alpha-2 of the sign.
    value
        The number on the sign, for patterns that have it in the code.
    """
    number = "" if value is None else f"{value:g}"
    patterns = _patterns().get(concept, ())
    # What `.*` stands for nobody knows; among equals the order is that of the file
    ranked = sorted(patterns, key=lambda rule: (".*" in rule[1], rule[0] != country, bool(rule[0])))
    codes = ((land, code) for land, pattern in ranked for code in _examples(pattern, number))
    return tuple(dict.fromkeys(f"{land}:{code}" if land else code for land, code in codes))


@cache
def _patterns() -> dict[str, list[tuple[str, str]]]:
    """Return country and pattern of every rule that OpenStreetMap's values are read by, by concept."""
    found: dict[str, list[tuple[str, str]]] = {}
    for rule in load_taxonomy().rules:
        if rule.country or rule.scheme == "osm":
            pattern = rule.text.replace(NUMBER, "{n}")
            found.setdefault(rule.concept.name, []).append((rule.country, pattern))
    return found


def _examples(pattern: str, number: str) -> list[str]:
    """Return the shortest code of each alternative of a pattern, and with a number the one that holds it."""
    examples = [example(branch) for branch in _branches(pattern)]
    if number and "{n}" in pattern:
        # what may be left out must stay when the number is in it
        examples = [example(pattern, is_full=True).replace("{n}", number), *examples]
    return [text.replace("{n}", number) for text in examples if number or "{n}" not in text]


def example(pattern: str, *, is_full: bool = False) -> str:
    """Return a text that a pattern of the vocabulary matches, with `{n}` left as it is.

    Parameters
    ----------
    pattern
        Literals, sets, groups, alternatives and the quantifiers `?`, `*` and `+`.
    is_full
        Keep what may be left out.
    """
    text, rest = "", _branches(pattern)[0]
    while rest:
        piece, rest = _piece(rest, is_full=is_full)
        quantifier = rest[:1] if rest[:1] in {"?", "*", "+"} else ""
        rest = rest[len(quantifier) :]
        if is_full or quantifier not in _OPTIONAL:
            text += piece
    return text


def _piece(pattern: str, *, is_full: bool) -> tuple[str, str]:
    """Return an example of the first thing in a pattern, and the rest of the pattern."""
    if pattern.startswith("{n}"):
        return "{n}", pattern[3:]
    match = _TOKEN.match(pattern)
    if match is None:
        raise ValueError(pattern)
    if match["open"]:
        end = _closing(pattern)
        return example(pattern[match.end() : end], is_full=is_full), pattern[end + 1 :]
    rest = pattern[match.end() :]
    if match["set"]:
        first = match["set"]
        return (_STANDS_FOR.get(first[1], first[1]) if first[0] == "\\" else first[0]), rest
    if match["escaped"]:
        return _STANDS_FOR.get(match["escaped"], match["escaped"]), rest
    return ("a" if match["plain"] == "." else match["plain"]), rest


def _branches(pattern: str) -> list[str]:
    """Split a pattern at the `|` that stand outside of groups and sets."""
    parts, start = [], 0
    for at, letter, depth in _letters(pattern):
        if letter == "|" and depth == 0:
            parts.append(pattern[start:at])
            start = at + 1
    return [*parts, pattern[start:]]


def _closing(pattern: str) -> int:
    """Return where the group that a pattern starts with ends."""
    return next(at for at, letter, depth in _letters(pattern) if letter == ")" and depth == 0)


def _letters(pattern: str) -> list[tuple[int, str, int]]:
    """Return place, letter and depth of groups after it, of what is neither escaped nor in a set."""
    found, depth, at = [], 0, 0
    while at < len(pattern):
        match = _TOKEN.match(pattern, at)
        letter = pattern[at]
        depth += (letter == "(") - (letter == ")")
        found.append((at, letter, depth))
        at = match.end() if match and not match["open"] else at + 1
    return found
