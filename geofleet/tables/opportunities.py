"""Opportunities of places from a stored `passes` table, some passes at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import shapely

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.opportunities import count_opportunities
from geofleet.errors import TableError
from geofleet.tables.schemas import GEOMETRY, PASSES
from geofleet.tables.store import read_table

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_COLUMNS = ("run_id", "vehicle_id", "pass_id", "range_m", "fov_deg", GEOMETRY)
_PASSES_AT_A_TIME = 1000
_PATCH_DEG = 0.1  # places are worked on in patches of this size: their planes are true to a millimetre in range


def read_passes(path: Path) -> pa.Table:
    """Read what a count of opportunities needs of a `passes` table.

    Raises
    ------
    InputError
        The file cannot be read.
    TableError
        A column is missing or mistyped.
    """
    return read_table(PASSES, path, columns=_COLUMNS)


def opportunities(passes: pa.Table, lon_deg: Floats, lat_deg: Floats, *, run_id: str, n_vehicles: int | None) -> Ints:
    """Return how many passes of the first vehicles of a run had each place in view.

    Parameters
    ----------
    passes
        From `read_passes`.
    lon_deg, lat_deg
        (n,) places.
    run_id, n_vehicles
        The run, and how many vehicles (in the order of their ids) count; None for all.

    Raises
    ------
    TableError
        The table has no pass of the run.
    """
    mine = passes.filter(pc.equal(passes["run_id"], run_id))
    if mine.num_rows == 0:
        raise TableError(f"no pass of run {run_id}.", where="table passes", todo="Give the passes of the same runs.")
    vehicles = sorted(set(mine["vehicle_id"].to_pylist()))[:n_vehicles]
    mine = mine.filter(pc.is_in(mine["vehicle_id"], pa.array(vehicles, pa.string())))
    counts = np.zeros(len(lon_deg), np.int64)
    for begin in range(0, mine.num_rows, _PASSES_AT_A_TIME):
        counts += _count_part(mine.slice(begin, _PASSES_AT_A_TIME), lon_deg, lat_deg)
    return counts


def _count_part(passes: pa.Table, lon_deg: Floats, lat_deg: Floats) -> Ints:
    """Count patch by patch, each in a plane of its own."""
    lines = shapely.from_wkb(passes[GEOMETRY].to_numpy())
    vertices, owner = shapely.get_coordinates(lines, return_index=True)
    first = np.searchsorted(owner, np.arange(passes.num_rows + 1))
    range_m, fov_deg = passes["range_m"].to_numpy(), passes["fov_deg"].to_numpy()
    counts = np.zeros(len(lon_deg), np.int64)
    patch = np.column_stack((np.floor(lon_deg / _PATCH_DEG), np.floor(lat_deg / _PATCH_DEG)))
    _, which = np.unique(patch, axis=0, return_inverse=True)
    for number in range(int(which.max(initial=-1)) + 1):
        places = np.flatnonzero(which == number)
        frame = EnuFrame.around(lon_deg[places], lat_deg[places])
        xy = frame.to_enu(lon_deg[places], lat_deg[places])
        path_xy = frame.to_enu(*vertices.T)
        counts[places] += count_opportunities(xy, path_xy, first, range_m=range_m, fov_deg=fov_deg)
    return counts
