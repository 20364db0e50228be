"""What is looked for in an OpenStreetMap file: nodes that carry signs.

Files are PBF, or are made into one first, by libosmium, in a temporary folder: then one reader serves all.
"""

from __future__ import annotations

import codecs
import re
import tempfile
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from geofleet.errors import InputError
from geofleet.formats import osm_json
from geofleet.formats.osm_dense import DenseNodes
from geofleet.formats.osm_pbf import UnusualPbfError, read_blocks
from geofleet.formats.osm_spool import NODE, NodeSpool
from geofleet.formats.osm_tags import (
    KEY_STARTS,
    POINT_HIGHWAYS,
    is_sign_key,
    tells_of_signs,
)
from geofleet.formats.reading import BZIP2, GZIP, open_unpacked, read_head

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from numpy.typing import NDArray

    from geofleet.formats.osm_pbf import Block
    from geofleet.formats.osm_strings import Strings

    Ints = NDArray[np.int64]

_T = TypeVar("_T")
_PBF_MARK = b"OSMHeader"
_MARK_WITHIN = 1024
_LANELET = re.compile(rb"""v=["']lanelet["']""")
_CHUNK, _OVERLAP = 1 << 20, 64
_TAG_BYTES = 16  # two numbers
_STARTS = [word.encode() for word in (*KEY_STARTS, *POINT_HIGHWAYS)]
_HIGHWAY = b"highway"
_POINT_WORDS = frozenset(word.encode() for word in POINT_HIGHWAYS)
# What a block with signs has in its string table: a key, or a word of `highway` with its length before it.
_WORDS = tuple(b"\n%c" % len(word) + word.encode() for word in POINT_HIGHWAYS)
_MARKS = (b"traffic_sign", *_WORDS)


@dataclass(frozen=True, slots=True)
class SignNodes:
    """Nodes that carry signs.

    Parameters
    ----------
    spool
        Id, position and number of the tags of each.
    tagsets
        The different tags that such nodes have, those that tell of signs only.
    """

    spool: NodeSpool
    tagsets: list[dict[str, str]]


@dataclass(frozen=True, slots=True)
class _Found:
    """Sign nodes of some blocks: how many tags each has, those as numbers of strings, (m, 2), and which these are."""

    nodes: NDArray[np.void]
    n_tags: Ints
    tags: Ints
    used: Ints
    texts: list[bytes]


def detect(head: bytes) -> str:
    """Return the encoding that a file's first bytes show, or "" when it is not OpenStreetMap's.

    `pbf`, `osm` (XML) or `json` (Overpass), the latter two with `.gz` or `.bz2` when packed.
    """
    if _PBF_MARK in head[:32]:
        return "pbf"
    for mark, suffix, unpacked in ((GZIP, ".gz", osm_json.gunzipped), (BZIP2, ".bz2", osm_json.bunzipped)):
        if head.startswith(mark):
            inside = unpacked(head)
            # A block of bzip2 shows nothing before its end, and what is packed and cannot be seen is a map.
            return f"{'json' if osm_json.looks_like(inside) else 'osm'}{suffix}"
    if osm_json.looks_like(head):
        return "json"
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        head = head[: len(head) // 2 * 2].decode("utf-16", "replace").encode()
    return "osm" if b"<osm" in head[:_MARK_WITHIN] else ""


def scan(path: Path, work: Callable[[Path], _T]) -> _T:
    """Return what `work` makes of a file as PBF: itself, or a copy of it in a temporary folder.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or not OpenStreetMap's.
    """
    found = detect(read_head(path))
    if not found:
        raise InputError(
            "not an OpenStreetMap file.",
            where=str(path),
            todo="Give a .osm.pbf, .osm or Overpass .json file; the latter two may be packed (.gz, .bz2).",
        )
    with _explained(path):
        if found == "pbf":
            try:
                return work(path)
            except UnusualPbfError:
                pass  # libosmium reads it, and writes what is read here
        from geofleet.formats.osm_copy import copy_as_pbf  # noqa: PLC0415  (PBF does without)

        with tempfile.TemporaryDirectory(prefix="geofleet-") as folder:
            copy = Path(folder) / "map.osm.pbf"
            copy_as_pbf(path, found, copy)
            return work(copy)


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """Turn what readers raise on a damaged file into an InputError that names the file asked for."""
    try:
        yield
    except InputError as error:
        raise InputError(error.what, where=str(path), todo=error.todo) from None
    except (RuntimeError, ValueError, IndexError, OSError, EOFError, OverflowError, MemoryError) as error:
        reason = str(error).strip().rstrip(".") or type(error).__name__
        raise InputError(
            f"damaged, or not an OpenStreetMap file ({reason}).",
            where=str(path),
            todo="Fetch or export it again.",
        ) from None


def refuse_lanelet2(path: Path) -> None:
    """Refuse a Lanelet2 map, which is OpenStreetMap XML in form only; asked when a file gave nothing.

    Raises
    ------
    InputError
        The file holds lanelets.
    """
    if _is_in(path, _LANELET):
        raise InputError(
            "a Lanelet2 map, which is not read.",
            where=str(path),
            todo="Give an OpenStreetMap extract: .osm.pbf, .osm, .osm.gz or .osm.bz2.",
        )


def _is_in(path: Path, pattern: re.Pattern[bytes]) -> bool:
    """Tell whether a file holds a short text, a piece at a time."""
    with open_unpacked(path) as file:
        tail = b""
        while chunk := file.read(_CHUNK):
            if pattern.search(tail + chunk):
                return True
            tail = chunk[-_OVERLAP:]
    return False


def sign_nodes(pbf: Path) -> SignNodes:
    """Read every node with a `traffic_sign` key or a `highway` value that stands for a sign or light.

    Raises
    ------
    InputError
        The file is damaged or holds no node at all.
    """
    known: dict[bytes, int] = {}
    tagsets: dict[bytes, int] = {}
    spool = NodeSpool()
    has_nodes = False
    for found in read_blocks(pbf, _signs_in, nodes_only=True):
        has_nodes |= found is not None
        if found:
            found.nodes["tagset"] = _numbered(found, known, tagsets)
            spool.append(found.nodes)
    if not has_nodes:
        raise InputError("the file holds no nodes.", where=str(pbf), todo="Check that it is the extract you mean.")
    return SignNodes(spool, [_tags(packed, list(known)) for packed in tagsets])


def _numbered(found: _Found, known: dict[bytes, int], tagsets: dict[bytes, int]) -> NDArray[np.int32]:
    """Return the number of each node's set of tags, in what was met so far; every block numbers its strings anew."""
    number = np.zeros(found.used[-1] + 1 if len(found.used) else 0, np.int64)
    number[found.used] = [known.setdefault(text, len(known)) for text in found.texts]
    packed = number[found.tags].tobytes()
    ends = (_TAG_BYTES * np.cumsum(found.n_tags)).tolist()
    return np.array(
        [tagsets.setdefault(packed[a:b], len(tagsets)) for a, b in zip([0, *ends], ends, strict=False)], np.int32
    )


def _tags(packed: bytes, strings: list[bytes]) -> dict[str, str]:
    """Return a set of tags by its numbers."""
    text = [strings[number].decode(errors="replace") for number in np.frombuffer(packed, np.int64)]
    return dict(sorted(zip(text[::2], text[1::2], strict=True)))


def _int32(e7: Ints) -> NDArray[np.int32]:
    """Return positions in half the room; what does not fit is nowhere on Earth and stays so."""
    limit = np.iinfo(np.int32).max
    return np.clip(e7, -limit, limit).astype(np.int32)


def _signs_in(blocks: list[Block]) -> _Found | None:
    """Return the sign nodes of some blocks; None when they hold no nodes at all."""
    blocks = [block for block in blocks if block.has_nodes()]
    if not blocks:
        return None
    nodes = DenseNodes([block for block in blocks if any(map(block.holds_string, _MARKS))], tagged=True)
    chosen, n_tags, tags = _sign_tags(nodes)
    found = np.empty(len(chosen), NODE)
    if len(chosen):
        found["node_id"] = nodes.node_id[chosen]
        found["lon_e7"], found["lat_e7"] = map(_int32, nodes.lonlat_e7(chosen))
    used = np.flatnonzero(np.bincount(tags.ravel()))
    return _Found(found, n_tags, tags, used, nodes.strings.take(used))


def _sign_tags(nodes: DenseNodes) -> tuple[Ints, Ints, Ints]:
    """Return which nodes carry signs, how many tags of theirs tell of them, and those: numbers of strings, (m, 2)."""
    key_role, is_word, is_highway = _roles(nodes.strings)
    coded, ends = nodes.tags()
    at = np.flatnonzero((key_role > 0)[coded])
    owner = np.searchsorted(ends, at)
    start = np.where(owner > 0, ends[owner - 1] + 1, 0)
    is_key = (at - start) % 2 == 0
    at, owner = at[is_key], owner[is_key]
    key, value = coded[at], coded[at + 1]
    names = (key_role[key] == 2) | (is_highway[key] & is_word[value])  # noqa: PLR2004 - the role of sign keys
    carries = np.zeros(len(ends), bool)
    carries[owner[names]] = True
    kept = carries[owner]
    chosen = np.flatnonzero(carries)
    counts = np.bincount(owner[kept], minlength=len(carries))[chosen]
    return chosen, counts, np.column_stack((key[kept], value[kept]))


def _roles(strings: Strings) -> tuple[NDArray[np.int8], NDArray[np.bool_], NDArray[np.bool_]]:
    """Tell which strings are keys that tell of signs (1) or name them (2), which are signs' words, which highway."""
    role = np.zeros(len(strings), np.int8)
    is_word, is_highway = np.zeros((2, len(strings)), bool)
    for index in strings.starting(_STARTS):
        text = strings[index]
        role[index], is_word[index], is_highway[index] = _role(text), text in _POINT_WORDS, text == _HIGHWAY
    role[strings.first[:-1]] = 0  # none of a tag
    return role, is_word, is_highway


@lru_cache(maxsize=4096)
def _role(key: bytes) -> int:
    text = key.decode(errors="replace")
    return (2 if is_sign_key(text) else tells_of_signs(text)) if text.startswith(KEY_STARTS) else 0
