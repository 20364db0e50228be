"""The work of a study: each replicate is simulated once, for its largest fleet, and mapped and scored many times.

A unit is one method and fleet size of one replicate. Its scores are written as soon as they are known, to a file that
the digest of all that shapes them names; a study that is started again goes on where it was killed.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
import time
from concurrent.futures import ProcessPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc
from threadpoolctl import threadpool_limits

from geofleet.errors import ConfigError
from geofleet.steps.aggregate import aggregate
from geofleet.steps.simulate import simulate
from geofleet.tables.matching import match_layers
from geofleet.tables.schemas import BBOX, DETECTIONS, GEOMETRY, REFERENCE, SIGNS
from geofleet.tables.scoring import score_matches
from geofleet.tables.store import atomic_path, read_table, write_table
from geofleet.workflows.stale import stale
from geofleet.workflows.study.methods import METHODS, with_settings
from geofleet.workflows.study.worlds import USUAL_PRIOR, code_digest, hash_input

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from geofleet.config import Config
    from geofleet.workflows.study.methods import Method
    from geofleet.workflows.study.worlds import Study, World

    Progress = Callable[[int, int], None]
    Rows = list[dict[str, Any]]

_LOOK_S = 0.5
_LEFTOVER_S = 24 * 3600.0


@dataclass(frozen=True, slots=True)
class Unit:
    """One method and fleet size of a replicate, and the file of its scores."""

    replicate: int
    method: str
    n_vehicles: int
    path: Path


@dataclass(frozen=True, slots=True)
class Batch:
    """Some fleets of a world, plain data: what is to be simulated at one time, and the units that it is for."""

    world: World
    seed: int
    n_vehicles: int
    units: tuple[Unit, ...]
    in_view: bool
    prior: Path | None

    @property
    def replicates(self) -> range:
        """The numbers of the fleets, from the first to the last that a unit needs."""
        numbers = [unit.replicate for unit in self.units]
        return range(min(numbers), max(numbers) + 1)


def run_study(study: Study, folder: Path, *, n_workers: int = 1, progress: Progress | None = None) -> Rows:
    """Simulate, map and score everything in a study that is not there yet; return all of its rows.

    Parameters
    ----------
    folder
        Where units are kept.
    n_workers
        Processes; the rows do not depend on it.
    progress
        Called with the units done and their total.

    Returns
    -------
    Rows of `study_scores`, over all tiles and one a tile, in the order of the study.

    Raises
    ------
    InputError, ConfigError
        A world cannot be simulated, or a method not be run.
    """
    units_dir = folder / "units"
    units_dir.mkdir(parents=True, exist_ok=True)
    remove_leftovers(units_dir)
    worlds = [_world(study, world, units_dir) for world in study.worlds]
    every = [unit for world in worlds for unit in world.units]
    tell = progress or (lambda _done, _total: None)
    tell(sum(unit.path.is_file() for unit in every), len(every))
    size = math.ceil(study.n_replicates / max(n_workers, 1))
    for _ in run_all(run_batch, [batch for world in worlds for batch in _missing(world, size)], n_workers=n_workers):
        tell(sum(unit.path.is_file() for unit in every), len(every))
    tell(len(every), len(every))
    return [row for world in worlds for unit in world.units for row in read_unit(world, unit)]


def remove_leftovers(units_dir: Path) -> None:
    """Remove what studies that were killed had begun. Younger than a day, it may be of one that still runs."""
    for leftover in units_dir.glob(".*"):
        with suppress(FileNotFoundError):  # the other study has just finished it
            if time.time() - leftover.stat().st_mtime > _LEFTOVER_S:
                shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()


def run_all(function: Callable[[Any], Any], tasks: Sequence[Any], *, n_workers: int) -> Iterator[None]:
    """Do every task, in processes when there are several workers; yield now and then, for a look at what is done.

    Processes, not threads: much of a unit is Python, and a small one.
    """
    if n_workers < 1:
        raise ConfigError(f"{n_workers} workers cannot run anything.", where="--workers", todo="Give 1 or more.")
    if n_workers == 1 or len(tasks) < 2:  # noqa: PLR2004 (a pool for one is none)
        for task in tasks:
            function(task)
            yield
        return
    with ProcessPoolExecutor(min(n_workers, len(tasks)), get_context("spawn")) as pool:
        running = {pool.submit(function, task) for task in tasks}
        try:
            while running:
                done, running = wait(running, timeout=_LOOK_S)
                for future in done:
                    future.result()
                yield
        finally:
            for future in running:
                future.cancel()


def _world(study: Study, world: World, units_dir: Path) -> Batch:
    """Return all units of a world."""
    batch = world_batch(study, world)
    return replace(
        batch,
        units=tuple(
            Unit(number, method.label, size, units_dir / f"{unit_digest(batch, method, size, number)}.json")
            for method in study.methods
            for size in study.sizes
            for number in range(study.n_replicates)
        ),
    )


def world_batch(study: Study, world: World) -> Batch:
    """Return the batch of a world before it has units."""
    if any(method.upload == "information" for method in study.methods):
        world = replace(world, config=_sending(world.config, is_sent=True))
    return Batch(world, study.seed, max(study.sizes), (), study.in_view, study.prior)


def _sending(config: Config, *, is_sent: bool) -> Config:
    """Have vehicles send the information form, or not."""
    tracking = config.tracking.model_copy(update={"send_information": is_sent})
    return config.model_copy(update={"tracking": tracking})


def _missing(world: Batch, size: int) -> Iterator[Batch]:
    """Yield batches of so many fleets with the units that are not there yet.

    Every other batch goes through its methods backwards: two workers then compile different kernels, not the same.
    """
    units = [unit for unit in world.units if not unit.path.is_file()]
    numbers = sorted({unit.replicate for unit in units})
    for begin in range(0, len(numbers), size):
        some = set(numbers[begin : begin + size])
        mine = [unit for unit in units if unit.replicate in some]
        yield replace(world, units=tuple(mine if begin // size % 2 == 0 else reversed(mine)))


def unit_digest(batch: Batch, method: Method, n_vehicles: int, replicate: int) -> str:
    """Return 32 hex digits over everything that shapes the scores of a unit.

    What else the study compares does not: names of places and settings are labels, and a method that reads means alone
    gives the same map whether or not the vehicles send more.
    """
    world, config = batch.world, with_settings(batch.world.config, method)
    if method.upload == "mean":
        config = _sending(config, is_sent=False)
    prior = hash_input(batch.prior) if batch.prior else str(USUAL_PRIOR)
    parts = (
        code_digest(),
        *(hash_input(path) for path in (world.signs, world.drive)),
        config.digest(),
        *map(str, (batch.seed, replicate, method.label, n_vehicles, prior if method.has_prior else "")),
        str(batch.n_vehicles if batch.in_view else ""),
    )
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]


def run_batch(batch: Batch) -> None:
    """Simulate fleets and write the scores of their units, each when it is known."""
    groups: dict[tuple[str, int], list[Unit]] = {}
    for unit in batch.units:
        groups.setdefault((unit.method, unit.n_vehicles), []).append(unit)
    with threadpool_limits(1), TemporaryDirectory(dir=batch.units[0].path.parent, prefix=".") as name:
        fleets = simulate_fleets(batch, Path(name))
        for (label, n_vehicles), units in groups.items():
            scores = score_fleets(batch, fleets, METHODS[label], n_vehicles)
            for unit in units:
                with atomic_path(unit.path) as draft:
                    draft.write_text(json.dumps(scores[unit.replicate]), encoding="utf-8")


@dataclass(frozen=True, slots=True)
class Fleets:
    """Simulated fleets in a folder of their own, by the number of their replicate."""

    folder: Path
    run_ids: dict[int, str]
    references: dict[int, pa.Table]

    @property
    def detections(self) -> Path:
        """The folder with the detections of all fleets, a file each."""
        return self.folder / "detections"

    def of(self, replicate: int) -> Path:
        """Return the file with the detections of one fleet alone."""
        return self.detections / f"fleet-{replicate}.parquet"

    def scene(self, batch: Batch, replicate: int) -> pa.Table:
        """Return the signs that a fleet's map is scored against."""
        scene = self.references[replicate]
        return scene.filter(pc.field("n_passes_in_view") > 0) if batch.in_view else scene

    def labels(self, replicate: int, method: Method, n_vehicles: int) -> dict[str, Any]:
        """Return what the scores of a map are labelled with."""
        return {"run_id": self.run_ids[replicate], "method": method.label, "n_vehicles": n_vehicles}

    def prior(self, replicate: int) -> Path:
        """Return where the prior map of a fleet is."""
        return self.folder / f"prior-{replicate}.parquet"


def simulate_fleets(batch: Batch, folder: Path) -> Fleets:
    """Simulate the fleets of a batch, and make their prior maps when a unit needs them."""
    out, numbers = folder / "simulation", batch.replicates
    result = simulate(
        *(batch.world.signs, batch.world.drive, out),
        config=batch.world.config,
        n_vehicles=batch.n_vehicles,
        n_replicates=len(numbers),
        first_replicate=numbers.start,
        seed=batch.seed,
        n_buckets=1,  # every map reads them, and to open a file a vehicle would take longest
        n_workers=1,
    )
    run_ids = dict(zip(numbers, result.run_ids, strict=True))
    reference = read_table(REFERENCE, out / "reference.parquet")
    references = {number: reference.filter(pc.field("run_id") == run_id) for number, run_id in run_ids.items()}
    fleets = Fleets(folder, run_ids, references)
    for number, run_id in run_ids.items():
        _gather(out / "detections" / f"run_id={run_id}", fleets.of(number))
    if any(METHODS[unit.method].has_prior for unit in batch.units) and not batch.prior:
        for number in numbers:  # each has a prior of its own, which its fleet has nothing to do with
            stale(out / "reference.parquet", fleets.prior(number), USUAL_PRIOR, seed=batch.seed + number)
    return fleets


def _gather(run: Path, out: Path) -> None:
    """Put the detections of a run into one file, with its name in a column."""
    alone = out.with_suffix("")
    alone.mkdir(parents=True)
    write_table(DETECTIONS, read_table(DETECTIONS, run.rename(alone / run.name).parent), out)
    shutil.rmtree(alone)


def score_fleets(batch: Batch, fleets: Fleets, method: Method, n_vehicles: int) -> dict[int, Rows]:
    """Map the first vehicles of every fleet and return the scores, over all tiles and one a tile, by replicate."""
    maps = map_fleets(batch, fleets, method, n_vehicles)
    rows = score_maps(
        [
            (fused, fleets.scene(batch, number), fleets.labels(number, method, n_vehicles))
            for number, fused in maps.items()
        ],
        batch.world.config,
    )
    return {number: [row for row in rows if row["run_id"] == fleets.run_ids[number]] for number in maps}


def map_fleets(batch: Batch, fleets: Fleets, method: Method, n_vehicles: int) -> dict[int, pa.Table]:
    """Return the map of the first vehicles of every fleet, by replicate."""
    if method.has_prior:
        return {
            number: _map(
                batch, fleets, fleets.of(number), method, n_vehicles, prior=batch.prior or fleets.prior(number)
            )
            for number in fleets.run_ids
        }
    fused = _map(batch, fleets, fleets.detections, method, n_vehicles, prior=None)
    return {number: fused.filter(pc.field("run_id") == run_id) for number, run_id in fleets.run_ids.items()}


def _map(
    batch: Batch, fleets: Fleets, detections: Path, method: Method, n_vehicles: int, *, prior: Path | None
) -> pa.Table:
    """Return the map of the first vehicles of some fleets."""
    out, simulation = fleets.folder / "fused.parquet", fleets.folder / "simulation"
    given: dict[str, Any] = {"prior": prior} if prior else {}
    aggregate(
        detections,
        out,
        config=with_settings(batch.world.config, method),
        n_vehicles=n_vehicles,
        passes=simulation / "passes.parquet" if method.has_passes else None,
        k_from=simulation / "reference.parquet" if method.has_oracle_k else None,
        n_workers=1,
        **given,
    )
    return read_table(SIGNS, out)


def score_maps(maps: Sequence[tuple[pa.Table, pa.Table, dict[str, Any]]], config: Config) -> Rows:
    """Return the scores of maps, each with its reference and labels, as rows of `scores` without geometry.

    There is a row a map over all tiles, and one a tile.
    """
    matching: dict[str, Any] = config.evaluate.model_dump(include={"gate_m", "match_on"})
    matches = pa.concat_tables(
        match_layers(fused, reference, labels, **matching, tile_zoom=config.aggregate.tile_zoom)
        for fused, reference, labels in maps
    )
    scores = score_matches(matches, **matching).drop_columns([GEOMETRY, BBOX])
    rows: Rows = scores.filter(pc.field("concept") == "all").drop_columns(["concept"]).to_pylist()
    return rows


def read_unit(batch: Batch, unit: Unit) -> Rows:
    """Return the rows of a unit with what they are rows of."""
    world, tracking = batch.world, batch.world.config.tracking
    labels = {
        "scenario": world.config.scenario,
        "place": world.place,
        "setting": world.setting,
        "seed": batch.seed,
        "replicate": unit.replicate,
        "tracker": tracking.tracker,
        "upload": METHODS[unit.method].upload,
    }
    return [labels | row for row in json.loads(unit.path.read_text(encoding="utf-8"))]
