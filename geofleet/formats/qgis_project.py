"""A QGIS project of layers that lie beside it: styled, in order, zoomed to what matters, with relative paths.

A `.qgz` is a zip of one XML document. Written for QGIS 3.22, read by every later 3.x; the folder that holds project and
layers can be moved.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from string import Template
from typing import TYPE_CHECKING
from xml.sax.saxutils import escape, quoteattr

from geofleet.tables.store import atomic_path

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from geofleet.formats.qgis import Style

_VERSION = "3.22.0-Bia\u0142owie\u017ca"
_NO_TIME = (1980, 1, 1, 0, 0, 0)  # the same project gives the same bytes
_KINDS = {"Point": "Point", "LineString": "Line", "Polygon": "Polygon"}

# QGIS takes the authority's code when there is an id of its own catalogue, whichever; 3452 is that of EPSG:4326.
_CRS = Template("""<spatialrefsys nativeFormat="Wkt">
  <wkt>$wkt</wkt>
  <srsid>3452</srsid>
  <authid>EPSG:$code</authid>
 </spatialrefsys>""")
_LAYER = Template("""<maplayer type="vector" geometry=$kind autoRefreshEnabled="0" hasScaleBasedVisibilityFlag="0">
 <id>$id</id>
 <datasource>$source</datasource>
 <layername>$label</layername>
 <srs>$crs</srs>
 <provider encoding="UTF-8">ogr</provider>
$style</maplayer>""")
_LEAF = Template(
    """ <layer-tree-layer id=$id name=$label source=$source providerKey="ogr"
  checked="Qt::$checked" expanded=$expanded/>"""
)
_PROJECT = Template("""<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="$version" projectname=$title_attribute>
<homePath path=""/>
<title>$title</title>
<projectCrs>$crs</projectCrs>
<layer-tree-group>
$leaves
 <custom-order enabled="0">
$order
 </custom-order>
</layer-tree-group>
<mapcanvas name="theMapCanvas" annotationsVisible="1">
 <units>meters</units>
 <extent><xmin>$xmin</xmin><ymin>$ymin</ymin><xmax>$xmax</xmax><ymax>$ymax</ymax></extent>
 <rotation>0</rotation>
 <destinationsrs>$crs</destinationsrs>
</mapcanvas>
<projectlayers>
$layers
</projectlayers>
<layerorder>
$layer_order
</layerorder>
<properties>
 <Paths><Absolute type="bool">false</Absolute></Paths>
 <SpatialRefSys><ProjectionsEnabled type="int">1</ProjectionsEnabled></SpatialRefSys>
 <Measure><Ellipsoid type="QString">EPSG:7030</Ellipsoid></Measure>
 <Measurement>
  <DistanceUnits type="QString">meters</DistanceUnits>
  <AreaUnits type="QString">m2</AreaUnits>
 </Measurement>
</properties>
<ProjectViewSettings UseProjectScales="0">
 <Scales/>
 <DefaultViewExtent xmin="$xmin" ymin="$ymin" xmax="$xmax" ymax="$ymax">$crs</DefaultViewExtent>
</ProjectViewSettings>
</qgis>
""")


@dataclass(frozen=True, slots=True)
class ProjectLayer:
    """A layer of a project.

    Parameters
    ----------
    name, label
        Its name in the file, and what the legend calls it.
    file
        The GeoPackage that holds it, with forward slashes, seen from the folder of the project.
    geometry
        `Point`, `LineString` or `Polygon`, in WGS 84.
    style
        How it looks.
    subset
        A filter in SQL; all features by default.
    is_shown
        Whether it is switched on at first.
    """

    name: str
    label: str
    file: str
    geometry: str
    style: Style
    subset: str = ""
    is_shown: bool = True

    @property
    def layer_id(self) -> str:
        """Its id; QGIS replaces one of ten characters or fewer."""
        return f"geofleet_{self.name}"

    @property
    def source(self) -> str:
        """The layer as OGR is asked for it."""
        return f"{self.file}|layername={self.name}" + (f"|subset={self.subset}" if self.subset else "")


def write_project(
    path: Path, layers: Sequence[ProjectLayer], *, title: str, extent_deg: tuple[float, float, float, float]
) -> None:
    """Write a project, atomically; the same layers give the same bytes.

    Parameters
    ----------
    path
        The `.qgz` to write.
    layers
        The one drawn on top first.
    title
        Of the window.
    extent_deg
        West, south, east and north of what is shown at first. Its UTM zone (EPSG, WGS 84) is the CRS of the map, so
        that scale bar and distances are in metres.
    """
    code, extent_m = _utm(extent_deg)
    crs, lonlat = _crs(code), _crs(4326)
    ids = [f"  <item>{layer.layer_id}</item>" for layer in layers]
    text = _PROJECT.substitute(
        version=_VERSION,
        title=escape(title),
        title_attribute=quoteattr(title),
        crs=crs,
        leaves="\n".join(_leaf(layer) for layer in layers),
        order="\n".join(ids),
        layers="\n".join(_map_layer(layer, lonlat) for layer in layers),
        layer_order="\n".join(f' <layer id="{layer.layer_id}"/>' for layer in layers),
        **{name: f"{value:.3f}" for name, value in zip(("xmin", "ymin", "xmax", "ymax"), extent_m, strict=True)},
    )
    entry = zipfile.ZipInfo(f"{path.stem}.qgs", _NO_TIME)
    entry.compress_type = zipfile.ZIP_DEFLATED
    entry.external_attr = 0o644 << 16
    with atomic_path(path) as draft, zipfile.ZipFile(draft, "w") as archive:
        archive.writestr(entry, text.encode())


def _leaf(layer: ProjectLayer) -> str:
    return _LEAF.substitute(
        id=quoteattr(layer.layer_id),
        label=quoteattr(layer.label),
        source=quoteattr(layer.source),
        checked="Checked" if layer.is_shown else "Unchecked",
        expanded=quoteattr("1" if len(layer.style.rules) > 1 else "0"),
    )


def _map_layer(layer: ProjectLayer, crs: str) -> str:
    return _LAYER.substitute(
        id=escape(layer.layer_id),
        kind=quoteattr(_KINDS[layer.geometry]),
        source=escape(layer.source),
        label=escape(layer.label),
        crs=crs,
        style=layer.style.elements(),
    )


def _utm(extent_deg: tuple[float, float, float, float]) -> tuple[int, tuple[float, float, float, float]]:
    """Return the EPSG code of the UTM zone in the middle of an extent, and the extent in it."""
    from pyproj import Transformer  # noqa: PLC0415

    west, south, east, north = extent_deg
    zone = min(int(((west + east) / 2 + 180.0) // 6.0) + 1, 60)
    code = (32600 if south + north >= 0 else 32700) + zone
    found = Transformer.from_crs("OGC:CRS84", code, always_xy=True).transform_bounds(west, south, east, north)
    return code, found


def _crs(code: int) -> str:
    from pyproj import CRS  # noqa: PLC0415

    return _CRS.substitute(wkt=escape(CRS.from_epsg(code).to_wkt("WKT2_2019")), code=code)
