"""What a file holds, told from its content, and its rows: a map, a drive, detections, or a table of geofleet."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from geofleet.errors import ConfigError, GeofleetError, InputError
from geofleet.formats import layers
from geofleet.formats.reading import LayerRead, content_head, read_head
from geofleet.tables.schemas import DETECTIONS, DRIVES, LANES, SCHEMAS, SIGNS
from geofleet.tables.store import read_table

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from geofleet.formats.reading import LayerStream
    from geofleet.tables.schemas import Schema

INVENTORY, CSV = "inventory", "csv"
_MARK = b"geofleet:table"
_READABLE = {schema.name: schema for schema in (SIGNS, LANES, DRIVES, DETECTIONS)}
# Only what a fleet reports has such columns; a drive has no codes
_OF_FLEETS = frozenset({"vehicle_id", "pass_id", "track_id", "n_frames", "frame_first"})
_OF_CODES = frozenset({"sign_class", "raw_code"})
_OPTIONS = {
    DRIVES.name: frozenset({"columns", "crs", "origin", "utm"}),
    DETECTIONS.name: frozenset({"columns", "crs", "scheme", "country"}),
}


def read_any(path: Path, *, table: str = "auto", **options: Any) -> tuple[Schema, LayerRead | LayerStream]:
    """Read a file of whatever kind.

    Parameters
    ----------
    path
        A map, inventory, drive, file of detections, or a table of geofleet (a folder, where it is partitioned).
    table
        `signs`, `lanes`, `drives` or `detections`, where the content does not tell; `auto`.
    options
        Of the reader; None means not given.

    Returns
    -------
    Schema of the rows, and the rows.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or of no known format.
    ConfigError
        The table is unknown, or an option is not for such a file.
    """
    own = own_schema(path)
    if own is not None:
        return own, LayerRead(read_table(own, path), "geofleet")
    if table not in {"auto", *_READABLE}:
        raise ConfigError(
            f"no file is read as {table!r}.", where="--table", todo=f"Give one of {', '.join(_READABLE)}."
        )
    kind = kind_of(path) if table == "auto" else table
    given = {name: value for name, value in options.items() if value is not None}
    if kind in _OPTIONS:
        foreign = sorted(set(given) - _OPTIONS[kind] - {"roads"})
        if foreign:
            raise ConfigError(f"--{', --'.join(foreign)} is not for {kind}.", where=str(path))
        given.pop("roads", None)
        return _READABLE[kind], _read_drive(path, given) if kind == DRIVES.name else _read_detections(path, given)
    return _READABLE[kind], layers.read_layer(path, _READABLE[kind], **given)


def own_schema(path: Path) -> Schema | None:
    """Return the schema of a table of geofleet, None for any other file.

    Raises
    ------
    InputError
        It is a folder that holds no such table.
    """
    if not path.is_dir():
        return _marked(path)
    found = next((schema for file in sorted(path.rglob("*.parquet")) if (schema := _marked(file))), None)
    if found is None:
        raise InputError("a folder that is no table of geofleet.", where=str(path), todo="Give a file, or its folder.")
    return found


def kind_of(path: Path) -> str:
    """Return what a file holds: `signs`, `drives` or `detections`.

    Raises
    ------
    InputError
        The file is missing, unreadable, empty or of no known format.
    """
    from geofleet.formats import drives  # noqa: PLC0415  (brings numba and pandas, which maps do without)

    drive = drives.detect(content_head(path))
    if drive and drive != CSV:
        return DRIVES.name
    found = layers.recognise(path)
    if found == INVENTORY:
        return _kind_of_rows(path, is_drive=bool(drive))
    if not found:
        raise InputError(
            f"{layers.unknown(path)}.",
            where=str(path),
            todo=f"Supported are {layers.SUPPORTED}; drives: {', '.join(drives.FORMATS.values())}.",
        )
    return SIGNS.name


def _kind_of_rows(path: Path, *, is_drive: bool) -> str:
    """Tell detections, drives, lanes and inventories apart by what their columns are called."""
    from geofleet.formats import drive_features  # noqa: PLC0415  (as above)
    from geofleet.formats.detection_columns import choose_columns  # noqa: PLC0415
    from geofleet.formats.detection_files import read_batches  # noqa: PLC0415

    try:
        rows = next(read_batches(path)).table
        names = rows.column_names
        chosen = choose_columns(names, {}, has_geometry=True)[0]
    except (InputError, StopIteration):  # not a format that detections come in: its own reader will say more
        return DRIVES.name if is_drive else LANES.name if _holds_lanes(path) else SIGNS.name
    if {column.name for column in LANES.columns if not column.nullable} <= set(names):
        return LANES.name
    if chosen.keys() & _OF_CODES:
        is_fleet = bool(chosen.keys() & _OF_FLEETS) and not set(SIGNS.key) <= set(names)
        if is_fleet and is_drive and _is_blank(rows, [chosen[name] for name in _OF_CODES & chosen.keys()]):
            return DRIVES.name
        return DETECTIONS.name if is_fleet else SIGNS.name
    return DRIVES.name if is_drive or drive_features.holds_drive(names) else SIGNS.name


def _is_blank(rows: pa.Table, columns: list[str]) -> bool:
    """Tell whether no row has a text in some columns: no detection is without a class."""
    return all(pc.all(pc.equal(rows[name].cast(pa.string()).fill_null(""), "")).as_py() for name in columns)


def _holds_lanes(path: Path) -> bool:
    """Tell whether a file of a GIS is a `lanes` table written before."""
    from geofleet.formats.inventory_files import read_features  # noqa: PLC0415  (as above)
    from geofleet.formats.inventory_layer import is_own_layer  # noqa: PLC0415

    try:
        return is_own_layer(read_features(path).table, LANES)
    except GeofleetError:  # its own reader will say more
        return False


def _read_drive(path: Path, options: Mapping[str, Any]) -> LayerRead:
    from geofleet.formats import drives  # noqa: PLC0415  (as above)

    return drives.read_drive(path, **options)


def _read_detections(path: Path, options: Mapping[str, Any]) -> LayerRead:
    from geofleet.formats.detections import read_detections  # noqa: PLC0415  (as above)

    skipped: Counter[str] = Counter()
    found: Counter[str] = Counter()
    read = list(read_detections(path, **options))
    for batch in read:
        skipped.update(batch.skipped)
        found.update(batch.found)
    table = pa.concat_tables([batch.table for batch in read])
    return LayerRead(table, f"detections{path.suffix}", dict(skipped), dict(found), read[0].datum)


def _marked(path: Path) -> Schema | None:
    """Return the schema that a Parquet file names."""
    if not path.is_file() or not read_head(path).startswith(b"PAR1"):
        return None
    try:
        mark = (pq.read_metadata(path).metadata or {}).get(_MARK, b"").decode(errors="replace")
    except (pa.ArrowInvalid, OSError):  # damaged: its reader will say so
        return None
    return SCHEMAS.get(mark)
