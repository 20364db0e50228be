"""Compiled loops of the Kalman tracker: association by innovation and class, and the merging of fragments.

A track is a filter over four numbers: the sign's place (east, north) in the frame of the *reported* poses, and what the
pass adds to every range and bearing. A frame measures d = |y - q| + b_r + n_r and a = ∠(y - q) + b_θ + n_θ from the
reported pose q. All tracks of a pass share the bias, so its prior is that of the pass, as tight as is known.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.assignment import NONE, _assign, _Graph  # the compiled core: one call a frame
from geofleet.algorithms.compiled import kernel
from geofleet.algorithms.information_kernels import expected, wrapped
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


class _Seen(NamedTuple):
    """What one pass detects, (n,) each."""

    range_m: Floats
    azimuth_rad: Floats
    class_code: Ints


class _Tracks(NamedTuple):
    """The state of every track and its readings of each class; room for as many as there are detections.

    `weight[k]` is what a class weighs that lags behind by k readings, against the one most read.
    """

    mean: Floats  # (n, 4)
    cov: Floats  # (n, 4, 4)
    votes: Ints  # (n, n_classes)
    last_frame: Ints  # (n,)
    weight: Floats  # (VOTES_AWAY + 1,)


@kernel
def associate_filtered(  # noqa: PLR0917 - numba takes no keyword-only arguments
    frame_start: Ints, range_m: Floats, azimuth_rad: Floats, class_code: Ints, pose_xy_m: Floats, model: Filter
) -> Ints:
    """Return the track of every detection, numbered by birth.

    In each frame detections and live tracks are assigned one to one at the least total of
    ½ m² + ½ ln|2πS| - ln P(class), m² being the squared innovation under S and below the gate, against the density of
    births.
    """
    n, none = len(range_m), np.empty(0, np.int64)
    seen = _Seen(range_m, azimuth_rad, class_code)
    tracks = _Tracks(
        np.empty((n, 4)),
        np.empty((n, 4, 4)),
        np.zeros((n, model.n_classes), np.int64),
        np.empty(n, np.int64),
        _weights(model),
    )
    track, live, choice, holder = (
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
        np.empty(n, np.int64),
    )
    graph = _Graph(np.zeros(n + 1, np.int64), none, np.empty(0), np.zeros(n))  # room that frames share, and it grows
    n_live, n_tracks = 0, 0
    for frame in range(len(frame_start) - 1):
        first, last = frame_start[frame], frame_start[frame + 1]
        x, y = pose_xy_m[frame, 0], pose_xy_m[frame, 1]
        n_live = _without_stale(live, n_live, tracks.last_frame, frame - 1 - model.max_missed_frames)
        if n_live * (last - first) > len(graph.cost):
            n_pairs = 2 * n_live * (last - first)
            graph = _Graph(graph.start, np.empty(n_pairs, np.int64), np.empty(n_pairs), graph.skip_cost)
        if _pairs(live, n_live, tracks, seen, first, last, x, y, model, graph, choice, holder):
            n_pairs = graph.start[n_live]
            own = _Graph(
                graph.start[: n_live + 1], graph.column[:n_pairs], graph.cost[:n_pairs], graph.skip_cost[:n_live]
            )
            choice[:n_live] = _assign(own, last - first)
        for i in range(first, last):
            track[i] = NONE
        for k in range(n_live):
            if choice[k] != NONE:
                track[first + choice[k]] = live[k]
        for i in range(first, last):
            if track[i] == NONE:
                track[i] = live[n_live] = n_tracks
                _begin(tracks, n_tracks, range_m[i], azimuth_rad[i], x, y, model)
                n_live, n_tracks = n_live + 1, n_tracks + 1
            else:
                _update(tracks, track[i], range_m[i], azimuth_rad[i], x, y, model)
            tracks.votes[track[i], class_code[i]] += 1
            tracks.last_frame[track[i]] = frame
    return track


@kernel
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


@kernel
def _pairs(  # noqa: PLR0917 - numba takes no keyword-only arguments
    live: Ints,
    n_live: int,
    tracks: _Tracks,
    seen: _Seen,
    first: int,
    last: int,
    x: float,
    y: float,
    model: Filter,
    graph: _Graph,
    choice: Ints,
    holder: Ints,
) -> bool:
    """Write the pairs of live tracks and detections inside the gate, with what each saves over a birth.

    Return whether two tracks would take one detection; if not, what each takes is best (`choice`, from `first` on).
    """
    n_pairs, is_contested = 0, False
    for j in range(last - first):
        holder[j] = NONE
    for k in range(n_live):
        t, choice[k], least = live[k], NONE, 0.0
        distance, azimuth, ux, uy = expected(tracks.mean[t, 0], tracks.mean[t, 1], x, y)
        rr, ra, aa = _innovation_cov(tracks.cov, t, distance, ux, uy, model)
        det = rr * aa - ra * ra
        for j in range(last - first):
            er = seen.range_m[first + j] - distance - tracks.mean[t, 2]
            ea = wrapped(seen.azimuth_rad[first + j] - azimuth - tracks.mean[t, 3])
            weighted = aa * er * er - 2 * ra * er * ea + rr * ea * ea
            if weighted < model.gate_chi2 * det:
                likelihood = -0.5 * weighted / det - np.log(2 * np.pi) - 0.5 * np.log(det)
                likelihood += _log_class(tracks, t, seen.class_code[first + j], model)
                cost = LOG_BIRTH_DENSITY - np.log(model.n_classes) - likelihood
                graph.column[n_pairs], graph.cost[n_pairs] = j, cost
                n_pairs += 1
                if cost < least:
                    least, choice[k] = cost, j
        graph.start[k + 1] = n_pairs
        if choice[k] != NONE:
            is_contested |= holder[choice[k]] != NONE
            holder[choice[k]] = k
    return is_contested


@kernel
def _misread(model: Filter) -> float:
    """Return the chance to read one certain wrong class."""
    return model.class_error_rate / max(model.n_classes - 1, 1)


@kernel
def _weights(model: Filter) -> Floats:
    weights = np.ones(VOTES_AWAY + 1)
    for k in range(VOTES_AWAY):
        weights[k + 1] = weights[k] * _misread(model) / (1 - model.class_error_rate)
    return weights


@kernel
def _log_class(tracks: _Tracks, t: int, class_code: int, model: Filter) -> float:
    """Return ln Σ_k π_k M_kc: the chance to read this class on the sign that track t read like this before."""
    if model.n_classes == 1:
        return 0.0
    most, total = 0, 0.0
    for k in range(model.n_classes):
        most = max(most, tracks.votes[t, k])
    for k in range(model.n_classes):
        if most - tracks.votes[t, k] <= VOTES_AWAY:
            total += tracks.weight[most - tracks.votes[t, k]]
    behind, misread = most - tracks.votes[t, class_code], _misread(model)
    share = tracks.weight[behind] / total if behind <= VOTES_AWAY else 0.0
    likelihood: float = np.log(misread + share * (1 - model.class_error_rate - misread))
    return likelihood


@kernel
def _innovation_cov(  # noqa: PLR0917 - numba takes no keyword-only arguments
    cov: Floats, t: int, distance: float, ux: float, uy: float, model: Filter
) -> tuple[float, float, float]:
    """Return rr, ra, aa of S = H P Hᵀ + R; the rows of H are (ux, uy, 1, 0) and (-uy / d, ux / d, 0, 1)."""
    rx, ry = -uy / distance, ux / distance
    r0, r1 = ux * cov[t, 0, 0] + uy * cov[t, 1, 0] + cov[t, 2, 0], ux * cov[t, 0, 1] + uy * cov[t, 1, 1] + cov[t, 2, 1]
    r2, r3 = ux * cov[t, 0, 2] + uy * cov[t, 1, 2] + cov[t, 2, 2], ux * cov[t, 0, 3] + uy * cov[t, 1, 3] + cov[t, 2, 3]
    a0, a1 = rx * cov[t, 0, 0] + ry * cov[t, 1, 0] + cov[t, 3, 0], rx * cov[t, 0, 1] + ry * cov[t, 1, 1] + cov[t, 3, 1]
    a3 = rx * cov[t, 0, 3] + ry * cov[t, 1, 3] + cov[t, 3, 3]
    rr = ux * r0 + uy * r1 + r2 + model.range_var_m2
    aa = rx * a0 + ry * a1 + a3 + model.bearing_var_rad2
    return rr, rx * r0 + ry * r1 + r3, aa


@kernel
def _begin(  # noqa: PLR0917 - numba takes no keyword-only arguments
    tracks: _Tracks, t: int, range_m: float, azimuth_rad: float, x: float, y: float, model: Filter
) -> None:
    """Start a track where its first detection points, corrected by the bias as far as that is known."""
    mean, cov, bias, bias_cov = tracks.mean, tracks.cov, model.bias, model.bias_cov
    distance, angle = range_m - bias[0], azimuth_rad - bias[1]
    ux, uy = np.cos(angle), np.sin(angle)
    mean[t, 0], mean[t, 1], mean[t, 2], mean[t, 3] = x + distance * ux, y + distance * uy, bias[0], bias[1]
    range_var, angle_var = bias_cov[0, 0] + model.range_var_m2, bias_cov[1, 1] + model.bearing_var_rad2
    both = bias_cov[0, 1]
    for p in range(2):
        by_range, by_angle = (ux, -distance * uy) if p == 0 else (uy, distance * ux)  # how the place turns
        for q in range(2):
            range_q, angle_q = (ux, -distance * uy) if q == 0 else (uy, distance * ux)
            cov[t, p, q] = by_range * (range_var * range_q + both * angle_q)
            cov[t, p, q] += by_angle * (both * range_q + angle_var * angle_q)
            cov[t, p, 2 + q] = cov[t, 2 + q, p] = -(by_range * bias_cov[0, q] + by_angle * bias_cov[1, q])
            cov[t, 2 + p, 2 + q] = bias_cov[p, q]


@kernel
def _update(  # noqa: PLR0917 - numba takes no keyword-only arguments
    tracks: _Tracks, t: int, range_m: float, azimuth_rad: float, x: float, y: float, model: Filter
) -> None:
    """Take a detection in: range first, then azimuth, each a scalar update of the extended filter."""
    mean, cov = tracks.mean, tracks.cov
    distance, _, ux, uy = expected(mean[t, 0], mean[t, 1], x, y)
    _take_in(mean, cov, t, ux, uy, 2, range_m - distance - mean[t, 2], model.range_var_m2)
    distance, azimuth, ux, uy = expected(mean[t, 0], mean[t, 1], x, y)
    error = wrapped(azimuth_rad - azimuth - mean[t, 3])
    _take_in(mean, cov, t, -uy / distance, ux / distance, 3, error, model.bearing_var_rad2)


@kernel
def _take_in(  # noqa: PLR0917 - numba takes no keyword-only arguments
    mean: Floats, cov: Floats, t: int, hx: float, hy: float, own: int, error: float, noise_var: float
) -> None:
    """Take one number in that measures hx · east + hy · north + the bias `own`."""
    a0 = hx * cov[t, 0, 0] + hy * cov[t, 0, 1] + cov[t, 0, own]
    a1 = hx * cov[t, 1, 0] + hy * cov[t, 1, 1] + cov[t, 1, own]
    a2 = hx * cov[t, 2, 0] + hy * cov[t, 2, 1] + cov[t, 2, own]
    a3 = hx * cov[t, 3, 0] + hy * cov[t, 3, 1] + cov[t, 3, own]
    along = (a0, a1, a2, a3)
    variance = hx * a0 + hy * a1 + along[own] + noise_var
    for p in range(4):
        gain = along[p] / variance
        mean[t, p] += gain * error
        for q in range(4):
            cov[t, p, q] -= gain * along[q]
