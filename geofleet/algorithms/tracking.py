"""Frames to tracks: the vehicle's own fusion over a pass (paper, "Temporal Tracking and Fusion").

Three trackers give every frame detection a track: `track_paper`, `track_ideal`, and `track_kalman` (module `kalman`);
`summarise` turns tracks into what the vehicle sends. Positions are metres in an ENU frame, angles
counter-clockwise from east.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from geofleet.algorithms.information import Information, PolarNoise, TrackRows, information_form, pass_bias
from geofleet.algorithms.kalman import track_kalman
from geofleet.algorithms.sensing import GHOST
from geofleet.algorithms.streams import PassesRandom
from geofleet.algorithms.tracking_kernels import associate_passes, majority, moments, spans

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from geofleet.algorithms.sensing import FrameDetections
    from geofleet.algorithms.streams import PassStreams
    from geofleet.algorithms.trajectory import Poses

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TrackerModel:
    """How frames become tracks.

    Parameters
    ----------
    tracker
        `paper`: exact Hungarian assignment from frame to frame; `kalman`: innovation and class, fragments merged;
        `ideal`: one track a sign and pass.
    track_gate_m
        A detection joins a track only when nearer than this to its reference position (strictly).
    track_reference
        Reference position: that of the last detection, or the mean of all so far.
    max_missed_frames
        A track ends when it was not seen in more frames than this in a row.
    min_track_frames
        Shorter tracks are not sent.
    end_on_leaving_view
        A track not seen in a frame ends when its reference position is outside the view cone of the reported pose.
    range_m, half_fov_rad
        The view cone.
    track_gate_chi2, merge_gate_chi2
        `kalman`: largest χ² (2 degrees of freedom) of a detection that joins a track, and of fragments that merge.
    class_error_rate
        `kalman`: how often a frame reads another class than the sign's.
    send_information
        Send the information form beside the mean.
    split_track_rate
        Share of the tracks long enough for two that are sent as two (`split_tracks`).
    noise
        What the vehicle knows about its sensor: for `kalman` and for the information form.
    """

    tracker: Literal["paper", "kalman", "ideal"]
    track_gate_m: float
    track_reference: Literal["last", "mean"]
    max_missed_frames: int
    min_track_frames: int
    end_on_leaving_view: bool
    range_m: float
    half_fov_rad: float
    track_gate_chi2: float = 13.8
    merge_gate_chi2: float = 13.8
    class_error_rate: float = 0.05
    send_information: bool = False
    split_track_rate: float = 0.0
    noise: PolarNoise = field(default_factory=lambda: PolarNoise(0.3, 0.0035, 2.4, 0.021))


@dataclass(frozen=True, slots=True)
class Tracks:
    """What passes send, one row a track in the order of birth, pass after pass, and (`sign`) where it came from.

    Parameters
    ----------
    xy_m
        Mean position, shape (n, 2).
    sigma_e_m, sigma_n_m, cov_en_m2
        Spread over frames with F - 1 in the denominator; NaN when F = 1.
    pass_number
        Of which pass, counted from 0.
    n_frames, frame_first, frame_last
        F, and the frames of the first and the last detection, counted from the first of the pass.
    range_mean_m, azimuth_rad
        Mean measured range, and mean direction of view.
    class_code, class_confidence
        Class by vote over frames (of equals, the smallest code), and the winner's share of the votes.
    sign
        The sign that most frames came from, `GHOST` when none: truth, never sent.
    information
        The tracks in information form, when they are sent like that.
    """

    xy_m: Floats
    sigma_e_m: Floats
    sigma_n_m: Floats
    cov_en_m2: Floats
    pass_number: Ints
    n_frames: Ints
    frame_first: Ints
    frame_last: Ints
    range_mean_m: Floats
    azimuth_rad: Floats
    class_code: Ints
    class_confidence: Floats
    sign: Ints
    information: Information | None = None


def track_pass(
    seen: FrameDetections, reported: Poses, model: TrackerModel, streams: PassStreams | None = None
) -> Tracks:
    """Track the detections of one pass and return what is sent: `track_passes` of one."""
    return track_passes(seen, reported, model, None if streams is None else [streams])


def track_passes(
    seen: FrameDetections, reported: Poses, model: TrackerModel, streams: Sequence[PassStreams] | None = None
) -> Tracks:
    """Track the detections of passes, each by itself, and return what is sent: tracks of `min_track_frames` or more.

    `streams`, one a pass, are needed to split tracks, which is the one thing here that is random.
    """
    if model.tracker == "ideal":
        track = track_ideal(seen)
    elif model.tracker == "kalman":
        track = track_kalman(seen, reported, model)
    else:
        track = track_paper(seen, reported, model)
    if model.split_track_rate > 0:
        if streams is None:
            raise ValueError("to split tracks takes random numbers: give the streams of the pass")
        track_start = np.searchsorted(TrackRows.of(track).pass_of(seen), np.arange(len(streams) + 1))
        rng = PassesRandom([own.splits for own in streams], track_start)
        track = split_tracks(track, rate=model.split_track_rate, min_track_frames=model.min_track_frames, rng=rng)
    tracks = summarise(seen, track, min_track_frames=model.min_track_frames)
    if not model.send_information:
        return tracks
    return replace(tracks, information=_information(seen, reported, track, model))


def _information(seen: FrameDetections, reported: Poses, track: Ints, model: TrackerModel) -> Information:
    """Return the information form of the tracks that are sent, linearised under the bias that the pass shows."""
    rows = TrackRows.of(track)
    bias = pass_bias(seen, reported, rows, model.noise)
    return information_form(seen, reported, rows.at_least(model.min_track_frames), model.noise, bias.mean)


def track_paper(seen: FrameDetections, reported: Poses, model: TrackerModel) -> Ints:
    """Return the track of every detection by frame-to-frame association, numbered by birth, pass after pass.

    In each frame, detections and live tracks are assigned one to one so that as many pairs as possible are nearer
    than the gate and, of those assignments, the total ENU distance is least: the Hungarian algorithm, exactly.
    """
    frame_start = np.searchsorted(seen.frame, np.arange(seen.n_frames + 1))
    track: Ints = associate_passes(
        seen.pass_start,
        frame_start,
        seen.xy_m,
        reported.xy_m,
        reported.heading_rad,
        model.track_gate_m,
        model.max_missed_frames,
        model.track_reference == "mean",
        model.end_on_leaving_view,
        model.range_m,
        model.half_fov_rad,
    )
    return track


def track_ideal(seen: FrameDetections) -> Ints:
    """Return the track of every detection with identities known: one a sign, one a ghost, numbered by birth."""
    n = len(seen.sign)
    low, high = int(seen.sign.min(initial=0)), int(seen.sign.max(initial=0))
    of_pass = seen.sign + (high - low + 1) * seen.pass_of(seen.frame)
    return _by_birth(np.where(seen.sign == GHOST, of_pass.max(initial=0) + 1 + np.arange(n), of_pass))


def split_tracks(track: Ints, *, rate: float, min_track_frames: int, rng: Generator | PassesRandom) -> Ints:
    """Cut a share of the tracks in two and return the track of every detection, numbered by birth.

    A track of 2 `min_track_frames` detections or more is cut with probability `rate`, at any detection that leaves both
    parts long enough to be sent, alike.
    """
    count = np.bincount(track)
    chance, where = rng.random(len(count)), rng.random(len(count))
    is_cut = (chance < rate) & (count >= 2 * min_track_frames)
    cut = np.where(is_cut, min_track_frames + (where * (count - 2 * min_track_frames + 1)).astype(np.int64), count)
    order = np.argsort(track, kind="stable")
    rank = np.empty(len(track), dtype=np.int64)
    rank[order] = np.arange(len(track)) - np.repeat(np.cumsum(count) - count, count)
    return _by_birth(2 * track + (rank >= cut[track]))


def _by_birth(identity: Ints) -> Ints:
    """Return the number of each identity, counted by first occurrence."""
    _, first, inverse = np.unique(identity, return_index=True, return_inverse=True)
    birth_order = np.empty(len(first), dtype=np.int64)
    birth_order[np.argsort(first)] = np.arange(len(first))
    return birth_order[inverse]


def summarise(seen: FrameDetections, track: Ints, *, min_track_frames: int) -> Tracks:
    """Return mean position p = Σ p_f / F, spread √(Σ (p_f - p̄)² / (F - 1)), times and class of each track."""
    n_tracks = int(track.max()) + 1 if len(track) else 0
    count, mean, scatter = moments(track, seen.xy_m, n_tracks)
    sent = np.flatnonzero(count >= min_track_frames)
    class_code, votes = majority(track, seen.class_code, n_tracks)
    after_last = np.iinfo(np.int64).max  # of equals a sign wins over "ghost"
    sign, _ = majority(track, np.where(seen.sign == GHOST, after_last, seen.sign), n_tracks)
    first, last = spans(track, seen.frame, n_tracks)
    ray_x = np.bincount(track, np.cos(seen.azimuth_rad), n_tracks)
    ray_y = np.bincount(track, np.sin(seen.azimuth_rad), n_tracks)
    pass_number = seen.pass_of(first)
    first_frame = seen.pass_start[pass_number]
    freedom = np.where(count > 1, count - 1.0, np.nan)[:, None]
    var_e, var_n, cov_en = (scatter / freedom)[sent].T
    return Tracks(
        xy_m=mean[sent],
        sigma_e_m=np.sqrt(var_e),
        sigma_n_m=np.sqrt(var_n),
        cov_en_m2=cov_en,
        pass_number=pass_number[sent],
        n_frames=count[sent],
        frame_first=(first - first_frame)[sent],
        frame_last=(last - first_frame)[sent],
        range_mean_m=(np.bincount(track, seen.range_m, n_tracks) / count)[sent],
        azimuth_rad=np.arctan2(ray_y, ray_x)[sent],
        class_code=class_code[sent],
        class_confidence=(votes / count)[sent],
        sign=np.where(sign == after_last, GHOST, sign)[sent],
    )
