"""Place signs along a recorded drive that has no sign map: **they are simulated, no such sign stands there**.

Poles come as a Poisson process along the drive, no two nearer than `--gap-m`, on the side of the traffic, 3 to 8 m from
the path of the car; they face it. One pole in five carries two plates. Classes are drawn with the shares that they have
among the main signs of a real layer. The layer says so in every row: `source` begins with `placed`, and so do all ids,
which a simulation copies to its `reference`.

    geofleet ingest drive ../shared/data/trajectory/nagoya/reference.csv --out drive.parquet
    python scripts/place_signs.py drive.parquet signs.parquet --side left
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.algorithms.trajectory import resample
from geofleet.formats.layers import read_drives, read_layer
from geofleet.tables.scenes import load_drive
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import build_table, write_table
from geofleet.taxonomy import load_taxonomy

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

HELSINKI = Path(__file__).resolve().parents[1] / "data" / "raw" / "helsinki.osm.pbf"
GROUPS = ("warning", "priority", "prohibition", "mandatory", "crossing")
BESIDE_M = (3.0, 8.0)
TWO_PLATES = 0.2
MEANING = ("concept", "value", "unit", "sign_class", "raw_code")


def poles_along(length_m: float, *, per_km: float, gap_m: float, rng: Generator) -> Floats:
    """Return distances along a drive: gaps of `gap_m` and an exponential more, `per_km` on average."""
    mean_m = 1000.0 / per_km - gap_m
    if mean_m <= 0:
        raise SystemExit(f"{per_km:g} poles a km leave no gap of {gap_m:g} m: lower --per-km or --gap-m")
    gaps = gap_m + rng.exponential(mean_m, int(2 * length_m * per_km / 1000) + 20)
    along: Floats = np.cumsum(gaps)
    return along[along < length_m]


def real_classes(layer: Path) -> pa.Table:
    """Return the meaning of every main sign of a real layer, of the groups that studies use."""
    signs = read_layer(layer).table
    group = load_taxonomy().group_of(signs["concept"].to_pylist())
    is_wanted = pa.array(np.isin(group.astype(str), GROUPS))
    return signs.filter(pc.and_(is_wanted, pc.equal(signs["kind"], "main"))).select(list(MEANING))


def plates_on(n_poles: int, classes: pa.Table, rng: Generator) -> tuple[Ints, Ints]:
    """Return the pole and the row of `classes` of every plate; two plates of a pole differ in class."""
    name = np.array(classes["sign_class"].to_pylist(), dtype=object)
    first, second = rng.integers(0, len(name), (2, n_poles))
    has_two = (rng.random(n_poles) < TWO_PLATES) & (name[first] != name[second])
    pole = np.concatenate((np.arange(n_poles), np.flatnonzero(has_two)))
    row = np.concatenate((first, second[has_two]))
    order = np.argsort(pole, kind="stable")
    return pole[order], row[order]


def place(drive: Path, out: Path, *, per_km: float, gap_m: float, side: str, like: Path, seed: int) -> int:
    """Write the layer and return its number of signs."""
    rng, driven = np.random.default_rng(seed), load_drive(read_drives(drive).table, drive)
    way = resample(driven.line, spacing_m=1.0, heading_baseline_m=9.0)
    near = np.searchsorted(way.along_m, poles_along(way.along_m[-1], per_km=per_km, gap_m=gap_m, rng=rng))
    beside_m = rng.uniform(*BESIDE_M, len(near)) * (1 if side == "left" else -1)
    heading = way.heading_rad[near]
    left = np.column_stack((-np.sin(heading), np.cos(heading)))
    classes = real_classes(like)
    pole, row = plates_on(len(near), classes, rng)
    meaning = {name: classes[name].take(pa.array(row)).combine_chunks() for name in MEANING}
    columns = meaning | {
        "sign_id": [f"placed-{k:05d}" for k in range(len(pole))],
        "support_id": [f"placed-pole-{k:05d}" for k in pole],
        "source_ref": [f"placed/{k}" for k in range(len(pole))],
        "source": f"placed along {driven.drive_id}: simulated, no such sign stands there",
        "kind": "main",
        "facing_deg": (270.0 - np.rad2deg(heading[pole])) % 360.0,  # towards the car that comes
    }
    places = (way.xy_m[near] + beside_m[:, None] * left)[pole]
    write_table(SIGNS, build_table(SIGNS, columns, geometry=driven.frame.to_lonlat(places)), out)
    return len(pole)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("drive", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--per-km", type=float, default=20.0)
    parser.add_argument("--gap-m", type=float, default=10.0)
    parser.add_argument("--side", choices=("left", "right"), default="right")
    parser.add_argument("--like", type=Path, default=HELSINKI)
    parser.add_argument("--seed", type=int, default=0)
    arguments = vars(parser.parse_args())
    print(f"{arguments['out']}: {place(**arguments)} signs placed along a recorded drive; none of them is real")
