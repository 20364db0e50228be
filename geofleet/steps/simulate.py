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

import numpy as np
import pyarrow as pa
import shapely

from geofleet.algorithms.sensing import GHOST, PassSensing, SensorModel, sense_pass
from geofleet.algorithms.streams import pass_streams
from geofleet.algorithms.tracking import TrackerModel, Tracks, track_pass
from geofleet.algorithms.trajectory import Poses, resample, wander
from geofleet.errors import ConfigError, InputError
from geofleet.formats.layers import read_layer
from geofleet.tables.manifest import hash_path, write_manifest
from geofleet.tables.scenes import Drive, Scene, load_drive, pick_scene
from geofleet.tables.schemas import BBOX, DETECTIONS, GEOMETRY, PASSES, REFERENCE, RUNS, TRUTH
from geofleet.tables.store import atomic_path, build_table, lonlat, sort_by_key, write_table

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from numpy.random import Generator
    from numpy.typing import NDArray

    from geofleet.config import Config
    from geofleet.tables.schemas import Schema

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Progress = Callable[[int, int], None]

VEHICLES_A_PART = 250
"""Vehicles whose tracks are in memory at once, and in one file of `truth`: part of the layout, not a setting."""

_OUTPUTS = {"runs.parquet", "reference.parquet", "passes.parquet", "detections", "truth", "_manifest.json"}
_LIMITS = {"n_vehicles": (1, 100_000), "n_replicates": (1, 100_000), "seed": (0, 2**63 - 1), "n_workers": (1, 1024)}
_SHAPING = ("scene", "fleet", "sensor", "tracking")


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
class _Study:
    """Everything that the passes of all runs share."""

    config: Config
    drive: Drive
    scene: Scene
    base: Poses
    sensor: SensorModel
    tracker: TrackerModel


@dataclass(frozen=True, slots=True)
class _Run:
    """One replicate: what its passes share, and where it is written."""

    run_id: str
    seed: int
    replicate: int
    folder: Path


@dataclass(frozen=True, slots=True)
class _PassOutput:
    """What is left of a pass when its detections are on disk."""

    passes: pa.Table
    truth: pa.Table
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
        The sections scene, fleet, sensor and tracking are used.
    n_vehicles, n_replicates, seed
        Passes a run, number of runs, and the seed of all of them.
    n_workers
        Threads.
    progress
        Called with the passes done and their total.

    Raises
    ------
    ConfigError
        A number is out of range, or the scene has one class and classes are to be confused.
    InputError
        A table cannot be used, no sign is near the drive, the drive does not move, or `out` holds something else.
    """
    _check_numbers(n_vehicles=n_vehicles, n_replicates=n_replicates, seed=seed, n_workers=n_workers)
    _check_out(out)
    study = _load_study(signs, drive, config)
    digest = _digest(config, signs, drive)
    run_ids = tuple(_run_id(config.scenario, seed, replicate, digest) for replicate in range(n_replicates))
    tally = _Tally(progress or _silent, n_vehicles * n_replicates)
    with atomic_path(out) as draft, ThreadPoolExecutor(n_workers) as pool:
        draft.mkdir()
        references = []
        for replicate, run_id in enumerate(run_ids):
            in_view = np.zeros((2, len(study.scene.sign_ids)), dtype=np.int64)
            for output in _passes_of_run(study, _Run(run_id, seed, replicate, draft), n_vehicles, pool):
                in_view += np.stack((output.frames_in_view > 0, output.frames_in_view))
                tally.add(output)
            references.append(_reference(study.scene, run_id, *in_view))
        write_table(RUNS, _runs(config, run_ids, seed, n_vehicles, digest), draft / "runs.parquet")
        write_table(REFERENCE, _together(REFERENCE, references), draft / "reference.parquet")
        write_table(PASSES, _together(PASSES, tally.passes), draft / "passes.parquet")
    result = SimulateResult(
        out=out,
        run_ids=run_ids,
        n_signs=len(study.scene.sign_ids),
        n_classes=len(study.scene.classes),
        n_vehicles=n_vehicles,
        n_passes=tally.n_done,
        n_frame_detections=tally.n_frame_detections,
        n_detections=tally.n_detections,
        drive_length_m=float(study.drive.line.along_m[-1]),
    )
    _manifest(result, signs, drive, config, seed)
    return result


class _Tally:
    """What accumulates over the passes of all runs."""

    def __init__(self, progress: Progress, total: int) -> None:
        self.passes: list[pa.Table] = []
        self.n_done = self.n_frame_detections = self.n_detections = 0
        self._progress, self._total = progress, total

    def add(self, output: _PassOutput) -> None:
        self.passes.append(output.passes)
        self.n_frame_detections += output.n_frame_detections
        self.n_detections += output.truth.num_rows
        self.n_done += 1
        self._progress(self.n_done, self._total)


def _silent(_done: int, _total: int) -> None:
    """Take the place of a progress callback."""


def _passes_of_run(study: _Study, run: _Run, n_vehicles: int, pool: ThreadPoolExecutor) -> Iterator[_PassOutput]:
    """Simulate one pass a vehicle, in order; `truth` is written part by part."""
    for part, first in enumerate(range(0, n_vehicles, VEHICLES_A_PART)):
        truths = []
        vehicles = range(first, min(first + VEHICLES_A_PART, n_vehicles))
        for output in pool.map(partial(_simulate_pass, study, run), vehicles):
            truths.append(output.truth)
            yield output
        write_table(
            TRUTH,
            _together(TRUTH, truths),
            _made(run.folder / "truth" / f"run_id={run.run_id}") / f"part-{part}.parquet",
        )


def _simulate_pass(study: _Study, run: _Run, vehicle: int) -> _PassOutput:
    """Drive, sense, track and write the detections of one pass."""
    fleet = study.config.fleet
    streams = pass_streams(run.seed, replicate=run.replicate, vehicle=vehicle)
    true = wander(
        study.base,
        sigma_m=fleet.lateral_sigma_m,
        correlation_m=fleet.lateral_correlation_m,
        spacing_m=fleet.frame_spacing_m,
        rng=streams.pose,
    )
    times = _frame_times(study, vehicle, streams.pose)
    sensed = sense_pass(true, study.scene.field, study.sensor, streams)
    tracks = track_pass(sensed.detections, sensed.reported, study.tracker)
    ids = {"run_id": run.run_id, "vehicle_id": f"v{vehicle:05d}", "pass_id": f"v{vehicle:05d}-p0"}
    table = _detections(study, ids, tracks, times)
    folder = _made(run.folder / "detections" / f"run_id={run.run_id}" / f"vehicle_id={ids['vehicle_id']}")
    write_table(DETECTIONS, table.drop_columns(list(DETECTIONS.partitions)), folder / "part-0.parquet")
    return _PassOutput(
        _pass(study, ids, sensed, times),
        _truth(study.scene, ids, tracks),
        np.bincount(sensed.in_view.sign, minlength=len(study.scene.sign_ids)),
        len(sensed.detections.frame),
    )


def _frame_times(study: _Study, vehicle: int, rng: Generator) -> NDArray[np.datetime64] | None:
    """Return the time of every frame: vehicles start `headway_s` apart; without a dated drive there is none."""
    fleet = study.config.fleet
    factor = np.exp(fleet.speed_factor_sigma * rng.standard_normal())
    if study.drive.t_start is None:
        return None
    driven_s = study.base.along_m / (fleet.speed_mps * factor)
    microseconds = np.rint((vehicle * fleet.headway_s + driven_s) * 1e6).astype("timedelta64[us]")
    times: NDArray[np.datetime64] = study.drive.t_start + microseconds
    return times


def _detections(study: _Study, ids: dict[str, str], tracks: Tracks, times: NDArray[np.datetime64] | None) -> pa.Table:
    return build_table(
        DETECTIONS,
        {
            **ids,
            "track_id": np.arange(len(tracks.n_frames)),
            "t_first": None if times is None else times[tracks.frame_first],
            "t_last": None if times is None else times[tracks.frame_last],
            "frame_first": tracks.frame_first,
            "frame_last": tracks.frame_last,
            "n_frames": tracks.n_frames,
            "sigma_e_m": tracks.sigma_e_m,
            "sigma_n_m": tracks.sigma_n_m,
            "cov_en_m2": tracks.cov_en_m2,
            "range_mean_m": tracks.range_mean_m,
            "view_deg": (90.0 - np.rad2deg(tracks.azimuth_rad)) % 360.0,
            "sign_class": pa.array(study.scene.classes[tracks.class_code], pa.string()),
            "class_confidence": tracks.class_confidence,
        },
        geometry=study.drive.frame.to_lonlat(tracks.xy_m),
    )


def _pass(study: _Study, ids: dict[str, str], sensed: PassSensing, times: NDArray[np.datetime64] | None) -> pa.Table:
    sensor, fleet = study.config.sensor, study.config.fleet
    path = shapely.linestrings(np.column_stack(study.drive.frame.to_lonlat(sensed.reported.xy_m)))
    return build_table(
        PASSES,
        {
            **ids,
            "sensor_id": f"{ids['vehicle_id']}-s0",
            "sensor_kind": sensor.sensor_kind,
            "drive_id": study.drive.drive_id,
            "t_start": None if times is None else times[:1],
            "t_end": None if times is None else times[-1:],
            "range_m": sensor.range_m,
            "fov_deg": sensor.fov_deg,
            "frame_spacing_m": fleet.frame_spacing_m,
            "gnss_sigma_m": sensor.gnss_sigma_m,
        },
        geometry=[path],
    )


def _truth(scene: Scene, ids: dict[str, str], tracks: Tracks) -> pa.Table:
    is_ghost = tracks.sign == GHOST
    true_code = scene.field.class_code[tracks.sign]  # that of a ghost is masked below
    return build_table(
        TRUTH,
        {
            "run_id": ids["run_id"],
            "pass_id": ids["pass_id"],
            "track_id": np.arange(len(tracks.sign)),
            "ref_sign_id": pa.array(scene.sign_ids[tracks.sign], pa.string(), mask=is_ghost),
            "ref_sign_class": pa.array(scene.classes[true_code], pa.string(), mask=is_ghost),
            "semantic_correct": ~is_ghost & (true_code == tracks.class_code),
            "is_ghost": is_ghost,
        },
    )


def _reference(scene: Scene, run_id: str, n_passes: Ints, n_frames: Ints) -> pa.Table:
    columns = {
        name: scene.table[name].combine_chunks() for name in scene.table.column_names if name not in (GEOMETRY, BBOX)
    }
    counts = {"run_id": run_id, "n_passes_in_view": n_passes, "n_frames_in_view": n_frames}
    return build_table(REFERENCE, columns | counts, geometry=lonlat(scene.table))


def _runs(config: Config, run_ids: tuple[str, ...], seed: int, n_vehicles: int, digest: str) -> pa.Table:
    return build_table(
        RUNS,
        {
            "run_id": list(run_ids),
            "scenario": config.scenario,
            "seed": seed,
            "replicate": np.arange(len(run_ids)),
            "n_vehicles": n_vehicles,
            "tracker": config.tracking.tracker,
            "upload": "mean",
            "config_digest": digest,
        },
    )


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


def _load_study(signs: Path, drive: Path, config: Config) -> _Study:
    sensor = SensorModel(**config.sensor.model_dump(exclude={"sensor_kind"}))
    road = load_drive(drive)
    fleet = config.fleet
    try:
        base = resample(road.line, spacing_m=fleet.frame_spacing_m, heading_baseline_m=fleet.heading_baseline_m)
    except InputError as error:
        raise InputError(error.what, where=str(drive), todo=error.todo) from None
    layer = read_layer(signs).table
    scene = pick_scene(layer, road, source=signs, **config.scene.model_dump(), cell_m=sensor.range_m)
    if len(scene.classes) == 1 and sensor.semantic_rate < 1:
        raise ConfigError(
            f"semantic_rate = {sensor.semantic_rate:g} confuses classes, but the scene has only one: "
            f"{scene.classes[0]}.",
            where=str(signs),
            todo="Set semantic_rate to 1, or widen corridor_m or groups.",
        )
    tracker = TrackerModel(**config.tracking.model_dump(), range_m=sensor.range_m, half_fov_rad=sensor.half_fov_rad)
    return _Study(config, road, scene, base, sensor, tracker)


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


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return folder
