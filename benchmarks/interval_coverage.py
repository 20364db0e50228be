"""Measure how often each 95 % interval holds what it is an interval for.

    .venv/bin/python benchmarks/interval_coverage.py [repetitions]
    .venv/bin/python benchmarks/interval_coverage.py fleets [runs]      (how `FLEETS` was made; 2 s a run)

Every repetition draws a new map (or a new set of runs) from a process whose true score is known. 2000 repetitions tell
coverage to about one percentage point (two standard errors); `docs/uncertainty.md` carries the table that this prints.
"""

from __future__ import annotations

import sys
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, get_args

import numpy as np
from scipy import stats

import geofleet as gf
from geofleet.algorithms.metrics import derive_scores
from geofleet.algorithms.road import RoadOutcomes
from geofleet.algorithms.uncertainty import Method, compare_replicates, replicate_interval
from geofleet.algorithms.uncertainty_paired import compare_on_road
from geofleet.algorithms.uncertainty_road import COMMON_OFFSET, ROAD_SCORES, road_intervals

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.random import Generator
    from numpy.typing import NDArray

    from geofleet.algorithms.uncertainty import Interval

    Floats = NDArray[np.float64]

GATE_M = 2.0
SCORES = ("precision", "recall", "f1", "rmse_m", "gospa_m")


@dataclass(frozen=True)
class World:
    """A road, and a procedure that maps it with errors.

    Each sign is missed when a latent number passes a threshold, comes with a ghost when another does, and is off by an
    error whose scale is log-normal from sign to sign; an error beyond the gate costs an FP and an FN. Latent numbers
    share the part `shared` of their variance within stretches of `stretch_m`, whose start is random; `common_offset_m`
    (per axis) moves a whole map.
    """

    n_signs: int
    length_m: float
    shared: float = 0.0
    stretch_m: float = 100.0
    miss_rate: float = 0.10
    ghost_rate: float = 0.05
    sigma_m: float = 0.4
    common_offset_m: float = 0.0


URBAN = World(33, 1200.0)  # the demo's scene
CITY = World(500, 18_000.0)
GOOD = {"miss_rate": 0.02, "ghost_rate": 0.01, "sigma_m": 0.2}

ROADS = {
    "33 signs, 1.2 km, independent": URBAN,
    "33 signs, stretches of 100 m, 0.3 shared": replace(URBAN, shared=0.3),
    "33 signs, stretches of 100 m, 0.6 shared": replace(URBAN, shared=0.6),
    "33 signs, good map, independent": replace(URBAN, **GOOD),
    "33 signs, good map, 0.3 shared": replace(URBAN, **GOOD, shared=0.3),
    "500 signs, 18 km, independent": CITY,
    "500 signs, stretches of 100 m, 0.3 shared": replace(CITY, shared=0.3),
    "500 signs, stretches of 100 m, 0.6 shared": replace(CITY, shared=0.6),
    "500 signs, good map, 0.3 shared": replace(CITY, **GOOD, shared=0.3),
}
WARNED_ROADS = {
    "17 signs, 600 m (3 blocks), 0.3 shared": World(17, 600.0, shared=0.3),
    "500 signs, stretches of 1 km, 0.6 shared": replace(CITY, shared=0.6, stretch_m=1000.0),
    "33 signs, offset of 0.5 m common to the map": replace(URBAN, common_offset_m=0.5),
    "500 signs, offset of 0.5 m common to the map": replace(CITY, common_offset_m=0.5),
}
BETTER_MAP = {"miss_rate": 0.05, "ghost_rate": 0.03, "sigma_m": 0.3}


PROBABILITIES = (*np.linspace(0, 0.9, 19), 0.925, 0.95, 0.975, 0.99, 1.0)


class Fleet(NamedTuple):
    """Quantiles at `PROBABILITIES` of GOSPA_M over 400 runs of the scenario `paper` on the demo's drive, metres."""

    quantiles: tuple[float, ...]

    def at(self, probability: Floats) -> Floats:
        """Return the quantiles at any probability."""
        return np.interp(probability, PROBABILITIES, self.quantiles)

    def truth(self, method: Method) -> float:
        """Return what an interval of the method is for."""
        return float(self.at(np.array(0.5)) if method == "median" else np.trapezoid(self.quantiles, PROBABILITIES))


FLEETS = {
    # 6 of 400 runs had no match; mean 1.873, standard deviation 1.244
    "5 vehicles": Fleet(
        (
            0.615,
            0.899,
            0.980,
            1.040,
            1.119,
            1.192,
            1.265,
            1.326,
            1.398,
            1.462,
            1.578,
            1.621,
            1.695,
            1.761,
            1.872,
            1.994,
            2.196,
            2.576,
            3.097,
            3.420,
            3.951,
            5.405,
            6.978,
            12.119,
        )
    ),
    # 0 of 400 runs had no match; mean 0.893, standard deviation 0.182
    "20 vehicles": Fleet(
        (
            0.618,
            0.662,
            0.689,
            0.709,
            0.731,
            0.757,
            0.771,
            0.791,
            0.818,
            0.836,
            0.860,
            0.888,
            0.917,
            0.942,
            0.964,
            1.001,
            1.030,
            1.069,
            1.133,
            1.187,
            1.263,
            1.329,
            1.415,
            1.559,
        )
    ),
}


class Latents:
    """Numbers of variance 1 that the signs of a stretch share in part."""

    def __init__(self, world: World, rng: Generator) -> None:
        self.rng, self.shared = rng, world.shared
        self.station_m = rng.uniform(0, world.length_m, world.n_signs)
        self.stretch = ((self.station_m + rng.uniform(0, world.stretch_m)) // world.stretch_m).astype(int)

    def draw(self) -> Floats:
        """Draw one number a sign."""
        of_stretch = self.rng.standard_normal(self.stretch.max(initial=0) + 1)[self.stretch]
        own = self.rng.standard_normal(self.station_m.size)
        return np.sqrt(self.shared) * of_stretch + np.sqrt(1 - self.shared) * own


def map_of(world: World, signs: Latents, common: list[Floats] | None = None) -> RoadOutcomes:
    """Draw one map; latent numbers of two maps have correlation 1/2 when both are given the same `common` ones."""
    rng = signs.rng
    own = [signs.draw() for _ in range(5)]
    spread, east, north, miss, ghost = own if common is None else np.sqrt(0.5) * (np.array(own) + np.array(common))
    scale_m = world.sigma_m * np.exp(0.5 * spread)
    offset_m = world.common_offset_m * rng.standard_normal(2)
    sq_m2 = (scale_m * east + offset_m[0]) ** 2 + (scale_m * north + offset_m[1]) ** 2
    found = miss < stats.norm.isf(world.miss_rate)
    tp = found & (sq_m2 < GATE_M**2)
    fp = [found & ~tp, ghost > stats.norm.isf(world.ghost_rate)]
    parts = [(tp, "TP"), (~tp, "FN"), *((f, "FP") for f in fp)]
    return RoadOutcomes(
        np.concatenate([signs.station_m[kept] for kept, _ in parts]),
        np.concatenate([np.full(np.count_nonzero(kept), name) for kept, name in parts]),
        np.concatenate(
            [sq_m2[kept] if name == "TP" else np.full(np.count_nonzero(kept), np.nan) for kept, name in parts]
        ),
        world.length_m,
    )


@cache
def truth(world: World) -> dict[str, float]:
    """Return the scores of an endless road; a common offset is drawn anew along it, as it is from map to map."""
    rng = np.random.default_rng(1)
    long = replace(world, n_signs=4000, length_m=world.length_m * 4000 / world.n_signs, shared=0.0)
    sums = sum(map_of(long, Latents(long, rng)).sums().sum(axis=0) for _ in range(500))
    return {name: float(value) for name, value in derive_scores(*sums, GATE_M).items()}


class Tally:
    """Counts of where the truth lay."""

    def __init__(self) -> None:
        self.below = self.above = self.none = self.warned = 0
        self.widths: list[float] = []

    def add(self, interval: Interval, true: float) -> None:
        """Count one interval."""
        if interval.low is None or interval.high is None:
            self.none += 1
            return
        # counts are whole: an end may equal the truth up to rounding
        self.below += true < interval.low - 1e-12
        self.above += true > interval.high + 1e-12
        self.warned += interval.note not in {"", COMMON_OFFSET}
        self.widths.append(interval.high - interval.low)

    @property
    def coverage(self) -> float:
        """The share of the intervals that held the truth."""
        return 1 - (self.below + self.above) / max(len(self.widths), 1)

    def row(self) -> str:
        """Return the cells of a row of the table."""
        n = len(self.widths)
        if not n:
            return f"none given | | | | | {self.none} |"
        share = f"{self.coverage:.1%} | {self.below / n:.1%} | {self.above / n:.1%}"
        return f"{share} | {np.median(self.widths):.3f} | {self.warned / n:.0%} | {self.none} |"


def road_coverage(world: World, repetitions: int, *, seed: int = 0, n_draws: int = 999) -> dict[str, Tally]:
    rng, tallies = np.random.default_rng(seed), {name: Tally() for name in ROAD_SCORES}
    for _ in range(repetitions):
        for name, interval in road_intervals(map_of(world, Latents(world, rng)), n_draws=n_draws).items():
            tallies[name].add(interval, truth(world)[name])
    return tallies


def pair_coverage(a: World, b: World, repetitions: int, *, seed: int = 0) -> dict[str, tuple[Tally, float]]:
    """Return coverage, and the share of repetitions in which the test calls one of the maps better."""
    rng, tallies, called = np.random.default_rng(seed), {name: Tally() for name in SCORES}, dict.fromkeys(SCORES, 0)
    for _ in range(repetitions):
        signs = Latents(a, rng)
        common = [signs.draw() for _ in range(5)]
        maps = map_of(a, signs, common), map_of(b, signs, common)
        for name in SCORES:
            comparison = compare_on_road(*maps, score=name)
            tallies[name].add(comparison.interval, truth(a)[name] - truth(b)[name])
            called[name] += comparison.verdict != "no difference shown"
    return {name: (tallies[name], called[name] / repetitions) for name in SCORES}


def run_coverage(fleet: Fleet, n_runs: int, method: Method, repetitions: int, *, seed: int = 0) -> Tally:
    rng, tally = np.random.default_rng(seed), Tally()
    for _ in range(repetitions):
        tally.add(replicate_interval(fleet.at(rng.random(n_runs)), method=method, n_draws=999), fleet.truth(method))
    return tally


def paired_run_coverage(n_runs: int, repetitions: int, *, seed: int = 0) -> Tally:
    """Fleets of 20 against fleets of 5 whose runs share half of what makes them good or bad."""
    rng, tally = np.random.default_rng(seed), Tally()
    few, many = FLEETS["5 vehicles"], FLEETS["20 vehicles"]
    for _ in range(repetitions):
        shared, own_a, own_b = rng.standard_normal((3, n_runs)) * np.sqrt(0.5)
        scores = many.at(stats.norm.cdf(shared + own_a)), few.at(stats.norm.cdf(shared + own_b))
        comparison = compare_replicates(*scores, score="gospa_m")
        tally.add(comparison.interval, many.truth("t") - few.truth("t"))
    return tally


HEAD = "coverage | truth below | truth above | median width | warned | none |"
RULE = "---|---|---|---|---|---|"


def print_rows(title: str, first: str, rows: Iterable[tuple[str, str]]) -> None:
    print(f"\n### {title}\n\n| {first} | {HEAD}\n|{'---|' * (first.count('|') + 1)}{RULE}")
    for label, row in rows:
        print(f"| {label} | {row}", flush=True)


def print_fleets(n_runs: int) -> None:
    """Simulate the fleets anew, seeds 0 to n_runs - 1, and print the quantiles of `FLEETS`."""
    raw = Path(__file__).parents[1] / "data" / "raw"
    signs, drive = gf.read_signs(raw / "helsinki.osm.pbf"), gf.read_drive(raw / "helsinki_derived.pos")
    scores: dict[int, list[float]] = {5: [], 20: []}
    for seed in range(n_runs):
        run = gf.simulate(signs, drive, scenario="paper", n_vehicles=20, seed=seed)
        vehicles = sorted(set(run.detections["vehicle_id"]))
        for n_vehicles, found in scores.items():
            seen = run.detections[run.detections["vehicle_id"].isin(vehicles[:n_vehicles])]
            gospa_m = gf.score_map(gf.aggregate(seen.reset_index(drop=True)), run.reference).gospa_m
            found.append(np.nan if gospa_m is None else gospa_m)
    for n_vehicles, found in scores.items():
        print(n_vehicles, np.isnan(found).sum(), np.round(np.nanquantile(found, PROBABILITIES), 3).tolist())


def main() -> None:
    if sys.argv[1:2] == ["fleets"]:
        print_fleets(int(sys.argv[2]) if len(sys.argv) > 2 else 400)  # noqa: PLR2004 (the second argument)
        return
    repetitions = int(sys.argv[1]) if len(sys.argv) > 1 else 2000
    begin = time.perf_counter()
    print(f"{repetitions} repetitions a row")
    for title, worlds in (("Single maps", ROADS), ("Single maps where the note warns", WARNED_ROADS)):
        rows = (
            (f"{name} | {score}", tally.row())
            for name, world in worlds.items()
            for score, tally in road_coverage(world, repetitions).items()
            if score in SCORES
        )
        print_rows(title, "road | score", rows)
    pairs = {
        "33 signs, equal maps": (ROADS["33 signs, stretches of 100 m, 0.3 shared"],) * 2,
        "33 signs, B better": (
            ROADS["33 signs, stretches of 100 m, 0.3 shared"],
            replace(URBAN, shared=0.3, **BETTER_MAP),
        ),
        "500 signs, equal maps": (ROADS["500 signs, stretches of 100 m, 0.3 shared"],) * 2,
        "500 signs, B better": (
            ROADS["500 signs, stretches of 100 m, 0.3 shared"],
            replace(CITY, shared=0.3, **BETTER_MAP),
        ),
    }
    rows = (
        (f"{name} | {score} | {called:.0%}", tally.row())
        for name, (a, b) in pairs.items()
        for score, (tally, called) in pair_coverage(a, b, repetitions).items()
    )
    print_rows("A against B on one road", "maps | score | called different", rows)
    rows = (
        (f"{name} | {n} | {method}", run_coverage(fleet, n, method, repetitions).row())
        for name, fleet in FLEETS.items()
        for n in (5, 10, 20)
        for method in get_args(Method)
    )
    print_rows("GOSPA_M over runs", "fleet | runs | method", rows)
    rows = ((f"20 vehicles minus 5 | {n}", paired_run_coverage(n, repetitions).row()) for n in (5, 10, 20))
    print_rows("Paired runs", "fleets | runs", rows)
    print(f"\n{time.perf_counter() - begin:.0f} s")


if __name__ == "__main__":
    main()
