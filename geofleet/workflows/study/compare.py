"""Compare methods on the same fleets: the paper's Table 2, and any other list of methods, sizes and worlds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from geofleet.formats.palette import BLACK, SERIES
from geofleet.formats.study_figures import NAMES, draw_curves, draw_paper, figure_file
from geofleet.workflows.study.methods import CORRECTED, JOINT, PEAKS, TABLE_2, default_methods
from geofleet.workflows.study.paper import paper_curve, paper_table
from geofleet.workflows.study.results import GROUP, find, write_study
from geofleet.workflows.study.units import run_study

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes

    from geofleet.workflows.study.worlds import Study

    Rows = Sequence[Mapping[str, Any]]

DEFAULT_METHODS = default_methods(*TABLE_2, PEAKS, CORRECTED, JOINT)
DEFAULT_SIZES = (50,)
SHOWN = ("precision", "recall", "f1", "gospa_m")


@dataclass(frozen=True, slots=True)
class CompareResult:
    """What a comparison found.

    Parameters
    ----------
    caption
        What was simulated, in words.
    table
        A row a scenario, place, setting, method and fleet size: means, what the paper printed for it, and
        `gospa_m`'s standard deviation, median and 95 % interval of the mean.
    files
        Tables and figures.
    """

    caption: str
    table: tuple[dict[str, Any], ...]
    files: tuple[Path, ...]


def compare(
    study: Study, out: Path, *, n_workers: int = 1, progress: Callable[[int, int], None] | None = None
) -> CompareResult:
    """Run a comparison and write its tables and figures below `out`.

    Raises
    ------
    InputError, ConfigError
        As `run_study`.
    """
    rows = run_study(study, out, n_workers=n_workers, progress=progress)
    caption = describe(study)

    def draw(folder: Path, summary: list[dict[str, Any]]) -> None:
        draw_comparison(folder, summary, caption)

    keys = {world.setting.partition("=")[0] for world in study.worlds}
    name = f"sweep-{keys.pop()}" if len(study.worlds) > 1 and keys != {""} and len(keys) == 1 else "compare"
    summary, files = write_study(name, study, rows, out, draw=draw)
    return CompareResult(caption, tuple(table_rows(summary)), files)


def describe(study: Study) -> str:
    """Say what a study simulates."""
    worlds = study.worlds
    scenarios = ", ".join(dict.fromkeys(world.config.scenario for world in worlds))
    places = ", ".join(dict.fromkeys(world.place for world in worlds))
    trackers = ", ".join(dict.fromkeys(world.config.tracking.tracker for world in worlds))
    sizes = f"{study.sizes[0]}" if len(study.sizes) == 1 else f"{min(study.sizes)} to {max(study.sizes)}"
    seen = ", signs in view" if study.in_view else ""
    return (
        f"{sizes} simulated vehicles, {study.n_replicates} fleets, seed {study.seed}; scenario {scenarios}, tracker "
        f"{trackers}; {places}{seen}"
    )


def table_rows(summary: Rows) -> list[dict[str, Any]]:
    """Return a row a group, as people read it."""
    paper = paper_table()
    groups = dict.fromkeys(tuple(row[name] for name in GROUP) for row in summary)
    table = []
    for labels in groups:
        named = dict(zip(GROUP, labels, strict=True))
        scores = {row["score"]: row for row in find(summary, **named)}
        row = named | {name: scores["f1"][name] for name in ("tracker", "upload")}
        row |= {"n": scores["tp"]["n"], "n_null": scores["gospa_m"]["n_null"]}
        row |= {name: scores[name]["mean"] for name in ("tp", "fp", "fn", *SHOWN)}
        row |= {f"gospa_m_{name}": scores["gospa_m"][name] for name in ("sd", "median", "mean_low", "mean_high")}
        is_paper = named["n_vehicles"] == 50  # noqa: PLR2004 (the fleet of Table 2)
        printed = paper.get(named["method"], {}) if is_paper else {}
        table.append(row | {f"paper_{name}": printed.get(name) for name in SHOWN})
    return table


def draw_comparison(folder: Path, summary: Rows, caption: str) -> None:
    """Draw what a comparison varies: methods alone, fleet sizes, a setting, or worlds."""
    largest = max(row["n_vehicles"] for row in summary)
    for (scenario, place), part in _worlds(summary).items():
        stem = "" if len(_worlds(summary)) == 1 else f"-{scenario}-{place}"
        named = f"{caption}; here {scenario}, {place}" if stem else caption
        if len({row["setting"] for row in part}) > 1:
            _draw_sweep(folder / f"sweep{stem}", find(part, n_vehicles=largest), named)
        elif len({row["n_vehicles"] for row in part}) > 1:
            _draw_sizes(folder / f"sizes{stem}", part, named)
        else:
            _draw_methods(folder / f"methods{stem}", part, named)


def _worlds(summary: Rows) -> dict[tuple[str, str], list[Mapping[str, Any]]]:
    worlds: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for row in summary:
        worlds.setdefault((row["scenario"], row["place"]), []).append(row)
    return worlds


def _draw_sizes(path: Path, summary: Rows, caption: str) -> None:
    with figure_file(path, caption=f"{caption}\n{BARS}", size=(7.2, 6.6)) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True)
        for axes, score in ((upper, "f1"), (lower, "gospa_m")):
            draw_curves(axes, summary, score=score)
            draw_paper(axes, [(p.n_vehicles, p.mean, p.sd) for p in paper_curve(score)], label="the paper, DBSCAN")
        lower.set(xlabel="vehicles", ylim=(0, None))
        upper.legend()


BARS = "Means over fleets; bars: standard deviation; bands: 95 % interval of the mean."


def _draw_sweep(path: Path, summary: Rows, caption: str) -> None:
    """Draw scores over the values of a setting, beside what the paper printed for its own."""
    key = summary[0]["setting"].partition("=")[0]
    values = [{**row, "value": float(row["setting"].partition("=")[2])} for row in summary]
    with figure_file(path, caption=f"{caption}\n{BARS} Dotted: the paper's Table 2.", size=(7.2, 6.6)) as figure:
        upper, lower = figure.subplots(2, 1, sharex=True)
        for axes, score in ((upper, "f1"), (lower, "gospa_m")):
            draw_curves(axes, values, score=score, across="value")
            for method, colour in zip(dict.fromkeys(row["method"] for row in values), SERIES, strict=False):
                if method in paper_table():
                    axes.axhline(paper_table()[method][score], color=colour, linestyle=":", linewidth=1)
        lower.set(xlabel=key, ylim=(0, None))
        upper.legend()


def _draw_methods(path: Path, summary: Rows, caption: str) -> None:
    """Draw the methods one below the other, as Table 2 lists them."""
    methods = list(dict.fromkeys(row["method"] for row in summary))
    spread = "Means over fleets; bars: standard deviation."
    with figure_file(path, caption=f"{caption}\n{spread}", size=(7.6, 1.4 + 0.34 * len(methods))) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for axes, score in ((left, "f1"), (right, "gospa_m")):
            _draw_dots(axes, find(summary, score=score), methods, score)
        left.set_yticks(range(len(methods)), methods)
        left.invert_yaxis()
        right.set_xlim(0, None)
        handles, names = left.get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper right", ncols=2)


def _draw_dots(axes: Axes, rows: Rows, methods: list[str], score: str) -> None:
    ours = [row for row in rows if row["mean"] is not None]
    where = [methods.index(row["method"]) for row in ours]
    mean = [row["mean"] for row in ours]
    axes.errorbar(
        mean, where, xerr=[row["sd"] or 0.0 for row in ours], fmt="o", color=SERIES[0], capsize=2, label="geofleet"
    )
    printed = [(methods.index(name), scores[score]) for name, scores in paper_table().items() if name in methods]
    if printed and rows[0]["n_vehicles"] == 50:  # noqa: PLR2004 (the fleet of Table 2)
        place, value = zip(*printed, strict=True)
        axes.plot(value, place, "x", color=BLACK, label="the paper")
    axes.set_xlabel(NAMES[score])
