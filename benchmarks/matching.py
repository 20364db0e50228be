"""How fast is the exact matching? Ours beside dense and sparse scipy and Stone Soup, in one run.

Run with `python benchmarks/matching.py`; the data is made from seed 0. Stone Soup is timed when it is installed. Peak
memory is that of a child process during the call, above what it held before (Linux).
"""

from __future__ import annotations

import multiprocessing
import time
from datetime import UTC, datetime
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array, hstack
from scipy.sparse.csgraph import min_weight_full_bipartite_matching
from scipy.spatial import cKDTree

from geofleet.algorithms.matching import match_points

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    Points = NDArray[np.float64]

GATE_M = 2.0


def scene(n: int) -> tuple[Points, Points]:
    """One sign per 10 m by 10 m; the map is 0.7 m off a axis, a tenth of it anywhere."""
    rng = np.random.default_rng(0)
    ref_xy = rng.uniform(0, 10 * np.sqrt(n), (n, 2))
    xy = ref_xy + rng.normal(0, 0.7, (n, 2))
    xy[: n // 10] = rng.uniform(0, 10 * np.sqrt(n), (n // 10, 2))
    return xy, ref_xy


def crowd(n: int) -> tuple[Points, Points]:
    """Uniform points, each with 20 candidates in its gate: one giant component."""
    rng = np.random.default_rng(0)
    side_m = np.sqrt(n * np.pi * GATE_M**2 / 20)
    return rng.uniform(0, side_m, (n, 2)), rng.uniform(0, side_m, (n, 2))


def ours(xy: Points, ref_xy: Points) -> float:
    """GOSPA² of the sparse matching."""
    matching = match_points(xy, ref_xy, gate_m=GATE_M)
    return matching.sum_sq_error_m2 + GATE_M**2 / 2 * (len(xy) + len(ref_xy) - 2 * len(matching))


def dense_scipy(xy: Points, ref_xy: Points) -> float:
    """GOSPA² by `linear_sum_assignment` on all pairs (sets of one size)."""
    cost = (xy[:, :1] - ref_xy[:, 0]) ** 2
    cost += (xy[:, 1:] - ref_xy[:, 1]) ** 2
    np.minimum(cost, GATE_M**2, out=cost)
    return float(cost[linear_sum_assignment(cost)].sum())


def sparse_scipy(xy: Points, ref_xy: Points) -> float:
    """GOSPA² by `min_weight_full_bipartite_matching` on the pairs in the gate, and a column of its own for each row."""
    n = len(xy)
    pairs = cKDTree(xy).sparse_distance_matrix(cKDTree(ref_xy), GATE_M, output_type="ndarray")
    inside = pairs[pairs["v"] < GATE_M]
    shift = 1.0  # scipy takes an explicit 0 for no edge; every row pays it once
    gated = coo_array((inside["v"] ** 2 + shift, (inside["i"], inside["j"])), shape=(n, len(ref_xy)))
    own = coo_array((np.full(n, GATE_M**2 + shift), (np.arange(n), np.arange(n))), shape=(n, n))
    graph = hstack((gated, own)).tocsr()
    rows, columns = min_weight_full_bipartite_matching(graph)
    return float(graph[rows, columns].sum() - shift * n)


def stone_soup(xy: Points, ref_xy: Points) -> float:
    """GOSPA² by Stone Soup's `GOSPAMetric`."""
    from stonesoup.metricgenerator.ospametric import GOSPAMetric  # noqa: PLC0415 (optional)
    from stonesoup.types.state import State  # noqa: PLC0415

    now = datetime(2026, 1, 1, tzinfo=UTC)
    states, ref_states = ([State(p.reshape(2, 1), timestamp=now) for p in points] for points in (xy, ref_xy))
    metric, _ = GOSPAMetric(p=2, c=GATE_M).compute_gospa_metric(states, ref_states)
    return float(metric.value["distance"]) ** 2


def timed(solver: Callable[[Points, Points], float], points: tuple[Points, Points]) -> tuple[float, float]:
    """Best wall time in seconds (of three, or of one that takes longer than a second), and the GOSPA² found."""
    best = np.inf
    for _ in range(3):
        begin = time.perf_counter()
        gospa_sq = solver(*points)
        best = min(best, time.perf_counter() - begin)
        if best > 1:
            break
    return best, gospa_sq


def _resident_mb(peak: str) -> float:
    """Read the resident memory now (`VmRSS`) or its peak (`VmHWM`); `ru_maxrss` is inherited from the parent."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith(peak))


def _measure_peak(n: int, queue: multiprocessing.Queue[float]) -> None:
    ours(*scene(100))
    points = scene(n)
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # the peak begins anew
    before = _resident_mb("VmRSS")
    ours(*points)
    queue.put(_resident_mb("VmHWM") - before)


def peak_mb(n: int) -> float:
    """Peak memory of one call above the points themselves, MB."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    process = context.Process(target=_measure_peak, args=(n, queue))
    process.start()
    peak = queue.get()
    process.join()
    return peak


def compare(name: str, points: tuple[Points, Points], others: tuple[Callable[[Points, Points], float], ...]) -> None:
    """Print a row for ours and for each other solver, with the ratio of the times; all must agree."""
    seconds, gospa_sq = timed(ours, points)
    print(f"{name:22} {'ours':14} {seconds:10.4f} s")
    for solver in others:
        other_seconds, other_gospa_sq = timed(solver, points)
        assert abs(other_gospa_sq - gospa_sq) < 1e-9 * max(1.0, gospa_sq), (solver.__name__, other_gospa_sq, gospa_sq)
        print(f"{'':22} {solver.__name__:14} {other_seconds:10.4f} s {other_seconds / seconds:10.0f} x ours")


def main() -> None:
    ours(*scene(100))  # compile, or load the compiled code
    optional = (stone_soup,) if find_spec("stonesoup") else ()
    compare("scene 10^3", scene(10**3), (dense_scipy, sparse_scipy, *optional))
    compare("scene 10^4", scene(10**4), (dense_scipy, sparse_scipy))
    compare("crowd 10^4, 20 each", crowd(10**4), (sparse_scipy,))
    compare("crowd 10^5, 20 each", crowd(10**5), ())
    for n in (10**5, 10**6):
        compare(f"scene {n:.0e}", scene(n), ())
        print(f"{'':22} {'peak memory':14} {peak_mb(n):10.0f} MB")


if __name__ == "__main__":
    main()
