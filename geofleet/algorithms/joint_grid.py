"""Things filed by the cell of a plane that they lie in: what is near a place stands in the nine cells around it.

Only cells that some place lies in or beside exist, so a long road costs its length and not its extent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

NOTHING = -1


class Grid(NamedTuple):
    """Cells, and a list of things a cell."""

    keys: Ints  # (n_cells,) row * width + column, sorted
    low: Floats  # (2,) where rows and columns are counted from
    width: int
    size_m: float
    head: Ints  # (n_cells,) first thing of each cell
    cell: Ints  # (n_things,) where each thing is filed, `NOTHING` for nowhere
    following: Ints  # (n_things,) the next thing in its cell, `NOTHING` at the end


def grid_around(xy_m: Floats, size_m: float, n_things: int) -> Grid:
    """Return an empty grid of the cells in and beside which places (n, 2) lie, for things numbered below `n_things`."""
    low = xy_m.min(axis=0) - 2 * size_m
    cell = np.floor((xy_m - low) / size_m).astype(np.int64)
    width = int(cell[:, 0].max()) + 3
    around = np.array([row * width + column for row in (-1, 0, 1) for column in (-1, 0, 1)])
    keys = np.unique(np.unique(cell[:, 1] * width + cell[:, 0])[:, None] + around)
    nowhere = np.full((2, n_things), NOTHING)
    return Grid(keys, low, width, size_m, np.full(len(keys), NOTHING), nowhere[0], nowhere[1])


@kernel
def first_from(sorted_keys: Ints, key: int) -> int:
    """Return where the first key stands that is not below this one."""
    low, high = 0, sorted_keys.size
    while low < high:
        middle = (low + high) // 2
        if sorted_keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@kernel
def file_thing(grid: Grid, thing: int, east: float, north: float) -> None:
    """File a thing under the cell of its place, and take it from where it stood.

    Far from all places it goes under the next cell that there is: nobody looks for it there, and nobody will miss it.
    """
    column = int(np.floor((east - grid.low[0]) / grid.size_m))
    row = int(np.floor((north - grid.low[1]) / grid.size_m))
    at = min(first_from(grid.keys, row * grid.width + column), grid.keys.size - 1)
    if grid.cell[thing] == at:
        return
    if grid.cell[thing] != NOTHING:
        unfile_thing(grid, thing)
    grid.cell[thing] = at
    grid.following[thing] = grid.head[at]
    grid.head[at] = thing


@kernel
def unfile_thing(grid: Grid, thing: int) -> None:
    """Take a thing out of its cell."""
    at = grid.cell[thing]
    grid.cell[thing] = NOTHING
    if grid.head[at] == thing:
        grid.head[at] = grid.following[thing]
        return
    other = grid.head[at]
    while grid.following[other] != thing:
        other = grid.following[other]
    grid.following[other] = grid.following[thing]


@kernel
def things_around(grid: Grid, east: float, north: float, found: Ints) -> tuple[Ints, int]:
    """Return the things in the nine cells around a place, and their number: in `found`, or in a longer array."""
    column = int(np.floor((east - grid.low[0]) / grid.size_m))  # floored once: neighbours are whole steps away
    row = int(np.floor((north - grid.low[1]) / grid.size_m))
    n = 0
    for beside in range(row - 1, row + 2):
        key = beside * grid.width + column
        at = first_from(grid.keys, key - 1)
        while at < grid.keys.size and grid.keys[at] <= key + 1:
            thing = grid.head[at]
            while thing != NOTHING:
                if n == found.size:
                    found = longer(found)
                found[n] = thing
                n += 1
                thing = grid.following[thing]
            at += 1
    return found, n


@kernel
def longer(values: Ints) -> Ints:
    """Return the values with room for as many more."""
    grown = np.empty(2 * values.size, np.int64)
    for at in range(values.size):
        grown[at] = values[at]
    return grown
