"""The figures of the page, drawn with Bokeh: the map to look around in, and what the errors look like."""

from __future__ import annotations

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
from geofleet.steps.report.statistics import error_bins, landmarks
from geofleet.steps.report.study import PAPER, SCORE_LABELS

if TYPE_CHECKING:
    from bokeh.model import Model
    from bokeh.plotting import figure as Figure  # noqa: N812 (a class by its use)

    from geofleet.steps.report.scene import Scene
    from geofleet.steps.report.statistics import Confusion
    from geofleet.steps.report.study import Study

FONT = "system-ui, sans-serif"
_MARKS = ("circle", "square", "triangle", "inverted_triangle", "hex", "star")
_DASHES = ("solid", "dashed", "dashdot", "dotted", "dotdash", [8, 2])
INK, FAINT = "#333333", "#E8E8E8"
_TIP = """
<div style="font: 13px/1.45 system-ui, sans-serif; margin: 2px 0 6px">
<b style="color:{colour}">{title}</b> @sign_class<br>
sign @sign · tile @tile<br>distance @distance<br>@evidence</div>
"""
# Keeps both axes at one scale when the window changes its width.
_KEEP_SCALE = """
const [width, height] = [plot.inner_width, plot.inner_height]
if (width > 0 && height > 0) {
  const middle = (x.start + x.end) / 2
  const half = (y.end - y.start) * width / height / 2
  x.setv({start: middle - half, end: middle + half})
}
"""
# Shows everything, at one scale: at first, which is when the figure gets its width, and on reset.
_SHOW_ALL = """
const [width, height] = [plot.inner_width, plot.inner_height]
if (width > 0 && height > 0) {
  const scale = Math.max((high[0] - low[0]) / width, (high[1] - low[1]) / height) / 2
  const [east, north] = [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2]
  x.setv({start: east - scale * width, end: east + scale * width})
  y.setv({start: north - scale * height, end: north + scale * height})
  plot.tags = ["laid out"]
}
"""
_ON_WIDTH = f"if (plot.tags.length) {{ {_KEEP_SCALE} }} else {{ {_SHOW_ALL} }}"


def draw_map(scene: Scene) -> Model:
    """Draw roads, drive, tiles, both layers of signs, outcomes and error ellipses; the legend switches each."""
    from bokeh.models import Range1d, WheelZoomTool  # noqa: PLC0415  (a second of import that only the report needs)
    from bokeh.plotting import figure  # noqa: PLC0415

    low, high = scene.extent
    plot = figure(
        name="map",
        height=640,
        sizing_mode="stretch_width",
        tools="pan,box_zoom,wheel_zoom,reset,save",
        x_range=Range1d(float(low[0]), float(high[0])),
        y_range=Range1d(float(low[1]), float(high[1])),
        x_axis_label="east (m)",
        y_axis_label="north (m)",
    )
    plot.toolbar.active_scroll = plot.select_one(WheelZoomTool)
    _style(plot)
    plot.grid.grid_line_color = None
    _draw_ground(plot, scene)
    _draw_signs(plot, scene)
    plot.legend.click_policy = "hide"
    plot.legend.location = "top_right"
    plot.legend.title = "click to show or hide"
    plot.legend.update(label_text_font_size="12px", spacing=0, padding=6, margin=6, background_fill_alpha=0.85)
    _hold_scale(plot, low.tolist(), high.tolist())
    return plot


def _hold_scale(plot: Figure, low: list[float], high: list[float]) -> None:
    """Give both axes of a figure one scale, whatever its width."""
    from bokeh.events import Reset  # noqa: PLC0415
    from bokeh.models import CustomJS  # noqa: PLC0415

    args = {"plot": plot, "x": plot.x_range, "y": plot.y_range, "low": low, "high": high}
    plot.js_on_change("inner_width", CustomJS(args=args, code=_ON_WIDTH))
    plot.js_on_event(Reset, CustomJS(args=args, code=_SHOW_ALL))


def draw_errors(scene: Scene, gate_m: float) -> Model:
    """Draw how far the map's signs are from their reference, and how often."""
    from bokeh.plotting import figure  # noqa: PLC0415

    counts, edges = error_bins(scene.distance_m, gate_m)
    plot = figure(
        name="errors",
        height=340,
        sizing_mode="stretch_width",
        tools="save",
        x_range=(0.0, gate_m),
        x_axis_label="distance to the reference sign (m)",
        y_axis_label="signs",
        tooltips=[("distance", "@left{0.00} to @right{0.00} m"), ("signs", "@top")],
    )
    _style(plot)
    plot.quad(top=counts, bottom=0, left=edges[:-1], right=edges[1:], fill_color=GREEN, line_color="white")
    for value, name, dash in landmarks(scene.distance_m):
        plot.vspan(x=[value], line_color=INK, line_dash=dash, line_width=1.5, legend_label=f"{name} {value:.2f} m")
    plot.y_range.start = 0
    return plot


def draw_offsets(scene: Scene, gate_m: float) -> Model:
    """Draw where the map's signs lie as seen from their reference: a cloud beside the origin is a common shift."""
    from bokeh.models import Range1d  # noqa: PLC0415
    from bokeh.plotting import figure  # noqa: PLC0415

    found = scene.found
    plot = figure(
        name="offsets",
        height=340,
        sizing_mode="stretch_width",
        tools="save",
        x_range=Range1d(-gate_m, gate_m),
        y_range=Range1d(-gate_m, gate_m),
        x_axis_label="error east (m)",
        y_axis_label="error north (m)",
        tooltips=[("class", "@sign_class"), ("east", "@east_m{0.00} m"), ("north", "@north_m{0.00} m")],
    )
    _style(plot)
    angle = np.linspace(0, 2 * np.pi, 181)
    plot.line(gate_m * np.cos(angle), gate_m * np.sin(angle), line_color=GREY, line_dash="dashed", name="gate")
    _hold_scale(plot, [-1.05 * gate_m] * 2, [1.05 * gate_m] * 2)
    source = {name: found[name].to_numpy() for name in ("east_m", "north_m", "sign_class")}
    dots = plot.scatter(
        "east_m", "north_m", source=source, size=7, fill_color=GREEN, fill_alpha=0.7, line_color=BLACK, line_width=0.5
    )
    plot.hover[0].renderers = [dots]
    if scene.shift_m:
        east, north = scene.shift_m
        plot.scatter([east], [north], marker="cross", size=16, line_color=VERMILLION, line_width=3)
    return plot


def draw_confusion(confusion: Confusion) -> Model:
    """Draw the confusion of classes; the diagonal is what is right."""
    from bokeh.models import FactorRange  # noqa: PLC0415
    from bokeh.plotting import figure  # noqa: PLC0415

    ref, fused = np.nonzero(confusion.counts)
    n = confusion.counts[ref, fused]
    rows, columns = np.asarray(confusion.rows), np.asarray(confusion.columns)
    is_right = rows[ref] == columns[fused]
    source = {
        "ref": rows[ref],
        "map": columns[fused],
        "n": n,
        "text": n.astype(str),
        "colour": np.where(is_right, GREEN, VERMILLION),
        "alpha": 0.25 + 0.75 * n / max(n.max(initial=1), 1),
        "ink": np.where((n > 0.6 * n.max(initial=1)), "white", INK),
    }
    plot = figure(
        name="confusion",
        height=150 + 24 * len(rows),
        sizing_mode="stretch_width",
        tools="save",
        x_range=FactorRange(*columns),
        y_range=FactorRange(*reversed(rows)),
        x_axis_label="class in the map",
        y_axis_label="class in the reference",
        tooltips=[("reference", "@ref"), ("map", "@map"), ("signs", "@n")],
    )
    _style(plot)
    plot.rect(
        "map",
        "ref",
        width=0.94,
        height=0.9,
        source=source,
        fill_color="colour",
        fill_alpha="alpha",
        line_color=None,
    )
    plot.text(
        "map",
        "ref",
        text="text",
        source=source,
        text_align="center",
        text_baseline="middle",
        text_color="ink",
        text_font={"value": FONT},
        text_font_size="12px",
    )
    plot.xaxis.major_label_orientation = 0.9
    return plot


def draw_curves(study: Study, score: str) -> Model:
    """Draw a score over the fleet's size, its 95 % interval as a band, and the paper's points."""
    from bokeh.models import HoverTool  # noqa: PLC0415
    from bokeh.plotting import figure  # noqa: PLC0415

    plot = figure(
        name=f"curve_{score}",
        height=380,
        sizing_mode="stretch_width",
        tools="pan,box_zoom,reset,save",
        x_axis_label="vehicles",
        y_axis_label=SCORE_LABELS[score],
    )
    _style(plot)
    curves = [curve for curve in study.curves if curve.score == score]
    for curve, colour, mark, dash in zip(curves, cycle(SERIES), cycle(_MARKS), cycle(_DASHES), strict=False):
        x, label = curve.n_vehicles, f"{curve.name}, {curve.n_runs} runs"
        plot.varea(x, curve.low, curve.high, color=colour, alpha=0.2, legend_label=label)
        plot.segment(x, curve.mean - curve.sd, x, curve.mean + curve.sd, color=colour, alpha=0.6, legend_label=label)
        plot.line(x, curve.mean, color=colour, line_dash=dash, line_width=2.5, legend_label=label)
        source = {"x": x, "y": curve.mean, "sd": curve.sd, "name": [curve.name] * len(x)}
        dots = plot.scatter("x", "y", source=source, color=colour, marker=mark, size=8, legend_label=label)
        tips = [("", "@name"), ("vehicles", "@x"), (SCORE_LABELS[score], "@y{0.000}"), ("sd", "@sd{0.000}")]
        plot.add_tools(HoverTool(renderers=[dots], tooltips=tips, visible=False))
    if score in study.paper:
        x, mean, sd = study.paper[score].T
        plot.segment(x, mean - sd, x, mean + sd, line_color=BLACK, legend_label=PAPER)
        looks = {"size": 11, "fill_color": "white", "line_color": BLACK, "line_width": 1.5, "legend_label": PAPER}
        plot.scatter(x, mean, marker="diamond", **looks)
    plot.legend.click_policy = "hide"
    plot.legend.location = "bottom_right" if score == "f1" else "top_right"
    if score == "gospa_m":
        plot.y_range.start = 0
    return plot


def _draw_ground(plot: Figure, scene: Scene) -> None:
    """Draw what lies below the signs."""
    tiles = scene.tiles
    scored = [tile for tile in tiles if tile["gospa_m"] is not None]
    empty = [tile for tile in tiles if tile["gospa_m"] is None]
    plot.patches(
        [tile["ring"][:, 0] for tile in scored],
        [tile["ring"][:, 1] for tile in scored],
        fill_color=[gospa_m_colour(tile["gospa_m"]) for tile in scored],
        fill_alpha=0.35,
        line_color=GREY,
        name="tiles",
        legend_label="tiles by GOSPA_M",
    )
    plot.patches(
        [tile["ring"][:, 0] for tile in empty],
        [tile["ring"][:, 1] for tile in empty],
        fill_color=None,
        hatch_pattern="/",
        hatch_color=VERMILLION,
        hatch_alpha=0.5,
        line_color=GREY,
        name="tiles_empty",
        legend_label="tiles by GOSPA_M",
    )
    corners = np.asarray([tile["ring"][3] for tile in tiles]).reshape(-1, 2)
    plot.text(
        corners[:, 0],
        corners[:, 1],
        text=[_tile_text(tile) for tile in tiles],
        x_offset=6,
        y_offset=18,
        text_color=INK,
        text_font={"value": FONT},
        text_font_size="12px",
        name="tile_texts",
        legend_label="tiles by GOSPA_M",
    )
    if scene.roads:
        _lines(plot, scene.roads, "roads", line_color=LIGHT_GREY, line_width=3.5, line_cap="round", line_join="round")
    if scene.drives:
        _lines(plot, scene.drives, "drive", line_color=INK, line_width=1.6, line_dash="dashed")


def _tile_text(tile: dict[str, Any]) -> str:
    return "nothing matched" if tile["gospa_m"] is None else f"{tile['gospa_m']:.2f} m"


def _lines(plot: Figure, lines: list[Any], name: str, **looks: Any) -> None:
    plot.multi_line(
        [line[:, 0].astype(np.float32) for line in lines],
        [line[:, 1].astype(np.float32) for line in lines],
        name=name,
        legend_label=name,
        **looks,
    )


def _draw_signs(plot: Figure, scene: Scene) -> None:
    """Draw both layers of signs and, above them, the outcomes, which tell all when pointed at."""
    if scene.ellipses:
        plot.patches(
            [ring[:, 0].astype(np.float32) for ring in scene.ellipses],
            [ring[:, 1].astype(np.float32) for ring in scene.ellipses],
            fill_color=SKY_BLUE,
            fill_alpha=0.3,
            line_color=SKY_BLUE,
            name="ellipses",
            legend_label="95 % error ellipses",
        )
    (x0, y0), (x1, y1) = scene.lines[:, 0].T, scene.lines[:, 1].T
    plot.segment(x0, y0, x1, y1, line_color=ORANGE, line_width=2, name="match_lines", legend_label="matches")
    plot.scatter(
        *scene.reference_xy.T,
        size=16,
        fill_color=None,
        line_color=GREY,
        line_width=1.5,
        name="reference",
        legend_label="reference signs",
    )
    plot.scatter(*scene.fused_xy.T, marker="square", size=5, color=BLACK, name="fused", legend_label="signs of the map")
    _draw_outcome(
        plot, scene, "TP", "found (TP)", marker="circle", size=9, fill_color=GREEN, line_color=BLACK, line_width=0.8
    )
    _draw_outcome(plot, scene, "FN", "missed (FN)", marker="diamond", size=18, fill_color=None, line_color=BLUE)
    _draw_outcome(
        plot, scene, "FP", "not in the reference (FP)", marker="x", size=13, fill_color=None, line_color=VERMILLION
    )


def _draw_outcome(plot: Figure, scene: Scene, outcome: str, label: str, **looks: Any) -> None:
    from bokeh.models import HoverTool  # noqa: PLC0415

    rows = scene.outcomes[scene.outcomes["outcome"] == outcome]
    names = ("x", "y", "sign", "sign_class", "tile", "distance", "evidence")
    dots = plot.scatter(
        "x",
        "y",
        source={name: rows[name].to_numpy() for name in names},
        name=outcome,
        legend_label=f"{label}: {len(rows)}",
        **{"line_width": 2.5} | looks,
    )
    tip = _TIP.format(colour=looks["line_color"] if outcome != "TP" else GREEN, title=label)
    # On a pole with a found, a missed and a false sign each tip needs a side of its own.
    side = {"TP": "right", "FN": "left", "FP": "below"}[outcome]
    plot.add_tools(HoverTool(renderers=[dots], tooltips=tip, attachment=side, visible=False))


def _style(plot: Figure) -> None:
    """Give a figure the page's type and colours, and no link to elsewhere."""
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.background_fill_color = plot.border_fill_color = "white"
    plot.outline_line_color = FAINT
    plot.grid.grid_line_color = FAINT
    for axis in plot.axis:
        axis.axis_label_text_font = axis.major_label_text_font = FONT
        axis.axis_label_text_font_style = "normal"
        axis.axis_label_text_color = axis.major_label_text_color = INK
        axis.axis_line_color = axis.major_tick_line_color = GREY
        axis.minor_tick_line_color = None
