"""What a simulation writes, as tables: `detections`, `passes`, `truth`, `reference` and `runs`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import shapely

from geofleet.tables.schemas import BBOX, DETECTIONS, GEOMETRY, PASSES, REFERENCE, RUNS, TRUTH
from geofleet.tables.store import build_table, lonlat

if TYPE_CHECKING:
    from collections.abc import Mapping

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


def detections_table(
    ids: PassIds, tracks: Tracks, classes: NDArray[np.object_], frame: EnuFrame, times: Times | None
) -> pa.Table:
    """Return what a pass sends; `classes` names the codes, `times` is the time of every frame."""
    columns = {
        "run_id": ids.run_id,
        "vehicle_id": ids.vehicle_id,
        "pass_id": ids.pass_id,
        "track_id": np.arange(len(tracks.n_frames)),
        "t_first": None if times is None else times[tracks.frame_first],
        "t_last": None if times is None else times[tracks.frame_last],
        "frame_first": tracks.frame_first,
        "frame_last": tracks.frame_last,
        "n_frames": tracks.n_frames,
        "sigma_e_m": tracks.sigma_e_m,
        "sigma_n_m": tracks.sigma_n_m,
        "cov_en_m2": tracks.cov_en_m2,
        "range_mean_m": tracks.range_mean_m,
        "view_deg": (90.0 - np.rad2deg(tracks.azimuth_rad)) % 360.0,
        "sign_class": pa.array(classes[tracks.class_code], pa.string()),
        "class_confidence": tracks.class_confidence,
    }
    if tracks.information is not None:
        columns |= _information(tracks.information, frame)
    return build_table(DETECTIONS, columns, geometry=frame.to_lonlat(tracks.xy_m))


def _information(form: Information, frame: EnuFrame) -> dict[str, object]:
    lon, lat = frame.to_lonlat(form.origin_xy_m)
    upper = np.ascontiguousarray(form.matrix[:, *_UPPER])
    return {
        "info_lon": lon,
        "info_lat": lat,
        "info_matrix": pa.FixedSizeListArray.from_arrays(upper.ravel(), upper.shape[1]),
        "info_vector": pa.FixedSizeListArray.from_arrays(form.vector.ravel(), form.vector.shape[1]),
        "info_s0": form.s0,
        "info_dof": form.dof,
    }


def passes_table(
    ids: PassIds,
    reported: Poses,
    frame: EnuFrame,
    times: Times | None,
    *,
    drive_id: str,
    sensor: SensorConfig,
    declared: Declared,
    frame_spacing_m: float,
) -> pa.Table:
    """Return the row of a pass: the way that it believes it drove, what its sensor can see, and what it declares."""
    path = shapely.linestrings(np.column_stack(frame.to_lonlat(reported.xy_m)))
    return build_table(
        PASSES,
        {
            "run_id": ids.run_id,
            "vehicle_id": ids.vehicle_id,
            "pass_id": ids.pass_id,
            "sensor_id": f"{ids.vehicle_id}-s0",
            "sensor_kind": sensor.sensor_kind,
            "drive_id": drive_id,
            "t_start": None if times is None else times[:1],
            "t_end": None if times is None else times[-1:],
            "range_m": sensor.range_m,
            "fov_deg": sensor.fov_deg,
            "frame_spacing_m": frame_spacing_m,
            **asdict(declared),
        },
        geometry=[path],
    )


def truth_table(ids: PassIds, tracks: Tracks, scene: Scene) -> pa.Table:
    """Return which sign each track came from; what came from none, or from a billboard, is a ghost."""
    is_ghost = tracks.sign < 0
    sign = np.where(is_ghost, 0, tracks.sign)
    true_code = scene.field.class_code[sign]
    return build_table(
        TRUTH,
        {
            "run_id": ids.run_id,
            "pass_id": ids.pass_id,
            "track_id": np.arange(len(tracks.sign)),
            "ref_sign_id": pa.array(scene.sign_ids[sign], pa.string(), mask=is_ghost),
            "ref_sign_class": pa.array(scene.classes[true_code], pa.string(), mask=is_ghost),
            "semantic_correct": ~is_ghost & (true_code == tracks.class_code),
            "is_ghost": is_ghost,
        },
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
