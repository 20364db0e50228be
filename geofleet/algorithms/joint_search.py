"""The alternation of joint fusion: association, normal equations and what residuals teach, until nothing changes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from geofleet.algorithms import joint_evidence as evidence
from geofleet.algorithms.joint_alignment import align_passes
from geofleet.algorithms.joint_association import NO_SIGN, REACH_M, Places, leaders, sweep
from geofleet.algorithms.joint_merging import merge
from geofleet.algorithms.joint_solution import solve
from geofleet.algorithms.joint_tracks import Passes, Tracks, blocks, pass_biases, places, with_jitter

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.joint_solution import Solution

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
PASS_JITTER_COST = 3.0
"""Nats that a pass must gain to have a jitter of its own."""
FREE_ROUNDS, JITTER_INERTIA = 4, 1.0
"""After so many rounds a pass keeps its jitter unless it gains so many nats by another."""


PRIOR_SHIFT_M = (0.1, 1.0)
"""Standard deviation an axis of the translation of a prior map as a whole: as a rule, and when it is off."""
PRIOR_IS_OFF = 1 / 3
"""Probability beforehand that it is off."""
LEFT_OUT = 0.1
"""What a 90 % ellipse leaves out: up to so much the other translation need not lie in it."""
BEYOND_CHI2 = 13.8
"""Squared standard deviations, of two unknowns, that one pass in a thousand exceeds by chance."""
AS_READ = 1e-6
"""Share of misread tracks where nothing can show one."""
PRIOR_RETYPED = 0.1
"""Share of a prior map's signs that show another class by now."""


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


def with_prior(tracks: Tracks, passes: Passes, prior: PriorMap) -> tuple[Tracks, Passes]:
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


class Search:
    """The alternation: tracks and passes as given, and the association, solution and noise as they stand."""

    def __init__(self, tracks: Tracks, passes: Passes, n_classes: int, n_fleet: int) -> None:
        self.tracks, self.passes, self.n_fleet = tracks, passes, n_fleet
        self.declared = passes
        self.n_classes = n_classes
        n_passes, n_kinds = len(passes.gnss_sigma_m), int(passes.kind_code.max(initial=-1)) + 1
        self.has_prior = n_passes > n_fleet
        self.first = np.searchsorted(tracks.pass_code, np.arange(n_passes + 1))
        self.kind = passes.kind_code[tracks.pass_code]
        self.is_fixed = np.zeros(n_kinds, np.bool_)
        self.fixed_rate = np.full(n_kinds, evidence.ERROR_PRIOR[0] / sum(evidence.ERROR_PRIOR))
        if not (np.diff(self.first)[:n_fleet] > 1).any():
            # no pass saw two signs at once: nothing tells a misread sign from two on one pole, so classes stay apart
            self.is_fixed[:], self.fixed_rate[:] = True, AS_READ
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
        self.at, self.at_cov = np.zeros((len(self.sign), 4)), np.zeros((len(self.sign), 4, 4))
        self.weighted = tracks
        self.n_around = np.zeros(len(self.sign), np.int64)
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
            state = self.sign.tobytes() + self.jitter.tobytes()
            if is_firm and changed and state in seen:
                return  # it goes in circles: two associations that are as good as each other
            if is_firm:
                seen.add(state)
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
        # a pass of a single track drove who knows where: not seeing a sign tells nothing of it
        self.n_around[rows] = _passes_around(self.placed(self.weighted)[0][rows], self.tracks.pass_code[rows])

    def placed(self, tracks: Tracks) -> tuple[Floats, Floats]:
        """Return where tracks are, offset and bias of their pass taken out as its other tracks know them."""
        xy_m, cov = np.empty((len(self.sign), 2)), np.empty((len(self.sign), 2, 2))
        for rows in blocks(len(self.sign)):
            inverse = np.linalg.inv(tracks.matrix[rows, :2, :2])
            slope = inverse @ tracks.matrix[rows, :2, 2:]
            known = np.concatenate((np.broadcast_to(np.eye(2), slope.shape), slope), axis=2)
            there = tracks.origin_xy_m[rows] + np.einsum("tij,tj->ti", inverse, tracks.vector[rows, :2])
            xy_m[rows] = there - np.einsum("tij,tj->ti", known, self.at[rows])
            cov[rows] = inverse + known @ self.at_cov[rows] @ np.swapaxes(known, 1, 2)
        return xy_m, cov

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
            self.n_around,
        )

    def associate(self) -> int:
        """Assign every pass anew and join what is one; return how many tracks changed their sign."""
        loose_m = LOOSE_M[self.n_rounds - 1] if self.n_rounds <= len(LOOSE_M) else 0.0
        here = self.places(loose_m)
        confusion = self.read.log_confusion
        before = self.sign
        found = sweep(here, before, confusion, self.log_prior, birth_cost=self.birth_cost)
        if self.n_rounds == 1:
            found = sweep(here, found, confusion, self.log_prior, birth_cost=self.birth_cost)
        self.sign = merge(here, found, confusion, self.log_prior, birth_cost=self.birth_cost)
        return int(np.count_nonzero(leaders(before) != leaders(self.sign)))

    def solve(self) -> float:
        """Solve for signs and passes; return how far the signs of before have moved at most."""
        n_signs = int(self.sign.max()) + 1
        solution = solve(self.weighted, self.passes, self.sign, n_signs, self.nuisance, with_cov=False)
        before = self.xy_m
        self.xy_m, self.nuisance = solution.xy_m, solution.nuisance
        self._look_at_passes()
        return float(np.abs(before - self.xy_m).max()) if len(before) == len(self.xy_m) else np.inf

    def _look_at_passes(self) -> None:
        """Find offset and bias of each pass, with covariance, for each of its tracks from all the others."""
        tracks, code = self.weighted, self.tracks.pass_code
        sigma = np.column_stack((self.passes.gnss_sigma_m, self.passes.gnss_sigma_m, self.passes.bias_sigma))
        shift = np.concatenate((self.xy_m[self.sign] - tracks.origin_xy_m, np.zeros((len(code), 2))), axis=1)
        said = tracks.vector - np.einsum("tij,tj->ti", tracks.matrix, shift)
        own, right = np.zeros((len(sigma), 4, 4)), np.zeros((len(sigma), 4))
        np.add.at(own, code, tracks.matrix)
        np.add.at(right, code, said)
        for rows in blocks(len(code)):
            root = sigma[code[rows]][:, :, None] * np.eye(4)
            inner = np.eye(4) + root @ (own[code[rows]] - tracks.matrix[rows]) @ root
            self.at_cov[rows] = root @ np.linalg.solve(inner, root)
        self.at = np.einsum("tij,tj->ti", self.at_cov, right[code] - said)

    def learn(self) -> None:
        """Learn recognition and the noise that tracks do not declare."""
        n_signs = int(self.sign.max()) + 1
        log_posterior = evidence.class_posterior(self.sign, n_signs, self.tracks.class_code, self.kind, self.read)
        self.read = evidence.learn_recognition(
            log_posterior,
            self.sign,
            self.tracks.class_code,
            self.kind,
            fixed_rate=self.fixed_rate,
            is_fixed=self.is_fixed,
        )
        self.jitter = self._learn_jitter()
        self.weighted = with_jitter(self.tracks, self.jitter[self.tracks.pass_code])
        self.passes = self._believed()
        self._look_at_passes()

    def _believed(self) -> Passes:
        """Return the passes as they declare themselves, those with a gross fault aside (`believed`).

        A prior map that is off must not make a fault of what a sure pass sees: it is judged with the map let go.
        """
        nuisance = self.nuisance
        if self.has_prior:
            loose = replace(self.passes, gnss_sigma_m=np.append(self.passes.gnss_sigma_m[:-1], PRIOR_SHIFT_M[1]))
            n_signs = int(self.sign.max()) + 1
            nuisance = solve(self.weighted, loose, self.sign, n_signs, nuisance, with_cov=False).nuisance
        return believed(self.declared, nuisance, self.n_fleet)

    def _learn_jitter(self) -> Floats:
        """Return the likeliest further error of places, an axis: the fleet's, or its own for a pass that differs."""
        error, spread, code = self._errors()
        if not len(code):
            return self.jitter
        gain = np.zeros((len(self.passes.gnss_sigma_m), len(JITTERS_M)))
        for at, tau_m in enumerate(JITTERS_M):
            s = spread + tau_m**2 * np.eye(2)
            det = s[:, 0, 0] * s[:, 1, 1] - s[:, 0, 1] ** 2
            east, north = error.T
            chi2 = (s[:, 1, 1] * east**2 - 2 * s[:, 0, 1] * east * north + s[:, 0, 0] * north**2) / det
            gain[:, at] = np.bincount(code, -0.5 * (np.log(det) + chi2), minlength=len(gain))
        fleet = int(np.argmax(gain.sum(axis=0)))
        own = np.argmax(gain, axis=1)
        every = np.arange(len(gain))
        differs = gain[every, own] > gain[:, fleet] + PASS_JITTER_COST
        chosen = np.where(differs, own, fleet)
        # what is as good as before stays as before: the errors that it is chosen by depend on it
        before = np.searchsorted(JITTERS_M, self.jitter)
        stays = gain[every, chosen] < gain[every, before] + JITTER_INERTIA
        jitter: Floats = JITTERS_M[np.where(stays & (self.n_rounds > FREE_ROUNDS), before, chosen)]
        jitter[self.n_fleet :] = 0.0
        return jitter

    def _errors(self) -> tuple[Floats, Floats, Ints]:
        """Return how far each track lies from what the other passes say of its sign, the covariance, and its pass.

        Without jitter; only tracks of the fleet whose sign another pass reports too.
        """
        n_signs, n_passes, code = int(self.sign.max()) + 1, len(self.passes.gnss_sigma_m), self.tracks.pass_code
        xy_m, cov = self.placed(self.weighted)
        information = np.asarray(np.linalg.inv(cov), np.float64)
        weighed = np.einsum("tij,tj->ti", information, xy_m)
        total, moment = _added(information, weighed, self.sign, n_signs)
        pairs, which = np.unique(self.sign * n_passes + code, return_inverse=True)
        of_pass, moment_of_pass = _added(information, weighed, which, len(pairs))
        n_passes_of = np.bincount(pairs // n_passes, minlength=n_signs)
        used = (n_passes_of[self.sign] > 1) & (code < self.n_fleet)
        others_cov = np.linalg.inv(total[self.sign[used]] - of_pass[which[used]])
        others = np.einsum("tij,tj->ti", others_cov, moment[self.sign[used]] - moment_of_pass[which[used]])
        plain_xy_m, plain_cov = self.placed(self.tracks)
        return plain_xy_m[used] - others, plain_cov[used] + others_cov, code[used]

    def final(self) -> Solution:
        """Solve with covariances; of both priors of a prior map's translation by the one that the fleet makes likelier.

        A mean of both would be far from either. The covariance holds for the other one too, unless that is unlikely.
        """
        n_signs = int(self.sign.max(initial=-1)) + 1
        if not self.has_prior or n_signs == 0:
            return solve(self.weighted, self.passes, self.sign, n_signs, self.nuisance, with_cov=n_signs > 0)
        tight, wide = (self._solved_with_prior(sigma_m, n_signs) for sigma_m in PRIOR_SHIFT_M)
        share = _share_of_tight(wide, PRIOR_SHIFT_M)
        likelier, other_share = (tight, 1 - share) if share >= 1 / 2 else (wide, share)
        apart = tight.xy_m - wide.xy_m
        wide_cov = wide.cov_m2 + apart[:, :, None] * apart[:, None, :]
        weight = min(1.0, other_share / LEFT_OUT)
        return replace(likelier, cov_m2=(1 - weight) * likelier.cov_m2 + weight * wide_cov)

    def _solved_with_prior(self, sigma_m: float, n_signs: int) -> Solution:
        """Solve with this standard deviation of the translation of the prior map."""
        passes = replace(self.passes, gnss_sigma_m=np.append(self.passes.gnss_sigma_m[:-1], sigma_m))
        return solve(self.weighted, passes, self.sign, n_signs, self.nuisance, with_cov=True, marginal_of=self.n_fleet)


def believed(declared: Passes, nuisance: Floats, n_fleet: int) -> Passes:
    """Return the passes with the sigmas of those widened that are further off than they can be by what they declare.

    Offset and biases apart: where χ² of the two is beyond `BEYOND_CHI2`, both variances are taken χ²/2 times as large,
    the likeliest factor: a fault that is held to what its pass declares draws the signs of all others along.
    """
    sigma = np.column_stack((declared.gnss_sigma_m, declared.gnss_sigma_m, declared.bias_sigma))
    squared = (nuisance / np.where(sigma > 0, sigma, np.inf)) ** 2
    chi2 = squared.reshape(-1, 2, 2).sum(axis=2)
    scale = np.sqrt(np.where(chi2 > BEYOND_CHI2, chi2 / 2, 1.0))
    scale[n_fleet:] = 1.0
    return replace(
        declared,
        gnss_sigma_m=declared.gnss_sigma_m * scale[:, 0],
        bias_sigma=declared.bias_sigma * scale[:, 1:],
    )


def _passes_around(xy_m: Floats, pass_code: Ints) -> Ints:
    """Return how many passes have a track in the cell of each track or in one beside it, (n,); cells of `REACH_M`."""
    if not len(xy_m):
        return np.zeros(0, np.int64)
    cell = np.floor((xy_m - xy_m.min(axis=0)) / REACH_M).astype(np.int64) + 1
    width = int(cell[:, 0].max()) + 2
    keys, at = np.unique(cell[:, 1] * width + cell[:, 0], return_inverse=True)
    drove = _ones(at, pass_code, (len(keys), int(pass_code.max()) + 1))
    steps = np.array([row * width + column for row in (-1, 0, 1) for column in (-1, 0, 1)])
    beside = np.searchsorted(keys, keys[:, None] + steps)
    is_there = keys[np.minimum(beside, len(keys) - 1)] == keys[:, None] + steps
    cells = _ones(np.nonzero(is_there)[0], beside[is_there], (len(keys), len(keys)))
    around: Ints = np.diff((cells @ drove).indptr)[at].astype(np.int64)
    return around


def _ones(row: Ints, column: Ints, shape: tuple[int, int]) -> sparse.csr_array:
    """Return a sparse matrix that is not zero at these places."""
    return sparse.csr_array(sparse.coo_array((np.ones(len(row)), (row, column)), shape=shape))


def _share_of_tight(wide: Solution, sigmas_m: tuple[float, float]) -> float:
    """Return the posterior of the tight prior of a map's translation, from the solution under the wide one."""
    if wide.marginal_cov is None:
        raise ValueError("the solution lacks the marginal covariance of the prior map")
    precision = np.asarray(np.linalg.inv(wide.marginal_cov[:2, :2]), np.float64)
    said = precision @ wide.nuisance[-1, :2]
    of_fleet = precision - np.eye(2) / sigmas_m[1] ** 2  # nothing where no sign of the map is reported
    log_evidence = []
    for sigma_m in sigmas_m:
        spread = np.linalg.det(np.eye(2) + sigma_m**2 * of_fleet)
        log_evidence.append(0.5 * (said @ np.linalg.solve(of_fleet + np.eye(2) / sigma_m**2, said) - np.log(spread)))
    odds = PRIOR_IS_OFF / (1 - PRIOR_IS_OFF)
    return float(1 / (1 + odds * np.exp(log_evidence[1] - log_evidence[0])))


def _added(matrices: Floats, vectors: Floats, group: Ints, n_groups: int) -> tuple[Floats, Floats]:
    """Return the sums of matrices and vectors over groups."""
    total, moment = np.zeros((n_groups, 2, 2)), np.zeros((n_groups, 2))
    np.add.at(total, group, matrices)
    np.add.at(moment, group, vectors)
    return total, moment
