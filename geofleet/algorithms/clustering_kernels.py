"""Compiled parts of DBSCAN: points sorted into square cells, cores, connected cells, borders.

A cell's side is just under eps / √2, so that two points of one cell are always neighbours: a cell with min_samples
points holds only cores, and its cores are one cluster. Cells are sorted by group, row and column; the cells that can
hold a neighbour of a point lie in five rows, two columns to either side, and are found by five cursors that only move
forward. Work grows linearly with the points, however many share a cell.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.compiled import inlined_kernel, kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]

REACH = 2  # cells to either side that can hold a neighbour: eps / side < 1.5
N_ROWS = 2 * REACH + 1
_DIGIT_BITS = 11
_DIGITS = 1 << _DIGIT_BITS
_KEY_BITS = 63  # of a non-negative int64
_SMALL_PAIR = 256  # pairs of points that are cheaper to try than to bound


class Cells(NamedTuple):
    """Points sorted by cell. `first[c]:first[c + 1]` are the points of cell c, `order` their places in the input."""

    coords: tuple[Floats, ...]
    order: Ints
    first: Ints
    window: NDArray[np.int32]  # (n_cells, 5, 2) half-open ranges of the cells that can hold a neighbour, one a row


@kernel
def radix_argsort(keys: Ints, order: Ints) -> Ints:
    """Sort `order` stably by non-negative `keys`, eleven bits at a time.

    Calling it with the least significant key first and the result of one call as `order` of the next sorts by several.
    """
    n = order.size
    largest = keys.max() if n else np.int64(0)
    source, target = order.copy(), np.empty_like(order)
    count = np.empty(_DIGITS + 1, np.int64)
    shift = 0
    while shift < _KEY_BITS and (largest >> shift) > 0:
        count[:] = 0
        for i in range(n):
            count[((keys[source[i]] >> shift) & (_DIGITS - 1)) + 1] += 1
        for digit in range(_DIGITS):
            count[digit + 1] += count[digit]
        for i in range(n):
            digit = (keys[source[i]] >> shift) & (_DIGITS - 1)
            target[count[digit]] = source[i]
            count[digit] += 1
        source, target = target, source
        shift += _DIGIT_BITS
    return source


@kernel
def is_in_order(major: Ints, minor: Ints) -> bool:
    """Return whether rows are sorted by two keys."""
    for i in range(1, major.size):
        if major[i] < major[i - 1] or (major[i] == major[i - 1] and minor[i] < minor[i - 1]):
            return False
    return True


@kernel
def take_axes(coords: Floats, order: Ints) -> Floats:
    """Return the coordinates (n, d) of points in an order, axis by axis: (d, n)."""
    axes = np.empty((coords.shape[1], order.size))
    for i in range(order.size):
        for axis in range(coords.shape[1]):
            axes[axis, i] = coords[order[i], axis]
    return axes


@kernel
def cell_starts(keys: Ints, order: Ints) -> Ints:
    """Return where each run of equal keys starts in `order`, and the number of points at the end."""
    first = np.empty(order.size + 1, np.int64)
    n_cells = 0
    for i in range(order.size):
        if i == 0 or keys[order[i]] != keys[order[i - 1]]:
            first[n_cells] = i
            n_cells += 1
    first[n_cells] = order.size
    return first[: n_cells + 1].copy()


@kernel
def cell_windows(cell_keys: Ints, row_stride: int) -> NDArray[np.int32]:
    """Return, for every cell and each of five rows, the half-open range of cells within two columns."""
    n_cells = cell_keys.size
    window = np.empty((n_cells, N_ROWS, 2), np.int32)
    for row in range(N_ROWS):
        low = high = 0
        for cell in range(n_cells):
            centre = cell_keys[cell] + (row - REACH) * row_stride
            while low < n_cells and cell_keys[low] < centre - REACH:
                low += 1
            while high < n_cells and cell_keys[high] <= centre + REACH:
                high += 1
            window[cell, row, 0] = low
            window[cell, row, 1] = high
    return window


@inlined_kernel
def _sq_distance(coords: tuple[Floats, ...], i: int, j: int) -> float:
    total = 0.0
    for axis in coords:
        total += (axis[i] - axis[j]) ** 2
    return total


@kernel
def _has_neighbours(cells: Cells, cell: int, i: int, sq_eps: float, min_samples: int) -> bool:
    """Return whether point i of a cell with fewer than min_samples points has that many neighbours, itself included."""
    n = cells.first[cell + 1] - cells.first[cell]
    for row in range(N_ROWS):
        for other in range(cells.window[cell, row, 0], cells.window[cell, row, 1]):
            if other == cell:
                continue
            for j in range(cells.first[other], cells.first[other + 1]):
                if _sq_distance(cells.coords, i, j) <= sq_eps:
                    n += 1
                    if n >= min_samples:
                        return True
    return False


@kernel
def find_cores(cells: Cells, sq_eps: float, min_samples: int) -> Flags:
    """Return which points, in cell order, have min_samples within eps, themselves included."""
    core = np.zeros(cells.order.size, np.bool_)
    for cell in range(cells.first.size - 1):
        a, b = cells.first[cell], cells.first[cell + 1]
        if b - a >= min_samples:
            core[a:b] = True
        else:
            for i in range(a, b):
                core[i] = _has_neighbours(cells, cell, i, sq_eps, min_samples)
    return core


@kernel
def count_neighbours(cells: Cells, sq_eps: float) -> Ints:
    """Return how many points, in cell order, each has within eps, itself included."""
    n = np.empty(cells.order.size, np.int64)
    for cell in range(cells.first.size - 1):
        n[cells.first[cell] : cells.first[cell + 1]] = cells.first[cell + 1] - cells.first[cell]
    for cell in range(cells.first.size - 1):
        for row in range(REACH, N_ROWS):  # rows above: every pair of cells is seen once
            for other in range(max(cells.window[cell, row, 0], cell + 1), cells.window[cell, row, 1]):
                for i in range(cells.first[cell], cells.first[cell + 1]):
                    for j in range(cells.first[other], cells.first[other + 1]):
                        if _sq_distance(cells.coords, i, j) <= sq_eps:
                            n[i] += 1
                            n[j] += 1
    return n


@kernel
def largest_near(cells: Cells, sq_eps: float, values: Ints) -> Ints:
    """Return, in cell order, the largest value of a point within eps of each, itself included."""
    largest = np.empty_like(values)
    n_cells = cells.first.size - 1
    of_cell = np.empty(n_cells, np.int64)
    for cell in range(n_cells):
        of_cell[cell] = values[cells.first[cell] : cells.first[cell + 1]].max()
    for cell in range(n_cells):
        for i in range(cells.first[cell], cells.first[cell + 1]):
            best = of_cell[cell]
            for row in range(N_ROWS):
                for other in range(cells.window[cell, row, 0], cells.window[cell, row, 1]):
                    if of_cell[other] <= best:
                        continue
                    for j in range(cells.first[other], cells.first[other + 1]):
                        if values[j] > best and _sq_distance(cells.coords, i, j) <= sq_eps:
                            best = values[j]
            largest[i] = best
    return largest


@kernel
def _root(parent: NDArray[np.int32], cell: int) -> int:
    while parent[cell] != cell:
        parent[cell] = parent[parent[cell]]
        cell = parent[cell]
    return cell


@kernel
def _near_box(cells: Cells, points: Ints, others: Ints, sq_eps: float) -> Ints:
    """Return those of `points` that are within eps of the bounding box of `others`."""
    sq_gap = np.zeros(points.size)
    for axis in cells.coords:
        low = high = axis[others[0]]
        for j in others:
            low, high = min(low, axis[j]), max(high, axis[j])
        for k in range(points.size):
            value = axis[points[k]]
            sq_gap[k] += max(low - value, value - high, 0.0) ** 2
    # a hair of slack: the gap to a box and the distance to its corner are rounded differently
    return points[sq_gap <= sq_eps * (1 + 1e-12)]


@kernel
def _are_linked(cells: Cells, core: Flags, a: int, b: int, sq_eps: float) -> bool:
    """Return whether a core of cell a is within eps of a core of cell b."""
    first = cells.first
    if (first[a + 1] - first[a]) * (first[b + 1] - first[b]) <= _SMALL_PAIR:
        for i in range(first[a], first[a + 1]):
            if core[i]:
                for j in range(first[b], first[b + 1]):
                    if core[j] and _sq_distance(cells.coords, i, j) <= sq_eps:
                        return True
        return False
    mine = np.arange(first[a], first[a + 1])[core[first[a] : first[a + 1]]]
    yours = np.arange(first[b], first[b + 1])[core[first[b] : first[b + 1]]]
    mine = _near_box(cells, mine, yours, sq_eps)
    if mine.size:
        yours = _near_box(cells, yours, mine, sq_eps)
    for i in mine:
        for j in yours:
            if _sq_distance(cells.coords, i, j) <= sq_eps:
                return True
    return False


@kernel
def _connect(cells: Cells, core: Flags, has_core: Flags, sq_eps: float, parent: NDArray[np.int32]) -> None:
    """Join the clusters of neighbouring cells: cells that touch, or the others within reach."""
    for cell in range(has_core.size):
        if not has_core[cell]:
            continue
        for row in range(REACH, N_ROWS):  # rows above: every pair of cells is seen once
            low, high = cells.window[cell, row, 0], cells.window[cell, row, 1]
            for other in range(low, high):
                if other <= cell or not has_core[other]:
                    continue
                a, b = _root(parent, cell), _root(parent, other)
                if a != b and _are_linked(cells, core, cell, other, sq_eps):
                    parent[max(a, b)] = min(a, b)


@kernel
def number_clusters(cells: Cells, core: Flags, sq_eps: float) -> NDArray[np.int32]:
    """Return the cluster of every cell, -1 where there is no core.

    Clusters are numbered in the order of their first cores, as scikit-learn numbers them.
    """
    n_cells = cells.first.size - 1
    parent = np.arange(n_cells).astype(np.int32)
    has_core = np.zeros(n_cells, np.bool_)
    for cell in range(n_cells):
        has_core[cell] = core[cells.first[cell] : cells.first[cell + 1]].any()
    _connect(cells, core, has_core, sq_eps, parent)
    leader = np.full(n_cells, cells.order.size, np.int64)
    for cell in range(n_cells):
        if has_core[cell]:
            root = _root(parent, cell)
            for i in range(cells.first[cell], cells.first[cell + 1]):
                if core[i]:
                    leader[root] = min(leader[root], cells.order[i])
    roots = np.flatnonzero(leader < cells.order.size)
    roots = roots[np.argsort(leader[roots])]
    number = np.full(n_cells, -1, np.int32)
    for k in range(roots.size):
        number[roots[k]] = k
    cluster = np.full(n_cells, -1, np.int32)
    for cell in range(n_cells):
        if has_core[cell]:
            cluster[cell] = number[_root(parent, cell)]
    return cluster


@kernel
def _adjacent_clusters(  # noqa: PLR0917  (numba inlines no keyword-only arguments)
    cells: Cells, core: Flags, cluster: NDArray[np.int32], cell: int, i: int, sq_eps: float, found: Ints
) -> int:
    """Write the distinct clusters with a core within eps of a point into `found`, return how many."""
    n = 0
    for row in range(N_ROWS):
        for other in range(cells.window[cell, row, 0], cells.window[cell, row, 1]):
            label = cluster[other]
            if label < 0 or (found[:n] == label).any():
                continue
            for j in range(cells.first[other], cells.first[other + 1]):
                if core[j] and _sq_distance(cells.coords, i, j) <= sq_eps:
                    found[n] = label
                    n += 1
                    break
    return n


@kernel
def label_points(
    cells: Cells, core: Flags, cluster: NDArray[np.int32], sq_eps: float
) -> tuple[Ints, Flags, Ints, Ints]:
    """Return, in input order, labels and core flags, and the border points that several clusters reach.

    A border point belongs to the reaching cluster with the lowest number. The last two arrays list every
    (point, cluster) of the points that more than one cluster reaches.
    """
    n = cells.order.size
    labels, is_core = np.full(n, -1, np.int64), np.zeros(n, np.bool_)
    point, reached = [np.int64(0) for _ in range(0)], [np.int64(0) for _ in range(0)]
    found = np.empty(N_ROWS * N_ROWS, np.int64)
    for cell in range(cells.first.size - 1):
        for i in range(cells.first[cell], cells.first[cell + 1]):
            at = cells.order[i]
            if core[i]:
                labels[at], is_core[at] = cluster[cell], True
                continue
            n_found = _adjacent_clusters(cells, core, cluster, cell, i, sq_eps, found)
            if n_found:
                labels[at] = found[:n_found].min()
            if n_found > 1:
                for k in range(n_found):
                    point.append(at)
                    reached.append(found[k])
    return labels, is_core, np.array(point, dtype=np.int64), np.array(reached, dtype=np.int64)


@kernel
def join_parts(order: Ints, point: Ints, cluster: Ints, is_core: Flags) -> tuple[Ints, Ints]:
    """Join clusters that share a core.

    Parameters
    ----------
    order
        (n,) rows sorted by point.
    point, cluster, is_core
        (n,) of each row: its point, the cluster that it is in, whether it is a core.

    Returns
    -------
    Of each cluster the lowest number of those that it is joined with, and of each lowest number its first core.
    """
    n_clusters = cluster.max() + 1 if cluster.size else np.int64(0)
    parent = np.arange(n_clusters).astype(np.int32)
    last = np.int64(-1)
    for row in order:
        if is_core[row]:
            if last >= 0 and point[last] == point[row]:
                a, b = _root(parent, cluster[last]), _root(parent, cluster[row])
                parent[max(a, b)] = min(a, b)
            last = row
    joined, first_core = np.empty(n_clusters, np.int64), np.full(n_clusters, np.iinfo(np.int64).max)
    for k in range(n_clusters):
        joined[k] = _root(parent, k)
    for row in order:
        if is_core[row]:
            root = joined[cluster[row]]
            first_core[root] = min(first_core[root], point[row])
    return joined, first_core
