"""Figures of studies, as SVG and PNG: told apart by colour-blind readers, and by marks and dashes in print."""

from __future__ import annotations

from contextlib import contextmanager
from itertools import cycle
from typing import TYPE_CHECKING, Any

from geofleet.formats.palette import BLACK, SERIES

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    Rows = Sequence[Mapping[str, Any]]

MARKS = ("o", "s", "^", "D", "v", "P", "X", "*")
DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (8, 2)), (0, (3, 3)))
NAMES = {
    "gospa_m": "GOSPA_M (m)",
    "f1": "F1",
    "precision": "precision",
    "recall": "recall",
    "rmse_m": "RMSE of matched signs (m)",
    "tp": "TP",
    "fp": "FP",
    "fn": "FN",
}
_PAPER: dict[str, Any] = {"marker": "x", "markersize": 6, "linestyle": "none", "zorder": 6}
# No random ids and no date in the SVG: the same study gives the same bytes.
_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "geofleet",
    "font.size": 9,
    "savefig.bbox": "tight",
    "axes.grid": True,
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.framealpha": 0.95,
}


@contextmanager
def figure_file(path: Path, *, caption: str, size: tuple[float, float] = (7.0, 4.6)) -> Iterator[Figure]:
    """Yield a figure and write it beside `path`, which has no suffix, as .svg and .png, with a caption below it."""
    import matplotlib as mpl  # noqa: PLC0415  (a second of import that only this function needs)
    from matplotlib.figure import Figure  # noqa: PLC0415

    with mpl.rc_context(_STYLE):
        figure = Figure(figsize=size, layout="constrained")
        yield figure
        figure.supxlabel(caption, fontsize=7, color="#444444", x=0.01, ha="left")
        for suffix in ("svg", "png"):
            metadata = {"Date": None} if suffix == "svg" else {}
            figure.savefig(path.with_name(f"{path.name}.{suffix}"), dpi=160, metadata=metadata)


def draw_curves(
    axes: Axes,
    summary: Rows,
    *,
    score: str | None,
    across: str = "n_vehicles",
    by: str = "method",
    labels: Mapping[str, str] | None = None,
) -> None:
    """Draw a score over something, a line a group: mean with standard deviation, and the 95 % interval as a band.

    Parameters
    ----------
    summary
        Rows of `summarise`.
    across, by
        What is drawn along the x axis, and what tells the lines apart.
    score
        Which score of the rows is drawn; None when they are of one, or told apart by it.
    labels
        What the legend calls the groups.
    """
    names = list(dict.fromkeys(row[by] for row in summary))
    for name, colour, mark, dash in zip(names, cycle(SERIES), cycle(MARKS), cycle(DASHES), strict=False):
        rows = [r for r in summary if r[by] == name and score in {None, r["score"]} and r["mean"] is not None]
        x, mean = [row[across] for row in rows], [row["mean"] for row in rows]
        sd = [row["sd"] or 0.0 for row in rows]
        low = [row["mean"] if row["mean_low"] is None else row["mean_low"] for row in rows]
        high = [row["mean"] if row["mean_high"] is None else row["mean_high"] for row in rows]
        axes.fill_between(x, low, high, color=colour, alpha=0.18, linewidth=0)
        axes.errorbar(
            *(x, mean, sd),
            color=colour,
            marker=mark,
            markersize=4,
            linestyle=dash,
            linewidth=1.3,
            elinewidth=0.8,
            capsize=2,
            label=(labels or {}).get(name, str(name)),
        )
    if score:
        axes.set_ylabel(NAMES[score])


def draw_paper(
    axes: Axes, points: Sequence[tuple[float, float, float | None]], *, label: str, colour: str = BLACK
) -> None:
    """Draw points of the paper: x, mean, and standard deviation where it has one."""
    if points:
        x, mean, sd = zip(*points, strict=True)
        bars = None if None in sd else sd
        axes.errorbar(x, mean, bars, elinewidth=0.8, capsize=3, label=label, color=colour, **_PAPER)
