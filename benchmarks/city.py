"""A city, out of core: every sign of central Helsinki, thousands of passes of 5 km, and what they cost.

    python benchmarks/city.py                     # 500, 1000 and 2000 passes; needs ../shared/data
    python benchmarks/city.py --passes 2000 --source city.osm.pbf --workers 1

Signs and roads are real (© OpenStreetMap contributors, ODbL). The drives are derived from the road graph by
`scripts/derive_city_drives.py`: nobody drove them. The detections are simulated. Each size is a `geofleet simulate`
of its own, so the peak memory is that of the command.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import NamedTuple

from geofleet.taxonomy import load_taxonomy

ROOT = Path(__file__).resolve().parents[1]
HELSINKI = ROOT.parent / "shared" / "data" / "osm" / "Helsinki.osm.pbf"
NOT_SIGNS = {"light", "marking", "plate"}


class Cost(NamedTuple):
    """What a command printed, how long it took, the processor time of all its threads and its peak memory."""

    printed: str
    wall_s: float
    cpu_s: float
    peak_mb: float


def measured(*command: object) -> Cost:
    """Run a command and measure it; its messages are shown when it fails."""
    begin = perf_counter()
    arguments = [str(part) for part in command]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True) as process:  # noqa: S603 - our own commands
        printed = process.stdout.read()
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(process.returncode)
    return Cost(printed, perf_counter() - begin, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def size_mb(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", type=Path, default=HELSINKI)
    parser.add_argument("--drives", type=int, default=12)
    parser.add_argument("--length-m", type=float, default=5000.0)
    parser.add_argument("--passes", type=int, action="append")
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--workers", type=int, default=2)
    args = parser.parse_args()
    geofleet = Path(sys.executable).with_name("geofleet")
    groups = ",".join(group for group in load_taxonomy().groups if group not in NOT_SIGNS)
    with TemporaryDirectory() as name:
        folder = Path(name)
        signs, drives = folder / "signs.parquet", folder / "drives.parquet"
        measured(geofleet, "ingest", "signs", args.source, "--out", signs)
        derive = ROOT / "scripts" / "derive_city_drives.py"
        how = ("--drives", args.drives, "--length-m", args.length_m)
        print(measured(sys.executable, derive, args.source, drives, *how).printed.strip())
        print("passes  signs  frame detections     tracks  wall s  CPU s  M detections/s: wall, CPU  peak MB  disk MB")
        for n in args.passes or (500, 1000, 2000):
            cost = measured(
                *(geofleet, "simulate", "--signs", signs, "--drive", drives, "--out", folder / "out", "--json"),
                *("--groups", groups, "--set", "drives=all", "--scenario", args.scenario),
                *("--vehicles", n, "--workers", args.workers),
            )
            told = json.loads(cost.printed)
            frames = told["n_frame_detections"]
            print(
                f"{n:6d}  {told['n_signs']:5d}  {frames:16,d}  {told['n_detections']:9,d}  {cost.wall_s:6.1f}"
                f"  {cost.cpu_s:5.1f}  {frames / cost.wall_s / 1e6:20.2f} {frames / cost.cpu_s / 1e6:5.2f}"
                f"  {cost.peak_mb:7.0f}  {size_mb(folder / 'out'):7.0f}"
            )


if __name__ == "__main__":
    main()
