"""Does F1 hold as passes grow to 2,000? The demo scene, DBSCAN's core fixed and following the densest place around.

    python benchmarks/fleet_growth.py --seed 11 --replicates 10
    python benchmarks/fleet_growth.py --seed 12 --replicates 10 --drive data/raw/helsinki_derived_b.pos

Means over replicates. `step` is the mean change of F1 from the size before, replicate by replicate, with its standard
error: a fleet of 50 is the first 50 vehicles of the fleet of 100, so that the sizes share their luck.
Detections are simulated; signs and the road are real (© OpenStreetMap contributors, ODbL).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms import clustering
from geofleet.config import load_config
from geofleet.steps.aggregate import aggregate
from geofleet.steps.evaluate import evaluate
from geofleet.steps.ingest import ingest_drive, ingest_signs
from geofleet.steps.simulate import simulate

if TYPE_CHECKING:
    from numpy.typing import NDArray

RAW = Path(__file__).parent.parent / "data" / "raw"
KEYS = ("f1", "tp", "fp", "fn", "gospa_m")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--sizes", nargs="+", type=int, default=[20, 50, 100, 200, 500, 2000])
    parser.add_argument("--shares", nargs="+", type=float, default=[0.0, 0.7])
    parser.add_argument("--replicates", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drive", type=Path, default=RAW / "helsinki_derived.pos")
    parser.add_argument(
        "--with-passes", action="store_true", help="support relative to the passes that had a place in view"
    )
    parser.add_argument("--peak-steps", type=int, default=clustering.PEAK_STEPS, help="how far is around; 60: anywhere")
    args = parser.parse_args()
    clustering.PEAK_STEPS = args.peak_steps
    with TemporaryDirectory() as name:
        folder = Path(name)
        ingest_signs([RAW / "helsinki.osm.pbf"], folder / "signs.parquet")
        ingest_drive([args.drive], folder / "drives.parquet")
        out = folder / "simulation"
        config = load_config(args.scenario, args.set)
        simulate(
            *(folder / "signs.parquet", folder / "drives.parquet", out),
            config=config,
            n_vehicles=max(args.sizes),
            n_replicates=args.replicates,
            seed=args.seed,
        )
        passes = out / "passes.parquet" if args.with_passes else None
        print("vehicles  share     F1   step (s.e.)        tp    fp    fn  GOSPA_M")
        before: dict[float, NDArray[np.float64]] = {}
        for size in args.sizes:
            for share in args.shares:
                config = load_config(args.scenario, [*args.set, f"min_samples_share={share}"])
                aggregate(out / "detections", folder / "fused.parquet", config=config, n_vehicles=size, passes=passes)
                totals = evaluate(
                    folder / "fused.parquet", out / "reference.parquet", folder / "evaluation", config=config
                ).totals
                f1, *others = (np.array([row[key] or 0 for row in totals]) for key in KEYS)
                step = f1 - before.get(share, f1)
                error = step.std(ddof=1) / np.sqrt(step.size) if step.size > 1 else float("nan")
                tp, fp, fn, gospa_m = (values.mean() for values in others)
                print(
                    f"{size:8d}  {share:5.2f}  {f1.mean():.3f}  {step.mean():+.3f} ({error:.3f})"
                    f"  {tp:6.1f}{fp:6.1f}{fn:6.1f}  {gospa_m:.3f}",
                    flush=True,
                )
                before[share] = f1


if __name__ == "__main__":
    main()
