"""Clusters of whole runs: K-Means, K-Medoids and HDBSCAN."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.engines.batches import concatenate
from geofleet.engines.local import run_tasks
from geofleet.engines.whole import RunTask, cluster_run
from geofleet.steps.aggregate.tiles import run_codes
from geofleet.tables.dealt import batch_path

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from geofleet.algorithms.partitions import Method
    from geofleet.config import AggregateConfig
    from geofleet.tables.staging import Staged

    Columns = dict[str, NDArray[Any]]


def cluster_runs(
    staged: Staged,
    settings: AggregateConfig,
    method: Method,
    counts: dict[tuple[str, str], int] | None,
    *,
    progress: Callable[[int, int], None] | None,
) -> Columns:
    """Return the clusters of every run, one after the other."""
    tasks = _run_tasks(staged, settings, method, counts)
    return concatenate(list(run_tasks(cluster_run, tasks, n_workers=1, progress=progress)))


def _run_tasks(
    staged: Staged, settings: AggregateConfig, method: Method, counts: dict[tuple[str, str], int] | None
) -> list[RunTask]:
    """Return one task a run that has usable detections; its tiles are consecutive."""
    batch, n_points = staged.tiles["batch"].to_numpy(), staged.tiles["n_points"].to_numpy()
    codes, starts = np.unique(run_codes(staged), return_index=True)
    stops = np.append(starts, len(batch))[1:]
    run_ids = sorted(staged.fleet)
    return [
        RunTask(
            paths=tuple(batch_path(staged.folder, number) for number in np.unique(batch[start:stop]).tolist()),
            run_code=code,
            first_tile=start,
            stop_tile=stop,
            n_points=int(n_points[start:stop].sum()),
            method=method,
            semantic=settings.semantic,
            n_clusters=_given_k(run_ids[code], staged.classes, settings.k, counts),
            max_clusters=settings.max_k,
            min_cluster_size=settings.min_cluster_size,
        )
        for code, start, stop in zip(codes.tolist(), starts.tolist(), stops.tolist(), strict=True)
    ]


def _given_k(
    run_id: str, classes: tuple[str, ...], k: int, counts: dict[tuple[str, str], int] | None
) -> dict[int, int] | None:
    """Return K a class code, or {0: K} for all classes together; None when it is to be chosen."""
    if counts is None:
        return {0: k} if k else None
    of_run = {name: n for (run, name), n in counts.items() if run in {run_id, ""}}
    together = {0: of_run[""]} if "" in of_run else {}
    return together | {code: of_run[name] for code, name in enumerate(classes) if name in of_run}
