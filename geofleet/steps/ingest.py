"""Files from outside to tables: sign maps to `signs`, roads to `lanes`, trajectories to `drives`.

The format of a file is recognised by its content. A table is written when every input has been read, or not at all.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.errors import SUSPICIOUS, ConfigError, InputError
from geofleet.formats import layers
from geofleet.formats.reading import LayerStream
from geofleet.tables.manifest import Hashing, write_manifest
from geofleet.tables.schemas import BBOX, DRIVES, LANES, SIGNS
from geofleet.tables.store import lonlat, sort_by_key, write_pieces

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from geofleet.formats.reading import LayerRead
    from geofleet.tables.schemas import Schema

    Progress = Callable[[int, int], None]
    Reader = Callable[[Path], LayerRead | LayerStream]

_FAR_M = 100_000.0
_GLOBAL_IDS = frozenset({"osm", "geofleet"})


@dataclass(frozen=True, slots=True)
class IngestResult:
    """What an ingest wrote.

    Parameters
    ----------
    table
        Name of the table.
    out
        File written.
    n_rows
        Rows written.
    by_kind
        Rows of each kind (signs), road class (lanes) or fix quality (drives), most first.
    found
        Other counts: unknown codes, gaps, ….
    skipped
        Reason to number of items left out.
    inputs
        Format of each input by its path.
    """

    table: str
    out: Path
    n_rows: int
    by_kind: dict[str, int]
    found: dict[str, int]
    skipped: dict[str, int]
    inputs: dict[str, str]

    def summary(self) -> list[str]:
        """Return what to tell the user, a line each."""
        lines = [f"{self.out}: {self.n_rows} {self.table} from {', '.join(self.inputs)}"]
        told = (("", self.by_kind), ("", self.found), ("left out: ", self.skipped))
        return lines + [f"  {head}{_told(counts)}" for head, counts in told if any(counts.values())]


def ingest_signs(
    inputs: Sequence[Path],
    out: Path,
    *,
    file_format: str = "auto",
    roads: bool = True,
    progress: Progress | None = None,
    **options: Any,
) -> IngestResult:
    """Read sign maps into one `signs` table.

    Parameters
    ----------
    inputs
        Files, each in a format of `geofleet.formats.layers.FORMATS`.
    out
        Parquet file to write.
    file_format
        `auto`, or the name of the format of all inputs.
    roads
        Take road and, where the map does not say, facing from the nearest drivable way (OpenStreetMap).
    progress
        Called with files done and in all.
    options
        Those of the format's reader, e.g. `crs`, `origin`, `utm`, `columns`, `scheme`, `country`.

    Raises
    ------
    InputError
        There is no input, or one is missing, damaged or in no known format; nothing is written.
    ConfigError
        An option is not for the format of an input.
    """
    plan = _plan_layers(inputs, SIGNS, file_format=file_format, roads=roads, **options)
    return _ingest(SIGNS, "kind", plan, out, progress=progress, settings=_plain({"roads": roads, **options}))


def ingest_lanes(
    inputs: Sequence[Path], out: Path, *, file_format: str = "auto", progress: Progress | None = None, **options: Any
) -> IngestResult:
    """Read drivable roads and lanes into one `lanes` table; parameters and errors as `ingest_signs`."""
    plan = _plan_layers(inputs, LANES, file_format=file_format, **options)
    return _ingest(LANES, "kind", plan, out, progress=progress, settings=_plain(options))


def _plan_layers(
    inputs: Sequence[Path], schema: Schema, *, file_format: str, **options: Any
) -> list[tuple[Path, str, Reader]]:
    """Return path, format and reader of each input; every file is looked at before the first is read."""
    if not inputs:
        raise InputError("no input file is named.", todo=f"Supported are {layers.SUPPORTED}.")
    if file_format not in {"auto", *layers.FORMATS}:
        raise ConfigError(
            f"unknown format {file_format!r}.", where="--format", todo=f"Supported are auto; {layers.SUPPORTED}."
        )
    paths = [Path(path) for path in inputs]
    found = [layers.recognise(path) if file_format == "auto" else file_format for path in paths]
    reader = partial(layers.read_layer, schema=schema, **options)
    return [(path, name, partial(reader, file_format=name or "auto")) for path, name in zip(paths, found, strict=True)]


def _plain(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that were given as what JSON can hold."""
    return {
        name: dict(v) if isinstance(v, Mapping) else str(v) if isinstance(v, Path) else v
        for name, v in options.items()
        if v is not None
    }


def ingest_drive(
    inputs: Sequence[Path],
    out: Path,
    *,
    file_format: str = "auto",
    columns: Mapping[str, str] | Path | None = None,
    crs: str | None = None,
    origin: tuple[float, float] | None = None,
    utm: tuple[str, float, float] | None = None,
    progress: Progress | None = None,
) -> IngestResult:
    """Read trajectories, one drive a file, into one `drives` table; other parameters and errors as `ingest_signs`.

    Parameters
    ----------
    columns, crs, origin, utm
        Of a CSV file, as in `formats.drive_csv.read_epochs`; with any of them a file of unknown kind is read as CSV.
    """
    from geofleet.formats import drives  # noqa: PLC0415  (brings numba and pandas, which maps do without)

    given = {"columns": columns, "crs": crs, "origin": origin, "utm": utm}
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}

    def reader(name: str) -> Reader:
        return lambda path: drives.read_drive(path, name, **options)

    readers = {name: reader(name) for name in drives.FORMATS}
    plan = _plan(inputs, file_format, drives.FORMATS, readers, otherwise=drives.CSV if options else "")
    settings = {name: str(value.name if isinstance(value, Path) else value) for name, value in options.items()}
    return _ingest(DRIVES, "fix_quality", plan, out, progress=progress, settings=settings)


def recognise(path: Path) -> str:
    """Return the format of a drive by its content, or "" when it is none of ours.

    Raises
    ------
    InputError
        The file is missing, unreadable or empty.
    """
    from geofleet.formats import drives  # noqa: PLC0415  (as above)

    return drives.recognise(path)


def _plan(
    inputs: Sequence[Path],
    file_format: str,
    formats: Mapping[str, str],
    readers: Mapping[str, Reader],
    *,
    otherwise: str,
) -> list[tuple[Path, str, Reader]]:
    """Return path, format and reader of each input; every file is looked at before the first is read.

    A file of an unknown kind is read as the format `otherwise`, where there is one.
    """
    supported = "; ".join(f"{name}: {what}" for name, what in formats.items())
    if not inputs:
        raise InputError("no input file is named.", todo=f"Supported are {supported}.")
    if file_format not in {"auto", *formats}:
        raise InputError(f"unknown format {file_format!r}.", where="--format", todo=f"Supported are auto; {supported}.")
    plan = []
    for path in map(Path, inputs):
        found = (recognise(path) or otherwise) if file_format == "auto" else file_format
        if found not in readers:
            what = f"a file of format {found}, which is not read here" if found else "not in a format that is read here"
            raise InputError(f"{what}.", where=str(path), todo=f"Supported are {supported}.")
        plan.append((path, found, readers[found]))
    return plan


def _ingest(
    schema: Schema,
    kind: str,
    plan: list[tuple[Path, str, Reader]],
    out: Path,
    *,
    progress: Progress | None,
    settings: Mapping[str, object],
) -> IngestResult:
    """Read every input, put the rows together, write the table and, last, its manifest."""
    skipped: Counter[str] = Counter()
    found: Counter[str] = Counter()
    kinds: Counter[str] = Counter()
    layers_read = []
    hashing = Hashing(path for path, *_ in plan)
    for done, (path, _, reader) in enumerate(plan):
        if progress:
            progress(done, len(plan))
        layers_read.append(reader(path))
    n_rows = write_pieces(schema, _counted(_pieces(schema, plan, layers_read, skipped, found), kind, kinds), Path(out))
    for layer in layers_read:
        skipped.update(layer.skipped)
        found.update(layer.found)
    if progress:
        progress(len(plan), len(plan))
    by_kind = {name or "unknown": n for name, n in kinds.most_common()}
    write_manifest(
        Path(out),
        step=f"ingest {schema.name}",
        inputs=hashing,
        settings=settings,
        counts={"rows": n_rows, "by_kind": by_kind, "found": dict(found), "skipped": dict(skipped)},
    )
    formats = {str(path): file_format for path, file_format, _ in plan}
    return IngestResult(schema.name, Path(out), n_rows, by_kind, dict(found), dict(skipped), formats)


def _pieces(
    schema: Schema,
    plan: Sequence[tuple[Path, str, Reader]],
    read: list[LayerRead | LayerStream],
    skipped: Counter[str],
    found: Counter[str],
) -> Iterator[pa.Table]:
    """Return the rows to write: of one file piece by piece, where it comes so; of several put together."""
    only = read[0]
    if len(read) == 1 and isinstance(only, LayerStream):
        return only.pieces()
    tables = _told_apart(schema, read)
    found.update(_far_apart(plan, tables))
    return iter([_together(schema, tables, skipped)])


def _far_apart(plan: Sequence[tuple[Path, str, Reader]], tables: Sequence[pa.Table]) -> dict[str, int]:
    """Return the inputs whose middle lies over `_FAR_M` beyond the reach of every other one's rows, with their rows."""
    some = [(path.name, table) for (path, *_), table in zip(plan, tables, strict=True) if table.num_rows]
    if len(some) < 2 or any(BBOX not in table.column_names for _, table in some):  # noqa: PLR2004 - apart from what?
        return {}
    from geofleet.algorithms.geodesy import to_ecef  # noqa: PLC0415  (brings pyproj, which one map does without)

    middle, reach_m = [], []
    for _, table in some:
        lon, lat = lonlat(table)
        xyz = to_ecef(lon, lat)
        middle.append(np.median(xyz, axis=0))
        reach_m.append(float(np.linalg.norm(xyz - middle[-1], axis=1).max()))
    apart_m = np.linalg.norm(np.array(middle)[:, None] - np.array(middle)[None], axis=2)
    gap_m = apart_m - np.add.outer(reach_m, reach_m)
    np.fill_diagonal(gap_m, np.inf)
    return {
        f"{SUSPICIOUS}in {name}, over {_FAR_M / 1000:.0f} km from every other input; is its CRS right?": table.num_rows
        for (name, table), gap in zip(some, gap_m.min(axis=1), strict=True)
        if gap > _FAR_M
    }


def _told_apart(schema: Schema, read: list[LayerRead | LayerStream]) -> list[pa.Table]:
    """Return the tables, the ids of files that use the same ones prefixed with the names of the files.

    Ids of OpenStreetMap are unique on Earth: one id twice is one object in two extracts. Elsewhere 1 is the first
    signal of every file.
    """
    tables = [layer.table for layer in read]
    ids = [name for name in ("sign_id", "parent_id", "lane_id") if name in tables[0].column_names]
    local = [i for i, layer in enumerate(read) if layer.file_format not in _GLOBAL_IDS]
    if not ids or schema.key != (ids[0],) or len(local) < 2:  # noqa: PLR2004 - one file has its ids to itself
        return tables
    seen = Counter(name for i in local for name in tables[i][ids[0]].to_pylist())
    for i in local:
        if any(seen[name] > 1 for name in tables[i][ids[0]].to_pylist()):
            prefix = f"{tables[i]['source'][0].as_py()}:"
            for name in ids:
                at = tables[i].column_names.index(name)
                prefixed = pc.binary_join_element_wise(prefix, tables[i][name], "")
                tables[i] = tables[i].set_column(at, tables[i].schema.field(at), prefixed)
    return tables


def _counted(pieces: Iterator[pa.Table], kind: str, kinds: Counter[str]) -> Iterator[pa.Table]:
    """Pass tables on, and count what is in a column of theirs."""
    for piece in pieces:
        counted = pc.value_counts(piece[kind])
        kinds.update(dict(zip(counted.field("values").to_pylist(), counted.field("counts").to_pylist(), strict=True)))
        yield piece


def _together(schema: Schema, tables: list[pa.Table], skipped: Counter[str]) -> pa.Table:
    """Concatenate tables (a column that only some have is null in the others); of rows with one key the first stays."""
    table = sort_by_key(schema, pa.concat_tables(tables, promote_options="default"))
    if table.num_rows < 2:  # noqa: PLR2004 - one row repeats nothing
        return table
    same = np.ones(table.num_rows - 1, bool)
    for name in schema.key:
        column = table[name]
        same &= pc.equal(column[1:], column[:-1]).to_numpy()
    if same.any():
        skipped[f"rows whose {', '.join(schema.key)} came before"] += int(same.sum())
        table = table.filter(np.concatenate(([True], ~same)))
    return table


def _told(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{n} {name}" for name, n in counts.items() if n)
