"""The work of a study: one replicate is simulated once, for its largest fleet, and mapped and scored many times.

A unit is one method and fleet size of one replicate. Its scores are written as soon as they are known, to a file that
the digest of all that shapes them names; a study that is started again goes on where it was killed.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from concurrent.futures import ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import pyarrow.compute as pc
from threadpoolctl import threadpool_limits

from geofleet.errors import ConfigError
from geofleet.steps.aggregate import aggregate
from geofleet.steps.simulate import simulate
from geofleet.tables.matching import match_layers
from geofleet.tables.schemas import BBOX, GEOMETRY, REFERENCE, SIGNS
from geofleet.tables.scoring import score_matches
from geofleet.tables.store import atomic_path, read_table
from geofleet.workflows.stale import stale
from geofleet.workflows.study.methods import METHODS, with_settings
from geofleet.workflows.study.worlds import USUAL_PRIOR, code_digest, hash_input

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    import pyarrow as pa

    from geofleet.config import Config
    from geofleet.workflows.study.methods import Method
    from geofleet.workflows.study.worlds import Study, World

    Progress = Callable[[int, int], None]
    Rows = list[dict[str, Any]]

_LOOK_S = 0.5


@dataclass(frozen=True, slots=True)
class Unit:
    """One method and fleet size of a replicate, and the file of its scores."""

    method: str
    n_vehicles: int
    path: Path


@dataclass(frozen=True, slots=True)
class Replicate:
    """One fleet of a world, plain data: what is to be simulated, and the units that it is for."""

    world: World
    number: int
    seed: int
    n_vehicles: int
    units: tuple[Unit, ...]
    in_view: bool
    prior: Path | None


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
    for leftover in units_dir.glob(".*"):  # of a study that was killed
        shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
    replicates = tuple(_replicates(study, units_dir))
    every = [unit for replicate in replicates for unit in replicate.units]
    tell = progress or (lambda _done, _total: None)
    missing = [task for task in map(_missing, replicates) if task.units]
    for _ in run_all(run_replicate, missing, n_workers=n_workers):
        tell(sum(unit.path.is_file() for unit in every), len(every))
    tell(len(every), len(every))
    return [row for replicate in replicates for unit in replicate.units for row in read_unit(replicate, unit)]


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


def _replicates(study: Study, units_dir: Path) -> Iterator[Replicate]:
    for world in (_sending(w, study.methods) for w in study.worlds):
        for number in range(study.n_replicates):
            task = Replicate(world, number, study.seed, max(study.sizes), (), study.in_view, study.prior)
            units = tuple(
                Unit(method.label, size, units_dir / f"{unit_digest(task, method, size)}.json")
                for method in study.methods
                for size in study.sizes
            )
            yield replace(task, units=units)


def _sending(world: World, methods: Sequence[Method]) -> World:
    """Have vehicles send the information form when a method reads it."""
    if all(method.upload == "mean" for method in methods):
        return world
    tracking = world.config.tracking.model_copy(update={"send_information": True})
    return replace(world, config=world.config.model_copy(update={"tracking": tracking}))


def _missing(replicate: Replicate) -> Replicate:
    """Return a replicate with the units that are not there yet."""
    return replace(replicate, units=tuple(unit for unit in replicate.units if not unit.path.is_file()))


def unit_digest(replicate: Replicate, method: Method, n_vehicles: int) -> str:
    """Return 32 hex digits over everything that shapes the scores of a unit."""
    world, config = replicate.world, with_settings(replicate.world.config, method)
    prior = hash_input(replicate.prior) if replicate.prior else str(USUAL_PRIOR)
    parts = (
        code_digest(),
        *(hash_input(path) for path in (world.signs, world.drive)),
        config.digest(),
        *(str(value) for value in (world.place, world.setting, replicate.seed, replicate.number)),
        *(str(value) for value in (method.label, n_vehicles, prior if method.has_prior else "")),
        str(replicate.n_vehicles if replicate.in_view else ""),
    )
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:32]


def run_replicate(replicate: Replicate) -> None:
    """Simulate a fleet and write the scores of its units, each when it is known."""
    with (
        threadpool_limits(1),
        TemporaryDirectory(dir=replicate.units[0].path.parent, prefix=".") as name,
    ):
        simulated = simulate_replicate(replicate, Path(name))
        for unit in replicate.units:
            scores = score_unit(replicate, simulated, METHODS[unit.method], unit.n_vehicles)
            with atomic_path(unit.path) as draft:
                draft.write_text(json.dumps(scores), encoding="utf-8")


@dataclass(frozen=True, slots=True)
class Simulated:
    """A simulated fleet in a folder of its own."""

    folder: Path
    run_id: str
    reference: pa.Table

    @property
    def path(self) -> Path:
        """Where its tables are."""
        return self.folder / "simulation"


def simulate_replicate(replicate: Replicate, folder: Path) -> Simulated:
    """Simulate the fleet of a replicate, and make its prior map when a unit needs one."""
    out = folder / "simulation"
    result = simulate(
        *(replicate.world.signs, replicate.world.drive, out),
        config=replicate.world.config,
        n_vehicles=replicate.n_vehicles,
        first_replicate=replicate.number,
        seed=replicate.seed,
        n_workers=1,
    )
    reference = read_table(REFERENCE, out / "reference.parquet")
    if any(METHODS[unit.method].has_prior for unit in replicate.units) and not replicate.prior:
        # Every replicate has a prior of its own, which its fleet has nothing to do with.
        stale(out / "reference.parquet", folder / "prior.parquet", USUAL_PRIOR, seed=replicate.seed + replicate.number)
    scored = reference.filter(pc.field("n_passes_in_view") > 0) if replicate.in_view else reference
    return Simulated(folder, result.run_ids[0], scored)


def score_unit(replicate: Replicate, simulated: Simulated, method: Method, n_vehicles: int) -> Rows:
    """Map the first vehicles of a fleet and return the scores, over all tiles and one a tile."""
    config = with_settings(replicate.world.config, method)
    fused = simulated.folder / "fused.parquet"
    options: dict[str, Any] = {}
    if method.has_prior:
        options["prior"] = replicate.prior or simulated.folder / "prior.parquet"
    aggregate(
        simulated.path / "detections",
        fused,
        config=config,
        n_vehicles=n_vehicles,
        passes=simulated.path / "passes.parquet" if method.has_passes else None,
        k_from=simulated.path / "reference.parquet" if method.has_oracle_k else None,
        n_workers=1,
        **options,
    )
    labels = {"run_id": simulated.run_id, "method": method.label, "n_vehicles": n_vehicles}
    return _scores(read_table(SIGNS, fused), simulated.reference, labels, config)


def _scores(fused: pa.Table, reference: pa.Table, labels: dict[str, Any], config: Config) -> Rows:
    matching: dict[str, Any] = config.evaluate.model_dump(include={"gate_m", "match_on"})
    matches = match_layers(fused, reference, labels, **matching, tile_zoom=config.aggregate.tile_zoom)
    scores = score_matches(matches, **matching).drop_columns([GEOMETRY, BBOX])
    rows: Rows = scores.filter(pc.field("concept") == "all").drop_columns(["concept"]).to_pylist()
    return rows


def read_unit(replicate: Replicate, unit: Unit) -> Rows:
    """Return the rows of a unit with what they are rows of."""
    world, tracking = replicate.world, replicate.world.config.tracking
    labels = {
        "scenario": world.config.scenario,
        "place": world.place,
        "setting": world.setting,
        "seed": replicate.seed,
        "replicate": replicate.number,
        "tracker": tracking.tracker,
        "upload": METHODS[unit.method].upload,
    }
    return [labels | row for row in json.loads(unit.path.read_text(encoding="utf-8"))]
