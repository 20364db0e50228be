"""Joint fusion of one run, from rows to rows: tracks, passes and a prior map in, signs and their evidence out.

A run is estimated as a whole: the offset and calibration of a pass are one unknown, however many tiles it crosses, so
tiles have no part in it. What bounds it is the plane of the run (`MAX_EXTENT_M`) and memory, about 2 kB a detection.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.algorithms.fusion import ID_SHIFT, POSITION_DIGITS, hash_members
from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.joint import fuse_joint
from geofleet.algorithms.joint_search import BEYOND_CHI2, PriorMap
from geofleet.algorithms.joint_tracks import places
from geofleet.engines.whole import MAX_EXTENT_M
from geofleet.errors import InputError
from geofleet.tables.dealt import NEVER_BEGUN, NEVER_ENDED
from geofleet.tables.schemas import EVIDENCE, NUISANCE
from geofleet.tables.store import build_table, lonlat
from geofleet.tables.tracks import Assumed, Fleet, fleet_arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.joint import JointMap

    Columns = dict[str, NDArray[Any]]
    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

IN_MAP = 0.5
"""A sign is in the map when its existence times its class confidence is above this: each is likelier in than out."""
SUSPECT_NOISE = 2.0
ALONE_LEAST, ALONE_CHANCES = 4, 3
"""So many detections, and most of its own, of signs that others had in view, so many passes in all, and do not report:
such a pass is not where it says."""
TOLD_PASSES = 5
"""So many suspect passes are named in a note; the table has all."""
PRIOR_OFF_M = 0.3
"""A prior map that lies further off than this, three standard deviations of a good one, is told."""
PRIOR_NAME = "prior map"


@dataclass(frozen=True, slots=True)
class JointTask:
    """What a run brings; `prior` is a `signs` layer, `classes` the meaning of class codes in every run."""

    run_id: str
    run_code: int
    tracks: pa.Table
    passes: pa.Table | None
    prior: pa.Table | None
    classes: tuple[str, ...]
    assumed: Assumed
    prior_sigma_m: float


@dataclass(frozen=True, slots=True, eq=False)
class JointResult:
    """Signs of the map as columns of clusters, all evidence, and notes for the user."""

    clusters: Columns
    evidence: pa.Table
    nuisance: pa.Table
    n_candidates: int
    notes: tuple[str, ...]


def fuse_run(task: JointTask) -> JointResult:
    """Fuse one run.

    Raises
    ------
    InputError
        The run is too wide for one plane.
    """
    frame = _frame(task)
    class_code = _codes(task.tracks["sign_class"], task.classes)
    fleet = fleet_arrays(task.tracks, task.passes, class_code=class_code, frame=frame, assumed=task.assumed)
    prior = _prior(task, task.prior, frame) if task.prior is not None and task.prior.num_rows else None
    found = fuse_joint(
        fleet.tracks, fleet.passes, n_classes=len(task.classes), views=fleet.views, view_xy=fleet.view_xy, prior=prior
    )
    hashes = _hashes(task, found)
    nuisance = _nuisance(task, fleet, found)
    in_map = found.existence * found.class_probability > IN_MAP
    if fleet.views is not None:  # what stands in a prior map where nobody drove is not this fleet's to say
        in_map &= (found.n_passes > 0) | (found.n_chances > 0)
    return JointResult(
        _clusters(task, found, frame, hashes, in_map),
        _evidence(task, fleet, found, hashes, in_map),
        nuisance,
        len(found.xy_m),
        _notes(task, fleet, found) + _warnings(task, nuisance),
    )


def _frame(task: JointTask) -> EnuFrame:
    lon, lat = (task.tracks[name].to_numpy() for name in ("lon", "lat"))
    frame = EnuFrame.around(lon, lat)
    reach_m = float(np.abs(frame.to_enu(lon, lat)).max())
    if not reach_m <= MAX_EXTENT_M:
        raise InputError(
            f"detections of run {task.run_id} lie up to {reach_m / 1000:.0f} km from their middle, not "
            f"{MAX_EXTENT_M / 1000:.0f} at most.",
            where="joint fusion",
            todo="Give a smaller area, or use method=dbscan.",
        )
    return frame


def _codes(names: pa.ChunkedArray, classes: tuple[str, ...]) -> Ints:
    return np.asarray(pc.index_in(names, pa.array(classes, pa.string())).to_numpy(), np.int64)


def _prior(task: JointTask, table: pa.Table, frame: EnuFrame) -> PriorMap:
    """Return the prior map; its variance is part of its layer, `prior_sigma_m` where it is not."""
    variance = np.full(table.num_rows, task.prior_sigma_m**2)
    if "var_e_m2" in table.column_names and "var_n_m2" in table.column_names:
        told = (table["var_e_m2"].to_numpy() + table["var_n_m2"].to_numpy()) / 2
        variance = np.where(np.isfinite(told) & (told > 0), told, variance)
    facing = np.asarray(table["facing_deg"].cast(pa.float64()).to_numpy(), np.float64)
    view = np.deg2rad(270.0 - facing)  # the other way round, from clockwise from north to counter-clockwise from east
    return PriorMap(
        frame.to_enu(*lonlat(table)),
        np.sqrt(variance),
        _codes(table["sign_class"], task.classes),
        np.nan_to_num(np.column_stack((np.cos(view), np.sin(view)))),
    )


def _hashes(task: JointTask, found: JointMap) -> NDArray[np.uint64]:
    """Return a hash of each sign's detections; of a sign that only the prior map has, of its id there."""
    n = len(found.xy_m)
    order = np.argsort(found.sign_of_track, kind="stable")
    first = np.searchsorted(found.sign_of_track[order], np.arange(n + 1))
    pass_hash, track_id = (task.tracks[name].to_numpy()[order] for name in ("pass_hash", "track_id"))
    hashes = hash_members(np.asarray(pass_hash, np.uint64), np.asarray(track_id, np.int64), first)
    for sign in np.flatnonzero(np.diff(first) == 0).tolist():
        name = (
            f"{task.run_id}/{PRIOR_NAME}/{found.xy_m[sign, 0]:.3f}/{found.xy_m[sign, 1]:.3f}/{found.class_code[sign]}"
        )
        hashes[sign] = int.from_bytes(hashlib.md5(name.encode(), usedforsecurity=False).digest()[:8], "big")
    return hashes


def _clusters(
    task: JointTask, found: JointMap, frame: EnuFrame, hashes: NDArray[np.uint64], in_map: NDArray[np.bool_]
) -> Columns:
    if not in_map.any():
        return {}
    lon, lat = frame.to_lonlat(found.xy_m[in_map])
    n = len(found.xy_m)
    begun, ended = np.full(n, NEVER_BEGUN), np.full(n, NEVER_ENDED)
    np.minimum.at(begun, found.sign_of_track, pc.fill_null(task.tracks["t_first_us"], NEVER_BEGUN).to_numpy())
    np.maximum.at(ended, found.sign_of_track, pc.fill_null(task.tracks["t_last_us"], NEVER_ENDED).to_numpy())
    columns: Columns = {
        "run_code": np.full(int(in_map.sum()), task.run_code, np.int64),
        "lon": np.round(lon, POSITION_DIGITS),
        "lat": np.round(lat, POSITION_DIGITS),
        "var_e_m2": found.cov_m2[in_map, 0, 0],
        "var_n_m2": found.cov_m2[in_map, 1, 1],
        "cov_en_m2": found.cov_m2[in_map, 0, 1],
        "class_code": found.class_code[in_map],
        "class_confidence": found.class_probability[in_map],
        "existence": found.existence[in_map],
        "n_passes": found.n_passes[in_map],
        "n_detections": found.n_tracks[in_map],
        "hash": hashes[in_map],
        "t_first_us": begun[in_map],
        "t_last_us": ended[in_map],
    }
    if task.passes is not None:
        columns["n_opportunities"] = found.n_chances[in_map].astype(np.int64)
    return columns


def _evidence(
    task: JointTask, fleet: Fleet, found: JointMap, hashes: NDArray[np.uint64], in_map: NDArray[np.bool_]
) -> pa.Table:
    n_fleet = len(fleet.passes.gnss_sigma_m)
    tracks, sign = fleet.tracks, found.sign_of_track
    xy_m, cov = places(tracks, found.nuisance[:n_fleet, 2:], np.zeros((n_fleet, 2, 2)))
    residual = xy_m - found.nuisance[tracks.pass_code, :2] - found.xy_m[sign]
    jitter = found.jitter_m[tracks.pass_code, None, None] ** 2 * np.eye(2)
    whole = cov * found.noise_factor[tracks.pass_code, None, None] + jitter
    names = np.array([f"f{number:012x}" for number in (hashes >> ID_SHIFT).tolist()], object)
    classes = np.array(task.classes, object)
    return build_table(
        EVIDENCE,
        {
            "run_id": task.run_id,
            "pass_id": task.tracks["pass_id"].combine_chunks(),
            "track_id": task.tracks["track_id"].to_numpy(),
            "sign_id": pa.array(names[sign], pa.string()),
            "is_in_map": in_map[sign],
            "existence": found.existence[sign],
            "sign_class": pa.array(classes[found.class_code[sign]], pa.string()),
            "read_class": pa.array(classes[tracks.class_code], pa.string()),
            "residual_e_m": residual[:, 0],
            "residual_n_m": residual[:, 1],
            "chi2": np.einsum("ti,ti->t", residual, np.linalg.solve(whole, residual[:, :, None])[:, :, 0]),
        },
    )


def _nuisance(task: JointTask, fleet: Fleet, found: JointMap) -> pa.Table:
    """Return a row a pass that reports, and one for the prior map."""
    n_fleet = len(fleet.passes.gnss_sigma_m)
    count = np.bincount(fleet.tracks.pass_code, minlength=n_fleet)
    rows = np.append(np.flatnonzero(count > 0), np.arange(n_fleet, len(found.nuisance)))
    sigma = np.column_stack((fleet.passes.gnss_sigma_m, fleet.passes.gnss_sigma_m, fleet.passes.bias_sigma))
    sigma = np.concatenate((sigma, np.full((len(found.nuisance) - n_fleet, 4), np.inf)))
    nuisance = found.nuisance[rows]
    squared = (nuisance / np.where(sigma[rows] > 0, sigma[rows], np.inf)) ** 2
    offset_chi2, bias_chi2 = squared[:, :2].sum(axis=1), squared[:, 2:].sum(axis=1)
    extra = len(found.nuisance) - n_fleet
    noise = np.append(found.noise_factor[:n_fleet], np.ones(extra))[rows]
    kinds = [fleet.kinds[code] for code in fleet.passes.kind_code.tolist()] + [PRIOR_NAME] * extra
    names = [*fleet.pass_ids, *[PRIOR_NAME] * extra]
    is_alone = ((found.n_passes == 1) & (found.n_chances >= ALONE_CHANCES))[found.sign_of_track]
    alone = np.bincount(fleet.tracks.pass_code[is_alone], minlength=n_fleet)
    n_tracks, n_alone = (np.append(n, np.zeros(extra, np.int64))[rows] for n in (count, alone))
    is_lost = (n_alone >= ALONE_LEAST) & (2 * n_alone > n_tracks)
    return build_table(
        NUISANCE,
        {
            "run_id": task.run_id,
            "pass_id": [names[row] for row in rows.tolist()],
            "sensor_kind": [kinds[row] for row in rows.tolist()],
            "n_detections": n_tracks,
            "n_alone": n_alone,
            "offset_e_m": nuisance[:, 0],
            "offset_n_m": nuisance[:, 1],
            "range_bias_m": nuisance[:, 2],
            "bearing_bias_deg": np.rad2deg(nuisance[:, 3]),
            "offset_chi2": offset_chi2,
            "bias_chi2": bias_chi2,
            "noise_factor": noise,
            "jitter_m": found.jitter_m[rows],
            "is_suspect": (np.maximum(offset_chi2, bias_chi2) > BEYOND_CHI2) | (noise > SUSPECT_NOISE) | is_lost,
        },
    )


def _notes(task: JointTask, fleet: Fleet, found: JointMap) -> tuple[str, ...]:
    """Return what was learnt, a sensor kind each, and whether the search settled."""
    notes = []
    code = fleet.passes.kind_code
    reports = np.bincount(fleet.tracks.pass_code, minlength=len(code)) > 0
    for kind, name in enumerate(fleet.kinds):
        mine = np.flatnonzero((code == kind) & reports)
        if mine.size and task.passes is not None:
            noise, jitter_m = np.sqrt(np.median(found.noise_factor[mine])), np.median(found.jitter_m[mine])
            notes.append(
                f"{task.run_id}, {name or 'sensor'}: {mine.size} passes; noise {noise:.2f} times what they declare, "
                f"{jitter_m:.2f} m beyond it; {found.recognition.error_rate[kind]:.1%} of tracks misread."
            )
    if task.passes is not None:
        notes.append(
            f"{task.run_id}: passes report {found.rates.detection_rate:.1%} of the signs that they have in view, and "
            f"{found.rates.clutter_per_pass:.2f} tracks of nothing each."
        )
    if not found.is_settled:
        notes.append(
            f"{task.run_id}: the association still changed after {found.n_rounds} rounds; the last one is kept."
        )
    return tuple(notes)


def _warnings(task: JointTask, nuisance: pa.Table) -> tuple[str, ...]:
    """Return what a user should look at: passes that are far from what they declare, and a prior map that is off."""
    warnings = []
    suspect = nuisance.filter(nuisance["is_suspect"]).to_pylist()
    if suspect:
        worst = sorted(suspect, key=lambda row: -max(row["offset_chi2"], row["bias_chi2"]))[:TOLD_PASSES]
        told = "; ".join(
            f"{row['pass_id']} (offset {row['offset_e_m']:+.1f} m east {row['offset_n_m']:+.1f} m north, range "
            f"{row['range_bias_m']:+.1f} m, bearing {row['bearing_bias_deg']:+.1f}°, "
            f"noise {row['noise_factor'] ** 0.5:.1f} times, alone with {row['n_alone']} of {row['n_detections']} signs)"
            for row in worst
        )
        more = f"; and {len(suspect) - len(worst)} more" if len(suspect) > len(worst) else ""
        warnings.append(
            f"{task.run_id}: {len(suspect)} of {nuisance.num_rows - (task.prior is not None)} passes are far from what "
            f"they declare: {told}{more}. What the tracks of a pass "
            "have in common is taken out and, beyond what it declares, draws no other pass along; noise lowers its "
            "weight. Look at the sensor, or at its declaration."
        )
    warnings += [
        f"{task.run_id}: the prior map lies {row['offset_e_m']:+.2f} m east, {row['offset_n_m']:+.2f} m north of where "
        "the fleet sees it; it was moved by as much."
        for row in nuisance.filter(pc.equal(nuisance["pass_id"], PRIOR_NAME)).to_pylist()
        if np.hypot(row["offset_e_m"], row["offset_n_m"]) > PRIOR_OFF_M
    ]
    return tuple(warnings)
