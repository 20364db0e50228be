"""What a simulation writes, as tables: `detections`, `passes`, `truth`, `reference` and `runs`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import shapely

from geofleet.tables.schemas import BBOX, DETECTIONS, GEOMETRY, PASSES, REFERENCE, RUNS, TRUTH
from geofleet.tables.store import arrow_numbers, arrow_texts, build_table, lonlat

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
_NEVER = np.datetime64("NaT", "us")
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
class SimulatedPass:
    """What is kept of a pass: its names and sensor, the way that it believes it drove, and what it sends.

    `times` is the time of every frame, `frame_spacing_m` the distance between two.
    """

    ids: PassIds
    drive_id: str
    sensor: SensorConfig
    declared: Declared
    frame_spacing_m: float
    reported: Poses
    times: Times | None
    tracks: Tracks


def detections_table(passes: Sequence[SimulatedPass], classes: NDArray[np.object_], frame: EnuFrame) -> pa.Table:
    """Return what some passes of a run send; `classes` names the codes."""
    columns: dict[str, object] = {name: _of_tracks(passes, name) for name in _AS_SENT}
    columns |= _keys(passes) | {
        "vehicle_id": _of_each(passes, [one.ids.vehicle_id for one in passes]),
        "t_first": _times(passes, "frame_first"),
        "t_last": _times(passes, "frame_last"),
        "view_deg": (90.0 - np.rad2deg(_of_tracks(passes, "azimuth_rad"))) % 360.0,
        "sign_class": _named(classes, _of_tracks(passes, "class_code")),
    }
    forms = [one.tracks.information for one in passes if one.tracks.information is not None]
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


def passes_table(passes: Sequence[SimulatedPass], frame: EnuFrame) -> pa.Table:
    """Return a row a pass: the way that it believes it drove, what its sensor can see, and what it declares."""
    lonlat_deg = np.column_stack(frame.to_lonlat(np.concatenate([one.reported.xy_m for one in passes])))
    number = np.repeat(np.arange(len(passes)), [len(one.reported.xy_m) for one in passes])
    rows = [
        {
            "pass_id": one.ids.pass_id,
            "vehicle_id": one.ids.vehicle_id,
            "sensor_id": f"{one.ids.vehicle_id}-s0",
            "sensor_kind": one.sensor.sensor_kind,
            "drive_id": one.drive_id,
            "range_m": one.sensor.range_m,
            "fov_deg": one.sensor.fov_deg,
            "frame_spacing_m": one.frame_spacing_m,
            **asdict(one.declared),
        }
        for one in passes
    ]
    columns: dict[str, object] = {name: [row[name] for row in rows] for name in rows[0]}
    ends = {
        name: np.array([_NEVER if one.times is None else one.times[at] for one in passes], _NEVER.dtype)
        for name, at in (("t_start", 0), ("t_end", -1))
    }
    return build_table(
        PASSES,
        columns | ends | {"run_id": passes[0].ids.run_id},
        geometry=shapely.linestrings(lonlat_deg, indices=number),
    )


def truth_table(passes: Sequence[SimulatedPass], scene: Scene) -> pa.Table:
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


def _keys(passes: Sequence[SimulatedPass]) -> dict[str, object]:
    return {
        "run_id": passes[0].ids.run_id,
        "pass_id": _of_each(passes, [one.ids.pass_id for one in passes]),
        "track_id": np.concatenate([np.arange(len(one.tracks.sign)) for one in passes]),
    }


def _of_tracks(passes: Sequence[SimulatedPass], name: str) -> NDArray[Any]:
    """Return something of all tracks of all passes, one after the other."""
    return np.concatenate([getattr(one.tracks, name) for one in passes])


def _of_each(passes: Sequence[SimulatedPass], texts: list[str]) -> pa.Array:
    """Return a text a pass, repeated for each of its tracks."""
    number = np.repeat(np.arange(len(passes)), [len(one.tracks.sign) for one in passes])
    return arrow_texts(texts).take(arrow_numbers(number))


def _named(names: NDArray[np.object_], code: Ints) -> pa.Array:
    """Return the name of each code; -1 has none."""
    index = arrow_numbers(np.where(code < 0, np.nan, code)).cast(pa.int64())
    return arrow_texts(names.tolist()).take(index)


def _times(passes: Sequence[SimulatedPass], name: str) -> Times:
    """Return the time of a frame of every track, where the drive is dated."""
    return np.concatenate(
        [
            np.full(len(one.tracks.sign), _NEVER) if one.times is None else one.times[getattr(one.tracks, name)]
            for one in passes
        ]
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
