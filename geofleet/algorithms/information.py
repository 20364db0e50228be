"""A track in information form: what its frames say about the sign's place and about the bias of the pass.

The unknowns of a track are x = (east, north, range bias, bearing bias): the place in the frame of the *reported* poses
(the true place plus the GNSS offset of the pass, which no single pass can see), in metres, and what the sensor adds to
every range (metres) and bearing (radians, the heading error with it). A frame at the reported pose q measures

    d = |y - q| + b_r + n_r        a = ∠(y - q) + b_θ + n_θ

and adds HᵀWH to N and HᵀW(z - h + Hx) to r, with W = diag(1/var_r, 1/var_θ) and H at the smoothed place. N and r add
up: over frames, over tracks that share a bias and over passes. Minimising over x gives Nx = r.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.information_kernels import locate, misfit, normal_equations

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.sensing import FrameDetections
    from geofleet.algorithms.trajectory import Poses

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

MIN_FRAMES = 3
"""Shorter tracks have no say in the bias of their pass: they may be ghosts."""
N_ROUNDS = 4
"""Gauss-Newton steps for the bias that is sent; two are enough unless the bias is tens of degrees."""
OUTLIER_SIGMAS = 5.0
RANK_TOLERANCE = 1e-10


@dataclass(frozen=True, slots=True)
class PolarNoise:
    """What a vehicle knows about its sensor: standard deviations of noise (a frame) and of bias (a pass)."""

    range_sigma_m: float
    bearing_sigma_rad: float
    range_bias_sigma_m: float
    bearing_bias_sigma_rad: float

    @property
    def bias_cov(self) -> Floats:
        """Prior covariance of range and bearing bias, shape (2, 2)."""
        return np.diag([self.range_bias_sigma_m**2, self.bearing_bias_sigma_rad**2])


@dataclass(frozen=True, slots=True)
class PassBias:
    """Range bias (m) and bearing bias (rad) of passes, shape (n_passes, 2), and covariances, (n_passes, 2, 2)."""

    mean: Floats
    cov: Floats


@dataclass(frozen=True, slots=True)
class Information:
    """Tracks in information form, one row a track.

    Parameters
    ----------
    origin_xy_m
        The smoothed place, where N is linearised and r is counted from, shape (n, 2).
    matrix
        N = Σ HᵀWH over east, north, range bias, bearing bias; in m and rad, shape (n, 4, 4).
    vector
        r: N times the estimate of (east - origin, north - origin, range bias, bearing bias), shape (n, 4).
    s0
        Least weighted sum of squared residuals, χ² with `dof` degrees of freedom when the declared sigmas are right.
    dof
        Two a frame, less the rank of N.
    """

    origin_xy_m: Floats
    matrix: Floats
    vector: Floats
    s0: Floats
    dof: Floats


@dataclass(frozen=True, slots=True)
class TrackRows:
    """Detections grouped by track: rows `order[start[t]:start[t + 1]]` are those of track t, by frame."""

    start: Ints
    order: Ints

    @classmethod
    def of(cls, track: Ints) -> TrackRows:
        """Group the rows by the track of each."""
        n_tracks = int(track.max()) + 1 if len(track) else 0
        return cls(
            np.concatenate(([0], np.cumsum(np.bincount(track, minlength=n_tracks)))).astype(np.int64),
            np.argsort(track, kind="stable"),
        )

    def at_least(self, n_frames: int) -> TrackRows:
        """Return the tracks of this many detections or more, in their order."""
        count = np.diff(self.start)
        kept = count >= n_frames
        rows = np.repeat(kept, count)
        return TrackRows(np.concatenate(([0], np.cumsum(count[kept]))).astype(np.int64), self.order[rows])

    def pass_of(self, seen: FrameDetections) -> Ints:
        """Return the number of the pass of each track; a track has one detection at least."""
        return seen.pass_of(seen.frame[self.order[self.start[:-1]]])


def information_form(
    seen: FrameDetections, reported: Poses, rows: TrackRows, noise: PolarNoise, bias: Floats
) -> Information:
    """Return N and r of each track, linearised at the place that its frames agree on under the bias of its pass.

    The place is found by Gauss-Newton steps that are damped until the residual falls (Levenberg-Marquardt), from the
    mean of the reported positions: without damping a track seen from one direction only runs away.
    """
    bias = bias[rows.pass_of(seen)]
    place, matrix, gradient, square = linearised(seen, reported, rows, noise, bias)
    scale = np.outer(1 / _unit(noise), 1 / _unit(noise))
    value, axes = np.linalg.eigh(matrix / scale)
    is_seen = value > RANK_TOLERANCE * value[:, -1:]
    in_axes = np.einsum("tij,ti->tj", axes, gradient / scale[0])
    explained = np.sum(np.where(is_seen, in_axes**2 / np.where(is_seen, value, 1.0), 0.0), axis=1)
    return Information(
        origin_xy_m=place,
        matrix=matrix,
        vector=gradient + (matrix[:, :, 2:] @ bias[:, :, None])[:, :, 0],
        s0=np.maximum(square - explained, 0.0),
        dof=2.0 * np.diff(rows.start) - is_seen.sum(axis=1),
    )


def linearised(
    seen: FrameDetections, reported: Poses, rows: TrackRows, noise: PolarNoise, bias: Floats
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return the place of each track under its bias, (n_tracks, 2), and N, HᵀWε and εᵀWε there."""
    poses = np.ascontiguousarray(reported.xy_m[seen.frame])
    sigmas = np.array([noise.range_sigma_m, noise.bearing_sigma_rad])
    place = locate(rows.start, rows.order, seen.xy_m, seen.range_m, seen.azimuth_rad, poses, sigmas, bias)
    equations = normal_equations(rows.start, rows.order, seen.range_m, seen.azimuth_rad, poses, sigmas, bias, place)
    return place, *equations


def _unit(noise: PolarNoise) -> Floats:
    """Return what each unknown is counted in, so that one tolerance fits metres and radians."""
    return np.array([1.0, 1.0, 1.0, noise.bearing_sigma_rad / noise.range_sigma_m])


def pass_bias(
    seen: FrameDetections,
    reported: Poses,
    rows: TrackRows,
    noise: PolarNoise,
    *,
    start: Floats | None = None,
    n_rounds: int = N_ROUNDS,
) -> PassBias:
    """Return the bias of each pass from its own tracks (`bias_posterior`).

    Tracks whose residual is beyond `OUTLIER_SIGMAS` are left out: two signs in one track say nothing about the sensor.

    Parameters
    ----------
    start
        Bias of each pass to linearise at first, (n_passes, 2); none by default.
    n_rounds
        Gauss-Newton steps.
    """
    n_passes = len(seen.pass_start) - 1
    mean, cov = np.zeros((n_passes, 2)), np.tile(noise.bias_cov, (n_passes, 1, 1))
    rows = rows.at_least(MIN_FRAMES)
    if not cov.any() or len(rows.start) == 1:
        return PassBias(mean, cov)
    of_pass = rows.pass_of(seen)
    has_tracks = np.bincount(of_pass, minlength=n_passes) > 0
    if start is not None:
        mean[has_tracks] = start[has_tracks]
    for _ in range(n_rounds):
        bias = mean[of_pass]
        _, matrix, gradient, square = linearised(seen, reported, rows, noise, bias)
        s0, rank = misfit(matrix, gradient, square, 1 / _unit(noise), RANK_TOLERANCE)
        dof = 2.0 * np.diff(rows.start) - rank
        used = s0 <= dof + OUTLIER_SIGMAS * np.sqrt(2 * np.maximum(dof, 1))
        vector = gradient + (matrix[:, :, 2:] @ bias[:, :, None])[:, :, 0]
        schur, right = about_bias(matrix[used], vector[used])
        says = _by_pass(np.column_stack((schur.reshape(-1, 4), right)), of_pass[used], n_passes)
        found = bias_posterior(says[:, :4].reshape(-1, 2, 2), says[:, 4:], np.sqrt(np.diag(noise.bias_cov)))
        mean[has_tracks], cov[has_tracks] = found[0][has_tracks], found[1][has_tracks]
    return PassBias(mean, cov)


def _by_pass(values: Floats, of_pass: Ints, n_passes: int) -> Floats:
    """Return the sums of rows (n, k) by pass, (n_passes, k)."""
    return np.column_stack([np.bincount(of_pass, column, n_passes) for column in values.T])


def about_bias(matrix: Floats, vector: Floats) -> tuple[Floats, Floats]:
    """Return what tracks, (n, 4, 4) and (n, 4), still say about the bias once their own places are solved for.

    S = N_bb - N_bp N_pp⁻¹ N_pb, (n, 2, 2), and u = r_b - N_bp N_pp⁻¹ r_p, (n, 2). `sql/aggregate/solved` does the same
    for tables.
    """
    n_bp = matrix[:, 2:, :2]
    solved = np.linalg.solve(matrix[:, :2, :2], np.concatenate((matrix[:, :2, 2:], vector[:, :2, None]), axis=2))
    return matrix[:, 2:, 2:] - n_bp @ solved[:, :, :2], vector[:, 2:] - np.einsum("tij,tj->ti", n_bp, solved[:, :, 2])


def bias_posterior(schur: Floats, right: Floats, sigma: Floats) -> tuple[Floats, Floats]:
    """Return (P⁻¹ + ΣS)⁻¹ Σu, (..., 2), and the covariance (P⁻¹ + ΣS)⁻¹, (..., 2, 2), with P = diag(sigma²).

    Written D (I + D ΣS D)⁻¹ D with P = D², which also holds where a sigma is 0: that bias stays 0.
    """
    root = sigma[..., :, None] * np.eye(2)
    cov = root @ np.linalg.solve(np.eye(2) + root @ schur @ root, root)
    return (cov @ right[..., None])[..., 0], cov
