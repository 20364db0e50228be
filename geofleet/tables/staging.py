"""Detections made ready for clustering: judged, numbered, and dealt with their halos into batches of tiles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from geofleet.algorithms.clustering_kernels import radix_argsort
from geofleet.tables.biases import BiasSummary, correct_passes
from geofleet.tables.binding import bind_table
from geofleet.tables.database import create_view, materialise, run
from geofleet.tables.schemas import DETECTIONS

if TYPE_CHECKING:
    from pathlib import Path

    import duckdb
    from numpy.typing import NDArray

    Columns = dict[str, NDArray[Any]]

FINE_ZOOM = 18  # cells of 100 m at 50 degrees: hot tiles are split down to these
_CELL_M = 3_400_000.0  # a cell of zoom 0 at 85.05 degrees is at least this wide
BLOCK_ROWS = 250_000  # rows that are sorted into their batches at a time
_MAX_ID_BITS = 1 << 29  # 64 MB of track ids
NEVER_BEGUN, NEVER_ENDED = np.iinfo(np.int64).max, np.iinfo(np.int64).min  # times that are missing, µs
_HASHES_OF_PASSES = "pass_hash.npy"
_ROW = np.dtype(
    [
        *((name, np.float64) for name in ("lon", "lat", "var_m2", "class_confidence")),
        *((name, np.int64) for name in ("track_id", "t_first_us", "t_last_us")),
        *((name, np.int32) for name in ("tile_code", "pass_code", "class_code")),
        ("is_owned", np.bool_),
    ],
    align=True,
)


@dataclass(frozen=True, slots=True)
class Staged:
    """Detections dealt into batches below a folder, and the meaning of their codes."""

    folder: Path
    tiles: pa.Table  # run_id, tile, n_points, tile_code, batch
    classes: tuple[str, ...]
    fleet: dict[str, int]  # vehicles that report, a run
    rejected: pa.Table  # what the checks find, with the reason
    n_detections: int
    bias: BiasSummary | None = None


def stage_detections(
    connection: duckdb.DuckDBPyConnection,
    detections: Path,
    folder: Path,
    *,
    zoom: int,
    halo_m: float,
    batch_rows: int,
    n_vehicles: int,
    passes: Path | None = None,
    correct_bias: bool = False,
) -> Staged:
    """Judge, number and tile the detections, and write a file a batch.

    Parameters
    ----------
    detections
        A `detections` table: a file, or a folder partitioned by run and vehicle.
    folder
        Where the batches go, `batch_path(folder, number)`.
    zoom, halo_m
        Size of the tiles, and the margin that each reads, metres.
    batch_rows
        Detections that the tiles of a batch own; a tile that owns more is split.
    n_vehicles
        Use the first so many of every run; 0 for all.
    passes, correct_bias
        Whether to take the range and bearing bias of each pass out first, and the `passes` table that declares how
        large these may be.

    Raises
    ------
    InputError
        The table cannot be read, or biases cannot be solved for want of the information form.
    TableError
        A column is missing or mistyped.
    """
    fine_zoom = max(zoom, FINE_ZOOM)
    bind_table(connection, DETECTIONS, detections, is_filled=True)
    create_view(connection, "aggregate/judged")
    materialise(connection, "aggregate/reporting")
    _find_suspects(connection)
    materialise(connection, "aggregate/copies")
    materialise(connection, "aggregate/fleet", {"n_vehicles": n_vehicles})
    materialise(connection, "aggregate/passes")
    create_view(connection, "aggregate/usable")
    bias = correct_passes(connection, detections, passes) if correct_bias else None
    if bias is None:
        create_view(connection, "aggregate/placed")
    create_view(connection, "aggregate/points")
    materialise(connection, "aggregate/classes")
    materialise(connection, "tiles/counts", {"fine_zoom": fine_zoom})
    materialise(connection, "tiles/leaves", {"zoom": zoom, "fine_zoom": fine_zoom, "batch_rows": batch_rows})
    materialise(connection, "tiles/assign", {"batch_rows": batch_rows})
    reach = {"fine_zoom": fine_zoom, "halo_m": halo_m, "n_around": math.ceil(halo_m / _CELL_M * 2.0**fine_zoom) or 1}
    materialise(connection, "tiles/readers", reach)
    members = run(connection, "tiles/members", {"fine_zoom": fine_zoom})
    _deal(members.to_arrow_reader(BLOCK_ROWS), folder)
    hashes = connection.sql("SELECT DISTINCT pass_code, pass_hash FROM passes ORDER BY pass_code").fetchnumpy()
    np.save(folder / _HASHES_OF_PASSES, np.asarray(hashes["pass_hash"], np.uint64))
    fleet = connection.table("fleet").to_arrow_table()
    n_rows, n_usable = connection.table("reporting").aggregate("sum(n_rows), sum(n_usable)").fetchall()[0]
    return Staged(
        folder=folder,
        tiles=connection.table("assign").to_arrow_table(),
        classes=tuple(connection.table("classes").to_arrow_table()["sign_class"].to_pylist()),
        fleet=dict(zip(fleet["run_id"].to_pylist(), fleet["n_reporting"].to_pylist(), strict=True)),
        rejected=_rejected(connection, n_invalid=(n_rows or 0) - (n_usable or 0)),
        n_detections=n_rows or 0,
        bias=bias,
    )


def batch_path(folder: Path, number: int) -> Path:
    """Return the file of a batch."""
    return folder / f"{number}.rows"


def read_rows(path: Path) -> Columns:
    """Read a batch: one array a column of `tiles/members`, and the hash of each row's pass."""
    rows = np.fromfile(path, _ROW)
    columns: Columns = {
        name: rows[name].astype(np.int64 if kind.kind == "i" else kind)
        for name, kind in ((name, _ROW[name]) for name in _ROW.names or ())
    }
    hashes = np.load(path.with_name(_HASHES_OF_PASSES), mmap_mode="r")
    return columns | {"pass_hash": hashes[columns["pass_code"]]}


def _find_suspects(connection: duckdb.DuckDBPyConnection) -> None:
    """Keep the passes that may repeat a key: by bit strings or, when the ids are too spread for these, all of them."""
    low, high, n_passes = (
        connection.table("reporting").aggregate("min(track_low), max(track_high), count(n_usable)").fetchall()[0]
    )
    if low is not None and (high - low + 1) * n_passes <= _MAX_ID_BITS:
        materialise(connection, "aggregate/suspects", {"low": low, "high": high})
    else:
        connection.table("reporting").filter("n_usable > 0").project("run_id, pass_id").distinct().create("suspects")


def _rejected(connection: duckdb.DuckDBPyConnection, *, n_invalid: int) -> pa.Table:
    """Return the rows that cannot be used; the detections are scanned for bad ones only if there are any."""
    copies = run(connection, "checks/detections_duplicate").to_arrow_table()
    if n_invalid == 0:
        return copies
    return pa.concat_tables([run(connection, "checks/detections_invalid").to_arrow_table(), copies])


def _deal(blocks: pa.RecordBatchReader, folder: Path) -> None:
    """Append the rows to one file a batch as they come: one block is in memory, one file is open at a time."""
    for block in blocks:
        batch = block.column("batch").to_numpy().astype(np.int64)
        order = radix_argsort(batch, np.arange(batch.size))
        rows = np.empty(batch.size, _ROW)
        for name in _ROW.names or ():
            rows[name] = block.column(name).to_numpy(zero_copy_only=False)[order]
        numbers, starts = np.unique(batch[order], return_index=True)
        for number, start, stop in zip(numbers.tolist(), starts, [*starts[1:], batch.size], strict=True):
            with batch_path(folder, number).open("ab") as file:
                rows[start:stop].tofile(file)
