"""How many passes a fleet needs for a target: found by doubling and halving, summed up over independent fleets."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from geofleet.algorithms.uncertainty import check_level, median_rank

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]


def passes_needed(meets: Callable[[int], bool], largest: int) -> int | None:
    """Return the number of passes at which a fleet meets its target and goes on to meet it; None above `largest`.

    Fleet sizes are doubled until one meets the target and so does twice its size (a lucky one does not count), then
    the gap to the last that did not is halved. What lies inside the gap is taken to be monotone.

    Parameters
    ----------
    meets
        Tells whether the first so many passes meet the target; asked once a size, about 2 log2(largest) sizes.
    largest
        Passes that there are.
    """
    asked: dict[int, bool] = {}

    def ask(size: int) -> bool:
        if size not in asked:
            asked[size] = meets(size)
        return asked[size]

    below, size = 0, 1
    while not (ask(size) and ask(min(2 * size, largest))):
        if size >= largest:
            return None
        below, size = size, min(2 * size, largest)
    while size - below > 1:
        middle = (below + size) // 2
        below, size = (below, middle) if ask(middle) else (middle, size)
    return size


@dataclass(frozen=True, slots=True)
class PassesNeeded:
    """Passes needed, over fleets; None stands for more than were tried.

    Parameters
    ----------
    typical
        Median over the fleets.
    low, high
        Interval of the median, order statistics; None and None where the fleets are too few for one.
    has_interval
        Whether they are enough.
    safe
        Passes by which a share `level` of the fleets simulated had met the target.
    n_reached, n_fleets
        Fleets that met it at all, of those simulated.
    level
        Of the interval, and the share of `safe`.
    """

    typical: int | None
    low: int | None
    high: int | None
    has_interval: bool
    safe: int | None
    n_reached: int
    n_fleets: int
    level: float


def sum_up(needed: Sequence[int | None], *, level: float) -> PassesNeeded:
    """Sum up the passes that independent fleets needed.

    Raises
    ------
    InputError
        The level is no share between 0 and 1.
    """
    check_level(level)
    values = np.sort([math.inf if n is None else float(n) for n in needed])
    n = values.size
    k = median_rank(n, level)
    low, high = (values[k - 1], values[n - k]) if k >= 1 else (math.nan, math.nan)
    return PassesNeeded(
        typical=_whole(values[n // 2]),  # the upper of two middle fleets: no fleet needs half a pass
        low=_whole(low),
        high=_whole(high),
        has_interval=k >= 1,
        safe=_whole(values[math.ceil(level * n) - 1]),
        n_reached=int(np.isfinite(values).sum()),
        n_fleets=n,
        level=level,
    )


def _whole(value: float) -> int | None:
    return int(value) if math.isfinite(value) else None


def class_groups(xy_m: Floats, class_code: Ints, eps_m: float) -> Ints:
    """Return the number of the group of every sign: signs of one class that hang together over steps below `eps_m`.

    A clustering that links over `eps_m` may take a group for one sign.
    """
    pairs = cKDTree(xy_m).query_pairs(eps_m, output_type="ndarray")
    pairs = pairs[class_code[pairs[:, 0]] == class_code[pairs[:, 1]]]
    n = len(xy_m)
    graph = coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    group: Ints = connected_components(graph, directed=False)[1].astype(np.int64)
    return group
