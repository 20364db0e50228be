"""Figures of the benchmark of joint fusion: convergence, fleet sizes, reliability, and a map with error ellipses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from unittest.mock import patch

import numpy as np
from joint_fleets import Case, runs
from joint_maps import accepted, joint, known

from geofleet.algorithms import joint as joint_module
from geofleet.algorithms.joint_search import Search
from geofleet.formats.palette import BLACK, BLUE, GREEN, GREY, ORANGE, VERMILLION
from geofleet.formats.study_figures import figure_file

if TYPE_CHECKING:
    from pathlib import Path

    from joint_fleets import Run
    from matplotlib.axes import Axes

DEMO = Case(settings={"tracker": "kalman"})
SIMULATED = "Simulated fleets, scenario paper-ideal with the Kalman tracker"
LINES = {  # method: colour, mark, dash, name
    "dbscan": (GREY, "s", ":", "DBSCAN on means"),
    "dbscan corrected": (ORANGE, "D", "-.", "DBSCAN, biases taken out"),
    "joint": (BLUE, "o", "-", "joint"),
    "known": (BLACK, "x", "--", "known association"),
    "joint with a stale prior": (GREEN, "^", "-", "joint with a stale prior"),
}
MOST_M = 5.0
CORNER = 0.02


def draw_fleet_sizes(bars: dict[str, Any], path: Path) -> None:
    """Draw GOSPA_M and F1 over the number of passes, a row a drive."""
    names = [name for name in bars if name.startswith("paper-ideal, kalman")]
    n = min(row["joint"]["n"] for name in names for row in bars[name].values() if "joint" in row)
    n_dbscan = [row["paired"]["n"] for name in names for row in bars[name].values()]
    caption = (
        f"{SIMULATED}; {n} replicates or more.\n"
        f"Of DBSCAN the first {min(n_dbscan)} to {max(n_dbscan)}: these are of other draws."
    )
    with figure_file(path, caption=caption, size=(9.0, 3.2 * len(names))) as figure:
        axes = figure.subplots(len(names), 2, squeeze=False)
        for (left, right), name in zip(axes, names, strict=True):
            for method, (colour, mark, dash, label) in LINES.items():
                sizes = sorted(int(v) for v in bars[name] if method in bars[name][v])
                style = {"color": colour, "marker": mark, "linestyle": dash, "markersize": 4, "label": label}
                of = [bars[name][str(v)][method] for v in sizes]
                medians = {v: row["gospa_m_median"] for v, row in zip(sizes, of, strict=True)}
                left.plot(list(medians), [min(median, MOST_M) for median in medians.values()], **style)
                right.plot(sizes, [row["f1_mean"] for row in of], **style)
            for axis in (left, right):
                axis.set(xscale="log", xlabel="passes", title=f"drive {name[-1]}")
                axis.set_xticks(ticks := [1, 2, 3, 5, 8, 10, 20, 50], ticks, minor=False)
                axis.minorticks_off()
            left.set(ylabel="median GOSPA_M (m)", yscale="log")
            left.axhline(0.78, color=VERMILLION, linewidth=0.8)
            left.annotate("the paper at 50: 0.78 m", (1, 0.74), color=VERMILLION, fontsize=7, va="top")
            _plain_ticks(left, (0.1, 0.2, 0.5, 1.0, 2.0, 5.0))
            right.set(ylabel="mean F1", ylim=(0, 1.03))
        axes[0, 1].legend(fontsize=7, loc="lower right")


def _plain_ticks(axes: Axes, ticks: tuple[float, ...]) -> None:
    """Mark these values of a logarithmic axis as people read them."""
    axes.set_yticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_yticks([], minor=True)


def draw_reliability(honesty: dict[str, Any], path: Path) -> None:
    """Draw stated existence against the share that exist."""
    with figure_file(path, caption=f"{SIMULATED}; numbers: signs of the maps of all runs.", size=(5.2, 4.4)) as figure:
        axes = figure.subplots()
        axes.plot([0, 1], [0, 1], color=GREY, linewidth=0.8)
        name = "paper-ideal, kalman, A"
        for v, colour, mark in (("3", ORANGE, "^"), ("5", VERMILLION, "s"), ("20", BLUE, "o"), ("50", GREEN, "D")):
            if v in honesty.get(name, {}):
                bins = honesty[name][v]["reliability"]
                axes.plot(
                    [b["stated"] for b in bins],
                    [b["true"] for b in bins],
                    marker=mark,
                    color=colour,
                    label=f"{v} passes; in the corners "
                    + ", ".join(str(b["n"]) for b in bins if not CORNER < b["stated"] < 1 - CORNER),
                    linestyle="none",
                )
                for b in bins:
                    if not CORNER < b["stated"] < 1 - CORNER:
                        continue
                    axes.annotate(
                        str(b["n"]), (b["stated"], b["true"]), fontsize=6, xytext=(3, 3), textcoords="offset points"
                    )
        axes.set(xlabel="stated probability of existence", ylabel="share that exist")
        axes.legend(fontsize=8)


class Recorded(Search):
    """A search that keeps its map after each round."""

    kept: list[tuple[np.ndarray, np.ndarray]]

    def solve(self) -> float:
        """Solve, and keep the map."""
        moved = super().solve()
        self.kept = [*getattr(self, "kept", []), (self.xy_m.copy(), self.sign.copy())]
        Recorded.last = self
        return moved


def draw_convergence(fleets: Path, path: Path) -> None:
    """Draw the relative error of the map after each round, beside the known association."""
    caption = f"{SIMULATED}, drive A; a line a replicate. Places of the signs that half of the passes report."
    with figure_file(path, caption=caption, size=(7.0, 3.8)) as figure:
        axes = figure.subplots()
        for v, colour in ((5, ORANGE), (20, BLUE), (50, GREEN)):
            for number, whole in runs(fleets, DEMO, 8):
                run = whole.first_vehicles(v)
                with patch.object(joint_module, "Search", Recorded):
                    joint(run)
                found = [_rms(xy, run, np.bincount(sign) > v / 2) for xy, sign in Recorded.last.kept]
                label = f"{v} passes" if number == 0 else None
                axes.plot(range(1, len(found) + 1), found, color=colour, linewidth=0.9, marker=".", label=label)
            best = known(run)
            axes.axhline(
                _rms(best.xy_m, run, np.ones(len(best.xy_m), bool)), color=colour, linestyle=":", linewidth=0.9
            )
        axes.set(xlabel="round of association", ylabel="error of relative places (m)", yscale="log")
        _plain_ticks(axes, (0.02, 0.03, 0.04, 0.06))
        axes.legend(fontsize=8, title="dotted: known association, last replicate", title_fontsize=7)


def _rms(xy_m: np.ndarray, run: Run, is_supported: np.ndarray) -> float:
    """Return the median error, the common translation taken out, of the nearest true signs."""
    xy = xy_m[is_supported]
    apart = xy[:, None] - run.reference_xy[None]
    error = apart[np.arange(len(xy)), np.argmin((apart**2).sum(axis=2), axis=1)]
    relative = error - np.median(error, axis=0)
    return float(np.sqrt(np.median((relative**2).sum(axis=1))))


DENSE_M = 20.0


def draw_map(fleets: Path, path: Path) -> None:
    """Draw the map of five passes and of fifty with 90 % ellipses, beside the true signs."""
    _, whole = next(iter(runs(fleets, DEMO, 1)))
    caption = f"{SIMULATED}, drive A, first replicate. Ellipses hold 90 %, the offset that all passes share included."
    with figure_file(path, caption=caption, size=(9.5, 4.8)) as figure:
        for axes, v in zip(figure.subplots(1, 2, sharex=True, sharey=True), (5, 50), strict=True):
            _draw_ellipses(axes, whole.first_vehicles(v))
            axes.set(title=f"{v} passes", xlabel="east (m)", aspect="equal")
            axes.label_outer()
        figure.axes[0].set_ylabel("north (m)")
        figure.axes[0].legend(fontsize=7)


def _draw_ellipses(axes: Axes, run: Run) -> None:
    fused = joint(run)
    kept = accepted(fused)
    turn = np.linspace(0, 2 * np.pi, 60)
    circle = np.sqrt(4.605) * np.column_stack((np.cos(turn), np.sin(turn)))
    apart = np.hypot(*(run.reference_xy[:, None] - run.reference_xy[None]).transpose(2, 0, 1))
    middle, half = (
        run.reference_xy[np.argmax((apart < DENSE_M).sum(axis=1))],
        DENSE_M,
    )  # where most signs stand together
    axes.plot(*run.reference_xy.T, "+", color=BLACK, markersize=7, label="true sign", zorder=3)
    for at, (xy, cov) in enumerate(zip(fused.xy_m[kept], fused.cov_m2[kept], strict=True)):
        ring = xy + circle @ np.linalg.cholesky(cov).T
        axes.plot(*ring.T, color=BLUE, linewidth=0.9, label=None if at else "joint: 90 % ellipse")
    axes.plot(*fused.xy_m[kept].T, ".", color=BLUE, markersize=3)
    axes.set(xlim=(middle[0] - half, middle[0] + half), ylim=(middle[1] - half, middle[1] + half))
