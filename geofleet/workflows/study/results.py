"""The results of a study: one row a fleet, and what they sum up to."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.algorithms.uncertainty import Interval, replicate_interval
from geofleet.formats.results import write_csv
from geofleet.tables.manifest import write_manifest
from geofleet.tables.schemas import STUDY_SCORES
from geofleet.tables.store import atomic_path, build_table, write_table

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from geofleet.workflows.study.worlds import Study

    Rows = Sequence[Mapping[str, Any]]

GROUP = ("scenario", "place", "setting", "method", "n_vehicles")
"""What rows of one summary have in common; only the replicate differs."""
LABELS = (*GROUP, "tracker", "upload")
SUMMARISED = ("tp", "fp", "fn", "precision", "recall", "f1", "rmse_m", "gospa_m")
LEVEL = 0.95


def totals(rows: Rows) -> list[Mapping[str, Any]]:
    """Return the rows over all tiles."""
    return [row for row in rows if row["tile"] == "all"]


def summarise(rows: Rows) -> list[dict[str, Any]]:
    """Sum fleets up: a row a scenario, place, setting, method, fleet size and score, in the order of the rows.

    Parameters
    ----------
    rows
        Over all tiles.

    Returns
    -------
    Labels, `score`, `n` fleets that have it and `n_null` that do not (they are left out), `mean`, `sd` (n - 1),
    `median`, and 95 % intervals of the mean (Student's t) and of the median (order statistics, six fleets or more),
    None where there is none; `note` says when not to trust them.
    """
    summary = []
    for labels, group in grouped(rows).items():
        first = group[0]
        for score in SUMMARISED:
            values = np.array([np.nan if row[score] is None else row[score] for row in group], np.float64)
            summary.append(
                dict(zip(GROUP, labels, strict=True))
                | {"tracker": first["tracker"], "upload": first["upload"], "score": score}
                | _summary(values, score)
            )
    return summary


def grouped(rows: Rows) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    """Return the fleets of every scenario, place, setting, method and fleet size."""
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in GROUP), []).append(row)
    return groups


def _summary(values: np.ndarray[tuple[int], np.dtype[np.float64]], score: str) -> dict[str, Any]:
    there = values[~np.isnan(values)]
    mean, median = (_interval(values, score, method) for method in ("t", "median"))
    return {
        "n": int(there.size),
        "n_null": int(values.size - there.size),
        "mean": mean.estimate,
        "sd": float(there.std(ddof=1)) if there.size > 1 else None,
        "mean_low": mean.low,
        "mean_high": mean.high,
        "median": median.estimate,
        "median_low": median.low,
        "median_high": median.high,
        "note": mean.note,
    }


def _interval(values: np.ndarray[tuple[int], np.dtype[np.float64]], score: str, method: Any) -> Interval:
    return replicate_interval(values, score=score, method=method, level=LEVEL)


def write_study(
    name: str,
    study: Study,
    rows: Rows,
    out: Path,
    *,
    draw: Callable[[Path, list[dict[str, Any]]], None],
    more: Mapping[str, Rows] | None = None,
) -> tuple[list[dict[str, Any]], tuple[Path, ...]]:
    """Write rows (Parquet and CSV), their summary and figures into the folder of its name in that of a study.

    Parameters
    ----------
    name
        Of the study.
    rows
        Of `run_study`.
    draw
        Draws figures into a folder from the summary.
    more
        Further tables, by the name of their CSV file.

    Returns
    -------
    The summary, and the files.
    """
    results, summary = out / name, summarise(totals(rows))
    columns = [column.name for column in STUDY_SCORES.all_columns]
    table = build_table(STUDY_SCORES, {column: [row[column] for row in totals(rows)] for column in columns})
    with atomic_path(results) as draft:
        draft.mkdir()
        write_table(STUDY_SCORES, table, draft / "study_scores.parquet")
        write_csv(table.to_pylist(), draft / "study_scores.csv")
        write_csv(summary, draft / "summary.csv")
        for stem, part in (more or {}).items():
            if part:
                write_csv(part, draft / f"{stem}.csv")
        draw(draft, summary)
        names = sorted(path.name for path in draft.iterdir())
    worlds = [
        {"place": world.place, "setting": world.setting, "config_digest": world.config.digest()}
        for world in study.worlds
    ]
    settings = {"worlds": worlds, "methods": [method.label for method in study.methods], "sizes": list(study.sizes)}
    settings |= {"n_replicates": study.n_replicates, "seed": study.seed, "in_view": study.in_view}
    inputs = {path for world in study.worlds for path in (world.signs, world.drive)}
    inputs |= {study.prior} if study.prior else set()
    write_manifest(results, step=f"study {name}", inputs=inputs, settings=settings, counts={"rows": table.num_rows})
    return summary, tuple(results / name for name in names)


def find(summary: Rows, **wanted: Any) -> list[Mapping[str, Any]]:
    """Return the rows of a summary that have these labels."""
    return [row for row in summary if all(row[name] == value for name, value in wanted.items())]
