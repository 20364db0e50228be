"""Compiled loops of tracking: association over frames by exact assignment, and sums by track."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from geofleet.algorithms.assignment import NONE
from geofleet.algorithms.compiled import inlined_kernel, kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]


class _Room(NamedTuple):
    """Where an association is worked out, made once for all frames: to allocate would cost more than to decide.

    A column stands for a point of `b` or, after these, for one member that stays without partner.
    """

    partner: Ints  # of each point of `a`, counted from the first of `b`, or NONE
    holder: Ints  # the last point of `a` that is nearest to one of `b`
    member: Ints  # the points of `a` that are decided together
    is_member: Flags  # of these or of those before
    row_price: Floats
    column_price: Floats
    row_of_column: Ints
    distance: Floats  # of a column from the row that the search started at
    reached_from: Ints  # the column that a column was reached from
    is_settled: Flags


@kernel
def _room(n_a: int, n_b: int) -> _Room:
    n = n_a + n_b
    return _Room(
        np.empty(n_a, np.int64),
        np.empty(n_b, np.int64),
        np.empty(n_a, np.int64),
        np.empty(n_a, np.bool_),
        np.empty(n_a),
        np.empty(n),
        np.empty(n, np.int64),
        np.empty(n),
        np.empty(n, np.int64),
        np.empty(n, np.bool_),
    )


class _Pairs(NamedTuple):
    """What is paired: some rows of `a` with those of `b` from `first` to `last`; to slice them would cost more."""

    a_xy_m: Floats
    rows: Ints
    n_rows: int
    b_xy_m: Floats
    first: int
    last: int
    gate_m: float


@kernel
def match_within(a_xy_m: Floats, b_xy_m: Floats, gate_m: float) -> Ints:
    """Return for every point of `a` its partner in `b`, or `NONE`: optimal one-to-one under a gate.

    Only pairs nearer than the gate (strictly) are allowed; of all one-to-one assignments of them the one with the
    most pairs is taken and, of those, the one with the least total distance. Where the nearest partners of all points
    are different ones, that is it; what is contested is decided by the Hungarian method.
    """
    room = _room(len(a_xy_m), len(b_xy_m))
    _match(_Pairs(a_xy_m, np.arange(len(a_xy_m)), len(a_xy_m), b_xy_m, 0, len(b_xy_m), gate_m), room)
    return room.partner


@inlined_kernel
def _match(pairs: _Pairs, room: _Room) -> None:
    """Write the partner of each row of `a`, or `NONE`, into the room."""
    is_contested = False
    for j in range(pairs.last - pairs.first):
        room.holder[j] = NONE
    for k in range(pairs.n_rows):
        x, y = pairs.a_xy_m[pairs.rows[k], 0], pairs.a_xy_m[pairs.rows[k], 1]
        nearest, found = pairs.gate_m * pairs.gate_m, NONE
        for i in range(pairs.first, pairs.last):
            dx, dy = x - pairs.b_xy_m[i, 0], y - pairs.b_xy_m[i, 1]
            square = dx * dx + dy * dy
            if square < nearest:
                nearest, found = square, i - pairs.first
        room.partner[k] = found
        if found != NONE:
            is_contested |= room.holder[found] != NONE
            room.holder[found] = k
    if is_contested:
        _decide(pairs, room)


@inlined_kernel
def _decide(pairs: _Pairs, room: _Room) -> None:
    """Give the contested points of `a` their partners: each component of the gate graph that is contested, whole."""
    for k in range(pairs.n_rows):
        room.is_member[k] = False
    for k in range(pairs.n_rows):
        if not room.is_member[k] and _is_contested(room.partner, pairs.n_rows, k):
            n_members = _component(pairs, room, k)
            _assign_members(pairs, room, n_members)


@inlined_kernel
def _is_contested(partner: Ints, n_rows: int, row: int) -> bool:
    n_wanting = 0
    for k in range(n_rows):
        n_wanting += partner[k] == partner[row] != NONE
    return n_wanting > 1


@inlined_kernel
def _gated(pairs: _Pairs, k: int, j: int) -> float:
    """Return the distance of a point of `a` from one of `b`, infinite when it is not below the gate."""
    at, to = pairs.rows[k], pairs.first + j
    dx, dy = pairs.a_xy_m[at, 0] - pairs.b_xy_m[to, 0], pairs.a_xy_m[at, 1] - pairs.b_xy_m[to, 1]
    square = dx * dx + dy * dy
    return float(np.sqrt(square)) if square < pairs.gate_m * pairs.gate_m else np.inf


@inlined_kernel
def _component(pairs: _Pairs, room: _Room, start: int) -> int:
    """Write the rows that `start` reaches over pairs within the gate, itself first; return how many they are."""
    room.member[0], room.is_member[start], n, done = start, True, 1, 0
    while done < n:
        for j in range(pairs.last - pairs.first):
            if _gated(pairs, room.member[done], j) < np.inf:
                for k in range(pairs.n_rows):
                    if not room.is_member[k] and _gated(pairs, k, j) < np.inf:
                        room.member[n], room.is_member[k] = k, True
                        n += 1
        done += 1
    return n


@inlined_kernel
def _assign_members(pairs: _Pairs, room: _Room, n_members: int) -> None:
    """Assign by shortest augmenting paths: one pair less never pays, for that costs more than all pairs together."""
    n_b = pairs.last - pairs.first
    stay_out = pairs.gate_m * (min(n_members, n_b) + 1)
    for j in range(n_b + n_members):
        room.column_price[j], room.row_of_column[j] = 0.0, NONE
    for m in range(n_members):
        room.row_price[m] = 0.0
        end = _search(pairs, room, m, n_members, stay_out)
        _reprice(room, m, end, n_b + n_members)
        while end != NONE:  # each column on the path takes the row that held the one before
            before = room.reached_from[end]
            room.row_of_column[end] = m if before == NONE else room.row_of_column[before]
            end = before
    for m in range(n_members):
        room.partner[room.member[m]] = NONE
    for j in range(n_b):
        if room.row_of_column[j] != NONE:
            room.partner[room.member[room.row_of_column[j]]] = j


@inlined_kernel
def _search(pairs: _Pairs, room: _Room, source: int, n_members: int, stay_out: float) -> int:
    """Find the shortest alternating path, in reduced costs, from a member to a free column; return that column."""
    n_b = pairs.last - pairs.first
    for j in range(n_b + n_members):
        room.distance[j], room.is_settled[j] = np.inf, False
    row, column, base = source, NONE, 0.0
    while True:
        nearest, found = np.inf, NONE
        for j in range(n_b + n_members):
            if not room.is_settled[j]:
                cost = _gated(pairs, room.member[row], j) if j < n_b else (stay_out if j - n_b == row else np.inf)
                through = base + cost - room.row_price[row] - room.column_price[j]
                if through < room.distance[j]:
                    room.distance[j], room.reached_from[j] = through, column
                if room.distance[j] < nearest:
                    nearest, found = room.distance[j], j
        column, base = found, nearest
        room.is_settled[column] = True
        if room.row_of_column[column] == NONE:
            return column
        row = room.row_of_column[column]


@inlined_kernel
def _reprice(room: _Room, source: int, end: int, n_columns: int) -> None:
    """Keep reduced costs at zero on what is paired, and not below it elsewhere."""
    length = room.distance[end]
    room.row_price[source] += length
    for j in range(n_columns):
        if room.is_settled[j] and j != end:
            room.row_price[room.row_of_column[j]] += length - room.distance[j]
            room.column_price[j] -= length - room.distance[j]


@kernel
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
    room = _room(len(xy_m), len(xy_m))
    for frame in range(len(frame_start) - 1):
        first, last = frame_start[frame], frame_start[frame + 1]
        n_live = _without_stale(live, n_live, last_frame, frame - 1 - max_missed_frames)
        _match(_Pairs(reference, live, n_live, xy_m, first, last, gate_m), room)
        for i in range(first, last):
            track[i] = NONE
        for k in range(n_live):
            if room.partner[k] != NONE:
                track[first + room.partner[k]] = live[k]
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


@kernel
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


@kernel
def _without_stale(live: Ints, n_live: int, last_frame: Ints, oldest: int) -> int:
    """Drop from `live` the tracks last seen before frame `oldest`; return how many are left."""
    kept = 0
    for k in range(n_live):
        if last_frame[live[k]] >= oldest:
            live[kept] = live[k]
            kept += 1
    return kept


@kernel
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


@kernel
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


@kernel
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


@kernel
def spans(track: Ints, frame: Ints, n_tracks: int) -> tuple[Ints, Ints]:
    """Return the frames of the first and the last detection of each track; detections are by frame."""
    first, last = np.full(n_tracks, NONE), np.full(n_tracks, NONE)
    for i in range(len(track)):
        if first[track[i]] == NONE:
            first[track[i]] = frame[i]
        last[track[i]] = frame[i]
    return first, last
