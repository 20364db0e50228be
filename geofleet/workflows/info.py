"""What is in a file: format, place, how it came to WGS 84, what it counts, what was left out and why."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.compute as pc

from geofleet.errors import SUSPICIOUS, GeofleetError
from geofleet.formats.layers import FORMATS, read_layer
from geofleet.tables.arrays import sound_times
from geofleet.tables.schemas import BBOX, DRIVES, LANES, SIGNS
from geofleet.taxonomy.reader import RAW_PREFIX
from geofleet.workflows.anyfile import read_any
from geofleet.workflows.drive_info import DriveInfo, drives_in

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

_COUNTED = ("kind", "concept", "outcome", "fix_quality", "sensor_kind", "scenario")
_SHOWN = 12
_OWN = "geofleet"


@dataclass(frozen=True, slots=True)
class FileInfo:
    """What is in a file.

    Parameters
    ----------
    file
        Its path.
    file_format
        Short name of the format.
    table
        What its rows are: `signs`, `drives`, `detections`, or another table of geofleet.
    n_rows
        Rows read.
    crs, to_wgs84, accuracy_m
        CRS of the file, the operation that brought its positions to WGS 84, and the accuracy that the registry states
        for it, m; None when nobody states one.
    extent_deg
        West, south, east, north; None without a position.
    t_first, t_last
        First and last time in any column, UTC, ISO 8601.
    counts
        Column to value to rows, most first.
    unknown_codes
        Codes that the vocabulary does not know, with their country, and rows.
    drives
        Each drive of a file of drives.
    lanes
        Lanes or roads by kind, in a map that has some.
    found, skipped
        What else the reader tells; what it left out, and why.
    warnings
        What may be wrong, in words.
    """

    file: str
    file_format: str
    table: str
    n_rows: int
    crs: str
    to_wgs84: str
    accuracy_m: float | None
    extent_deg: tuple[float, float, float, float] | None
    t_first: str | None
    t_last: str | None
    counts: dict[str, dict[str, int]]
    unknown_codes: dict[str, int]
    drives: list[DriveInfo] = field(default_factory=list)
    lanes: dict[str, int] = field(default_factory=dict)
    found: dict[str, int] = field(default_factory=dict)
    skipped: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    def lines(self) -> list[str]:
        """Return what to tell the user, a line each: warnings first, long lists cut."""
        said = [("WARNING", warning) for warning in self.warnings]
        if self.crs:
            said += [("CRS", self.crs), ("to WGS 84", f"{self.to_wgs84}; {_accuracy(self.accuracy_m)}")]
        if self.extent_deg:
            west, south, east, north = self.extent_deg
            said.append(("extent", f"lon {west:.6f} to {east:.6f}, lat {south:.6f} to {north:.6f}"))
        if self.t_first and not self.drives:
            said.append(("time", f"{self.t_first} to {self.t_last}"))
        said += [(name, _cut(counts)) for name, counts in self.counts.items()]
        said += [("drive", line) for drive in self.drives for line in _drive_lines(drive)]
        said += [("lanes", _cut(self.lanes)), ("unknown codes", _cut(self.unknown_codes))]
        said += [("found", _cut(self.found, n_shown=None)), ("left out", _cut(self.skipped, n_shown=None))]
        what = FORMATS[self.file_format].what if self.file_format in FORMATS else self.file_format
        width = max((len(name) for name, text in said if text), default=0)
        head = f"{self.file}: {self.n_rows} {'epochs' if self.drives else self.table}, {what}"
        return [head, *(f"  {name.ljust(width)}  {text}" for name, text in said if text)]


def info(path: Path, *, table: str = "auto", **options: Any) -> FileInfo:
    """Tell what is in a file, read as `ingest` would.

    Parameters
    ----------
    path
        A map, inventory, drive, file of detections, or a table of geofleet (a folder, where it is partitioned).
    table
        `signs`, `lanes`, `drives` or `detections`, where the content does not tell; `auto`.
    options
        Of the reader: `crs`, `origin`, `utm`, `columns`, …; None means not given.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or of no known format.
    ConfigError
        An option is not for this file.
    """
    schema, layer = read_any(path, table=table, **options)
    rows = layer.table
    lanes, lane_warning = _lanes(path, layer.file_format, options) if schema is SIGNS else ({}, "")
    told = {name: n for name, n in layer.found.items() if not name.startswith(SUSPICIOUS)}
    suspicious = [f"{name}: {n}" for name, n in layer.found.items() if name.startswith(SUSPICIOUS)]
    first, last = _times(rows)
    return FileInfo(
        file=str(path),
        file_format=layer.file_format,
        table=schema.name,
        n_rows=rows.num_rows,
        crs=layer.datum.crs if schema.geometry else "",
        to_wgs84=layer.datum.to_wgs84 if schema.geometry else "",
        accuracy_m=layer.datum.accuracy_m if schema.geometry else None,
        extent_deg=_extent(rows),
        t_first=first,
        t_last=last,
        counts={name: counts for name in _counted(rows) if (counts := _counts(rows[name]))},
        unknown_codes=_unknown_codes(rows),
        drives=drives_in(rows) if schema is DRIVES else [],
        lanes=lanes,
        found=told,
        skipped=dict(layer.skipped),
        warnings=tuple(text for text in (*suspicious, layer.datum.doubt, lane_warning) if text),
    )


def _lanes(path: Path, file_format: str, options: Mapping[str, Any]) -> tuple[dict[str, int], str]:
    """Return the lanes or roads of a map by kind; why there are none where they cannot be read."""
    form = FORMATS.get(file_format)
    if form is None or file_format == _OWN:
        return {}, ""
    taken = {name: value for name, value in options.items() if name in form.options(LANES)}
    try:
        return _counts(read_layer(path, LANES, **taken).table["kind"]), ""
    except GeofleetError as error:
        return {}, f"lanes cannot be read: {error.what}"


def _counted(rows: pa.Table) -> list[str]:
    """Return the columns worth counting: of detections, which have no concept, the class."""
    names = [name for name in _COUNTED if name in rows.column_names]
    return names if names or "sign_class" not in rows.column_names else ["sign_class"]


def _counts(column: pa.ChunkedArray) -> dict[str, int]:
    counted = [(one["values"] or "unknown", one["counts"]) for one in pc.value_counts(column).to_pylist()]
    return dict(sorted(counted, key=lambda item: (-item[1], item[0])))


def _unknown_codes(rows: pa.Table) -> dict[str, int]:
    """Return the codes of rows whose concept the vocabulary does not know, with country, most first."""
    name = next((name for name in ("concept", "sign_class") if name in rows.column_names), None)
    if name is None:
        return {}
    unknown = rows.filter(pc.starts_with(rows[name], RAW_PREFIX))
    codes = [text.removeprefix(RAW_PREFIX) or "(no code)" for text in unknown[name].to_pylist()]
    lands = unknown["country"].to_pylist() if "country" in rows.column_names else [None] * len(codes)
    named = Counter(f"{land}:{code}" if land else code for land, code in zip(lands, codes, strict=True))
    return dict(sorted(named.items(), key=lambda item: (-item[1], item[0])))


def _extent(rows: pa.Table) -> tuple[float, float, float, float] | None:
    if BBOX not in rows.column_names or rows.num_rows == rows[BBOX].null_count:
        return None
    sides = {side: pc.struct_field(rows[BBOX], side) for side in ("xmin", "ymin", "xmax", "ymax")}
    low = [pc.min(sides[side]).as_py() for side in ("xmin", "ymin")]
    high = [pc.max(sides[side]).as_py() for side in ("xmax", "ymax")]
    return low[0], low[1], high[0], high[1]


def _times(rows: pa.Table) -> tuple[str | None, str | None]:
    """Return the first and the last time in any column."""
    every = [sound_times(rows[f.name]) for f in rows.schema if pa.types.is_timestamp(f.type)]
    columns = [column for column in every if column.null_count < len(rows)]
    if not columns:
        return None, None
    first, last = min(pc.min(one).as_py() for one in columns), max(pc.max(one).as_py() for one in columns)
    return first.isoformat(), last.isoformat()


def _accuracy(accuracy_m: float | None) -> str:
    return "accuracy not stated" if accuracy_m is None else f"accuracy {accuracy_m:g} m"


def _cut(counts: Mapping[str, int], *, n_shown: int | None = _SHOWN) -> str:
    """Return counts as one line; those after the first ones are summed."""
    items = [(name, n) for name, n in counts.items() if n]
    shown, rest = (items, []) if n_shown is None else (items[:n_shown], items[n_shown:])
    text = ", ".join(f"{name} {n}" for name, n in shown)
    return text + (f", {len(rest)} more {sum(n for _, n in rest)}" if rest else "")


def _drive_lines(drive: DriveInfo) -> list[str]:
    span = (
        f"{drive.duration_s:.1f} s, {drive.t_first} to {drive.t_last}" if drive.duration_s is not None else "no times"
    )
    gap = f", longest gap {drive.longest_gap_s:.1f} s" if drive.longest_gap_s is not None else ""
    return [
        f"{drive.drive_id}: {drive.n_epochs} epochs, {drive.length_m:.1f} m, {span}",
        f"{drive.drive_id}: {drive.n_segments} segments{gap}; {_cut(drive.fix_quality)}",
    ]
