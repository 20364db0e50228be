"""Trajectories in the files of a GIS: points with a time, or lines, with a time for each vertex or without any."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
import shapely

from geofleet.errors import InputError
from geofleet.formats.drive_epochs import NO_POSITION, Epochs
from geofleet.formats.drive_names import guess_columns
from geofleet.formats.drive_times import guess_format, times_of
from geofleet.formats.inventory_columns import texts
from geofleet.formats.inventory_files import CRS84, read_features
from geofleet.formats.positions import to_lonlat
from geofleet.formats.reading import read_head

if TYPE_CHECKING:
    from pathlib import Path

    import pyarrow as pa
    from numpy.typing import NDArray

    from geofleet.formats.inventory_files import Features

FORMATS = ("geojson", "geojsonseq", "gpkg", "shapefile", "shapefile.zip", "flatgeobuf")
_GEOPACKAGE, _TRACK_POINTS = b"SQLite format 3\0", "track_points"
_POINT, _LINE, _LINES = 0, 1, 5  # shapely.get_type_id
# Of togeojson, of its later versions, and of Mapbox
_VERTEX_TIMES = ("coordTimes", "coordinateProperties", "times", "timestamps")
_TIMES = frozenset({"time", "timestamp", "t_utc"})
_OF_MOTION = frozenset({"speed", "course", "track_fid", "track_seg_id", "speed_mps", "heading_deg", "velocity"})
_HELD = "times", "coordTimes"  # where one property holds others


@dataclass(frozen=True, slots=True)
class _Vertices:
    """Places in the CRS of the file, in its order; `part` is None where nothing parts them."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    t_utc: NDArray[np.datetime64]
    elapsed_s: NDArray[np.float64] | None
    drive: NDArray[np.object_]
    part: NDArray[np.int64] | None
    found: dict[str, int]


def holds_drive(names: list[str]) -> bool:
    """Tell whether properties of that name are those of a trajectory: times of vertices, or a time beside a motion."""
    return bool(set(_VERTEX_TIMES[:2]) & set(names)) or (
        bool(_TIMES & set(names)) and bool(_OF_MOTION & {name.lower() for name in names})
    )


def read_epochs(path: Path) -> tuple[dict[str, Epochs], dict[str, int], dict[str, int], Any]:
    """Read every point, or every vertex of every line, of a file; a line is a stretch of its own.

    Returns
    -------
    tuple
        The epochs with a position by the name of their drive, the numbers left out by reason, other counts, and the
        CRS of the file.

    Raises
    ------
    InputError
        The file is damaged, or holds neither points nor lines.
    """
    features = _features(path)
    geometry = features.geometry
    kind = np.full(features.table.num_rows, -1) if geometry is None else shapely.get_type_id(geometry)
    is_line, is_point = np.isin(kind, (_LINE, _LINES)), kind == _POINT
    if geometry is None or not (is_line.any() or is_point.any()):
        raise InputError("holds neither points nor lines.", where=str(path), todo="Give points with a time, or a line.")
    _refuse_map(path, features.table, is_line, is_point)
    chosen = is_line if is_line.sum() >= is_point.sum() or not _time_of(features.table) else is_point
    rows = np.flatnonzero(chosen)
    read = _of_lines if chosen is is_line else _of_points
    try:
        vertices = read(features.table.take(rows), geometry[rows])
    except UnicodeDecodeError:
        raise InputError("a text that is not UTF-8.", where=str(path), todo="Export it again.") from None
    crs = features.crs or CRS84
    lon, lat = to_lonlat(vertices.x, vertices.y, crs, where=str(path))
    epochs = Epochs.of(lon, lat, t_utc=vertices.t_utc, elapsed_s=vertices.elapsed_s, part=vertices.part)
    placed = epochs.is_placed()
    if not placed.any():
        raise InputError("holds no valid position.", where=str(path), todo="Export it again.")
    skipped = {NO_POSITION: int((~placed).sum()), "other geometries": int((~chosen).sum())}
    number, names = pd.factorize(vertices.drive)  # numpy takes "a\0" for "a" where it compares
    drives = {names[n]: epochs.take(placed & (number == n)) for n in dict.fromkeys(number[placed].tolist())}
    return drives, skipped, features.found | vertices.found, crs


def _features(path: Path) -> Features:
    """Return the rows of a file; of several layers those of the points of tracks, as GDAL makes them of GPX."""
    import pyogrio  # noqa: PLC0415  (loads GDAL, which only these formats need)

    if not read_head(path).startswith(_GEOPACKAGE):
        return read_features(path)
    try:
        layers = pyogrio.list_layers(path.resolve())[:, 0].tolist()
    except Exception:  # noqa: BLE001  (a damaged file: its reader will say so)
        return read_features(path)
    try:
        return read_features(path, layer=_TRACK_POINTS if _TRACK_POINTS in layers else None)
    except InputError as error:
        if len(layers) > 1:
            raise InputError(error.what, where=error.where, todo="Export the layer of the drive alone.") from None
        raise


def _refuse_map(path: Path, table: pa.Table, is_line: NDArray[np.bool_], is_point: NDArray[np.bool_]) -> None:
    """Refuse what has no times and more than one feature: signs or streets, and no way driven."""
    is_timed = bool(_time_of(table)) if is_point.any() else bool(set(_VERTEX_TIMES) & set(table.column_names))
    if not is_timed and int(is_line.sum() + is_point.sum()) > 1:
        what = f"{int(is_line.sum())} lines and {int(is_point.sum())} points without times"
        raise InputError(
            f"holds {what}, which are no drive.",
            where=str(path),
            todo="Give points with a column time, lines with coordTimes, or one line alone.",
        )


def _of_points(table: pa.Table, geometry: NDArray[np.object_]) -> _Vertices:
    column = _time_of(table)
    text = pd.Series(texts(table, column), dtype="string")
    t_utc, elapsed_s, found = _read_times(text, column)
    by = guess_columns(table.column_names, {}, is_projected=False).get("drive", "")
    drive = np.array([name or "" for name in texts(table, by)], object)
    x, y = shapely.get_x(geometry), shapely.get_y(geometry)
    return _Vertices(x, y, t_utc, elapsed_s, drive, None, {f"time read from column {column} (guessed)": len(x)} | found)


def _of_lines(table: pa.Table, geometry: NDArray[np.object_]) -> _Vertices:
    coordinates, line = shapely.get_coordinates(geometry, return_index=True)
    column = next((name for name in _VERTEX_TIMES if name in table.column_names), "")
    values = table[column].to_pylist() if column else [None] * len(geometry)
    n_vertices = np.bincount(line, minlength=len(geometry))
    stated: list[str | None] = []
    n_odd = 0
    for value, n in zip(values, n_vertices.tolist(), strict=True):
        times = _flat(value)
        n_odd += len(times) not in {0, n}
        stated += times if len(times) == n else [None] * n
    t_utc, elapsed_s, found = _read_times(pd.Series(stated, dtype="string"), column)
    found |= {"lines with another number of times than of vertices": n_odd} if n_odd else {}
    drive = np.full(len(line), "", object)
    return _Vertices(coordinates[:, 0], coordinates[:, 1], t_utc, elapsed_s, drive, line.astype(np.int64), found)


def _read_times(
    text: pd.Series[str], name: str
) -> tuple[NDArray[np.datetime64], NDArray[np.float64] | None, dict[str, int]]:
    if not text.notna().any():
        return np.full(len(text), "NaT", "datetime64[us]"), None, {}
    chosen = guess_format(text[text.notna()], name)
    t_utc, elapsed_s = times_of(text, chosen)
    n_lost = int((text.notna().to_numpy(bool) & np.isnat(t_utc)).sum()) if elapsed_s is None else 0
    found = {f"times read as {chosen} (guessed)": len(text), "times that cannot be read": n_lost}
    return t_utc, elapsed_s, {what: n for what, n in found.items() if n}


def _time_of(table: pa.Table) -> str:
    """Return the column of the times of points, "" without one."""
    return guess_columns(table.column_names, {}, is_projected=False).get("time", "")


def _flat(value: Any) -> list[str]:
    """Return the times of the vertices of a line: a list, one of lists (of a line in parts), or JSON of either."""
    if isinstance(value, str):
        try:
            value = json.loads(value)
        except ValueError:
            return []
    if isinstance(value, dict):
        value = next((value[name] for name in _HELD if name in value), [])
    if not isinstance(value, list):
        return []
    return [text for one in value for text in (_flat(one) if isinstance(one, list) else [str(one)])]
