"""OpenStreetMap's PBF, read a block at a time: https://wiki.openstreetmap.org/wiki/PBF_Format.

Blocks are unpacked and decoded on threads of their own, as arrays, numbers of a block at once. Blocks that cannot hold
what is looked for are passed over by a search in their string table, so that a file is read about as fast as it
unpacks, and memory holds a few blocks whatever its size.

Read are dense nodes and ways, which is what every usual writer makes. Anything else that the format allows raises
`UnusualPbfError`; libosmium can rewrite such a file.
"""

from __future__ import annotations

import zlib
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from geofleet.errors import InputError
from geofleet.formats.osm_blobs import UnusualPbfError, check_features, read_blobs, unpack
from geofleet.formats.protobuf import BYTES, VARINT, DamagedPbfError, deltas, fields, signed, varint, varints

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator
    from concurrent.futures import Future
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.formats.protobuf import Span

    Ints = NDArray[np.int64]

__all__ = ["Block", "DenseNodes", "Strings", "UnusualPbfError", "read_blocks"]

_THREADS, _AHEAD = 2, 6
_NANO_PER_E7 = 100
_NEWLINE = 0x0A  # field 1, bytes
_HEAD = 3  # bytes by which strings are looked up
_WAY_FIELDS = ((1, 0), (2, b""), (3, b""), (8, b""))  # id, keys, values, refs

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class DenseNodes:
    """Nodes of a group: ids and positions in 1e-7 degrees, shape (n,), and their tags as the block has them.

    `keys_vals` holds numbers of strings, key and value in turn, with a 0 after each node; empty when no node has tags.
    """

    node_id: Ints
    lon_e7: Ints
    lat_e7: Ints
    keys_vals: Ints


@dataclass(frozen=True, slots=True)
class Strings:
    """A string table: where each string begins and ends; strings are cut when asked for."""

    data: bytes
    begin: Ints
    end: Ints

    @classmethod
    def of(cls, data: bytes, span: Span) -> Strings:
        """Find the strings of a table.

        Each begins with a newline, as the format happens to have it, and says how long it is. So all newlines are
        taken for beginnings, and where one is not, since it stands inside of a string, those up to the string's end go.
        """
        begin, end = span
        if begin == end:
            return cls(data, np.zeros(0, np.int64), np.zeros(0, np.int64))
        raw = np.frombuffer(data, np.uint8)
        at = np.append(np.flatnonzero(raw[begin:end] == _NEWLINE) + begin, end)
        first, second = (raw[np.minimum(at + n, len(raw) - 1)].astype(np.int64) for n in (1, 2))
        is_long = first >= 0x80  # noqa: PLR2004 - the top bit says that more bytes follow
        ends = at + 2 + np.where(is_long, 1 + (first & 0x7F) + (second << 7), first)
        ends[is_long & (second >= 0x80)] = -1  # noqa: PLR2004 - as above
        kept = np.ones(len(at), bool)
        odd = np.flatnonzero(ends[:-1] != at[1:])
        after = np.searchsorted(at, np.minimum(ends[odd], end))
        is_wrong = at[after] != ends[odd]
        beyond = 0
        for place, follows, wrong in zip(odd.tolist(), after.tolist(), is_wrong.tolist(), strict=True):
            if place >= beyond:
                if wrong:
                    raise DamagedPbfError("a string table with something else in it")
                kept[place + 1 : follows] = False
                beyond = follows
        if at[0] != begin:
            raise DamagedPbfError("a string table with something else in it")
        kept[-1] = False
        return cls(data, (at + 2 + is_long)[kept], ends[kept])

    def __len__(self) -> int:
        return len(self.begin)

    def __getitem__(self, index: int) -> bytes:
        return self.data[self.begin[index] : self.end[index]]

    def take(self, numbers: Ints) -> list[bytes]:
        """Return the strings of some numbers."""
        places = zip(self.begin[numbers].tolist(), self.end[numbers].tolist(), strict=True)
        return [self.data[at:end] for at, end in places]

    def numbers(self, texts: Iterable[bytes]) -> list[int]:
        """Return the numbers of the strings that are one of some texts, of three bytes or more."""
        wanted = set(texts)
        return [n for n in self.starting(wanted) if self[n] in wanted]

    def starting(self, heads: Iterable[bytes]) -> list[int]:
        """Return the numbers of the strings whose first three bytes are those of one of some texts."""
        raw = np.frombuffer(self.data, np.uint8)
        at = np.minimum(self.begin, len(raw) - _HEAD)
        first, second, third = (raw[at + n].astype(np.uint32) for n in range(_HEAD))
        wanted = {int.from_bytes(head[:_HEAD], "big") for head in heads}
        return np.flatnonzero(np.isin(first << 16 | second << 8 | third, list(wanted))).tolist()


@dataclass(frozen=True)
class Block:
    """A block of a file, unpacked and not yet decoded."""

    data: bytes

    @cached_property
    def _parts(self) -> tuple[Span, list[Span], dict[int, int]]:
        """Return where the string table and the groups lie, and the numbers by field."""
        strings, groups, numbers = (0, 0), [], {17: 100, 19: 0, 20: 0}
        for number, value in fields(self.data, (0, len(self.data))):
            if number == 1 and isinstance(value, tuple):
                strings = value
            elif number == 2 and isinstance(value, tuple):  # noqa: PLR2004 - field numbers are the format's
                groups.append(value)
            elif isinstance(value, int):
                numbers[number] = signed(value)
        return strings, groups, numbers

    def holds_string(self, text: bytes) -> bool:
        """Tell whether a string of the block starts with a text; may say yes when none does, never no wrongly."""
        start, end = self._parts[0]
        return self.data.find(text, start, end) >= 0

    @cached_property
    def strings(self) -> Strings:
        """The string table."""
        return Strings.of(self.data, self._parts[0])

    def dense_nodes(self, *, tagged: bool = True) -> Iterator[DenseNodes]:
        """Yield the nodes of each group; without tags when they are not asked for.

        Raises
        ------
        UnusualPbfError
            Nodes are not stored densely.
        """
        _, groups, numbers = self._parts
        for group in groups:
            # A group holds things of one kind, and dense nodes are one field.
            number, value = next(fields(self.data, group), (0, 0))
            if number == 1:
                raise UnusualPbfError("nodes that are not dense")
            if number == 2 and isinstance(value, tuple):  # noqa: PLR2004 - field numbers are the format's
                yield self._dense(value, numbers, tagged=tagged)

    def has_nodes(self) -> bool:
        """Tell whether the block holds nodes, without decoding them."""
        return any(next(fields(self.data, group), (0, 0))[0] in {1, 2} for group in self._parts[1])

    def ways(self, is_wanted: Callable[[bytes], bool]) -> Iterator[tuple[int, bytes, bytes, bytes]]:
        """Yield id, packed keys, packed values and packed references of the ways whose packed keys are wanted."""
        for group in self._parts[1]:
            for number, value in fields(self.data, group):
                if number != 3:  # noqa: PLR2004 - field numbers are the format's
                    break
                if isinstance(value, tuple):
                    way = self._way(value)
                    if is_wanted(way[1]):
                        yield way

    def _way(self, span: Span) -> tuple[int, bytes, bytes, bytes]:
        # The same as `fields` in one loop: ways are what a file has most of, and each has five fields.
        data, (at, end) = self.data, span
        found: dict[int, int | bytes] = {}
        while at < end:
            key, at = (data[at], at + 1) if data[at] < 0x80 else varint(data, at)  # noqa: PLR2004 - one byte
            size, at = (data[at], at + 1) if data[at] < 0x80 else varint(data, at)  # noqa: PLR2004 - as above
            if key & 7 == VARINT:
                found[key >> 3] = size
            elif key & 7 == BYTES and at + size <= end:
                found[key >> 3] = data[at : at + size]
                at += size
            else:
                raise DamagedPbfError("a field beyond its end")
        way_id, keys, values, refs = (found.get(number, missing) for number, missing in _WAY_FIELDS)
        if not (isinstance(way_id, int) and isinstance(keys, bytes)):
            raise DamagedPbfError("a way without its fields")
        if not (isinstance(values, bytes) and isinstance(refs, bytes)):
            raise DamagedPbfError("a way without its fields")
        return signed(way_id), keys, values, refs

    def _dense(self, span: Span, numbers: dict[int, int], *, tagged: bool) -> DenseNodes:
        packed = {1: b"", 8: b"", 9: b"", 10: b""}
        for number, value in fields(self.data, span):
            if isinstance(value, tuple):
                packed[number] = self.data[slice(*value)]
        node_id, lat, lon = (deltas(packed[number]) for number in (1, 8, 9))
        if not len(node_id) == len(lat) == len(lon):
            raise DamagedPbfError("ids and positions differ in number")
        lat_e7, lon_e7 = (_e7(numbers[offset], numbers[17], side) for offset, side in ((19, lat), (20, lon)))
        return DenseNodes(node_id, lon_e7, lat_e7, varints(packed[10]) if tagged else np.zeros(0, np.int64))


def read_blocks(path: Path, work: Callable[[Block], _T], *, nodes_only: bool = False) -> Iterator[_T]:
    """Yield what `work` makes of every block of a file, in the order of the file.

    `work` runs on threads, beside what the caller does with what it made: most of both is zlib's and numpy's, which let
    others run. Blocks of ways and relations come without their content with `nodes_only`, which spares unpacking it.

    Raises
    ------
    InputError
        The file is truncated or damaged; the message says from which byte on.
    UnusualPbfError
        The file is valid and not read here.
    """

    def made(blob: bytes) -> _T:
        return work(Block(unpack(blob, nodes_only=nodes_only)))

    with path.open("rb") as file, ThreadPoolExecutor(_THREADS) as pool:
        waiting: deque[tuple[int, Future[_T]]] = deque()
        at = 0
        try:
            for begin, kind, blob in read_blobs(file):
                if kind == b"OSMHeader":
                    check_features(unpack(blob))
                elif kind == b"OSMData":
                    waiting.append((begin, pool.submit(made, blob)))
                if len(waiting) >= _AHEAD:
                    at, done = waiting.popleft()
                    yield done.result()
            while waiting:
                at, done = waiting.popleft()
                yield done.result()
        except (DamagedPbfError, zlib.error, IndexError, OverflowError) as error:
            raise InputError(
                f"damaged, or not an OpenStreetMap file ({error}, at or after byte {at}).",
                where=str(path),
                todo="Fetch or export it again.",
            ) from None
        finally:
            for _, done in waiting:
                done.cancel()


def _e7(offset: int, granularity: int, coded: Ints) -> Ints:
    """Return degrees as a block has them in 1e-7, rounded towards zero as libosmium does: every tool reads the same."""
    if offset % _NANO_PER_E7 == 0 and granularity % _NANO_PER_E7 == 0:
        return offset // _NANO_PER_E7 + granularity // _NANO_PER_E7 * coded
    nano = offset + granularity * coded
    return np.where(nano < 0, -(-nano // _NANO_PER_E7), nano // _NANO_PER_E7)
