"""The layers of an evaluation for GIS tools: a GeoJSON file and a QGIS style each, and one GeoPackage of them all."""

from __future__ import annotations

import csv
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from geofleet.algorithms.ellipses import error_ellipses
from geofleet.formats.geojson import write_geojson
from geofleet.formats.geopackage import write_geopackage
from geofleet.formats.qgis import STYLES
from geofleet.tables.database import connect, run
from geofleet.tables.schemas import BBOX
from geofleet.tables.store import lonlat, to_geodataframe

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from geopandas import GeoDataFrame

# In the order in which they are drawn, the lowest first.
GEOMETRY_TYPES: Mapping[str, str] = MappingProxyType(
    {
        "scores": "Polygon",
        "ellipses": "Polygon",
        "match_lines": "LineString",
        "reference": "Point",
        "fused": "Point",
        "matches": "Point",
    }
)
ELLIPSE_PROBABILITY = 0.95
GEOPACKAGE = "results.gpkg"
_SHORTEST_LINE_M = 0.002  # GeoJSON is written to a millimetre: anything shorter could come out without length
_LABELS = ("run_id", "method", "n_vehicles")


def write_result_layers(
    folder: Path, *, fused: pa.Table, labels: pa.Table, reference: pa.Table, matches: pa.Table, scores: pa.Table
) -> dict[str, int]:
    """Write the layers of an evaluation into a folder.

    Parameters
    ----------
    folder
        Where to write; it exists.
    fused, reference
        The signs that were scored, `signs` tables.
    labels
        `run_id`, `method` and `n_vehicles` of every row of `fused`, as in `matches`.
    matches, scores
        What the evaluation found.

    Returns
    -------
    Number of features a layer, and `signs_without_ellipse`.
    """
    tiles = scores.filter((pc.field("tile") != "all") & (pc.field("concept") == "all"))
    labelled = _label(fused, labels)
    ellipses = _ellipses(labelled)
    frames = {
        "scores": _frame(tiles),
        "ellipses": ellipses,
        "match_lines": _match_lines(matches, labelled),
        "reference": _frame(reference),
        "fused": _frame(fused),
        "matches": _frame(matches),
    }
    styles = {name: STYLES[name].qml() for name in frames}
    for name, frame in frames.items():
        write_geojson(frame, folder / f"{name}.geojson")
        (folder / f"{name}.qml").write_text(styles[name], encoding="utf-8")
    layers = {name: (frame, GEOMETRY_TYPES[name]) for name, frame in frames.items()}
    write_geopackage(layers, folder / GEOPACKAGE, styles=styles)
    return {name: len(frame) for name, frame in frames.items()} | {
        "signs_without_ellipse": fused.num_rows - len(ellipses)
    }


def write_csv(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write rows as CSV (RFC 4180, UTF-8): a missing value is empty, numbers are written in full."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _frame(table: pa.Table) -> GeoDataFrame:
    """Return a table as a frame in which a flag or whole number stays one beside nulls, not text or a fraction."""
    frame = to_geodataframe(table)
    for field in table.schema:
        if pa.types.is_boolean(field.type):
            frame[field.name] = frame[field.name].astype("boolean")
        elif pa.types.is_integer(field.type):
            frame[field.name] = frame[field.name].astype("Int64")
    return frame


def _label(fused: pa.Table, labels: pa.Table) -> pa.Table:
    """Return the signs with their labels in place of what the layer itself says, which may be nothing."""
    plain = fused.drop_columns([name for name in _LABELS if name in fused.column_names])
    for name in _LABELS:
        plain = plain.append_column(name, labels[name])
    return plain


def _ellipses(fused: pa.Table) -> GeoDataFrame:
    """Return the error ellipse of every sign of the map that has a covariance."""
    import geopandas  # noqa: PLC0415  (a second of import that only writing needs)

    lon, lat = lonlat(fused)
    found = error_ellipses(
        lon,
        lat,
        var_e_m2=_numbers(fused, "var_e_m2"),
        var_n_m2=_numbers(fused, "var_n_m2"),
        cov_en_m2=_numbers(fused, "cov_en_m2"),
        probability=ELLIPSE_PROBABILITY,
    )
    frame = fused.select(["sign_id", "sign_class", *_LABELS]).take(pa.array(found.index)).to_pandas()
    frame["probability"] = np.full(len(frame), ELLIPSE_PROBABILITY)
    for name in ("semi_major_m", "semi_minor_m", "orientation_deg"):
        frame[name] = getattr(found, name)
    return geopandas.GeoDataFrame(frame, geometry=shapely.polygons(found.ring_deg), crs="OGC:CRS84")


def _numbers(table: pa.Table, name: str) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Return a column, NaN where it is null or absent."""
    if name not in table.column_names:
        return np.full(table.num_rows, np.nan)
    return np.asarray(table[name].to_numpy(), np.float64)


def _match_lines(matches: pa.Table, fused: pa.Table) -> GeoDataFrame:
    """Return a line from every matched sign of the map to its reference; lines without length are left out."""
    import geopandas  # noqa: PLC0415

    connection = connect(spatial=False)
    connection.register("matches", matches)
    connection.register("signs", fused.select(["sign_id", BBOX, *_LABELS]))
    lines = run(connection, "evaluate/match_lines", {"min_length_m": _SHORTEST_LINE_M}).to_arrow_table()
    connection.close()
    ends = np.stack([lines[name].to_numpy() for name in ("lon", "lat", "ref_lon", "ref_lat")], axis=-1)
    frame = lines.drop_columns(["lon", "lat", "ref_lon", "ref_lat"]).to_pandas()
    return geopandas.GeoDataFrame(frame, geometry=shapely.linestrings(ends.reshape(-1, 2, 2)), crs="OGC:CRS84")
