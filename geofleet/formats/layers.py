"""Any layer of signs or roads named on a command line: recognised by its content, read by the module of its format."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from geofleet.errors import ConfigError, InputError
from geofleet.formats import inventory, lanelet2, lanelet2_map, opendrive, osm
from geofleet.formats.reading import LayerRead, read_head
from geofleet.tables.schemas import LANES, SIGNS, Schema
from geofleet.tables.store import read_table

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

_OWN = "geofleet"
_MARK = b"geofleet:table"


@dataclass(frozen=True, slots=True)
class LayerFormat:
    """A format: what it is called, its readers, and the options that they take."""

    what: str
    read_signs: Callable[..., LayerRead]
    read_lanes: Callable[..., LayerRead] | None = None
    sign_options: frozenset[str] = frozenset()
    lane_options: frozenset[str] = frozenset()


def _own_table(schema: Schema) -> Callable[[Path], LayerRead]:
    return lambda path: LayerRead(read_table(schema, path), _OWN)


FORMATS: Mapping[str, LayerFormat] = MappingProxyType(
    {
        _OWN: LayerFormat("a table of geofleet (.parquet)", _own_table(SIGNS), _own_table(LANES)),
        osm.FORMAT: LayerFormat(
            "OpenStreetMap (.osm.pbf, .osm, .osm.gz, .osm.bz2)", osm.read_signs, osm.read_lanes, frozenset({"roads"})
        ),
        opendrive.FORMAT: LayerFormat(
            "OpenDRIVE (.xodr)",
            opendrive.read_signs,
            opendrive.read_lanes,
            frozenset({"crs", "origin", "country"}),
            frozenset({"crs", "origin"}),
        ),
        lanelet2.FORMAT: LayerFormat(
            "Lanelet2 (.osm)",
            lanelet2.read_signs,
            lanelet2.read_lanes,
            frozenset({"origin", "utm"}),
            frozenset({"origin", "utm"}),
        ),
        inventory.FORMAT: LayerFormat(
            "a sign inventory (GeoJSON, GeoPackage, Shapefile, FlatGeobuf, GeoParquet, CSV)",
            inventory.read_signs,
            sign_options=inventory.OPTIONS | {"columns"},
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
    if head.startswith(b"PAR1"):
        return _OWN if _is_own_table(path) else inventory.FORMAT
    if opendrive.detect(head):
        return opendrive.FORMAT
    if osm.detect(head):
        return lanelet2.FORMAT if lanelet2_map.is_lanelet2(path) else osm.FORMAT
    return inventory.FORMAT if inventory.detect(head) else ""


def read_layer(path: Path, schema: Schema = SIGNS, *, file_format: str = "auto", **options: Any) -> LayerRead:
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
        what = f"unknown format {found!r}" if found else "this format is not known"
        raise InputError(f"{what}.", where=str(path), todo=f"Supported are {SUPPORTED}.")
    layer = FORMATS[found]
    reader, takes = (
        (layer.read_signs, layer.sign_options) if schema is SIGNS else (layer.read_lanes, layer.lane_options)
    )
    if reader is None:
        raise InputError(f"{layer.what} holds no {schema.name}.", where=str(path), todo="Give a map with roads.")
    given = {name: value for name, value in options.items() if value is not None}
    foreign = sorted(set(given) - takes - {"roads"})  # roads are on by default, also where there are none
    if foreign:
        raise ConfigError(
            f"--{', --'.join(foreign).replace('_', '-')} is not for {layer.what}.",
            where=str(path),
            todo=f"It takes {', '.join(f'--{name}'.replace('_', '-') for name in sorted(takes)) or 'no option'}.",
        )
    return reader(path, **{name: value for name, value in given.items() if name in takes})


def _is_own_table(path: Path) -> bool:
    """Tell whether a Parquet file is a table of geofleet; a damaged file is not, and its reader will say so."""
    try:
        return _MARK in (pq.read_metadata(path).metadata or {})
    except (pa.ArrowInvalid, OSError):
        return False
