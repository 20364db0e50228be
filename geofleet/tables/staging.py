"""Detections made ready for clustering: judged, numbered, and dealt with their halos into batches of tiles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from geofleet.tables.arrays import numpy_numbers
from geofleet.tables.biases import BiasSummary, correct_passes
from geofleet.tables.binding import bind_table
from geofleet.tables.database import create_view, keep_table, make_empty, materialise, run
from geofleet.tables.dealt import Dealer, write_pass_hashes
from geofleet.tables.plain import BLOCK_ROWS, MAX_ID_BITS, Coder, Survey, coded_columns, survey
from geofleet.tables.schemas import DETECTIONS
from geofleet.taxonomy.reader import load_taxonomy

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    import duckdb
    from numpy.typing import NDArray

    Columns = dict[str, NDArray[Any]]
    Blocks = tuple[Iterable[pa.RecordBatch], Callable[[pa.RecordBatch], Columns]]  # read, and made into numbers

FINE_ZOOM = 18  # cells of 100 m at 50 degrees: hot tiles are split down to these
_CELL_M = 3_400_000.0  # a cell of zoom 0 at 85.05 degrees is at least this wide
MAX_BATCHES = 500  # files that are written by turns


@dataclass(frozen=True, slots=True)
class Limits:
    """What detections must keep to, beside being sound.

    Parameters
    ----------
    area
        West, south, east and north in degrees; west beyond east is a box across the antimeridian. None for anywhere.
    is_listed
        Their class must be of the vocabulary.
    """

    area: tuple[float, float, float, float] | None = None
    is_listed: bool = False


ANYTHING = Limits()


@dataclass(frozen=True, slots=True)
class Staged:
    """Detections dealt into batches below a folder, and the meaning of their codes."""

    folder: Path
    tiles: pa.Table  # run_id, tile, n_points, tile_code, batch
    classes: tuple[str, ...]
    fleet: dict[str, int]  # vehicles that report, a run
    rejected: pa.Table  # what the checks find, with the reason
    n_detections: int
    n_of_class: tuple[int, ...]  # detections used, a class
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
    limits: Limits = ANYTHING,
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
        Detections that the tiles of a batch own, or more where there would be over MAX_BATCHES; a tile that owns more
        is split.
    n_vehicles
        Use the first so many of every run; 0 for all.
    passes, correct_bias
        Whether to take the range and bearing bias of each pass out first, and the `passes` table that declares how
        large these may be.
    limits
        What the detections must keep to.

    Raises
    ------
    InputError
        The table cannot be read, or biases cannot be solved for want of the information form.
    TableError
        A column is missing or mistyped.
    """
    fine_zoom = max(zoom, FINE_ZOOM)
    fine = None if correct_bias else fine_zoom
    plain = judge_detections(connection, detections, n_vehicles=n_vehicles, fine_zoom=fine, limits=limits)
    found = judged(connection)
    batch_rows = max(batch_rows, found.n_detections // MAX_BATCHES)
    bias = correct_passes(connection, detections, passes) if correct_bias else None
    classes = plain.classes if plain else _number_classes(connection)
    if plain and not n_vehicles:
        keep_table(connection, plain.counts, "counts")
    else:
        if bias is None:
            create_view(connection, "aggregate/placed")
        _choose(connection, n_vehicles)
        materialise(connection, "tiles/counts", {"fine_zoom": fine_zoom})
    materialise(connection, "tiles/leaves", {"zoom": zoom, "fine_zoom": fine_zoom, "batch_rows": batch_rows})
    materialise(connection, "tiles/assign", {"batch_rows": batch_rows})
    n_of_class = np.zeros(len(classes), np.int64)
    _deal(connection, folder, plain, n_of_class, fine_zoom=fine_zoom, halo_m=halo_m)
    return Staged(
        folder=folder,
        tiles=connection.table("assign").to_arrow_table(),
        classes=classes,
        fleet=found.fleet,
        rejected=found.rejected,
        n_detections=found.n_detections,
        n_of_class=tuple(n_of_class.tolist()),
        bias=bias,
    )


@dataclass(frozen=True, slots=True)
class Judged:
    """What the judgement of all detections found; fields as in `Staged`."""

    fleet: dict[str, int]
    rejected: pa.Table
    n_detections: int


def judge_detections(
    connection: duckdb.DuckDBPyConnection,
    detections: Path,
    *,
    n_vehicles: int,
    fine_zoom: int | None = None,
    limits: Limits = ANYTHING,
) -> Survey | None:
    """Make the views and tables `judged`, `reporting`, `copies`, `fleet`, `passes` and `usable` of the detections.

    With `fine_zoom`, return what a plain table holds, counted in cells of that zoom, unless there are limits. All of
    such a table is usable; where all vehicles are used too, nobody asks for the views `judged` and `usable`, and they
    are not made.

    Raises
    ------
    InputError, TableError
        The table cannot be read, or a column is missing or mistyped.
    """
    bind_table(connection, DETECTIONS, detections, is_filled=True)
    plain = survey(detections, fine_zoom) if fine_zoom and limits == ANYTHING else None
    are_asked_for = not plain or n_vehicles
    if are_asked_for:
        _bind_limits(connection, limits)
        create_view(connection, "aggregate/judged")
    if plain:
        keep_table(connection, plain.reporting, "reporting")
    else:
        _report_passes(connection)
    materialise(connection, "aggregate/suspects")
    _find_copies(connection)
    materialise(connection, "aggregate/fleet", {"n_vehicles": n_vehicles})
    materialise(connection, "aggregate/passes")
    if are_asked_for:
        _select_usable(connection)
    return plain


def _bind_limits(connection: duckdb.DuckDBPyConnection, limits: Limits) -> None:
    """Make the tables `area` and `unlisted`, empty where there is no such limit."""
    sides = limits.area or (None,) * 4
    materialise(connection, "aggregate/area", dict(zip(("west", "south", "east", "north"), sides, strict=True)))
    concepts = ",".join(load_taxonomy().concepts) if limits.is_listed else None
    materialise(connection, "aggregate/unlisted", {"concepts": concepts})


def _select_usable(connection: duckdb.DuckDBPyConnection) -> None:
    """Make the view `usable`: what `sql/aggregate/usable` says or, where all rows can be used, plainly all of them.

    A filter that keeps every row still costs as much as reading them.
    """
    n_bad = connection.table("reporting").aggregate("sum(n_rows - n_usable)").fetchall()[0][0]
    n_copies = connection.table("copies").aggregate("count(*)").fetchall()[0][0]
    if n_bad or n_copies:
        create_view(connection, "aggregate/usable")
    else:
        connection.table("judged").project("* EXCLUDE (reason)").create_view("usable")


def judged(connection: duckdb.DuckDBPyConnection) -> Judged:
    """Return what `judge_detections` found."""
    fleet = connection.table("fleet").to_arrow_table()
    n_rows, n_usable = connection.table("reporting").aggregate("sum(n_rows), sum(n_usable)").fetchall()[0]
    return Judged(
        fleet=dict(zip(fleet["run_id"].to_pylist(), fleet["n_reporting"].to_pylist(), strict=True)),
        rejected=_rejected(connection, n_invalid=(n_rows or 0) - (n_usable or 0)),
        n_detections=n_rows or 0,
    )


def _report_passes(connection: duckdb.DuckDBPyConnection) -> None:
    """Count what each pass reports."""
    low, high, n_passes = run(connection, "aggregate/ranges").fetchall()[0]
    is_narrow = low is not None and (high - low + 1) * n_passes <= MAX_ID_BITS
    ids = {"low": low if is_narrow else 0, "high": high if is_narrow else 0, "is_narrow": is_narrow}
    materialise(connection, "aggregate/reporting", ids)


def _find_copies(connection: duckdb.DuckDBPyConnection) -> None:
    """Find the rows that repeat a key; the detections are scanned for them only where there may be any."""
    if connection.table("suspects").aggregate("count(*)").fetchall()[0][0]:
        materialise(connection, "aggregate/copies")
    else:
        make_empty(connection, "aggregate/copies")


def _choose(connection: duckdb.DuckDBPyConnection, n_vehicles: int) -> None:
    """Make the view `chosen`: what `sql/aggregate/chosen` says or, where all vehicles are used, plainly all of them."""
    if n_vehicles:
        create_view(connection, "aggregate/chosen")
    else:
        connection.table("placed").create_view("chosen")


def _number_classes(connection: duckdb.DuckDBPyConnection) -> tuple[str, ...]:
    """Return the classes in the order of their numbers."""
    materialise(connection, "aggregate/classes")
    return tuple(connection.table("classes").to_arrow_table()["sign_class"].to_pylist())


def _rejected(connection: duckdb.DuckDBPyConnection, *, n_invalid: int) -> pa.Table:
    """Return the rows that cannot be used; the detections are scanned for bad ones only if there are any."""
    copies = run(connection, "checks/detections_duplicate").to_arrow_table()
    if n_invalid == 0:
        return copies
    return pa.concat_tables([run(connection, "checks/detections_invalid").to_arrow_table(), copies])


def _deal(
    connection: duckdb.DuckDBPyConnection,
    folder: Path,
    plain: Survey | None,
    n_of_class: NDArray[np.int64],
    *,
    fine_zoom: int,
    halo_m: float,
) -> None:
    """Write every detection to the batches whose tiles read it, and count those of each class."""
    reach = {"fine_zoom": fine_zoom, "halo_m": halo_m, "n_around": math.ceil(halo_m / _CELL_M * 2.0**fine_zoom) or 1}
    materialise(connection, "tiles/readers", reach)
    found = connection.sql("SELECT * EXCLUDE (run_id) FROM readers").fetchnumpy()
    readers = {name: np.asarray(values) for name, values in found.items()}
    tiles = connection.sql("SELECT run_id FROM assign ORDER BY tile_code").fetchnumpy()
    passes = connection.sql("SELECT DISTINCT pass_code, run_id, pass_hash FROM passes ORDER BY pass_code").fetchnumpy()
    run_ids, run_of_pass = np.unique(np.asarray(passes["run_id"], str), return_inverse=True)
    write_pass_hashes(folder, np.asarray(passes["pass_hash"], np.uint64))
    run_of_tile = np.searchsorted(run_ids, np.asarray(tiles["run_id"], str))
    dealer = Dealer(folder, readers, fine_zoom=fine_zoom, run_of_tile=run_of_tile, run_of_pass=run_of_pass)
    blocks, coded = _plain_blocks(connection, plain) if plain else _blocks(connection)

    def counted(block: pa.RecordBatch) -> Columns:
        columns = coded(block)
        n_of_class[:] += np.bincount(columns["class_code"], minlength=n_of_class.size)
        return columns

    dealer.deal_all(blocks, counted)


def _plain_blocks(connection: duckdb.DuckDBPyConnection, plain: Survey) -> Blocks:
    codes = connection.sql("SELECT run_id, vehicle_id, pass_id, pass_code FROM passes").fetchall()
    passes = {(run_id, vehicle_id, pass_id): code for run_id, vehicle_id, pass_id, code in codes}
    return coded_columns(plain), Coder(plain, passes)


def _blocks(connection: duckdb.DuckDBPyConnection) -> Blocks:
    blocks = run(connection, "aggregate/coded").to_arrow_reader(BLOCK_ROWS)
    return blocks, lambda block: {name: numpy_numbers(block.column(name)) for name in block.schema.names}
