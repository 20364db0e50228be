"""What a camera reports frame by frame: the paper's "Detection Simulation", one function an equation.

The chain of a pass is `in_view_of` → `keep_detected` → `measured` → `recognised`, with `ghosts` beside it and
`projected` at the end; `sensing_chain` runs it. Positions are metres in an ENU frame, headings and bearings
counter-clockwise (a bearing is positive to the left), angles of the model in degrees as in the configuration.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.pose_errors import gauss_markov, wrong_fixes
from geofleet.algorithms.sensing_kernels import in_view, project

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from geofleet.algorithms.sensor_model import SensorModel
    from geofleet.algorithms.streams import PassesRandom
    from geofleet.algorithms.trajectory import Poses

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]
    Random = Generator | PassesRandom

GHOST = -1
"""Stands for the sign of a detection that came from none."""
FIRST_BILLBOARD = -2
"""Stands for the first billboard; the next ones count downwards, and ghosts that last after them."""


class SignField:
    """The signs of a scene, in a grid of cells as wide as the sensor sees.

    Parameters
    ----------
    xy_m
        East and north, shape (n, 2).
    class_code
        Class of each sign, 0 … n_classes - 1, shape (n,).
    n_classes
        How many classes are valid in the scene.
    cell_m
        Width of a cell; `SensorModel.range_m` of the sensors that look at the field may not exceed it.
    facing_rad
        The way each sign's face looks, counter-clockwise from east, NaN where unknown, shape (n,). When given, a sign
        is seen from its front only, and one of unknown facing from everywhere.
    """

    def __init__(
        self, xy_m: Floats, class_code: Ints, *, n_classes: int, cell_m: float, facing_rad: Floats | None = None
    ) -> None:
        self.xy_m = np.ascontiguousarray(xy_m, dtype=np.float64)
        self.class_code = np.ascontiguousarray(class_code, dtype=np.int64)
        self.n_classes = n_classes
        self.cell_m = cell_m
        self.facing_rad = facing_rad
        self.origin_xy_m = self.xy_m.min(axis=0)
        column, row = np.floor((self.xy_m - self.origin_xy_m) / cell_m).astype(np.int64).T
        self.shape = (int(row.max()) + 1, int(column.max()) + 1)
        cell = row * self.shape[1] + column
        self.cell_sign = np.argsort(cell, kind="stable")
        self.cell_start = np.searchsorted(cell[self.cell_sign], np.arange(self.shape[0] * self.shape[1] + 1))


@dataclass(frozen=True, slots=True)
class Sightings:
    """Signs in the view cone, or what was measured of them, one row a frame and object, by frame.

    Parameters
    ----------
    frame, sign
        Number of the frame and of the sign (`GHOST` for none), shape (n,).
    range_m, bearing_rad
        Distance and angle from the heading, positive to the left, shape (n,).
    """

    frame: Ints
    sign: Ints
    range_m: Floats
    bearing_rad: Floats

    def take(self, rows: Ints | Flags) -> Sightings:
        """Return some rows, by number or by flag."""
        return Sightings(self.frame[rows], self.sign[rows], self.range_m[rows], self.bearing_rad[rows])

    @classmethod
    def joined(cls, parts: Sequence[Sightings], first_frame: Sequence[int]) -> Sightings:
        """Return one after the other, the frames of each counted from a first one."""
        return cls(
            np.concatenate([part.frame + first for part, first in zip(parts, first_frame, strict=True)]),
            np.concatenate([part.sign for part in parts]),
            np.concatenate([part.range_m for part in parts]),
            np.concatenate([part.bearing_rad for part in parts]),
        )


@dataclass(frozen=True, slots=True)
class Calibration:
    """Sensor-setting error of one sensor: what it adds to every range and bearing.

    `drift` is what it adds beside in each frame, range in metres and bearing in radians, shape (n_frames, 2).
    """

    range_bias_m: float
    bearing_bias_rad: float
    drift: Floats | None = None

    def at(self, frame: Ints) -> tuple[Floats | float, Floats | float]:
        """Return the range bias (m) and the bearing bias (rad) in some frames."""
        if self.drift is None:
            return self.range_bias_m, self.bearing_bias_rad
        return self.range_bias_m + self.drift[frame, 0], self.bearing_bias_rad + self.drift[frame, 1]


@dataclass(frozen=True, slots=True)
class FrameBiases:
    """Sensor-setting errors of several passes: range bias (m) and bearing bias (rad), each (n_frames,)."""

    range_bias_m: Floats
    bearing_bias_rad: Floats

    @classmethod
    def of(cls, calibrations: Sequence[Calibration], pass_start: Ints) -> FrameBiases:
        """Spread the calibration of each pass over its frames, `pass_start[k]:pass_start[k + 1]`."""
        n_frames = np.diff(pass_start)
        range_bias_m = np.repeat([one.range_bias_m for one in calibrations], n_frames)
        bearing_bias_rad = np.repeat([one.bearing_bias_rad for one in calibrations], n_frames)
        for one, first, last in zip(calibrations, pass_start[:-1], pass_start[1:], strict=True):
            if one.drift is not None:
                range_bias_m[first:last] += one.drift[:, 0]
                bearing_bias_rad[first:last] += one.drift[:, 1]
        return cls(range_bias_m, bearing_bias_rad)

    def at(self, frame: Ints) -> tuple[Floats, Floats]:
        """Return the range bias (m) and the bearing bias (rad) in some frames."""
        return self.range_bias_m[frame], self.bearing_bias_rad[frame]


@dataclass(frozen=True, slots=True)
class FrameDetections:
    """What a pass detects, or several passes one after the other: one row a frame and object, by frame.

    Parameters
    ----------
    frame, sign, class_code
        Number of the frame, of the true sign (`GHOST` for none) and of the reported class, shape (n,).
    xy_m
        Reported position, shape (n, 2).
    range_m, azimuth_rad
        Measured range, and reported direction of view counter-clockwise from east, shape (n,).
    n_frames
        Frames of all passes, with and without detections.
    later_passes
        First frame of every pass but the first, shape (n_passes - 1,).
    """

    frame: Ints
    sign: Ints
    class_code: Ints
    xy_m: Floats
    range_m: Floats
    azimuth_rad: Floats
    n_frames: int
    later_passes: Ints = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def pass_start(self) -> Ints:
        """First frame of each pass and, last, the number of all, shape (n_passes + 1,)."""
        return np.concatenate(([0], self.later_passes, [self.n_frames]))

    def pass_of(self, frame: Ints) -> Ints:
        """Return the number of the pass that some frames belong to."""
        return np.searchsorted(self.later_passes, frame, side="right")


@dataclass(frozen=True, slots=True)
class PassSensing:
    """What one pass sees, or several: the signs truly in view, what is detected, and where they say they were."""

    in_view: Sightings
    detections: FrameDetections
    reported: Poses


def in_view_of(poses: Poses, signs: SignField, model: SensorModel) -> Sightings:
    """Return the signs in the view cone: d < r and |θ| < FOV/2, both strict, from the true pose (paper, eq. 1)."""
    if model.range_m > signs.cell_m:
        raise ValueError(f"a sensor of {model.range_m} m range needs cells as wide, not {signs.cell_m} m")
    seen = Sightings(
        *in_view(
            poses.xy_m,
            poses.heading_rad,
            signs.xy_m,
            signs.cell_start,
            signs.cell_sign,
            signs.origin_xy_m,
            signs.shape,
            signs.cell_m,
            model.range_m,
            model.half_fov_rad,
        )
    )
    return seen if signs.facing_rad is None else seen.take(_from_front(seen, poses, signs.facing_rad))


def _from_front(seen: Sightings, poses: Poses, facing_rad: Floats) -> Flags:
    """Return which sightings look at the front of a sign: its face looks into the half-plane that the car is in."""
    to_car_rad = poses.heading_rad[seen.frame] + seen.bearing_rad + np.pi
    off_rad = facing_rad[seen.sign] - to_car_rad
    return np.isnan(off_rad) | (np.cos(off_rad) > 0)


def draw_calibration(model: SensorModel, rng: Generator) -> Calibration:
    """Draw the sensor-setting error, ε_sensor ~ N(0, sigma_sensor²) in range and in bearing (paper, eq. 2).

    A fault that the model gives comes on top.
    """
    range_unit, bearing_unit = rng.standard_normal(2)
    return Calibration(
        float(model.range_bias_m + model.range_bias_sigma_m * range_unit),
        float(np.deg2rad(model.bearing_bias_deg) + np.deg2rad(model.bearing_bias_sigma_deg) * bearing_unit),
    )


def drifting(calibration: Calibration, poses: Poses, model: SensorModel, rng: Generator) -> Calibration:
    """Let a sensor-setting error drift along a pass: a Gauss-Markov process each in range and in bearing."""
    if poses.elapsed_s is None:
        raise ValueError("a drift needs poses with times")
    unit = gauss_markov(poses.elapsed_s, sigma_m=1.0, correlation_s=model.bias_drift_correlation_s, rng=rng)
    sigma = np.array([model.range_bias_drift_sigma_m, np.deg2rad(model.bearing_bias_drift_sigma_deg)])
    return replace(calibration, drift=sigma * unit)


def reported_poses(true: Poses, model: SensorModel, rng: Generator, drift: Generator | None = None) -> Poses:
    """Return the poses that the vehicle believes: one offset a axis and one heading error for the whole pass.

    With `drift`, what the model says about drift and wrong fixes is added, drawn from that stream.
    """
    east_unit, north_unit, heading_unit = rng.standard_normal(3)
    offset_m = model.gnss_sigma_m * np.array([east_unit, north_unit])
    turn_rad = np.deg2rad(model.heading_sigma_deg) * heading_unit
    xy_m = true.xy_m + offset_m
    if drift is not None and model.gnss_drift_sigma_m > 0:
        if true.elapsed_s is None:
            raise ValueError("a drift needs poses with times")
        sigma_m, correlation_s = model.gnss_drift_sigma_m, model.gnss_drift_correlation_s
        xy_m = xy_m + gauss_markov(true.elapsed_s, sigma_m=sigma_m, correlation_s=correlation_s, rng=drift)
    if drift is not None and model.wrong_fixes_per_km > 0:
        xy_m = xy_m + wrong_fixes(
            true.along_m,
            per_km=model.wrong_fixes_per_km,
            length_m=model.wrong_fix_length_m,
            sigma_m=model.wrong_fix_sigma_m,
            rng=drift,
        )
    return type(true)(xy_m, true.heading_rad + turn_rad, true.along_m, true.elapsed_s)


def miss_rate(range_m: Floats, model: SensorModel) -> Floats | float:
    """Return the probability that a sign in view is missed: FN, or 1 - (1 - FN) / (1 + exp((d - d_half) / width))."""
    if model.fade_range_m == 0:
        return model.false_negative_rate
    fallen = np.clip((range_m - model.fade_range_m) / model.fade_width_m, None, 700)  # exp stays finite
    missed: Floats = 1 - (1 - model.false_negative_rate) / (1 + np.exp(fallen))
    return missed


def keep_detected(n: int, false_negative_rate: Floats | float, rng: Random) -> Flags:
    """Draw which of n signs in view are detected: each is missed with probability FN, independently."""
    return rng.random(n) >= false_negative_rate


def measured(true: Sightings, calibration: Calibration | FrameBiases, model: SensorModel, rng: Random) -> Sightings:
    """Add both levels of error: d + ε_sensor + ε_object, and the same for θ (paper, eqs. 3-5).

    A range may come out negative when sigma is as large as the distance; the paper does not cut it, nor do we.
    """
    n = len(true.frame)
    range_bias_m, bearing_bias_rad = calibration.at(true.frame)
    range_m = true.range_m + range_bias_m + model.range_noise_sigma_m * rng.standard_normal(n)
    noise_rad = np.deg2rad(model.bearing_noise_sigma_deg) * rng.standard_normal(n)
    bearing_rad = true.bearing_rad + bearing_bias_rad + noise_rad
    return Sightings(true.frame, true.sign, range_m, bearing_rad)


def recognised(true_class: Ints, *, n_classes: int, semantic_rate: float, rng: Random) -> Ints:
    """Recognise classes (paper, Algorithm 1): keep with probability r_semantic, else a random other valid class.

    Raises
    ------
    ValueError
        A class would have to be confused, but there is only one.
    """
    correct = rng.random(len(true_class)) < semantic_rate
    if n_classes == 1:
        if semantic_rate < 1:
            raise ValueError("one class alone cannot be confused: semantic_rate must be 1")
        return true_class
    other = rng.integers(0, n_classes - 1, len(true_class))
    other += other >= true_class  # skip the true one
    return np.where(correct, true_class, other)


def ghost_frames(n_frames: int, model: SensorModel, rng: Random) -> Ints:
    """Draw how many false positives each frame has, N ~ Poisson(λ), and return the frame of every one."""
    return np.repeat(np.arange(n_frames), rng.poisson(model.ghosts_per_frame, n_frames))


def ghosts(frame: Ints, *, n_classes: int, model: SensorModel, rng: Random) -> tuple[Sightings, Ints]:
    """Draw the false positives of some frames: uniform over the view cone, with a random valid class each."""
    n = len(frame)
    range_m = model.range_m * np.sqrt(rng.random(n))  # area grows with the square of the radius
    bearing_rad = model.half_fov_rad * (2 * rng.random(n) - 1)
    class_code = rng.integers(0, n_classes, n)
    return Sightings(frame, np.full(n, GHOST), range_m, bearing_rad), class_code


def ghost_tracks(
    true: Poses, n_classes: int, calibration: Calibration, model: SensorModel, rng: Generator, *, first: int
) -> tuple[Sightings, Ints]:
    """Draw false positives that last: a reflection that looks like a sign over several frames of one pass.

    Poisson along the way; each appears in a uniform frame at a uniform place of its view cone, with one random valid
    class, lasts a geometric number of frames of mean `ghost_track_frames`, and is measured and missed as a sign is.
    They are numbered downwards from `first`.
    """
    n = rng.poisson(model.ghost_tracks_per_km * (true.along_m[-1] - true.along_m[0]) / 1000.0)
    born = rng.integers(0, len(true.along_m), n)
    range_m = model.range_m * np.sqrt(rng.random(n))
    azimuth_rad = true.heading_rad[born] + model.half_fov_rad * (2 * rng.random(n) - 1)
    last = born + rng.geometric(1.0 / model.ghost_track_frames, n) - 1
    class_code = rng.integers(0, n_classes, n)
    if not n:
        return Sightings(born, born, np.empty(0), np.empty(0)), class_code
    place = true.xy_m[born] + range_m[:, None] * np.column_stack((np.cos(azimuth_rad), np.sin(azimuth_rad)))
    visible = in_view_of(true, SignField(place, class_code, n_classes=n_classes, cell_m=model.range_m), model)
    there = (visible.frame >= born[visible.sign]) & (visible.frame <= last[visible.sign])
    near = visible.take(there)
    kept = keep_detected(len(near.frame), miss_rate(near.range_m, model), rng)
    seen = measured(near.take(kept), calibration, model, rng)
    return Sightings(seen.frame, first - seen.sign, seen.range_m, seen.bearing_rad), class_code[seen.sign]


def projected(seen: Sightings, reported: Poses) -> tuple[Floats, Floats]:
    """Return reported positions p = pose + R(heading) d (cos θ, sin θ) (paper, eq. 6), and directions of view."""
    xy_m, azimuth_rad = project(seen.frame, seen.range_m, seen.bearing_rad, reported.xy_m, reported.heading_rad)
    return xy_m, azimuth_rad
