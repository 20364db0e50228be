"""Detections made ready for joint fusion: judged and numbered like those of every method, and kept run by run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import pyarrow as pa
import pyarrow.compute as pc

from geofleet.errors import TableError
from geofleet.tables.database import materialise, run
from geofleet.tables.staging import ANYTHING, Judged, Limits, judge_detections, judged

if TYPE_CHECKING:
    from pathlib import Path

    import duckdb


@dataclass(frozen=True, slots=True)
class StagedTracks:
    """Where the tracks of each run are, and what was found on the way."""

    connection: duckdb.DuckDBPyConnection
    judged: Judged

    def of_run(self, run_id: str) -> pa.Table:
        """Return the tracks of one run, sorted by pass and track (`aggregate/tracks_of_run`)."""
        return run(self.connection, "aggregate/tracks_of_run", {"run_id": run_id}).to_arrow_table()


def stage_tracks(
    connection: duckdb.DuckDBPyConnection, detections: Path, *, n_vehicles: int, limits: Limits = ANYTHING
) -> StagedTracks:
    """Judge the detections and keep those that can be used.

    Raises
    ------
    InputError
        The table cannot be read.
    TableError
        A column is missing or mistyped.
    """
    judge_detections(connection, detections, n_vehicles=n_vehicles, limits=limits)
    materialise(connection, "aggregate/tracks")
    return StagedTracks(connection, judged(connection))


def count_classes(staged: StagedTracks) -> dict[str, int]:
    """Return how many detections are used of every class."""
    rows = staged.connection.table("tracks").aggregate("sign_class, count(*)", "sign_class").fetchall()
    return dict(sorted(rows))


def prior_of_run(layer: pa.Table, run_id: str) -> pa.Table:
    """Return the main signs of a prior map, by id: of the same run, when the map is one of several runs.

    Raises
    ------
    TableError
        The layer holds several runs, and this is none of them.
    """
    mine = layer.filter(pc.equal(layer["kind"], "main"))
    runs = set(mine["run_id"].to_pylist()) - {None} if "run_id" in mine.column_names else set()
    if run_id in runs:
        mine = mine.filter(pc.equal(mine["run_id"], run_id))
    elif len(runs) > 1:
        raise TableError(
            f"holds {len(runs)} runs, and none is {run_id}.", where="prior map", todo="Give one map, or the same runs."
        )
    return mine.sort_by("sign_id")


def joint_classes(staged: StagedTracks, prior: pa.Table | None) -> tuple[str, ...]:
    """Return all classes of detections and of a prior map, in alphabetical order."""
    reported = staged.connection.table("tracks").project("sign_class").distinct().to_arrow_table()["sign_class"]
    known = [] if prior is None else prior["sign_class"].to_pylist()
    return tuple(sorted({*reported.to_pylist(), *known}))


def passes_of_run(passes: pa.Table, run_id: str, n_vehicles: int | None) -> pa.Table:
    """Return the passes of the first vehicles of a run.

    Raises
    ------
    TableError
        The table has no pass of the run.
    """
    mine = passes.filter(pc.equal(passes["run_id"], run_id))
    if mine.num_rows == 0:
        raise TableError(f"no pass of run {run_id}.", where="table passes", todo="Give the passes of the same runs.")
    vehicles = sorted(set(mine["vehicle_id"].to_pylist()))[:n_vehicles]
    return mine.filter(pc.is_in(mine["vehicle_id"], pa.array(vehicles, pa.string())))
