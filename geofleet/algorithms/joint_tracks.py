"""What passes report, ready for joint fusion: every track as a quadratic form in its place and the bias of its pass.

The unknowns of a track are x = (east, north, range bias, bearing bias): the place in the frame of the *reported* poses
(the sign's place plus the GNSS offset of the pass) and what the sensor adds to ranges and bearings. A track says
-½ xᵀNx + rᵀx about them (`algorithms.information`). A detection that brings its mean only says the same of a single
measurement p = place + u b_r + d u⊥ b_θ, with the mean direction u and range d of its frames and the covariance of the
mean; where direction or range are missing, what they would have told widens the covariance instead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.compiled import kernel
from geofleet.algorithms.information import about_bias, bias_posterior

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Flags = NDArray[np.bool_]
    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

UNKNOWN_FRAME = -1
SPREAD_M = 1.0
"""Spread over frames of a mean that does not bring one."""
FLOOR_M = 0.05
"""A mean is never better than this, an axis: its frames share more than a calibration."""
LEVER_ERROR = 0.2
"""Of what biases do to a mean, its mean range and direction do not tell this part: they stand for all frames."""
SCALE_DOF = 30.0
"""Degrees of freedom with which the scale of a pass is held to 1 before its residuals speak."""
SPOILT_RATIO = 4.0
"""Tracks whose residual is this many times that of the pass's median track say nothing about its noise."""
FRAGMENT_CHI2 = 13.8
"""Fragments of one pass whose places differ by less (99.9 %, 2 degrees of freedom) are one track."""
FRAGMENT_REACH_M = 15.0
BLOCK = 65_536
"""Tracks that are looked at together."""
UNKNOWNS = 4
"""That a track solves for: two measurements a frame, less these, are its degrees of freedom."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Tracks in quadratic form, one row a track, sorted by pass.

    Parameters
    ----------
    pass_code, class_code
        (n,) pass and reported class.
    origin_xy_m
        (n, 2) where the place of each is counted from.
    matrix, vector
        (n, 4, 4), (n, 4): N and r; metres and radians.
    frame_first, frame_last
        (n,) frames of the pass between which the track was seen; `UNKNOWN_FRAME` where not told.
    s0, dof
        (n,) sum of weighted squared residuals within the track, and its degrees of freedom; 0 for a mean.
    """

    pass_code: Ints
    class_code: Ints
    origin_xy_m: Floats
    matrix: Floats
    vector: Floats
    frame_first: Ints
    frame_last: Ints
    s0: Floats
    dof: Floats

    def take(self, rows: Ints | Flags) -> Tracks:
        """Return some rows."""
        return Tracks(*(getattr(self, name)[rows] for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class Passes:
    """What passes declare of themselves, one row a pass.

    Parameters
    ----------
    gnss_sigma_m
        (n,) standard deviation an axis of the offset that a pass adds to every place.
    bias_sigma
        (n, 2) standard deviation of range bias (m) and bearing bias (rad); 0 where there is none.
    kind_code
        (n,) kind of sensor: noise and recognition are learnt a kind.
    """

    gnss_sigma_m: Floats
    bias_sigma: Floats
    kind_code: Ints


def tracks_of_means(
    xy_m: Floats, *, n_frames: Floats, spread: Floats, range_m: Floats, azimuth_rad: Floats, bias_sigma: Floats
) -> tuple[Floats, Floats]:
    """Return N (n, 4, 4) and r (n, 4) about the means themselves, of detections that bring nothing else.

    Parameters
    ----------
    xy_m
        (n, 2) mean reported positions.
    n_frames
        (n,) frames; NaN counts as one.
    spread
        (n, 3) variance east, north and covariance over frames, m²; NaN where unknown.
    range_m, azimuth_rad
        (n,) mean range and direction of view counter-clockwise from east; NaN where unknown.
    bias_sigma
        (n, 2) of the pass: it widens the covariance of a mean whose direction or range is unknown.
    """
    frames = np.fmax(n_frames, 1.0)
    known = np.isfinite(spread[:, :2]).all(axis=1)
    cov = np.zeros((len(xy_m), 2, 2))
    cov[:, 0, 0] = np.where(known, spread[:, 0], SPREAD_M**2) / frames + FLOOR_M**2
    cov[:, 1, 1] = np.where(known, spread[:, 1], SPREAD_M**2) / frames + FLOOR_M**2
    cov[:, 0, 1] = cov[:, 1, 0] = np.where(known & np.isfinite(spread[:, 2]), spread[:, 2], 0.0) / frames
    is_viewed = np.isfinite(range_m) & np.isfinite(azimuth_rad)
    east, north = np.cos(np.where(is_viewed, azimuth_rad, 0.0)), np.sin(np.where(is_viewed, azimuth_rad, 0.0))
    reach = np.where(is_viewed, range_m, 0.0)
    design = np.zeros((len(xy_m), 2, 4))
    design[:, 0, 0] = design[:, 1, 1] = 1.0
    design[:, 0, 2], design[:, 1, 2] = east * is_viewed, north * is_viewed
    design[:, 0, 3], design[:, 1, 3] = -reach * north, reach * east
    lever = bias_sigma[:, 0] ** 2 + (reach * bias_sigma[:, 1]) ** 2
    cov += (np.where(is_viewed, LEVER_ERROR**2, 1.0) * lever)[:, None, None] * np.eye(2)
    return np.swapaxes(design, 1, 2) @ np.linalg.solve(cov, design), np.zeros((len(xy_m), 4))


def scaled(tracks: Tracks, n_passes: int) -> tuple[Tracks, Floats]:
    """Return the tracks with the noise that their own residuals show, and the factor of the variance of every pass.

    The factor is (ν₀ + Σ s₀) / (ν₀ + Σ dof) over the tracks of the pass, spoilt ones left out, with ν₀ = `SCALE_DOF`:
    the mean of the inverse-gamma posterior around the declared noise. A track that is worse than its pass by more than
    chance keeps its own factor: it holds two signs, or a drift.
    """
    ratio = tracks.s0 / np.maximum(tracks.dof, 1.0)
    usable = tracks.dof > 0
    factor = np.ones(n_passes)
    if usable.any():
        typical = _medians(ratio[usable], tracks.pass_code[usable], n_passes)
        fair = usable & (ratio <= SPOILT_RATIO * typical[tracks.pass_code])
        total = np.bincount(tracks.pass_code[fair], tracks.s0[fair], minlength=n_passes)
        dof = np.bincount(tracks.pass_code[fair], tracks.dof[fair], minlength=n_passes)
        factor = (SCALE_DOF + total) / (SCALE_DOF + dof)
    beyond = ratio / factor[tracks.pass_code] > 1 + 5 * np.sqrt(2 / np.maximum(tracks.dof, 1.0))
    own = np.where(usable & beyond, ratio, factor[tracks.pass_code])
    return replace(tracks, matrix=tracks.matrix / own[:, None, None], vector=tracks.vector / own[:, None]), factor


def _medians(values: Floats, group: Ints, n_groups: int) -> Floats:
    """Return the lower median of each group, 1 where a group is empty."""
    order = np.lexsort((values, group))
    start = np.searchsorted(group[order], np.arange(n_groups + 1))
    middle = np.minimum((start[:-1] + start[1:] - 1) // 2, len(order) - 1)
    return np.where(start[1:] > start[:-1], values[order[np.maximum(middle, 0)]], 1.0)


def with_jitter(tracks: Tracks, jitter_m: Floats) -> Tracks:
    """Return the tracks with a further error of their places marginalised in, `jitter_m` (n,) an axis.

    N' = N - N_:p (τ⁻²I + N_pp)⁻¹ N_p:, and r' alike: no track is trusted beyond what its model can promise.
    """
    matrix, vector = np.empty_like(tracks.matrix), np.empty_like(tracks.vector)
    for rows in blocks(len(vector)):
        n_p, r, var = tracks.matrix[rows, :2], tracks.vector[rows], jitter_m[rows, None, None] ** 2
        gain = np.linalg.solve(var * n_p[:, :, :2] + np.eye(2), var * np.concatenate((n_p, r[:, :2, None]), axis=2))
        less = tracks.matrix[rows] - tracks.matrix[rows, :, :2] @ gain[:, :, :4]
        matrix[rows] = (less + np.swapaxes(less, 1, 2)) / 2
        vector[rows] = r - np.einsum("tij,tj->ti", tracks.matrix[rows, :, :2], gain[:, :, 4])
    return replace(tracks, matrix=matrix, vector=vector)


def blocks(n: int) -> list[slice]:
    """Return the parts in which so many tracks are looked at: matrices of all of them together would be large."""
    return [slice(begin, begin + BLOCK) for begin in range(0, n, BLOCK)]


def pass_biases(tracks: Tracks, passes: Passes) -> tuple[Floats, Floats]:
    """Return range and bearing bias of every pass from its own tracks, (n, 2), and their covariances, (n, 2, 2).

    A bias that the sensor cannot have stays 0.
    """
    n_passes = len(passes.gnss_sigma_m)
    schur, right = np.zeros((n_passes, 2, 2)), np.zeros((n_passes, 2))
    for rows in blocks(len(tracks.pass_code)):
        matrix, vector = about_bias(tracks.matrix[rows], tracks.vector[rows])
        np.add.at(schur, tracks.pass_code[rows], matrix)
        np.add.at(right, tracks.pass_code[rows], vector)
    return bias_posterior(schur, right, passes.bias_sigma)


def places(tracks: Tracks, bias: Floats, bias_cov: Floats) -> tuple[Floats, Floats]:
    """Return where each track is, its bias taken out, (n, 2), and the covariance, (n, 2, 2), the bias's share in it.

    `bias` and `bias_cov` are those of the passes.
    """
    inverse = np.linalg.inv(tracks.matrix[:, :2, :2])
    slope = inverse @ tracks.matrix[:, :2, 2:]
    right = np.einsum("tij,tj->ti", inverse, tracks.vector[:, :2])
    xy_m = tracks.origin_xy_m + right - np.einsum("tij,tj->ti", slope, bias[tracks.pass_code])
    cov = inverse + slope @ bias_cov[tracks.pass_code] @ np.swapaxes(slope, 1, 2)
    return xy_m, cov


def without_fragments(tracks: Tracks, xy_m: Floats, cov: Floats) -> tuple[Tracks, Ints]:
    """Join tracks of a pass that have one class, never share a frame and whose places agree: they are one sign.

    Where two tracks span the same frames and each was seen in a part of them, so that both parts have room in one
    frame after the other, they took turns: a gate that is too narrow for the noise makes two tracks of one sign so.

    Returns
    -------
    The joined tracks, and the joined track of each row given, (n,).
    """
    group = _fragments(tracks, xy_m, cov)
    n_groups = int(group.max(initial=-1)) + 1
    if n_groups == len(group):
        return tracks, group
    lead = np.unique(group, return_index=True)[1]
    origin = tracks.origin_xy_m[lead]
    shift = np.concatenate((tracks.origin_xy_m - origin[group], np.zeros((len(group), 2))), axis=1)
    matrix, vector = np.zeros((n_groups, 4, 4)), np.zeros((n_groups, 4))
    np.add.at(matrix, group, tracks.matrix)
    np.add.at(vector, group, tracks.vector + np.einsum("tij,tj->ti", tracks.matrix, shift))
    first, last = tracks.frame_first[lead].copy(), tracks.frame_last[lead].copy()
    np.minimum.at(first, group, tracks.frame_first)
    np.maximum.at(last, group, tracks.frame_last)
    joined = Tracks(
        tracks.pass_code[lead],
        tracks.class_code[lead],
        origin,
        matrix,
        vector,
        first,
        last,
        np.bincount(group, tracks.s0, minlength=n_groups).astype(np.float64),
        np.bincount(group, tracks.dof, minlength=n_groups).astype(np.float64),
    )
    return joined, group


def _fragments(tracks: Tracks, xy_m: Floats, cov: Floats) -> Ints:
    frames = np.where(tracks.dof > 0, (tracks.dof + UNKNOWNS) / 2, np.inf)
    frames = np.minimum(frames, tracks.frame_last - tracks.frame_first + 1)
    group: Ints = _join(
        tracks.pass_code,
        tracks.class_code,
        tracks.frame_first,
        tracks.frame_last,
        frames,
        np.ascontiguousarray(xy_m),
        cov,
    )
    return np.unique(group, return_inverse=True)[1].astype(np.int64)


@kernel
def _join(  # noqa: PLR0917
    pass_code: Ints, class_code: Ints, first: Ints, last: Ints, frames: Floats, xy_m: Floats, cov: Floats
) -> Ints:
    """Return the group of each track, named by its first row; rows of a pass stand together."""
    n = len(pass_code)
    group = np.arange(n)
    for i in range(n):
        if group[i] != i or first[i] < 0:
            continue
        j = i + 1
        while j < n and pass_code[j] == pass_code[i]:
            if group[j] == j and class_code[j] == class_code[i] and first[j] >= 0:
                east, north = xy_m[j, 0] - xy_m[i, 0], xy_m[j, 1] - xy_m[i, 1]
                ee, nn = cov[i, 0, 0] + cov[j, 0, 0], cov[i, 1, 1] + cov[j, 1, 1]
                en = cov[i, 0, 1] + cov[j, 0, 1]
                chi2 = (nn * east * east - 2 * en * east * north + ee * north * north) / (ee * nn - en * en)
                is_near = east * east + north * north < FRAGMENT_REACH_M**2 and chi2 < FRAGMENT_CHI2
                if is_near and _is_apart(group, first, last, frames, i, j):
                    group[j] = i
            j += 1
    return group


@kernel
def _is_apart(group: Ints, first: Ints, last: Ints, frames: Floats, lead: int, other: int) -> bool:  # noqa: PLR0917
    """Return whether a track likely shares no frame with any member of the group of `lead`."""
    for k in range(lead, other):
        is_during = first[k] <= last[other] and first[other] <= last[k]
        span = max(last[k], last[other]) - min(first[k], first[other]) + 1
        if group[k] == lead and is_during and frames[k] + frames[other] > span:
            return False
    return True
