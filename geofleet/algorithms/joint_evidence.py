"""What a group of tracks says besides its place: which class the sign has, and whether there is one.

Classes: log π_j = log prior + Σ log M[:, c], with M the confusion of each kind of sensor. Existence: a sign is reported
by a share of the passes that had it in view that scatters around P_D (beta-binomial), a persistent ghost by a smaller
one, and clutter once. M, P_D and the clutter are learnt by expectation-maximisation from priors that are stated here.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import betaln, gammaln, xlogy

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

SIGN_DENSITY_M2 = 1e-3
"""Signs a square metre beside a road: one every 30 m on either side, within 15 m."""
ERROR_PRIOR = (2.0, 38.0)
"""Beta prior of the share of misread tracks: 5 %, worth forty tracks."""
CONFUSION_PRIOR = 20.0
"""Dirichlet prior of what a misread class is taken for: as much for each other class, worth this many misreadings.

A weak one believes itself: a single track against a retyped sign of the prior map becomes the usual misreading."""
DETECTION_PRIOR = (18.0, 2.0)
"""Beta prior of P_D, the chance that a pass that had a sign in view reports it: 90 %, worth twenty chances."""
DETECTION_SPREAD = 20.0
"""Signs differ: P_D of one sign is beta around the common one, worth this many chances."""
VIEW_SPREAD = 2.0
"""A brief view is alike for all passes, and enough or not: the part it counts for is beta, worth so many views."""
GHOST = (2.0, 3.0)
"""Share of the passes that report a persistent ghost: beta around 0.4."""
GHOSTS_A_SIGN = 0.03
CLUTTER_PRIOR = (0.5, 1.0)
"""Gamma prior of clutter tracks a pass: shape, and the passes that it is worth."""
PRIOR_MAP_KEPT = (9.0, 1.0)
"""Beta prior of the share of a prior map's entries that stand: 90 %, worth ten entries that the fleet can judge."""
OUTDATED_BY_MOVING = 0.5
"""Share of the other entries whose sign stands elsewhere by now, within `MOVED_M`."""
MOVED_M, ANOTHER = 10.0, 0.1
"""So many other signs of its class stand within `MOVED_M` of a sign: where signs of a class are paired, none moved."""
PRIOR_MAP_COMPLETE = 0.85
"""Share of the signs that a prior map knows."""
FULL_VIEW_FRAMES, LEAST_VIEW_FRAMES = 5.0, 2.0
"""A pass had a fair chance with so many frames in view, and none with so few; in between in proportion."""
UNTOLD_CLUTTER = 0.2
"""Share of single tracks that are clutter where nobody knows who had the place in view."""
BESIDE_M = 6.0
STRAY_RATE = 0.003
"""Of the tracks of a sign so many stray beyond every gate, and look like a second sign of its class beside it."""
LEAST_ERROR = 1e-6
LEAST_SHARE = 1e-3
"""No chance to report a sign is smaller, and none is surer than one minus it."""
MAX_ROUNDS, SETTLED = 50, 1e-6
CHANCE_OF_CLUTTER = 1e-3
"""Of a clutter track within the gate of a given place, a pass."""


@dataclass(frozen=True, slots=True, eq=False)
class Recognition:
    """How classes are read: confusion a kind of sensor.

    Parameters
    ----------
    log_confusion
        (n_kinds, n_classes, n_classes): log-probability that class k is read as c.
    error_rate
        (n_kinds,) share of misread tracks.
    """

    log_confusion: Floats
    error_rate: Floats


def recognition(error_rate: Floats, n_classes: int, misread: Floats | None = None) -> Recognition:
    """Return the confusion of sensors that misread so often, as `misread` or any class alike.

    `misread` (n_kinds, n_classes, n_classes) says what each class is taken for when it is misread, up to a factor.
    """
    if n_classes == 1:
        return Recognition(np.zeros((len(error_rate), 1, 1)), error_rate)
    other = (1 - np.eye(n_classes)) * (np.ones((1, n_classes, n_classes)) if misread is None else misread)
    other /= other.sum(axis=2, keepdims=True)
    rate = np.clip(error_rate, LEAST_ERROR, 1 - LEAST_ERROR)[:, None, None]
    return Recognition(np.log((1 - rate) * np.eye(n_classes) + rate * other + 1e-300), error_rate)


def class_posterior(sign: Ints, n_signs: int, class_code: Ints, kind_code: Ints, read: Recognition) -> Floats:
    """Return the log-posterior of every class, (n_signs, n_classes), classes being alike beforehand."""
    n_classes = read.log_confusion.shape[1]
    log_class = np.zeros((n_signs, n_classes))
    np.add.at(log_class, sign, read.log_confusion[kind_code, :, class_code])
    return log_class - np.logaddexp.reduce(log_class, axis=1, keepdims=True)


def learn_recognition(
    log_posterior: Floats,
    sign: Ints,
    class_code: Ints,
    kind_code: Ints,
    *,
    fixed_rate: Floats,
    is_fixed: NDArray[np.bool_],
) -> Recognition:
    """Return the confusion that the tracks show, one step of expectation-maximisation.

    `fixed_rate` is kept for the kinds that `is_fixed` (a prior map).
    """
    n_kinds, n_classes = len(fixed_rate), log_posterior.shape[1]
    if n_classes == 1:
        return recognition(fixed_rate, 1)
    posterior = np.exp(log_posterior[sign])
    right = posterior[np.arange(len(sign)), class_code]
    wrong = np.bincount(kind_code, 1 - right, minlength=n_kinds)
    total = np.bincount(kind_code, minlength=n_kinds)
    rate = (ERROR_PRIOR[0] + wrong) / (sum(ERROR_PRIOR) + total)
    expected = np.zeros((n_classes, n_classes))
    learnt = ~is_fixed[kind_code]
    np.add.at(expected.T, class_code[learnt], posterior[learnt])
    np.fill_diagonal(expected, 0.0)
    misread = (expected + CONFUSION_PRIOR / (n_classes - 1)) / (expected.sum(axis=1, keepdims=True) + CONFUSION_PRIOR)
    of_kind = np.where(is_fixed[:, None, None], 1.0, misread)
    return recognition(np.where(is_fixed, fixed_rate, rate), n_classes, of_kind)


@dataclass(frozen=True, slots=True, eq=False)
class Support:
    """Evidence for each sign that it exists.

    Parameters
    ----------
    n_passes
        (n,) passes of the fleet that report it.
    n_in_view, n_chances
        (n,) passes that had it in view, and the same in parts where the view was short; NaN where nobody knows.
    n_beside
        (n,) passes that report a sign of the same class within `BESIDE_M`, 0 without one that has far more of them.
    in_prior
        (n,) whether the prior map holds it; None without a prior map.
    moved_to
        (n,) row that an entry of the prior map may have moved to: a sign of its class within `MOVED_M` that the map
        does not hold, where nobody reports the entry. -1 without one.
    n_fleet
        Passes of the fleet.
    n_classes
        Classes that signs may have.
    """

    n_passes: Floats
    n_in_view: Floats
    n_chances: Floats
    n_beside: Floats
    in_prior: NDArray[np.bool_] | None
    moved_to: Ints
    n_fleet: int
    n_classes: int


@dataclass(frozen=True, slots=True, eq=False)
class Existence:
    """Probability that each sign exists, (n,), and what was learnt: P_D and clutter tracks a pass."""

    probability: Floats
    detection_rate: float
    clutter_per_pass: float


def existence(support: Support) -> Existence:
    """Weigh, for each group of tracks, a sign against a persistent ghost, clutter and an outdated entry of the map."""
    n, chances = support.n_passes, np.fmax(support.n_chances, support.n_passes)
    told, in_prior = np.isfinite(support.n_chances), _is_in_prior(support)
    single = (n == 1) & ~in_prior
    judged = np.where(told, np.minimum(chances, 1.0), n > 0) * in_prior
    learnt = Rates(
        _mean(DETECTION_PRIOR), CLUTTER_PRIOR[0] / CLUTTER_PRIOR[1], _mean(PRIOR_MAP_KEPT), max(1.0, float(len(n)))
    )
    probability = np.ones(len(n))
    for _ in range(MAX_ROUNDS):
        before = probability
        probability = _probability(support, learnt, before)
        learnt = Rates(
            _mean(DETECTION_PRIOR, (probability * n)[told].sum(), (probability * chances)[told].sum()),
            float(CLUTTER_PRIOR[0] + (1 - probability)[single].sum()) / (CLUTTER_PRIOR[1] + support.n_fleet),
            _mean(PRIOR_MAP_KEPT, (probability * judged).sum(), judged.sum()),
            max(float(probability.sum()), 1.0),
        )
        if np.abs(probability - before).max(initial=0) < SETTLED:
            break
    return Existence(probability, learnt.detection, learnt.clutter)


class Rates(NamedTuple):
    """What existence is weighed with, learnt from the run: P_D, clutter a pass, entries that stand, signs."""

    detection: float
    clutter: float
    kept: float
    n_signs: float


def _mean(prior: tuple[float, float], successes: float = 0.0, trials: float = 0.0) -> float:
    """Return the posterior mean of a share under a beta prior."""
    return float((prior[0] + successes) / (sum(prior) + trials))


def _is_in_prior(support: Support) -> NDArray[np.bool_]:
    return np.zeros(len(support.n_passes), np.bool_) if support.in_prior is None else support.in_prior


def _probability(support: Support, rates: Rates, before: Floats) -> Floats:
    """Return the posterior of existence under these rates, and under the one before of what entries moved to."""
    n, told = support.n_passes, np.isfinite(support.n_chances)
    trials = np.fmax(support.n_in_view, n)
    missed = np.where(told, trials - n, 0.0)
    a, b = _detection(support, rates.detection)
    sign = betaln(a + n, b + missed) - betaln(a, b)
    ghost = np.log(GHOSTS_A_SIGN) + betaln(GHOST[0] + n, GHOST[1] + missed) - betaln(*GHOST)
    # singles: as many signs as there are would be seen by one of their passes only, against clutter over all passes
    once = np.log(rates.clutter * max(support.n_fleet, 1) / rates.n_signs)
    once = once - np.log(np.maximum(np.where(told, trials, 1.0), 1.0))
    once = np.where(n == 1, once, n * np.log(CHANCE_OF_CLUTTER))
    once = np.where(told, once, sign + n * np.log(UNTOLD_CLUTTER / (1 - UNTOLD_CLUTTER)))
    class_density = SIGN_DENSITY_M2 / support.n_classes
    stray = sign + xlogy(n, STRAY_RATE * support.n_beside) - gammaln(n + 1)
    stray = stray - np.log(class_density * np.pi * BESIDE_M**2)  # expected signs of the class beside another
    stray[support.n_beside == 0] = -np.inf
    other = np.logaddexp(ghost, np.logaddexp(once, stray))
    if support.in_prior is not None:
        gone = (1 - rates.kept) * (1 - OUTDATED_BY_MOVING + OUTDATED_BY_MOVING * _moved(support, before))
        outdated = np.log(gone) + n * np.log(CHANCE_OF_CLUTTER)
        sign = sign + np.where(support.in_prior, np.log(rates.kept), np.log(1 - PRIOR_MAP_COMPLETE))
        other = np.where(support.in_prior, outdated, other)
    exists: Floats = 1 / (1 + np.exp(np.clip(other - sign, -700, 700)))
    return exists


def _detection(support: Support, rate: float) -> tuple[Floats, Floats]:
    """Return the beta by which passes that had it in view report each sign: P_D times the part of a view.

    Signs differ in P_D, and more where views are brief: the variances of both parts add up.
    """
    told, trials = np.isfinite(support.n_chances), np.fmax(support.n_in_view, support.n_passes)
    part = np.where(told & (trials > 0), np.fmax(support.n_chances, support.n_passes) / np.maximum(trials, 1.0), 1.0)
    part = np.clip(part, LEAST_SHARE, 1.0)
    rate = min(max(rate, LEAST_SHARE), 1 - LEAST_SHARE)
    of_signs = rate * (1 - rate) / (DETECTION_SPREAD + 1)
    variance = part**2 * of_signs + (rate**2 + of_signs) * part * (1 - part) / (VIEW_SPREAD + 1)
    share = rate * part
    worth = share * (1 - share) / variance - 1
    return worth * share, worth * (1 - share)


def _moved(support: Support, probability: Floats) -> Floats:
    """Return how much likelier what is seen around each entry is where its sign moved than where it stands.

    That is one, without a sign beside it that the map does not know; such a one is moved, or new.
    """
    has_one = support.moved_to >= 0
    there = np.zeros(len(probability))
    there[has_one] = probability[support.moved_to[has_one]]
    ratio: Floats = 1 - there + there / (ANOTHER * (1 - PRIOR_MAP_COMPLETE))
    return ratio
