"""What a table of detections holds, counted block by block: its passes, repeated keys, and detections a cell.

`sql/aggregate/reporting` and `sql/tiles/counts` say the same; here texts are numbers and tables of counts are arrays.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.compiled import kernel
from geofleet.algorithms.dealing import CELL_BITS, EMPTY, cell_key, places, slot_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Codes = NDArray[np.int32]

MAX_LON_DEG, MAX_LAT_DEG = 180.0, 85.05  # as `sql/aggregate/judged` has them
_WORD_BITS = 64
_FIRST_SLOTS = 1 << 12


@kernel
def number_combinations(outer: Codes, middle: Codes, inner: Codes, number: Codes) -> tuple[Codes, Ints]:
    """Give the combinations of three codes numbers in the order in which they appear.

    Parameters
    ----------
    outer, middle, inner
        (n,) codes from 0.
    number
        (n_outer, n_middle, n_inner) of -1, which is filled.

    Returns
    -------
    (n,) the number of each row's combination, and (n_combinations,) the first row of each.
    """
    of_row, first = np.empty(outer.size, np.int32), np.empty(outer.size, np.int64)
    n = 0
    for i in range(outer.size):
        found = number[outer[i], middle[i], inner[i]]
        if found < 0:
            found = np.int32(n)
            number[outer[i], middle[i], inner[i]] = found
            first[n] = i
            n += 1
        of_row[i] = found
    return of_row, first[:n].copy()


@kernel
def are_placed(lon_deg: Floats, lat_deg: Floats) -> bool:
    """Return whether all positions are finite and where tiles can be; NaN is not."""
    good = True
    for i in range(lon_deg.size):
        good &= abs(lon_deg[i]) <= MAX_LON_DEG and abs(lat_deg[i]) <= MAX_LAT_DEG
    return good


@kernel
def mark_ids(bits: NDArray[np.uint64], pass_number: Codes, track_id: Ints, low: int) -> bool:
    """Mark the track ids of every pass, and return whether none was marked before.

    Parameters
    ----------
    bits
        (n_passes, n_words) a bit a track id, from `low` on.
    pass_number, track_id
        (n,) of every detection.
    low
        The smallest id.
    """
    are_new = True
    for i in range(track_id.size):
        place_ = track_id[i] - low
        word, bit = place_ // _WORD_BITS, np.uint64(1) << np.uint64(place_ % _WORD_BITS)
        are_new &= (bits[pass_number[i], word] & bit) == 0
        bits[pass_number[i], word] |= bit
    return are_new


class CellCounts:
    """Detections a cell, of the cells that have any: a hash table that grows.

    Parameters
    ----------
    fine_zoom
        Zoom of the cells.
    """

    def __init__(self, fine_zoom: int) -> None:
        self._side = 1 << fine_zoom
        self._slots = np.full((_FIRST_SLOTS, 2), EMPTY, np.int64)
        self._n_cells = 0

    def add(self, run: Codes, lon_deg: Floats, lat_deg: Floats) -> None:
        """Count detections; `run` is the number of the run of each."""
        x, y = places(lon_deg, lat_deg, self._side)
        done = 0
        while done < run.size:
            done, self._n_cells = _count(self._slots, self._n_cells, run, x, y, done)
            if done < run.size:
                self._slots = _grown(self._slots)

    def cells(self) -> tuple[Ints, Ints, Ints, Ints]:
        """Return run, column, row and number of detections of every cell, in the order of the first three."""
        keys, counts = self._slots[self._slots[:, 0] != EMPTY].T
        order = np.argsort(keys)
        mask = (1 << CELL_BITS) - 1
        keys = keys[order]
        return keys >> 2 * CELL_BITS, keys & mask, (keys >> CELL_BITS) & mask, counts[order]


@kernel
def _count(  # noqa: PLR0917  (numba inlines no keyword-only arguments)
    slots: Ints, n_cells: int, run: Codes, x: Floats, y: Floats, begin: int
) -> tuple[int, int]:
    """Count from row `begin` on until the table is half full; return the first row not counted, and the cells found."""
    mask = len(slots) - 1
    for i in range(begin, run.size):
        if 2 * n_cells > mask:
            return i, n_cells
        key = cell_key(run[i], math.floor(x[i]), math.floor(y[i]))
        slot = slot_of(key, mask)
        while slots[slot, 0] != key and slots[slot, 0] != EMPTY:
            slot = (slot + 1) & mask
        if slots[slot, 0] == EMPTY:
            slots[slot, 0], slots[slot, 1] = key, 0
            n_cells += 1
        slots[slot, 1] += 1
    return run.size, n_cells


@kernel
def _grown(slots: Ints) -> Ints:
    """Return the table with four times the slots."""
    larger = np.full((4 * len(slots), 2), EMPTY, np.int64)
    mask = len(larger) - 1
    for old in range(len(slots)):
        if slots[old, 0] != EMPTY:
            slot = slot_of(slots[old, 0], mask)
            while larger[slot, 0] != EMPTY:
                slot = (slot + 1) & mask
            larger[slot, 0], larger[slot, 1] = slots[old, 0], slots[old, 1]
    return larger


@kernel
def mean_variances(sigma_e_m: Floats, sigma_n_m: Floats, n_frames: Ints) -> Floats:
    """Return the variance of the mean over the frames of each detection, an axis, m², as `sql/aggregate/judged` does.

    What is missing widens it: a spread that is not finite counts as 1 m, frames below one as one.
    """
    variance = np.empty(sigma_e_m.size)
    for i in range(variance.size):
        spread = sigma_e_m[i] * sigma_e_m[i] + sigma_n_m[i] * sigma_n_m[i]
        variance[i] = (spread / 2 if math.isfinite(spread) else 1.0) / max(n_frames[i], 1)
    return variance
