"""Detections made ready for clustering: judged, numbered, and dealt with their halos into batches of tiles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from geofleet.tables.binding import bind_table
from geofleet.tables.database import load_sql, run
from geofleet.tables.schemas import DETECTIONS

if TYPE_CHECKING:
    from pathlib import Path

    import duckdb


@dataclass(frozen=True, slots=True)
class Staged:
    """Detections dealt into batches below a folder, and the meaning of their codes."""

    folder: Path
    tiles: pa.Table  # run_id, tile, n_points, tile_code, batch
    classes: tuple[str, ...]
    fleet: dict[str, int]  # vehicles that report, a run
    rejected: pa.Table  # what the checks find, with the reason
    n_detections: int


def stage_detections(
    connection: duckdb.DuckDBPyConnection,
    detections: Path,
    folder: Path,
    *,
    zoom: int,
    halo_m: float,
    batch_rows: int,
    n_vehicles: int,
) -> Staged:
    """Judge, number and tile the detections, and write a file a batch.

    Parameters
    ----------
    detections
        A `detections` table: a file, or a folder partitioned by run and vehicle.
    folder
        Where the batches go, `<batch>.parquet`.
    zoom, halo_m
        Size of the tiles, and the margin that each reads, metres.
    batch_rows
        Detections that the tiles of a batch own; a tile is never split.
    n_vehicles
        Use the first so many of every run; 0 for all.

    Raises
    ------
    InputError
        The table cannot be read.
    TableError
        A column is missing or mistyped.
    """
    bind_table(connection, DETECTIONS, detections)
    connection.sql(load_sql("aggregate/judged").text).create_view("judged")
    _materialise(connection, "aggregate/copies")
    _materialise(connection, "aggregate/fleet", {"n_vehicles": n_vehicles})
    connection.sql(load_sql("aggregate/points").text).create_view("points")
    _materialise(connection, "aggregate/passes")
    _materialise(connection, "aggregate/classes")
    _materialise(connection, "tiles/assign", {"zoom": zoom, "batch_rows": batch_rows})
    _deal(run(connection, "tiles/members", {"zoom": zoom, "halo_m": halo_m}).to_arrow_reader(batch_rows), folder)
    fleet = connection.table("fleet").to_arrow_table()
    return Staged(
        folder=folder,
        tiles=connection.table("assign").to_arrow_table(),
        classes=tuple(connection.table("classes").to_arrow_table()["sign_class"].to_pylist()),
        fleet=dict(zip(fleet["run_id"].to_pylist(), fleet["n_reporting"].to_pylist(), strict=True)),
        rejected=pa.concat_tables(
            [run(connection, f"checks/detections_{name}").to_arrow_table() for name in ("invalid", "duplicate")]
        ),
        n_detections=connection.table("detections").count("*").fetchall()[0][0],
    )


def _materialise(connection: duckdb.DuckDBPyConnection, name: str, params: dict[str, Any] | None = None) -> None:
    """Keep the result of a statement as a table of its file's name."""
    table = run(connection, name, params).to_arrow_table()
    connection.from_arrow(table).create(name.rpartition("/")[2])


def _deal(rows: pa.RecordBatchReader, folder: Path) -> None:
    """Append the rows to one file a batch as they come, so that only a part is ever in memory."""
    writers: dict[int, pq.ParquetWriter] = {}
    schema = pa.schema([field for field in rows.schema if field.name != "batch"])
    try:
        for block in rows:
            table = pa.Table.from_batches([block]).sort_by("batch")
            numbers, starts = np.unique(table["batch"].to_numpy(), return_index=True)
            for number, start, stop in zip(numbers.tolist(), starts, [*starts[1:], table.num_rows], strict=True):
                if number not in writers:
                    writers[number] = pq.ParquetWriter(folder / f"{number}.parquet", schema, compression="none")
                writers[number].write_table(table.slice(start, stop - start).select(schema.names))
    finally:
        for writer in writers.values():
            writer.close()
