"""The paper's Figure 5 (GOSPA_M over fleet size) on the shipped drives, beside the paper's own points.

    python benchmarks/paper_figure5.py --scenario paper --seed 1 --replicates 24
    python benchmarks/paper_figure5.py --drive data/raw/helsinki_derived_b.pos --in-view

The map is that of `dbscan-first` in a study: plain DBSCAN, as the paper has it (`min_samples_share` 0).
Detections are simulated; signs and roads are real (© OpenStreetMap contributors, ODbL), the drives derived.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow.compute as pc

from geofleet.config import load_config
from geofleet.steps.aggregate import aggregate
from geofleet.steps.evaluate import evaluate
from geofleet.steps.ingest import ingest_drive, ingest_signs
from geofleet.steps.simulate import simulate
from geofleet.tables.schemas import REFERENCE, SIGNS
from geofleet.tables.store import atomic_path, read_table, write_table
from geofleet.workflows.study.fleet_size import PAPER_METHOD
from geofleet.workflows.study.methods import METHODS, with_settings
from geofleet.workflows.study.paper import paper_curve

RAW = Path(__file__).parent.parent / "data" / "raw"


BLOCK = 10
"""Replicates that are simulated, aggregated and scored before any is kept."""


def scores(folder: Path, args: argparse.Namespace, replicates: range) -> list[dict[str, object]]:
    """Simulate some replicates once and return the totals of every fleet size."""
    config = with_settings(load_config(args.scenario, args.set), METHODS[PAPER_METHOD])
    ingest_signs([RAW / "helsinki.osm.pbf"], folder / "signs.parquet")
    ingest_drive([args.drive], folder / "drives.parquet")
    simulation = folder / "simulation"
    simulate(
        *(folder / "signs.parquet", folder / "drives.parquet", simulation),
        config=config,
        n_vehicles=50,
        n_replicates=len(replicates),
        first_replicate=replicates.start,
        seed=args.seed,
    )
    reference = simulation / "reference.parquet"
    if args.in_view:
        seen = read_table(REFERENCE, reference).filter(pc.field("n_passes_in_view") > 0)
        reference = folder / "seen.parquet"
        write_table(SIGNS, seen.drop_columns(["n_passes_in_view", "n_frames_in_view"]), reference)
    totals: list[dict[str, object]] = []
    for size in [point.n_vehicles for point in paper_curve("gospa_m")]:
        fused = folder / f"fused-{size}.parquet"
        aggregate(simulation / "detections", fused, config=config, n_vehicles=size)
        totals += evaluate(fused, reference, folder / f"evaluation-{size}", config=config).totals
    return totals


def kept_scores(args: argparse.Namespace) -> list[dict[str, object]]:
    """Return the totals of all replicates, block by block; those in the file to keep are not computed again."""
    what = [args.scenario, *args.set, args.seed, args.drive.name, args.in_view]
    blocks = json.loads(args.keep.read_text(encoding="utf-8")) if args.keep and args.keep.exists() else {}
    totals = []
    for first in range(0, args.replicates, BLOCK):
        replicates = range(first, min(first + BLOCK, args.replicates))
        key = " ".join(map(str, [*what, replicates.start, replicates.stop]))
        if key not in blocks:
            with TemporaryDirectory() as name:
                blocks[key] = scores(Path(name), args, replicates)
            if args.keep:
                with atomic_path(args.keep) as draft:
                    draft.write_text(json.dumps(blocks), encoding="utf-8")
        totals += blocks[key]
    return totals


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--replicates", type=int, default=24)
    parser.add_argument("--drive", type=Path, default=RAW / "helsinki_derived.pos")
    parser.add_argument("--in-view", action="store_true", help="leave out signs that no pass had in view")
    parser.add_argument("--keep", type=Path, metavar="FILE.json", help="keep what is done, to go on from there")
    args = parser.parse_args()
    totals = kept_scores(args)
    print(f"{args.scenario}, seed {args.seed}, {args.replicates} replicates, {args.drive.name}")
    print(" V   F1 (paper)     tp   fp   fn   GOSPA_M mean sd median (paper mean sd)   z")
    inside = 0
    for point, paper_f1 in zip(paper_curve("gospa_m"), paper_curve("f1"), strict=True):
        size = point.n_vehicles
        rows = [total for total in totals if total["n_vehicles"] == size]
        gospa_m, f1, tp, fp, fn = (
            np.array([row[name] for row in rows], float) for name in ("gospa_m", "f1", "tp", "fp", "fn")
        )
        gospa_m = gospa_m[~np.isnan(gospa_m)]  # a map without a hit has none
        z = (gospa_m.mean() - point.mean) / point.sd
        inside += abs(z) <= 1
        print(
            f"{size:3.0f}  {f1.mean():.3f} ({paper_f1.mean:.3f})  {tp.mean():5.1f}{fp.mean():5.1f}{fn.mean():5.1f}"
            f"   {gospa_m.mean():.3f} {gospa_m.std(ddof=1):.3f} {np.median(gospa_m):.3f}"
            f"  ({point.mean:.3f} {point.sd:.3f})  {z:+.2f}"
            + (f"  undefined in {n_undefined} runs" if (n_undefined := len(rows) - len(gospa_m)) else "")
        )
    print(f"within the paper's mean ± 1 sd: {inside} of {len(paper_curve('gospa_m'))} fleet sizes")


if __name__ == "__main__":
    main()
