"""Clusterings that weigh every detection of a run against every other: no tiles, a stated size limit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.partitions import check_size, partition_groups
from geofleet.engines.batches import concatenate, fuse_members
from geofleet.errors import InputError
from geofleet.tables.dealt import read_rows

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.algorithms.partitions import Method

    Columns = dict[str, NDArray[Any]]

MAX_EXTENT_M = 50_000.0  # as far from the middle, a plane shortens distances by 3e-5


@dataclass(frozen=True, slots=True)
class RunTask:
    """The detections of one run: plain data."""

    paths: tuple[Path, ...]
    run_code: int
    first_tile: int  # tiles first_tile … stop_tile - 1 are the run's
    stop_tile: int
    n_points: int
    method: Method
    semantic: str
    n_clusters: dict[int, int] | None  # signs a class code (0: of all classes, semantic after); None: to be chosen
    max_clusters: int
    min_cluster_size: int


def cluster_run(task: RunTask) -> Columns:
    """Cluster one run as a whole and fuse the clusters.

    Positions are plain means for K-Means, members for K-Medoids and information-weighted means for HDBSCAN.

    Raises
    ------
    InputError
        The run is too large or too wide for the method.
    """
    if task.semantic == "after":
        check_size(task.n_points, task.method, is_chosen=task.n_clusters is None)
    rows = concatenate([_own_rows(path, task) for path in task.paths])
    order = np.lexsort((rows["track_id"], rows["pass_code"]))
    rows = {name: values[order] for name, values in rows.items()}
    groups = rows["class_code"] if task.semantic == "first" else np.zeros_like(rows["class_code"])
    found = partition_groups(
        _plane(rows),
        groups,
        method=task.method,
        n_clusters=_per_group(task.n_clusters, groups),
        max_clusters=task.max_clusters,
        min_cluster_size=task.min_cluster_size,
    )
    member = np.flatnonzero(found.labels >= 0)
    return fuse_members(
        rows,
        member,
        found.labels[member],
        is_weighted=task.method == "hdbscan",
        is_medoid=found.is_medoid[member] if task.method == "kmedoids" else None,
    )


def _own_rows(path: Path, task: RunTask) -> Columns:
    rows = read_rows(path)
    mine = rows["is_owned"] & (rows["tile_code"] >= task.first_tile) & (rows["tile_code"] < task.stop_tile)
    rows = {name: values[mine] for name, values in rows.items()}
    return rows | {"run_code": np.full(int(mine.sum()), task.run_code, np.int64)}


def _plane(rows: Columns) -> NDArray[np.float64]:
    frame = EnuFrame.around(rows["lon"], rows["lat"])
    xy = frame.to_enu(rows["lon"], rows["lat"])
    reach_m = float(np.abs(xy).max())
    if not reach_m <= MAX_EXTENT_M:
        raise InputError(
            f"detections lie up to {reach_m / 1000:.0f} km from their middle, not {MAX_EXTENT_M / 1000:.0f} at most.",
            where="methods that see a run as a whole",
            todo="Use a smaller area, or method=dbscan.",
        )
    return xy


def _per_group(n_clusters: dict[int, int] | None, groups: NDArray[np.int64]) -> NDArray[np.int64] | None:
    if n_clusters is None:
        return None
    return np.array([n_clusters.get(group, 0) for group in range(int(groups.max()) + 1)], np.int64)
