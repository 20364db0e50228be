"""Aggregate: the detections of many passes become one layer of signs.

DuckDB judges the detections, numbers passes and classes and deals them into batches of tiles with their halos; each
batch is clustered and fused on a thread of its own; what crosses tile borders is joined here. Runs are never mixed.
Tiles, batches and workers do not show in the result (`algorithms.tiling` says why).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from geofleet.algorithms.fusion import fuse, hash_members, information_weights, name_hashes, vote
from geofleet.algorithms.tiling import cluster_tiles, halo_m, join_open, quadkey_bounds
from geofleet.engines.local import run_tasks
from geofleet.tables.database import connect
from geofleet.tables.manifest import write_manifest
from geofleet.tables.schemas import SIGNS
from geofleet.tables.staging import Staged, stage_detections
from geofleet.tables.store import atomic_path, build_table, write_table
from geofleet.taxonomy.reader import load_taxonomy

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from geofleet.config import AggregateConfig, Config

    Columns = dict[str, NDArray[Any]]
    Ints = NDArray[np.int64]

BATCH_ROWS = 200_000  # detections that one thread clusters at a time: tens of megabytes
_NUMBERED_CLASS = re.compile(r"(?P<concept>[^:]+):(?P<value>-?\d+(\.\d+)?)(?P<unit>\D*)")
_FUSED = (
    *("var_e_m2", "var_n_m2", "cov_en_m2", "class_confidence", "n_passes", "n_detections"),
    *("run_id", "method", "n_vehicles"),
)  # the optional columns of the layer
_LONG_AGO, _FAR_AHEAD = np.iinfo(np.int64).min, np.iinfo(np.int64).max
_MISSING = {"t_first_us": _FAR_AHEAD, "t_last_us": _LONG_AGO}


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
                f"vehicles in {len(self.run_ids)} run(s): {self.n_clusters} clusters in {self.n_tiles} tiles, "
                f"{self.n_clusters - self.n_signs} with too few passes."
            ),
            *self.notes,
        ]
        if self.rejected:
            lines.append(f"{self.n_rejected} detections could not be used: {self.rejected}")
        return [*lines, f"Written: {self.out}"]


@dataclass(frozen=True, slots=True)
class _Task:
    """A batch of tiles: plain data, so that it can be sent anywhere."""

    folder: Path
    first_tile: int
    tiles: tuple[str, ...]
    runs: tuple[int, ...]
    eps_m: float
    min_samples: int
    semantic: str


@dataclass(frozen=True, slots=True, eq=False)
class _BatchResult:
    """Fused signs of the closed clusters, and the rows of the open ones."""

    signs: Columns
    open_rows: Columns


def aggregate(
    detections: Path,
    out: Path,
    *,
    config: Config,
    n_vehicles: int | None = None,
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
    n_workers
        Threads.
    progress
        Called with the number of batches done and to do.

    Raises
    ------
    InputError
        The table cannot be read.
    TableError
        A column is missing or mistyped.
    """
    settings = config.aggregate
    out.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=out.parent, prefix=f".{out.stem}.") as folder:
        connection = connect(threads=n_workers)
        staged = stage_detections(
            connection,
            detections,
            Path(folder),
            zoom=settings.tile_zoom,
            halo_m=halo_m(settings.eps_m),
            batch_rows=BATCH_ROWS,
            n_vehicles=n_vehicles or 0,
        )
        connection.close()
        tasks = _tasks(staged, settings)
        batches = list(run_tasks(_aggregate_batch, tasks, n_workers=n_workers, progress=progress))
    clusters = _concatenate([*(b.signs for b in batches), _fuse_open([b.open_rows for b in batches])])
    fleet = {run_id: n_vehicles or reporting for run_id, reporting in staged.fleet.items()}
    signs = _layer(clusters, staged, fleet, settings)
    write_table(SIGNS, signs, out)
    result = AggregateResult(
        out=out,
        rejected=_write_rejected(staged.rejected, out),
        run_ids=tuple(fleet),
        n_vehicles=max(fleet.values(), default=0),
        n_detections=staged.n_detections,
        n_rejected=staged.rejected.num_rows,
        n_used=int(pc.sum(staged.tiles["n_points"]).as_py() or 0),
        n_tiles=staged.tiles.num_rows,
        n_clusters=len(clusters["lon"]) if clusters else 0,
        n_signs=signs.num_rows,
        notes=_notes(staged, n_vehicles),
    )
    _write_manifest(result, detections, config)
    return result


def _write_rejected(rejected: pa.Table, out: Path) -> Path | None:
    """Write the rejected rows beside the output; without any, remove what an earlier run left there."""
    path = out.with_name(f"{out.stem}_rejected.parquet")
    if rejected.num_rows == 0:
        path.unlink(missing_ok=True)
        return None
    with atomic_path(path) as draft:
        pq.write_table(rejected, draft, compression="zstd")
    return path


def _tasks(staged: Staged, settings: AggregateConfig) -> list[_Task]:
    """Return one task a batch; its tiles are consecutive."""
    tiles = staged.tiles
    names, run_ids = tiles["tile"].to_pylist(), tiles["run_id"].to_pylist()
    run_code = {run_id: code for code, run_id in enumerate(sorted(staged.fleet))}
    runs = [run_code[run_id] for run_id in run_ids]
    numbers, starts = np.unique(tiles["batch"].to_numpy(), return_index=True)
    stops = np.append(starts, len(names))[1:]
    return [
        _Task(
            folder=staged.folder / f"{number}.parquet",
            first_tile=start,
            tiles=tuple(names[start:stop]),
            runs=tuple(runs[start:stop]),
            eps_m=settings.eps_m,
            min_samples=settings.min_samples,
            semantic=settings.semantic,
        )
        for number, start, stop in zip(numbers.tolist(), starts.tolist(), stops.tolist(), strict=True)
    ]


def _aggregate_batch(task: _Task) -> _BatchResult:
    """Cluster one batch of tiles, fuse the clusters that are all its own and hand back the others."""
    rows = _read_rows(task)
    bounds = quadkey_bounds(task.tiles)
    clusters = cluster_tiles(
        rows["lon"],
        rows["lat"],
        tile=rows["tile_code"] - task.first_tile,
        tile_centres_deg=np.column_stack((bounds[:, [0, 2]].mean(axis=1), bounds[:, [1, 3]].mean(axis=1))),
        is_owned=rows["is_owned"],
        codes=rows["class_code"] if task.semantic == "first" else np.zeros_like(rows["class_code"]),
        eps_m=task.eps_m,
        min_samples=task.min_samples,
    )
    open_rows = {name: values[clusters.open_row] for name, values in rows.items()}
    open_rows |= {"cluster": clusters.open_cluster, "is_core": clusters.open_is_core}
    closed = {name: values[clusters.closed_row] for name, values in rows.items()}
    return _BatchResult(_fuse_members(closed, clusters.closed_cluster), open_rows)


def _read_rows(task: _Task) -> Columns:
    """Read the rows of a batch; a missing time is one that no minimum or maximum takes, other missing numbers NaN."""
    table = pq.read_table(task.folder, use_threads=False)
    rows: Columns = {}
    for name in table.column_names:
        column = table[name]
        if name in _MISSING:
            column = pc.fill_null(column, _MISSING[name])
        rows[name] = column.to_numpy()
    for name in ("n_frames", "spread_m2", "class_confidence"):
        rows[name] = rows[name].astype(np.float64)
    rows["run_code"] = np.asarray(task.runs, np.int64)[rows["tile_code"] - task.first_tile]
    return rows


def _fuse_members(rows: Columns, cluster: Ints) -> Columns:
    """Return one row a cluster; members are put in the order of their keys first."""
    if cluster.size == 0:
        return {}
    order = np.lexsort((rows["track_id"], rows["pass_code"], cluster))
    rows = {name: values[order] for name, values in rows.items()}
    first = np.append(np.flatnonzero(np.diff(cluster[order], prepend=-1)), cluster.size)
    lead = first[:-1]
    fused = fuse(
        rows["lon"],
        rows["lat"],
        weight=information_weights(rows["n_frames"], rows["spread_m2"]),
        pass_code=rows["pass_code"],
        first=first,
    )
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


def _fuse_open(parts: Sequence[Columns]) -> Columns:
    """Join the open clusters of all batches and fuse them."""
    n_before = 0
    numbered = []
    for part in parts:
        # a cluster belongs to one tile, and clusters are numbered within a batch
        numbered.append(part | {"cluster": part["cluster"] + n_before})
        n_before += int(part["cluster"].max(initial=-1)) + 1
    rows = _concatenate(numbered)
    if not rows:
        return {}
    order = np.lexsort((rows["track_id"], rows["pass_code"]))
    is_new = (np.diff(rows["pass_code"][order], prepend=-1) != 0) | (np.diff(rows["track_id"][order], prepend=0) != 0)
    point = np.empty(len(order), np.int64)
    point[order] = np.cumsum(is_new)
    row, cluster = join_open(point, rows["cluster"], rows["is_core"], rows["is_owned"])
    return _fuse_members({name: values[row] for name, values in rows.items()}, cluster)


def _concatenate(parts: Sequence[Columns]) -> Columns:
    """Stack columns; parts without any are skipped."""
    parts = [part for part in parts if part]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else {}


def _layer(clusters: Columns, staged: Staged, fleet: dict[str, int], settings: AggregateConfig) -> pa.Table:
    """Return the `signs` table of the clusters that enough passes support."""
    if not clusters:
        return SIGNS.arrow(_FUSED).empty_table()
    run_ids = sorted(fleet)
    n_vehicles = np.array([fleet[run_id] for run_id in run_ids], np.int64)[clusters["run_code"]]
    support = np.maximum(settings.min_support, settings.min_support_share * n_vehicles)
    # in an order that comes from the clusters alone: it tells ids that collide apart
    order = np.lexsort((clusters["lat"], clusters["lon"], clusters["class_code"], clusters["run_code"]))
    order = order[(clusters["n_passes"] >= support)[order]]
    kept = {name: values[order] for name, values in clusters.items()}
    meanings = [_meaning(name) for name in staged.classes]
    runs = pa.array(run_ids, pa.string()).take(pa.array(kept["run_code"]))
    columns = {
        "sign_id": name_hashes(kept["hash"].astype(np.uint64)),
        "kind": "main",
        **{
            name: pa.array([meaning[name] for meaning in meanings], kind).take(pa.array(kept["class_code"]))
            for name, kind in (("concept", pa.string()), ("value", pa.float64()), ("unit", pa.string()))
        },
        "sign_class": (names := pa.array(staged.classes, pa.string()).take(pa.array(kept["class_code"]))),
        "raw_code": names,
        "source": "geofleet",
        "source_ref": runs,
        "first_seen": _times(kept["t_first_us"], _FAR_AHEAD),
        "last_seen": _times(kept["t_last_us"], _LONG_AGO),
        **{
            name: pa.array(kept[name].astype(np.float64), from_pandas=True)
            for name in ("var_e_m2", "var_n_m2", "cov_en_m2", "class_confidence")
        },
        "n_passes": kept["n_passes"],
        "n_detections": kept["n_detections"],
        "run_id": runs,
        "method": f"{settings.method}-{settings.semantic}",
        "n_vehicles": n_vehicles[order],
    }
    return build_table(SIGNS, columns, geometry=(kept["lon"].astype(np.float64), kept["lat"].astype(np.float64)))


def _times(microseconds: Ints, missing: int) -> pa.Array:
    return pa.array(microseconds, mask=microseconds == missing).cast(pa.timestamp("us", tz="UTC"))


def _meaning(sign_class: str) -> dict[str, Any]:
    """Return concept, value and unit of a class: `concept`, `concept:number`, or with a unit other than the concept's.

    Any other text, such as `raw:<code>`, is its own concept.
    """
    concepts = load_taxonomy().concepts
    found = _NUMBERED_CLASS.fullmatch(sign_class)
    if not found or found["concept"] == "raw":
        return {"concept": sign_class, "value": None, "unit": None}
    own = concepts[found["concept"]].unit if found["concept"] in concepts else ""
    return {"concept": found["concept"], "value": float(found["value"]), "unit": found["unit"] or own or None}


def _notes(staged: Staged, n_vehicles: int | None) -> tuple[str, ...]:
    """Return what the user should know beside the counts."""
    if not staged.fleet:
        return ("There are no detections: the layer is empty.",)
    return tuple(
        f"Run {run_id}: {reporting} of the {n_vehicles} vehicles asked for have detections."
        for run_id, reporting in staged.fleet.items()
        if n_vehicles and reporting < n_vehicles
    )


def _write_manifest(result: AggregateResult, detections: Path, config: Config) -> None:
    names = ("n_vehicles", "n_detections", "n_rejected", "n_used", "n_clusters", "n_signs")
    write_manifest(
        result.out,
        step="aggregate",
        inputs=(detections,),
        config_digest=config.digest("aggregate"),
        settings=config.aggregate.model_dump(),
        counts={name: getattr(result, name) for name in names},
    )
