"""Any layer or drive named on a command line: recognised by its content, read by the module of its format."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from geofleet.errors import ConfigError, InputError
from geofleet.formats import osm
from geofleet.formats.foreign import refuse_foreign
from geofleet.formats.osm_value import is_own_osm
from geofleet.formats.reading import (
    BZIP2,
    GZIP,
    ZIP,
    LayerRead,
    LayerStream,
    is_packed,
    read_head,
    unpacked,
    unpacked_head,
)
from geofleet.formats.xml import root_tag
from geofleet.tables.schemas import DRIVES, LANES, SIGNS, Schema
from geofleet.tables.store import read_table

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

_OWN, _OWN_OSM, _OPENDRIVE, _LANELET2, _INVENTORY = "geofleet", "geofleet-osm", "opendrive", "lanelet2", "inventory"
_MARK = b"geofleet:table"


@dataclass(frozen=True, slots=True)
class LayerFormat:
    """A format: what it is called, the module that reads it, and the options that its readers take.

    The module is imported when a file of the format is read: no map pays for what another one needs.
    """

    what: str
    module: str
    sign_options: frozenset[str] = frozenset()
    lane_options: frozenset[str] = frozenset()

    def reader(self, schema: Schema) -> Callable[..., LayerRead | LayerStream]:
        """Return the function that reads a table of this format."""
        read: Callable[..., LayerRead | LayerStream] = getattr(
            import_module(f"geofleet.formats.{self.module}"), f"read_{schema.name}"
        )
        return read

    def options(self, schema: Schema) -> frozenset[str]:
        """Return the names of the options that the reader takes."""
        if self.module == "inventory" and schema is SIGNS:
            return frozenset({"columns", *import_module("geofleet.formats.inventory").OPTIONS})
        return self.sign_options if schema is SIGNS else self.lane_options


FORMATS: Mapping[str, LayerFormat] = MappingProxyType(
    {
        _OWN: LayerFormat("a table of geofleet (.parquet)", "layers"),
        _OWN_OSM: LayerFormat("signs that geofleet wrote as OpenStreetMap XML (.osm, .osc)", "osm_layer"),
        osm.FORMAT: LayerFormat(
            "OpenStreetMap (.osm.pbf, .osm, Overpass .json; .gz, .bz2)", "osm", sign_options=frozenset({"roads"})
        ),
        _OPENDRIVE: LayerFormat(
            "OpenDRIVE (.xodr)",
            "opendrive",
            sign_options=frozenset({"crs", "origin", "country"}),
            lane_options=frozenset({"crs", "origin"}),
        ),
        _LANELET2: LayerFormat(
            "Lanelet2 (.osm)",
            "lanelet2",
            sign_options=frozenset({"origin", "utm"}),
            lane_options=frozenset({"origin", "utm"}),
        ),
        _INVENTORY: LayerFormat(
            "a sign inventory (GeoJSON, Esri JSON, GeoPackage, Shapefile, FlatGeobuf, GeoParquet, CSV)",
            "inventory",
        ),
    }
)
SUPPORTED = "; ".join(f"{name}: {layer.what}" for name, layer in FORMATS.items())


def recognise(path: Path) -> str:
    """Return the format of a layer by its content, or "" when it is none of ours.

    Raises
    ------
    InputError
        The file is missing, unreadable or empty.
    """
    head = read_head(path)
    if head.startswith(ZIP) and is_packed(path):
        with unpacked(path) as plain:
            return recognise(plain)
    if head.startswith(b"PAR1"):
        return _OWN if _is_own_table(path) else _INVENTORY
    refuse_foreign(path)
    if root_tag(unpacked_head(path) if head.startswith((GZIP, BZIP2)) else head) == "OpenDRIVE":
        return _OPENDRIVE
    return _recognise_map(path, head) or (_INVENTORY if _is_inventory(head) else "")


def _recognise_map(path: Path, head: bytes) -> str:
    """Return the format of a map in one of OpenStreetMap's encodings, or of an inventory packed as they are, or ""."""
    encoding = osm.detect(head)
    if encoding in {"osm.gz", "osm.bz2"} and _is_inventory(unpacked_head(path)):
        return _INVENTORY
    if encoding == "osm" and is_own_osm(head):
        return _OWN_OSM
    if encoding in {"osm", "osm.gz", "osm.bz2"}:
        return _LANELET2 if import_module("geofleet.formats.lanelet2_map").is_lanelet2(path) else osm.FORMAT
    return osm.FORMAT if encoding else ""


def _is_inventory(head: bytes) -> bool:
    """Tell whether a file's first bytes are an inventory's, packed with nothing."""
    return not osm.detect(head) and bool(import_module("geofleet.formats.inventory").detect(head))


def unknown(path: Path) -> str:
    """Say what a file is that no reader takes."""
    head = read_head(path).lower()
    if b"<kml" in head or b"<gml:" in head:
        kind = "KML" if b"<kml" in head else "GML"
        return f"{kind}, which is not read; `ogr2ogr signs.geojson {path.name}` of GDAL converts it"
    is_page = b"<html" in head or b"<!doctype html" in head
    return "a web page, such as a server sends in place of data" if is_page else "this format is not known"


def read_signs(path: Path) -> LayerRead:
    """Read a `signs` table of our own."""
    return LayerRead(read_table(SIGNS, path), _OWN)


def read_lanes(path: Path) -> LayerRead:
    """Read a `lanes` table of our own."""
    return LayerRead(read_table(LANES, path), _OWN)


def read_layer(
    path: Path, schema: Schema = SIGNS, *, file_format: str = "auto", **options: Any
) -> LayerRead | LayerStream:
    """Read the signs, or the roads and lanes, of a file.

    Parameters
    ----------
    path
        Any file of a format in `FORMATS`.
    schema
        `SIGNS` or `LANES`.
    file_format
        `auto`, or the name of the format.
    options
        Those of the reader; None means not given.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or of no known format.
    ConfigError
        An option is not for this format.
    """
    found = recognise(path) if file_format == "auto" else file_format
    if found not in FORMATS:
        what = f"unknown format {found!r}" if found else unknown(path)
        raise InputError(f"{what}.", where=str(path), todo=f"Supported are {SUPPORTED}.")
    layer = FORMATS[found]
    given = {name: value for name, value in options.items() if value is not None}
    takes = layer.options(schema)
    foreign = sorted(set(given) - takes - {"roads"})  # roads are on by default, also where there are none
    if foreign:
        raise ConfigError(
            f"--{', --'.join(foreign).replace('_', '-')} is not for {layer.what}.",
            where=str(path),
            todo=f"It takes {', '.join(f'--{name}'.replace('_', '-') for name in sorted(takes)) or 'no option'}.",
        )
    read, taken = layer.reader(schema), {name: value for name, value in given.items() if name in takes}
    if is_packed(path) and (found == _INVENTORY or read_head(path).startswith(ZIP)):
        with unpacked(path) as plain:
            return read(plain, **taken)
    return read(path, **taken)


def read_drives(path: Path) -> LayerRead:
    """Read a `drives` table of our own, or a trajectory of any format as one.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or of no known format.
    """
    if read_head(path).startswith(b"PAR1") and _is_own_table(path):
        return LayerRead(read_table(DRIVES, path), _OWN)
    read: LayerRead = import_module("geofleet.formats.drives").read_drive(path)
    return read


def _is_own_table(path: Path) -> bool:
    """Tell whether a Parquet file is a table of geofleet; a damaged file is not, and its reader will say so."""
    try:
        return _MARK in (pq.read_metadata(path).metadata or {})
    except (pa.ArrowException, OSError, ValueError):
        return False
