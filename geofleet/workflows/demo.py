"""The main job on the shipped data: real signs and roads of Helsinki, a derived drive, a simulated fleet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow.compute as pc

from geofleet.config import load_config
from geofleet.errors import InputError
from geofleet.steps.aggregate import aggregate
from geofleet.steps.evaluate import evaluate
from geofleet.steps.ingest import ingest_drive, ingest_lanes, ingest_signs
from geofleet.steps.report import PAGE, PROJECT, report
from geofleet.steps.simulate import simulate
from geofleet.tables.schemas import RUNS, SCORES
from geofleet.tables.store import read_table

if TYPE_CHECKING:
    from collections.abc import Callable

N_VEHICLES = 50
SEED = 0


@dataclass(frozen=True, slots=True)
class DemoResult:
    """What the demo found, and the files that show it."""

    caption: str
    totals: tuple[dict[str, Any], ...]
    files: tuple[Path, ...]


def raw_data() -> Path:
    """Return the folder of the shipped inputs: inside the package when installed, else the checkout's `data/raw/`."""
    package = Path(__file__).resolve().parent.parent
    packed = package / "_data"
    return packed if packed.is_dir() else package.parent / "data" / "raw"


def run_demo(
    out: Path,
    *,
    n_vehicles: int = N_VEHICLES,
    n_workers: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Run every step as the Makefile does and leave the tables below `out`."""
    config = load_config()
    raw, signs, drives = raw_data(), out / "signs" / "signs.parquet", out / "drives" / "drives.parquet"
    simulation, fused = out / "simulation", out / "fused" / "fused.parquet"
    steps: tuple[Callable[[], object], ...] = (
        lambda: ingest_signs([raw / "helsinki.osm.pbf"], signs),
        lambda: ingest_lanes([raw / "helsinki.osm.pbf"], out / "lanes" / "lanes.parquet"),
        lambda: ingest_drive([raw / "helsinki_derived.pos"], drives),
        lambda: simulate(
            signs, drives, simulation, config=config, n_vehicles=n_vehicles, seed=SEED, n_workers=n_workers
        ),
        lambda: aggregate(simulation / "detections", fused, config=config, n_workers=n_workers),
        lambda: evaluate(fused, simulation / "reference.parquet", out / "evaluation", config=config, drive_path=drives),
        lambda: report(out, out / "report"),
    )
    for done, step in enumerate(steps):
        if progress:
            progress(done, len(steps))
        step()


def demo_result(out: Path) -> DemoResult:
    """Read what a finished demo has found.

    Raises
    ------
    InputError
        There is no finished demo at `out`.
    """
    page = out / "report" / PAGE
    if not page.is_file():
        raise InputError("there is no finished demo here.", where=str(out), todo=f"Run: geofleet demo --out {out}")
    scores = read_table(SCORES, out / "evaluation" / "scores.parquet")
    runs = read_table(RUNS, out / "simulation" / "runs.parquet").to_pylist()
    totals = scores.filter((pc.field("tile") == "all") & (pc.field("concept") == "all")).to_pylist()
    caption = (
        f"{runs[0]['n_vehicles']} simulated vehicles (scenario {runs[0]['scenario']}, tracker {runs[0]['tracker']}, "
        f"upload {runs[0]['upload']}) past real signs of central Helsinki, on a drive derived from the road graph."
    )
    files = (page, out / "qgis" / PROJECT)
    return DemoResult(caption, tuple(totals), files)
