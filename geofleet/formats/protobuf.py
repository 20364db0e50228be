"""The wire format that OpenStreetMap's PBF is made of: fields of a message, and packed numbers as arrays.

As in https://protobuf.dev/programming-guides/encoding/.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    Ints = NDArray[np.int64]

VARINT, BYTES = 0, 2
_MAX_VARINT_BYTES, _SHORT_BYTES = 10, 4
_FIXED_BYTES = {1: 8, 5: 4}

Span = tuple[int, int]


class DamagedPbfError(ValueError):
    """The bytes are not what the format allows; who reads a file tells where."""


def varints(packed: bytes) -> Ints:
    """Decode packed unsigned numbers, as 64 bits whose sign is the reader's affair."""
    return _decoded(np.frombuffer(packed, np.uint8))[0]


def varints_of(parts: Sequence[bytes]) -> tuple[Ints, Ints]:
    """Decode many packed sequences at once; return their numbers and where each begins, with the total last."""
    numbers, last = _decoded(np.frombuffer(b"".join(parts), np.uint8))
    ends = np.cumsum([0, *map(len, parts)])
    start = np.searchsorted(last, ends)
    filled = np.diff(ends) > 0
    if (last[start[1:][filled] - 1] != ends[1:][filled] - 1).any():
        raise DamagedPbfError("a number that does not end")
    return numbers, start


def deltas_of(parts: Sequence[bytes]) -> tuple[Ints, Ints]:
    """Decode packed, zigzag-coded differences to the numbers themselves, each sequence from zero; else `varints_of`."""
    coded, start = varints_of(parts)
    half = (coded.view(np.uint64) >> np.uint64(1)).view(np.int64)
    total = np.cumsum(half ^ -(coded & 1))
    inner = start[1:-1][start[1:-1] > 0]
    for first, last, before in zip(inner.tolist(), [*inner[1:].tolist(), len(total)], total[inner - 1], strict=False):
        total[first:last] -= before
    return total, start


def _decoded(raw: NDArray[np.uint8]) -> tuple[Ints, Ints]:
    """Return packed numbers, and where the last byte of each is."""
    ends = np.flatnonzero(raw < 0x80)  # noqa: PLR2004 - the top bit says that more bytes follow
    if len(raw) and (not len(ends) or ends[-1] != len(raw) - 1):
        raise DamagedPbfError("a number that does not end")
    if len(ends) == len(raw):
        return raw.astype(np.int64), ends
    starts = np.concatenate(([0], ends[:-1] + 1))
    n_more = ends - starts
    most = int(n_more.max())
    if most >= _MAX_VARINT_BYTES:
        raise DamagedPbfError("a number of more than ten bytes")
    value = _short(raw, starts, most)
    if most >= _SHORT_BYTES:
        rows = np.flatnonzero(n_more >= _SHORT_BYTES)
        value[rows] = _long(raw, starts[rows], n_more[rows])
    return value, ends


def _short(raw: NDArray[np.uint8], starts: Ints, most: int) -> Ints:
    """Return the numbers of up to four bytes: seven bits of each are laid together where they are, by twos."""
    bits = (raw & 0x7F).astype(np.uint32)
    goes_on = (raw >> 7).astype(np.uint32)
    bits[:-1] |= (bits[1:] << np.uint32(7)) * goes_on[:-1]
    if most > 1:
        bits[:-2] |= (bits[2:] << np.uint32(14)) * (goes_on[:-2] & goes_on[1:-1])
    return bits[starts].astype(np.int64)


def _long(raw: NDArray[np.uint8], starts: Ints, n_more: Ints) -> Ints:
    """Return numbers of any length, each from a row of its bytes."""
    place = np.arange(int(n_more.max()) + 1)
    bits = raw[np.minimum(starts[:, None] + place, len(raw) - 1)].astype(np.uint64) & np.uint64(0x7F)
    bits[place > n_more[:, None]] = 0
    joined: Ints = np.bitwise_or.reduce(bits << (7 * place).astype(np.uint64), axis=1).view(np.int64)
    return joined


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
