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
    Flags = NDArray[np.bool_]


@njit(cache=True, nogil=True)
def match_within(a_xy_m: Floats, b_xy_m: Floats, gate_m: float) -> Ints:
    """Return for every point of `a` its partner in `b`, or `NONE`: optimal one-to-one under a gate.

    Only pairs nearer than the gate (strictly) are allowed; of all one-to-one assignments of them the one with the
    most pairs is taken and, of those, the one with the least total distance. Where the nearest partners of all points
    are different ones, that is it; what is contested is decided by the Hungarian method.
    """
    rows, partner, holder = np.arange(len(a_xy_m)), np.empty(len(a_xy_m), np.int64), np.full(len(b_xy_m), NONE)
    _match(a_xy_m, rows, len(rows), b_xy_m, 0, len(b_xy_m), gate_m, partner, holder)
    return partner


@njit(cache=True, nogil=True)
def _match(  # noqa: PLR0917 - numba takes no keyword-only arguments
    a_xy_m: Floats,
    rows: Ints,
    n_rows: int,
    b_xy_m: Floats,
    first: int,
    last: int,
    gate_m: float,
    partner: Ints,
    holder: Ints,
) -> None:
    """Write the partner of each of the first `n_rows` rows of `a`, counted from `first`, or `NONE`.

    `b` is rows `first` up to `last`; `holder` is room for as many. Slices would cost more than what is done with them.
    """
    is_contested = False
    for j in range(last - first):
        holder[j] = NONE
    for k in range(n_rows):
        x, y, nearest, found = a_xy_m[rows[k], 0], a_xy_m[rows[k], 1], gate_m * gate_m, NONE
        for i in range(first, last):
            dx, dy = x - b_xy_m[i, 0], y - b_xy_m[i, 1]
            square = dx * dx + dy * dy
            if square < nearest:
                nearest, found = square, i - first
        partner[k] = found
        if found != NONE:
            is_contested |= holder[found] != NONE
            holder[found] = k
    if is_contested:
        _decide(a_xy_m[rows[:n_rows]], b_xy_m[first:last], gate_m, partner)


@njit(cache=True, nogil=True)
def _decide(a_xy_m: Floats, b_xy_m: Floats, gate_m: float, partner: Ints) -> None:
    """Give the contested points of `a` their partners: each component of the gate graph that is contested, whole."""
    n_a, n_b = len(a_xy_m), len(b_xy_m)
    distance = np.empty((n_a, n_b))
    for k in range(n_a):
        for j in range(n_b):
            dx, dy = a_xy_m[k, 0] - b_xy_m[j, 0], a_xy_m[k, 1] - b_xy_m[j, 1]
            square = dx * dx + dy * dy
            distance[k, j] = np.sqrt(square) if square < gate_m * gate_m else np.inf
    is_done = np.zeros(n_a, np.bool_)
    for k in range(n_a):
        if not is_done[k] and _is_contested(partner, n_a, k):
            rows = _component(distance, k, is_done)
            if len(rows) == 2:  # noqa: PLR2004 - two plates on a pole: nearly always
                _decide_two(distance, rows[0], rows[1], partner)
            else:
                _decide_many(distance, rows, gate_m, partner)


@njit(cache=True, nogil=True)
def _is_contested(partner: Ints, n_rows: int, row: int) -> bool:
    n_wanting = 0
    for k in range(n_rows):
        n_wanting += partner[k] == partner[row] != NONE
    return n_wanting > 1


@njit(cache=True, nogil=True)
def _component(distance: Floats, start: int, is_in: Flags) -> Ints:
    """Return the rows that `start` reaches over pairs of finite distance, itself first, and mark them in `is_in`."""
    n_rows, n_columns = distance.shape
    rows, is_reached = np.empty(n_rows, np.int64), np.zeros(n_columns, np.bool_)
    rows[0], is_in[start], n, done = start, True, 1, 0
    while done < n:
        for j in range(n_columns):
            if distance[rows[done], j] < np.inf and not is_reached[j]:
                is_reached[j] = True
                for k in range(n_rows):
                    if not is_in[k] and distance[k, j] < np.inf:
                        rows[n], is_in[k] = k, True
                        n += 1
        done += 1
    return rows[:n]


@njit(cache=True, nogil=True)
def _decide_two(distance: Floats, one: int, two: int, partner: Ints) -> None:
    """Try every pair of columns; when no two can be had, the nearer row takes the only one."""
    best = np.inf
    for i in range(distance.shape[1]):
        for j in range(distance.shape[1]):
            total = distance[one, i] + distance[two, j]
            if i != j and total < best:
                best, partner[one], partner[two] = total, i, j
    if best == np.inf:
        partner[two if distance[one].min() <= distance[two].min() else one] = NONE


@njit(cache=True, nogil=True)
def _decide_many(distance: Floats, rows: Ints, gate_m: float, partner: Ints) -> None:
    """Decide by the Hungarian method: one pair less never pays, for to stay out costs more than all pairs together."""
    n_columns = distance.shape[1]
    start, n_pairs = np.zeros(len(rows) + 1, np.int64), 0
    column, cost = np.empty(len(rows) * n_columns, np.int64), np.empty(len(rows) * n_columns)
    for k in range(len(rows)):
        for j in range(n_columns):
            if distance[rows[k], j] < np.inf:
                column[n_pairs], cost[n_pairs] = j, distance[rows[k], j]
                n_pairs += 1
        start[k + 1] = n_pairs
    stay_out = np.full(len(rows), gate_m * (min(len(rows), n_columns) + 1))
    partner[rows] = _assign(_Graph(start, column[:n_pairs], cost[:n_pairs], stay_out), n_columns)


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
    partner, holder = np.empty(len(xy_m), dtype=np.int64), np.empty(len(xy_m), dtype=np.int64)
    for frame in range(len(frame_start) - 1):
        first, last = frame_start[frame], frame_start[frame + 1]
        n_live = _without_stale(live, n_live, last_frame, frame - 1 - max_missed_frames)
        _match(reference, live, n_live, xy_m, first, last, gate_m, partner, holder)
        for i in range(first, last):
            track[i] = NONE
        for k in range(n_live):
            if partner[k] != NONE:
                track[first + partner[k]] = live[k]
        for i in range(first, last):
            if track[i] == NONE:
                track[i] = live[n_live] = n_tracks
                n_live, n_tracks = n_live + 1, n_tracks + 1
            t = track[i]
            n_seen[t] += 1
            last_frame[t] = frame
            share = 1.0 / n_seen[t] if use_mean else 1.0
            for axis in range(2):  # one number at a time: array expressions would allocate
                reference[t, axis] = (1.0 - share) * reference[t, axis] + share * xy_m[i, axis]
        if end_on_leaving_view:
            n_live = _still_in_view(
                live, n_live, last_frame, frame, reference, pose_xy_m, heading_rad, range_m, half_fov_rad
            )
    return track


@njit(cache=True, nogil=True)
def associate_passes(  # noqa: PLR0917 - numba takes no keyword-only arguments
    pass_start: Ints,
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
    """Associate each pass by itself; the tracks of a pass are numbered after those of the passes before."""
    track, n_tracks = np.empty(len(xy_m), dtype=np.int64), 0
    for number in range(len(pass_start) - 1):
        begin, end = pass_start[number], pass_start[number + 1]
        first, last = frame_start[begin], frame_start[end]
        track[first:last] = n_tracks + associate(
            frame_start[begin : end + 1] - first,
            xy_m[first:last],
            pose_xy_m[begin:end],
            heading_rad[begin:end],
            gate_m,
            max_missed_frames,
            use_mean,
            end_on_leaving_view,
            range_m,
            half_fov_rad,
        )
        for i in range(first, last):
            n_tracks = max(n_tracks, track[i] + 1)
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
    heading_rad: Floats,
    range_m: float,
    half_fov_rad: float,
) -> int:
    """Drop from `live` the tracks not seen in this frame whose place is outside the cone; return how many are left."""
    ahead_x, ahead_y, cos_half = np.cos(heading_rad[frame]), np.sin(heading_rad[frame]), np.cos(half_fov_rad)
    kept = 0
    for k in range(n_live):
        dx, dy = reference[live[k], 0] - pose_xy_m[frame, 0], reference[live[k], 1] - pose_xy_m[frame, 1]
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
    candidate, ballots = np.empty(len(value), dtype=np.int64), np.empty(len(value), dtype=np.int64)
    end = start[:-1].copy()  # a track has few distinct values: they are looked for one by one
    winner, votes = np.empty(n_tracks, dtype=np.int64), np.zeros(n_tracks, dtype=np.int64)
    for i in range(len(track)):
        t = track[i]
        k = start[t]
        while k < end[t] and candidate[k] != value[i]:
            k += 1
        if k == end[t]:
            candidate[k], ballots[k], end[t] = value[i], 0, end[t] + 1
        ballots[k] += 1
    for t in range(n_tracks):
        for k in range(start[t], end[t]):
            if ballots[k] > votes[t] or (ballots[k] == votes[t] and candidate[k] < winner[t]):
                winner[t], votes[t] = candidate[k], ballots[k]
    return winner, votes


@njit(cache=True, nogil=True)
def spans(track: Ints, frame: Ints, n_tracks: int) -> tuple[Ints, Ints]:
    """Return the frames of the first and the last detection of each track; detections are by frame."""
    first, last = np.full(n_tracks, NONE), np.full(n_tracks, NONE)
    for i in range(len(track)):
        if first[track[i]] == NONE:
            first[track[i]] = frame[i]
        last[track[i]] = frame[i]
    return first, last
