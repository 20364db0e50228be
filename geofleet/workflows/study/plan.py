"""How many passes do I need? For a drive, a map, sensors and a method, answered by simulated fleets."""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from threadpoolctl import threadpool_limits

from geofleet.algorithms.planning import PassesNeeded, passes_needed, sum_up
from geofleet.algorithms.tiling import quadkey_bounds
from geofleet.algorithms.uncertainty import check_level
from geofleet.errors import ConfigError
from geofleet.formats.geojson import write_geojson
from geofleet.formats.results import write_csv
from geofleet.tables.manifest import write_manifest
from geofleet.tables.store import atomic_path
from geofleet.workflows.study.answers import Target, answer_in_words, part_rows, score_rows, tile_rows, total_of
from geofleet.workflows.study.compare import describe
from geofleet.workflows.study.limits import Floor, floor_of, take_apart
from geofleet.workflows.study.methods import METHODS, with_settings
from geofleet.workflows.study.units import (
    Batch,
    Fleets,
    Unit,
    map_fleets,
    run_all,
    score_maps,
    simulate_fleets,
    unit_digest,
    world_batch,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    import pyarrow as pa

    from geofleet.config import Config
    from geofleet.workflows.study.worlds import Study

FIRST_FLEET = 16  # passes simulated before it is known that more are needed; then four times as many


@dataclass(frozen=True, slots=True)
class PlanResult:
    """The answer.

    Parameters
    ----------
    caption, target
        What was simulated and asked for, in words.
    answer
        Sentences: how many passes, how sure, and what limits the map.
    needed
        Passes needed, over the fleets.
    floor
        What no number of passes can find.
    scores
        A row a fleet size that was tried: fleets, and median, lowest and highest score.
    parts
        What is left of GOSPA_M² at the largest fleet tried, m² and share, mean over fleets.
    tiles
        A row a tile: signs, passes needed by the median fleet (at most), fleets that reached it, main limit.
    files
        Tables and GeoJSON.
    """

    caption: str
    target: str
    answer: tuple[str, ...]
    needed: PassesNeeded
    floor: Floor
    scores: tuple[dict[str, Any], ...]
    parts: tuple[dict[str, Any], ...]
    tiles: tuple[dict[str, Any], ...]
    files: tuple[Path, ...]


@dataclass(frozen=True, slots=True)
class Search:
    """One fleet and what it is asked, plain data; the one unit of the batch is the fleet with all of its passes."""

    batch: Batch
    target: Target

    @property
    def path(self) -> Path:
        """The file of the answer."""
        return self.batch.units[0].path


def plan(
    study: Study,
    target: Target,
    out: Path,
    *,
    level: float = 0.95,
    n_workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> PlanResult:
    """Find how many passes are needed and write `plan/` below `out`.

    Every fleet is asked by doubling and halving how many of its passes it needs; the passes needed are summed up over
    fleets.

    Parameters
    ----------
    study
        One world and one method; its largest size is the most passes that are tried.
    level
        Of the interval, and the share of fleets that the safe number holds for.

    Raises
    ------
    ConfigError
        There are several worlds or methods, or the level is no share.
    InputError, ConfigError
        As `run_study`.
    """
    check_level(level)
    if len(study.worlds) != 1 or len(study.methods) != 1:
        raise ConfigError("a plan is for one drive, one scenario and one method.", todo="Name one of each.")
    folder = out / "units"
    folder.mkdir(parents=True, exist_ok=True)
    searches = [_search(study, target, folder, number) for number in range(study.n_replicates)]
    tell = progress or (lambda _done, _total: None)
    missing = [search for search in searches if not search.path.is_file()]
    tell(len(searches) - len(missing), len(searches))
    for _ in run_all(run_search, missing, n_workers=n_workers):
        tell(sum(search.path.is_file() for search in searches), len(searches))
    fleets = [json.loads(search.path.read_text(encoding="utf-8")) for search in searches]
    needed, floor = sum_up([fleet["needed"] for fleet in fleets], level=level), Floor(**fleets[0]["floor"])
    scores, parts, tiles = score_rows(fleets, target), part_rows(fleets), tile_rows(fleets, target, level)
    answer = answer_in_words(needed, target, floor, parts, scores)
    if needed.typical is None and not (study.methods[0].has_passes or floor.n_never_in_view):
        answer.append("Another method may: --method joint takes out what the detections of a pass have in common.")
    return PlanResult(
        caption=f"{describe(study)}; method {study.methods[0].label}, upload {study.methods[0].upload}",
        target=str(target),
        answer=tuple(answer),
        needed=needed,
        floor=floor,
        scores=tuple(scores),
        parts=tuple(parts),
        tiles=tuple(tiles),
        files=_write(out / "plan", study, target, needed, {"scores": scores, "parts": parts, "tiles": tiles}),
    )


def _search(study: Study, target: Target, folder: Path, number: int) -> Search:
    batch, method, largest = world_batch(study, study.worlds[0]), study.methods[0], max(study.sizes)
    digest = f"{unit_digest(batch, method, largest, number)} plan {target}"
    path = folder / f"plan-{hashlib.sha256(digest.encode()).hexdigest()[:32]}.json"
    return Search(replace(batch, units=(Unit(number, method.label, largest, path),)), target)


def run_search(search: Search) -> None:
    """Ask one fleet how many of its passes it needs, and write the answer with all that was seen on the way."""
    (unit,) = search.batch.units
    with threadpool_limits(1), TemporaryDirectory(dir=unit.path.parent, prefix=".") as name:
        fleet = _Growing(search.batch, Path(name))
        seen: dict[int, list[dict[str, Any]]] = {}

        def meets(size: int) -> bool:
            fused, scene, labels, config = fleet.map(size)
            seen[size] = score_maps([(fused, scene, labels)], config)
            return search.target.is_met(total_of(seen[size])[search.target.score])

        needed = passes_needed(meets, unit.n_vehicles)
        fused, scene, labels, config = fleet.map(needed or unit.n_vehicles)
        found = {
            "needed": needed,
            "seen": [{"n_vehicles": size, "rows": rows} for size, rows in sorted(seen.items())],
            "parts": take_apart(fused, scene, labels, config),
            "floor": asdict(floor_of(scene, config, search.target.score)),
        }
        with atomic_path(unit.path) as draft:
            draft.write_text(json.dumps(found), encoding="utf-8")


class _Growing:
    """A fleet that is simulated as far as it is asked for: its first passes do not depend on how many follow."""

    def __init__(self, batch: Batch, folder: Path) -> None:
        self._batch, self._folder = batch, folder
        self._unit = batch.units[0]
        self._fleets: tuple[int, Fleets] | None = None

    def map(self, size: int) -> tuple[pa.Table, pa.Table, dict[str, Any], Config]:
        """Return the map of the first so many passes, its scene, labels and settings."""
        largest, fleets = self._simulated(size)
        batch, number, method = (
            replace(self._batch, n_vehicles=largest),
            self._unit.replicate,
            METHODS[self._unit.method],
        )
        fused = map_fleets(batch, fleets, method, size)[number]
        settings = with_settings(batch.world.config, method)
        return fused, fleets.scene(batch, number), fleets.labels(number, method, size), settings

    def _simulated(self, size: int) -> tuple[int, Fleets]:
        if self._fleets is None or self._fleets[0] < size:
            # What is in view is a matter of the largest fleet, so scoring by it needs that one from the start.
            begin = self._batch.n_vehicles if self._batch.in_view else FIRST_FLEET
            n = min(self._batch.n_vehicles, max(begin, 4 ** math.ceil(math.log(size, 4))))
            folder = self._folder / f"{n}"
            folder.mkdir()
            self._fleets = n, simulate_fleets(replace(self._batch, n_vehicles=n), folder)
        return self._fleets


def _write(
    out: Path, study: Study, target: Target, result: PassesNeeded, tables: dict[str, list[dict[str, Any]]]
) -> tuple[Path, ...]:
    """Write tables as CSV and tiles as GeoJSON, whole or not at all."""
    import geopandas  # noqa: PLC0415  (a second of import that only writing needs)
    import shapely  # noqa: PLC0415

    with atomic_path(out) as draft:
        draft.mkdir()
        for name, rows in tables.items():
            write_csv(rows, draft / f"{name}.csv")
        tiles = tables["tiles"]
        boxes = shapely.box(*quadkey_bounds([row["tile"] for row in tiles]).T)
        write_geojson(geopandas.GeoDataFrame(tiles, geometry=boxes, crs="OGC:CRS84"), draft / "tiles.geojson")
        (draft / "plan.json").write_text(
            json.dumps(asdict(result) | {"target": str(target)}, indent=2) + "\n", encoding="utf-8"
        )
        names = sorted(path.name for path in draft.iterdir())
    world = study.worlds[0]
    settings = {"target": str(target), "method": study.methods[0].label, "seed": study.seed, "in_view": study.in_view}
    settings |= {"n_replicates": study.n_replicates, "largest": max(study.sizes)}
    inputs = [path for path in (world.signs, world.drive, study.prior) if path]
    write_manifest(out, step="study plan", inputs=inputs, config_digest=world.config.digest(), settings=settings)
    return tuple(out / name for name in names)
