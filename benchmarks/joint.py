"""Measure joint fusion beside DBSCAN, the known association and the Cramér-Rao bound, on simulated fleets.

    .venv/bin/python benchmarks/joint.py bars --drive A --replicates 200
    .venv/bin/python benchmarks/joint.py rivals --drive A --replicates 60            (DBSCAN on the same fleets)
    .venv/bin/python benchmarks/joint.py bars --drive B --seed 7 --replicates 20      (a seed nobody looked at)
    .venv/bin/python benchmarks/joint.py prior | robustness | cost
    make fusion-table                                                (`study compare`, then `joint.py table`)
    .venv/bin/python benchmarks/joint_report.py                      (docs/fusion-results.md and its figures)

Every command adds its figures to `benchmarks/results/joint.json`; fleets are simulated once, into `--fleets`.
"""

from __future__ import annotations

import argparse
import csv
import json
import pickle
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from joint_cases import PRIOR_CASES, ROBUSTNESS
from joint_cost import measure_cost
from joint_fleets import DRIVE_FILES, SEED, Case, runs, simulated
from joint_honesty import Honesty, covered, faults
from joint_maps import (
    dbscan,
    joint,
    known,
    score_dbscan,
    score_joint,
    score_prior,
    stale_prior,
    without_common_offset,
)

from geofleet.workflows.study.worlds import code_digest

if TYPE_CHECKING:
    from collections.abc import Iterator

    from geofleet.algorithms.metrics import MapScore

RESULTS = Path(__file__).parent / "results/joint.json"
VEHICLES = (1, 2, 3, 5, 8, 10, 15, 20, 30, 50)
KALMAN = {"tracker": "kalman"}
WITH_PRIOR = (1, 3, 50)
"""Fleets that are also given a stale prior."""
N_BOOTSTRAP = 2000
RIVALS = {"dbscan": "dbscan-first", "dbscan by default": "dbscan-peaks", "dbscan corrected": "dbscan-corrected"}
"""DBSCAN as the paper has it, and with a core rule that follows the fleet, without and with biases taken out."""
NO_MATCH_M = 99.0
"""Stands for GOSPA_M where nothing matches, in medians."""


@dataclass
class Scores:
    """Scores of one method on many runs."""

    f1: list[float] = field(default_factory=list)
    gospa_m: list[float] = field(default_factory=list)

    def add(self, score: MapScore) -> None:
        """Add a run."""
        self.f1.append(score.f1 or 0.0)
        self.gospa_m.append(NO_MATCH_M if score.gospa_m is None else score.gospa_m)

    def summary(self) -> dict[str, float]:
        """Return the figures that are told."""
        return {
            "n": len(self.f1),
            "f1_mean": float(np.mean(self.f1)),
            "f1_p1": float(np.quantile(self.f1, 0.01)),
            "f1_min": float(np.min(self.f1)),
            "gospa_m_median": float(np.median(self.gospa_m)),
            "gospa_m_p90": float(np.quantile(self.gospa_m, 0.9)),
        }


class Table(dict[str, Scores]):
    """Scores by method."""

    def add(self, method: str, score: MapScore) -> None:
        """Add a run of a method."""
        self.setdefault(method, Scores()).add(score)

    def summary(self) -> dict[str, dict[str, float]]:
        """Return the figures of every method."""
        found: dict[str, dict[str, float]] = {method: scores.summary() for method, scores in self.items()}
        rival = next((name for name in reversed(RIVALS) if name in self), None)  # the strongest that was run
        if rival:
            found["paired"] = paired(self["joint"], self[rival])
        return found


def paired(ours: Scores, theirs: Scores) -> dict[str, float]:
    """Return median GOSPA_M of both on the runs that both have, and the difference: a percentile bootstrap of runs."""
    n = min(len(ours.gospa_m), len(theirs.gospa_m))
    both = np.column_stack((ours.gospa_m[:n], theirs.gospa_m[:n]))
    drawn = np.median(both[np.random.default_rng(0).integers(0, n, (N_BOOTSTRAP, n))], axis=1)
    low, high = np.quantile(drawn[:, 0] - drawn[:, 1], [0.025, 0.975])
    of_ours, of_theirs = np.median(both, axis=0)
    won = float((both[:, 0] < both[:, 1]).mean())
    return {"n": n, "joint": of_ours, "rival": of_theirs, "low": low, "high": high, "won": won}


def bars(
    fleets: Path, case: Case, n_replicates: int, vehicles: tuple[int, ...]
) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """Score joint fusion at every fleet size; and how honest it is about its errors. A batch at a time.

    What a batch found is kept beside the fleets: a run that was stopped goes on, with the same program.
    """
    sizes = "-".join(map(str, vehicles))
    kept = fleets / f"bars-{case.name}-{sizes}-{code_digest()}.pickle"
    done, tables, honesty, unsettled = _begun(kept, vehicles)
    for number, whole in runs(fleets, case, n_replicates, first=done):
        for v in vehicles:
            run = whole.first_vehicles(v)
            fused = joint(run)
            unsettled[v] += not fused.is_settled
            tables[v].add("joint", score_joint(run, fused))
            best = known(run)
            tables[v].add("known", best.score)
            tables[v].add("known, no common offset", without_common_offset(run, best))
            honesty[v].add(run, fused, best)
            if v in WITH_PRIOR:
                prior, judged = stale_prior(run, whole.in_view, seed=case.seed + number)
                tables[v].add("joint with a stale prior", score_joint(judged, joint(run, prior)))
                tables[v].add("stale prior alone", score_prior(judged, prior))
        if (number + 1) % case.batch == 0:
            for v in vehicles:
                print(number + 1, v, _short(tables[v].summary()), unsettled[v], flush=True)
            kept.write_bytes(pickle.dumps((number + 1, tables, honesty, unsettled)))
            scores = {str(v): {**table.summary(), "unsettled": unsettled[v]} for v, table in tables.items()}
            yield scores, {str(v): honesty[v].summary() for v in vehicles}


def rivals(fleets: Path, case: Case, n_replicates: int, vehicles: tuple[int, ...]) -> dict[str, Any]:
    """Score DBSCAN, and joint fusion beside it on the same runs; its maps are kept beside the fleets."""
    # the fair rival where tracks tell their bias
    labels = ("dbscan", "dbscan corrected") if case.settings.get("tracker") == "kalman" else ("dbscan",)
    tables = {v: Table() for v in vehicles}
    for number, whole in runs(fleets, case, n_replicates):
        if number % case.batch == 0:
            at = simulated(fleets, case, number)
            maps = {(v, label): dbscan(at, case, v, RIVALS[label]) for v in vehicles for label in labels}
        for v in vehicles:
            run = whole.first_vehicles(v)
            tables[v].add("joint", score_joint(run, joint(run)))
            for label in labels:
                tables[v].add(label, score_dbscan(run, maps[v, label]))
    for v, table in tables.items():
        print(v, _short(table.summary()), flush=True)
    return {str(v): {k: of for k, of in table.summary().items() if k != "joint"} for v, table in tables.items()}


def _begun(kept: Path, vehicles: tuple[int, ...]) -> tuple[int, dict[int, Table], dict[int, Honesty], dict[int, int]]:
    """Return how many runs were done, and what they found."""
    if not kept.exists():
        return 0, {v: Table() for v in vehicles}, {v: Honesty() for v in vehicles}, dict.fromkeys(vehicles, 0)
    state: tuple[int, dict[int, Table], dict[int, Honesty], dict[int, int]]
    state = pickle.loads(kept.read_bytes())  # noqa: S301 - written by this program
    return state


def priors(fleets: Path, case: Case, n_replicates: int, vehicles: tuple[int, ...]) -> dict[str, Any]:
    """Every fault of a prior alone, and all together, beside the map without it."""
    found: dict[str, Any] = {}
    for v in vehicles:
        tables = {name: Table() for name in PRIOR_CASES}
        shares: dict[str, list[float]] = {name: [] for name in PRIOR_CASES}
        for number, whole in runs(fleets, case, n_replicates):
            run = whole.first_vehicles(v)
            alone = joint(run)
            for name, how in PRIOR_CASES.items():
                prior, judged = stale_prior(run, whole.in_view, how, seed=case.seed + number)
                fused = joint(run, prior)
                tables[name].add("with", score_joint(judged, fused))
                tables[name].add("without", score_joint(run, alone))
                tables[name].add("prior alone", score_prior(judged, prior))
                shares[name].append(covered(run, fused))
        found[str(v)] = {
            name: {**table.summary(), "coverage_90": float(np.nanmean(shares[name]))} for name, table in tables.items()
        }
        for name, row in found[str(v)].items():
            print(v, name, _short(row), round(row["coverage_90"], 3), flush=True)
    return found


def robustness(fleets: Path, name: str, n_replicates: int, vehicles: tuple[int, ...]) -> dict[str, Any]:
    """Score a hard case beside bias-corrected DBSCAN on the same detections."""
    case = ROBUSTNESS[name]
    tables = {v: Table() for v in vehicles}
    coverage: dict[int, list[float]] = {v: [] for v in vehicles}
    settled: dict[int, list[bool]] = {v: [] for v in vehicles}
    named = {v: np.zeros(4, np.int64) for v in vehicles}
    for number, whole in runs(fleets, case, n_replicates):
        if number % case.batch == 0:
            at = simulated(fleets, case, number)
            rival = "dbscan corrected" if case.settings.get("send_information", True) else "dbscan by default"
            maps = {v: dbscan(at, case, v, RIVALS[rival]) for v in vehicles}
        for v in vehicles:
            run = whole.first_vehicles(v)
            fused = joint(run)
            tables[v].add("joint", score_joint(run, fused))
            tables[v].add("known", known(run).score)
            tables[v].add(rival, score_dbscan(run, maps[v]))
            coverage[v].append(covered(run, fused))
            settled[v].append(fused.is_settled)
            named[v] += faults(run, fused)
    found = {
        str(v): {
            **table.summary(),
            "coverage_90": float(np.nanmean(coverage[v])),
            "settled": float(np.mean(settled[v])),
            "named": dict(zip(("faulty", "faulty named", "sound", "sound named"), named[v].tolist(), strict=True)),
        }
        for v, table in tables.items()
    }
    for size, row in found.items():
        print(name, size, _short(row), f"coverage {row['coverage_90']:.2f} settled {row['settled']:.2f}", flush=True)
    return found


def shown(folder: Path) -> dict[str, Any]:
    """Return the figures of a `study compare`, by scenario, tracker and drive, fleet size and method."""
    found: dict[str, Any] = {}
    with (folder / "compare" / "summary.csv").open(encoding="utf-8") as stream:
        for row in csv.DictReader(stream):
            if row["score"] in {"f1", "gospa_m"}:
                drive = next(name for name, file in DRIVE_FILES.items() if file == row["place"])
                of = found.setdefault(f"{row['scenario']}, {row['tracker']}, {drive}", {})
                of = of.setdefault(row["n_vehicles"], {}).setdefault(row["method"], {})
                numbers = {name: float(row[name]) for name in ("mean", "sd", "median", "n", "n_null") if row[name]}
                of[row["score"]] = numbers
    return found


def _short(row: dict[str, Any]) -> str:
    return " | ".join(
        f"{name}: F1 {s['f1_mean']:.3f} (1 % {s['f1_p1']:.3f}) GM {s['gospa_m_median']:.3f}"
        for name, s in row.items()
        if "f1_mean" in (s if isinstance(s, dict) else {})
    )


def keep(section: str, name: str, figures: Any, *, is_part: bool = False) -> None:
    """Put figures into the results, beside those of other commands; with `is_part`, also of other sizes and methods."""
    RESULTS.parent.mkdir(exist_ok=True)
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    of_section = results.setdefault(section, {})
    before = of_section.get(name, {}) if is_part else {}
    of_section[name] = before | {key: before.get(key, {}) | of for key, of in figures.items()} if is_part else figures
    RESULTS.write_text(json.dumps(_rounded(results), indent=1, sort_keys=True) + "\n")


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return round(value, 4) if isinstance(value, float) else value


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("bars", "rivals", "table", "prior", "robustness", "cost"))
    parser.add_argument("--fleets", type=Path, default=Path("data/processed/benchmark-fleets"))
    parser.add_argument("--drive", choices=("A", "B"), default="A")
    parser.add_argument("--scenario", default="paper-ideal")
    parser.add_argument("--tracker", default="kalman")
    parser.add_argument("--replicates", type=int, default=200)
    parser.add_argument("--vehicles", type=int, nargs="+")
    parser.add_argument("--cases", nargs="*", default=[])
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--largest", type=int, default=50, help="vehicles that are simulated")
    parser.add_argument("--study", type=Path, default=Path("data/processed/fusion-study"))
    given = parser.parse_args()
    case = Case(given.scenario, given.drive, {"tracker": given.tracker}, given.largest, seed=given.seed)
    name = f"{given.scenario}, {given.tracker}, {given.drive}"
    is_usual = given.seed == SEED
    largest = "" if given.largest == Case.n_vehicles else f", {given.largest} at most"
    section, name = ("bars", name) if is_usual else ("fresh", f"{name}, seed {given.seed}{largest}")
    sizes = tuple(given.vehicles or VEHICLES)
    if given.what == "bars":
        for scores, honesty in bars(given.fleets, case, given.replicates, sizes):
            keep(section, name, scores, is_part=True)
            if is_usual:
                keep("honesty", name, honesty, is_part=True)
    elif given.what == "rivals":
        keep(section, name, rivals(given.fleets, case, given.replicates, sizes), is_part=True)
    elif given.what == "table":
        for world, by_size in shown(given.study).items():
            keep("table", world, by_size)
    elif given.what == "prior":
        keep("prior", name, priors(given.fleets, case, given.replicates, tuple(given.vehicles or (3, 20, 50))))
    elif given.what == "robustness":
        sizes = tuple(given.vehicles or (5, 20))
        for one in given.cases or ROBUSTNESS:
            keep("robustness", one, robustness(given.fleets, one, given.replicates, sizes))
    else:
        keep("cost", "two cores", measure_cost())


if __name__ == "__main__":
    main()
