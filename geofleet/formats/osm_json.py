"""OpenStreetMap as Overpass answers it, in JSON: `out body`, `out geom`, packed or not; read an element at a time."""

from __future__ import annotations

import bz2
import gzip
import json
import re
import zlib
from collections import Counter
from typing import IO, TYPE_CHECKING, Any, cast

from geofleet.errors import InputError
from geofleet.formats.reading import BZIP2, GZIP

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping
    from pathlib import Path

    import osmium

_ELEMENTS = re.compile(r'"elements"\s*:\s*\[')
_LOOKS = re.compile(rb'\s*(\xef\xbb\xbf)?\s*\{.*?("elements"\s*:|"generator"\s*:\s*"Overpass|"osm3s"\s*:)', re.DOTALL)
_REMARK = re.compile(r'"remark"\s*:\s*("(?:[^"\\]|\\.)*")')
_CHUNK = 1 << 20
_HEAD_BYTES = 4096
_MAX_ELEMENT_CHARS = 64 << 20
AGAIN = "Fetch it again in full, with `out body` or `out geom`."


def looks_like(head: bytes) -> bool:
    """Tell whether a file's first bytes are those of an Overpass answer."""
    return _LOOKS.match(head) is not None and b'"FeatureCollection"' not in head


def gunzipped(head: bytes) -> bytes:
    """Return what the first bytes of a gzip file hold, as far as they go."""
    try:
        return zlib.decompressobj(31).decompress(head, _HEAD_BYTES)
    except zlib.error:
        return b""


def bunzipped(head: bytes) -> bytes:
    """Return what the first bytes of a bzip2 file hold, as far as they go."""
    try:
        return bz2.BZ2Decompressor().decompress(head, _HEAD_BYTES)
    except (OSError, EOFError):
        return b""


def write_elements(answer: Iterable[Mapping[str, Any]], writer: osmium.SimpleWriter, *, where: str) -> None:
    """Write the nodes and ways of an answer to a file of another encoding.

    Ways of `out geom` bring their points along; these become nodes.

    Raises
    ------
    InputError
        The answer is cut off, is an error message, or has an element that is none.
    """
    from osmium.osm.mutable import Node, Way  # noqa: PLC0415  (libosmium is not needed for PBF)

    unnamed = n_placed = 0
    without: Counter[str] = Counter()
    for element in answer:
        kind, number, tags = element.get("type"), element.get("id"), element.get("tags") or {}
        without[_bare(element)] += 1
        if kind not in {"node", "way"}:
            continue
        if not isinstance(number, int) or not isinstance(tags, dict):
            raise InputError(f"an element that is none: {str(element)[:80]}.", where=where, todo=AGAIN)
        text = {str(key): str(value) for key, value in tags.items()}
        if kind == "node":
            writer.add_node(Node(id=number, location=_place(element), tags=text))
            n_placed += 1
            continue
        geometry = element.get("geometry") or []
        refs = element.get("nodes") or range(unnamed - 1, unnamed - 1 - len(geometry), -1)
        if not element.get("nodes"):
            unnamed -= len(geometry)
        for ref, point in zip(refs, geometry, strict=False):
            if point:
                writer.add_node(Node(id=ref, location=_place(point)))
                n_placed += 1
        writer.add_way(Way(id=number, nodes=list(refs), tags=text))
    if not n_placed:
        _refuse_bare(without, where)


def _bare(element: Mapping[str, Any]) -> str:
    """Return what an element is given by in place of its points, "" when it has some or is a node."""
    if element.get("type") == "count":
        return "count"
    if element.get("type") == "node" or element.get("geometry"):
        return ""
    return next((name for name in ("center", "bounds") if element.get(name)), "ids" if element.get("nodes") else "")


def _refuse_bare(without: Counter[str], where: str) -> None:
    """Refuse an answer that holds no node and no point of a way."""
    what = {
        "center": "ways or relations by their centres (`out center`)",
        "bounds": "ways or relations by their bounds (`out bb`)",
        "ids": "ways by the ids of their nodes",
        "count": "counts",
    }
    named = [f"{without[kind]} {text}" for kind, text in what.items() if without[kind]]
    if named:
        raise InputError(
            f"the answer holds {' and '.join(named)} only, and no node: signs are mapped as nodes.",
            where=where,
            todo="Ask for the nodes with their positions, and for ways with `out geom`: node[traffic_sign](…);out;",
        )


def elements(path: Path) -> Iterator[Mapping[str, Any]]:
    """Yield the elements of an answer, holding one at a time.

    Raises
    ------
    InputError
        The answer is cut off, damaged or an error message.
    """
    decoder = json.JSONDecoder()
    with _opened(path) as file:
        text = _up_to_elements(path, file)
        at = 0
        while True:
            at = _past(text, at, " \t\r\n,")
            if at == len(text):
                text, at = _more(path, file, ""), 0
                continue
            if text[at] == "]":
                _refuse_remark(path, text[at:] + file.read(_CHUNK))
                return
            try:
                element, at = decoder.raw_decode(text, at)
            except (ValueError, RecursionError):
                text, at = _more(path, file, text[at:]), 0
                continue
            if not isinstance(element, dict):
                raise InputError(f"an element that is none: {str(element)[:80]}.", where=str(path), todo=AGAIN)
            yield element


def _opened(path: Path) -> IO[str]:
    with path.open("rb") as file:
        mark = file.read(3)
    opened: Any = gzip.open if mark.startswith(GZIP) else bz2.open if mark.startswith(BZIP2) else open
    return cast("IO[str]", opened(path, "rt", encoding="utf-8-sig"))


def _up_to_elements(path: Path, file: IO[str]) -> str:
    """Return what was read, from the first element on."""
    text = file.read(_CHUNK)
    match = _ELEMENTS.search(text)
    _refuse_remark(path, text[: match.start()] if match else text)
    if not match:
        raise InputError("an Overpass answer without elements.", where=str(path), todo=AGAIN)
    return text[match.end() :]


def _refuse_remark(path: Path, text: str) -> None:
    """Refuse an answer that says that it is not all: a query that timed out gives what it had, and a remark."""
    remark = _REMARK.search(text)
    if remark and "error" in remark[1]:
        raise InputError(f"Overpass could not answer in full ({json.loads(remark[1])}).", where=str(path), todo=AGAIN)


def _more(path: Path, file: IO[str], rest: str) -> str:
    more = file.read(_CHUNK + len(rest))
    if not more or len(rest) > _MAX_ELEMENT_CHARS:
        raise InputError("the Overpass answer is cut off or damaged.", where=str(path), todo=AGAIN)
    return rest + more


def _past(text: str, at: int, letters: str) -> int:
    while at < len(text) and text[at] in letters:
        at += 1
    return at


def _place(point: Mapping[str, Any]) -> tuple[float, float]:
    lon, lat = point.get("lon"), point.get("lat")
    if not isinstance(lon, int | float) or not isinstance(lat, int | float):
        raise InputError(f"a position that is none: {str(point)[:80]}.", todo=AGAIN)
    return float(lon), float(lat)
