"""Joint fusion: signs, the errors that each pass has in common, classes and existence, estimated together.

All detections of one pass share one GNSS offset and one calibration; one pass cannot see one sign twice in a frame; and
not seeing a sign is evidence. Alternates between

1. association: each pass against the map of all others, one-to-one (`joint_association`);
2. the sparse normal equations for signs and passes (`joint_solution`);
3. what the residuals teach: noise, confusion of classes (`joint_evidence`);

and ends with class posteriors and existence. A prior map is one more pass, without calibration errors, whose offset is
the translation of the whole map: small as a rule, and sometimes not. docs/fusion.md derives each part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from geofleet.algorithms import joint_evidence as evidence
from geofleet.algorithms.joint_search import PriorMap, Search, with_prior
from geofleet.algorithms.joint_tracks import Passes, Tracks, pass_biases, places, scaled, without_fragments
from geofleet.algorithms.opportunities import view_chances

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.joint_evidence import Existence, Recognition
    from geofleet.algorithms.joint_solution import Solution

    Flags = NDArray[np.bool_]
    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

FAR_MORE = 3
"""A sign with so many times the passes of one beside it may have lost it a stray track."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Where passes could have seen a sign: reported paths with range and opening angle of the sensors.

    `xy_m` (m, 2) holds the vertices of all paths, `first` (n_passes + 1,) where each begins.
    """

    xy_m: Floats
    first: Ints
    range_m: Floats
    fov_deg: Floats


@dataclass(frozen=True, slots=True, eq=False)
class JointMap:
    """The map, one row a sign that tracks were associated to, likely or not, and what was found on the way.

    Parameters
    ----------
    xy_m, cov_m2
        (n, 2), (n, 2, 2) place and its covariance, the offset that the fleet has in common included.
    class_code, class_probability
        (n,) the likeliest class, and its posterior.
    existence
        (n,) probability that the sign exists.
    n_passes, n_tracks, n_chances
        (n,) passes and tracks that report it, passes that had it in view (NaN without paths).
    sign_of_track
        (n_tracks,) row of the sign of every track given.
    nuisance, nuisance_sigma
        (n_passes, 4) offset east and north (m), range (m) and bearing bias (rad) of each pass; standard deviations.
    noise_factor, jitter_m
        (n_passes,) factor on the variance that the sensor declares, and further error of its places.
    recognition, rates
        What was learnt of recognition and of detection.
    n_rounds, is_settled
        Rounds of association, and whether the last one changed nothing.
    """

    xy_m: Floats
    cov_m2: Floats
    class_code: Ints
    class_probability: Floats
    existence: Floats
    n_passes: Ints
    n_tracks: Ints
    n_chances: Floats
    sign_of_track: Ints
    nuisance: Floats
    nuisance_sigma: Floats
    noise_factor: Floats
    jitter_m: Floats
    recognition: Recognition
    rates: Existence
    n_rounds: int
    is_settled: bool


def fuse_joint(
    tracks: Tracks,
    passes: Passes,
    *,
    n_classes: int,
    views: Views | None = None,
    view_xy: Floats | None = None,
    prior: PriorMap | None = None,
) -> JointMap:
    """Estimate signs from the tracks of all passes together.

    Parameters
    ----------
    tracks
        Sorted by pass.
    passes
        All passes that drove, also those without tracks.
    n_classes
        Class codes run from 0 to below it.
    views
        Where each pass drove and how far its sensor sees; without, not seeing a sign is no evidence.
    view_xy
        (n_tracks, 2) the way each track was looked at, unit vectors, (0, 0) where unknown.
    prior
        An earlier map, whatever its age.
    """
    views_of = np.zeros((len(tracks.pass_code), 2)) if view_xy is None else view_xy
    n_fleet = len(passes.gnss_sigma_m)
    scaled_tracks, factor = scaled(tracks, n_fleet)
    passes = _widened(passes, factor)
    bias, bias_cov = pass_biases(scaled_tracks, passes)
    xy_m, cov = places(scaled_tracks, bias, bias_cov)
    # a gate that took the noise for smaller parts a track by its errors: its pieces lie apart by more than chance
    leeway = np.maximum(factor, 1.0)[tracks.pass_code]
    joined, joined_of = without_fragments(scaled_tracks, xy_m, cov * leeway[:, None, None])
    if prior is not None:
        joined, passes = with_prior(joined, passes, prior)
        views_of = np.concatenate((views_of, prior.view_xy))
        joined_of = np.concatenate((joined_of, np.arange(len(prior.xy_m)) + joined_of.max(initial=-1) + 1))
    search = Search(joined, passes, n_classes, n_fleet)
    search.run()
    solution = search.final()
    return _described(search, solution, factor, joined_of, views=views, view_xy=views_of, n_given=len(tracks.pass_code))


def _widened(passes: Passes, factor: Floats) -> Passes:
    """Return the passes with the sigmas of offset and bias as much larger as the noise of their frames is.

    A car whose frames are worse than it declares is hardly right about the rest; one that is better may still be.
    """
    scale = np.sqrt(np.maximum(factor, 1.0))
    return replace(passes, gnss_sigma_m=passes.gnss_sigma_m * scale, bias_sigma=passes.bias_sigma * scale[:, None])


def _described(
    search: Search,
    solution: Solution,
    factor: Floats,
    joined_of: Ints,
    *,
    views: Views | None,
    view_xy: Floats,
    n_given: int,
) -> JointMap:
    """Return the map with classes, existence and counts."""
    tracks, sign, n_fleet = search.tracks, search.sign, search.n_fleet
    n_signs = len(solution.xy_m)
    log_posterior = evidence.class_posterior(sign, n_signs, tracks.class_code, search.kind, search.read)
    is_fleet = tracks.pass_code < n_fleet
    pairs = np.unique(sign[is_fleet] * max(n_fleet, 1) + tracks.pass_code[is_fleet])
    n_passes = np.bincount(pairs // max(n_fleet, 1), minlength=n_signs)
    sign_of_track = sign[joined_of]
    chances, n_in_view = np.full(n_signs, np.nan), np.full(n_signs, np.nan)
    if views is not None and n_signs:
        chances, n_in_view = _chances(solution, views, n_fleet, sign_of_track, view_xy)
    in_prior = np.bincount(sign[~is_fleet], minlength=n_signs) > 0 if search.has_prior else None
    class_code = np.argmax(log_posterior, axis=1) if n_signs else np.zeros(0, np.int64)
    support = evidence.Support(
        n_passes.astype(np.float64),
        n_in_view,
        chances,
        _beside(solution.xy_m, class_code, n_passes),
        in_prior,
        _moved_to(solution.xy_m, class_code, n_passes, in_prior),
        n_fleet,
        search.n_classes,
    )
    found = evidence.existence(support)
    return JointMap(
        xy_m=solution.xy_m,
        cov_m2=solution.cov_m2,
        class_code=class_code,
        class_probability=np.exp(log_posterior[np.arange(n_signs), class_code]),
        existence=found.probability,
        n_passes=n_passes,
        n_tracks=np.bincount(sign_of_track[:n_given], minlength=n_signs),
        n_chances=n_in_view,
        sign_of_track=sign_of_track[:n_given],
        nuisance=solution.nuisance,
        nuisance_sigma=np.sqrt(np.diagonal(solution.nuisance_cov, axis1=1, axis2=2)),
        noise_factor=factor,
        jitter_m=search.jitter,
        recognition=search.read,
        rates=found,
        n_rounds=search.n_rounds,
        is_settled=search.is_settled,
    )


def _beside(xy_m: Floats, class_code: Ints, n_passes: Ints) -> Floats:
    """Return how many passes report the best supported sign of the same class beside each sign, if far more do."""
    beside = np.zeros(len(xy_m))
    if len(xy_m):
        pairs = cKDTree(xy_m).query_pairs(evidence.BESIDE_M, output_type="ndarray")
        one, two = np.concatenate((pairs, pairs[:, ::-1])).T
        counts = (class_code[one] == class_code[two]) & (n_passes[two] > FAR_MORE * n_passes[one])
        np.maximum.at(beside, one[counts], n_passes[two[counts]])
    return beside


def _moved_to(xy_m: Floats, class_code: Ints, n_passes: Ints, in_prior: Flags | None) -> Ints:
    """Return for each entry of the prior map that nobody reports the nearest sign of its class that it does not hold.

    A sign is what the nearest entry moved to only; -1 where there is none.
    """
    moved_to = np.full(len(xy_m), -1)
    if in_prior is None or in_prior.all() or not in_prior.any():
        return moved_to
    entry, new = np.flatnonzero(in_prior & (n_passes == 0)), np.flatnonzero(~in_prior)
    pairs = cKDTree(xy_m[entry]).sparse_distance_matrix(cKDTree(xy_m[new]), evidence.MOVED_M, output_type="ndarray")
    of, to, away_m = entry[pairs["i"]], new[pairs["j"]], pairs["v"]
    alike = class_code[of] == class_code[to]
    order = np.lexsort((of, to, away_m))
    free = np.ones(len(xy_m), np.bool_)
    for row in order[alike[order]]:  # few: entries that nobody reports, beside new signs of their class
        if free[of[row]] and free[to[row]]:
            moved_to[of[row]], free[of[row]], free[to[row]] = to[row], False, False
    return moved_to


def _chances(solution: Solution, views: Views, n_fleet: int, sign: Ints, view_xy: Floats) -> tuple[Floats, Floats]:
    """Return chances to report each sign, and passes that had it in view, from the side that its tracks saw."""
    offset = np.repeat(solution.nuisance[:n_fleet, :2], np.diff(views.first), axis=0)
    total = np.zeros((len(solution.xy_m), 2))
    np.add.at(total, sign, view_xy)
    length = np.hypot(*total.T)
    count = np.bincount(sign[np.hypot(*view_xy.T) > 0], minlength=len(total))
    is_one_sided = length > 0.7 * np.maximum(count, 1)  # 0.7: all within about 45° of their mean
    chances, n_in_view = view_chances(
        solution.xy_m,
        views.xy_m - offset,
        views.first,
        range_m=views.range_m,
        fov_deg=views.fov_deg,
        least_frames=evidence.LEAST_VIEW_FRAMES,
        full_frames=evidence.FULL_VIEW_FRAMES,
        view_xy=np.where(is_one_sided[:, None], total / np.maximum(length, 1e-9)[:, None], 0.0),
    )
    return chances, n_in_view.astype(np.float64)
