"""Aggregate: the detections of many passes become one layer of signs.

DuckDB judges the detections, numbers passes and classes and deals them into batches of tiles with their halos; each
batch is clustered and fused on a thread of its own; what crosses tile borders is joined here. Runs are never mixed.
Tiles, batches and workers do not show in the result (`algorithms.tiling` says why). K-Means, K-Medoids, HDBSCAN and
joint fusion see a run as a whole.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from geofleet.algorithms.tiling import halo_m
from geofleet.engines.batches import TileTask, cluster_batch, concatenate, fuse_open, splitter
from geofleet.engines.joint import JointTask, fuse_run
from geofleet.engines.local import run_tasks
from geofleet.engines.whole import RunTask, cluster_run
from geofleet.errors import ConfigError, InputError
from geofleet.formats.layers import read_layer
from geofleet.tables.biases import BEARING_BIAS_SIGMA_DEG, RANGE_BIAS_SIGMA_M
from geofleet.tables.database import connect
from geofleet.tables.dealt import batch_path
from geofleet.tables.fused import Labels, layer_pieces
from geofleet.tables.manifest import Hashing, write_manifest
from geofleet.tables.opportunities import opportunities, read_passes
from geofleet.tables.reference_counts import reference_counts
from geofleet.tables.schemas import EVIDENCE, NUISANCE, PASSES, SIGNS
from geofleet.tables.staging import Staged, stage_detections
from geofleet.tables.store import atomic_path, read_table, write_pieces, write_table
from geofleet.tables.tracks import Assumed
from geofleet.tables.tracks_staging import joint_classes, passes_of_run, prior_of_run, stage_tracks

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from geofleet.algorithms.partitions import Method
    from geofleet.config import AggregateConfig, Config

    Columns = dict[str, NDArray[Any]]
    Ints = NDArray[np.int64]

BATCH_ROWS = 100_000  # detections that one thread clusters at a time: tens of megabytes
DUCKDB_MEMORY = "250MB"  # what its joins and groups may hold before they spill


@dataclass(frozen=True, slots=True)
class AggregateResult:
    """What became of the detections.

    `n_detections` and `n_rejected` count the whole table, `n_used` the vehicles asked for; signs are clusters with
    enough passes.
    """

    out: Path
    rejected: Path | None
    run_ids: tuple[str, ...]
    n_vehicles: int
    n_detections: int
    n_rejected: int
    n_used: int
    n_tiles: int
    n_clusters: int
    n_signs: int
    notes: tuple[str, ...] = ()

    def summary(self) -> list[str]:
        """Return the result in sentences."""
        lines = [
            (
                f"{self.n_signs} signs from {self.n_used} of {self.n_detections} detections of {self.n_vehicles} "
                f"vehicles in {len(self.run_ids)} run(s): {self.n_clusters} clusters in {self.n_tiles or 'no'} tiles, "
                f"{self.n_clusters - self.n_signs} with too little support."
            ),
            *self.notes,
        ]
        if self.rejected:
            lines.append(f"{self.n_rejected} detections could not be used: {self.rejected}")
        return [*lines, f"Written: {self.out}"]


def aggregate(
    detections: Path,
    out: Path,
    *,
    config: Config,
    n_vehicles: int | None = None,
    passes: Path | None = None,
    k_from: Path | None = None,
    prior: Path | None = None,
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
    label = _label(settings, k_from, prior)
    if settings.method == "joint":
        return _fuse_jointly(
            detections,
            out,
            config,
            label,
            n_vehicles=n_vehicles,
            passes=passes,
            prior=prior,
            n_workers=n_workers,
            progress=progress,
        )
    driven = read_passes(passes) if passes else None
    counts = reference_counts(k_from, semantic=settings.semantic) if k_from else None
    inputs = Hashing(path for path in (detections, passes, k_from) if path)
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=out.parent, prefix=f".{out.stem}.") as folder:
        staged = _stage(detections, Path(folder), settings, n_vehicles=n_vehicles, passes=passes, n_workers=n_workers)
        method = settings.method
        if method == "dbscan":
            tasks = _tile_tasks(staged, settings)
            results = list(run_tasks(cluster_batch, tasks, n_workers=n_workers, progress=progress))
            crossing = fuse_open([r.open_rows for r in results], splitter(tasks[0]) if tasks else None)
            clusters = concatenate([*(r.clusters for r in results), crossing])
        else:
            whole = _run_tasks(staged, settings, method, counts)
            clusters = concatenate(list(run_tasks(cluster_run, whole, n_workers=1, progress=progress)))
    fleet = {run_id: n_vehicles or reporting for run_id, reporting in staged.fleet.items()}
    if driven and clusters:
        clusters["n_opportunities"] = _opportunities(clusters, driven, sorted(fleet), n_vehicles)
    of_run = np.array([fleet[run_id] for run_id in sorted(fleet)], np.int64)
    labels = Labels(tuple(sorted(fleet)), staged.classes, of_run, label)
    n_signs = write_pieces(SIGNS, layer_pieces(clusters, _support(clusters, of_run, settings), labels), out)
    result = AggregateResult(
        out=out,
        rejected=_write_rejected(staged.rejected, out),
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
    _write_manifest(result, inputs, config)
    return result


def _fuse_jointly(
    detections: Path,
    out: Path,
    config: Config,
    label: str,
    *,
    n_vehicles: int | None,
    passes: Path | None,
    prior: Path | None,
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
        staged = stage_tracks(connection, detections, n_vehicles=n_vehicles or 0)
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
        rejected=_write_rejected(staged.judged.rejected, out),
        run_ids=runs,
        n_vehicles=max(fleet.values(), default=0),
        n_detections=staged.judged.n_detections,
        n_rejected=staged.judged.rejected.num_rows,
        n_used=sum(task.tracks.num_rows for task in tasks),
        n_tiles=0,
        n_clusters=sum(one.n_candidates for one in found),
        n_signs=n_signs,
        notes=_few(staged.judged.fleet, n_vehicles) + tuple(note for one in found for note in one.notes),
    )
    _write_manifest(result, inputs, config)
    return result


def beside(out: Path, name: str) -> Path:
    """Return where the side table of a layer is."""
    return out.with_name(f"{out.stem}_{name}.parquet")


def explain(out: Path, sign_id: str) -> pa.Table:
    """Return the evidence of a sign of a jointly fused layer: detections, passes, residuals and classes read.

    Raises
    ------
    InputError
        The layer has no evidence beside it, or no such sign.
    """
    evidence = read_table(EVIDENCE, beside(out, "evidence"))
    rows = evidence.filter(pc.equal(evidence["sign_id"], sign_id))
    if rows.num_rows == 0:
        raise InputError(
            f"no detection belongs to a sign {sign_id!r}.",
            where=str(beside(out, "evidence")),
            todo="Take a sign_id of the layer; one that only the prior map knows has no detections.",
        )
    return rows


def _label(settings: AggregateConfig, k_from: Path | None, prior: Path | None) -> str:
    """Return how the layer calls its method; where K came from and whether biases are taken out are part of it."""
    if prior and settings.method != "joint":
        raise ConfigError(f"{settings.method} takes no prior map.", where="--prior", todo="Use --method joint.")
    if settings.method == "joint":
        if settings.correct_bias or settings.k or k_from:
            raise ConfigError(
                "joint fusion solves the bias of each pass itself and takes no K.",
                where="--correct-bias, --k, --k-from",
                todo="Leave them out.",
            )
        return "joint-prior" if prior else "joint"
    label = f"{settings.method}-{settings.semantic}{'-corrected' * settings.correct_bias}"
    if settings.method not in {"kmeans", "kmedoids"}:
        if k_from or settings.k:
            raise ConfigError(
                f"{settings.method} takes no K.", where="--k", todo="Leave it out, or use kmeans or kmedoids."
            )
        return label
    if settings.k and k_from:
        raise ConfigError("K is given twice.", where="--k and --k-from", todo="Give one of them.")
    if settings.k and settings.semantic == "first":
        raise ConfigError(
            f"k={settings.k} is for all classes together, and semantic=first clusters each class by itself.",
            where="--k",
            todo="Use --k-from REFERENCE for the number of signs a class, or leave K out to have it chosen.",
        )
    return f"{label}-oracle-k" if k_from else f"{label}-k{settings.k}" if settings.k else label


def _stage(
    detections: Path,
    folder: Path,
    settings: AggregateConfig,
    *,
    n_vehicles: int | None,
    passes: Path | None,
    n_workers: int,
) -> Staged:
    connection = connect(threads=n_workers, memory_limit=DUCKDB_MEMORY, spatial=False)
    try:
        return stage_detections(
            connection,
            detections,
            folder,
            zoom=settings.tile_zoom,
            halo_m=halo_m(settings.eps_m) if settings.method == "dbscan" else 0.0,
            batch_rows=BATCH_ROWS,
            n_vehicles=n_vehicles or 0,
            passes=passes,
            correct_bias=settings.correct_bias,
        )
    finally:
        connection.close()
        pa.default_memory_pool().release_unused()


def _tile_tasks(staged: Staged, settings: AggregateConfig) -> list[TileTask]:
    """Return one task a batch; its tiles are consecutive."""
    names, runs = staged.tiles["tile"].to_pylist(), _run_codes(staged).tolist()
    numbers, starts = np.unique(staged.tiles["batch"].to_numpy(), return_index=True)
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


def _run_tasks(
    staged: Staged, settings: AggregateConfig, method: Method, counts: dict[tuple[str, str], int] | None
) -> list[RunTask]:
    """Return one task a run that has usable detections; its tiles are consecutive."""
    batch, n_points = staged.tiles["batch"].to_numpy(), staged.tiles["n_points"].to_numpy()
    run_codes, starts = np.unique(_run_codes(staged), return_index=True)
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
        for code, start, stop in zip(run_codes.tolist(), starts.tolist(), stops.tolist(), strict=True)
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


def _run_codes(staged: Staged) -> Ints:
    codes = {run_id: code for code, run_id in enumerate(sorted(staged.fleet))}
    return np.array([codes[run_id] for run_id in staged.tiles["run_id"].to_pylist()], np.int64)


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


def _write_rejected(rejected: pa.Table, out: Path) -> Path | None:
    """Write the rejected rows beside the output; without any, remove what an earlier run left there."""
    path = out.with_name(f"{out.stem}_rejected.parquet")
    if rejected.num_rows == 0:
        path.unlink(missing_ok=True)
        return None
    with atomic_path(path) as draft:
        pq.write_table(rejected, draft, compression="zstd")
    return path


def _notes(staged: Staged, n_vehicles: int | None) -> tuple[str, ...]:
    """Return what the user should know beside the counts."""
    return _few(staged.fleet, n_vehicles) + (staged.bias.notes() if staged.bias else ())


def _few(fleet: dict[str, int], n_vehicles: int | None) -> tuple[str, ...]:
    """Return where fewer vehicles report than were asked for."""
    if not fleet:
        return ("There are no detections: the layer is empty.",)
    return tuple(
        f"Run {run_id}: {reporting} of the {n_vehicles} vehicles asked for have detections."
        for run_id, reporting in fleet.items()
        if n_vehicles and reporting < n_vehicles
    )


def _write_manifest(result: AggregateResult, inputs: Hashing, config: Config) -> None:
    names = ("n_vehicles", "n_detections", "n_rejected", "n_used", "n_clusters", "n_signs")
    write_manifest(
        result.out,
        step="aggregate",
        inputs=inputs,
        config_digest=config.digest("aggregate"),
        settings=config.aggregate.model_dump(),
        counts={name: getattr(result, name) for name in names},
    )
