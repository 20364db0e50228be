"""The dense nodes of PBF blocks, those of several decoded at once: https://wiki.openstreetmap.org/wiki/PBF_Format.

The time of an array operation on one block's eight thousand nodes is as much the call's as the numbers'; and threads
that share the interpreter's lock hand it over at every call.
"""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from geofleet.formats.osm_strings import Strings
from geofleet.formats.protobuf import DamagedPbfError, deltas_of, varints_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from geofleet.formats.osm_pbf import Block

    Ints = NDArray[np.int64]

__all__ = ["DenseNodes"]

_ID, _LAT, _LON, _TAGS = 1, 8, 9, 10  # field numbers of dense nodes
_GRANULARITY, _LAT_OFFSET, _LON_OFFSET = 17, 19, 20  # of a block
_NANO_PER_E7 = 100


class DenseNodes:
    """Nodes of some blocks in the order of the file, decoded as far as they are asked for.

    Parameters
    ----------
    blocks
        The blocks.
    tagged
        Leave out groups of which no node has tags.

    Raises
    ------
    UnusualPbfError
        Nodes are not stored densely.
    """

    def __init__(self, blocks: Sequence[Block], *, tagged: bool = False) -> None:
        self._blocks = blocks
        groups = [(n, packed) for n, block in enumerate(blocks) for packed in block.dense_groups()]
        groups = [(n, packed) for n, packed in groups if packed.get(_TAGS) or not tagged]
        self._block_of = np.array([n for n, _ in groups], np.int64)
        self._packed = [packed for _, packed in groups]

    @cached_property
    def strings(self) -> Strings:
        """The string tables of all blocks."""
        return Strings.of([block.string_table for block in self._blocks])

    @cached_property
    def n_nodes(self) -> Ints:
        """How many nodes each group has."""
        ids = [np.frombuffer(packed.get(_ID, b""), np.uint8) for packed in self._packed]
        return np.array([np.count_nonzero(one < 0x80) for one in ids], np.int64)  # noqa: PLR2004 - last bytes

    def tags(self) -> tuple[Ints, Ints]:
        """Return numbers of strings, key and value in turn, and where the tags of each node end.

        There stands the first string of a block, which is none of a tag.
        """
        numbers, start = varints_of([packed[_TAGS] for packed in self._packed])
        ends = np.flatnonzero(numbers == 0)
        if len(ends) != self.n_nodes.sum() or (ends[np.cumsum(self.n_nodes) - 1] != start[1:] - 1).any():
            raise DamagedPbfError("tags and nodes differ in number")
        if self._packed:
            n_strings = np.diff(self.strings.first)[self._block_of]
            if (np.maximum.reduceat(numbers.view(np.uint64), start[:-1]) >= n_strings.astype(np.uint64)).any():
                raise DamagedPbfError("a tag out of the range of its strings")
        return numbers + np.repeat(self.strings.first[self._block_of], np.diff(start)), ends

    @cached_property
    def _columns(self) -> Ints:
        parts = [packed.get(column, b"") for column in (_ID, _LON, _LAT) for packed in self._packed]
        numbers, start = deltas_of(parts)
        if not np.array_equal(np.diff(start), np.tile(self.n_nodes, 3)):
            raise DamagedPbfError("ids and positions differ in number")
        return numbers.reshape(3, -1)

    @property
    def node_id(self) -> Ints:
        """Ids, shape (n,)."""
        ids: Ints = self._columns[0]
        return ids

    def lonlat_e7(self, rows: Ints) -> tuple[Ints, Ints]:
        """Return the positions of some nodes in 1e-7 degrees, rounded towards zero as libosmium does."""
        block_of = self._block_of[np.searchsorted(np.cumsum(self.n_nodes), rows, side="right")]
        granularity, lon, lat = (
            np.array([block.number(field) for block in self._blocks], np.int64)[block_of]
            for field in (_GRANULARITY, _LON_OFFSET, _LAT_OFFSET)
        )
        return _e7(lon + granularity * self._columns[1, rows]), _e7(lat + granularity * self._columns[2, rows])


def _e7(nano: Ints) -> Ints:
    return np.where(nano < 0, -(-nano // _NANO_PER_E7), nano // _NANO_PER_E7)
