"""Simulate: a fleet that drives past real signs and reports what its cameras saw.

Reads a layer of signs and a drive; writes `runs`, `reference`, `passes`, `detections` and, apart, `truth`.
"""

from __future__ import annotations

import hashlib
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np
import pyarrow as pa

from geofleet.algorithms.sensing import sense_pass
from geofleet.algorithms.streams import pass_streams
from geofleet.algorithms.tracking import track_pass
from geofleet.errors import ConfigError, InputError
from geofleet.formats.layers import read_layer
from geofleet.tables.fleets import Fleet, load_fleet
from geofleet.tables.manifest import hash_path, write_manifest
from geofleet.tables.schemas import DETECTIONS, PASSES, REFERENCE, RUNS, TRUTH
from geofleet.tables.simulated import (
    PassIds,
    detections_table,
    passes_table,
    reference_table,
    runs_table,
    truth_table,
)
from geofleet.tables.store import atomic_path, sort_by_key, write_pieces, write_table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.algorithms.billboards import Billboards
    from geofleet.config import Config
    from geofleet.tables.schemas import Schema

    Ints = NDArray[np.int64]
    Progress = Callable[[int, int], None]

VEHICLES_A_PART = 250
"""Vehicles whose tracks are in memory at once, and in one file of `truth`: part of the layout, not a setting."""
FOLDER_A_VEHICLE = 1000
"""Up to so many vehicles have a folder of detections each; those of larger fleets share `N_BUCKETS` by hash."""
N_BUCKETS = 32

_OUTPUTS = {"runs.parquet", "reference.parquet", "passes.parquet", "detections", "truth", "_manifest.json"}
_LIMITS = {
    "n_vehicles": (1, 100_000),
    "n_replicates": (1, 100_000),
    "first_replicate": (0, 100_000),
    "seed": (0, 2**63 - 1),
    "n_workers": (1, 1024),
}
_SHAPING = ("scene", "fleet", "sensor", "tracking", "mixed")


@dataclass(frozen=True, slots=True)
class SimulateResult:
    """What was simulated, and where it lies."""

    out: Path
    run_ids: tuple[str, ...]
    n_signs: int
    n_classes: int
    n_vehicles: int
    n_passes: int
    n_frame_detections: int
    n_detections: int
    drive_length_m: float


@dataclass(frozen=True, slots=True)
class _Run:
    """One replicate: what its passes share, and where it is written."""

    run_id: str
    seed: int
    replicate: int
    n_vehicles: int
    folder: Path
    billboards: Billboards | None


@dataclass(frozen=True, slots=True)
class _PassOutput:
    """What is left of a pass when it is over; its detections too, unless they are on disk."""

    passes: pa.Table
    truth: pa.Table
    detections: pa.Table | None
    frames_in_view: Ints
    n_frame_detections: int


def simulate(
    signs: Path,
    drive: Path,
    out: Path,
    *,
    config: Config,
    n_vehicles: int,
    n_replicates: int = 1,
    first_replicate: int = 0,
    seed: int = 0,
    n_workers: int = 2,
    progress: Progress | None = None,
) -> SimulateResult:
    """Simulate a fleet and write its tables below `out`, whole or not at all.

    The bytes depend on the signs, the drive, the configuration, `n_vehicles`, `n_replicates` and `seed` alone; the
    detections of a vehicle do not depend on how many others there are.

    Parameters
    ----------
    signs, drive
        A `signs` and a `drives` table.
    out
        Folder to write; an earlier simulation there is replaced.
    config
        The sections scene, fleet, sensor and tracking and the kinds of sensors are used.
    n_vehicles, n_replicates, seed
        Passes a run, number of runs, and the seed of all of them.
    first_replicate
        Number of the first run: runs may be simulated apart, and are the same.
    n_workers
        Threads.
    progress
        Called with the passes done and their total.

    Raises
    ------
    ConfigError
        A number is out of range, or what is asked for cannot be: see `load_fleet`.
    InputError
        A table cannot be used, no sign is near the drive, the drive does not move, or `out` holds something else.
    """
    numbers = {"n_vehicles": n_vehicles, "n_replicates": n_replicates, "first_replicate": first_replicate}
    _check_numbers(**numbers, seed=seed, n_workers=n_workers)
    _check_out(out)
    fleet = load_fleet(read_layer(signs).table, drive, source=signs, config=config)
    digest = _digest(config, signs, drive)
    replicates = range(first_replicate, first_replicate + n_replicates)
    run_ids = tuple(_run_id(config.scenario, seed, replicate, digest) for replicate in replicates)
    tally = _Tally(fleet, progress or _silent, n_vehicles * n_replicates)
    with atomic_path(out) as draft, ThreadPoolExecutor(n_workers) as pool:
        draft.mkdir()
        runs = [
            _Run(run_id, seed, replicate, n_vehicles, draft, fleet.billboards(seed, replicate))
            for run_id, replicate in sorted(zip(run_ids, replicates, strict=True))  # by key
        ]
        pieces = (piece for run in runs for piece in _parts_of_run(fleet, run, tally, pool))
        write_pieces(PASSES, pieces, draft / "passes.parquet")
        table = runs_table(
            config, dict(zip(run_ids, replicates, strict=True)), seed=seed, n_vehicles=n_vehicles, digest=digest
        )
        write_table(RUNS, table, draft / "runs.parquet")
        write_table(REFERENCE, _together(REFERENCE, tally.references), draft / "reference.parquet")
    result = SimulateResult(
        out=out,
        run_ids=run_ids,
        n_signs=len(fleet.scene.sign_ids),
        n_classes=len(fleet.scene.classes),
        n_vehicles=n_vehicles,
        n_passes=tally.n_done,
        n_frame_detections=tally.n_frame_detections,
        n_detections=tally.n_detections,
        drive_length_m=fleet.length_m,
    )
    _manifest(result, signs, drive, config, seed)
    return result


class _Tally:
    """What accumulates over the passes of all runs."""

    def __init__(self, fleet: Fleet, progress: Progress, total: int) -> None:
        self.references: list[pa.Table] = []
        self.n_done = self.n_frame_detections = self.n_detections = 0
        self._scene = fleet.scene
        self._progress, self._total = progress, total
        self._in_view = np.zeros((2, len(fleet.scene.sign_ids)), dtype=np.int64)

    def add(self, output: _PassOutput) -> None:
        self._in_view += np.stack((output.frames_in_view > 0, output.frames_in_view))
        self.n_frame_detections += output.n_frame_detections
        self.n_detections += output.truth.num_rows
        self.n_done += 1
        self._progress(self.n_done, self._total)

    def close_run(self, run_id: str) -> None:
        """Keep what the passes of a run had in view, and start anew."""
        self.references.append(reference_table(self._scene, run_id, *self._in_view))
        self._in_view[:] = 0


def _silent(_done: int, _total: int) -> None:
    """Take the place of a progress callback."""


def _parts_of_run(fleet: Fleet, run: _Run, tally: _Tally, pool: ThreadPoolExecutor) -> Iterator[pa.Table]:
    """Simulate one pass a vehicle, in order; write all but `passes`, which is returned part by part."""
    for part, first in enumerate(range(0, run.n_vehicles, VEHICLES_A_PART)):
        outputs = []
        vehicles = range(first, min(first + VEHICLES_A_PART, run.n_vehicles))
        for output in pool.map(partial(_simulate_pass, fleet, run), vehicles):
            tally.add(output)
            outputs.append(output)
        truth = _together(TRUTH, [output.truth for output in outputs])
        write_table(TRUTH, truth, _folder(run, "truth") / f"part-{part}.parquet")
        shared = [output.detections for output in outputs if output.detections is not None]
        if shared:
            _write_buckets(_together(DETECTIONS, shared), run, part)
        yield _together(PASSES, [output.passes for output in outputs])
    tally.close_run(run.run_id)


def _simulate_pass(fleet: Fleet, run: _Run, vehicle: int) -> _PassOutput:
    """Drive, sense, track and write the detections of one pass."""
    streams = pass_streams(run.seed, replicate=run.replicate, vehicle=vehicle)
    drive = fleet.start(vehicle, streams)
    sensed = sense_pass(drive.true, fleet.scene.field, drive.kind.sensor, streams, run.billboards)
    tracks = track_pass(sensed.detections, sensed.reported, drive.kind.tracker, streams)
    ids = PassIds.of(run.run_id, vehicle)
    table = detections_table(ids, tracks, fleet.scene.classes, fleet.frame, drive.times)
    if run.n_vehicles <= FOLDER_A_VEHICLE:
        folder = _folder(run, "detections", f"vehicle_id={ids.vehicle_id}")
        write_table(DETECTIONS, table.drop_columns(list(DETECTIONS.partitions)), folder / "part-0.parquet")
    return _PassOutput(
        passes_table(
            *(ids, sensed.reported, fleet.frame, drive.times),
            drive_id=drive.way.drive.drive_id,
            sensor=drive.kind.config,
            declared=drive.kind.declared,
            frame_spacing_m=drive.frame_spacing_m
            if fleet.config.fleet.frame_rate_hz
            else fleet.config.fleet.frame_spacing_m,
        ),
        truth_table(ids, tracks, fleet.scene),
        None if run.n_vehicles <= FOLDER_A_VEHICLE else table,
        np.bincount(sensed.in_view.sign, minlength=len(fleet.scene.sign_ids)),
        len(sensed.detections.frame),
    )


def _write_buckets(detections: pa.Table, run: _Run, part: int) -> None:
    """Write the detections of many vehicles into the buckets that their ids hash to."""
    vehicles = detections["vehicle_id"].combine_chunks().dictionary_encode()
    bucket_of = np.array([crc32(name.encode()) % N_BUCKETS for name in vehicles.dictionary.to_pylist()])
    bucket = bucket_of[vehicles.indices.to_numpy()]
    plain = detections.drop_columns(["run_id"])
    for number in np.unique(bucket).tolist():
        folder = _folder(run, "detections", f"bucket={number:02d}")
        write_table(DETECTIONS, plain.filter(pa.array(bucket == number)), folder / f"part-{part}.parquet")


def _folder(run: _Run, table: str, *partitions: str) -> Path:
    """Return a folder of a run, made."""
    folder = run.folder.joinpath(table, f"run_id={run.run_id}", *partitions)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _manifest(result: SimulateResult, signs: Path, drive: Path, config: Config, seed: int) -> None:
    write_manifest(
        result.out,
        step="simulate",
        inputs=(signs, drive),
        config_digest=config.digest(*_SHAPING),
        settings={"seed": seed} | config.model_dump(include=set(_SHAPING)),
        counts={
            name: getattr(result, name)
            for name in ("n_signs", "n_classes", "n_vehicles", "n_passes", "n_frame_detections", "n_detections")
        },
    )


def _check_numbers(**numbers: int) -> None:
    for name, number in numbers.items():
        least, most = _LIMITS[name]
        if not least <= number <= most:
            raise ConfigError(f"{name} is {number}.", todo=f"Set {name} between {least} and {most}.")


def _check_out(out: Path) -> None:
    """Refuse to replace a file, or a folder that holds anything but an earlier simulation."""
    if out.is_file():
        raise InputError("this is a file, and a folder is to be written.", where=str(out), todo="Give a folder.")
    strange = sorted({p.name for p in out.iterdir()} - _OUTPUTS) if out.is_dir() else []
    if strange:
        raise InputError(
            f"the folder holds {', '.join(strange[:3])}, which no simulation wrote.",
            where=str(out),
            todo="Give a new folder, or one of an earlier simulation, which is replaced.",
        )


def _digest(config: Config, *inputs: Path) -> str:
    """Return 16 hex digits of the SHA-256 of everything that shapes a run but its seed and replicate."""
    parts = (config.digest(*_SHAPING), *(hash_path(path) for path in inputs))
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:16]


def _run_id(scenario: str, seed: int, replicate: int, digest: str) -> str:
    """Return the name of a run; it becomes the name of a folder, so odd characters of a scenario become dashes."""
    return f"{re.sub(r'[^A-Za-z0-9._-]', '-', scenario)}-s{seed}-r{replicate}-{digest[:8]}"


def _together(schema: Schema, tables: list[pa.Table]) -> pa.Table:
    return sort_by_key(schema, pa.concat_tables(tables))
