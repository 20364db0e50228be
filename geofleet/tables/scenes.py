"""A study's scene and drive: rows of the tables `signs` and `drives` as the arrays that a simulation runs on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.scene import is_repeated, nearest_m, within_corridor
from geofleet.algorithms.sensing import SignField
from geofleet.algorithms.trajectory import DriveLine, drive_line
from geofleet.errors import ConfigError, InputError
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import lonlat
from geofleet.taxonomy import load_taxonomy

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive in its own ENU frame; `t_start` is the time of its first epoch, UTC, when it has one."""

    drive_id: str
    frame: EnuFrame
    line: DriveLine
    t_start: np.datetime64 | None


@dataclass(frozen=True, slots=True)
class Scene:
    """The signs of a study: their rows (sorted by sign_id), their places and class codes, and what the codes mean.

    `groups` are the groups of the classes, by code.
    """

    table: pa.Table
    field: SignField
    sign_ids: NDArray[np.object_]
    classes: NDArray[np.object_]
    groups: NDArray[np.object_]


def load_drive(table: pa.Table, source: Path) -> Drive:
    """Return the one drive of a `drives` table that came from `source`, which messages name.

    Raises
    ------
    InputError
        The table holds several drives or none, or the drive does not move.
    """
    names = pc.unique(table["drive_id"]).to_pylist()
    if len(names) != 1:
        raise InputError(
            f"one drive is needed, found {len(names)}{': ' if names else ''}{', '.join(names[:5])}.",
            where=str(source),
            todo='Give one with a single drive_id, or set drives = "all".',
        )
    return _drive(table, EnuFrame.around(*lonlat(table)), source)


def load_drives(table: pa.Table, source: Path) -> tuple[Drive, ...]:
    """Return every drive of a `drives` table, by name, all in one frame.

    Raises
    ------
    InputError
        The table holds no drive, or one of them does not move.
    """
    names = sorted(pc.unique(table["drive_id"]).to_pylist())
    if not names:
        raise InputError("there is no drive in the table.", where=str(source), todo="Ingest one first.")
    frame = EnuFrame.around(*lonlat(table))
    return tuple(_drive(table.filter(pc.field("drive_id") == name), frame, source) for name in names)


def _drive(table: pa.Table, frame: EnuFrame, source: Path) -> Drive:
    table = table.sort_by("seq")
    lon, lat = lonlat(table)
    times = None if table["t_utc"].null_count else table["t_utc"].cast(pa.int64()).to_numpy()
    elapsed_s = None if times is None else (times - times[0]) / 1e6
    try:
        line = drive_line(frame.to_enu(lon, lat), table["segment"].to_numpy(), elapsed_s)
    except InputError as error:
        raise InputError(error.what, where=str(source), todo=error.todo) from None
    first = table["t_utc"][0].as_py()
    t_start = None if first is None else np.datetime64(first.replace(tzinfo=None), "us")
    return Drive(table["drive_id"][0].as_py(), frame, line, t_start)


def pick_scene(
    layer: pa.Table,
    drives: Sequence[Drive],
    *,
    source: Path,
    corridor_m: float,
    groups: Sequence[str],
    cell_m: float,
    respect_facing: bool = False,
) -> Scene:
    """Pick the main signs of some groups near the drives, equal classes at one point counted once.

    Parameters
    ----------
    layer
        A `signs` table.
    drives
        The drives; the scene is in their frame.
    source
        Where the layer came from, for messages.
    corridor_m
        Signs at most this far from the drive are the scene.
    groups
        Groups of the taxonomy.
    cell_m
        See `SignField`.
    respect_facing
        Signs whose facing is known are seen from their front only.

    Raises
    ------
    ConfigError
        A group is unknown.
    InputError
        No sign of the layer belongs to the scene.
    """
    layer = _signs_of_groups(layer, groups, source)
    lon, lat = lonlat(layer)
    frame = drives[0].frame
    near = np.any([within_corridor(lon, lat, frame, drive.line, corridor_m) for drive in drives], axis=0)
    if not near.any():
        away_m, drive = min(((nearest_m(lon, lat, frame, d.line), d) for d in drives), key=lambda pair: pair[0])
        raise InputError(
            f"no sign is within {corridor_m:g} m of the drive {drive.drive_id!r}; the nearest of {layer.num_rows} is "
            f"{away_m:,.0f} m away.",
            where=str(source),
            todo="Give signs and a drive of the same place, or set corridor_m wider.",
        )
    layer, xy_m = layer.filter(pa.array(near)), frame.to_enu(lon[near], lat[near])
    kept = ~is_repeated(xy_m, layer["sign_class"].to_pylist(), layer["support_id"].to_pylist())
    layer, xy_m = layer.filter(pa.array(kept)), xy_m[kept]
    classes, code = np.unique(np.array(layer["sign_class"].to_pylist(), dtype=object), return_inverse=True)
    facing_rad = _facing_rad(layer, source) if respect_facing else None
    field = SignField(xy_m, code, n_classes=len(classes), cell_m=cell_m, facing_rad=facing_rad)
    concepts = [class_.partition(":")[0] if not class_.startswith("raw:") else class_ for class_ in classes]
    sign_ids = np.array(layer["sign_id"].to_pylist(), dtype=object)
    return Scene(layer, field, sign_ids, classes, load_taxonomy().group_of(concepts))


def _facing_rad(layer: pa.Table, source: Path) -> NDArray[np.float64]:
    """Return the way each face looks, counter-clockwise from east, NaN where unknown."""
    facing_deg = layer["facing_deg"].to_numpy().astype(np.float64)
    if np.isnan(facing_deg).all():
        raise InputError(
            f"none of the {len(facing_deg)} signs of the scene has a facing to respect.",
            where=str(source),
            todo="Give a layer with facing_deg, or set respect_facing to false.",
        )
    facing_rad: NDArray[np.float64] = np.deg2rad(90.0 - facing_deg)
    return facing_rad


def _signs_of_groups(layer: pa.Table, groups: Sequence[str], source: Path) -> pa.Table:
    taxonomy = load_taxonomy()
    unknown = sorted(set(groups) - set(taxonomy.groups))
    if unknown:
        raise ConfigError(
            f"unknown group {', '.join(unknown)}.",
            where="[scene] groups",
            todo=f"Groups are {', '.join(taxonomy.groups)}.",
        )
    layer = layer.select(SIGNS.arrow(()).names)
    is_main = pc.equal(layer["kind"], "main").to_numpy()
    is_wanted = np.isin(taxonomy.group_of(layer["concept"].to_pylist()).astype(str), list(groups))
    found = layer.filter(pa.array(is_main & is_wanted)).sort_by("sign_id")
    if not found.num_rows:
        raise InputError(
            f"none of the {layer.num_rows} signs is a main sign of the groups {', '.join(groups)}.",
            where=str(source),
            todo="Give another layer, or name other groups in [scene] groups.",
        )
    return found
