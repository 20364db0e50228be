"""The wire format that OpenStreetMap's PBF is made of: fields of a message, and packed numbers as arrays.

As in https://protobuf.dev/programming-guides/encoding/.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Ints = NDArray[np.int64]

VARINT, BYTES = 0, 2
_MAX_VARINT_BYTES = 10
_FIXED_BYTES = {1: 8, 5: 4}

Span = tuple[int, int]


class DamagedPbfError(ValueError):
    """The bytes are not what the format allows; who reads a file tells where."""


def varints(packed: bytes) -> Ints:
    """Decode packed unsigned numbers, as 64 bits whose sign is the reader's affair."""
    raw = np.frombuffer(packed, np.uint8)
    if not len(raw):
        return np.zeros(0, np.int64)
    ends = np.flatnonzero(raw < 0x80)  # noqa: PLR2004 - the top bit says that more bytes follow
    if not len(ends) or ends[-1] != len(raw) - 1:
        raise DamagedPbfError("a number that does not end")
    if len(ends) == len(raw):
        return raw.astype(np.int64)
    starts = np.concatenate(([0], ends[:-1] + 1))
    n_more = ends - starts
    most = int(n_more.max())
    if most >= _MAX_VARINT_BYTES:
        raise DamagedPbfError("a number of more than ten bytes")
    kind: Any = np.uint32 if most < 4 else np.uint64  # noqa: PLR2004 - 28 bits in four bytes
    low = raw & 0x7F
    value: NDArray[Any] = low[starts].astype(kind)
    n_more = n_more.astype(np.uint8)
    for place in range(1, most + 1):
        rows = np.flatnonzero(n_more >= place)
        value[rows] |= low[starts[rows] + place].astype(kind) << kind(7 * place)
    return value.astype(np.uint64).view(np.int64)


def varints_of(parts: list[bytes]) -> tuple[Ints, Ints]:
    """Decode many packed sequences at once; return their numbers and where each begins, with the total last."""
    joined = b"".join(parts)
    numbers = varints(joined)
    ends = np.cumsum([0, *map(len, parts)])
    is_last = np.frombuffer(joined, np.uint8) < 0x80  # noqa: PLR2004 - the top bit says that more bytes follow
    if not is_last[ends[1:][np.diff(ends) > 0] - 1].all():
        raise DamagedPbfError("a number that does not end")
    return numbers, np.concatenate(([0], np.cumsum(is_last)))[ends]


def deltas(packed: bytes) -> Ints:
    """Decode packed, zigzag-coded differences to the numbers themselves."""
    coded = varints(packed).view(np.uint64)
    half = (coded >> np.uint64(1)).view(np.int64)
    return np.cumsum(np.where(coded & np.uint64(1), ~half, half))


def fields(data: bytes, span: Span) -> Iterator[tuple[int, int | Span]]:
    """Yield number and value of the fields of a message: an integer, or where the bytes lie."""
    at, end = span
    while at < end:
        key, at = varint(data, at)
        wire = key & 7
        if wire == VARINT:
            value, at = varint(data, at)
            yield key >> 3, value
            continue
        size, at = varint(data, at) if wire == BYTES else (_FIXED_BYTES.get(wire, -1), at)
        if size < 0 or at + size > end:
            raise DamagedPbfError("a field beyond its end")
        yield key >> 3, (at, at + size)
        at += size


def varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a number and where it ends."""
    value = data[at]
    if value < 0x80:  # noqa: PLR2004 - the top bit says that more bytes follow
        return value, at + 1
    value &= 0x7F
    for shift in range(7, 7 * _MAX_VARINT_BYTES, 7):
        at += 1
        value |= (data[at] & 0x7F) << shift
        if data[at] < 0x80:  # noqa: PLR2004 - as above
            return value, at + 1
    raise DamagedPbfError("a number of more than ten bytes")


def signed(value: int) -> int:
    """Return a number of two's complement, 64 bits."""
    value &= (1 << 64) - 1
    return value - (1 << 64) if value >> 63 else value
