"""Clusterings of a whole set: K-Means and HDBSCAN by scikit-learn, K-Medoids by PAM, and K by silhouette.

They weigh every point against every other, so they cannot be cut into tiles: a set has a stated size limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from geofleet.algorithms.compiled import kernel
from geofleet.algorithms.medoids import build, fasterpam
from geofleet.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]

Method = Literal["kmeans", "kmedoids", "hdbscan"]
MAX_POINTS = {"kmeans": 200_000, "kmedoids": 20_000, "hdbscan": 50_000}
MAX_POINTS_TO_CHOOSE_K = 20_000
N_STARTS, SEED = 10, 0
WEAK_SILHOUETTE = 0.5
_PATIENCE = 20


@dataclass(frozen=True, slots=True, eq=False)
class Partition:
    """Clusters of a set.

    Parameters
    ----------
    labels
        (n,) cluster of each point, -1 for noise.
    is_medoid
        (n,) whether the point is the centre of its cluster; K-Medoids only, else all False.
    """

    labels: Ints
    is_medoid: Flags


def partition_groups(
    xy: Floats,
    groups: Ints,
    *,
    method: Method,
    n_clusters: Ints | None = None,
    max_clusters: int = 100,
    min_cluster_size: int = 10,
) -> Partition:
    """Cluster points within groups (classes) one group after the other.

    Parameters
    ----------
    xy
        (n, 2) east and north, metres. The result depends on the order of the rows: sort them by key.
    groups
        (n,) integers from 0; no cluster spans two.
    method
        `kmeans`: scikit-learn's, best of 10 starts from seed 0. `kmedoids`: BUILD and FasterPAM. `hdbscan`:
        scikit-learn's with its defaults; a group smaller than `min_cluster_size` is noise.
    n_clusters
        (n_groups,) K of every group, at most its number of distinct points; all points of a group with 0 are noise.
        None: K is chosen by `choose` among 1 … max_clusters.
    max_clusters
        Largest K to choose.
    min_cluster_size
        HDBSCAN's.

    Raises
    ------
    InputError
        A group has more points than `MAX_POINTS` of the method (`MAX_POINTS_TO_CHOOSE_K` without K).
    """
    labels, is_medoid = np.full(len(xy), -1, np.int64), np.zeros(len(xy), np.bool_)
    n_found = 0
    for group, rows in _each(groups):
        points = xy[rows]
        check_size(len(rows), method, is_chosen=n_clusters is None)
        if method == "hdbscan":
            found = Partition(hdbscan(points, min_cluster_size), np.zeros(len(rows), np.bool_))
        elif n_clusters is None:
            found = choose(points, method, max_clusters)
        elif n_clusters[group]:
            found = _given(points, method, int(n_clusters[group]))
        else:
            continue
        labels[rows] = np.where(found.labels < 0, -1, found.labels + n_found)
        is_medoid[rows] = found.is_medoid
        n_found += int(found.labels.max(initial=-1)) + 1
    return Partition(labels, is_medoid)


def _each(groups: Ints) -> Iterator[tuple[int, Ints]]:
    order = np.argsort(groups, kind="stable")
    numbers, starts = np.unique(groups[order], return_index=True)
    yield from zip(numbers.tolist(), np.split(order, starts[1:])[: numbers.size], strict=True)


def check_size(n: int, method: Method, *, is_chosen: bool) -> None:
    """Refuse a set that a method would take hours or gigabytes for.

    Raises
    ------
    InputError
        It has more than `MAX_POINTS` points or, when K is to be chosen, more than `MAX_POINTS_TO_CHOOSE_K`.
    """
    is_chosen = is_chosen and method != "hdbscan"
    limit = min(MAX_POINTS[method], MAX_POINTS_TO_CHOOSE_K) if is_chosen else MAX_POINTS[method]
    if n > limit:
        raise InputError(
            f"{n} detections are to be clustered as one set; the limit is {limit}{' when K is chosen' * is_chosen}.",
            where=f"method {method}",
            todo="It cannot be cut into tiles: use a smaller area, fewer vehicles, semantic=first, or method=dbscan.",
        )


def _given(xy: Floats, method: Method, k: int) -> Partition:
    k = min(k, len(np.unique(xy, axis=0)))
    if method == "kmeans":
        return Partition(kmeans(xy, k), np.zeros(len(xy), np.bool_))
    return _around(xy, build(xy, k))


def _around(xy: Floats, start: Ints) -> Partition:
    found = fasterpam(xy, start)
    is_medoid = np.zeros(len(xy), np.bool_)
    is_medoid[found.rows] = True
    return Partition(found.labels, is_medoid)


def kmeans(xy: Floats, k: int) -> Ints:
    """Return scikit-learn's K-Means labels: k-means++, Lloyd, the best of 10 starts from seed 0.

    It runs on one thread: sums over several are rounded in an order of their own, and labels must not depend on it.
    """
    from sklearn.cluster import KMeans  # noqa: PLC0415  (a second to import, and only this method needs it)
    from threadpoolctl import threadpool_limits  # noqa: PLC0415  (scikit-learn's)

    with threadpool_limits(limits=1):
        labels: Ints = KMeans(n_clusters=k, n_init=N_STARTS, random_state=SEED).fit_predict(xy)
    return labels.astype(np.int64)


def hdbscan(xy: Floats, min_cluster_size: int) -> Ints:
    """Return scikit-learn's HDBSCAN labels, -1 for noise (min_samples = min_cluster_size, excess of mass)."""
    if len(xy) < min_cluster_size:
        return np.full(len(xy), -1, np.int64)
    from sklearn.cluster import HDBSCAN  # noqa: PLC0415  (as above)

    labels: Ints = HDBSCAN(min_cluster_size=min_cluster_size, copy=True).fit_predict(xy)
    return labels.astype(np.int64)


def choose(xy: Floats, method: Method, max_clusters: int) -> Partition:
    """Cluster with the K of 2 … max_clusters whose mean silhouette is largest; ties go to the smaller.

    A single cluster has no silhouette: it is what remains when no K gets above 0.5, under which Kaufman and Rousseeuw
    (Finding Groups in Data, 1990, p. 88) call the structure weak and possibly artificial. The search ends when 20
    numbers in a row have brought nothing better.
    """
    largest = min(max_clusters, len(np.unique(xy, axis=0)) - 1)
    best, best_score, best_k = _given(xy, method, 1), WEAK_SILHOUETTE, 1
    start = build(xy, max(1, largest)) if method == "kmedoids" else None
    for k in range(2, largest + 1):
        found = _given(xy, method, k) if start is None else _around(xy, start[:k])
        score = silhouette(xy, found.labels)
        if score > best_score:
            best, best_score, best_k = found, score, k
        elif k - best_k >= _PATIENCE and best_k > 1:
            break
    return best


def silhouette(xy: Floats, labels: Ints) -> float:
    """Return the mean silhouette (Rousseeuw 1987, doi:10.1016/0377-0427(87)90125-7) of two clusters or more.

    From -1 to 1, 1 is best; a point alone in its cluster counts 0. Time grows with n², memory with n.
    """
    return float(_silhouette(np.ascontiguousarray(xy), labels, int(labels.max()) + 1))


@kernel
def _silhouette(xy: Floats, labels: Ints, k: int) -> float:
    size, total = np.bincount(labels, minlength=k), 0.0
    for i in range(len(xy)):
        if size[labels[i]] == 1:
            continue
        sums = np.zeros(k)
        for j in range(len(xy)):
            sums[labels[j]] += np.sqrt((xy[i, 0] - xy[j, 0]) ** 2 + (xy[i, 1] - xy[j, 1]) ** 2)
        own, other = sums[labels[i]] / (size[labels[i]] - 1), np.inf
        for label in range(k):
            if label != labels[i]:
                other = min(other, sums[label] / size[label])
        larger = max(own, other)
        total += (other - own) / larger if larger > 0 else 0.0
    return total / len(xy)
