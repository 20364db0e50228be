"""How map quality follows the size of the fleet: the paper's Figures 3 to 5, with its own points beside."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from geofleet.formats.palette import SERIES
from geofleet.formats.study_figures import NAMES, draw_curves, draw_paper, figure_file
from geofleet.workflows.study.compare import BARS, describe
from geofleet.workflows.study.methods import CORRECTED, JOINT, PEAKS, default_methods
from geofleet.workflows.study.paper import paper_curve
from geofleet.workflows.study.results import find, write_study
from geofleet.workflows.study.units import run_study

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from geofleet.workflows.study.worlds import Study

    Rows = Sequence[Mapping[str, Any]]

DEFAULT_SIZES = tuple(range(5, 51, 5))
PAPER_METHOD = "dbscan-first"
DEFAULT_METHODS = default_methods(PAPER_METHOD, PEAKS, CORRECTED, JOINT)


@dataclass(frozen=True, slots=True)
class FleetSizeResult:
    """What a study of fleet sizes found.

    Parameters
    ----------
    caption
        What was simulated, in words.
    table
        A row a method and fleet size: means, standard deviation, median and 95 % interval of GOSPA_M, the paper's
        numbers, and `z`, the distance of the mean GOSPA_M to the paper's in the paper's standard deviations.
    n_within, n_compared
        Fleet sizes at which DBSCAN semantic-first lies within the paper's standard deviation, of those it printed.
    files
        Tables and figures.
    """

    caption: str
    table: tuple[dict[str, Any], ...]
    n_within: int
    n_compared: int
    files: tuple[Path, ...]


def fleet_size(
    study: Study, out: Path, *, n_workers: int = 1, progress: Callable[[int, int], None] | None = None
) -> FleetSizeResult:
    """Run a study of fleet sizes in one world and write its tables and figures below `out`.

    Raises
    ------
    InputError, ConfigError
        As `run_study`.
    """
    rows = run_study(study, out, n_workers=n_workers, progress=progress)
    caption = describe(study)
    summary, files = write_study(
        "fleet-size", study, rows, out, draw=lambda folder, summary: draw_figures(folder, summary, caption)
    )
    table = table_rows(summary)
    compared = [row for row in table if row["z"] is not None]
    return FleetSizeResult(caption, tuple(table), sum(abs(row["z"]) <= 1 for row in compared), len(compared), files)


def table_rows(summary: Rows) -> list[dict[str, Any]]:
    """Return a row a method and fleet size, with the paper's numbers beside its method."""
    paper = {(p.n_vehicles, p.score): p for score in ("f1", "tp", "fp", "fn", "gospa_m") for p in paper_curve(score)}
    table = []
    for row in find(summary, score="gospa_m"):
        same = {name: row[name] for name in ("scenario", "place", "setting", "method", "n_vehicles")}
        means = {name: find(summary, score=name, **same)[0]["mean"] for name in ("f1", "tp", "fp", "fn")}
        point = paper.get((row["n_vehicles"], "gospa_m")) if row["method"] == PAPER_METHOD else None
        z = (row["mean"] - point.mean) / point.sd if point and point.sd and row["mean"] is not None else None
        table.append(
            {name: row[name] for name in ("method", "n_vehicles", "tracker", "upload", "n", "n_null")}
            | means
            | {f"gospa_m_{name}": row[name] for name in ("mean", "sd", "mean_low", "mean_high", "median")}
            | {
                "paper_f1": paper[row["n_vehicles"], "f1"].mean if point else None,
                "paper_gospa_m": point.mean if point else None,
                "paper_sd": point.sd if point else None,
                "z": z,
            }
        )
    return table


def draw_figures(folder: Path, summary: Rows, caption: str) -> None:
    """Draw F1, the counts of the paper's method, and GOSPA_M over the size of the fleet."""
    for number, score in ((3, "f1"), (5, "gospa_m")):
        with figure_file(folder / f"figure-{number}-{score}", caption=f"{caption}\n{BARS}") as figure:
            axes = figure.subplots()
            draw_curves(axes, summary, score=score)
            draw_paper(axes, [(p.n_vehicles, p.mean, p.sd) for p in paper_curve(score)], label="the paper, DBSCAN")
            axes.set(xlabel="vehicles", **({"ylim": (0, None)} if score == "gospa_m" else {}))
            axes.legend()
    own = find(summary, method=PAPER_METHOD) or find(summary, method=summary[0]["method"])
    counts = [{**row, "of": NAMES[row["score"]]} for row in own if row["score"] in {"tp", "fp", "fn"}]
    with figure_file(folder / "figure-4-counts", caption=f"{caption}\n{BARS} Crosses: the paper.") as figure:
        axes = figure.subplots()
        draw_curves(axes, counts, score=None, by="of")
        for score, colour in zip(("tp", "fp", "fn"), SERIES, strict=False):
            points = [(p.n_vehicles, p.mean, p.sd) for p in paper_curve(score)]
            draw_paper(axes, points, label="", colour=colour)
        axes.set(xlabel="vehicles", ylabel=f"signs, {own[0]['method']}", ylim=(0, None))
        axes.legend()
