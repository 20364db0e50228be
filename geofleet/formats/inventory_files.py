"""Rows and geometry of a vector or table file: GDAL's formats through pyogrio, Parquet and CSV through Arrow.

The format is told from the content, and GDAL is asked for that one driver: no file can make it open another file.
"""

from __future__ import annotations

import codecs
import json
import re
import warnings
import zipfile
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import shapely

from geofleet.errors import ConfigError, InputError
from geofleet.formats import json_records
from geofleet.formats.osm_tags import is_sign_key
from geofleet.formats.reading import read_head
from geofleet.formats.text_tables import ANSI, NOT_UTF8, encoding_of, read_header, text_of_head

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

CRS84 = "OGC:CRS84"
_ZIP, _SQLITE, _SHP, _FGB, _PARQUET = b"PK\x03\x04", b"SQLite format 3\0", b"\x00\x00\x27\x0a", b"fgb\x03", b"PAR1"
_MARKS = {_SQLITE: "gpkg", _SHP: "shapefile", _FGB: "flatgeobuf", _PARQUET: "parquet", _ZIP: "shapefile.zip"}
_SEQUENCE = re.compile(rb'(?:\x1e|\s*\{[^\n]*"Feature"[^\n]*\}\s*\n\s*\{)')
_GEOJSON_TYPE = re.compile(rb'"type"\s*:\s*"(?:Feature|GeometryCollection|(?:Multi)?(?:Point|Line|Poly))')
_ESRI = re.compile(rb'"geometryType"\s*:\s*"esriGeometry')
_CRS_NAME = re.compile(
    rb'"crs"\s*:\s*\{\s*(?:"type"\s*:\s*"([a-z]+)"\s*,\s*)?"properties"\s*:\s*\{\s*"\w+"\s*:\s*"([^"]*)"'
)
_DRIVERS = {"geojson": "GeoJSON:", "geojsonseq": "GeoJSONSeq:", "esrijson": "ESRIJSON:"}
_SUFFIXES = {"gpkg": ".gpkg", "flatgeobuf": ".fgb", "shapefile": ".shp"}  # where no prefix names the driver
# Dates stay text: GDAL reads 1/2/2022 by its own rule, which the user cannot override
_OPEN_OPTIONS = {"geojson": {"DATE_AS_STRING": "YES"}, "geojsonseq": {"DATE_AS_STRING": "YES"}}
_MAX_UNPACKED_BYTES = 4 << 30
_CSV_BLOCK_BYTES = 16 << 20
_TAGS = frozenset({"direction", "highway", "maxspeed", "city_limit", "traffic_signals:direction"})
_GEOMETRY_NAMES = ("geometry", "geom", "wkb_geometry")
_AGAIN = "Fetch or export it again."


@dataclass(frozen=True, slots=True)
class Features:
    """The rows of a file.

    Parameters
    ----------
    table
        Attributes, without the geometry.
    geometry
        Geometries, None where there is none, shape (n,); None for a file of plain rows.
    crs
        As pyproj takes it; None when the file does not say.
    file_format
        Short name.
    skipped, found
        What was left out and why; what else is worth telling.
    """

    table: pa.Table
    geometry: NDArray[np.object_] | None
    crs: Any
    file_format: str
    skipped: dict[str, int] = field(default_factory=dict)
    found: dict[str, int] = field(default_factory=dict)


def detect(head: bytes) -> str:
    """Return the short name of the format that a file's first bytes show; text that is no JSON is taken for CSV.

    "" for anything else.
    """
    for mark, name in _MARKS.items():
        if head.startswith(mark):
            return name
    is_utf16 = head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    text = (text_of_head(head).encode() if is_utf16 else head.removeprefix(codecs.BOM_UTF8)).lstrip()
    if _SEQUENCE.match(text):
        return "geojsonseq"
    if json_records.detect(text):
        return "json"
    if text.startswith((b"{", b"[")):
        return "esrijson" if _ESRI.search(text) else "geojson"
    if text.startswith(b"<") or (b"\0" in head and not is_utf16):
        return ""
    return "csv" if text else ""


def read_features(
    path: Path, *, layer: str | None = None, encoding: str | None = None, delimiter: str | None = None
) -> Features:
    """Read all rows of a file.

    Parameters
    ----------
    path
        GeoJSON, GeoJSON text sequence, Esri JSON, GeoPackage, Shapefile or a zip of one, FlatGeobuf, (Geo)Parquet,
        CSV, or rows as JSON.
    layer
        Layer of a GeoPackage or zip; by default the only one with geometry.
    encoding, delimiter
        Of a CSV file; by default UTF-8, else Windows-1252, and what its header shows.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or of another format.
    """
    found = detect(read_head(path))
    try:
        if found == "csv":
            return _read_csv(path, encoding, delimiter)
        if found == "parquet":
            return _read_parquet(path)
        if found == "json":
            return Features(json_records.read_records(path), None, None, found)
        if found:
            return _read_gdal(path, found, layer)
    except (
        pa.ArrowException,
        OSError,
        ValueError,
        KeyError,
        OverflowError,
        MemoryError,
        shapely.GEOSException,
    ) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"damaged or not {found} ({reason[:300]}).", where=str(path), todo=_AGAIN) from None
    raise InputError(
        "no format of an inventory.",
        where=str(path),
        todo="Give GeoJSON, Esri JSON, GeoPackage, Shapefile, FlatGeobuf, GeoParquet or CSV.",
    )


def _read_gdal(path: Path, found: str, layer: str | None) -> Features:
    import pyogrio  # noqa: PLC0415  (loads GDAL, which only these formats need)

    _check_name(path, found)
    source = _zipped_shapefile(path) if found == "shapefile.zip" else _DRIVERS.get(found, "") + str(path.resolve())
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            layer, n_others = _layer(source, path, layer)
            meta, table = pyogrio.read_arrow(source, layer=layer, **_OPEN_OPTIONS.get(found, {}))
        except (InputError, ConfigError):
            raise
        except Exception as error:  # noqa: BLE001  (a damaged file makes the binding fail in any way, even by NameError)
            raise _damaged(path, found, str(error)) from None
    name = meta["geometry_name"] or "wkb_geometry"
    notes = {f"GDAL warned: {str(warning.message)[:200]}": 1 for warning in told}
    if n_others:
        notes["layers not read"] = n_others
    if name not in table.column_names:
        return Features(table, None, None, found, {}, notes)
    crs = meta["crs"]
    if found in {"geojson", "geojsonseq"}:
        crs = _geojson_crs(path) or CRS84
    geometry = shapely.from_wkb(table[name].to_numpy(zero_copy_only=False), on_invalid="ignore")
    attributes = _with_tags(table.drop_columns([name]))
    return Features(attributes, np.asarray(geometry, object), crs, found, {}, notes)


def _with_tags(table: pa.Table) -> pa.Table:
    """Return rows of OpenStreetMap whose tags stand as JSON in a column `tags` with a column for each tag of a sign."""
    if "tags" not in table.column_names or getattr(table["tags"].type, "extension_name", "") != "arrow.json":
        return table
    tags = [_tags(text) for text in table["tags"].cast(pa.string()).to_pylist()]
    for key in sorted({key for one in tags for key in one} - set(table.column_names)):
        table = table.append_column(key, pa.array([one.get(key) for one in tags], pa.string()))
    return table


def _tags(text: str | None) -> dict[str, str]:
    """Return the tags in a text that tell of a sign."""
    try:
        found = json.loads(text or "{}")
    except ValueError:
        return {}
    kept = found.items() if isinstance(found, dict) else ()
    return {key: str(value) for key, value in kept if is_sign_key(key) or key in _TAGS}


def _damaged(path: Path, found: str, reason: str) -> InputError:
    """Return why GDAL could not read a file."""
    head = read_head(path)
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return InputError("GeoJSON in UTF-16, which nobody reads.", where=str(path), todo="Save it as UTF-8.")
    if found == "geojson" and not _GEOJSON_TYPE.search(head):
        return InputError(
            "JSON, but no GeoJSON: it does not begin with features.",
            where=str(path),
            todo="Export it as GeoJSON (ArcGIS: f=geojson), or as CSV.",
        )
    return InputError(f"damaged or not {found} ({reason[:300]}).", where=str(path), todo=_AGAIN)


def _check_name(path: Path, found: str) -> None:
    """Refuse a name that GDAL, which goes by it, would take for that of another format."""
    suffix = _SUFFIXES.get(found, "")
    if suffix and path.suffix.lower() != suffix:
        raise InputError(f"the content is {found}, the name is not.", where=str(path), todo=f"Rename it to …{suffix}.")


def _zipped_shapefile(path: Path) -> str:
    """Return the one Shapefile in a zip, refusing one that unpacks to more than `_MAX_UNPACKED_BYTES`."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
    except (zipfile.BadZipFile, NotImplementedError) as error:
        raise InputError(f"damaged zip file ({error}).", where=str(path), todo=_AGAIN) from None
    if sum(entry.file_size for entry in entries) > _MAX_UNPACKED_BYTES:
        raise InputError(
            f"the zip file unpacks to more than {_MAX_UNPACKED_BYTES >> 30} GiB.", where=str(path), todo="Unpack it."
        )
    names = [e.filename for e in entries if e.filename.lower().endswith(".shp") and "__MACOSX" not in e.filename]
    if len(names) != 1:
        raise InputError(
            f"the zip file holds {len(names)} Shapefiles, not one.",
            where=str(path),
            todo="Unpack it and give the file.",
        )
    return f"/vsizip/{{{path.resolve()}}}/{names[0]}"


def _layer(source: str, path: Path, layer: str | None) -> tuple[str, int]:
    """Return the layer to read and how many others there are."""
    import pyogrio  # noqa: PLC0415  (as above)

    layers = [(str(name), kind) for name, kind in pyogrio.list_layers(source)]
    names = [name for name, _ in layers]
    if layer is not None:
        if layer not in names:
            raise ConfigError(f"there is no layer {layer!r}.", where=str(path), todo=f"Layers are {', '.join(names)}.")
        return layer, len(names) - 1
    spatial = [name for name, kind in layers if kind]
    if len(spatial) > 1:
        raise InputError(
            f"the file has {len(spatial)} layers: {', '.join(spatial)[:300]}.",
            where=str(path),
            todo=f"Name one: --layer {spatial[0]!r}.",
        )
    if not names:
        raise InputError("the file has no layer.", where=str(path), todo=_AGAIN)
    return (spatial or names)[0], len(names) - 1


def _geojson_crs(path: Path) -> str:
    """Return the CRS that a GeoJSON file names, "" without one; GDAL takes a name it does not know for degrees."""
    from pyproj import CRS  # noqa: PLC0415  (takes a moment to load)
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    match = _CRS_NAME.search(read_head(path)) or _CRS_NAME.search(_tail(path))
    if not match:
        return ""
    kind, name = (match[1] or b"name").decode(), match[2].decode("utf-8", "replace")
    if name.upper().rstrip("/") in {"", "URN:OGC:DEF:CRS:OGC:1.3:CRS84"}:
        return ""
    try:
        if kind == "name":
            return str(CRS.from_user_input(name).to_wkt())
    except CRSError:
        pass
    raise InputError(f"the file names a CRS that cannot be used: {name[:80]!r}.", where=str(path), todo="Give --crs.")


def _tail(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(max(path.stat().st_size - 4096, 0))
        return file.read()


def _read_parquet(path: Path) -> Features:
    import pyarrow.parquet as pq  # noqa: PLC0415  (only Parquet needs it)

    table = pq.ParquetFile(path).read()
    raw = (table.schema.metadata or {}).get(b"geo")
    plain = table.replace_schema_metadata(None)
    if raw is None:
        return _with_wkb(Features(plain, None, None, "parquet"))
    try:
        geo = json.loads(raw)
        name = geo["primary_column"]
        about, encoding = geo["columns"][name], geo["columns"][name]["encoding"]
        plain[name]
    except (ValueError, KeyError, TypeError) as error:
        reason = f"it lacks {error}" if isinstance(error, KeyError) else error
        raise InputError(f"its geo metadata is damaged ({reason}).", where=str(path), todo=_AGAIN) from None
    if encoding == "WKB":
        geometry = shapely.from_wkb(plain[name].to_numpy(zero_copy_only=False), on_invalid="ignore")
    else:
        import geopandas  # noqa: PLC0415  (only the rare native encodings need it)

        geometry = np.asarray(geopandas.read_parquet(path, columns=[name]).geometry.array)
    crs = about.get("crs", CRS84)  # absent means CRS84, null means unknown
    others = [
        column for column, kind in geo["columns"].items() if column != name and column in plain.column_names and kind
    ]
    covering = [side[0] for side in about.get("covering", {}).get("bbox", {}).values()]
    dropped = [column for column in dict.fromkeys([name, *others, *covering]) if column in plain.column_names]
    return Features(plain.drop_columns(dropped), np.asarray(geometry, object), _parquet_crs(crs, path), "geoparquet")


def _parquet_crs(crs: Any, path: Path) -> Any:
    from pyproj import CRS  # noqa: PLC0415  (takes a moment to load)
    from pyproj.exceptions import CRSError  # noqa: PLC0415

    try:
        return CRS.from_json_dict(crs).to_wkt() if isinstance(crs, dict) else crs
    except CRSError as error:
        raise InputError(
            f"the CRS of the file cannot be used ({error}).", where=str(path), todo="Give --crs."
        ) from None


def _with_wkb(features: Features) -> Features:
    """Take a column of WKB for the geometry of a Parquet file that does not describe it, and nested columns apart."""
    binary = [f.name for f in features.table.schema if pa.types.is_binary(f.type) or pa.types.is_large_binary(f.type)]
    for name in sorted(binary, key=lambda name: name not in _GEOMETRY_NAMES):
        wkb = features.table[name].to_numpy(zero_copy_only=False)
        geometry = np.asarray(shapely.from_wkb(wkb, on_invalid="ignore"), object)
        if not shapely.is_missing(geometry).all() or name in _GEOMETRY_NAMES:
            return replace(features, table=features.table.drop_columns([name]), geometry=geometry)
    return replace(features, table=features.table.flatten())


def _read_csv(path: Path, encoding: str | None, delimiter: str | None) -> Features:
    from pyarrow import csv as arrow_csv  # noqa: PLC0415  (only CSV needs it)

    notes = {}
    if not encoding:
        encoding = encoding_of(path)
        notes = {NOT_UTF8: 1} if encoding == ANSI else {}
    header = read_header(path, encoding, delimiter)
    bad: list[int] = []

    def count(row: Any) -> str:
        bad.append(row.actual_columns)
        is_open = (row.text or "").count('"') % 2  # a quote never closed makes one row of all that follow
        return "error" if is_open else "skip"

    table = arrow_csv.read_csv(
        path,
        read_options=arrow_csv.ReadOptions(
            encoding=encoding, block_size=_CSV_BLOCK_BYTES, use_threads=False, skip_rows=header.n_before
        ),
        parse_options=arrow_csv.ParseOptions(
            delimiter=header.delimiter, newlines_in_values=True, invalid_row_handler=count
        ),
        # Text, all of it: as numbers 274.10 and 0205 would lose what tells them apart
        convert_options=arrow_csv.ConvertOptions(column_types=dict.fromkeys(header.names, pa.string())),
    )
    skipped = {"rows with another number of columns than the header": len(bad)} if bad else {}
    return Features(table, None, None, "csv", skipped, notes)
