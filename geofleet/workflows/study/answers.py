"""What a plan says: its target, and the passes that fleets needed as tables and sentences."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.algorithms.planning import PassesNeeded, sum_up
from geofleet.algorithms.uncertainty import BETTER
from geofleet.errors import ConfigError
from geofleet.workflows.study.limits import PARTS, Floor

if TYPE_CHECKING:
    from collections.abc import Sequence

SCORES = ("gospa_m", "f1", "precision", "recall", "rmse_m")
WORTH_NAMING = 0.05  # of GOSPA_M²
_TARGET = re.compile(r"\s*([a-z_0-9]+)\s*(?:=|<=|>=|<|>)\s*(\d*\.?\d+)\s*")


@dataclass(frozen=True, slots=True)
class Target:
    """A score to be reached: at most `value` where lower is better, at least where higher is."""

    score: str
    value: float

    def is_met(self, score: float | None) -> bool:
        """Tell whether a score meets it; no score does not."""
        if score is None:
            return False
        return score <= self.value if BETTER[self.score] == "lower" else score >= self.value

    def __str__(self) -> str:
        return f"{self.score} {'<=' if BETTER[self.score] == 'lower' else '>='} {self.value:g}"


def parse_target(text: str) -> Target:
    """Read `gospa_m=0.5`.

    Raises
    ------
    ConfigError
        It is not `score=number`, or the score is unknown or out of range.
    """
    found = _TARGET.fullmatch(text)
    if not found or found[1] not in SCORES:
        todo = f"Example: gospa_m=0.5; scores are {', '.join(SCORES)}."
        raise ConfigError(f"{text!r} is not a target.", where="--target", todo=todo)
    target = Target(found[1], float(found[2]))
    if target.value <= 0 or (BETTER[target.score] == "higher" and target.value > 1):
        raise ConfigError(f"{target} is no goal.", where="--target", todo="Give a score that a map can have.")
    return target


def total_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the row over all tiles."""
    return next(row for row in rows if row["tile"] == "all")


def score_rows(fleets: Sequence[dict[str, Any]], target: Target) -> list[dict[str, Any]]:
    """Return a row a fleet size that some fleet tried; sizes that few tried are those near what these needed."""
    scores: dict[int, list[float | None]] = {}
    for fleet in fleets:
        for seen in fleet["seen"]:
            scores.setdefault(seen["n_vehicles"], []).append(total_of(seen["rows"])[target.score])
    rows = []
    for size, values in sorted(scores.items()):
        there = [value for value in values if value is not None]
        spread = {"median": float(np.median(there)), "least": min(there), "greatest": max(there)} if there else {}
        met = sum(map(target.is_met, values))
        rows.append(
            {
                "n_vehicles": size,
                "n_fleets": len(values),
                "n_met": met,
                "score": target.score,
                **dict.fromkeys(("median", "least", "greatest")),
                **spread,
            }
        )
    return rows


def part_rows(fleets: Sequence[dict[str, Any]], tile: str = "all") -> list[dict[str, Any]]:
    """Return a row a part of GOSPA_M²: its mean over fleets, m² a matched sign, and its share."""
    totals = [row for fleet in fleets for row in fleet["parts"] if row["tile"] == tile]
    tp = sum(row["tp"] for row in totals)
    # in one tile what is left of the errors beside the common offset may lie below zero
    sums = {name: max(sum(row[name] for row in totals), 0.0) for name in PARTS}
    whole = sum(sums.values())
    return [
        {"part": name, "what": PARTS[name], "m2": value / tp if tp else None, "share": value / whole if whole else 0.0}
        for name, value in sums.items()
    ]


def tile_rows(fleets: Sequence[dict[str, Any]], target: Target, level: float) -> list[dict[str, Any]]:
    """Return a row a tile that has signs."""
    n_signs = {row["tile"]: row["n_signs"] for fleet in fleets for row in fleet["parts"] if row["n_signs"]}
    rows = []
    for tile in sorted(set(n_signs) - {"all"}):
        needed = sum_up([_needed_in_tile(fleet["seen"], tile, target) for fleet in fleets], level=level)
        parts = max(part_rows(fleets, tile), key=lambda part: part["share"])
        row = {"tile": tile, "n_signs": n_signs[tile], "passes_at_most": needed.typical, "safe_at_most": needed.safe}
        row |= {"n_reached": needed.n_reached, "n_fleets": needed.n_fleets}
        rows.append(row | {"main_limit": parts["what"] if parts["share"] else "", "limit_share": parts["share"]})
    return rows


def _needed_in_tile(seen: list[dict[str, Any]], tile: str, target: Target) -> int | None:
    """Return the least size tried from which on a tile met the target at every size tried."""
    needed = None
    for one in reversed(seen):
        rows = [row for row in one["rows"] if row["tile"] == tile]
        if not rows or not target.is_met(rows[0][target.score]):
            return needed
        needed = one["n_vehicles"]
    return needed


def answer_in_words(
    result: PassesNeeded, target: Target, floor: Floor, parts: list[dict[str, Any]], scores: list[dict[str, Any]]
) -> list[str]:
    """Say in sentences how many passes are needed and what limits the map."""
    tried = [row for row in scores if row["n_fleets"] == result.n_fleets]
    lines = [_typical(result, target, scores[-1]["n_vehicles"])]
    wanted = math.ceil(result.level * result.n_fleets)
    if result.safe is not None:
        lines.append(f"{wanted} of the {result.n_fleets} fleets had met it by {result.safe} passes.")
    elif result.n_reached:
        lines.append(f"Only {result.n_reached} of the {result.n_fleets} fleets met it, not {result.level:.0%} of them.")
    if result.typical is None and len(tried) > 1 and tried[-1]["median"] is not None:
        lines.append(
            f"The median {target.score} is {tried[-1]['median']:.3f} with {tried[-1]['n_vehicles']} passes, after "
            f"{_shown(tried[-2]['median'])} with {tried[-2]['n_vehicles']}."
        )
    lines += _beyond_reach(floor, target)
    left = sorted((part for part in parts if part["share"] >= WORTH_NAMING), key=lambda part: -part["share"])
    if left:
        where = "there" if result.typical is None else "then"
        lines.append(f"What GOSPA_M² is made of {where}:")
        lines += [f"  {part['share']:4.0%}  {part['what']}" for part in left]
    return lines


def _shown(score: float | None) -> str:
    return "undefined" if score is None else f"{score:.3f}"


def _typical(result: PassesNeeded, target: Target, largest: int) -> str:
    if result.n_reached == 0:
        return f"No fleet of up to {largest} passes reaches {target}."
    if result.typical is None:
        return f"Most fleets do not reach {target} with up to {largest} passes."
    high = "more than were tried" if result.high is None else str(result.high)
    sure = (
        f"{result.level:.0%} interval {result.low} to {high}"
        if result.has_interval
        else "too few fleets for an interval"
    )
    plural = "pass" if result.typical == 1 else "passes"
    return f"{result.typical} {plural} reach {target}: the median of {result.n_fleets} simulated fleets, {sure}."


def _beyond_reach(floor: Floor, target: Target) -> list[str]:
    """Say what no number of passes can find."""
    lost = []
    if floor.n_never_in_view:
        lost.append(f"no pass has {floor.n_never_in_view} in view")
    if floor.n_merged:
        lost.append(f"clustering may merge {floor.n_merged} with a neighbour of the same class closer than eps_m")
    if not lost:
        return []
    out_of_reach = "" if target.is_met(floor.score) else ": the target is out of reach whatever the number of passes"
    have = f"Of {floor.n_signs} signs, {' and '.join(lost)}"
    return [
        f"{have}; without them a map that is perfect otherwise has {target.score} {_shown(floor.score)}{out_of_reach}."
    ]
