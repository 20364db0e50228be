"""Drives to poses: a recorded line resampled at the frame rate, and the way that one pass takes along it.

Everything is in an ENU frame in metres; headings are mathematical, counter-clockwise from east, in radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.compiled import kernel
from geofleet.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

MOVING_STEP_M = 0.5
"""Epochs nearer than this to the last one kept are standing still: their noise is no motion and has no heading."""
CRAWL_MPS = 1.0
"""A camera at a constant frame rate stands still below this speed."""


@dataclass(frozen=True, slots=True)
class Poses:
    """Where a vehicle is at each frame.

    Parameters
    ----------
    xy_m
        East and north, shape (n, 2).
    heading_rad
        Driving direction, counter-clockwise from east, shape (n,).
    along_m
        Distance driven since the start of the drive, gaps included, shape (n,).
    elapsed_s
        Time since the start of the pass, shape (n,), where it is known.
    """

    xy_m: Floats
    heading_rad: Floats
    along_m: Floats
    elapsed_s: Floats | None = None

    @classmethod
    def joined(cls, poses: Sequence[Poses]) -> Poses:
        """Return the poses of several passes, one after the other; times only when all have them."""
        elapsed_s = [one.elapsed_s for one in poses if one.elapsed_s is not None]
        return cls(
            np.concatenate([one.xy_m for one in poses]),
            np.concatenate([one.heading_rad for one in poses]),
            np.concatenate([one.along_m for one in poses]),
            np.concatenate(elapsed_s) if len(elapsed_s) == len(poses) else None,
        )


@dataclass(frozen=True, slots=True)
class DriveLine:
    """The moving part of a drive.

    Parameters
    ----------
    xy_m
        East and north, shape (n, 2); at least two points a segment.
    along_m
        Distance from the first point, gaps included, shape (n,).
    starts
        Index of the first point of each segment and, last, the number of points.
    recorded_s
        Time of each point since the first, shape (n,), where the drive is dated.
    """

    xy_m: Floats
    along_m: Floats
    starts: Ints
    recorded_s: Floats | None = None

    def backward(self) -> DriveLine:
        """Return the line driven from its end to its beginning."""
        times = None if self.recorded_s is None else self.recorded_s[-1] - self.recorded_s[::-1]
        along = self.along_m[-1] - self.along_m[::-1]
        return DriveLine(self.xy_m[::-1], along, len(self.xy_m) - self.starts[::-1], times)


def drive_line(xy_m: Floats, segment: Ints, elapsed_s: Floats | None = None) -> DriveLine:
    """Drop the epochs that stand still and the segments that never move.

    Parameters
    ----------
    xy_m
        East and north of every epoch, shape (n, 2), in the order driven.
    segment
        Segment number of every epoch, shape (n,); a gap starts a new one.
    elapsed_s
        Time of every epoch since any instant, shape (n,), when the drive is dated.

    Raises
    ------
    InputError
        Fewer than two epochs remain, so that nothing has a heading.
    """
    if not np.isfinite(xy_m).all():
        raise InputError(
            "the drive has positions that are not finite numbers.", todo="Remove those epochs and ingest again."
        )
    kept = _moving(np.ascontiguousarray(xy_m), segment, MOVING_STEP_M)
    points, part = xy_m[kept], segment[kept]
    lonely = np.ones(len(points), dtype=np.bool_)
    same = part[1:] == part[:-1]
    lonely[1:] &= ~same
    lonely[:-1] &= ~same
    points, part = points[~lonely], part[~lonely]
    times = None if elapsed_s is None else elapsed_s[kept][~lonely]
    if len(points) < 2:  # noqa: PLR2004 - a heading needs two points
        raise InputError(
            f"the drive of {len(xy_m)} epoch{'s' if len(xy_m) > 1 else ''} has no motion: no two of a segment are "
            f"{MOVING_STEP_M} m apart.",
            todo="Give a drive that moves.",
        )
    steps = np.hypot(*np.diff(points, axis=0).T)
    starts = np.concatenate(([0], np.flatnonzero(np.diff(part)) + 1, [len(points)]))
    along = np.concatenate(([0.0], np.cumsum(steps)))
    return DriveLine(points, along, starts.astype(np.int64), None if times is None else times - times[0])


def resample(line: DriveLine, *, spacing_m: float, heading_baseline_m: float) -> Poses:
    """Place a frame every `spacing_m` of each segment, with the heading of its motion.

    The heading is that of the chord over `heading_baseline_m` around the frame, which equals the heading of the line
    smoothed by a moving average of that length: corners turn smoothly and centimetres of noise turn nothing. At the
    ends of a segment the chord is shorter.

    Raises
    ------
    InputError
        The drive is shorter than one frame spacing.
    """
    spans = list(zip(line.along_m[line.starts[:-1]], line.along_m[line.starts[1:] - 1], strict=True))
    pieces = [np.arange(first, last + 1e-9, spacing_m) for first, last in spans]
    along = np.concatenate(pieces)
    if len(along) < 2:  # noqa: PLR2004 - one frame is no drive
        raise InputError(
            f"the drive moves {line.along_m[-1]:.2f} m, less than one frame spacing of {spacing_m} m.",
            todo="Give a longer drive, or set frame_spacing_m lower.",
        )
    low, high = np.repeat(np.array(spans), [len(piece) for piece in pieces], axis=0).T
    behind = _at(line, np.maximum(along - heading_baseline_m / 2, low))
    ahead = _at(line, np.minimum(along + heading_baseline_m / 2, high))
    chord = ahead - behind
    return Poses(_at(line, along), np.arctan2(chord[:, 1], chord[:, 0]), along)


def travel_times(line: DriveLine, *, speed_mps: float, recorded: bool) -> Floats:
    """Return when a pass is at each point of a line, seconds since its start, shape (n,).

    Recorded times where they are wanted, else those of a constant speed.

    Raises
    ------
    InputError
        Recorded times are wanted and the drive has none, or they do not grow.
    """
    if not recorded:
        return line.along_m / speed_mps
    if line.recorded_s is None:
        raise InputError("the drive has no times to take the speed from.", todo="Set speed_profile to constant.")
    if not (np.diff(line.recorded_s) > 0).all():
        raise InputError(
            "the times of the drive do not grow, so it has no speed.",
            todo="Give a drive in the order of its times, or set speed_profile to constant.",
        )
    return line.recorded_s


def frames_in_time(way: Poses, line: DriveLine, *, times_s: Floats, rate_hz: float) -> Poses:
    """Return the poses of a way at a constant frame rate, where `resample` placed them at a constant distance.

    Parameters
    ----------
    way
        Poses at small distances along a line, as `resample` and `wander` give them.
    line
        The line; no frame lies in a gap between its segments.
    times_s
        When the pass is at each point of the line; a standstill gives no frames, and less than `CRAWL_MPS` counts as
        that speed, for a camera that stands still sends nothing new.
    rate_hz
        Frames a second.
    """
    moving_s = np.minimum(np.diff(times_s), np.diff(line.along_m) / CRAWL_MPS)
    clock_s = np.concatenate(([0.0], np.cumsum(moving_s)))
    along = np.interp(np.arange(0.0, clock_s[-1], 1.0 / rate_hz), clock_s, line.along_m)
    segment = np.searchsorted(line.along_m[line.starts[:-1]], along, side="right") - 1
    along = along[along <= line.along_m[line.starts[1:] - 1][segment]]
    if len(along) < 2:  # noqa: PLR2004 - one frame is no drive
        raise InputError(
            f"the drive lasts for less than two frames at {rate_hz:g} Hz.", todo="Set frame_rate_hz higher."
        )
    columns = [np.interp(along, way.along_m, values) for values in (*way.xy_m.T, np.unwrap(way.heading_rad))]
    return Poses(np.column_stack(columns[:2]), columns[2], along, np.interp(along, line.along_m, times_s))


def beside(way: Poses, left_m: float) -> Poses:
    """Return a way shifted to its left: the lane of the other direction, where traffic keeps to the right."""
    left = np.column_stack((-np.sin(way.heading_rad), np.cos(way.heading_rad)))
    return Poses(way.xy_m + left_m * left, way.heading_rad, way.along_m, way.elapsed_s)


def wander(base: Poses, *, sigma_m: float, correlation_m: float, spacing_m: float, rng: Generator) -> Poses:
    """Return the way of one pass: the base drive with a smooth lateral offset.

    The offset is a stationary Gaussian process along the drive, N(0, sigma_m²) everywhere, with correlation
    exp(-Δ² / (2 correlation_m²)) at distance Δ: white noise smoothed by a Gaussian kernel. Positive is left. The
    heading follows the offset line.
    """
    if sigma_m == 0:
        return base
    width = correlation_m / np.sqrt(2) / spacing_m  # in frames; smoothing twice widens by the root of two
    reach = int(np.ceil(4 * width))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / width) ** 2)
    kernel *= sigma_m / np.linalg.norm(kernel)
    noise = rng.standard_normal(len(base.heading_rad) + 2 * reach)
    offset = np.convolve(noise, kernel, mode="valid")
    slope = np.gradient(offset, spacing_m)
    left = np.column_stack((-np.sin(base.heading_rad), np.cos(base.heading_rad)))
    heading = base.heading_rad + np.arctan(slope)
    return Poses(base.xy_m + offset[:, None] * left, heading, base.along_m, base.elapsed_s)


def _at(line: DriveLine, along_m: Floats) -> Floats:
    """Return the points of a line at some distances, shape (n, 2)."""
    return np.column_stack([np.interp(along_m, line.along_m, line.xy_m[:, axis]) for axis in (0, 1)])


@kernel
def _moving(xy_m: Floats, segment: Ints, step_m: float) -> Ints:
    """Return the epochs to keep: the first of a segment, and each that is a step away from the last one kept."""
    kept = np.empty(len(xy_m), dtype=np.int64)
    n_kept = 0
    for i in range(len(xy_m)):
        if n_kept and segment[i] == segment[kept[n_kept - 1]]:
            last = kept[n_kept - 1]
            if np.hypot(xy_m[i, 0] - xy_m[last, 0], xy_m[i, 1] - xy_m[last, 1]) < step_m:
                continue
        kept[n_kept] = i
        n_kept += 1
    return kept[:n_kept]
