"""Detections dealt to the tiles that read them: the one that owns each, and those in whose halo it lies.

`sql/tiles/members.sql` says the same as a join. A join a detection costs several times what the rest of the step does;
here a cell is looked up in a hash table, and most cells have one reader.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_CELL_BITS = 20  # of a column or row: cells of zoom 20 at most
_EMPTY = -1


class Readers(NamedTuple):
    """The tiles that read each cell: a hash table of cells, open addressing, whose entries are ranges of readers."""

    slots: Ints  # (n_slots, 3) key of a cell or -1, its first reader and their number; n_slots is a power of two
    batch: Ints  # (n,)
    box: Floats  # (n, 4) west, east, north and south in cells, without bounds for the owner


def index_readers(run: Ints, cell_x: Ints, cell_y: Ints, batch: Ints, box: Floats) -> tuple[Readers, Ints]:
    """Return the readers by cell, and the order that their rows are in.

    Parameters
    ----------
    run, cell_x, cell_y
        (n,) the cell that each row reads.
    batch
        (n,) batch of the tile that reads it.
    box
        (n, 4) west, east, north and south of what it reads, in cells.
    """
    key = _key(run, cell_x, cell_y)
    order = np.argsort(key, kind="stable")
    keys, starts, counts = np.unique(key[order], return_index=True, return_counts=True)
    slots = np.full((1 << max(4, int(2 * len(keys)).bit_length()), 3), _EMPTY, np.int64)
    _fill_slots(slots, keys, starts.astype(np.int64), counts.astype(np.int64))
    return Readers(slots, batch[order], np.ascontiguousarray(box[order])), order


def _key(run: Ints, cell_x: Ints, cell_y: Ints) -> Ints:
    return (run.astype(np.int64) << 2 * _CELL_BITS) | (cell_y.astype(np.int64) << _CELL_BITS) | cell_x.astype(np.int64)


@njit(cache=True, nogil=True, inline="always")
def _slot(key: int, mask: int) -> int:
    """Spread keys over slots (Fibonacci hashing, Knuth 6.4)."""
    return int(np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)) & mask)


@njit(cache=True, nogil=True)
def _fill_slots(slots: Ints, keys: Ints, starts: Ints, counts: Ints) -> None:
    mask = len(slots) - 1
    for cell in range(keys.size):
        slot = _slot(keys[cell], mask)
        while slots[slot, 0] != _EMPTY:
            slot = (slot + 1) & mask
        slots[slot, 0], slots[slot, 1], slots[slot, 2] = keys[cell], starts[cell], counts[cell]


@njit(cache=True, nogil=True, inline="always")
def _find(slots: Ints, key: int) -> int:
    """Return the slot of a cell, or an empty one."""
    mask = len(slots) - 1
    slot = _slot(key, mask)
    while slots[slot, 0] != key and slots[slot, 0] != _EMPTY:
        slot = (slot + 1) & mask
    return slot


@njit(cache=True, nogil=True)
def deal(run: Ints, x: Floats, y: Floats, readers: Readers, n_batches: int) -> tuple[Ints, Ints, Ints]:
    """Return which rows each batch takes.

    Parameters
    ----------
    run
        (n,) run of each detection.
    x, y
        (n,) column and row of its cell, with the fraction.
    readers
        From `index_readers`. A detection whose cell nobody reads is left out.
    n_batches
        Number of batches.

    Returns
    -------
    Row and reader of every copy, by batch and then in the order of the rows, and (n_batches + 1,) where each batch
    starts.
    """
    n = x.size
    first, count = np.empty(n, np.int64), np.empty(n, np.int32)
    start = np.zeros(n_batches + 1, np.int64)
    for i in range(n):
        key = int((np.int64(run[i]) << 2 * _CELL_BITS) | (np.int64(y[i]) << _CELL_BITS) | np.int64(x[i]))
        slot = _find(readers.slots, key)
        first[i], count[i] = readers.slots[slot, 1], max(readers.slots[slot, 2], 0)
        for r in range(first[i], first[i] + count[i]):
            if count[i] == 1 or _reads(readers.box, r, x[i], y[i]):  # a cell's only reader is its owner
                start[readers.batch[r] + 1] += 1
    for batch in range(n_batches):
        start[batch + 1] += start[batch]
    row, reader = np.empty(start[n_batches], np.int64), np.empty(start[n_batches], np.int64)
    at = start[:-1].copy()
    for i in range(n):
        for r in range(first[i], first[i] + count[i]):
            if count[i] == 1 or _reads(readers.box, r, x[i], y[i]):
                batch = readers.batch[r]
                row[at[batch]], reader[at[batch]] = i, r
                at[batch] += 1
    return row, reader, start


@njit(cache=True, nogil=True, inline="always")
def _reads(box: Floats, r: int, x: float, y: float) -> bool:
    return bool(box[r, 0] <= x <= box[r, 1] and box[r, 2] <= y <= box[r, 3])


@njit(cache=True, nogil=True)
def take_rows(  # noqa: PLR0917  (numba inlines no keyword-only arguments)
    dealt: NDArray[np.void],
    row: Ints,
    reader: Ints,
    by_reader: tuple[NDArray[np.int32], NDArray[np.bool_]],
    floats: tuple[Floats, ...],
    whole: tuple[Ints, ...],
    codes: tuple[NDArray[np.int32], ...],
) -> None:
    """Fill records with the columns of the rows dealt: one pass over them, and no copy of a column.

    Parameters
    ----------
    dealt
        (m,) records to fill: `lon`, `lat`, `var_m2`, `class_confidence`, `track_id`, `t_first_us`, `t_last_us`,
        `tile_code`, `pass_code`, `class_code`, `is_owned`.
    row, reader
        (m,) from `deal`.
    by_reader
        Tile of every reader, and whether it owns the cell.
    floats, whole, codes
        The columns of the rows, in the order of the records.
    """
    tile, is_owned = by_reader
    for i in range(row.size):
        r = row[i]
        record = dealt[i]
        record.lon, record.lat = floats[0][r], floats[1][r]
        record.var_m2, record.class_confidence = floats[2][r], floats[3][r]
        record.track_id, record.t_first_us, record.t_last_us = whole[0][r], whole[1][r], whole[2][r]
        record.pass_code, record.class_code = codes[0][r], codes[1][r]
        record.tile_code, record.is_owned = tile[reader[i]], is_owned[reader[i]]
