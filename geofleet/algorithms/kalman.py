"""The Kalman tracker: one track a sign, also where a bias of degrees moves its projection by metres.

1. Forward over the frames: each track filters its place and the bias of the pass; a detection joins by the χ² of its
   innovation under polar noise, its class and one-to-one assignment (`kalman_kernels`).
2. The bias of the pass from all of its tracks (`information.pass_bias`), and forward again with what is known now.
3. Fragments of one pass that have one class, never share a frame and whose places agree are one sign.

Steps 2 and 3 look back, so a vehicle sends when the pass ends, not when a sign leaves the view.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from geofleet.algorithms.fragments import join_fragments
from geofleet.algorithms.information import PassBias, TrackRows, linearised, pass_bias
from geofleet.algorithms.kalman_kernels import Filter, associate_filtered_passes
from geofleet.algorithms.tracking_kernels import majority

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.sensing import FrameDetections
    from geofleet.algorithms.tracking import TrackerModel
    from geofleet.algorithms.trajectory import Poses

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

JITTER_M = 0.2
"""Places of fragments may differ by this in addition: drift of the reported path, and what linearisation leaves."""
MERGE_RADIUS_M = 15.0
"""Fragments further apart than this are never compared, however little they know."""
FIRST_ROUNDS = 2
"""Gauss-Newton steps for the bias that the second round starts from: it only decides what joins."""
BIAS_INFLATION = 4.0
"""The bias found in the first round is trusted at twice its sigma in the second: its tracks may be fragments."""


def track_kalman(seen: FrameDetections, reported: Poses, model: TrackerModel) -> Ints:
    """Return the track of every detection, numbered by birth, pass after pass; ghosts are tracks of their own.

    Costs are linear in frames and detections, and in pairs of tracks that lie within `MERGE_RADIUS_M`.
    """
    if not len(seen.frame):
        return np.empty(0, dtype=np.int64)
    n_passes = len(seen.pass_start) - 1
    unknown = PassBias(np.zeros((n_passes, 2)), np.tile(model.noise.bias_cov, (n_passes, 1, 1)))
    rows = TrackRows.of(_forward(seen, reported, model, unknown))
    known = pass_bias(seen, reported, rows, model.noise, n_rounds=FIRST_ROUNDS)
    track = _forward(seen, reported, model, PassBias(known.mean, BIAS_INFLATION * known.cov))
    return _merged(seen, reported, model, track, known)


def _forward(seen: FrameDetections, reported: Poses, model: TrackerModel, bias: PassBias) -> Ints:
    assumed = Filter(
        model.noise.range_sigma_m**2,
        model.noise.bearing_sigma_rad**2,
        bias.mean[0],
        bias.cov[0],
        model.track_gate_chi2,
        model.class_error_rate,
        0,
        model.max_missed_frames,
    )
    frame_start = np.searchsorted(seen.frame, np.arange(seen.n_frames + 1))
    track: Ints = associate_filtered_passes(
        *(seen.pass_start, frame_start, seen.range_m, seen.azimuth_rad, seen.class_code, reported.xy_m),
        *(bias.mean, bias.cov, assumed),
    )
    return track


def _merged(seen: FrameDetections, reported: Poses, model: TrackerModel, track: Ints, known: PassBias) -> Ints:
    """Join tracks of one class that never share a frame and agree on a place, the best agreement first."""
    rows = TrackRows.of(track)
    bias = pass_bias(seen, reported, rows, model.noise, start=known.mean, n_rounds=1)
    of_pass = rows.pass_of(seen)
    place, matrix, _, _ = linearised(seen, reported, rows, model.noise, bias.mean[of_pass])
    class_code, _ = majority(track, seen.class_code, len(place))
    apart = np.column_stack((place, 2 * MERGE_RADIUS_M * of_pass))  # passes never meet
    pairs = cKDTree(apart).query_pairs(MERGE_RADIUS_M, output_type="ndarray")
    pairs = pairs[class_code[pairs[:, 0]] == class_code[pairs[:, 1]]]
    chi2 = _disagreement(place, matrix[:, :2], bias.cov[of_pass[pairs[:, 0]]], *pairs.T)
    agreed = np.flatnonzero(chi2 < model.merge_gate_chi2)
    best_first = pairs[agreed[np.lexsort((pairs[agreed, 1], pairs[agreed, 0], chi2[agreed]))]]
    group = join_fragments(rows.start, rows.order, seen.frame, best_first[:, 0], best_first[:, 1], seen.n_frames)
    merged: Ints = group[track]
    return merged


def _disagreement(place: Floats, matrix: Floats, bias_cov: Floats, first: Ints, second: Ints) -> Floats:
    """Return the χ² of the distance between two places, 2 degrees of freedom, what they share in bias taken out.

    `matrix` is what the frames of each track say about its place, and about the bias, (n_tracks, 2, 4); `bias_cov` is
    that of the pass of each pair, (n_pairs, 2, 2).
    """
    cov = np.linalg.inv(matrix[:, :, :2])
    by_bias = cov @ matrix[:, :, 2:]  # a place moves by minus this times the bias
    apart = place[first] - place[second]
    lever = by_bias[first] - by_bias[second]
    spread = cov[first] + cov[second] + lever @ bias_cov @ np.swapaxes(lever, 1, 2) + JITTER_M**2 * np.eye(2)
    chi2: Floats = np.einsum("ki,ki->k", apart, np.linalg.solve(spread, apart[:, :, None])[:, :, 0])
    return chi2
