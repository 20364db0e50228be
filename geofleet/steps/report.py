"""Report: the picture of a run.

Reads `lanes`, `drives`, `matches`, `scores` and the match lines; writes a map as PNG and SVG.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.compute as pc
import shapely

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.tables.manifest import write_manifest
from geofleet.tables.schemas import DRIVES, GEOMETRY, LANES, MATCHES, SCORES
from geofleet.tables.store import atomic_path, lonlat, read_table

if TYPE_CHECKING:
    from pathlib import Path

    import pyarrow as pa
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, told apart by the colour-blind; shapes differ too, for print without colour.
_MARKS: dict[str, dict[str, Any]] = {
    "TP": {"marker": "o", "c": "#009E73", "s": 34, "label": "found (TP)", "zorder": 5},
    "FP": {"marker": "X", "c": "#D55E00", "s": 60, "label": "not in the reference (FP)", "zorder": 7},
    "FN": {
        "marker": "D",
        "facecolors": "none",
        "edgecolors": "#CC79A7",
        "linewidths": 2.0,
        "s": 70,
        "label": "missed (FN)",
        "zorder": 6,
    },
}
_MARGIN_M = 60.0
# No random ids in the SVG: the same run gives the same bytes.
_STYLE: dict[Any, Any] = {"svg.hashsalt": "geofleet", "font.size": 9, "savefig.bbox": "tight"}


@dataclass(frozen=True, slots=True)
class ReportResult:
    """The files of a report."""

    out: Path
    files: tuple[Path, ...]


def report(run_dir: Path, out: Path) -> ReportResult:
    """Draw roads, drive, reference signs and their outcomes of the first run in `scores`.

    Raises
    ------
    InputError
        A table of the run is missing.
    """
    import matplotlib as mpl  # noqa: PLC0415  (a second of import that only this function needs)

    paths = {
        "lanes": run_dir / "lanes" / "lanes.parquet",
        "drives": run_dir / "drives" / "drives.parquet",
        "matches": run_dir / "evaluation" / "matches.parquet",
        "scores": run_dir / "evaluation" / "scores.parquet",
    }
    lanes, drives = read_table(LANES, paths["lanes"]), read_table(DRIVES, paths["drives"])
    matches, scores = read_table(MATCHES, paths["matches"]), read_table(SCORES, paths["scores"])
    total = scores.filter((pc.field("tile") == "all") & (pc.field("concept") == "all")).slice(0, 1).to_pylist()[0]
    with mpl.rc_context(_STYLE), atomic_path(out) as draft:
        figure = _draw_map(lanes, drives, _of_run(matches, total), total)
        draft.mkdir()
        for suffix in ("png", "svg"):
            figure.savefig(draft / f"map.{suffix}", dpi=160, metadata={"Date": None} if suffix == "svg" else {})
    write_manifest(out, step="report", inputs=paths.values())
    return ReportResult(out, (out / "map.png", out / "map.svg"))


def _of_run(matches: pa.Table, total: dict[str, Any]) -> pa.Table:
    """Return the matches of one run, method and fleet size."""
    same_run = pc.field("run_id").is_null() if total["run_id"] is None else pc.field("run_id") == total["run_id"]
    return matches.filter(
        same_run & (pc.field("method") == total["method"]) & (pc.field("n_vehicles") == total["n_vehicles"])
    )


def _draw_map(lanes: pa.Table, drives: pa.Table, matches: pa.Table, total: dict[str, Any]) -> Figure:
    """Draw in the ENU frame of the drive, so that both axes are metres."""
    from matplotlib.collections import LineCollection  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    lon, lat = lonlat(drives)
    frame = EnuFrame.around(lon, lat)
    path = frame.to_enu(lon, lat)
    figure = Figure(figsize=(9, 6.5), layout="constrained")
    axes = figure.add_subplot()
    axes.add_collection(LineCollection(_lines(lanes, frame), colors="#C9C9C9", linewidths=2.0, zorder=1))
    axes.plot(*path.T, color="#0072B2", linewidth=1.6, label="drive (derived)", zorder=2)
    _draw_outcomes(axes, matches, frame)
    low, high = path.min(axis=0) - _MARGIN_M, path.max(axis=0) + _MARGIN_M
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), xlabel="east (m)", ylabel="north (m)", aspect="equal")
    axes.set_title(_title(total), loc="left", fontsize=10)
    axes.legend(loc="best", framealpha=0.95)
    figure.text(0.99, 0.005, "Map data © OpenStreetMap contributors (ODbL)", ha="right", fontsize=7, color="#555555")
    return figure


def _lines(lanes: pa.Table, frame: EnuFrame) -> list[Any]:
    shapes = shapely.from_wkb(lanes[GEOMETRY].to_numpy(zero_copy_only=False))
    lonlats, owner = shapely.get_coordinates(shapes, return_index=True)
    xy = frame.to_enu(*lonlats.T)
    return np.split(xy, np.flatnonzero(np.diff(owner)) + 1)


def _draw_outcomes(axes: Axes, matches: pa.Table, frame: EnuFrame) -> None:
    outcomes = np.asarray(matches["outcome"].to_pylist())
    xy = frame.to_enu(*lonlat(matches))
    for outcome, mark in _MARKS.items():
        here = xy[outcomes == outcome]
        axes.scatter(*here.T, **{**mark, "label": f"{mark['label']}: {len(here)}"})


def _title(total: dict[str, Any]) -> str:
    gospa_m = "undefined" if total["gospa_m"] is None else f"{total['gospa_m']:.3f} m"
    f1 = "undefined" if total["f1"] is None else f"{total['f1']:.3f}"
    return (
        f"{total['n_vehicles']} simulated vehicles, real signs, {total['method']}: GOSPA_M {gospa_m}, F1 {f1}\n"
        f"run {total['run_id']}; detections are simulated, the drive is derived from the road graph"
    )
