"""Does F1 hold as passes grow to 2,000? The demo scene, DBSCAN's core rule fixed and following the passes.

    python benchmarks/fleet_growth.py --replicates 3

Detections are simulated; signs and the road are real (© OpenStreetMap contributors, ODbL).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from geofleet.config import load_config
from geofleet.steps.aggregate import aggregate
from geofleet.steps.evaluate import evaluate
from geofleet.steps.ingest import ingest_drive, ingest_signs
from geofleet.steps.simulate import simulate

RAW = Path(__file__).parent.parent / "data" / "raw"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--sizes", nargs="+", type=int, default=[20, 50, 100, 200, 2000])
    parser.add_argument("--shares", nargs="+", type=float, default=[0.0, 0.2, 0.35, 0.5])
    parser.add_argument("--replicates", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--drive", type=Path, default=RAW / "helsinki_derived.pos")
    args = parser.parse_args()
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
        print("vehicles  share     F1    tp    fp    fn  GOSPA_M")
        for size in args.sizes:
            for share in args.shares:
                config = load_config(args.scenario, [*args.set, f"min_samples_share={share}"])
                aggregate(out / "detections", folder / "fused.parquet", config=config, n_vehicles=size)
                totals = evaluate(
                    folder / "fused.parquet", out / "reference.parquet", folder / "evaluation", config=config
                ).totals
                means = [np.mean([row[key] or 0 for row in totals]) for key in ("f1", "tp", "fp", "fn", "gospa_m")]
                f1, tp, fp, fn, gospa_m = means
                print(f"{size:8d}  {share:5.2f}  {f1:.3f}{tp:6.1f}{fp:6.1f}{fn:6.1f}  {gospa_m:.3f}")


if __name__ == "__main__":
    main()
