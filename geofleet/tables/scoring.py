"""The `scores` table: derived from matches, summed up over replicates, and held to requirements."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from geofleet.algorithms.metrics import derive_scores, null_reason
from geofleet.algorithms.tiling import quadkey_bounds
from geofleet.errors import ConfigError
from geofleet.tables.database import connect, run
from geofleet.tables.schemas import SCORES
from geofleet.tables.store import build_table

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from geofleet.algorithms.metrics import MapScore

_REQUIREMENT = re.compile(r"^\s*([a-z_0-9]+)\s*(<=|>=|<|>|==)\s*([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*$")
_COMPARE = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal, "==": np.equal}
SCORE_NAMES = tuple(c.name for c in SCORES.all_columns if c.name in ("tp", "fp", "fn") or pa.types.is_floating(c.type))
SUMMARISED = tuple(name for name in SCORE_NAMES if name != "gate_m")


@dataclass(frozen=True, slots=True)
class Requirement:
    """A bound on a score, e.g. `gospa_m < 0.8`."""

    text: str
    score: str
    operator: str
    bound: float


def score_matches(matches: pa.Table, *, gate_m: float, match_on: str) -> pa.Table:
    """Return the `scores` table of a `matches` table: per tile, per concept, both, and in total."""
    connection = connect(spatial=False)
    connection.register("matches", matches)
    counts = run(connection, "evaluate/counts").to_arrow_table()
    connection.close()
    columns: dict[str, Any] = {name: counts[name] for name in counts.column_names}
    columns |= _derive_columns(columns, gate_m=gate_m)
    return build_table(
        SCORES,
        columns | {"gate_m": gate_m, "match_on": match_on},
        geometry=_tile_polygons(counts["tile"].to_pylist()),
    )


def score_row(score: MapScore) -> dict[str, Any]:
    """Return a score as a row: the columns of `scores` that are neither labels nor geometry."""
    counts = {"tp": score.tp, "fp": score.fp, "fn": score.fn, "sum_sq_error_m2": score.sum_sq_error_m2}
    names = ("precision", "recall", "f1", "mse_m2", "rmse_m", "gospa", "gospa_m", "cardinality_m2", "null_reason")
    derived = {name: getattr(score, name) for name in names}
    return {"gate_m": score.gate_m, "match_on": score.match_on, **counts, **derived}


def summarise_scores(totals: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Sum up the totals of several runs: a row a method, fleet size and score.

    Parameters
    ----------
    totals
        Rows of `scores` over all tiles and concepts, one a run, method and fleet size.

    Returns
    -------
    Rows with `method`, `n_vehicles`, `score`, `mean`, `sd` (n - 1 in the denominator, so None for one value), `n`
    (the runs that have the score) and `n_null` (those that do not). A mean leaves out nulls: where `n_null` is not 0
    it is the mean of the better runs, and says less than the null count does. Intervals are not given here: they
    need an estimand.
    """
    groups: dict[tuple[str, int], list[Mapping[str, Any]]] = {}
    for total in totals:
        groups.setdefault((total["method"], total["n_vehicles"]), []).append(total)
    rows = []
    for (method, n_vehicles), runs in sorted(groups.items()):
        for score in SUMMARISED:
            values = [run[score] for run in runs if run[score] is not None]
            rows.append(
                {
                    "method": method,
                    "n_vehicles": n_vehicles,
                    "score": score,
                    "mean": float(np.mean(values)) if values else None,
                    "sd": float(np.std(values, ddof=1)) if len(values) > 1 else None,
                    "n": len(values),
                    "n_null": len(runs) - len(values),
                }
            )
    return rows


def parse_requirements(texts: Sequence[str]) -> list[Requirement]:
    """Read requirements like `gospa_m<0.8`.

    Raises
    ------
    ConfigError
        A text is not `score operator number`, or names no score.
    """
    parsed = []
    for text in texts:
        match = _REQUIREMENT.match(text)
        if not match or match[1] not in SCORE_NAMES:
            raise ConfigError(
                f"{text!r} is not a requirement.",
                where="--require",
                todo=f'Example: "gospa_m<0.8"; scores are {", ".join(SCORE_NAMES)}.',
            )
        parsed.append(Requirement(text.strip(), match[1], match[2], float(match[3])))
    return parsed


def missed_requirements(totals: Sequence[Mapping[str, Any]], requirements: Sequence[Requirement]) -> list[str]:
    """Return a sentence for every requirement that a total misses.

    What could not be scored has not been shown: a null score misses, and so does an evaluation without any sign.
    """
    missed = [] if totals else [f"{need.text} is missed: there was no sign to score." for need in requirements]
    for need in requirements:
        for total in totals:
            value = total[need.score]
            if value is None or not _COMPARE[need.operator](value, need.bound):
                shown = f"null ({total['null_reason']})" if value is None else f"{value:.6g}"
                run_id = f"run {total['run_id']}, " if total["run_id"] else ""
                name = f"{run_id}{total['method']}, {total['n_vehicles']} vehicles"
                missed.append(f"{need.text} is missed by {name}: {shown}.")
    return missed


def _tile_polygons(tiles: Sequence[str]) -> Any:
    """Return the polygon of every tile; None for `all`."""
    import shapely  # noqa: PLC0415  (half a second that only this function needs)

    polygons = np.full(len(tiles), None, dtype=object)
    real = [row for row, tile in enumerate(tiles) if tile != "all"]
    if real:
        bounds = quadkey_bounds([tiles[row] for row in real])
        polygons[real] = shapely.box(*bounds.T)
    return polygons


def _derive_columns(counts: Mapping[str, Any], *, gate_m: float) -> dict[str, Any]:
    """Return the derived columns of `scores` from its columns tp, fp, fn and sum_sq_error_m2."""
    tp, fp, fn, sum_sq = (np.asarray(counts[name]) for name in ("tp", "fp", "fn", "sum_sq_error_m2"))
    # GOSPA_M² of the same counts with every error 0
    cardinality = derive_scores(tp, fp, fn, np.zeros(len(tp)), gate_m)["gospa_m"] ** 2
    reasons = [null_reason(*row) for row in zip(tp.tolist(), fp.tolist(), fn.tolist(), strict=True)]
    return {
        **derive_scores(tp, fp, fn, sum_sq, gate_m),
        "cardinality_m2": cardinality,
        "null_reason": pa.array(reasons, pa.string()),
    }
