"""Compiled loops of the Kalman tracker: association by innovation and class, and the merging of fragments.

A track is a filter over four numbers: the sign's place (east, north) in the frame of the *reported* poses, and what the
pass adds to every range and bearing. A frame measures d = |y - q| + b_r + n_r and a = ∠(y - q) + b_θ + n_θ from the
reported pose q. All tracks of a pass share the bias, so its prior is that of the pass, as tight as is known.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numba import njit

from geofleet.algorithms.assignment import NONE, _assign, _Graph  # the compiled core: one call a frame
from geofleet.algorithms.information_kernels import NEAREST_M, wrapped
from geofleet.algorithms.tracking_kernels import _without_stale

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

LOG_BIRTH_DENSITY = np.log(6e-4)
"""New objects a frame, metre and radian: 0.06 over a cone of 100 m and 60°."""
VOTES_AWAY = 8
"""Classes that lag behind by more votes weigh nothing."""


class Filter(NamedTuple):
    """What the filter assumes: noise a frame, prior of the bias (range m, bearing rad), gate, misreadings."""

    range_var_m2: float
    bearing_var_rad2: float
    bias: Floats  # (2,)
    bias_cov: Floats  # (2, 2)
    gate_chi2: float
    class_error_rate: float
    n_classes: int
    max_missed_frames: int


@njit(cache=True, nogil=True)
def associate_filtered(  # noqa: PLR0917 - numba takes no keyword-only arguments
    frame_start: Ints, range_m: Floats, azimuth_rad: Floats, class_code: Ints, pose_xy_m: Floats, model: Filter
) -> Ints:
    """Return the track of every detection, numbered by birth.

    In each frame detections and live tracks are assigned one to one at the least total of
    ½ m² + ½ ln|2πS| - ln P(class), m² being the squared innovation under S and below the gate, against the density of
    births.
    """
    n = len(range_m)
    track, last_frame = np.empty(n, np.int64), np.empty(n, np.int64)
    mean, cov = np.empty((n, 4)), np.empty((n, 4, 4))
    votes = np.zeros((n, model.n_classes), np.int64)
    live, n_live, n_tracks = np.empty(n, np.int64), 0, 0
    for frame in range(len(frame_start) - 1):
        first, last = frame_start[frame], frame_start[frame + 1]
        n_live = _without_stale(live, n_live, last_frame, frame - 1 - model.max_missed_frames)
        taken = np.full(last - first, NONE)
        if n_live and last > first:
            seen = slice(first, last)
            candidates = _candidates(
                live[:n_live],
                mean,
                cov,
                votes,
                range_m[seen],
                azimuth_rad[seen],
                class_code[seen],
                pose_xy_m[frame],
                model,
            )
            column_of_track = _assign(candidates, last - first)
            for k in range(n_live):
                if column_of_track[k] != NONE:
                    taken[column_of_track[k]] = live[k]
        for i in range(first, last):
            if taken[i - first] == NONE:
                taken[i - first] = live[n_live] = n_tracks
                _begin(mean[n_tracks], cov[n_tracks], range_m[i], azimuth_rad[i], pose_xy_m[frame], model)
                n_live, n_tracks = n_live + 1, n_tracks + 1
            else:
                t = taken[i - first]
                _update(mean[t], cov[t], range_m[i], azimuth_rad[i], pose_xy_m[frame], model)
            t = track[i] = taken[i - first]
            votes[t, class_code[i]] += 1
            last_frame[t] = frame
    return track


@njit(cache=True, nogil=True)
def associate_filtered_passes(  # noqa: PLR0917 - numba takes no keyword-only arguments
    pass_start: Ints,
    frame_start: Ints,
    range_m: Floats,
    azimuth_rad: Floats,
    class_code: Ints,
    pose_xy_m: Floats,
    bias: Floats,
    bias_cov: Floats,
    model: Filter,
) -> Ints:
    """Associate each pass by itself under its bias, (n_passes, 2), and classes as many as it reports.

    The tracks of a pass are numbered after those of the passes before.
    """
    track, n_tracks = np.empty(len(range_m), np.int64), 0
    for number in range(len(pass_start) - 1):
        begin, end = pass_start[number], pass_start[number + 1]
        first, last = frame_start[begin], frame_start[end]
        if first == last:
            continue
        own = Filter(
            model.range_var_m2,
            model.bearing_var_rad2,
            bias[number],
            bias_cov[number],
            model.gate_chi2,
            model.class_error_rate,
            class_code[first:last].max() + 1,
            model.max_missed_frames,
        )
        track[first:last] = n_tracks + associate_filtered(
            frame_start[begin : end + 1] - first,
            range_m[first:last],
            azimuth_rad[first:last],
            class_code[first:last],
            pose_xy_m[begin:end],
            own,
        )
        n_tracks = track[first:last].max() + 1
    return track


@njit(cache=True, nogil=True)
def _candidates(  # noqa: PLR0917 - numba takes no keyword-only arguments
    live: Ints,
    mean: Floats,
    cov: Floats,
    votes: Ints,
    range_m: Floats,
    azimuth_rad: Floats,
    class_code: Ints,
    pose_xy_m: Floats,
    model: Filter,
) -> _Graph:
    """Return the pairs of live tracks and detections inside the gate, with what each saves over a birth."""
    start, n_pairs = np.zeros(len(live) + 1, np.int64), 0
    column, cost = np.empty(len(live) * len(range_m), np.int64), np.empty(len(live) * len(range_m))
    jacobian = np.empty((2, 4))
    for k in range(len(live)):
        t = live[k]
        expected_range, expected_azimuth = _expect(mean[t], pose_xy_m, jacobian)
        rr, ra, aa = _innovation_cov(jacobian, cov[t], model)
        det = rr * aa - ra * ra
        most_likely = votes[t].max()
        for j in range(len(range_m)):
            er, ea = range_m[j] - expected_range, wrapped(azimuth_rad[j] - expected_azimuth)
            chi2 = (aa * er * er - 2 * ra * er * ea + rr * ea * ea) / det
            if chi2 < model.gate_chi2:
                likelihood = -0.5 * chi2 - np.log(2 * np.pi) - 0.5 * np.log(det)
                likelihood += _log_class(votes[t], most_likely, class_code[j], model)
                column[n_pairs] = j
                cost[n_pairs] = LOG_BIRTH_DENSITY - np.log(model.n_classes) - likelihood
                n_pairs += 1
        start[k + 1] = n_pairs
    return _Graph(start, column[:n_pairs], cost[:n_pairs], np.zeros(len(live)))


@njit(cache=True, nogil=True)
def _log_class(votes: Ints, most: int, class_code: int, model: Filter) -> float:
    """Return ln Σ_k π_k M_kc: the chance to read this class on the sign that was read like this before."""
    if model.n_classes == 1:
        return 0.0
    misread = model.class_error_rate / (model.n_classes - 1)
    vote = np.log((1 - model.class_error_rate) / misread)  # what one reading is worth
    total = 0.0
    for k in range(model.n_classes):
        if most - votes[k] <= VOTES_AWAY:
            total += np.exp(vote * (votes[k] - most))
    share = np.exp(vote * (votes[class_code] - most)) / total
    likelihood: float = np.log(misread + share * (1 - model.class_error_rate - misread))
    return likelihood


@njit(cache=True, nogil=True)
def _expect(mean: Floats, pose_xy_m: Floats, jacobian: Floats) -> tuple[float, float]:
    """Return the range and azimuth to be measured, and write their derivatives by the state."""
    dx, dy = mean[0] - pose_xy_m[0], mean[1] - pose_xy_m[1]
    distance = max(np.sqrt(dx * dx + dy * dy), NEAREST_M)
    jacobian[0, 0], jacobian[0, 1], jacobian[0, 2], jacobian[0, 3] = dx / distance, dy / distance, 1.0, 0.0
    jacobian[1, 0], jacobian[1, 1] = -dy / distance**2, dx / distance**2
    jacobian[1, 2], jacobian[1, 3] = 0.0, 1.0
    return distance + mean[2], np.arctan2(dy, dx) + mean[3]


@njit(cache=True, nogil=True)
def _innovation_cov(jacobian: Floats, cov: Floats, model: Filter) -> tuple[float, float, float]:
    """Return rr, ra, aa of S = H P Hᵀ + R."""
    rr, ra, aa = model.range_var_m2, 0.0, model.bearing_var_rad2
    for p in range(4):
        for q in range(4):
            rr += jacobian[0, p] * cov[p, q] * jacobian[0, q]
            ra += jacobian[0, p] * cov[p, q] * jacobian[1, q]
            aa += jacobian[1, p] * cov[p, q] * jacobian[1, q]
    return rr, ra, aa


@njit(cache=True, nogil=True)
def _begin(  # noqa: PLR0917 - numba takes no keyword-only arguments
    mean: Floats, cov: Floats, range_m: float, azimuth_rad: float, pose_xy_m: Floats, model: Filter
) -> None:
    """Start a track where its first detection points, corrected by the bias as far as that is known."""
    distance, angle = range_m - model.bias[0], azimuth_rad - model.bias[1]
    ux, uy = np.cos(angle), np.sin(angle)
    mean[0], mean[1] = pose_xy_m[0] + distance * ux, pose_xy_m[1] + distance * uy
    mean[2], mean[3] = model.bias[0], model.bias[1]
    turn = np.array([[ux, -distance * uy], [uy, distance * ux]])  # of the place, by range and by angle
    noise = model.bias_cov.copy()
    noise[0, 0] += model.range_var_m2
    noise[1, 1] += model.bearing_var_rad2
    cross = turn @ model.bias_cov
    cov[:2, :2] = turn @ noise @ turn.T
    cov[:2, 2:] = -cross
    cov[2:, :2] = -cross.T
    cov[2:, 2:] = model.bias_cov


@njit(cache=True, nogil=True)
def _update(  # noqa: PLR0917 - numba takes no keyword-only arguments
    mean: Floats, cov: Floats, range_m: float, azimuth_rad: float, pose_xy_m: Floats, model: Filter
) -> None:
    """Take a detection in: range first, then azimuth, each a scalar update of the extended filter."""
    jacobian = np.empty((2, 4))
    for axis in range(2):
        expected_range, expected_azimuth = _expect(mean, pose_xy_m, jacobian)
        error = range_m - expected_range if axis == 0 else wrapped(azimuth_rad - expected_azimuth)
        along = cov @ jacobian[axis]
        variance = jacobian[axis] @ along + (model.range_var_m2 if axis == 0 else model.bearing_var_rad2)
        for p in range(4):
            mean[p] += along[p] * error / variance
            for q in range(4):
                cov[p, q] -= along[p] * along[q] / variance
