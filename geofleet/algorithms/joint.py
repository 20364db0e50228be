"""Joint fusion: signs, the errors that each pass has in common, classes and existence, estimated together.

All detections of one pass share one GNSS offset and one calibration; one pass cannot see one sign twice in a frame; and
not seeing a sign is evidence. Alternates between

1. association: each pass against the map of all others, one-to-one (`joint_association`);
2. the sparse normal equations for signs and passes (`joint_solution`);
3. what the residuals teach: noise, confusion of classes (`joint_evidence`);

and ends with class posteriors and existence. A prior map is one more pass, without calibration errors, whose offset is
the translation of the whole map: small as a rule, and sometimes not (`PRIOR_SHIFT_M`). docs/fusion.md derives each part.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from geofleet.algorithms import joint_evidence as evidence
from geofleet.algorithms.joint_alignment import align_passes
from geofleet.algorithms.joint_association import NO_SIGN, Places, merge, sweep
from geofleet.algorithms.joint_solution import solve
from geofleet.algorithms.joint_tracks import Passes, Tracks, pass_biases, places, scaled, with_jitter, without_fragments
from geofleet.algorithms.opportunities import view_chances

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.joint_evidence import Existence, Recognition
    from geofleet.algorithms.joint_solution import Solution

    Flags = NDArray[np.bool_]
    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

LOOSE_M = (0.5, 0.25)
"""The first rounds of association allow for this beside what is declared: passes are not yet well laid."""
MAX_ROUNDS = 20
SETTLED_M = 1e-4
JITTERS_M = np.array([0.0, 0.02, 0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 3.2])
"""Errors of places beyond what tracks declare, an axis: the likeliest of these is taken for the fleet, and for a pass
that differs."""
FLEET_JITTER_M = 0.05
FAR_MORE = 3
PASS_JITTER_COST = 3.0
"""Nats that a pass must gain to have a jitter of its own."""


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
        (n_passes, 4) offset east and north (m), range bias (m) and bearing bias (rad) of each pass; standard deviations.
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


@dataclass(frozen=True, slots=True, eq=False)
class PriorMap:
    """A map from before, one row a sign.

    Parameters
    ----------
    xy_m, sigma_m
        (n, 2), (n,) places and their standard deviation an axis.
    class_code
        (n,) classes.
    view_xy
        (n, 2) the way each sign is looked at, unit vectors; (0, 0) where unknown.
    """

    xy_m: Floats
    sigma_m: Floats
    class_code: Ints
    view_xy: Floats


PRIOR_SHIFT_M = (0.1, 1.0)
"""σ an axis of the translation of a prior map as a whole: as a rule, and when it is off; each as likely beforehand."""
PRIOR_RETYPED = 0.1
"""Share of a prior map's signs that show another class by now."""


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
    bias, bias_cov = pass_biases(scaled_tracks, passes)
    xy_m, cov = places(scaled_tracks, bias, bias_cov)
    joined, joined_of = without_fragments(scaled_tracks, xy_m, cov)
    if prior is not None:
        joined, passes = _with_prior(joined, passes, prior)
        views_of = np.concatenate((views_of, prior.view_xy))
        joined_of = np.concatenate((joined_of, np.arange(len(prior.xy_m)) + joined_of.max(initial=-1) + 1))
    search = _Search(joined, passes, n_classes, n_fleet)
    search.run()
    solution = search.final()
    return _described(search, solution, factor, joined_of, views, views_of, n_given=len(tracks.pass_code))


def _with_prior(tracks: Tracks, passes: Passes, prior: PriorMap) -> tuple[Tracks, Passes]:
    """Append the prior map as one more pass, of a kind of its own."""
    n, code = len(prior.xy_m), len(passes.gnss_sigma_m)
    matrix = np.zeros((n, 4, 4))
    matrix[:, 0, 0] = matrix[:, 1, 1] = 1 / prior.sigma_m**2
    unknown, none = np.full(n, -1), np.zeros(n)
    own = Tracks(np.full(n, code), prior.class_code, prior.xy_m, matrix, np.zeros((n, 4)), unknown, unknown, none, none)
    both = Tracks(*(np.concatenate((getattr(tracks, name), getattr(own, name))) for name in Tracks.__slots__))
    kind = int(passes.kind_code.max(initial=-1)) + 1
    return both, Passes(
        np.append(passes.gnss_sigma_m, PRIOR_SHIFT_M[0]),
        np.concatenate((passes.bias_sigma, np.zeros((1, 2)))),
        np.append(passes.kind_code, kind),
    )


class _Search:
    """The alternation: tracks and passes as given, and the association, solution and noise as they stand."""

    def __init__(self, tracks: Tracks, passes: Passes, n_classes: int, n_fleet: int) -> None:
        self.tracks, self.passes, self.n_fleet = tracks, passes, n_fleet
        self.n_classes = n_classes
        n_passes, n_kinds = len(passes.gnss_sigma_m), int(passes.kind_code.max(initial=-1)) + 1
        self.has_prior = n_passes > n_fleet
        self.first = np.searchsorted(tracks.pass_code, np.arange(n_passes + 1))
        self.kind = passes.kind_code[tracks.pass_code]
        self.is_fixed = np.zeros(n_kinds, np.bool_)
        self.fixed_rate = np.full(n_kinds, evidence.ERROR_PRIOR[0] / sum(evidence.ERROR_PRIOR))
        if self.has_prior:
            self.is_fixed[-1], self.fixed_rate[-1] = True, PRIOR_RETYPED
        self.read = evidence.recognition(self.fixed_rate, n_classes)
        self.log_prior = np.full(n_classes, -np.log(n_classes))
        self.birth_cost = float(np.log(n_classes) - np.log(evidence.SIGN_DENSITY_M2))
        self.jitter = np.full(n_passes, FLEET_JITTER_M)
        self.jitter[n_fleet:] = 0.0
        self.nuisance = np.zeros((n_passes, 4))
        self.sign = np.full(len(tracks.pass_code), NO_SIGN)
        self.xy_m = np.zeros((0, 2))
        self.n_rounds, self.is_settled = 0, False

    def run(self) -> None:
        """Alternate until nothing changes."""
        if not len(self.sign):
            self.is_settled = True
            return
        self.lay()
        seen: set[bytes] = set()
        for self.n_rounds in range(1, MAX_ROUNDS + 1):
            changed = self.associate()
            moved = self.solve()
            is_firm = self.n_rounds > len(LOOSE_M)
            if is_firm and changed == 0 and moved < SETTLED_M:
                self.is_settled = True
                return
            if is_firm and changed and self.sign.tobytes() in seen:
                return  # it goes in circles: two associations that are as good as each other
            seen.add(self.sign.tobytes())
            if self.n_rounds >= len(LOOSE_M):
                self.learn()

    def lay(self) -> None:
        """Lay the passes on each other; those of a single track stay where they say they are."""
        self.weighted = with_jitter(self.tracks, self.jitter[self.tracks.pass_code])
        bias, bias_cov = pass_biases(self.weighted, self.passes)
        xy_m, cov = places(self.weighted, bias, bias_cov)
        self.nuisance[:, 2:] = bias
        count = np.diff(self.first)
        laid = np.flatnonzero(count > 1)
        rows = np.flatnonzero((count > 1)[self.tracks.pass_code])
        if laid.size:
            self.nuisance[laid, :2] = align_passes(
                xy_m[rows],
                (cov[rows, 0, 0] + cov[rows, 1, 1]) / 2,
                self.tracks.class_code[rows],
                np.concatenate(([0], np.cumsum(count[laid]))),
                self.passes.gnss_sigma_m[laid],
                cell_m=100.0,
            )
        offset_var = 1 / (1 / np.maximum(self.passes.gnss_sigma_m, 1e-6) ** 2 + np.maximum(count - 1, 0))
        all_cov = np.zeros((len(count), 4, 4))
        all_cov[:, 0, 0] = all_cov[:, 1, 1] = offset_var
        all_cov[:, 2:, 2:] = bias_cov
        self.at = self.nuisance[self.tracks.pass_code]
        self.at_cov = all_cov[self.tracks.pass_code]

    def placed(self, tracks: Tracks) -> tuple[Floats, Floats]:
        """Return where tracks are, offset and bias of their pass taken out as its other tracks know them."""
        inverse = np.linalg.inv(tracks.matrix[:, :2, :2])
        slope = inverse @ tracks.matrix[:, :2, 2:]
        known = np.concatenate((np.broadcast_to(np.eye(2), slope.shape), slope), axis=2)
        xy_m = tracks.origin_xy_m + np.einsum("tij,tj->ti", inverse, tracks.vector[:, :2])
        return xy_m - np.einsum("tij,tj->ti", known, self.at), inverse + known @ self.at_cov @ np.swapaxes(known, 1, 2)

    def places(self, loose_m: float = 0.0) -> Places:
        """Return the tracks as the sweeps see them."""
        xy_m, cov = self.placed(self.weighted)
        return Places(
            np.ascontiguousarray(xy_m),
            np.column_stack((cov[:, 0, 0] + loose_m**2, cov[:, 1, 1] + loose_m**2, cov[:, 0, 1])),
            self.tracks.class_code,
            self.kind,
            self.tracks.frame_first,
            self.tracks.frame_last,
            self.first,
        )

    def associate(self) -> int:
        """Assign every pass anew and join what is one; return how many tracks changed their sign."""
        loose_m = LOOSE_M[self.n_rounds - 1] if self.n_rounds <= len(LOOSE_M) else 0.0
        here = self.places(loose_m)
        confusion = self.read.log_confusion
        before = self.sign
        found, changed = sweep(here, before, confusion, self.log_prior, birth_cost=self.birth_cost)
        if self.n_rounds == 1:
            found, _ = sweep(here, found, confusion, self.log_prior, birth_cost=self.birth_cost)
        joined = merge(here, found, confusion, self.log_prior, birth_cost=self.birth_cost)
        self.sign = joined
        return changed + int(found.max() - joined.max())

    def solve(self) -> float:
        """Solve for signs and passes; return how far the signs of before have moved at most."""
        n_signs = int(self.sign.max()) + 1
        solution = solve(self.weighted, self.passes, self.sign, n_signs, self.nuisance, with_cov=False)
        before = self.xy_m
        self.xy_m, self.nuisance = solution.xy_m, solution.nuisance
        self._look_at_passes()
        return float(np.abs(before - self.xy_m).max()) if len(before) == len(self.xy_m) else np.inf

    def _look_at_passes(self) -> None:
        """Find offset and bias of each pass, with covariance, from all of its tracks but one, for each of its tracks."""
        tracks, code = self.weighted, self.tracks.pass_code
        sigma = np.column_stack((self.passes.gnss_sigma_m, self.passes.gnss_sigma_m, self.passes.bias_sigma))
        shift = np.concatenate((self.xy_m[self.sign] - tracks.origin_xy_m, np.zeros((len(code), 2))), axis=1)
        said = tracks.vector - np.einsum("tij,tj->ti", tracks.matrix, shift)
        own, right = np.zeros((len(sigma), 4, 4)), np.zeros((len(sigma), 4))
        np.add.at(own, code, tracks.matrix)
        np.add.at(right, code, said)
        root = sigma[code][:, :, None] * np.eye(4)
        inner = np.eye(4) + root @ (own[code] - tracks.matrix) @ root
        self.at_cov = root @ np.linalg.solve(inner, root)
        self.at = np.einsum("tij,tj->ti", self.at_cov, right[code] - said)

    def learn(self) -> None:
        """Learn recognition and the noise that tracks do not declare."""
        n_signs = int(self.sign.max()) + 1
        log_posterior = evidence.class_posterior(self.sign, n_signs, self.tracks.class_code, self.kind, self.read)
        self.read = evidence.learn_recognition(
            log_posterior, self.sign, self.tracks.class_code, self.kind, self.fixed_rate, self.is_fixed
        )
        self.jitter = self._learn_jitter()
        self.weighted = with_jitter(self.tracks, self.jitter[self.tracks.pass_code])
        self._look_at_passes()

    def _learn_jitter(self) -> Floats:
        """Return the likeliest further error of places, an axis: one for the fleet, and others for passes that differ."""
        xy_m, cov = self.placed(self.weighted)
        information = np.linalg.inv(cov)
        n_signs, code = int(self.sign.max()) + 1, self.tracks.pass_code
        total, moment = np.zeros((n_signs, 2, 2)), np.zeros((n_signs, 2))
        weighed = np.einsum("tij,tj->ti", information, xy_m)
        np.add.at(total, self.sign, information)
        np.add.at(moment, self.sign, weighed)
        pair = self.sign * len(self.passes.gnss_sigma_m) + code
        _, which = np.unique(pair, return_inverse=True)
        of_pass, moment_of_pass = np.zeros((which.max() + 1, 2, 2)), np.zeros((which.max() + 1, 2))
        np.add.at(of_pass, which, information)
        np.add.at(moment_of_pass, which, weighed)
        n_passes_of = np.bincount(np.unique(pair) // len(self.passes.gnss_sigma_m), minlength=n_signs)
        used = (n_passes_of[self.sign] > 1) & (code < self.n_fleet)
        if not used.any():
            return self.jitter
        others = total[self.sign[used]] - of_pass[which[used]]
        others_cov = np.linalg.inv(others)
        expected = np.einsum("tij,tj->ti", others_cov, moment[self.sign[used]] - moment_of_pass[which[used]])
        xy0, cov0 = self.placed(self.tracks)
        error, spread = xy0[used] - expected, cov0[used] + others_cov
        gain = np.zeros((len(self.passes.gnss_sigma_m), len(JITTERS_M)))
        for at, tau in enumerate(JITTERS_M):
            s = spread + tau**2 * np.eye(2)
            det = s[:, 0, 0] * s[:, 1, 1] - s[:, 0, 1] ** 2
            chi2 = (
                s[:, 1, 1] * error[:, 0] ** 2
                - 2 * s[:, 0, 1] * error[:, 0] * error[:, 1]
                + s[:, 0, 0] * error[:, 1] ** 2
            ) / det
            gain[:, at] = np.bincount(code[used], -0.5 * (np.log(det) + chi2), minlength=len(gain))
        fleet = int(np.argmax(gain[: self.n_fleet].sum(axis=0)))
        own = np.argmax(gain, axis=1)
        differs = gain[np.arange(len(gain)), own] > gain[:, fleet] + PASS_JITTER_COST
        jitter = JITTERS_M[np.where(differs, own, fleet)]
        jitter[self.n_fleet :] = 0.0
        return jitter

    def final(self) -> Solution:
        """Solve with covariances; a prior map weighs both of its σ by what the fleet says of its translation."""
        n_signs = int(self.sign.max(initial=-1)) + 1
        if not self.has_prior or n_signs == 0:
            return solve(self.weighted, self.passes, self.sign, n_signs, self.nuisance, with_cov=n_signs > 0)
        sigmas = [np.append(self.passes.gnss_sigma_m[:-1], sigma) for sigma in PRIOR_SHIFT_M]
        found = [
            solve(
                self.weighted,
                replace(self.passes, gnss_sigma_m=sigma),
                self.sign,
                n_signs,
                self.nuisance,
                with_cov=True,
                marginal_of=self.n_fleet,
            )
            for sigma in sigmas
        ]
        weight = _translation_weights(found[1], PRIOR_SHIFT_M)
        xy_m = sum(w * one.xy_m for w, one in zip(weight, found, strict=True))
        apart = [one.xy_m - xy_m for one in found]
        cov = sum(
            w * (one.cov_m2 + d[:, :, None] * d[:, None, :]) for w, one, d in zip(weight, found, apart, strict=True)
        )
        nuisance = sum(w * one.nuisance for w, one in zip(weight, found, strict=True))
        return replace(found[0], xy_m=xy_m, cov_m2=cov, nuisance=nuisance)


def _translation_weights(wide: Solution, sigmas: tuple[float, float]) -> tuple[float, float]:
    """Return the posterior of a tight and a wide prior of a map's translation, from the solution under the wide one."""
    cov = wide.marginal_cov[:2, :2]
    information = np.linalg.inv(cov) - np.eye(2) / sigmas[1] ** 2  # what the fleet alone says
    likely_cov = np.linalg.inv(information)
    shift = likely_cov @ np.linalg.solve(cov, wide.nuisance[-1, :2])
    log_evidence = []
    for sigma in sigmas:
        s = likely_cov + sigma**2 * np.eye(2)
        log_evidence.append(-0.5 * (np.log(np.linalg.det(s)) + shift @ np.linalg.solve(s, shift)))
    tight = 1 / (1 + np.exp(log_evidence[1] - log_evidence[0]))
    return float(tight), float(1 - tight)


def _described(
    search: _Search,
    solution: Solution,
    factor: Floats,
    joined_of: Ints,
    views: Views | None,
    view_xy: Floats,
    *,
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
    beside = _beside(solution.xy_m, class_code, n_passes)
    support = evidence.Support(
        n_passes.astype(np.float64), n_in_view, chances, beside, in_prior, n_fleet, n_classes=search.n_classes
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


def _chances(solution: Solution, views: Views, n_fleet: int, sign: Ints, view_xy: Floats) -> tuple[Floats, Floats]:
    """Return the chances to report each sign, and the passes that had it in view, from the side that its tracks saw it from."""
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
