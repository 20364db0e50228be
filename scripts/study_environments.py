"""The paper's two open questions: other road environments, and fleets mixed from high-end and low-end sensors.

    python scripts/study_environments.py --out data/processed/study

Helsinki is shipped; Ingolstadt (OpenDRIVE), a stretch of the motorway A9 (OpenDRIVE) and the street Vaartstraat of
Hansbeke (an inventory) are real signs in ../shared/data, which is not: without them only Helsinki is simulated. Their
drives are derived from the maps (`derive_map_drive.py`). Fleets and detections are simulated.
"""

from __future__ import annotations

import argparse
import os
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from derive_map_drive import derive

from geofleet.cli.output import progress_bar
from geofleet.config import load_config
from geofleet.formats.study_figures import draw_curves, figure_file
from geofleet.workflows.study.compare import BARS, describe
from geofleet.workflows.study.methods import CORRECTED, JOINT, default_methods, parse_methods
from geofleet.workflows.study.results import find, write_study
from geofleet.workflows.study.units import run_study
from geofleet.workflows.study.worlds import Study, World, as_drives_table, as_signs_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

REPO = Path(__file__).resolve().parents[1]
RAW, SHARED = REPO / "data" / "raw", REPO.parent / "shared" / "data"
SIZES = (2, 5, 10, 20, 50)
PLACES = {  # place: scenario, map, street of an inventory
    "Ingolstadt": ("urban", SHARED / "opendrive" / "ingolstadt_cityhall.xodr", None),
    "A9": ("highway", SHARED / "opendrive" / "a9_nord_excerpt_bssd.xodr", None),
    "Hansbeke": ("rural", SHARED / "inventory" / "hansbeke_traffic-signs.geojson", "Vaartstraat"),
}
FLEETS = {  # what the rest carries is the camera of the scenario `urban`
    "all high-end": (1.0, 0.0),
    "half high-end, half telephone": (0.5, 0.5),
    "20 % high-end, 30 % telephone": (0.2, 0.3),
    "all as in urban": (0.0, 0.0),
    "20 % high-end, 80 % telephone": (0.2, 0.8),
    "all telephone": (0.0, 1.0),
}


def helsinki(folder: Path) -> World:
    """Return the shipped place under the scenario `urban`."""
    signs = as_signs_table(RAW / "helsinki.osm.pbf", folder)
    drive = as_drives_table(RAW / "helsinki_derived.pos", folder / "helsinki.parquet")
    return World("Helsinki (urban)", "", signs, drive, load_config("urban"))


def environments(folder: Path) -> tuple[World, ...]:
    """Return the shipped place and every other whose map is on this machine."""
    worlds = [helsinki(folder)]
    for place, (scenario, source, street) in PLACES.items():
        if not source.is_file():
            sys.stderr.write(f"{place} is left out: {source} is not on this machine\n")
            continue
        own = folder / place
        own.mkdir(parents=True, exist_ok=True)
        derive(source, own / "drive.parquet", street)
        signs = as_signs_table(source, own)
        worlds.append(World(f"{place} ({scenario})", "", signs, own / "drive.parquet", load_config(scenario)))
    return tuple(worlds)


def mixed_fleets(folder: Path) -> tuple[World, ...]:
    """Return the shipped place with fleets of other sensors."""
    base = helsinki(folder)
    return tuple(
        replace(base, setting=name, config=load_config("mixed", _shares(*shares))) for name, shares in FLEETS.items()
    )


def _shares(high_end: float, telephone: float) -> dict[str, Any]:
    return {"mixed.high_end.share": high_end, "mixed.telephone.share": telephone}


def draw(folder: Path, summary: Sequence[Mapping[str, Any]], *, name: str, by: str, caption: str) -> None:
    """Draw F1 and GOSPA_M over the size of the fleet: a row a method, a line an environment or a fleet."""
    methods = list(dict.fromkeys(row["method"] for row in summary))
    size = (9.0, 1.2 + 2.7 * len(methods))
    with figure_file(folder / name, caption=f"{caption}\n{BARS}", size=size) as figure:
        axes = figure.subplots(len(methods), 2, sharex=True, sharey="col", squeeze=False)
        for row, method in zip(axes, methods, strict=True):
            for one, score in zip(row, ("f1", "gospa_m"), strict=True):
                draw_curves(one, find(summary, method=method), score=score, by=by)
                one.set_xscale("log")
                one.set_xticks(SIZES, [str(v) for v in SIZES])
                one.set_title(method, fontsize=9, loc="left")
                one.minorticks_off()
            row[0].set_ylim(0, 1.03)
            row[1].set_ylim(0, 4)
        for one in axes[-1]:
            one.set_xlabel("vehicles")
        figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside upper center", ncols=3)


def main() -> None:
    """Run both studies; what is done is not done again."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("data/processed/study"))
    parser.add_argument("--replicates", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    args = parser.parse_args()
    methods = parse_methods(default_methods("dbscan-first", CORRECTED, JOINT))
    for name, make, by in (("environments", environments, "place"), ("mixed-fleets", mixed_fleets, "setting")):
        worlds = make(args.out / "inputs")
        study = Study(worlds, methods, SIZES, args.replicates, args.seed, in_view=True)
        with progress_bar(name) as progress:
            rows = run_study(study, args.out, n_workers=args.workers, progress=progress)
        caption = describe(study)
        write_study(
            *(name, study, rows, args.out),
            draw=partial(draw, name=name, by=by, caption=caption),
        )
        print(f"{name}: {args.out / name}")


if __name__ == "__main__":
    main()
