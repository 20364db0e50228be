"""Where the features of an inventory are: one point each, in degrees, or the reason why there is none."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely

from geofleet.errors import InputError
from geofleet.formats.inventory_columns import coordinates, paired_coordinates, texts
from geofleet.formats.inventory_files import CRS84
from geofleet.formats.positions import reject_null_island, to_lonlat

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.formats.inventory_columns import InventoryColumns
    from geofleet.formats.inventory_files import Features

    Floats = NDArray[np.float64]

_POINT, _MULTIPOINT = 0, 4  # shapely.get_type_id
_LINES = (1, 2, 5)
_SRID, _HEX = re.compile(r"SRID=(\d{1,6});\s*", re.IGNORECASE), re.compile(r"0[01][0-9a-fA-F]{8,}\Z")

_WKT = re.compile(r"(?:SRID=\d{1,6};\s*)?(?:MULTI)?(?:POINT|LINESTRING|POLYGON)\b", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class Places:
    """Points of features.

    Parameters
    ----------
    feature
        Row of the file that each point belongs to, shape (n,); a multipoint gives several.
    lon, lat
        Degrees, all valid, shape (n,).
    is_extended
        The feature is a line or an area, which the point stands for, shape (n,).
    skipped, found
        What was left out and why; what else is worth telling.
    crs
        What the coordinates are in.
    """

    feature: NDArray[np.int64]
    lon: Floats
    lat: Floats
    is_extended: NDArray[np.bool_]
    skipped: dict[str, int]
    found: dict[str, int]
    crs: Any


def place_features(
    path: Path, features: Features, chosen: InventoryColumns, *, crs: Any = None, swap_xy: bool = False
) -> Places:
    """Return the points of features.

    Parameters
    ----------
    path
        For messages.
    features, chosen
        Rows and geometry, and the columns that hold coordinates where there is no geometry.
    crs
        Overrides the CRS of the file; without either it is OGC:CRS84.
    swap_xy
        The file gives y before x.

    Raises
    ------
    InputError
        There are neither geometries nor columns of coordinates, or the positions contradict the CRS.
    """
    skipped: Counter[str] = Counter()
    geometry = features.geometry if features.geometry is not None else _written(features, chosen, skipped)
    if geometry is not None:
        feature, x, y, is_extended = _points(geometry, skipped)
    else:
        if not (chosen.lat_lon or (chosen.x and chosen.y)):
            raise InputError(
                f"no geometry, and no columns that look like coordinates; there are "
                f"{', '.join(features.table.column_names)[:300]}.",
                where=str(path),
                todo="Name them: --columns x=…,y=…, or lat_lon=… for one column of both.",
            )
        if chosen.lat_lon:
            x, y = paired_coordinates(features.table, chosen.lat_lon)
        else:
            x, y = coordinates(features.table, chosen.x), coordinates(features.table, chosen.y)
        feature, is_extended = np.arange(len(x)), np.zeros(len(x), bool)
    x, y = (y, x) if swap_xy else (x, y)
    stated = crs or features.crs or _srid(geometry)
    crs, assumed = stated or CRS84, stated is None
    lon, lat = to_lonlat(x, y, crs, where=str(path))
    finite = np.isfinite(x) & np.isfinite(y)
    skipped["coordinates that are no number"] += int((~finite).sum())
    skipped["coordinates out of range"] += int((finite & np.isnan(lon)).sum())
    kept = np.flatnonzero(~np.isnan(lon))
    null = reject_null_island(lon[kept], lat[kept], where=str(path))
    skipped["at 0° N 0° E, in the Gulf of Guinea"] += int(null.sum())
    kept = kept[~null]
    found = {"no CRS stated, taken as OGC:CRS84": len(kept)} if assumed else {}
    reasons = {reason: count for reason, count in skipped.items() if count}
    return Places(feature[kept], lon[kept], lat[kept], is_extended[kept], reasons, found, crs)


def _written(features: Features, chosen: InventoryColumns, skipped: Counter[str]) -> NDArray[np.object_] | None:
    """Return the geometries that a column of text holds, None without such a column.

    It is the column of geometries, or that of pairs where it holds well-known text. Geometries are well-known text or
    bytes in hexadecimal digits, either with an SRID as PostGIS writes them, or GeoJSON.
    """
    text = texts(features.table, chosen.geometry or chosen.lat_lon)
    if not (chosen.geometry or any(_WKT.match(one) for one in text if one)):
        return None
    shapes = np.full(len(text), None, object)
    for row, written in enumerate(text):
        if written:
            shapes[row] = _shape(written)
    skipped["geometries that cannot be read"] += int((shapely.is_missing(shapes) & np.array(text, bool)).sum())
    return shapes


def geometry_reader(text: str) -> Callable[..., Any]:
    """Return shapely's function for a text that is GeoJSON, well-known bytes in hexadecimal digits, or text."""
    read: Callable[..., Any]
    read = shapely.from_geojson if text.startswith("{") else shapely.from_wkb if _HEX.match(text) else shapely.from_wkt
    return read


def _shape(text: str) -> Any:
    """Return the geometry that a text says, None when it says none."""
    stated = _SRID.match(text)
    body = text[stated.end() :] if stated else text
    try:
        shape = geometry_reader(body)(body)
    except (shapely.GEOSException, ValueError):
        return None
    return shapely.set_srid(shape, int(stated[1])) if stated and shape is not None else shape


def _srid(geometry: NDArray[np.object_] | None) -> str | None:
    """Return the CRS that all geometries name, None when they name none or several."""
    if geometry is None:
        return None
    named = set(shapely.get_srid(geometry[~shapely.is_missing(geometry)]).tolist())
    return f"EPSG:{named.pop()}" if len(named) == 1 and named != {0} else None


def _points(
    geometry: NDArray[np.object_], skipped: Counter[str]
) -> tuple[NDArray[np.int64], Floats, Floats, NDArray[np.bool_]]:
    """Return feature, x, y and whether it stands for a line or an area, of every point."""
    absent = shapely.is_missing(geometry) | shapely.is_empty(geometry)
    skipped["without a geometry"] += int(absent.sum())
    feature = np.flatnonzero(~absent)
    parts, owner = geometry[feature], np.arange(len(feature))
    many = shapely.get_type_id(parts) == _MULTIPOINT
    split, of_split = shapely.get_parts(parts[many], return_index=True)
    owner = np.concatenate((owner[~many], owner[many][of_split]))
    shapes = np.concatenate((parts[~many], split))
    order = np.argsort(owner, kind="stable")
    shapes, feature = shapes[order], feature[owner[order]]
    kind = shapely.get_type_id(shapes)
    is_extended = kind != _POINT
    for index in np.flatnonzero(is_extended):
        shapes[index] = _middle(shapes[index], is_line=int(kind[index]) in _LINES)
    lost = shapely.is_missing(shapes) | shapely.is_empty(shapes)
    skipped["geometries without a point on them"] += int(lost.sum())
    shapes, feature, is_extended = shapes[~lost], feature[~lost], is_extended[~lost]
    return feature.astype(np.int64), shapely.get_x(shapes), shapely.get_y(shapes), is_extended


def _middle(shape: Any, *, is_line: bool) -> Any:
    """Return the middle of a line or a point within an area, None where its coordinates allow neither."""
    try:
        if is_line:
            return shapely.line_interpolate_point(shapely.line_merge(shape), 0.5, normalized=True)
        return shapely.point_on_surface(shape)
    except (shapely.GEOSException, TypeError, ValueError):
        return None
