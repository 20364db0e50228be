"""Simulate: a fleet that drives past real signs and reports what its cameras saw.

Reads a layer of signs and a drive; writes `runs`, `reference`, `passes`, `detections` and, apart, `truth`.
"""

from __future__ import annotations

import hashlib
import re
from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from itertools import groupby, islice
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np
import pyarrow as pa

from geofleet.algorithms.sensing_chain import sense_passes
from geofleet.algorithms.streams import pass_streams
from geofleet.algorithms.tracking import track_passes
from geofleet.errors import ConfigError, InputError
from geofleet.formats.layers import read_drives, read_layer
from geofleet.tables.fleets import Fleet, load_fleet, together
from geofleet.tables.manifest import hash_path, write_manifest
from geofleet.tables.schemas import DETECTIONS, PASSES, REFERENCE, RUNS, TRUTH
from geofleet.tables.simulated import (
    PassIds,
    SimulatedPasses,
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
    from geofleet.algorithms.sensing import PassSensing
    from geofleet.algorithms.streams import PassStreams
    from geofleet.config import Config
    from geofleet.tables.fleets import Pass
    from geofleet.tables.schemas import Schema

    Ints = NDArray[np.int64]
    Progress = Callable[[int, int], None]

VEHICLES_A_PART = 250
"""Vehicles whose tracks are in memory at once, and in one file of `truth`: part of the layout, not a setting."""
VEHICLES_A_BATCH = 25
"""Vehicles that a worker simulates before it makes tables of what they send: a table costs as much as two passes."""
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
    n_buckets: int | None  # None: a folder a vehicle


@dataclass(frozen=True, slots=True)
class _Batch:
    """Some vehicles of a run that one worker simulates in a row, and the part of the run that they belong to."""

    run: _Run
    part: int
    vehicles: range


@dataclass(frozen=True, slots=True)
class _BatchOutput:
    """What is left of a batch when it is over; its detections too, unless they are on disk."""

    batch: _Batch
    passes: pa.Table
    truth: pa.Table
    detections: pa.Table | None
    in_view: Ints  # (2, n_signs): passes and frames that had each sign in view
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
    n_buckets: int | None = None,
    n_workers: int = 2,
    progress: Progress | None = None,
) -> SimulateResult:
    """Simulate a fleet and write its tables below `out`, whole or not at all.

    The bytes depend on the signs, the drive, the configuration, `n_vehicles`, `n_replicates` and `seed` alone; the
    detections of a vehicle do not depend on how many others there are.

    Parameters
    ----------
    signs, drive
        A layer and a drive in any format that `read_layer` and `read_drives` know.
    out
        Folder to write; an earlier simulation there is replaced.
    config
        The sections scene, fleet, sensor and tracking and the kinds of sensors are used.
    n_vehicles, n_replicates, seed
        Passes a run, number of runs, and the seed of all of them.
    first_replicate
        Number of the first run: runs may be simulated apart, and are the same.
    n_buckets
        Hashed buckets that the detections of a run lie in; by default a folder a vehicle, `N_BUCKETS` for large fleets.
    n_workers
        Threads.
    progress
        Called with the passes done and their total.

    Raises
    ------
    ConfigError
        A number is out of range, or what is asked for cannot be: see `load_fleet`.
    InputError
        A file cannot be read, no sign is near the drive, the drive does not move, or `out` holds something else.
    """
    numbers = {"n_vehicles": n_vehicles, "n_replicates": n_replicates, "first_replicate": first_replicate}
    _check_numbers(**numbers, seed=seed, n_workers=n_workers)
    _check_out(out)
    fleet = load_fleet(read_layer(signs).table, read_drives(drive).table, source=signs, drive=drive, config=config)
    digest = _digest(config, signs, drive)
    replicates = range(first_replicate, first_replicate + n_replicates)
    run_ids = tuple(_run_id(config.scenario, seed, replicate, digest) for replicate in replicates)
    if n_buckets is None and n_vehicles > FOLDER_A_VEHICLE:
        n_buckets = N_BUCKETS
    tally = _Tally(fleet, progress or _silent, n_vehicles * n_replicates)
    with atomic_path(out) as draft, ThreadPoolExecutor(n_workers) as pool:
        draft.mkdir()
        runs = [
            _Run(run_id, seed, replicate, n_vehicles, draft, fleet.billboards(seed, replicate), n_buckets)
            for run_id, replicate in sorted(zip(run_ids, replicates, strict=True))  # by key
        ]
        outputs = _in_order(pool, partial(_simulate_batch, fleet), _batches(runs), ahead=2 * n_workers)
        write_pieces(PASSES, _parts(outputs, tally), draft / "passes.parquet")
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
        progress(0, total)

    def add(self, output: _BatchOutput) -> None:
        """Count what a batch did; with the last one of a run, keep what its passes had in view, and start anew."""
        batch = output.batch
        self._in_view += output.in_view
        self.n_frame_detections += output.n_frame_detections
        self.n_detections += output.truth.num_rows
        for _ in batch.vehicles:
            self.n_done += 1
            self._progress(self.n_done, self._total)
        if batch.vehicles.stop == batch.run.n_vehicles:
            self.references.append(reference_table(self._scene, batch.run.run_id, *self._in_view))
            self._in_view[:] = 0


def _silent(_done: int, _total: int) -> None:
    """Take the place of a progress callback."""


def _batches(runs: list[_Run]) -> Iterator[_Batch]:
    """Deal the vehicles of all runs, in order, to batches; a batch lies in one part."""
    for run in runs:
        for part, first in enumerate(range(0, run.n_vehicles, VEHICLES_A_PART)):
            last = min(first + VEHICLES_A_PART, run.n_vehicles)
            for begin in range(first, last, VEHICLES_A_BATCH):
                yield _Batch(run, part, range(begin, min(begin + VEHICLES_A_BATCH, last)))


def _in_order(
    pool: ThreadPoolExecutor, work: Callable[[_Batch], _BatchOutput], batches: Iterator[_Batch], ahead: int
) -> Iterator[_BatchOutput]:
    """Yield what comes of each batch, in order, while workers are at most so many batches ahead."""
    waiting = deque(pool.submit(work, batch) for batch in islice(batches, ahead))
    try:
        while waiting:
            output = waiting.popleft().result()
            waiting.extend(pool.submit(work, batch) for batch in islice(batches, 1))
            yield output
    finally:
        for future in waiting:
            future.cancel()


def _parts(outputs: Iterator[_BatchOutput], tally: _Tally) -> Iterator[pa.Table]:
    """Write what the batches of each part left, all but `passes`, which is returned part by part."""
    for _, group in groupby(outputs, key=lambda output: (output.batch.run.run_id, output.batch.part)):
        part = []
        for output in group:
            tally.add(output)
            part.append(output)
        run, number = part[0].batch.run, part[0].batch.part
        truth = _together(TRUTH, [output.truth for output in part])
        write_table(TRUTH, truth, _folder(run, "truth") / f"part-{number}.parquet")
        shared = [output.detections for output in part if output.detections is not None]
        if shared:
            _write_buckets(_together(DETECTIONS, shared), run, number)
        yield _together(PASSES, [output.passes for output in part])


def _simulate_batch(fleet: Fleet, batch: _Batch) -> _BatchOutput:
    """Simulate one pass a vehicle, and write their detections when each has a folder."""
    passes, in_view, n_frame_detections = [], np.zeros((2, len(fleet.scene.sign_ids)), dtype=np.int64), 0
    for drives in together(fleet.start(vehicle, _streams(batch.run, vehicle)) for vehicle in batch.vehicles):
        driven, sensed = _simulate_passes(fleet, batch.run, drives)
        in_view += _times_in_view(sensed, len(fleet.scene.sign_ids))
        n_frame_detections += len(sensed.detections.frame)
        passes.append(driven)
    table = detections_table(passes, fleet.scene.classes, fleet.frame)
    has_folders = batch.run.n_buckets is None
    if has_folders:
        _write_folders(table, batch.run, passes)
    return _BatchOutput(
        batch,
        passes_table(passes, fleet.frame),
        truth_table(passes, fleet.scene),
        None if has_folders else table,
        in_view,
        n_frame_detections,
    )


def _simulate_passes(fleet: Fleet, run: _Run, drives: list[Pass]) -> tuple[SimulatedPasses, PassSensing]:
    """Sense and track passes with one kind of sensor."""
    kind, streams, settings = drives[0].kind, [drive.streams for drive in drives], fleet.config.fleet
    sensed = sense_passes([drive.true for drive in drives], fleet.scene.field, kind.sensor, streams, run.billboards)
    passes = SimulatedPasses(
        ids=[PassIds.of(run.run_id, drive.vehicle) for drive in drives],
        drive_ids=[drive.way.drive.drive_id for drive in drives],
        frame_spacing_m=[one.frame_spacing_m if settings.frame_rate_hz else settings.frame_spacing_m for one in drives],
        sensor=kind.config,
        declared=kind.declared,
        pass_start=sensed.detections.pass_start,
        reported=sensed.reported,
        times=np.concatenate([drive.times for drive in drives]),
        tracks=track_passes(sensed.detections, sensed.reported, kind.tracker, streams),
    )
    return passes, sensed


def _streams(run: _Run, vehicle: int) -> PassStreams:
    return pass_streams(run.seed, replicate=run.replicate, vehicle=vehicle)


def _times_in_view(sensed: PassSensing, n_signs: int) -> Ints:
    """Return how many passes and how many frames had each sign in view, shape (2, n_signs)."""
    number, n_passes = sensed.detections.pass_of(sensed.in_view.frame), len(sensed.detections.pass_start) - 1
    frames = np.bincount(sensed.in_view.sign + n_signs * number, minlength=n_signs * n_passes).reshape(-1, n_signs)
    return np.stack(((frames > 0).sum(axis=0), frames.sum(axis=0)))


def _write_folders(detections: pa.Table, run: _Run, passes: list[SimulatedPasses]) -> None:
    """Write the detections of each vehicle into a folder of its own; rows are sorted by pass."""
    plain, first = detections.drop_columns(list(DETECTIONS.partitions)), 0
    n_tracks = {ids.vehicle_id: n for group in passes for ids, n in zip(group.ids, group.n_tracks, strict=True)}
    for vehicle_id in sorted(n_tracks):
        folder = _folder(run, "detections", f"vehicle_id={vehicle_id}")
        write_table(DETECTIONS, plain.slice(first, n_tracks[vehicle_id]), folder / "part-0.parquet")
        first += n_tracks[vehicle_id]


def _write_buckets(detections: pa.Table, run: _Run, part: int) -> None:
    """Write the detections of many vehicles into the buckets that their ids hash to."""
    vehicles = detections["vehicle_id"].combine_chunks().dictionary_encode()
    bucket_of = np.array([crc32(name.encode()) % (run.n_buckets or 1) for name in vehicles.dictionary.to_pylist()])
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
