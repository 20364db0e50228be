"""Joint fusion: every run estimated as a whole, with the evidence of its signs and the nuisance of its passes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.engines.batches import concatenate
from geofleet.engines.joint import JointTask, fuse_run
from geofleet.engines.local import run_tasks
from geofleet.formats.layers import read_layer
from geofleet.steps.aggregate.result import (
    AggregateResult,
    beside,
    count_reasons,
    few,
    unknown_classes,
    write_rejected,
    write_result_manifest,
)
from geofleet.steps.aggregate.tiles import DUCKDB_MEMORY
from geofleet.tables.biases import BEARING_BIAS_SIGMA_DEG, RANGE_BIAS_SIGMA_M
from geofleet.tables.database import connect
from geofleet.tables.fused import Labels, layer_pieces
from geofleet.tables.manifest import Hashing
from geofleet.tables.schemas import EVIDENCE, NUISANCE, PASSES, SIGNS
from geofleet.tables.store import read_table, write_pieces, write_table
from geofleet.tables.tracks import Assumed
from geofleet.tables.tracks_staging import count_classes, joint_classes, passes_of_run, prior_of_run, stage_tracks

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from geofleet.config import Config
    from geofleet.tables.staging import Limits


def fuse_jointly(
    detections: Path,
    out: Path,
    config: Config,
    label: str,
    *,
    n_vehicles: int | None,
    passes: Path | None,
    prior: Path | None,
    limits: Limits,
    n_workers: int,
    progress: Callable[[int, int], None] | None,
) -> AggregateResult:
    """Fuse every run jointly; beside the layer go `<stem>_evidence.parquet` and `<stem>_nuisance.parquet`."""
    settings = config.aggregate
    before = read_layer(prior).table if prior else None
    driven = read_table(PASSES, passes) if passes else None
    inputs = Hashing(path for path in (detections, passes, prior) if path)
    out.parent.mkdir(parents=True, exist_ok=True)
    connection = connect(threads=n_workers, memory_limit=DUCKDB_MEMORY, spatial=False)
    try:
        staged = stage_tracks(connection, detections, n_vehicles=n_vehicles or 0, limits=limits)
        runs, classes = tuple(sorted(staged.judged.fleet)), joint_classes(staged, before)
        tasks = [
            JointTask(
                run_id=run_id,
                run_code=code,
                tracks=staged.of_run(run_id),
                passes=passes_of_run(driven, run_id, n_vehicles) if driven else None,
                prior=None if before is None else prior_of_run(before, run_id),
                classes=classes,
                assumed=Assumed(settings.assumed_gnss_sigma_m, RANGE_BIAS_SIGMA_M, BEARING_BIAS_SIGMA_DEG),
                prior_sigma_m=settings.prior_sigma_m,
            )
            for code, run_id in enumerate(runs)
        ]
        n_of_class = count_classes(staged)
        found = list(run_tasks(fuse_run, tasks, n_workers=n_workers, progress=progress))
    finally:
        connection.close()
    fleet = {run_id: n_vehicles or reporting for run_id, reporting in staged.judged.fleet.items()}
    of_run = np.array([fleet[run_id] for run_id in runs], np.int64)
    clusters = concatenate([one.clusters for one in found])
    n_signs = write_pieces(
        SIGNS, layer_pieces(clusters, np.zeros(len(clusters.get("lon", ()))), Labels(runs, classes, of_run, label)), out
    )
    for schema, name in ((EVIDENCE, "evidence"), (NUISANCE, "nuisance")):
        tables = [getattr(one, name) for one in found]
        write_table(schema, pa.concat_tables(tables) if tables else schema.arrow().empty_table(), beside(out, name))
    result = AggregateResult(
        out=out,
        label=label,
        rejected=write_rejected(staged.judged.rejected, out),
        skipped=count_reasons(staged.judged.rejected),
        unknown_classes=unknown_classes(n_of_class),
        run_ids=runs,
        n_vehicles=max(fleet.values(), default=0),
        n_detections=staged.judged.n_detections,
        n_rejected=staged.judged.rejected.num_rows,
        n_used=sum(task.tracks.num_rows for task in tasks),
        n_tiles=None,
        n_clusters=sum(one.n_candidates for one in found),
        n_signs=n_signs,
        notes=few(staged.judged.fleet, n_vehicles) + tuple(note for one in found for note in one.notes),
        n_suspect_passes=sum(pc.sum(one.nuisance["is_suspect"]).as_py() or 0 for one in found),
    )
    write_result_manifest(result, inputs, config, limits)
    return result
