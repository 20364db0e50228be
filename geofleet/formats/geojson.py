"""GeoJSON (RFC 7946) for people and GIS tools, written through GDAL: one geometry type a file, nulls as null."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geofleet.tables.store import atomic_path

if TYPE_CHECKING:
    from pathlib import Path

    from geopandas import GeoDataFrame

_DECIMALS = 8  # a millimetre


def write_geojson(frame: GeoDataFrame, path: Path, *, decimals: int = _DECIMALS) -> None:
    """Write a frame in OGC:CRS84 as an RFC 7946 FeatureCollection, atomically.

    Ids stay properties (GDAL and QGIS drop integer feature ids). An empty frame gives an empty, valid collection.

    Parameters
    ----------
    frame
        One geometry type.
    path
        The file to write.
    decimals
        Of the coordinates, degrees.
    """
    import pyogrio  # noqa: PLC0415  (loads GDAL, which only writing needs)

    geometry_type = "Unknown" if frame.empty else str(frame.geom_type.iloc[0])
    with atomic_path(path) as draft:
        pyogrio.write_dataframe(
            frame,
            draft,
            driver="GeoJSON",
            layer=path.stem,  # GDAL would take the draft's name
            geometry_type=geometry_type,
            layer_options={
                "RFC7946": "YES",
                "COORDINATE_PRECISION": str(decimals),
                "SIGNIFICANT_FIGURES": "17",  # of other numbers: a double needs as many
                "WRITE_NAME": "YES",
                "AUTODETECT_JSON_STRINGS": "NO",  # a text like [50] stays one
            },
        )
