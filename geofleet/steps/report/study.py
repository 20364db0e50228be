"""Scores over fleet sizes: what a study left in the run's folder, or the run itself when it has several sizes."""

from __future__ import annotations

import csv
from collections import defaultdict
from dataclasses import dataclass
from importlib import resources
from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.algorithms.uncertainty import replicate_interval

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.steps.report.contents import Contents

    Floats = NDArray[np.float64]

SCORE_LABELS = {"gospa_m": "GOSPA_M (m)", "f1": "F1"}
PAPER = "the paper, DBSCAN"
_LEVEL = 0.95
# Where a study may lie, seen from the folder of a run.
_SUMMARIES = ("study/fleet-size/summary.csv", "fleet-size/summary.csv")
_WORLD = ("scenario", "place", "setting")


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """A score over fleet sizes: the mean over runs, its 95 % interval (the mean itself where there is none), and sd."""

    name: str
    score: str
    n_vehicles: Floats
    mean: Floats
    low: Floats
    high: Floats
    sd: Floats
    n_runs: int


@dataclass(frozen=True, slots=True, eq=False)
class Study:
    """Curves of scores over fleet sizes.

    Parameters
    ----------
    curves
        A curve a method and score.
    paper
        Score to the paper's own points, (n, 3): vehicles, mean and standard deviation (NaN where it prints none).
    source
        What the curves come from, in words.
    inputs
        Files read.
    """

    curves: tuple[Curve, ...]
    paper: Mapping[str, Floats]
    source: str
    inputs: tuple[Path, ...] = ()

    @property
    def scores(self) -> tuple[str, ...]:
        """Scores that have a curve."""
        return tuple(score for score in SCORE_LABELS if any(curve.score == score for curve in self.curves))


def read_study(run_dir: Path, contents: Contents) -> Study:
    """Read the curves of a study below a run, else those of the run's own fleet sizes; either may be none."""
    path = next((run_dir / name for name in _SUMMARIES if (run_dir / name).is_file()), None)
    if path is None:
        return Study(tuple(_of_totals(contents.totals)), {}, "the runs of this evaluation")
    with path.open(encoding="utf-8", newline="") as stream:
        curves = tuple(_of_summary(list(csv.DictReader(stream))))
    return Study(curves, _paper_points(), f"the study in {path.parent.relative_to(run_dir).as_posix()}", (path,))


def _of_summary(rows: list[dict[str, str]]) -> Iterable[Curve]:
    """Return the curves of a study's summary; of several worlds, each is named."""
    told_apart = [name for name in _WORLD if len({row[name] for row in rows}) > 1]
    groups: dict[tuple[str, str], list[dict[str, str]]] = defaultdict(list)
    for row in rows:
        if row["score"] in SCORE_LABELS and row["mean"]:
            groups[row["score"], " ".join(filter(None, (row["method"], *(row[n] for n in told_apart))))].append(row)
    for (score, name), group in groups.items():
        group.sort(key=lambda row: int(row["n_vehicles"]))
        points = [
            _point(int(row["n_vehicles"]), *(float(row[name]) if row[name] else None for name in _SUMMED))
            for row in group
        ]
        yield _curve(name, score, points, max(int(row["n"]) for row in group))


_SUMMED = ("mean", "mean_low", "mean_high", "sd")


def _of_totals(totals: Iterable[Mapping[str, Any]]) -> Iterable[Curve]:
    """Return a curve a method and score of runs with several fleet sizes; runs without the score are left out."""
    values: dict[tuple[str, str], dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for total in totals:
        for score in SCORE_LABELS:
            if total[score] is not None:
                values[score, total["method"]][total["n_vehicles"]].append(total[score])
    for (score, method), by_size in values.items():
        points = []
        for size, runs in sorted(by_size.items()):
            interval = replicate_interval(np.asarray(runs), score=score, method="t", level=_LEVEL)
            sd = float(np.std(runs, ddof=1)) if len(runs) > 1 else None
            points.append(_point(size, float(np.mean(runs)), interval.low, interval.high, sd))
        if len(points) > 1:
            yield _curve(method, score, points, max(map(len, by_size.values())))


def _point(size: int, mean: float | None, low: float | None, high: float | None, sd: float | None) -> list[Any]:
    return [size, mean, mean if low is None else low, mean if high is None else high, sd or 0.0]


def _curve(name: str, score: str, points: list[list[Any]], n_runs: int) -> Curve:
    n_vehicles, mean, low, high, sd = np.asarray(points, np.float64).T
    return Curve(name, score, n_vehicles, mean, low, high, sd, n_runs)


def _paper_points() -> dict[str, Floats]:
    """Return what the paper's Figures 3 to 5 print, score by score."""
    text = resources.files("geofleet.scenarios").joinpath("paper_results.csv").read_text(encoding="utf-8")
    rows = [row for row in csv.DictReader(text.splitlines()) if row["source"].startswith("figure")]
    return {
        score: np.asarray(
            [
                (float(row["n_vehicles"]), float(row["mean"]), float(row["sd"] or "nan"))
                for row in rows
                if row["score"] == score
            ]
        )
        for score in SCORE_LABELS
    }
