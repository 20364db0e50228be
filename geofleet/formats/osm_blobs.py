"""The blobs of an OpenStreetMap PBF file, unpacked: https://wiki.openstreetmap.org/wiki/PBF_Format.

A blob is raw, or packed by zlib, which is usual, by zstd, lz4 or lzma. What a header asks for and is not read here
raises `UnusualPbfError`; libosmium can rewrite such a file.
"""

from __future__ import annotations

import lzma
import zlib
from typing import TYPE_CHECKING

from geofleet.formats.protobuf import DamagedPbfError, Span, fields, varint

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import BinaryIO

MAX_BLOB_BYTES = 32 * 1024 * 1024
_MAX_HEADER_BYTES = 64 * 1024
_MAX_LZMA_BYTES = 1 << 28
_READ = frozenset({"OsmSchema-V0.6", "DenseNodes"})
_RAW, _ZLIB, _LZMA, _ARROW = 1, 3, 4, {6: "lz4_raw", 7: "zstd"}  # field numbers of a blob
_PEEK_BYTES = 32


class UnusualPbfError(Exception):
    """A valid file that uses a rare part of the format: nodes that are not dense, history, an obsolete compression."""


def read_blobs(file: BinaryIO) -> Iterator[tuple[int, bytes, bytes]]:
    """Yield the place, kind and content of every blob."""
    while True:
        at = file.tell()
        head = file.read(4)
        if not head:
            return
        size = int.from_bytes(head, "big")
        if len(head) < 4 or size > _MAX_HEADER_BYTES:  # noqa: PLR2004 - the length of a length
            raise DamagedPbfError("no block begins here")
        kind, size = _blob_header(_exactly(file, size))
        yield at, kind, _exactly(file, size)


def _exactly(file: BinaryIO, size: int) -> bytes:
    content = file.read(size)
    if len(content) < size:
        raise DamagedPbfError("the file is truncated")
    return content


def _blob_header(header: bytes) -> tuple[bytes, int]:
    kind, size = b"", -1
    for number, value in fields(header, (0, len(header))):
        if number == 1 and isinstance(value, tuple):
            kind = header[slice(*value)]
        elif number == 3 and isinstance(value, int):  # noqa: PLR2004 - field numbers are the format's
            size = value
    if not 0 <= size <= MAX_BLOB_BYTES:
        raise DamagedPbfError(f"a block of {size} bytes")
    return kind, size


def unpack(blob: bytes) -> bytes:
    """Return the content of a blob, of at most 32 MiB as the format has it, whatever it would grow to."""
    content, raw_size, how = _packed(blob)
    if how == _RAW:
        return bytes(content)
    return _inflated(content, raw_size) if how == _ZLIB else _unpacked(content, raw_size, how)


def is_without_nodes(blob: bytes) -> bool:
    """Tell whether a blob is one group of ways or relations; may say no of such a one, never yes of another.

    Its first bytes tell, and what follows its strings: less is unpacked than of the whole.
    """
    content, raw_size, how = _packed(blob)
    return how == _ZLIB and _begins_without_nodes(content, raw_size)


def _packed(blob: bytes) -> tuple[memoryview, int, int]:
    """Return what a blob holds, how large that is when unpacked, and in which way it is packed."""
    packed: Span | None = None
    raw_size = how = 0
    for number, value in fields(blob, (0, len(blob))):
        if number == 1 and isinstance(value, tuple):
            return memoryview(blob)[slice(*value)], value[1] - value[0], _RAW
        if number == 2 and isinstance(value, int):  # noqa: PLR2004 - field numbers are the format's
            raw_size = value
        elif isinstance(value, tuple):
            packed, how = value, number
    if packed is None or not 0 <= raw_size <= MAX_BLOB_BYTES:
        raise DamagedPbfError(f"a block that would unpack to {raw_size} bytes")
    return memoryview(blob)[slice(*packed)], raw_size, how


def _unpacked(packed: memoryview, raw_size: int, how: int) -> bytes:
    """Return what is packed otherwise than by zlib."""
    import pyarrow as pa  # noqa: PLC0415  (only rare files need it)

    try:
        if how == _LZMA:
            content = lzma.LZMADecompressor(lzma.FORMAT_ALONE, _MAX_LZMA_BYTES).decompress(packed, raw_size + 1)
        elif how in _ARROW:
            content = pa.Codec(_ARROW[how]).decompress(packed, raw_size, asbytes=True)
        else:
            raise UnusualPbfError(f"blobs packed in the way of field {how}")
    except (pa.ArrowException, OSError, lzma.LZMAError) as error:
        raise DamagedPbfError(f"a block that cannot be unpacked: {error}") from None
    if len(content) != raw_size:
        raise DamagedPbfError("a block whose size is not the one it states")
    return content


def _inflated(packed: memoryview, raw_size: int) -> bytes:
    unpacker = zlib.decompressobj()
    content = unpacker.decompress(packed, max(raw_size, 1))
    if len(content) != raw_size or unpacker.unconsumed_tail:
        raise DamagedPbfError("a block whose size is not the one it states")
    return content


def _begins_without_nodes(packed: memoryview, raw_size: int) -> bool:
    unpacker = zlib.decompressobj()
    head = unpacker.decompress(packed, _PEEK_BYTES)
    if head[:1] != b"\x0a":
        return False
    size, at = varint(head, 1)
    if at + size + _PEEK_BYTES > raw_size:
        return False
    beyond = at + size + _PEEK_BYTES - len(head)
    if beyond > 0:
        head += unpacker.decompress(unpacker.unconsumed_tail, beyond)
    at += size
    if len(head) < at + _PEEK_BYTES or head[at] != 0x12:  # noqa: PLR2004 - field 2, bytes: a group
        return False
    size, at = varint(head, at + 1)
    return at + size == raw_size and head[at] >> 3 > 2  # noqa: PLR2004 - ways, relations, changesets


def check_features(header: bytes) -> None:
    """Refuse what the reader would have to know about, as the format asks."""
    for number, value in fields(header, (0, len(header))):
        if number == 4 and isinstance(value, tuple):  # noqa: PLR2004 - field numbers are the format's
            feature = header[slice(*value)].decode(errors="replace")
            if feature not in _READ:
                raise UnusualPbfError(f"the feature {feature}")
