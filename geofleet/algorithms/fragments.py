"""Fragments of one pass joined into tracks: compiled union of groups that never share a frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.compiled import kernel

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Ints = NDArray[np.int64]

END = -1


@kernel
def join_fragments(start: Ints, order: Ints, frame: Ints, first: Ints, second: Ints, n_frames: int) -> Ints:  # noqa: PLR0917 - numba takes no keyword-only arguments
    """Return the group of each track: pairs are joined in the order given, unless their groups share a frame.

    Parameters
    ----------
    start, order, frame
        Detections by track, `order[start[t]:start[t + 1]]`, and the frame of every detection.
    first, second
        Tracks of each pair, the best pair first.
    n_frames
        Frames of the pass.

    Returns
    -------
    (n_tracks,) numbers of groups, by their first track.
    """
    n_tracks = len(start) - 1
    root, stamp = np.arange(n_tracks), np.full(n_frames, -1)
    following, tail = np.full(n_tracks, END), np.arange(n_tracks)  # members of a group as a chain from its root
    for k in range(len(first)):
        a, b = _root(root, first[k]), _root(root, second[k])
        a, b = min(a, b), max(a, b)
        if a != b and not _share_a_frame(a, b, k, following, start, order, frame, stamp):
            root[b], following[tail[a]], tail[a] = a, b, tail[b]
    group, n_groups = np.empty(n_tracks, np.int64), 0
    for t in range(n_tracks):
        if root[t] == t:
            group[t] = n_groups
            n_groups += 1
        else:
            group[t] = group[root[t]]  # a root comes before its members
    return group


@kernel
def _root(root: Ints, track: int) -> int:
    while root[track] != track:
        track = root[track]
    return track


@kernel
def _share_a_frame(  # noqa: PLR0917 - numba takes no keyword-only arguments
    a: int, b: int, mark: int, following: Ints, start: Ints, order: Ints, frame: Ints, stamp: Ints
) -> bool:
    """Stamp the frames of one group and look for them in the other."""
    member = a
    while member != END:
        for row in order[start[member] : start[member + 1]]:
            stamp[frame[row]] = mark
        member = following[member]
    member = b
    while member != END:
        for row in order[start[member] : start[member + 1]]:
            if stamp[frame[row]] == mark:
                return True
        member = following[member]
    return False
