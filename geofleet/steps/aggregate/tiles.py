"""Clusters of tiles: detections dealt into batches, clustered on threads, joined across borders."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.algorithms.tiling import halo_m
from geofleet.engines.batches import TileTask, cluster_batch, concatenate, fuse_open, splitter
from geofleet.engines.local import keep_freed_memory, release_memory, run_tasks
from geofleet.tables.arrays import numpy_numbers
from geofleet.tables.database import connect
from geofleet.tables.dealt import batch_path
from geofleet.tables.staging import Limits, Staged, stage_detections

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.config import AggregateConfig

    Columns = dict[str, NDArray[Any]]
    Ints = NDArray[np.int64]

BATCH_ROWS = 100_000  # detections that one thread clusters at a time: tens of megabytes
COARSEST_ZOOM, COARSER_BY = (
    12,
    2,
)  # where detections are sparse, tiles are four times as wide as asked for: fewer borders
DUCKDB_MEMORY = "250MB"  # what its joins and groups may hold before they spill


def stage(
    detections: Path,
    folder: Path,
    settings: AggregateConfig,
    *,
    n_vehicles: int | None,
    passes: Path | None,
    limits: Limits,
    n_workers: int,
) -> Staged:
    """Deal the detections into batches below a folder."""
    keep_freed_memory()
    connection = connect(threads=n_workers, memory_limit=DUCKDB_MEMORY, spatial=False)
    try:
        return stage_detections(
            connection,
            detections,
            folder,
            zoom=max(COARSEST_ZOOM, settings.tile_zoom - COARSER_BY),
            halo_m=halo_m(settings.eps_m) if settings.method == "dbscan" else 0.0,
            batch_rows=BATCH_ROWS,
            n_vehicles=n_vehicles or 0,
            passes=passes,
            correct_bias=settings.correct_bias,
            limits=limits,
        )
    finally:
        connection.close()
        release_memory()


def cluster_tiles_of(
    staged: Staged, settings: AggregateConfig, *, n_workers: int, progress: Callable[[int, int], None] | None
) -> Columns:
    """Return the clusters of all batches, and those that cross their tiles."""
    tasks = _tile_tasks(staged, settings)
    results = list(run_tasks(cluster_batch, tasks, n_workers=n_workers, progress=progress))
    release_memory()
    crossing = fuse_open([r.open_rows for r in results], splitter(tasks[0]) if tasks else None)
    clusters = concatenate([*(r.clusters for r in results), crossing])
    release_memory()
    return clusters


def _tile_tasks(staged: Staged, settings: AggregateConfig) -> list[TileTask]:
    """Return one task a batch; its tiles are consecutive."""
    names, runs = staged.tiles["tile"].to_pylist(), run_codes(staged).tolist()
    numbers, starts = np.unique(numpy_numbers(staged.tiles["batch"].combine_chunks()), return_index=True)
    stops = np.append(starts, len(names))[1:]
    return [
        TileTask(
            path=batch_path(staged.folder, number),
            first_tile=start,
            tiles=tuple(names[start:stop]),
            runs=tuple(runs[start:stop]),
            eps_m=settings.eps_m,
            min_samples=settings.min_samples,
            min_samples_share=settings.min_samples_share,
            semantic=settings.semantic,
        )
        for number, start, stop in zip(numbers.tolist(), starts.tolist(), stops.tolist(), strict=True)
    ]


def run_codes(staged: Staged) -> Ints:
    """Return the number of the run of every tile."""
    codes = {run_id: code for code, run_id in enumerate(sorted(staged.fleet))}
    return np.array([codes[run_id] for run_id in staged.tiles["run_id"].to_pylist()], np.int64)
