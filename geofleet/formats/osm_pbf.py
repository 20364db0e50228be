"""OpenStreetMap's PBF, read some blocks at a time: https://wiki.openstreetmap.org/wiki/PBF_Format.

Blocks are unpacked and decoded on threads of their own, as arrays, numbers of several blocks at once. Blocks that
cannot hold what is looked for are passed over by a search in their string table, and memory holds a few blocks whatever
the size of the file.

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

from geofleet.errors import InputError
from geofleet.formats.osm_blobs import UnusualPbfError, check_features, is_without_nodes, read_blobs, unpack
from geofleet.formats.osm_strings import Strings
from geofleet.formats.protobuf import BYTES, VARINT, DamagedPbfError, fields, signed, varint

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from concurrent.futures import Future
    from pathlib import Path
    from typing import BinaryIO

    from geofleet.formats.protobuf import Span

__all__ = ["Block", "UnusualPbfError", "read_blocks"]

_THREADS, _AHEAD = 2, 4
_BYTES_AT_ONCE = 384 << 10  # packed: some four blocks as libosmium makes them
_LARGE_BYTES = 16 << 20
_WAY_FIELDS = ((1, 0), (2, b""), (3, b""), (8, b""))  # id, keys, values, refs

_T = TypeVar("_T")


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

    @property
    def string_table(self) -> bytes:
        """The string table as the file has it."""
        return self.data[slice(*self._parts[0])]

    @cached_property
    def strings(self) -> Strings:
        """The strings."""
        return Strings.of([self.string_table])

    def number(self, field: int) -> int:
        """Return granularity (17), latitude's (19) or longitude's offset (20)."""
        return self._parts[2][field]

    def dense_groups(self) -> Iterator[dict[int, bytes]]:
        """Yield the columns of the nodes of each group, by field.

        Raises
        ------
        UnusualPbfError
            Nodes are not stored densely.
        """
        for group in self._parts[1]:
            # A group holds things of one kind, and dense nodes are one field.
            number, value = next(fields(self.data, group), (0, 0))
            if number == 1:
                raise UnusualPbfError("nodes that are not dense")
            if number == 2 and isinstance(value, tuple):  # noqa: PLR2004 - field numbers are the format's
                yield {n: self.data[slice(*at)] for n, at in fields(self.data, value) if isinstance(at, tuple)}

    def has_nodes(self) -> bool:
        """Tell whether the block holds nodes, without decoding them."""
        return any(next(fields(self.data, group), (0, 0))[0] in {1, 2} for group in self._parts[1])

    def ways(self, is_wanted: Callable[[bytes], object]) -> Iterator[tuple[int, bytes, bytes, bytes]]:
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


def read_blocks(path: Path, work: Callable[[list[Block]], _T], *, nodes_only: bool = False) -> Iterator[_T]:
    """Yield what `work` makes of the blocks of a file, some at a time, in the order of the file.

    `work` runs on threads, beside what the caller does with what it made: most of both lets others run. With
    `nodes_only`, blocks of ways and relations come without their content, which spares unpacking it, once one has come:
    in most files all nodes stand first.

    Raises
    ------
    InputError
        The file is truncated or damaged; the message says from which byte on.
    UnusualPbfError
        The file is valid and not read here.
    """

    def made(blobs: list[bytes], *, is_past: bool) -> tuple[bool, _T]:
        blocks = [Block(b"" if is_past and is_without_nodes(blob) else unpack(blob)) for blob in blobs]
        return nodes_only and not blocks[-1].has_nodes(), work(blocks)

    # glibc gives memory back at every turn, and has it zeroed anew for the next block, until a large piece was freed.
    bytes(_LARGE_BYTES)
    with path.open("rb") as file, ThreadPoolExecutor(_THREADS) as pool:
        waiting: deque[tuple[int, Future[tuple[bool, _T]]]] = deque()
        at = 0
        is_past = False
        try:
            for begin, blobs in _some_at_once(file):
                waiting.append((begin, pool.submit(made, blobs, is_past=is_past)))
                if len(waiting) >= _AHEAD:
                    at, done = waiting.popleft()
                    is_past, result = done.result()
                    yield result
            while waiting:
                at, done = waiting.popleft()
                yield done.result()[1]
        except (DamagedPbfError, zlib.error, IndexError, OverflowError) as error:
            raise InputError(
                f"damaged, or not an OpenStreetMap file ({error}, at or after byte {at}).",
                where=str(path),
                todo="Fetch or export it again.",
            ) from None
        finally:
            for _, done in waiting:
                done.cancel()


def _some_at_once(file: BinaryIO) -> Iterator[tuple[int, list[bytes]]]:
    """Yield the place of the first of some blobs of data, and those."""
    some: list[bytes] = []
    first = n_bytes = 0
    for begin, kind, blob in read_blobs(file):
        if kind == b"OSMHeader":
            check_features(unpack(blob))
        elif kind == b"OSMData":
            first = first if some else begin
            some.append(blob)
            n_bytes += len(blob)
            if n_bytes >= _BYTES_AT_ONCE:
                yield first, some
                some, n_bytes = [], 0
    if some:
        yield first, some
