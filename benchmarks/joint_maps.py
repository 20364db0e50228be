"""Maps of a simulated run by every method of the benchmark of joint fusion, with what is known of their quality."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.algorithms.joint import fuse_joint
from geofleet.algorithms.joint_search import PriorMap
from geofleet.algorithms.joint_solution import solve
from geofleet.algorithms.joint_tracks import with_jitter
from geofleet.algorithms.staleness import REMOVED, Staleness, make_stale, sign_keys
from geofleet.config import load_config
from geofleet.steps.aggregate import aggregate
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import lonlat, read_table
from geofleet.workflows.study.methods import METHODS, with_settings

if TYPE_CHECKING:
    from pathlib import Path

    from joint_fleets import Case, Run
    from numpy.typing import NDArray

    from geofleet.algorithms.joint import JointMap
    from geofleet.algorithms.metrics import MapScore

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

STALE = Staleness(removed=0.15, retyped=0.1, moved=0.1, obsolete=0.1, moved_m=5.0, sigma_m=0.15)
KNOWN_JITTER_M = 0.02
"""What the known-association estimator allows for beside the declared noise, an axis: its few weak tracks need it."""
ACCEPTED = 0.5
"""A sign is in the map when it likely exists and has the class that it is given."""


def joint(run: Run, prior: PriorMap | None = None) -> JointMap:
    """Return the joint map."""
    fleet = run.fleet
    return fuse_joint(
        fleet.tracks, fleet.passes, n_classes=len(run.classes), views=fleet.views, view_xy=fleet.view_xy, prior=prior
    )


def accepted(fused: JointMap) -> NDArray[np.bool_]:
    """Return which signs are in the map."""
    likely: NDArray[np.bool_] = fused.existence * fused.class_probability > ACCEPTED
    return likely


def score_joint(run: Run, fused: JointMap) -> MapScore:
    """Score the signs that are in the map."""
    kept = accepted(fused)
    return run.score(fused.xy_m[kept], fused.class_code[kept])


@dataclass(frozen=True, eq=False)
class Known:
    """What the truth about every track allows: nobody can do better without knowing where the passes really were."""

    xy_m: Floats
    cov_m2: Floats
    """(2 n, 2 n), of all signs together."""
    score: MapScore


def known(run: Run) -> Known:
    """Return the map of the known association: solved as joint fusion solves, and the covariance by dense algebra.

    The covariance is the Cramér-Rao bound, Bayesian in offset and bias, at the information that the tracks send.
    """
    is_sign = run.true_sign >= 0
    tracks = run.fleet.tracks.take(is_sign)
    tracks = with_jitter(tracks, np.full(len(tracks.pass_code), KNOWN_JITTER_M))
    sign = np.searchsorted(run.reported, run.true_sign[is_sign])
    n, passes = len(run.reported), run.fleet.passes
    nuisance = np.zeros((len(passes.gnss_sigma_m), 4))
    for _ in range(2):
        solution = solve(tracks, passes, sign, n, nuisance, with_cov=False)
        nuisance = solution.nuisance
    information = np.zeros((2 * n, 2 * n))
    sigma = np.column_stack((passes.gnss_sigma_m, passes.gnss_sigma_m, passes.bias_sigma))
    for v in np.unique(tracks.pass_code):
        rows = np.flatnonzero(tracks.pass_code == v)
        design = np.zeros((len(rows), 2, 2 * n))
        for r, k in enumerate(sign[rows]):
            design[r, :, 2 * k : 2 * k + 2] = np.eye(2)
        coupling = np.einsum("tij,tjk->ik", tracks.matrix[rows][:, :, :2], design)
        own = np.linalg.inv(tracks.matrix[rows].sum(axis=0) + np.diag(1 / np.maximum(sigma[v], 1e-6) ** 2))
        information += np.einsum("tia,tij,tjb->ab", design, tracks.matrix[rows][:, :2, :2], design)
        information -= coupling.T @ own @ coupling
    score = run.score(solution.xy_m, run.reference_code[run.reported])
    return Known(solution.xy_m, np.linalg.inv(information), score)


def without_common_offset(run: Run, best: Known) -> MapScore:
    """Score the map of the known association less the offset that the fleet has in common: what is lost to that."""
    common = (best.xy_m - run.reference_xy[run.reported]).mean(axis=0)
    return run.score(best.xy_m - common, run.reference_code[run.reported])


def without_translation(cov_m2: Floats) -> Floats:
    """Return a covariance of (2 n,) places with their common translation taken out."""
    n = len(cov_m2) // 2
    keep = np.eye(2 * n) - np.tile(np.eye(2), (n, n)) / n
    return keep @ cov_m2 @ keep.T


def own_sign(run: Run, fused: JointMap) -> Ints:
    """Return, for every sign of a joint map, the row of `run.reported` that it is, or -1.

    It is the sign that most of its tracks are of; of several rows of one sign the one with the most tracks is it.
    """
    n, n_true = len(fused.xy_m), len(run.reference_xy)
    counts = np.zeros((n, n_true + 1), np.int64)
    np.add.at(counts, (fused.sign_of_track, run.true_sign), 1)  # ghosts count in the last column
    most = np.argmax(counts, axis=1)
    size = counts[np.arange(n), most]
    own = np.full(n, -1)
    for k in range(n_true):
        rows = np.flatnonzero((most == k) & (size > 0))
        if rows.size:
            own[rows[np.argmax(size[rows])]] = np.searchsorted(run.reported, k)
    return own


def stale_prior(run: Run, rows: Ints, how: Staleness = STALE, *, seed: int) -> tuple[PriorMap, Run]:
    """Return an outdated map of some signs, and the run scored against what was reported or the prior holds.

    `rows` of the reference: those that the drive has in view; no fleet can judge what nobody could report.
    """
    scene, code = run.reference.take(pa.array(rows)), run.reference_code[rows]
    lon, lat = lonlat(scene)
    copy = make_stale(sign_keys(scene["sign_id"].to_pylist()), lon, lat, code, how, seed=seed)
    n = len(lon)
    there = np.append(copy.fate != REMOVED, np.ones(len(copy.key), bool))
    prior = PriorMap(
        run.frame.to_enu(copy.lon_deg, copy.lat_deg)[there],
        np.full(int(there.sum()), how.sigma_m),
        code[copy.class_of][there],
        np.zeros((int(there.sum()), 2)),
    )
    held = np.union1d(run.reported, rows[copy.fate[:n] != REMOVED])
    judged = replace(run)
    judged.__dict__.update({"reported": held, "fleet": run.fleet, "true_sign": run.true_sign})
    return prior, judged


def score_prior(run: Run, prior: PriorMap) -> MapScore:
    """Score the outdated map as it stands."""
    return run.score(prior.xy_m, prior.class_code)


def dbscan(folder: Path, case: Case, n_vehicles: int, label: str) -> dict[str, tuple[Floats, Floats, list[str]]]:
    """Return the maps of a batch of replicates by a method of studies: longitude, latitude, class by run; made once."""
    out = folder / f"{label}-{n_vehicles}.parquet"
    if not out.exists():
        aggregate(
            folder / "detections",
            out,
            config=with_settings(load_config(case.scenario), METHODS[label]),
            n_vehicles=n_vehicles,
            passes=folder / "passes.parquet",
            n_workers=1,
        )
    layer = read_table(SIGNS, out)
    maps = {}
    for run_id in set(layer["run_id"].to_pylist()):
        rows = layer.filter(pc.equal(layer["run_id"], run_id))
        maps[run_id] = (*lonlat(rows), rows["sign_class"].to_pylist())
    return maps


def score_dbscan(run: Run, maps: dict[str, tuple[Floats, Floats, list[str]]]) -> MapScore:
    """Score DBSCAN's map of a run; an empty one where it made none."""
    lon, lat, names = maps.get(run.run_id, (np.zeros(0), np.zeros(0), []))
    code = {name: at for at, name in enumerate(run.classes)}
    xy_m = run.frame.to_enu(lon, lat) if len(names) else np.zeros((0, 2))
    return run.score(xy_m, np.array([code[name] for name in names], np.int64))
