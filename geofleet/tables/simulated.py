"""What a simulation writes, as tables: `detections`, `passes`, `truth`, `reference` and `runs`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import shapely

from geofleet.tables.arrays import arrow_numbers, arrow_texts
from geofleet.tables.schemas import BBOX, DETECTIONS, GEOMETRY, PASSES, REFERENCE, RUNS, TRUTH
from geofleet.tables.store import build_table, lonlat

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    from geofleet.algorithms.geodesy import EnuFrame
    from geofleet.algorithms.information import Information
    from geofleet.algorithms.tracking import Tracks
    from geofleet.algorithms.trajectory import Poses
    from geofleet.config import Config, SensorConfig
    from geofleet.tables.declared import Declared
    from geofleet.tables.scenes import Scene

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Times = NDArray[np.datetime64]

_UPPER = np.triu_indices(4)
_AS_SENT = (
    *("frame_first", "frame_last", "n_frames", "sigma_e_m", "sigma_n_m", "cov_en_m2"),
    *("range_mean_m", "class_confidence"),
)
"""Columns of `detections` that are fields of `Tracks`."""


@dataclass(frozen=True, slots=True)
class PassIds:
    """The names of a pass."""

    run_id: str
    vehicle_id: str
    pass_id: str

    @classmethod
    def of(cls, run_id: str, vehicle: int) -> PassIds:
        """Name the one pass of a vehicle."""
        return cls(run_id, f"v{vehicle:05d}", f"v{vehicle:05d}-p0")


@dataclass(frozen=True, slots=True)
class SimulatedPasses:
    """What is kept of passes with one kind of sensor: the ways that they believe they drove, and what they send.

    Parameters
    ----------
    ids, drive_ids, frame_spacing_m
        Of each pass: its names, its drive, the distance between two frames.
    pass_start
        First frame of each pass and, last, the number of all, shape (n_passes + 1,).
    reported, times
        Of every frame of all passes, one after the other; without a dated drive a time is NaT.
    tracks
        Of all passes, one after the other.
    """

    ids: Sequence[PassIds]
    drive_ids: Sequence[str]
    frame_spacing_m: Sequence[float]
    sensor: SensorConfig
    declared: Declared
    pass_start: Ints
    reported: Poses
    times: Times
    tracks: Tracks

    @property
    def n_tracks(self) -> list[int]:
        """How many tracks each pass sends."""
        counts: list[int] = np.bincount(self.tracks.pass_number, minlength=len(self.ids)).tolist()
        return counts


def detections_table(passes: Sequence[SimulatedPasses], classes: NDArray[np.object_], frame: EnuFrame) -> pa.Table:
    """Return what some passes of a run send; `classes` names the codes."""
    columns: dict[str, object] = {name: _of_tracks(passes, name) for name in _AS_SENT}
    columns |= _keys(passes) | {
        "vehicle_id": _of_each(passes, "vehicle_id"),
        "t_first": _times(passes, "frame_first"),
        "t_last": _times(passes, "frame_last"),
        "view_deg": (90.0 - np.rad2deg(_of_tracks(passes, "azimuth_rad"))) % 360.0,
        "sign_class": _named(classes, _of_tracks(passes, "class_code")),
    }
    forms = [group.tracks.information for group in passes if group.tracks.information is not None]
    if forms:
        columns |= _information(forms, frame)
    return build_table(DETECTIONS, columns, geometry=frame.to_lonlat(_of_tracks(passes, "xy_m")))


def _information(forms: list[Information], frame: EnuFrame) -> dict[str, object]:
    lon, lat = frame.to_lonlat(np.concatenate([form.origin_xy_m for form in forms]))
    upper = np.ascontiguousarray(np.concatenate([form.matrix[:, *_UPPER] for form in forms]))
    vector = np.concatenate([form.vector for form in forms])
    return {
        "info_lon": lon,
        "info_lat": lat,
        "info_matrix": pa.FixedSizeListArray.from_arrays(arrow_numbers(upper.ravel()), upper.shape[1]),
        "info_vector": pa.FixedSizeListArray.from_arrays(arrow_numbers(vector.ravel()), vector.shape[1]),
        "info_s0": np.concatenate([form.s0 for form in forms]),
        "info_dof": np.concatenate([form.dof for form in forms]),
    }


def passes_table(passes: Sequence[SimulatedPasses], frame: EnuFrame) -> pa.Table:
    """Return a row a pass: the way that it believes it drove, what its sensor can see, and what it declares."""
    rows = [
        {
            "pass_id": ids.pass_id,
            "vehicle_id": ids.vehicle_id,
            "sensor_id": f"{ids.vehicle_id}-s0",
            "sensor_kind": group.sensor.sensor_kind,
            "drive_id": drive_id,
            "range_m": group.sensor.range_m,
            "fov_deg": group.sensor.fov_deg,
            "frame_spacing_m": frame_spacing_m,
            **declared,
        }
        for group, declared in ((group, asdict(group.declared)) for group in passes)
        for ids, drive_id, frame_spacing_m in zip(group.ids, group.drive_ids, group.frame_spacing_m, strict=True)
    ]
    columns: dict[str, object] = {name: [row[name] for row in rows] for name in rows[0]}
    columns["t_start"] = np.concatenate([group.times[group.pass_start[:-1]] for group in passes])
    columns["t_end"] = np.concatenate([group.times[group.pass_start[1:] - 1] for group in passes])
    lonlat_deg = np.column_stack(frame.to_lonlat(np.concatenate([group.reported.xy_m for group in passes])))
    n_frames = np.concatenate([np.diff(group.pass_start) for group in passes])
    return build_table(
        PASSES,
        columns | {"run_id": passes[0].ids[0].run_id},
        geometry=shapely.linestrings(lonlat_deg, indices=np.repeat(np.arange(len(rows)), n_frames)),
    )


def truth_table(passes: Sequence[SimulatedPasses], scene: Scene) -> pa.Table:
    """Return which sign each track of some passes came from; of none, or of a billboard: a ghost."""
    origin = _of_tracks(passes, "sign")
    is_ghost = origin < 0
    sign = np.where(is_ghost, 0, origin)
    true_code = scene.field.class_code[sign]
    columns = {
        "ref_sign_id": _named(scene.sign_ids, np.where(is_ghost, -1, sign)),
        "ref_sign_class": _named(scene.classes, np.where(is_ghost, -1, true_code)),
        "semantic_correct": ~is_ghost & (true_code == _of_tracks(passes, "class_code")),
        "is_ghost": is_ghost,
    }
    return build_table(TRUTH, _keys(passes) | columns)


def _keys(passes: Sequence[SimulatedPasses]) -> dict[str, object]:
    return {
        "run_id": passes[0].ids[0].run_id,
        "pass_id": _of_each(passes, "pass_id"),
        "track_id": np.concatenate([_track_ids(group) for group in passes]),
    }


def _track_ids(group: SimulatedPasses) -> Ints:
    """Count the tracks of each pass from 0."""
    number = group.tracks.pass_number
    ids: Ints = np.arange(len(number)) - np.searchsorted(number, number)
    return ids


def _of_tracks(passes: Sequence[SimulatedPasses], name: str) -> NDArray[Any]:
    """Return something of all tracks of all passes, one after the other."""
    return np.concatenate([getattr(group.tracks, name) for group in passes])


def _of_each(passes: Sequence[SimulatedPasses], name: str) -> pa.Array:
    """Return a name of the pass of every track."""
    parts = [arrow_texts([getattr(ids, name) for ids in group.ids]) for group in passes]
    return pa.concat_arrays([p.take(arrow_numbers(g.tracks.pass_number)) for p, g in zip(parts, passes, strict=True)])


def _named(names: NDArray[np.object_], code: Ints) -> pa.Array:
    """Return the name of each code; -1 has none."""
    index = arrow_numbers(np.where(code < 0, np.nan, code)).cast(pa.int64())
    return arrow_texts(names.tolist()).take(index)


def _times(passes: Sequence[SimulatedPasses], name: str) -> Times:
    """Return the time of a frame of every track, where the drive is dated."""
    return np.concatenate(
        [group.times[group.pass_start[group.tracks.pass_number] + getattr(group.tracks, name)] for group in passes]
    )


def reference_table(scene: Scene, run_id: str, n_passes: Ints, n_frames: Ints) -> pa.Table:
    """Return the signs of the scene with how many passes and frames had each in view."""
    columns = {
        name: scene.table[name].combine_chunks() for name in scene.table.column_names if name not in (GEOMETRY, BBOX)
    }
    counts = {"run_id": run_id, "n_passes_in_view": n_passes, "n_frames_in_view": n_frames}
    return build_table(REFERENCE, columns | counts, geometry=lonlat(scene.table))


def runs_table(config: Config, replicate_of: Mapping[str, int], *, seed: int, n_vehicles: int, digest: str) -> pa.Table:
    """Return a row a run, given the number of its replicate."""
    return build_table(
        RUNS,
        {
            "run_id": list(replicate_of),
            "scenario": config.scenario,
            "seed": seed,
            "replicate": list(replicate_of.values()),
            "n_vehicles": n_vehicles,
            "tracker": config.tracking.tracker,
            "upload": "information" if config.tracking.sends_information else "mean",
            "config_digest": digest,
        },
    )
