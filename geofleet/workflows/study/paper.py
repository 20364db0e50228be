"""What the paper printed: its Table 2 and Figures 3 to 5."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import cache
from importlib import resources


@dataclass(frozen=True, slots=True)
class PaperPoint:
    """One number of the paper: a mean over runs, with its standard deviation where the paper gives one."""

    source: str
    method: str
    n_vehicles: int
    score: str
    mean: float
    sd: float | None


@cache
def paper_points() -> tuple[PaperPoint, ...]:
    """Return every number, in the order of the paper."""
    text = resources.files("geofleet.scenarios").joinpath("paper_results.csv").read_text(encoding="utf-8")
    return tuple(
        PaperPoint(
            row["source"],
            row["method"],
            int(row["n_vehicles"]),
            row["score"],
            float(row["mean"]),
            float(row["sd"]) if row["sd"] else None,
        )
        for row in csv.DictReader(text.splitlines())
    )


def paper_table() -> dict[str, dict[str, float]]:
    """Return the rows of Table 2: method to score to value, in the order of the table."""
    rows: dict[str, dict[str, float]] = {}
    for point in paper_points():
        if point.source == "table-2":
            rows.setdefault(point.method, {})[point.score] = point.mean
    return rows


def paper_curve(score: str) -> tuple[PaperPoint, ...]:
    """Return the points of a score in Figures 3 to 5, by fleet size; none for a score that the paper does not draw."""
    return tuple(p for p in paper_points() if p.source.startswith("figure") and p.score == score)
