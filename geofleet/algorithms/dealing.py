"""Detections dealt to the tiles that read them: the one that owns each, and those in whose halo it lies.

`sql/tiles/members.sql` says the same as a join. A join a detection costs several times what the rest of the step does;
here a cell is looked up in a hash table, and most cells have few readers.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.compiled import inlined_kernel, kernel

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Rows32 = NDArray[np.int32]

CELL_BITS = 20  # of a column or row: cells of zoom 20 at most
_COUNT_BITS = 20  # of the number of readers of a cell
EMPTY = -1
_EDGE = 1e-6  # cells: two libraries' logarithms differ by less
_READER = np.dtype(
    [
        *((name, np.float64) for name in ("west", "east", "north", "south")),
        *((name, np.int32) for name in ("batch", "tile_code")),
        ("is_owned", np.bool_),
    ],
    align=True,
)


class Readers(NamedTuple):
    """The tiles that read each cell: a hash table of cells, open addressing, whose entries are ranges of readers."""

    slots: Ints  # (n_slots, 2) key of a cell or -1, and its readers: first << 20 | number; n_slots is a power of two
    reader: NDArray[
        np.void
    ]  # (n,) box in cells, without bounds for the owner; batch and tile; whether it owns the cell
    side: int  # cells along the equator
    most: int  # readers of any cell


def index_readers(run: Ints, columns: Mapping[str, NDArray[np.generic]], fine_zoom: int) -> Readers:
    """Return the readers by cell.

    Parameters
    ----------
    run
        (n,) number of the run of each row.
    columns
        The columns of `sql/tiles/readers`, (n,) each.
    fine_zoom
        Zoom of the cells.
    """
    cell_x, cell_y = columns["cell_x"].astype(np.int64), columns["cell_y"].astype(np.int64)
    key = (run << 2 * CELL_BITS) | (cell_y << CELL_BITS) | cell_x
    order = np.argsort(key, kind="stable")
    reader = np.empty(key.size, _READER)
    for name in _READER.names or ():
        reader[name] = columns[name][order]
    keys, starts, counts = np.unique(key[order], return_index=True, return_counts=True)
    slots = np.full((1 << max(4, int(2 * len(keys)).bit_length()), 2), EMPTY, np.int64)
    _fill_slots(slots, keys, (starts << _COUNT_BITS) | counts)
    return Readers(slots, reader, 1 << fine_zoom, int(counts.max(initial=0)))


@inlined_kernel
def cell_key(run: int, cell_x: int, cell_y: int) -> int:
    """Return a number for a cell of a run; they sort by run, row and column."""
    return int((np.int64(run) << 2 * CELL_BITS) | (np.int64(cell_y) << CELL_BITS) | np.int64(cell_x))


@inlined_kernel
def slot_of(key: int, mask: int) -> int:
    """Spread keys over slots (Fibonacci hashing, Knuth 6.4)."""
    return int(np.int64((np.uint64(key) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(20)) & mask)


@kernel
def _fill_slots(slots: Ints, keys: Ints, ranges: Ints) -> None:
    mask = len(slots) - 1
    for cell in range(keys.size):
        slot = slot_of(keys[cell], mask)
        while slots[slot, 0] != EMPTY:
            slot = (slot + 1) & mask
        slots[slot, 0], slots[slot, 1] = keys[cell], ranges[cell]


@inlined_kernel
def _find(slots: Ints, key: int) -> int:
    """Return the readers of a cell, -1 if there are none."""
    mask = len(slots) - 1
    slot = slot_of(key, mask)
    while slots[slot, 0] != key and slots[slot, 0] != EMPTY:
        slot = (slot + 1) & mask
    return int(slots[slot, 1])


@kernel
def _find_beside(slots: Ints, key: int, x: float, y: float) -> int:
    """Return the readers of the cell on whose edge a point lies that another logarithm puts into the next one."""
    for step_x in range(-1, 2):
        for step_y in range(-1, 2):
            if math.floor(x + step_x * _EDGE) != math.floor(x) or math.floor(y + step_y * _EDGE) != math.floor(y):
                found = _find(slots, key + (step_y << CELL_BITS) + step_x)
                if found != EMPTY:
                    return found
    return EMPTY


@kernel
def places(lon_deg: Floats, lat_deg: Floats, side: int) -> tuple[Floats, Floats]:
    """Return column and row of the cell of each position, with the fraction, as `sql/tiles/located` does."""
    x, y = np.empty(lon_deg.size), np.empty(lon_deg.size)
    for i in range(lon_deg.size):
        x[i] = (0.0 if lon_deg[i] == 180.0 else lon_deg[i] + 180.0) / 360.0 * side  # noqa: PLR2004  (180 is -180)
        sine = math.sin(math.radians(lat_deg[i]))
        y[i] = (0.5 - math.log((1.0 + sine) / (1.0 - sine)) / (4.0 * math.pi)) * side
    return x, y


@kernel
def _find_all(slots: Ints, run: Ints, x: Floats, y: Floats) -> Ints:
    """Return the readers of the cell of each position, -1 if there are none."""
    found = np.empty(run.size, np.int64)
    for i in range(run.size):
        key = cell_key(run[i], math.floor(x[i]), math.floor(y[i]))
        found[i] = _find(slots, key)
        if found[i] == EMPTY:
            found[i] = _find_beside(slots, key, x[i], y[i])
    return found


@kernel
def deal(run: Ints, lon_deg: Floats, lat_deg: Floats, readers: Readers, n_batches: int) -> tuple[Rows32, Rows32, Ints]:
    """Return who reads which detection.

    Parameters
    ----------
    run
        (n,) run of each detection.
    lon_deg, lat_deg
        (n,) its position.
    readers
        From `index_readers`. A detection whose cell nobody reads is left out.
    n_batches
        Number of batches.

    Returns
    -------
    Detection and reader of every copy, in the order of the detections, and (n_batches + 1,) where each batch starts
    when they are sorted by batch.
    """
    # One loop after the other: where a branch is guessed wrong, what was begun of the next rows is lost.
    x, y = places(lon_deg, lat_deg, readers.side)
    found = _find_all(readers.slots, run, x, y)
    row, reader = np.empty(run.size * readers.most, np.int32), np.empty(run.size * readers.most, np.int32)
    start = np.zeros(n_batches + 1, np.int64)
    n = 0
    for i in range(run.size):
        first, count = found[i] >> _COUNT_BITS, max(found[i], 0) & ((1 << _COUNT_BITS) - 1)
        for r in range(first, first + count):
            one = readers.reader[r]
            if one.is_owned or (one.west <= x[i] <= one.east and one.north <= y[i] <= one.south):
                row[n], reader[n] = i, r
                n += 1
                start[one.batch + 1] += 1
    for batch in range(n_batches):
        start[batch + 1] += start[batch]
    return row[:n], reader[:n], start


@kernel
def take_rows(  # noqa: PLR0917  (numba inlines no keyword-only arguments)
    dealt: NDArray[np.void],
    row: Rows32,
    reader: Rows32,
    start: Ints,
    readers: Readers,
    floats: tuple[Floats, ...],
    whole: tuple[Ints, ...],
    codes: tuple[NDArray[np.int32], ...],
) -> None:
    """Fill records, by batch, with the columns of the rows dealt; in a batch they stay in the order of the rows.

    Columns are read in order and every batch is written in order, which caches like.

    Parameters
    ----------
    dealt
        (m,) records to fill: `lon`, `lat`, `var_m2`, `class_confidence`, `track_id`, `t_first_us`, `t_last_us`,
        `tile_code`, `pass_code`, `class_code`, `is_owned`.
    row, reader, start
        From `deal`.
    readers
        From `index_readers`.
    floats, whole, codes
        The columns of the rows, in the order of the records.
    """
    at = start.copy()
    for i in range(row.size):
        r, one = row[i], readers.reader[reader[i]]
        record = dealt[at[one.batch]]
        at[one.batch] += 1
        record.lon, record.lat = floats[0][r], floats[1][r]
        record.var_m2, record.class_confidence = floats[2][r], floats[3][r]
        record.track_id, record.t_first_us, record.t_last_us = whole[0][r], whole[1][r], whole[2][r]
        record.pass_code, record.class_code = codes[0][r], codes[1][r]
        record.tile_code, record.is_owned = one.tile_code, one.is_owned


@kernel
def unpack_rows(
    dealt: NDArray[np.void],
) -> tuple[Floats, Floats, Floats, Floats, Ints, Ints, Ints, Ints, Ints, Ints, NDArray[np.bool_]]:
    """Return the columns of records that `take_rows` filled, in the order of their fields; numbers are 64 bits wide."""
    n = dealt.size
    lon, lat, var_m2, confidence = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    track, t_first, t_last = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    pass_code, class_code, tile_code = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    is_owned = np.empty(n, np.bool_)
    for i in range(n):
        record = dealt[i]
        lon[i], lat[i] = record.lon, record.lat
        var_m2[i], confidence[i] = record.var_m2, record.class_confidence
        track[i], t_first[i], t_last[i] = record.track_id, record.t_first_us, record.t_last_us
        pass_code[i], class_code[i], tile_code[i] = record.pass_code, record.class_code, record.tile_code
        is_owned[i] = record.is_owned
    return lon, lat, var_m2, confidence, track, t_first, t_last, pass_code, class_code, tile_code, is_owned
