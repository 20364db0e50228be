"""Any layer of signs, or of roads and lanes, in another format."""

from __future__ import annotations

from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from geofleet.errors import ConfigError
from geofleet.formats.layers import read_layer
from geofleet.tables.schemas import LANES, SIGNS
from geofleet.tables.store import write_table

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from pathlib import Path

    import pyarrow as pa

    from geofleet.tables.schemas import Schema

    Writer = Callable[[Schema, pa.Table, Path], None]

TABLES: Mapping[str, Schema] = MappingProxyType({schema.name: schema for schema in (SIGNS, LANES)})


@dataclass(frozen=True, slots=True)
class ConvertResult:
    """What a conversion wrote.

    Parameters
    ----------
    out
        File written.
    table
        `signs` or `lanes`.
    n_rows
        Rows written.
    file_format
        Format of the input.
    found, skipped
        What its reader tells.
    """

    out: Path
    table: str
    n_rows: int
    file_format: str
    found: dict[str, int]
    skipped: dict[str, int]


def convert(
    source: Path, out: Path, *, table: str = SIGNS.name, file_format: str = "auto", **options: Any
) -> ConvertResult:
    """Write the signs, or the roads and lanes, of a file in the format that the suffix of another one names.

    Ids, classes, values, facings, times and nulls stay, positions too: reading the signs back gives the same table. In
    OpenStreetMap's formats the tags say what its own grammar can, and `geofleet:` tags hold the rest.

    Parameters
    ----------
    source
        Any file that `geofleet.formats.layers.read_layer` reads.
    out
        File to write; its suffix is .parquet, .geojson, .gpkg, .fgb, .osm or .osc.
    table
        `signs` or `lanes`.
    file_format, options
        Of the reader.

    Raises
    ------
    ConfigError
        The suffix or the table is unknown, or an option is not for the format of the source.
    InputError
        The source is missing, damaged or in no known format, or the format to write cannot hold a text of it.
    """
    write = layer_writer(out)
    if table not in TABLES:
        raise ConfigError(f"there is no table {table!r} to convert.", todo=f"Tables are {', '.join(TABLES)}.")
    schema = TABLES[table]
    layer = read_layer(source, schema, file_format=file_format, **options)
    rows = layer.table
    write(schema, rows, out)
    return ConvertResult(out, table, rows.num_rows, layer.file_format, dict(layer.found), dict(layer.skipped))


def layer_writer(out: Path) -> Writer:
    """Return what writes layers to files of a suffix.

    Raises
    ------
    ConfigError
        The suffix is unknown.
    """
    from geofleet.formats import osm_write, vector_write  # noqa: PLC0415  (a bad option is told without them)

    writers: dict[str, Writer] = {
        ".parquet": write_table,
        ".geojson": vector_write.write_geojson_layer,
        ".gpkg": vector_write.write_geopackage_layer,
        ".fgb": vector_write.write_flatgeobuf_layer,
        ".osm": osm_write.write_osm,
        ".osc": osm_write.write_osc,
    }
    if out.suffix.lower() not in writers:
        raise ConfigError(
            f"{out.suffix or 'no suffix'} is no format to write.",
            where=str(out),
            todo=f"Give a name that ends in {', '.join(writers)}.",
        )
    return writers[out.suffix.lower()]
