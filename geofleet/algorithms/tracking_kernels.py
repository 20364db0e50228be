"""Compiled loops of tracking: association over frames by exact assignment, and sums by track."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numba import njit

from geofleet.algorithms.assignment import NONE, _assign, _Graph  # the compiled core: one call a frame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]


@njit(cache=True, nogil=True)
def match_within(a_xy_m: Floats, b_xy_m: Floats, gate_m: float) -> Ints:
    """Return for every point of `a` its partner in `b`, or `NONE`: optimal one-to-one under a gate.

    Only pairs nearer than the gate (strictly) are allowed; of all one-to-one assignments of them the one with the
    most pairs is taken and, of those, the one with the least total distance. Where the nearest partners of all points
    are different ones, that is it; otherwise the Hungarian method decides.
    """
    n_a, n_b = len(a_xy_m), len(b_xy_m)
    start, column, distance = np.zeros(n_a + 1, np.int64), np.empty(n_a * n_b, np.int64), np.empty(n_a * n_b)
    partner, is_taken = np.full(n_a, NONE), np.zeros(n_b, np.bool_)
    n_pairs, is_contested = 0, False
    for i in range(n_a):
        nearest = gate_m
        for j in range(n_b):
            dx, dy = a_xy_m[i, 0] - b_xy_m[j, 0], a_xy_m[i, 1] - b_xy_m[j, 1]
            if dx * dx + dy * dy < gate_m * gate_m:
                column[n_pairs], distance[n_pairs] = j, np.sqrt(dx * dx + dy * dy)
                if distance[n_pairs] < nearest or partner[i] == NONE:
                    nearest, partner[i] = distance[n_pairs], j
                n_pairs += 1
        start[i + 1] = n_pairs
        if partner[i] != NONE:
            is_contested |= is_taken[partner[i]]
            is_taken[partner[i]] = True
    if is_contested:
        # one pair less never pays: to stay out costs more than all pairs of an assignment together
        stay_out = np.full(n_a, gate_m * (min(n_a, n_b) + 1))
        return _assign(_Graph(start, column[:n_pairs], distance[:n_pairs], stay_out), n_b)
    return partner


@njit(cache=True, nogil=True)
def associate(  # noqa: PLR0917 - numba takes no keyword-only arguments
    frame_start: Ints,
    xy_m: Floats,
    pose_xy_m: Floats,
    heading_rad: Floats,
    gate_m: float,
    max_missed_frames: int,
    use_mean: bool,  # noqa: FBT001
    end_on_leaving_view: bool,  # noqa: FBT001
    range_m: float,
    half_fov_rad: float,
) -> Ints:
    """Return the track of every detection, numbered by birth.

    `frame_start[f]` is the first detection of frame f, with the total at the end; poses are those reported.
    """
    track = np.empty(len(xy_m), dtype=np.int64)
    reference, n_seen = np.zeros((len(xy_m), 2)), np.zeros(len(xy_m), dtype=np.int64)
    last_frame = np.empty(len(xy_m), dtype=np.int64)
    live, n_live, n_tracks = np.empty(len(xy_m), dtype=np.int64), 0, 0
    for frame in range(len(frame_start) - 1):
        first, last = frame_start[frame], frame_start[frame + 1]
        n_live = _without_stale(live, n_live, last_frame, frame - 1 - max_missed_frames)
        taken = np.full(last - first, NONE)
        if n_live and last > first:
            partner = match_within(reference[live[:n_live]], xy_m[first:last], gate_m)
            for k in range(n_live):
                if partner[k] != NONE:
                    taken[partner[k]] = live[k]
        for i in range(first, last):
            if taken[i - first] == NONE:
                taken[i - first] = live[n_live] = n_tracks
                n_live, n_tracks = n_live + 1, n_tracks + 1
            t = track[i] = taken[i - first]
            n_seen[t] += 1
            last_frame[t] = frame
            share = 1.0 / n_seen[t] if use_mean else 1.0
            for axis in range(2):  # one number at a time: array expressions would allocate
                reference[t, axis] = (1.0 - share) * reference[t, axis] + share * xy_m[i, axis]
        if end_on_leaving_view:
            n_live = _still_in_view(
                live, n_live, last_frame, frame, reference, pose_xy_m[frame], heading_rad[frame], range_m, half_fov_rad
            )
    return track


@njit(cache=True, nogil=True)
def _without_stale(live: Ints, n_live: int, last_frame: Ints, oldest: int) -> int:
    """Drop from `live` the tracks last seen before frame `oldest`; return how many are left."""
    kept = 0
    for k in range(n_live):
        if last_frame[live[k]] >= oldest:
            live[kept] = live[k]
            kept += 1
    return kept


@njit(cache=True, nogil=True)
def _still_in_view(  # noqa: PLR0917 - numba takes no keyword-only arguments
    live: Ints,
    n_live: int,
    last_frame: Ints,
    frame: int,
    reference: Floats,
    pose_xy_m: Floats,
    heading_rad: float,
    range_m: float,
    half_fov_rad: float,
) -> int:
    """Drop from `live` the tracks not seen in this frame whose place is outside the cone; return how many are left."""
    ahead_x, ahead_y, cos_half = np.cos(heading_rad), np.sin(heading_rad), np.cos(half_fov_rad)
    kept = 0
    for k in range(n_live):
        dx, dy = reference[live[k], 0] - pose_xy_m[0], reference[live[k], 1] - pose_xy_m[1]
        distance = np.sqrt(dx * dx + dy * dy)
        inside = distance < range_m and dx * ahead_x + dy * ahead_y > distance * cos_half
        if inside or last_frame[live[k]] == frame:
            live[kept] = live[k]
            kept += 1
    return kept


@njit(cache=True, nogil=True)
def moments(track: Ints, xy_m: Floats, n_tracks: int) -> tuple[Ints, Floats, Floats]:
    """Return of each track the number of detections, the mean position and the sums of squares ee, nn, en about it.

    Sums are updated about the running mean (B. P. Welford, doi:10.1080/00401706.1962.10490022): positions a
    kilometre from the origin lose no digit.
    """
    count, mean, scatter = np.zeros(n_tracks, dtype=np.int64), np.zeros((n_tracks, 2)), np.zeros((n_tracks, 3))
    for i in range(len(track)):
        t = track[i]
        count[t] += 1
        de, dn = xy_m[i, 0] - mean[t, 0], xy_m[i, 1] - mean[t, 1]
        mean[t, 0] += de / count[t]
        mean[t, 1] += dn / count[t]
        scatter[t, 0] += de * (xy_m[i, 0] - mean[t, 0])
        scatter[t, 1] += dn * (xy_m[i, 1] - mean[t, 1])
        scatter[t, 2] += de * (xy_m[i, 1] - mean[t, 1])
    return count, mean, scatter


@njit(cache=True, nogil=True)
def majority(track: Ints, value: Ints, n_tracks: int) -> tuple[Ints, Ints]:
    """Return the most frequent value of each track and how often it occurs; of equals, the smallest value."""
    start = np.zeros(n_tracks + 1, dtype=np.int64)
    for t in track:
        start[t + 1] += 1
    start = np.cumsum(start)
    filled, grouped = start[:-1].copy(), np.empty(len(value), dtype=np.int64)
    for i in range(len(track)):
        grouped[filled[track[i]]] = value[i]
        filled[track[i]] += 1
    winner, votes = np.empty(n_tracks, dtype=np.int64), np.zeros(n_tracks, dtype=np.int64)
    for t in range(n_tracks):
        ballots = np.sort(grouped[start[t] : start[t + 1]])
        run = 0
        for k in range(len(ballots)):
            run = run + 1 if k and ballots[k] == ballots[k - 1] else 1
            if run > votes[t]:
                winner[t], votes[t] = ballots[k], run
    return winner, votes
