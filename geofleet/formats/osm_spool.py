"""Nodes with signs, put aside in a temporary file: a map of any size is sorted a piece at a time.

Nodes come in the order of the file and leave in that of their ids as text, which is the order of the table's key. In
between they are dealt out to stretches of ids, each small enough to be sorted in memory.
"""

from __future__ import annotations

import tempfile
import weakref
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Iterator
    from typing import IO

    from numpy.typing import NDArray

    Ints = NDArray[np.int64]
    Nodes = NDArray[np.void]

__all__ = ["NODE", "NodeSpool", "text_order"]

# Position in 1e-7 degrees as the file has it, and the number of the node's set of tags
NODE = np.dtype([("node_id", "<i8"), ("lon_e7", "<i4"), ("lat_e7", "<i4"), ("tagset", "<i4")])
_NODES_A_PIECE = 1 << 14
_NODES_AT_ONCE = 1 << 16
_IN_MEMORY_BYTES = 1 << 21
_ONE_OF = 64  # nodes whose id is remembered, to find stretches of about equal size
_DIGITS = 19


class NodeSpool:
    """A sequence of nodes that grows on disk."""

    def __init__(self) -> None:
        self.n_nodes = 0
        self._sample: list[NDArray[np.uint64]] = []
        self._file = _temporary(self)

    def append(self, nodes: Nodes) -> None:
        """Put nodes, of dtype `NODE`, at the end."""
        first = -self.n_nodes % _ONE_OF
        self._sample.append(_rank(nodes["node_id"][first::_ONE_OF]))
        self._file.seek(0, 2)
        self._file.write(nodes.tobytes())
        self.n_nodes += len(nodes)

    def chunks(self) -> Iterator[Nodes]:
        """Yield the nodes in the order in which they came, some ten thousand at a time."""
        for first in range(0, self.n_nodes, _NODES_AT_ONCE):
            yield _read(self._file, first, min(_NODES_AT_ONCE, self.n_nodes - first))

    def in_text_order(self) -> Iterator[Nodes]:
        """Yield the nodes sorted by the text of their ids, some ten thousand at a time; equal ids stay together."""
        n_pieces = -(-self.n_nodes // _NODES_A_PIECE)
        if n_pieces <= 1:
            pieces = iter([_read(self._file, 0, self.n_nodes)]) if self.n_nodes else iter(())
        else:
            known = np.sort(np.concatenate(self._sample))
            pieces = self._dealt(known[np.arange(1, n_pieces) * len(known) // n_pieces])
        for piece in pieces:
            yield piece[text_order(piece["node_id"])]

    def _dealt(self, borders: NDArray[np.uint64]) -> Iterator[Nodes]:
        """Yield the nodes between each two borders, in the order in which they came."""
        size = np.zeros(len(borders) + 1, np.int64)
        for chunk in self.chunks():
            size += np.bincount(_stretch(borders, chunk), minlength=len(size))
        start = np.cumsum(size) - size
        with tempfile.TemporaryFile(prefix="geofleet-") as dealt:
            at = start.copy()
            for chunk in self.chunks():
                stretch = _stretch(borders, chunk)
                ordered = chunk[np.argsort(stretch, kind="stable")]
                n_each = np.bincount(stretch)
                used = np.flatnonzero(n_each)
                for number, part in zip(used.tolist(), np.split(ordered, np.cumsum(n_each[used])[:-1]), strict=True):
                    dealt.seek(int(at[number]) * NODE.itemsize)
                    dealt.write(part.tobytes())
                    at[number] += len(part)
            for first, n_nodes in zip(start.tolist(), size.tolist(), strict=True):
                if n_nodes:
                    yield _read(dealt, first, n_nodes)


def text_order(number: Ints) -> Ints:
    """Return the order of ids as text that goes on with a hyphen: -3, 1, 12, 2, as `n12-0` comes before `n2-0`."""
    padded, digits = _padded(number)
    return np.lexsort((digits, padded, number >= 0)).astype(np.int64)


def _padded(number: Ints) -> tuple[NDArray[np.uint64], Ints]:
    """Return the absolute numbers with zeros behind, all equally long, and how many digits they had."""
    size = np.abs(number).astype(np.uint64)
    digits = np.searchsorted(np.array([10**k for k in range(1, _DIGITS)], np.uint64), size, side="right") + 1
    return size * np.power(np.uint64(10), (_DIGITS - digits).astype(np.uint64)), digits.astype(np.int64)


def _rank(number: Ints) -> NDArray[np.uint64]:
    """Return numbers that never fall in the order of the text, and are equal for equal ids."""
    return (_padded(number)[0] >> np.uint64(1)) + ((number >= 0).astype(np.uint64) << np.uint64(63))


def _stretch(borders: NDArray[np.uint64], nodes: Nodes) -> Ints:
    return np.searchsorted(borders, _rank(nodes["node_id"]), side="right").astype(np.int64)


def _temporary(owner: NodeSpool) -> IO[bytes]:
    """Return a file that is gone with its owner; small ones never reach the disk."""
    file: IO[bytes] = tempfile.SpooledTemporaryFile(_IN_MEMORY_BYTES, prefix="geofleet-")  # noqa: SIM115 - closed below
    weakref.finalize(owner, file.close)
    return file


def _read(file: IO[bytes], first: int, n_nodes: int) -> Nodes:
    file.seek(first * NODE.itemsize)
    return np.frombuffer(file.read(n_nodes * NODE.itemsize), NODE)
