"""What is done with a batch of tiles, wherever it runs: read, cluster, fuse; and the clusters that cross tile borders.

A cluster leaves as one entry in each of a dictionary of equally long columns, `run_code` to `t_last_us`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.algorithms.clustering_kernels import is_in_order, radix_argsort
from geofleet.algorithms.fusion import fuse, hash_members, information_weights, move_to_members, vote
from geofleet.algorithms.geodesy_kernels import ecef_points
from geofleet.algorithms.tiling import cluster_tiles, join_open, quadkey_bounds, split_chains
from geofleet.tables.dealt import read_rows

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    Columns = dict[str, NDArray[Any]]
    Flags = NDArray[np.bool_]
    Ints = NDArray[np.int64]
    Splitter = Callable[..., Ints]


_FUSED = frozenset(
    {
        *("lon", "lat", "var_m2", "class_confidence", "track_id", "t_first_us", "t_last_us"),
        *("run_code", "pass_code", "pass_hash", "class_code", "ecef_m"),
    }
)  # what a sign is made from


_OPEN = (_FUSED - {"ecef_m"}) | {
    "is_owned"
}  # what is kept until all batches are done; places are cheaper to compute again


@dataclass(frozen=True, slots=True)
class TileTask:
    """A batch of tiles: plain data, so that it can be sent anywhere."""

    path: Path
    first_tile: int
    tiles: tuple[str, ...]
    runs: tuple[int, ...]
    eps_m: float
    min_samples: int
    min_samples_share: float
    semantic: str


@dataclass(frozen=True, slots=True, eq=False)
class TileResult:
    """Fused clusters that are all the batch's own, and the rows of the others."""

    clusters: Columns
    open_rows: Columns


def cluster_batch(task: TileTask) -> TileResult:
    """Cluster one batch of tiles by DBSCAN, fuse the clusters that are all its own and hand back the others."""
    rows = read_rows(task.path)
    rows["ecef_m"] = ecef_points(rows["lon"], rows["lat"])
    tile = rows["tile_code"] - task.first_tile
    rows["run_code"] = np.asarray(task.runs, np.int64)[tile]
    bounds = quadkey_bounds(task.tiles)
    found = cluster_tiles(
        rows["lon"],
        rows["lat"],
        tile=tile,
        tile_centres_deg=np.column_stack((bounds[:, [0, 2]].mean(axis=1), bounds[:, [1, 3]].mean(axis=1))),
        is_owned=rows["is_owned"],
        codes=rows["class_code"] if task.semantic == "first" else np.zeros_like(rows["class_code"]),
        eps_m=task.eps_m,
        min_samples=task.min_samples,
        ecef_m=rows["ecef_m"],
    )
    open_rows = {name: rows[name].take(found.open_row) for name in _OPEN}
    open_rows |= {"cluster": found.open_cluster, "is_core": found.open_is_core}
    return TileResult(fuse_members(rows, found.closed_row, found.closed_cluster, splitter=splitter(task)), open_rows)


def splitter(task: TileTask) -> Splitter:
    """Return `split_chains` with the settings of a task."""
    return partial(
        split_chains,
        eps_m=task.eps_m,
        min_samples=task.min_samples,
        share=task.min_samples_share,
    )


def fuse_open(parts: Sequence[Columns], split: Splitter | None = None) -> Columns:
    """Join the open clusters of all batches, taking their rows out of the parts, split chains and fuse them."""
    n_before = 0
    for part in parts:  # a cluster belongs to one tile, and clusters are numbered within a batch
        n_found = int(part["cluster"].max(initial=-1)) + 1
        part["cluster"] += n_before
        n_before += n_found
    rows = concatenate(parts)
    if not rows:
        return {}
    order = _key_order(rows["track_id"], rows["pass_code"])
    is_new = (np.diff(rows["pass_code"][order], prepend=-1) != 0) | (np.diff(rows["track_id"][order], prepend=0) != 0)
    point = np.empty(len(order), np.int64)
    point[order] = np.cumsum(is_new)
    row, cluster = join_open(point, rows["cluster"], rows["is_core"], rows["is_owned"])
    return fuse_members(rows, row, cluster, splitter=split)


def fuse_members(
    rows: Columns,
    member: Ints,
    cluster: Ints,
    *,
    splitter: Splitter | None = None,
    is_weighted: bool = True,
    is_medoid: Flags | None = None,
) -> Columns:
    """Return one row a cluster; members are put in the order of their keys first.

    Parameters
    ----------
    rows
        Detections, one array a column.
    member, cluster
        (n,) the rows that are in clusters, and the cluster of each.
    splitter
        What clusters members anew within their clusters; None to leave them.
    is_weighted
        Whether centroids are weighted by information, or plain means.
    is_medoid
        (n,) the members that are the positions of their clusters, one each; None for centroids.
    """
    if cluster.size == 0:
        return {}
    order = _key_order(rows["track_id"].take(member), rows["pass_code"].take(member))
    order = radix_argsort(cluster, order)
    taken, cluster = member.take(order), cluster.take(order)
    rows = {name: values.take(taken, axis=0) for name, values in rows.items() if name in _FUSED}
    if splitter:
        split = splitter(rows["lon"], rows["lat"], cluster)
        if split is not cluster:
            kept = np.flatnonzero(split >= 0)
            kept = kept[radix_argsort(split[kept], np.arange(kept.size))]  # stable: in a cluster they stay by key
            rows, cluster = {name: values.take(kept, axis=0) for name, values in rows.items()}, split[kept]
    first = np.append(np.flatnonzero(np.diff(cluster, prepend=-1)), cluster.size)
    lead = first[:-1]
    weight = information_weights(rows["var_m2"]) if is_weighted else np.ones(cluster.size)
    fused = fuse(
        rows["lon"],
        rows["lat"],
        weight=weight,
        pass_code=rows["pass_code"],
        first=first,
        ecef_m=rows.get("ecef_m"),
    )
    if is_medoid is not None:
        fused = move_to_members(fused, rows["lon"][is_medoid[order]], rows["lat"][is_medoid[order]])
    class_code, confidence = vote(rows["class_code"], rows["class_confidence"], first)
    return {
        "run_code": rows["run_code"][lead],
        "hash": hash_members(rows["pass_hash"], rows["track_id"], first),
        "class_code": class_code,
        "class_confidence": confidence,
        "lon": fused.lon_deg,
        "lat": fused.lat_deg,
        "var_e_m2": fused.var_e_m2,
        "var_n_m2": fused.var_n_m2,
        "cov_en_m2": fused.cov_en_m2,
        "n_passes": fused.n_passes,
        "n_detections": fused.n_detections,
        "t_first_us": np.minimum.reduceat(rows["t_first_us"], lead),
        "t_last_us": np.maximum.reduceat(rows["t_last_us"], lead),
    }


def _key_order(track_id: Ints, pass_code: Ints) -> Ints:
    """Return the order by pass and track, in which a geofleet table and so its batches often are."""
    if is_in_order(pass_code, track_id):
        return np.arange(track_id.size)
    if track_id.min(initial=0) < 0:  # the radix sort takes no negative keys
        return np.lexsort((track_id, pass_code))
    return radix_argsort(pass_code, radix_argsort(track_id, np.arange(track_id.size)))


def concatenate(parts: Sequence[Columns]) -> Columns:
    """Stack columns, taking them out of the parts: what is stacked is not held twice. Parts without any are skipped."""
    parts = [part for part in parts if part]
    return {name: np.concatenate([part.pop(name) for part in parts]) for name in list(parts[0])} if parts else {}
