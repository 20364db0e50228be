"""Signs that are likelier one than two are joined, after passes were assigned one by one (`joint_association`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from geofleet.algorithms.compiled import kernel
from geofleet.algorithms.joint_association import GATE_CHI2, REACH_M, Places, overlap

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

ASKEW_PASSES, ASKEW_M = 2, 0.7
"""Where so many passes report only the one of two places, and as many only the other, some may be laid askew together:
they agree among themselves, and are off from the others by this much, an axis, which their covariances do not know."""
MISSED_NATS = 1.0
"""Evidence of each pass that reports only the rarer of two places that they are one: passes miss few signs."""


def merge(places: Places, sign: Ints, log_confusion: Floats, log_prior: Floats, *, birth_cost: float) -> Ints:
    """Join signs that are likelier one than two.

    Two births cost more than one, passes report one of them only, and they agree in place and class; against it are the
    passes that hold both in one frame, of which one track would be cast out. Parameters and result are those of
    `sweep`; the pair that saves the most is joined first, and a sign joins once.
    """
    n_signs = int(sign.max(initial=-1)) + 1
    xy_m, cov = _sums(places, sign, n_signs)
    pairs = cKDTree(xy_m).query_pairs(REACH_M / 2, output_type="ndarray")
    one, two = pairs.T
    by_sign = np.argsort(sign, kind="stable")
    start = np.searchsorted(sign[by_sign], np.arange(n_signs + 1))
    owner = np.repeat(np.arange(len(places.first) - 1), np.diff(places.first))
    n_both, n_lonely = _passes_of_pairs(one, two, by_sign, start, owner, places)
    drove_by = places.n_around[by_sign[start[:-1]]] > 0
    askew = (n_lonely >= ASKEW_PASSES) & (n_lonely > ASKEW_PASSES * n_both) & drove_by[one] & drove_by[two]
    s, d = cov[one] + cov[two], xy_m[one] - xy_m[two]
    s[askew, :2] += ASKEW_M**2
    det = s[:, 0] * s[:, 1] - s[:, 2] ** 2
    chi2 = (s[:, 1] * d[:, 0] ** 2 - 2 * s[:, 2] * d[:, 0] * d[:, 1] + s[:, 0] * d[:, 1] ** 2) / det
    likely = chi2 < GATE_CHI2
    one, two, chi2, det, n_both, n_lonely = (values[likely] for values in (one, two, chi2, det, n_both, n_lonely))
    log_class = np.zeros((n_signs, len(log_prior)))
    np.add.at(log_class, sign, log_confusion[places.kind_code, :, places.class_code])
    own = np.logaddexp.reduce(log_class + log_prior, axis=1)
    together = np.logaddexp.reduce(log_class[one] + log_class[two] + log_prior, axis=1)
    # the class share of a birth, 1 / n_classes, is in `own`
    saved = birth_cost - np.log(len(log_prior)) - (0.5 * chi2 + np.log(2 * np.pi) + 0.5 * np.log(det))
    saved -= own[one] + own[two] - together
    saved += MISSED_NATS * n_lonely - birth_cost * n_both
    # a track that would be cast out must be outweighed by passes that report the rarer place alone
    worth = np.flatnonzero((saved > 0) & ((n_both == 0) | (n_lonely > n_both)))
    order = worth[np.argsort(-saved[worth], kind="stable")]
    root: Ints = _join_once(one[order], two[order], n_signs)
    joined: Ints = np.unique(root[sign], return_inverse=True)[1].astype(np.int64)
    return joined


def _sums(places: Places, sign: Ints, n_signs: int) -> tuple[Floats, Floats]:
    """Return places of signs, (n, 2), and their covariances, (n, 3: ee, nn, en), from their tracks."""
    ee, nn, en = places.cov_m2.T
    det = ee * nn - en * en
    a, b, c = (np.bincount(sign, weight, minlength=n_signs) for weight in (nn / det, ee / det, -en / det))
    east, north = places.xy_m.T
    u = np.bincount(sign, (nn * east - en * north) / det, minlength=n_signs)
    w = np.bincount(sign, (ee * north - en * east) / det, minlength=n_signs)
    whole = a * b - c * c
    xy_m = np.column_stack(((b * u - c * w) / whole, (a * w - c * u) / whole))
    return xy_m, np.column_stack((b, a, -c)) / whole[:, None]


@kernel
def _join_once(one: Ints, two: Ints, n_signs: int) -> Ints:
    """Join pairs in the order given, each sign once."""
    root, used = np.arange(n_signs), np.zeros(n_signs, np.bool_)
    for a, b in zip(one, two):  # noqa: B905 - numba knows no strict zip
        if not (used[a] or used[b]):
            root[b] = a
            used[a] = used[b] = True
    return root


@kernel
def _passes_of_pairs(  # noqa: PLR0917 - numba takes no keyword-only arguments
    one: Ints, two: Ints, by_sign: Ints, start: Ints, owner: Ints, places: Places
) -> tuple[Ints, Ints]:
    """Count the passes that hold both signs of each pair in one frame, and those that hold only the rarer one."""
    n_both, n_lonely = np.zeros(one.size, np.int64), np.zeros(one.size, np.int64)
    lonely, beyond = np.zeros(2, np.int64), places.first.size
    for p in range(one.size):
        mine, theirs = by_sign[start[one[p]] : start[one[p] + 1]], by_sign[start[two[p]] : start[two[p] + 1]]
        at, other = 0, 0
        lonely[:] = 0
        while at < mine.size or other < theirs.size:  # tracks of a sign are sorted by pass
            v = min(
                owner[mine[at]] if at < mine.size else beyond, owner[theirs[other]] if other < theirs.size else beyond
            )
            at_end, other_end = _end_of(mine, at, owner, v), _end_of(theirs, other, owner, v)
            n_both[p] += _meet(mine[at:at_end], theirs[other:other_end], places)
            lonely[0] += other_end == other
            lonely[1] += at_end == at
            at, other = at_end, other_end
        n_lonely[p] = lonely.min()
    return n_both, n_lonely


@kernel
def _end_of(tracks: Ints, begin: int, owner: Ints, v: int) -> int:
    while begin < tracks.size and owner[tracks[begin]] == v:
        begin += 1
    return begin


@kernel
def _meet(mine: Ints, theirs: Ints, places: Places) -> bool:
    """Return whether any two tracks of a pass share a frame."""
    for i in mine:
        for j in theirs:
            if overlap(places, i, j):
                return True
    return False
