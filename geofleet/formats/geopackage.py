"""GeoPackage: every layer of a result in one file, with the styles that QGIS opens it in."""

from __future__ import annotations

import sqlite3
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from geofleet.tables.store import atomic_path

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from geopandas import GeoDataFrame

# A GeoPackage holds the time of its last change; the same layers shall give the same bytes.
_LAST_CHANGE = "2000-01-01T00:00:00.000Z"
_VERSION = "1.2"  # of the format: GDAL 3.2, and so QGIS 3.22, warns of a later one
_GEOMETRY_COLUMN = "geom"

# As QGIS itself makes it when a style is saved in the file.
_CREATE_STYLES = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
    f_table_catalog TEXT(256),
    f_table_schema TEXT(256),
    f_table_name TEXT(256),
    f_geometry_column TEXT(256),
    styleName TEXT(30),
    styleQML TEXT,
    styleSLD TEXT,
    useAsDefault BOOLEAN,
    description TEXT,
    owner TEXT(30),
    ui TEXT(30),
    update_time DATETIME
)
"""
_REGISTER_STYLES = """
INSERT INTO gpkg_contents (table_name, data_type, identifier, description, last_change)
VALUES ('layer_styles', 'attributes', 'layer_styles', '', ?)
"""
_INSERT_STYLE = """
INSERT INTO layer_styles (
    f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName, styleQML, styleSLD, useAsDefault,
    description, owner, ui, update_time
) VALUES ('', '', ?, ?, ?, ?, '', 1, '', '', NULL, ?)
"""


def write_geopackage(
    layers: Mapping[str, tuple[GeoDataFrame, str]], path: Path, *, styles: Mapping[str, str] | None = None
) -> None:
    """Write frames in OGC:CRS84 as the layers of one GeoPackage, atomically; the same frames give the same bytes.

    Parameters
    ----------
    layers
        Name to frame and geometry type (`Point`, `LineString`, `Polygon`), also of a layer without features.
    path
        The file to write.
    styles
        Name of a layer to its QML, stored as the layer's default style.
    """
    import pyogrio  # noqa: PLC0415  (loads GDAL, which only writing needs)

    with atomic_path(path) as draft, TemporaryDirectory(dir=path.parent) as folder, _fixed_clock():
        package = Path(folder) / path.name  # GDAL warns of any other suffix
        created = {"VERSION": _VERSION}
        for name, (frame, geometry_type) in layers.items():
            pyogrio.write_dataframe(
                frame.set_crs("EPSG:4326", allow_override=True),  # x before y either way; GeoPackages name the EPSG's
                package,
                driver="GPKG",
                layer=name,
                geometry_type=geometry_type,
                dataset_options=created,
                layer_options={"GEOMETRY_NAME": _GEOMETRY_COLUMN},
            )
            created = {}
        _write_styles(package, styles or {})
        package.rename(draft)


@contextmanager
def _fixed_clock() -> Iterator[None]:
    """Let GDAL write one fixed time."""
    import pyogrio  # noqa: PLC0415

    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": _LAST_CHANGE})
    try:
        yield
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": before})


def _write_styles(path: Path, styles: Mapping[str, str]) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute(_CREATE_STYLES)
        connection.execute(_REGISTER_STYLES, (_LAST_CHANGE,))
        for name, qml in styles.items():
            connection.execute(_INSERT_STYLE, (name, _GEOMETRY_COLUMN, name, qml, _LAST_CHANGE))
