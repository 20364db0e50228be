"""Any OpenStreetMap file made into a PBF of what is there now: no deleted and no superseded versions.

libosmium reads the encodings. What it does not take care of is done here: Overpass answers (JSON, and XML with points
inside of ways), remarks that an answer is not all, deletions by an editor, changes (`.osc`) and histories (`.osh`), of
which the last version of each element counts.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from geofleet.errors import InputError
from geofleet.formats import osm_json
from geofleet.formats.reading import open_unpacked, unpacked_head
from geofleet.formats.xml import iter_elements

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    import osmium

_MARKS = re.compile(
    rb"""(?P<deleted>action=["']delete["'])|(?P<hidden>visible=["']false["'])|(?P<remark><remark>[^<]{0,400}error[^<]*)"""
    rb"""|(?P<within><center\s|<nd\s[^>]{0,60}lat=)"""
)
_CHUNK, _OVERLAP = 1 << 20, 512
_KINDS = ("node", "way", "relation")


def copy_as_pbf(path: Path, encoding: str, copy: Path) -> None:
    """Write what a file holds as PBF.

    Parameters
    ----------
    path, encoding
        The file, and what `osm_scan.detect` says of it.
    copy
        File to write.

    Raises
    ------
    InputError
        The file is an answer that broke off, or damaged.
    RuntimeError, ValueError
        libosmium cannot read it.
    """
    import osmium  # noqa: PLC0415  (libosmium is not needed for PBF)

    if encoding == "osm.bz2" and osm_json.looks_like(unpacked_head(path)):
        encoding = "json.bz2"
    with osmium.SimpleWriter(str(copy)) as writer:
        if encoding.startswith("json"):
            osm_json.write_elements(osm_json.elements(path), writer, where=str(path))
            return
        try:
            _copy(path, encoding, writer)
        except osmium.InvalidLocationError as error:
            raise ValueError(*error.args) from None


def _copy(path: Path, encoding: str, writer: osmium.SimpleWriter) -> None:
    import osmium  # noqa: PLC0415  (as above)

    marks = {} if encoding == "pbf" else _marks(path)
    if "remark" in marks:
        text = marks["remark"].removeprefix(b"<remark>").decode(errors="replace").strip()
        raise InputError(f"Overpass could not answer in full ({text}).", where=str(path), todo=osm_json.AGAIN)
    if "within" in marks:
        osm_json.write_elements(_overpass_elements(path), writer, where=str(path))
        return
    source = osmium.io.File(str(path), encoding)
    if marks or osmium.io.Reader(source).header().has_multiple_object_versions:
        _copy_latest(source, _deleted(path) if "deleted" in marks else frozenset(), writer)
    else:
        osmium.apply(source, writer)


def _marks(path: Path) -> dict[str, bytes]:
    """Return what XML holds that libosmium leaves to its caller, by kind."""
    found: dict[str, bytes] = {}
    with open_unpacked(path) as file:
        tail = b""
        while chunk := file.read(_CHUNK):
            for match in _MARKS.finditer(tail + chunk):
                found.setdefault(str(match.lastgroup), match[0])
            tail = chunk[-_OVERLAP:]
    return found


def _deleted(path: Path) -> frozenset[tuple[str, str]]:
    """Return kind and id of what an editor has marked to be deleted."""
    return frozenset((e.tag[0], e.get("id", "")) for e in iter_elements(path, _KINDS) if e.get("action") == "delete")


def _copy_latest(source: osmium.io.File, deleted: frozenset[tuple[str, str]], writer: osmium.SimpleWriter) -> None:
    """Write the last version of every element, unless it is deleted."""
    last: dict[tuple[str, int], tuple[int, int]] = {}
    for place, item in enumerate(_items(source)):
        key = (item.type_str(), item.id)
        if item.version >= last.get(key, (-1, 0))[0]:
            last[key] = (item.version, place)
    for place, item in enumerate(_items(source)):
        key = (item.type_str(), item.id)
        if last[key][1] == place and item.visible and (key[0], str(key[1])) not in deleted:
            writer.add(item)


def _items(source: osmium.io.File) -> Iterator[Any]:
    import osmium  # noqa: PLC0415  (as above)

    kinds = osmium.osm.NODE | osmium.osm.WAY | osmium.osm.RELATION
    yield from osmium.FileProcessor(source, kinds)


def _overpass_elements(path: Path) -> Iterator[Mapping[str, Any]]:
    """Yield the elements of an Overpass answer in XML as those of one in JSON."""
    for element in iter_elements(path, _KINDS):
        points = [nd.attrib for nd in element.findall("nd")]
        yield {
            "type": element.tag,
            "id": _integer(element.get("id")),
            **_point(element.attrib),
            "tags": {tag.get("k", ""): tag.get("v", "") for tag in element.findall("tag")},
            "nodes": [_integer(point["ref"]) for point in points if "ref" in point],
            "geometry": [_point(point) or None for point in points],
        }


def _point(attributes: Mapping[str, str]) -> dict[str, float]:
    return {side: float(attributes[side]) for side in ("lat", "lon") if attributes.get(side)}


def _integer(text: str | None) -> int | None:
    return int(text) if text and re.fullmatch(r"-?\d{1,19}", text) else None
