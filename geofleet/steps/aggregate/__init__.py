"""Aggregate: the detections of many passes become one layer of signs.

DuckDB judges the detections, numbers passes and classes and deals them into batches of tiles with their halos; each
batch is clustered and fused on a thread of its own; what crosses tile borders is joined here. Runs are never mixed.
Tiles, batches and workers do not show in the result (`algorithms.tiling` says why). K-Means, K-Medoids, HDBSCAN and
joint fusion see a run as a whole.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.compute as pc

from geofleet.steps.aggregate.labels import check_area, method_label
from geofleet.steps.aggregate.result import (
    AggregateResult,
    beside,
    count_reasons,
    explain,
    few,
    unknown_classes,
    write_rejected,
    write_result_manifest,
)
from geofleet.steps.aggregate.tiles import cluster_tiles_of, stage
from geofleet.tables.fused import Labels, layer_pieces
from geofleet.tables.manifest import Hashing
from geofleet.tables.opportunities import opportunities, read_passes
from geofleet.tables.reference_counts import reference_counts
from geofleet.tables.schemas import SIGNS
from geofleet.tables.staging import Limits
from geofleet.tables.store import write_pieces

if TYPE_CHECKING:
    from collections.abc import Callable

    import pyarrow as pa
    from numpy.typing import NDArray

    from geofleet.config import AggregateConfig, Config
    from geofleet.tables.staging import Staged

    Columns = dict[str, NDArray[Any]]
    Ints = NDArray[np.int64]

__all__ = ["AggregateResult", "aggregate", "beside", "explain"]


def aggregate(
    detections: Path,
    out: Path,
    *,
    config: Config,
    n_vehicles: int | None = None,
    passes: Path | None = None,
    k_from: Path | None = None,
    prior: Path | None = None,
    area: tuple[float, float, float, float] | None = None,
    n_workers: int = 2,
    progress: Callable[[int, int], None] | None = None,
) -> AggregateResult:
    """Cluster and fuse the detections of every run into a layer of signs.

    Parameters
    ----------
    detections
        A `detections` table: a file, or a folder partitioned by run and vehicle.
    out
        The layer to write. Detections that cannot be used go to `<stem>_rejected.parquet` beside it, with the reason.
    config
        Its `aggregate` section.
    n_vehicles
        Use the first so many vehicles of every run, in the order of their ids; all by default.
    passes
        A `passes` table of the same runs. Support is then relative to the passes that had a place in view, instead of
        to the vehicles, and the layer carries `n_opportunities`. What it declares about biases is used to correct them.
    k_from
        A `reference` table or any `signs` layer: K-Means and K-Medoids are given its number of signs (of each class,
        semantic first), which no real job knows. The layer's method says `oracle-k`.
    prior
        An earlier map, in any format that `read_layer` knows: joint fusion takes its main signs as soft anchors.
    area
        West, south, east and north in degrees: detections outside are set aside; west beyond east is a box across the
        antimeridian.
    n_workers
        Threads.
    progress
        Called with the number of batches done and to do.

    Raises
    ------
    InputError
        A table cannot be read, or is too large for a method that sees it as a whole.
    TableError
        A column is missing or mistyped, or the passes are not those of the runs.
    ConfigError
        K is given twice, for all classes together semantic first, or to a method that has none; a prior map is given
        to another method than joint.
    """
    settings = config.aggregate
    limits = Limits(check_area(area), is_listed=settings.unknown_classes == "reject")
    label = method_label(settings, k_from, prior)
    if settings.method == "joint":
        from geofleet.steps.aggregate.joint import fuse_jointly  # noqa: PLC0415  (0.5 s that the others can spare)

        return fuse_jointly(
            detections,
            out,
            config,
            label,
            n_vehicles=n_vehicles,
            passes=passes,
            prior=prior,
            limits=limits,
            n_workers=n_workers,
            progress=progress,
        )
    driven = read_passes(passes) if passes else None
    counts = reference_counts(k_from, semantic=settings.semantic) if k_from else None
    inputs = Hashing(path for path in (detections, passes, k_from) if path)
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=out.parent, prefix=f".{out.stem}.") as folder:
        staged = stage(
            detections,
            Path(folder),
            settings,
            n_vehicles=n_vehicles,
            passes=passes,
            limits=limits,
            n_workers=n_workers,
        )
        if settings.method == "dbscan":
            clusters = cluster_tiles_of(staged, settings, n_workers=n_workers, progress=progress)
        else:
            from geofleet.steps.aggregate.whole import cluster_runs  # noqa: PLC0415  (0.3 s that DBSCAN can spare)

            clusters = cluster_runs(staged, settings, settings.method, counts, progress=progress)
    fleet = {run_id: n_vehicles or reporting for run_id, reporting in staged.fleet.items()}
    if driven and clusters:
        clusters["n_opportunities"] = _opportunities(clusters, driven, sorted(fleet), n_vehicles)
    of_run = np.array([fleet[run_id] for run_id in sorted(fleet)], np.int64)
    labels = Labels(tuple(sorted(fleet)), staged.classes, of_run, label)
    n_signs = write_pieces(SIGNS, layer_pieces(clusters, _support(clusters, of_run, settings), labels), out)
    result = AggregateResult(
        out=out,
        label=label,
        rejected=write_rejected(staged.rejected, out),
        skipped=count_reasons(staged.rejected),
        unknown_classes=unknown_classes(dict(zip(staged.classes, staged.n_of_class, strict=True))),
        run_ids=tuple(sorted(fleet)),
        n_vehicles=max(fleet.values(), default=0),
        n_detections=staged.n_detections,
        n_rejected=staged.rejected.num_rows,
        n_used=int(pc.sum(staged.tiles["n_points"]).as_py() or 0),
        n_tiles=staged.tiles.num_rows,
        n_clusters=len(clusters["lon"]) if clusters else 0,
        n_signs=n_signs,
        notes=_notes(staged, n_vehicles),
    )
    write_result_manifest(result, inputs, config, limits)
    return result


def _opportunities(clusters: Columns, driven: pa.Table, run_ids: list[str], n_vehicles: int | None) -> Ints:
    """Return how many passes had the place of each cluster in view."""
    counts = np.zeros(len(clusters["lon"]), np.int64)
    for code in np.unique(clusters["run_code"]).tolist():
        mine = clusters["run_code"] == code
        lon, lat = clusters["lon"][mine], clusters["lat"][mine]
        counts[mine] = opportunities(driven, lon, lat, run_id=run_ids[code], n_vehicles=n_vehicles)
    return counts


def _support(clusters: Columns, n_vehicles: Ints, settings: AggregateConfig) -> NDArray[np.float64]:
    """Return the passes that each cluster needs: a share of those in view or, where these are unknown, of the fleet."""
    if not clusters:
        return np.empty(0)
    possible = clusters.get("n_opportunities", n_vehicles[clusters["run_code"]])
    return np.maximum(settings.min_support, settings.min_support_share * possible)


def _notes(staged: Staged, n_vehicles: int | None) -> tuple[str, ...]:
    """Return what the user should know beside the counts."""
    return few(staged.fleet, n_vehicles) + (staged.bias.notes() if staged.bias else ())
