"""The QGIS project of a run: its results, and the roads and the drive that they lie on."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from geofleet.formats.geopackage import write_geopackage
from geofleet.formats.qgis import GROUND_STYLES, STYLES
from geofleet.formats.qgis_project import ProjectLayer, write_project
from geofleet.formats.results import GEOMETRY_TYPES, GEOPACKAGE
from geofleet.steps.report.contents import LABELS
from geofleet.steps.report.wording import title
from geofleet.tables.store import lonlat, to_geodataframe

if TYPE_CHECKING:
    import pyarrow as pa
    from geopandas import GeoDataFrame

    from geofleet.steps.report.contents import Contents

PROJECT, GROUND = "project.qgz", "ground.gpkg"
_MARGIN = 0.08
_NAMES = {
    "matches": "Outcomes",
    "fused": "Map",
    "reference": "Reference",
    "match_lines": "Matches",
    "ellipses": "Error ellipses",
    "scores": "Tiles by GOSPA_M",
    "drives": "Drive",
    "roads": "Roads",
}
# From the top down: what is scored, then what it lies on.
_ORDER = ("matches", "match_lines", "fused", "reference", "ellipses", "drives", "roads", "scores")


def write_qgis(contents: Contents, folder: Path) -> list[str]:
    """Write the project and, where the run has roads or drives, a GeoPackage of them; return both names."""
    ground = _ground(contents)
    results = Path(os.path.relpath(contents.evaluation / GEOPACKAGE, folder)).as_posix()
    layers = []
    for name in _ORDER:
        if name in ground:
            layers.append(ProjectLayer(name, _NAMES[name], f"./{GROUND}", "LineString", GROUND_STYLES[name]))
        elif name in GEOMETRY_TYPES:
            subset = _subset(contents, name)
            layers.append(ProjectLayer(name, _NAMES[name], results, GEOMETRY_TYPES[name], STYLES[name], subset))
    folder.mkdir(parents=True, exist_ok=True)
    if ground:
        styles = {name: GROUND_STYLES[name].qml() for name in ground}
        frames = {name: (frame, "LineString") for name, frame in ground.items()}
        write_geopackage(frames, folder / GROUND, styles=styles)
    write_project(folder / PROJECT, layers, title=f"geofleet: {title(contents)}", extent_deg=_extent(contents))
    return [PROJECT, *([GROUND] if ground else [])]


def _subset(contents: Contents, name: str) -> str:
    """Return the filter that leaves one map of several; nothing when only one was scored."""
    if len(contents.totals) == 1:
        return ""
    frame = {"fused": contents.fused, "reference": contents.reference}.get(name)
    labels = [label for label in LABELS if frame is None or (label in frame and frame[label].notna().any())]
    return " AND ".join(f'"{label}" {_equals(contents.shown[label])}' for label in labels)


def _equals(value: Any) -> str:
    if value is None:
        return "IS NULL"
    return f"= {value}" if isinstance(value, int) else "= '" + value.replace("'", "''") + "'"


def _ground(contents: Contents) -> dict[str, GeoDataFrame]:
    frames = {}
    if contents.drives is not None:
        frames["drives"] = _drive_lines(contents.drives)
    if contents.lanes is not None:
        frames["roads"] = to_geodataframe(contents.lanes)
    return frames


def _drive_lines(drives: pa.Table) -> GeoDataFrame:
    """Return a line a drive and segment."""
    import geopandas  # noqa: PLC0415  (a second of import that only writing needs)

    keys = drives.select(["drive_id", "segment"]).to_pandas()
    places = np.column_stack(lonlat(drives))
    rows = [
        {"drive_id": drive, "segment": segment, "n_epochs": len(part), "geometry": shapely.LineString(places[part])}
        for (drive, segment), part in keys.groupby(["drive_id", "segment"]).indices.items()
        if len(part) > 1
    ]
    return geopandas.GeoDataFrame(rows, columns=["drive_id", "segment", "n_epochs", "geometry"], crs="OGC:CRS84")


def _extent(contents: Contents) -> tuple[float, float, float, float]:
    """Return west, south, east and north of signs and drives, with a margin."""
    parts = [lonlat(table) for table in (contents.matches, contents.drives) if table is not None and table.num_rows]
    lon, lat = (np.concatenate(side) for side in zip(*parts, strict=True)) if parts else (np.zeros(1), np.zeros(1))
    aside = _MARGIN * max(np.ptp(lon), np.ptp(lat), 1e-3)
    return float(lon.min() - aside), float(lat.min() - aside), float(lon.max() + aside), float(lat.max() + aside)
