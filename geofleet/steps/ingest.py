"""Files from outside to tables: sign maps to `signs`, roads to `lanes`, trajectories to `drives`.

The format of a file is recognised by its content. A table is written when every input has been read, or not at all.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.errors import InputError
from geofleet.formats import drives, osm
from geofleet.formats.reading import read_head
from geofleet.tables.manifest import write_manifest
from geofleet.tables.schemas import DRIVES, LANES, SIGNS
from geofleet.tables.store import sort_by_key, write_table

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from geofleet.formats.reading import LayerRead
    from geofleet.tables.schemas import Schema

    Progress = Callable[[int, int], None]
    Reader = Callable[[Path], LayerRead]

SIGN_FORMATS = {osm.FORMAT: "OpenStreetMap (.osm.pbf, .osm, .osm.gz, .osm.bz2)"}
DRIVE_FORMATS = {drives.FORMAT: "RTKLIB solution (.pos)"}


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
) -> IngestResult:
    """Read sign maps into one `signs` table.

    Parameters
    ----------
    inputs
        Files, each in a format of `SIGN_FORMATS`.
    out
        Parquet file to write.
    file_format
        `auto`, or the name of the format of all inputs.
    roads
        Take road and, where the map does not say, facing from the nearest drivable way.
    progress
        Called with files done and in all.

    Raises
    ------
    InputError
        There is no input, or one is missing, damaged or in no known format; nothing is written.
    """
    readers = {osm.FORMAT: lambda path: osm.read_signs(path, roads=roads)}
    plan = _plan(inputs, file_format, SIGN_FORMATS, readers)
    return _ingest(SIGNS, "kind", plan, out, progress=progress, settings={"roads": roads})


def ingest_lanes(
    inputs: Sequence[Path], out: Path, *, file_format: str = "auto", progress: Progress | None = None
) -> IngestResult:
    """Read drivable roads into one `lanes` table; parameters and errors as `ingest_signs`."""
    readers = {osm.FORMAT: osm.read_lanes}
    return _ingest(
        LANES, "kind", _plan(inputs, file_format, SIGN_FORMATS, readers), out, progress=progress, settings={}
    )


def ingest_drive(
    inputs: Sequence[Path], out: Path, *, file_format: str = "auto", progress: Progress | None = None
) -> IngestResult:
    """Read trajectories, one drive a file, into one `drives` table; parameters and errors as `ingest_signs`."""
    readers = {drives.FORMAT: drives.read_drive}
    return _ingest(
        DRIVES, "fix_quality", _plan(inputs, file_format, DRIVE_FORMATS, readers), out, progress=progress, settings={}
    )


def recognise(path: Path) -> str:
    """Return the format of a file by its content, or "" when it is none of ours.

    Raises
    ------
    InputError
        The file is missing, unreadable or empty.
    """
    head = read_head(path)
    if osm.detect(head):
        return osm.FORMAT
    return drives.FORMAT if drives.detect(head) else ""


def _plan(
    inputs: Sequence[Path], file_format: str, formats: Mapping[str, str], readers: Mapping[str, Reader]
) -> list[tuple[Path, str, Reader]]:
    """Return path, format and reader of each input; every file is looked at before the first is read."""
    supported = "; ".join(f"{name}: {what}" for name, what in formats.items())
    if not inputs:
        raise InputError("no input file is named.", todo=f"Supported are {supported}.")
    if file_format not in {"auto", *formats}:
        raise InputError(f"unknown format {file_format!r}.", where="--format", todo=f"Supported are auto; {supported}.")
    plan = []
    for path in map(Path, inputs):
        found = recognise(path) if file_format == "auto" else file_format
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
    tables = []
    for done, (path, _, reader) in enumerate(plan):
        if progress:
            progress(done, len(plan))
        layer = reader(path)
        skipped.update(layer.skipped)
        found.update(layer.found)
        tables.append(layer.table)
    table = _together(schema, tables, skipped)
    write_table(schema, table, Path(out))
    if progress:
        progress(len(plan), len(plan))
    kinds = {name or "unknown": n for name, n in Counter(table[kind].to_pylist()).most_common()}
    formats = {str(path): file_format for path, file_format, _ in plan}
    write_manifest(
        Path(out),
        step=f"ingest {schema.name}",
        inputs=[path for path, *_ in plan],
        settings=settings,
        counts={"rows": table.num_rows, "by_kind": kinds, "found": dict(found), "skipped": dict(skipped)},
    )
    return IngestResult(schema.name, Path(out), table.num_rows, kinds, dict(found), dict(skipped), formats)


def _together(schema: Schema, tables: list[pa.Table], skipped: Counter[str]) -> pa.Table:
    """Concatenate tables; of rows with one key the first stays."""
    table = sort_by_key(schema, pa.concat_tables(tables))
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
