"""Rows of detections from CSV, Parquet and GDAL's formats, a batch at a time.

Memory does not grow with CSV and Parquet; other files are held as a whole.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import shapely

from geofleet.errors import InputError
from geofleet.formats.inventory_files import CRS84, detect, read_features
from geofleet.formats.reading import read_head, refuse_long_lines
from geofleet.formats.text_tables import ANSI, NOT_UTF8, encoding_of, read_header

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

BATCH_ROWS = 100_000
_BLOCK_BYTES = 8 << 20
_SAMPLE_BYTES = 1 << 20
_GEOMETRY_NAMES = ("geometry", "geom", "wkb_geometry")
_AGAIN = "Fetch or export it again."


@dataclass(frozen=True, slots=True)
class Batch:
    """Some rows of a file.

    Parameters
    ----------
    table
        Attributes, without the geometry.
    geometry
        Geometries, None where there is none, shape (n,); None for plain rows.
    crs
        As pyproj takes it; None when the file does not say.
    first_row
        Number of the first row, counted from 1 in the file.
    broken
        Number and text of lines that have more or fewer fields than the header.
    notes
        What is to be told of the file.
    """

    table: pa.Table
    geometry: NDArray[np.object_] | None
    crs: Any
    first_row: int
    broken: tuple[tuple[int, str], ...] = field(default=())
    notes: tuple[str, ...] = field(default=())


def read_batches(path: Path) -> Iterator[Batch]:
    """Yield the rows of a file.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or of another format.
    """
    found = detect(read_head(path))
    readers = {"csv": _csv_batches, "parquet": _parquet_batches}
    if not found:
        raise InputError(
            "no format of detections.",
            where=str(path),
            todo="Give CSV, GeoJSON, GeoPackage, FlatGeobuf, Shapefile or (Geo)Parquet, with a position a row.",
        )
    try:
        yield from readers.get(found, _feature_batches)(path)
    except (pa.ArrowException, OSError, ValueError, KeyError, shapely.GEOSException) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"damaged or not {found} ({reason[:300]}).", where=str(path), todo=_AGAIN) from None


def _csv_batches(path: Path) -> Iterator[Batch]:
    from pyarrow import csv as arrow_csv  # noqa: PLC0415  (only CSV needs it)

    refuse_long_lines(path)
    encoding = encoding_of(path)  # of all of it: PyArrow cannot say what is wrong with a line that it cannot decode
    header = read_header(path, encoding)
    if _is_one_line(path):
        return
    broken: list[tuple[int, str]] = []

    def keep(row: Any) -> str:
        broken.append((int(row.number or 0) - 1, str(row.text)[:1000]))
        return "skip"

    # Text, all of it: as numbers 274.10 and 0205 would lose what tells them apart
    reader = arrow_csv.open_csv(
        path,
        read_options=arrow_csv.ReadOptions(
            encoding=encoding, block_size=_BLOCK_BYTES, use_threads=False, skip_rows=header.n_before
        ),
        parse_options=arrow_csv.ParseOptions(delimiter=header.delimiter, invalid_row_handler=keep),
        convert_options=arrow_csv.ConvertOptions(column_types=dict.fromkeys(header.names, pa.string())),
    )
    first = 1
    notes = (NOT_UTF8,) if encoding == ANSI else ()
    for block in reader:
        lost, broken[:] = tuple(broken), []
        yield Batch(pa.Table.from_batches([block]), None, None, first, lost, notes)
        first += block.num_rows + len(lost)
    if broken:
        yield Batch(reader.schema.empty_table(), None, None, first, tuple(broken), notes)


def _parquet_batches(path: Path) -> Iterator[Batch]:
    import pyarrow.parquet as pq  # noqa: PLC0415  (only Parquet needs it)

    with pq.ParquetFile(path) as file:
        name, crs, dropped = _geometry_of(file.schema_arrow)
        first = 1
        for block in file.iter_batches(batch_size=BATCH_ROWS, use_threads=False):
            block.validate(full=True)  # text that is not UTF-8 would be found anywhere later
            table = pa.Table.from_batches([block]).replace_schema_metadata(None)
            geometry = None
            if name:
                wkb = table[name].cast(pa.binary()).to_numpy(zero_copy_only=False)
                geometry = np.asarray(shapely.from_wkb(wkb, on_invalid="ignore"), object)
            yield Batch(table.drop_columns(dropped), geometry, crs, first)
            first += block.num_rows


def _geometry_of(schema: pa.Schema) -> tuple[str, Any, list[str]]:
    """Return the column of WKB and its CRS, and what columns hold geometry and bounding boxes."""
    raw = (schema.metadata or {}).get(b"geo")
    if raw is None:
        found = [n for n in _GEOMETRY_NAMES if n in schema.names and pa.types.is_binary(schema.field(n).type)]
        return (found[0] if found else ""), None, found[:1]
    geo = json.loads(raw)
    name = geo["primary_column"]
    about = geo["columns"][name]
    if about["encoding"] != "WKB":
        raise ValueError(f"geometries are encoded as {about['encoding']}, not as WKB")
    crs = about.get("crs", CRS84)  # absent means CRS84, null means unknown
    if isinstance(crs, dict):
        from pyproj import CRS  # noqa: PLC0415  (takes a moment to load)
        from pyproj.exceptions import CRSError  # noqa: PLC0415

        try:
            crs = CRS.from_json_dict(crs).to_wkt()
        except CRSError as error:
            raise ValueError(f"its CRS cannot be read: {str(error)[:100]}") from None
    covering = [side[0] for side in about.get("covering", {}).get("bbox", {}).values()]
    return name, crs, [n for n in dict.fromkeys([*geo["columns"], *covering]) if n in schema.names]


def _feature_batches(path: Path) -> Iterator[Batch]:
    features = read_features(path)
    features.table.validate(full=True)  # as above
    for first in range(0, features.table.num_rows, BATCH_ROWS):
        shapes = None if features.geometry is None else features.geometry[first : first + BATCH_ROWS]
        yield Batch(features.table.slice(first, BATCH_ROWS), shapes, features.crs, first + 1)


def _is_one_line(path: Path) -> bool:
    """Tell whether a file holds a header and no row, which Arrow takes for a fault."""
    with path.open("rb") as file:
        return not file.readline() or not file.read(_SAMPLE_BYTES).strip()
