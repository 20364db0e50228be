"""What a report is made of: the files of a run, read once."""

from __future__ import annotations

import csv
import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pyarrow.compute as pc

from geofleet.errors import ConfigError, InputError
from geofleet.formats.results import GEOPACKAGE
from geofleet.tables.finding import tables_of
from geofleet.tables.schemas import BBOX, DRIVES, LANES, MATCHES, NUISANCE, RUNS, SCORES
from geofleet.tables.store import read_table

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    import pyarrow as pa
    from geopandas import GeoDataFrame

LABELS = ("run_id", "method", "n_vehicles")


@dataclass(frozen=True, slots=True, eq=False)
class Contents:
    """Everything that a report shows.

    Parameters
    ----------
    evaluation
        The folder that an evaluation wrote.
    totals
        Scores of every map, over all tiles and concepts.
    shown
        Of `totals`, the map that is drawn.
    tiles
        Rows of `scores` of its tiles, those that cost it most first.
    matches, fused, reference, ellipses
        Its outcomes and layers.
    confusion, intervals
        Rows of the files of those names that belong to it.
    lanes, drives
        Tables; None where the run has none.
    runs
        Rows of `runs`: what was simulated.
    nuisance
        Rows of `nuisance` of the map drawn, when joint fusion made it: those farthest from what they declare first.
    manifests
        Path below the run and content of every manifest.
    inputs
        Files read.
    """

    evaluation: Path
    totals: tuple[dict[str, Any], ...]
    shown: dict[str, Any]
    tiles: tuple[dict[str, Any], ...]
    matches: pa.Table
    fused: GeoDataFrame
    reference: GeoDataFrame
    ellipses: GeoDataFrame
    confusion: tuple[dict[str, Any], ...]
    intervals: tuple[dict[str, Any], ...]
    lanes: pa.Table | None
    drives: pa.Table | None
    runs: tuple[dict[str, Any], ...]
    nuisance: tuple[dict[str, Any], ...]
    manifests: tuple[tuple[str, dict[str, Any]], ...]
    inputs: tuple[Path, ...]

    @property
    def run(self) -> dict[str, Any] | None:
        """The simulated run that the map was made from; None when no table here says that it was simulated."""
        return next((run for run in self.runs if run["run_id"] == self.shown["run_id"]), None)

    @property
    def is_drive_derived(self) -> bool:
        """Whether nobody recorded the drive."""
        return self.drives is not None and pc.all(pc.equal(self.drives["fix_quality"], "derived")).as_py() is True

    @property
    def is_from_osm(self) -> bool:
        """Whether any sign or road comes from OpenStreetMap, which asks to be named."""
        return any(str(ref).startswith("node/") for ref in self.reference["source_ref"])


def read_contents(
    run_dir: Path, *, run_id: str | None = None, method: str | None = None, n_vehicles: int | None = None
) -> Contents:
    """Read what a run has left; `run_id`, `method` and `n_vehicles` choose the map to draw.

    Raises
    ------
    InputError
        There is no evaluation, or several and none is called `evaluation`.
    ConfigError
        No map is of the run, method and fleet size asked for.
    """
    evaluation = _find_evaluation(run_dir)
    scores, matches = read_table(SCORES, evaluation / "scores.parquet"), evaluation / "matches.parquet"
    totals = scores.filter(_is_total("tile") & _is_total("concept")).drop_columns(["geometry", BBOX]).to_pylist()
    shown = _choose(totals, {"run_id": run_id, "method": method, "n_vehicles": n_vehicles})
    folders = [run_dir, *sorted(path for path in run_dir.iterdir() if path.is_dir())]
    found = {schema.name: tables_of(schema, folders) for schema in (LANES, DRIVES, RUNS, NUISANCE)}
    package = evaluation / GEOPACKAGE
    inputs = [evaluation / "scores.parquet", matches, package, *(path for paths in found.values() for path in paths)]
    return Contents(
        evaluation=evaluation,
        totals=tuple(totals),
        shown=shown,
        tiles=tuple(_worst_first(scores.filter(~_is_total("tile") & _is_total("concept") & _of(shown)).to_pylist())),
        matches=read_table(MATCHES, matches).filter(_of(shown)),
        fused=_layer(package, "fused", shown),
        reference=_layer(package, "reference", shown),
        ellipses=_layer(package, "ellipses", shown),
        confusion=tuple(_rows(evaluation / "confusion.csv", lambda row: _is_of(row, shown, LABELS))),
        intervals=tuple(_rows(evaluation / "intervals.csv", lambda row: _is_of(row, shown, LABELS[1:]))),
        lanes=_all(LANES.name, found),
        drives=_all(DRIVES.name, found),
        runs=tuple(row for path in found[RUNS.name] for row in read_table(RUNS, path).to_pylist()),
        nuisance=tuple(_nuisance(found[NUISANCE.name], shown)),
        manifests=tuple(_manifests(run_dir, folders)),
        inputs=tuple(dict.fromkeys(inputs)),
    )


def _find_evaluation(run_dir: Path) -> Path:
    """Return the folder of the evaluation: `evaluation`, the run's folder itself, or the only one below it."""
    if not run_dir.is_dir():
        raise InputError("there is no such folder.", where=str(run_dir), todo="Give the folder of a run.")
    for folder in (run_dir / "evaluation", run_dir):
        if (folder / "scores.parquet").is_file():
            return folder
    found = sorted(path.parent for path in run_dir.glob("*/scores.parquet"))
    if len(found) == 1:
        return found[0]
    names = ", ".join(path.name for path in found) or "none"
    raise InputError(
        f"an evaluation is needed; found: {names}.",
        where=str(run_dir),
        todo="Run: geofleet evaluate --map FUSED --reference REFERENCE --out RUN_DIR/evaluation"
        if not found
        else "Give the folder of one.",
    )


def _is_total(name: str) -> pc.Expression:
    return pc.field(name) == "all"


def _of(shown: dict[str, Any]) -> pc.Expression:
    """Select the rows of one map."""
    run = pc.field("run_id").is_null() if shown["run_id"] is None else pc.field("run_id") == shown["run_id"]
    return run & (pc.field("method") == shown["method"]) & (pc.field("n_vehicles") == shown["n_vehicles"])


def _choose(totals: list[dict[str, Any]], wanted: dict[str, Any]) -> dict[str, Any]:
    """Return the map to draw: of those asked for, of the largest fleet, the one with the median GOSPA_M."""
    asked = {name: value for name, value in wanted.items() if value is not None}
    fitting = [total for total in totals if all(total[name] == value for name, value in asked.items())]
    if not fitting:
        known = {name: sorted({str(total[name]) for total in totals}) for name in asked}
        raise ConfigError(f"no map of {asked} was scored.", todo=f"There are: {known}.")
    largest = max(total["n_vehicles"] for total in fitting)
    of_it = [total for total in fitting if total["n_vehicles"] == largest]
    of_it.sort(key=lambda t: (t["gospa_m"] is None, t["gospa_m"], t["method"], t["run_id"] or ""))
    return of_it[(len(of_it) - 1) // 2]


def _worst_first(tiles: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return sorted(tiles, key=lambda tile: (-tile["gospa"], tile["tile"]))


def _layer(package: Path, name: str, shown: dict[str, Any]) -> GeoDataFrame:
    """Read a layer of the results, its rows of one map only where the layer tells maps apart."""
    import pyogrio  # noqa: PLC0415  (loads GDAL)

    frame = pyogrio.read_dataframe(package, layer=name)
    for label in LABELS:
        if label in frame and frame[label].notna().any() and shown[label] is not None:
            frame = frame[frame[label] == shown[label]]
    return frame.reset_index(drop=True)


def _rows(path: Path, keep: Callable[[dict[str, str]], bool]) -> list[dict[str, Any]]:
    """Read a CSV that an evaluation may have left out."""
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as stream:
        return [row for row in csv.DictReader(stream) if keep(row)]


def _is_of(row: dict[str, str], shown: dict[str, Any], labels: tuple[str, ...]) -> bool:
    return all(row[label] == ("" if shown[label] is None else str(shown[label])) for label in labels)


def _all(name: str, found: dict[str, list[Path]]) -> pa.Table | None:
    """Return the rows of all tables of a schema."""
    import pyarrow as pa  # noqa: PLC0415

    schema = {LANES.name: LANES, DRIVES.name: DRIVES}[name]
    tables = [read_table(schema, path) for path in found[name]]
    return pa.concat_tables(tables) if tables else None


def _nuisance(paths: list[Path], shown: dict[str, Any]) -> list[dict[str, Any]]:
    """Return what the passes of a map have in common; nothing where several maps of its run lie here."""
    if not str(shown["method"]).startswith("joint"):
        return []
    rows = [row for path in paths for row in read_table(NUISANCE, path).to_pylist()]
    rows = [row for row in rows if (row["run_id"] or None) == shown["run_id"]]
    if len({row["pass_id"] for row in rows}) < len(rows):
        return []
    return sorted(rows, key=lambda row: (-row["is_suspect"], -row["bias_chi2"], row["pass_id"]))


def _manifests(run_dir: Path, folders: list[Path]) -> list[tuple[str, dict[str, Any]]]:
    """Return every manifest at most one folder down, but for that of a former report."""
    paths = sorted(path for folder in folders for path in folder.glob("*_manifest.json"))
    read = [(path.relative_to(run_dir).as_posix(), json.loads(path.read_text(encoding="utf-8"))) for path in paths]
    return [(name, content) for name, content in read if content.get("step") != "report"]
