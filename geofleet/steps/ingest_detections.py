"""Detections of a real fleet from outside to the `detections` table, batch by batch, bad rows set apart beside it."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow.compute as pc
import pyarrow.parquet as pq

from geofleet.errors import InputError
from geofleet.formats import detections
from geofleet.formats.reading import unpacked
from geofleet.tables.hive import HiveWriter, TooManyFoldersError
from geofleet.tables.manifest import write_manifest
from geofleet.tables.schemas import DETECTIONS
from geofleet.tables.store import atomic_path

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    Progress = Callable[[int, int], None]

_MAX_SAMPLES = 10


@dataclass(frozen=True, slots=True)
class DetectionsResult:
    """What an ingest of detections wrote: rows, rows set apart with one sample a reason, and what was found."""

    out: Path
    rejected: Path | None
    n_rows: int
    n_rejected: int
    found: dict[str, int]
    skipped: dict[str, int]
    samples: tuple[str, ...]


@dataclass
class _Counts:
    """What was read so far."""

    n_rows: int = 0
    n_rejected: int = 0
    n_before: int = 0  # rows of the files before the one being read
    skipped: Counter[str] = field(default_factory=Counter)
    found: Counter[str] = field(default_factory=Counter)
    samples: dict[str, str] = field(default_factory=dict)

    def add(self, read: detections.DetectionsRead) -> None:
        """Count a batch, and keep the first row of each reason to show."""
        self.n_rows += read.table.num_rows
        self.n_rejected += read.rejected.num_rows
        self.skipped.update(read.skipped)
        self.found.update(read.found)
        for reason in read.skipped if len(self.samples) < _MAX_SAMPLES else ():
            if reason not in self.samples:
                first = read.rejected.filter(pc.field("reason") == reason).slice(0, 1).to_pylist()[0]
                content = " ".join(first["content"][:120].split())
                self.samples[reason] = f"{first['source']} row {first['row']}: {content}"


def ingest_detections(
    inputs: Sequence[Path],
    out: Path,
    *,
    columns: Mapping[str, str] | Path | None = None,
    crs: str | None = None,
    scheme: str | None = None,
    country: str | None = None,
    run_id: str | None = None,
    progress: Progress | None = None,
) -> DetectionsResult:
    """Read detections of a real fleet into a `detections` table, partitioned by run and vehicle.

    Parameters
    ----------
    inputs
        CSV, GeoJSON, GeoPackage, FlatGeobuf, Shapefile or Parquet files; rows without a pass are numbered through all
        of them.
    out
        Folder to write; rows that cannot be used go to `<out>_rejected.parquet` beside it, with the reason.
    columns, crs, scheme, country, run_id
        As in `formats.detections.read_detections`.
    progress
        Called with files done and in all.

    Raises
    ------
    InputError
        There is no input, one cannot be read, or no row of them can be used; nothing is written.
    ConfigError
        An option or a column is unknown.
    """
    if not inputs:
        raise InputError(
            "no input file is named.", todo="Give CSV, GeoJSON, GeoPackage, FlatGeobuf, Shapefile or Parquet files."
        )
    options = {"columns": columns, "crs": crs, "scheme": scheme, "country": country, "run_id": run_id}
    paths = [Path(path) for path in inputs]
    try:
        result = _stream(paths, Path(out), options, bucketed=False, progress=progress)
    except TooManyFoldersError:
        result = _stream(paths, Path(out), options, bucketed=True, progress=progress)
    settings = {name: str(value.name if isinstance(value, Path) else value) for name, value in options.items() if value}
    counts = {"rows": result.n_rows, "rejected": result.n_rejected, "found": result.found, "skipped": result.skipped}
    write_manifest(Path(out), step="ingest detections", inputs=paths, settings=settings, counts=counts)
    return result


def _stream(
    paths: list[Path], out: Path, options: dict[str, Any], *, bucketed: bool, progress: Progress | None
) -> DetectionsResult:
    """Read, judge and write batch by batch; table and rejected rows take their places together at the end."""
    counts = _Counts()
    rejected_path = out.with_name(f"{out.stem}_rejected.parquet")
    with atomic_path(out) as draft, atomic_path(rejected_path) as rejected_draft:
        draft.mkdir()
        writer = HiveWriter(DETECTIONS, draft, bucketed=bucketed)
        with pq.ParquetWriter(rejected_draft, detections.REJECTED, compression="zstd") as rejects:
            for done, path in enumerate(paths):
                if progress:
                    progress(done, len(paths))
                with unpacked(path) as plain:
                    for read in detections.read_detections(plain, rows_before=counts.n_before, **options):
                        writer.write(read.table)
                        rejects.write_table(read.rejected)
                        counts.add(read)
                counts.n_before = counts.n_rows + counts.n_rejected
        writer.close()
        if not counts.n_rows:
            raise InputError(
                f"no row can be used: {', '.join(f'{n} {reason}' for reason, n in counts.skipped.items())}.",
                where=str(paths[0]),
                todo=f"Look at {'; '.join(counts.samples.values())}",
            )
    if not counts.n_rejected:
        rejected_path.unlink()
    return DetectionsResult(
        out=out,
        rejected=rejected_path if counts.n_rejected else None,
        n_rows=counts.n_rows,
        n_rejected=counts.n_rejected,
        found=dict(counts.found),
        skipped=dict(counts.skipped),
        samples=tuple(f"{reason}: {sample}" for reason, sample in counts.samples.items()),
    )
