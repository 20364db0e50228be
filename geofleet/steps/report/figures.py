"""The figures of a report for print, drawn with Matplotlib: PNG and SVG, no clock and no random id in them."""

from __future__ import annotations

import textwrap
from itertools import cycle
from typing import TYPE_CHECKING, Any

import numpy as np

from geofleet.formats.palette import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    LIGHT_GREY,
    ORANGE,
    SERIES,
    SKY_BLUE,
    VERMILLION,
    gospa_m_colour,
)
from geofleet.steps.report.statistics import Confusion, count_confusion, error_bins, landmarks
from geofleet.steps.report.study import PAPER, SCORE_LABELS
from geofleet.steps.report.wording import OSM_NOTICE, subtitle, title

if TYPE_CHECKING:
    from pathlib import Path

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from geofleet.steps.report.contents import Contents
    from geofleet.steps.report.scene import Scene
    from geofleet.steps.report.study import Study

_STYLE: dict[Any, Any] = {
    "svg.hashsalt": "geofleet",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": GREY,
    "hatch.linewidth": 0.6,
}
_DPI = 160
# Shapes differ as colours do, for print without colour.
_MARKS: dict[str, dict[str, Any]] = {
    "TP": {"marker": "o", "c": GREEN, "edgecolors": BLACK, "linewidths": 0.5, "s": 30, "label": "found (TP)"},
    "FN": {"marker": "D", "c": "none", "edgecolors": BLUE, "linewidths": 1.8, "s": 62, "label": "missed (FN)"},
    "FP": {"marker": "x", "c": VERMILLION, "linewidths": 2.0, "s": 46, "label": "not in the reference (FP)"},
}
_LINES = ("-", "--", "-.", ":")
_MARKERS = "os^vPD*"


def write_figures(contents: Contents, scene: Scene, study: Study, folder: Path) -> list[str]:
    """Write `map` into a folder and every other figure into its `figures`; return their names below the folder."""
    import matplotlib as mpl  # noqa: PLC0415  (a second of import that only this function needs)

    (folder / "figures").mkdir()
    names = []
    with mpl.rc_context(_STYLE):
        for name, figure in _draw(contents, scene, study).items():
            for suffix in ("png", "svg"):
                metadata = {"Date": None} if suffix == "svg" else {}
                figure.savefig(folder / f"{name}.{suffix}", dpi=_DPI, metadata=metadata)
                names.append(f"{name}.{suffix}")
    return names


def _draw(contents: Contents, scene: Scene, study: Study) -> dict[str, Figure]:
    """Return the figures that have something to show."""
    found: dict[str, Figure] = {"map": _map(contents, scene)}
    confusion = count_confusion(contents)
    if len(scene.distance_m):
        found["figures/errors"] = _errors(contents, scene)
    if confusion.counts.any():
        found["figures/confusion"] = _confusion(contents, confusion)
    for score in study.scores:
        found[f"figures/fleet_size_{score}"] = _curve(contents, study, score)
    return found


def _figure(contents: Contents, width: float, height: float) -> Figure:
    """Return an empty figure that says what is simulated and whose data it shows."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(width, height), layout="constrained")
    notes = []
    if contents.run is not None:
        notes.append("Detections are simulated.")
    if contents.is_drive_derived:
        notes.append("The drive is derived from the road graph.")
    if contents.is_from_osm:
        notes.append(OSM_NOTICE)
    lines = textwrap.wrap(" ".join(notes), width=int(16 * width))
    figure.supxlabel("\n".join(lines), fontsize=6.5, color="#555555", x=0.995, ha="right")
    return figure


def _map(contents: Contents, scene: Scene) -> Figure:
    """Draw in metres east and north, so that both axes have one scale."""
    low, high = scene.extent
    width, height = high - low
    figure = _figure(contents, 9.0, float(np.clip(8.0 * height / width + 0.9, 4.0, 10.0)))
    axes = figure.add_subplot()
    _draw_tiles(axes, scene)
    _draw_lines(axes, scene.roads, "", color=LIGHT_GREY, linewidths=2.2, zorder=1.5)
    drive = "drive (derived)" if contents.is_drive_derived else "drive"
    _draw_lines(axes, scene.drives, drive, color="#333333", linewidths=1.2, linestyles="--", zorder=2)
    _draw_lines(axes, list(scene.lines), "", color=ORANGE, linewidths=1.5, zorder=5.5)
    _draw_ellipses(axes, scene)
    for zorder, (outcome, mark) in enumerate(_MARKS.items(), start=6):
        here = scene.outcomes[scene.outcomes["outcome"] == outcome]
        axes.scatter(here["x"], here["y"], zorder=zorder, **mark | {"label": f"{mark['label']}: {len(here)}"})
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="east (m)", ylabel="north (m)", aspect="equal")
    shown = contents.shown
    scores = ", ".join(f"{label} {_text(shown[name])}" for name, label in (("gospa_m", "GOSPA_M"), ("f1", "F1")))
    axes.set_title(f"{title(contents)}: {scores}\n{subtitle(contents)}", loc="left", fontsize=9)
    axes.legend(loc="best", framealpha=0.95, fontsize=8)
    return figure


def _text(value: float | None) -> str:
    return "undefined" if value is None else f"{value:.3f}"


def _draw_tiles(axes: Axes, scene: Scene) -> None:
    for tile in scene.tiles:
        colour = gospa_m_colour(tile["gospa_m"])
        looks = {"facecolor": colour, "alpha": 0.35} if colour else {"facecolor": "none", "hatch": "//"}
        axes.fill(*tile["ring"].T, edgecolor=GREY, linewidth=0.6, zorder=1, **looks)
        text = "nothing matched" if colour is None else f"GOSPA_M {tile['gospa_m']:.2f} m"
        axes.annotate(
            text,
            tile["ring"][3],
            (4, -4),
            textcoords="offset points",
            va="top",
            fontsize=7,
            color="#444444",
            clip_on=True,
            annotation_clip=True,
        )


def _draw_lines(axes: Axes, lines: list[Any], label: str, **looks: Any) -> None:
    from matplotlib.collections import LineCollection  # noqa: PLC0415

    if lines:
        axes.add_collection(LineCollection(lines, label=label or "_", **looks))


def _draw_ellipses(axes: Axes, scene: Scene) -> None:
    from matplotlib.collections import PolyCollection  # noqa: PLC0415

    if scene.ellipses:
        looks: dict[str, Any] = {
            "facecolors": SKY_BLUE,
            "edgecolors": SKY_BLUE,
            "alpha": 0.5,
            "label": "95 % error ellipse",
        }
        axes.add_collection(PolyCollection(scene.ellipses, zorder=5, **looks))


def _errors(contents: Contents, scene: Scene) -> Figure:
    """Draw how far found signs are from their reference, and whereto."""
    gate_m = contents.shown["gate_m"]
    figure = _figure(contents, 7.2, 3.1)
    histogram, cloud = figure.subplots(1, 2, width_ratios=(1.7, 1))
    counts, edges = error_bins(scene.distance_m, gate_m)
    histogram.stairs(counts, edges, fill=True, color=GREEN, alpha=0.75)
    histogram.stairs(counts, edges, color=BLACK, linewidth=0.6)
    for (value, name, _), line in zip(landmarks(scene.distance_m), _LINES, strict=False):
        histogram.axvline(value, color=BLACK, linewidth=1.1, linestyle=line, label=f"{name} {value:.2f} m")
    histogram.set(xlim=(0, gate_m), xlabel="distance to the reference sign (m)", ylabel="signs")
    histogram.legend(fontsize=7.5, frameon=False)
    found = scene.found
    cloud.scatter(found["east_m"], found["north_m"], s=14, c=GREEN, edgecolors=BLACK, linewidths=0.4)
    angle = np.linspace(0, 2 * np.pi, 181)
    cloud.plot(gate_m * np.cos(angle), gate_m * np.sin(angle), color=GREY, linewidth=0.8, linestyle="--")
    if scene.shift_m:
        cloud.plot(*scene.shift_m, marker="+", markersize=11, markeredgewidth=2, color=VERMILLION)
    side = (-1.05 * gate_m, 1.05 * gate_m)
    cloud.set(xlim=side, ylim=side, aspect="equal", xlabel="error east (m)", ylabel="error north (m)")
    return figure


def _confusion(contents: Contents, confusion: Confusion) -> Figure:
    """Draw the confusion of classes in shades that print well."""
    rows, columns, counts = confusion.rows, confusion.columns, confusion.counts
    side = 1.6 + 0.26 * len(rows)
    figure = _figure(contents, side + 1.6, side + 0.9)
    axes = figure.add_subplot()
    is_right = np.equal.outer(np.asarray(rows), np.asarray(columns))
    for part, colours in ((is_right, "Greens"), (~is_right, "Oranges")):
        shades = np.where(part & (counts > 0), np.sqrt(counts), np.nan)
        axes.imshow(shades, cmap=colours, vmin=0, vmax=1.4 * np.sqrt(counts.max()), aspect="auto")
    for row, column in zip(*np.nonzero(counts), strict=True):
        weight = "normal" if is_right[row, column] else "bold"  # for print without colour
        axes.text(column, row, str(counts[row, column]), ha="center", va="center", weight=weight)
    axes.set_xticks(range(len(columns)), columns, rotation=50, ha="right", rotation_mode="anchor")
    axes.set_yticks(range(len(rows)), rows)
    axes.set(xlabel="class in the map", ylabel="class in the reference")
    return figure


def _curve(contents: Contents, study: Study, score: str) -> Figure:
    """Draw a score over the fleet's size with its band, and the paper's points."""
    figure = _figure(contents, 5.2, 3.6)
    axes = figure.add_subplot()
    curves = [curve for curve in study.curves if curve.score == score]
    for curve, colour, line, marker in zip(curves, cycle(SERIES), cycle(_LINES), cycle(_MARKERS), strict=False):
        axes.fill_between(curve.n_vehicles, curve.low, curve.high, color=colour, alpha=0.18, linewidth=0)
        looks: dict[str, Any] = {"color": colour, "linestyle": line, "marker": marker, "markersize": 4, "capsize": 2}
        label = f"{curve.name}, {curve.n_runs} runs"
        axes.errorbar(curve.n_vehicles, curve.mean, curve.sd, elinewidth=0.8, label=label, **looks)
    if score in study.paper:
        x, mean, sd = study.paper[score].T
        bars = None if np.isnan(sd).any() else sd
        axes.errorbar(x, mean, bars, fmt="D", color=BLACK, markerfacecolor="white", markersize=5, label=PAPER)
    axes.set(xlabel="vehicles", ylabel=SCORE_LABELS[score])
    if score == "gospa_m":
        axes.set_ylim(bottom=0)
    axes.grid(color="#E8E8E8")
    axes.legend(fontsize=7.5, frameon=False)
    return figure
