"""Sparse optimal assignment: rows take columns one-to-one, or stay out at a price.

Shortest augmenting paths with prices (the Hungarian method as Jonker and Volgenant run it, doi:10.1007/BF02278710) on a
graph that holds only the pairs worth considering. A row may always stay out, so no padding to a square is needed, and a
search never leaves its connected component of the graph: components are solved on their own by construction.
"""

from __future__ import annotations

from heapq import heappop, heappush
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.compiled import kernel
from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

NONE = -1


class _Graph(NamedTuple):
    """Candidate pairs by row (CSR), and what it costs each row to stay out."""

    start: Ints  # (n_rows + 1,)
    column: Ints  # (n_pairs,)
    cost: Floats  # (n_pairs,)
    skip_cost: Floats  # (n_rows,)


class _State(NamedTuple):
    """The assignment so far, and its prices: cost - row_price - column_price >= 0, and 0 on assigned pairs.

    A column that no row holds has price 0; `distance` is infinite between searches.
    """

    column_of_row: Ints
    row_of_column: Ints
    row_price: Floats
    column_price: Floats
    distance: Floats  # of a column from the row that the search started at
    reached_from: Ints  # the row that a column was reached from
    touched: Ints  # columns that the search gave a distance


class _Path(NamedTuple):
    """The shortest path of a search; it ends with `end_row` taking the free `end_column`, or staying out (NONE)."""

    length: float
    end_row: int
    end_column: int
    n_touched: int


def assign_sparse(start: Ints, column: Ints, cost: Floats, *, n_columns: int, skip_cost: Floats | float) -> Ints:
    """Assign rows to columns one-to-one so that the sum of the costs is least.

    Exact up to rounding, deterministic, and linear in the number of pairs when components are small.

    Parameters
    ----------
    start, column, cost
        Candidate pairs in CSR form: row i may take `column[start[i]:start[i + 1]]` at these costs (any finite numbers).
    n_columns
        Number of columns; a column that no row takes costs nothing.
    skip_cost
        What it costs a row to take no column, one number or one a row.

    Returns
    -------
    (n_rows,) the column of each row, -1 where the row stays out.

    Raises
    ------
    InputError
        When a cost is not finite, or the arrays do not describe a graph of this size.
    """
    skip_costs = np.broadcast_to(np.asarray(skip_cost, np.float64), (len(start) - 1,)).copy()
    n_bad = np.count_nonzero(~np.isfinite(cost)) + np.count_nonzero(~np.isfinite(skip_costs))
    if n_bad:
        raise InputError(f"{n_bad} costs are not finite", where="sparse assignment", todo="Leave such pairs out.")
    if not start[0] == 0 <= np.diff(start).min(initial=0) or not start[-1] == len(column) == len(cost):
        raise InputError("start, column and cost are not one CSR graph", where="sparse assignment")
    if len(column) and not 0 <= column.min() <= column.max() < n_columns:
        raise InputError(f"columns lie outside 0 … {n_columns - 1}", where="sparse assignment")
    assigned: Ints = _assign(_Graph(start, column, cost, skip_costs), n_columns)
    return assigned


@kernel
def _assign(graph: _Graph, n_columns: int) -> Ints:
    n_rows = graph.skip_cost.size
    state = _State(
        np.full(n_rows, NONE),
        np.full(n_columns, NONE),
        np.zeros(n_rows),
        np.zeros(n_columns),
        np.full(n_columns, np.inf),
        np.empty(n_columns, np.int64),
        np.empty(n_columns, np.int64),
    )
    for row in range(n_rows):
        _take_cheapest(graph, state, row)
    heap = [(0.0, 0) for _ in range(0)]
    for row in range(n_rows):
        if state.column_of_row[row] == NONE:
            path = _search(graph, state, row, heap)
            _reprice(state, row, path)
            _augment(state, row, path)
    return state.column_of_row


@kernel
def _take_cheapest(graph: _Graph, state: _State, row: int) -> None:
    """Price a row at its cheapest choice and give it that choice when it is free: all that a lone pair needs."""
    price, cheapest = graph.skip_cost[row], NONE
    for pair in range(graph.start[row], graph.start[row + 1]):
        if graph.cost[pair] < price:
            price, cheapest = graph.cost[pair], graph.column[pair]
    state.row_price[row] = price
    if cheapest != NONE and state.row_of_column[cheapest] == NONE:
        state.column_of_row[row], state.row_of_column[cheapest] = cheapest, row


@kernel
def _search(graph: _Graph, state: _State, source: int, heap: list[tuple[float, int]]) -> _Path:
    """Find the shortest alternating path from a row to a free column or to a row that then stays out (Dijkstra).

    Lengths are in reduced costs. Nothing as long as the best end found so far is followed, so a search stays local.
    """
    heap.clear()
    length, end_row, end_column, n_touched = np.inf, source, NONE, 0
    row, base = source, 0.0
    while base < length:
        stay_out = max(base, base + graph.skip_cost[row] - state.row_price[row])
        if stay_out < length:
            length, end_row, end_column = stay_out, row, NONE
        for pair in range(graph.start[row], graph.start[row + 1]):
            column = graph.column[pair]
            # Rounding may leave a reduced cost just below 0; the maximum keeps a settled column settled.
            through = max(base, base + graph.cost[pair] - state.row_price[row] - state.column_price[column])
            if through < length and through < state.distance[column]:
                if state.distance[column] == np.inf:
                    state.touched[n_touched] = column
                    n_touched += 1
                state.distance[column], state.reached_from[column] = through, row
                if state.row_of_column[column] == NONE:
                    length, end_row, end_column = through, row, column
                else:
                    heappush(heap, (through, column))
        base, row = _next_row(state, heap)
    return _Path(length, end_row, end_column, n_touched)


@kernel
def _next_row(state: _State, heap: list[tuple[float, int]]) -> tuple[float, int]:
    """Settle the nearest column and return its distance and the row that holds it; infinite when none is left."""
    while len(heap):
        distance, column = heappop(heap)
        if distance == state.distance[column]:  # otherwise a shorter way was pushed later
            return distance, state.row_of_column[column]
    return np.inf, NONE


@kernel
def _reprice(state: _State, source: int, path: _Path) -> None:
    """Move the prices of everything settled so that the path costs nothing and no reduced cost falls below 0."""
    state.row_price[source] += path.length
    for k in range(path.n_touched):
        column = state.touched[k]
        slack = path.length - state.distance[column]
        if slack > 0.0:
            state.column_price[column] -= slack
            state.row_price[state.row_of_column[column]] += slack
        state.distance[column] = np.inf


@kernel
def _augment(state: _State, source: int, path: _Path) -> None:
    """Shift every row of the path to its next column, from the end back to the source."""
    row, column = path.end_row, path.end_column
    while True:
        given_up = state.column_of_row[row]
        state.column_of_row[row] = column
        if column != NONE:
            state.row_of_column[column] = row
        if row == source:
            return
        row, column = state.reached_from[given_up], given_up
