"""DBSCAN with scikit-learn's meaning, linear in the points, for one set or for many groups at once.

Ester, Kriegel, Sander, Xu: A density-based algorithm for discovering clusters, KDD 1996. The cell method is that of
Gunawan (2013) and of Gan and Tao (2015, doi:10.1145/2723372.2737792), who show it exact in the plane.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms import clustering_kernels as kernels
from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]

# The side of a cell is this much under eps / √2: covers rounding, and the height of the ground over a tangent plane
# within 25 km, so that two points of one cell are always within eps.
_CELL_SLACK = 1e-5
_MAX_KEY_BITS = 62
PEAK_SIGMAS = 2.0  # by which a count may fall short of its share of the largest one by chance
PEAK_STEPS = 3  # of eps: as far as the detections of a sign reach out to others
_PLANE = 2


@dataclass(frozen=True, slots=True, eq=False)
class Clusters:
    """Clusters of points.

    Parameters
    ----------
    labels
        (n,) cluster of each point, -1 for noise; numbered in the order of their first cores.
    is_core
        (n,) whether a point has min_samples neighbours within eps, itself included.
    contested_point, contested_label
        (m,) every (border point, cluster) of the border points that more than one cluster reaches. Their label is the
        lowest of these.
    """

    labels: Ints
    is_core: Flags
    contested_point: Ints
    contested_label: Ints

    @property
    def n_clusters(self) -> int:
        """Number of clusters."""
        return int(self.labels.max(initial=-1)) + 1


def dbscan(xy: ArrayLike, eps_m: float, min_samples: int) -> Ints:
    """Cluster points of the plane.

    Parameters
    ----------
    xy
        (n, 2) east and north, metres.
    eps_m
        Neighbours are within this distance, inclusive.
    min_samples
        Points within eps_m, the point itself included, that make it a core.

    Returns
    -------
    (n,) int64 labels as scikit-learn's: -1 is noise, clusters are numbered in the order of their first cores, and a
    border point belongs to the first cluster that reaches it.

    Raises
    ------
    InputError
        The shape is not (n, 2), a coordinate is not finite, or an option is out of range.
    """
    points = _checked(xy)
    return dbscan_groups(points, np.zeros(len(points), np.int64), eps_m=eps_m, min_samples=min_samples).labels


def dbscan_groups(
    xy: ArrayLike,
    groups: ArrayLike,
    *,
    eps_m: float,
    min_samples: int,
    ecef_m: Floats | None = None,
) -> Clusters:
    """Cluster points within groups (classes, tiles, runs) in one pass: no cluster spans two groups.

    Parameters
    ----------
    xy
        (n, 2) east and north, metres. Each group may use a frame of its own.
    groups
        (n,) integers from 0.
    eps_m, min_samples
        As for `dbscan`.
    ecef_m
        (n, 3) Earth-centred coordinates, metres. When given, distances are taken between these and `xy` only says
        where to look for neighbours; it must be a tangent plane with its origin within 25 km.

    Raises
    ------
    InputError
        As for `dbscan`, or points are too far apart for eps_m.
    """
    points, codes = _checked(xy), np.ascontiguousarray(groups, np.int64)
    if not (math.isfinite(eps_m) and eps_m > 0):
        raise InputError(f"eps_m is {eps_m}.", where="dbscan", todo="Give a positive finite distance, e.g. 4.0.")
    if min_samples < 1:
        raise InputError(f"min_samples is {min_samples}.", where="dbscan", todo="Give 1 or more, e.g. 3.")
    if len(points) == 0:
        nothing = np.empty(0, np.int64)
        return Clusters(nothing, np.empty(0, np.bool_), nothing, nothing)
    cells = _sort_into_cells(points, codes, points if ecef_m is None else ecef_m, eps_m)
    sq_eps = eps_m * eps_m
    core = kernels.find_cores(cells, sq_eps, min_samples)
    cluster = kernels.number_clusters(cells, core, sq_eps)
    return Clusters(*kernels.label_points(cells, core, cluster, sq_eps))


def core_counts(peak: Ints, min_samples: int, share: float) -> Ints:
    """Return how many neighbours make a core where the densest place has `peak`: see `split_groups`."""
    return np.maximum(min_samples, np.ceil(share * peak - PEAK_SIGMAS * np.sqrt(peak))).astype(np.int64)


def split_groups(
    xy: ArrayLike, groups: ArrayLike, *, eps_m: float, min_samples: int, share: float, ecef_m: Floats | None = None
) -> Ints:
    """Cluster the points of each group anew with a core rule that follows the densest place around.

    Where M is the most neighbours within eps_m that any point has which is reached in PEAK_STEPS steps of eps_m from
    point to point of the group, a core has max(min_samples, share M - 2 √M): a count of M varies by √M, so of few
    points hardly anything is asked. What is farther away has no say, so that a busy place does not silence a quiet one.

    Parameters
    ----------
    xy, groups, ecef_m
        As for `dbscan_groups`; the groups are clusters of it, and none is empty.
    eps_m, min_samples
        Those of the clusters.
    share
        Of the largest count, 0 … 1.

    Returns
    -------
    (n,) numbers of the new clusters, -1 for noise; a group in which min_samples still make a core stays as it is.
    """
    points, codes = _checked(xy), np.ascontiguousarray(groups, np.int64)
    cells = _sort_into_cells(points, codes, points if ecef_m is None else ecef_m, eps_m)
    sq_eps = eps_m * eps_m
    counts = kernels.count_neighbours(cells, sq_eps)
    peak = counts
    for _ in range(PEAK_STEPS):
        peak = kernels.largest_near(cells, sq_eps, peak)
    least = core_counts(peak, min_samples, share)
    core = counts >= least
    labels, *_ = kernels.label_points(cells, core, kernels.number_clusters(cells, core, sq_eps), sq_eps)
    is_split = np.zeros(int(codes.max()) + 1, np.bool_)
    is_split[codes[cells.order[least > min_samples]]] = True
    return np.where(is_split[codes], labels, labels.max() + 1 + codes)


def _checked(xy: ArrayLike) -> Floats:
    points = np.asarray(xy, np.float64)
    if points.size == 0:
        return np.empty((0, _PLANE))
    if points.ndim != _PLANE or points.shape[1] != _PLANE:
        raise InputError(f"points have shape {points.shape}, not (n, 2).", where="dbscan")
    if not np.isfinite(points).all():
        n_bad = np.count_nonzero(~np.isfinite(points).all(axis=1))
        raise InputError(
            f"{n_bad} of {len(points)} points have a coordinate that is not finite.",
            where="dbscan",
            todo="Drop or repair them.",
        )
    return points


def _sort_into_cells(points: Floats, groups: Ints, coords: Floats, eps_m: float) -> kernels.Cells:
    """Sort points by group, row and column of their cell."""
    side = eps_m / math.sqrt(2) * (1 - _CELL_SLACK)
    columns, n_columns = _cell_numbers(points[:, 0], side)
    rows, n_rows = _cell_numbers(points[:, 1], side)
    if math.log2(int(groups.max()) + 1) + math.log2(n_columns) + math.log2(n_rows) > _MAX_KEY_BITS:
        columns, n_columns = _close_gaps(columns)
        rows, n_rows = _close_gaps(rows)
    if (int(groups.max()) + 1) * n_columns * n_rows >= 1 << _MAX_KEY_BITS:
        raise InputError("too many groups over too wide an area.", where="dbscan", todo="Cluster it in parts.")
    keys = (groups * n_rows + rows) * n_columns + columns
    order = kernels.radix_argsort(keys, np.arange(len(points)))
    first = kernels.cell_starts(keys, order)
    window = kernels.cell_windows(keys[order[first[:-1]]], n_columns)
    return kernels.Cells(tuple(kernels.take_axes(coords, order)), order, first, window)


def _cell_numbers(values: Floats, side: float) -> tuple[Ints, int]:
    """Return cell numbers along one axis; two empty cells at each end keep a reach of two inside its row."""
    low, high = values.min(), values.max()
    if (high - low) / side > 1 << 52:
        raise InputError(f"points are {high - low:.3g} m apart: no grid of {side:.3g} m can hold them.", where="dbscan")
    numbers = np.floor((values - low) / side).astype(np.int64) + kernels.REACH
    return numbers, int(numbers.max()) + kernels.REACH + 1


def _close_gaps(numbers: Ints) -> tuple[Ints, int]:
    """Shorten every run of empty rows (or columns) to two: what is out of reach stays out of reach."""
    present, inverse = np.unique(numbers, return_inverse=True)
    steps = np.minimum(np.diff(present, prepend=present[0] - kernels.REACH), kernels.REACH + 1)
    closed = np.cumsum(steps)
    return closed[inverse], int(closed[-1]) + kernels.REACH + 1
