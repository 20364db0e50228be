"""Where signs stand along a road, and what became of each: what a block bootstrap resamples."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from geofleet.errors import InputError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from geofleet.algorithms.trajectory import DriveLine

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_PLANE = 2
_OUTCOMES = ("TP", "FP", "FN")
_STEP_M = 2.0  # a station is exact to half of this; blocks are a hundred times as long
_CURVE_BITS = 16


class Stations(NamedTuple):
    """Positions along a road.

    Parameters
    ----------
    station_m
        (n,) from the start of the road, metres.
    length_m
        Of the road, metres.
    """

    station_m: Floats
    length_m: float


def stations_along_drive(xy_m: Floats, line: DriveLine) -> Stations:
    """Give each sign the nearest place on a drive, to a metre; gaps between segments are no road.

    Parameters
    ----------
    xy_m
        (n, 2) east and north in the frame of the drive.
    line
        The drive (`geofleet.algorithms.trajectory.drive_line`). Of a road driven twice a sign takes the nearest run.

    Raises
    ------
    InputError
        `xy_m` is not (n, 2) finite numbers.
    """
    xy = _checked(xy_m)
    along_m = _without_gaps(line)
    length_m = float(along_m[-1])
    posts = np.linspace(0.0, length_m, max(int(np.ceil(length_m / _STEP_M)), 1) + 1)
    posts_xy = np.column_stack([np.interp(posts, along_m, axis) for axis in line.xy_m.T])
    return Stations(posts[cKDTree(posts_xy).query(xy)[1]] if len(xy) else np.empty(0), length_m)


def stations_along_curve(xy_m: Floats, *, longest_gap_m: float = 100.0) -> Stations:
    """Order signs along a Hilbert curve where no drive is known; neighbours on it are neighbours on the ground.

    The station of a sign is the way from sign to sign along the curve, each step counted as `longest_gap_m` at most:
    empty land is no road.

    Parameters
    ----------
    xy_m
        (n, 2) east and north, metres: every sign of the reference, and every sign of the map without a match.

    Raises
    ------
    InputError
        `xy_m` is not (n, 2) finite numbers, or the gap is not positive.
    """
    xy = _checked(xy_m)
    if not longest_gap_m > 0:
        raise InputError(f"the longest gap is {longest_gap_m} m", where="stations", todo="Give a positive distance.")
    if not len(xy):
        return Stations(np.empty(0), 0.0)
    corner = xy.min(axis=0)
    # one scale for both axes keeps the curve's cells square
    scale = (2**_CURVE_BITS - 1) / max(float((xy - corner).max()), 1.0)
    order = np.lexsort((xy[:, 1], xy[:, 0], _hilbert(((xy - corner) * scale).astype(np.int64))))
    steps_m = np.minimum(np.hypot(*np.diff(xy[order], axis=0).T), longest_gap_m)
    station_m = np.empty(len(xy))
    station_m[order] = np.concatenate(([0.0], np.cumsum(steps_m)))
    return Stations(station_m, float(station_m.max()))


@dataclass(frozen=True, slots=True, eq=False)
class RoadOutcomes:
    """What became of every sign of a map and of its reference, along a road.

    Parameters
    ----------
    station_m
        (n,) place along the road, 0 … length_m; of the reference sign for a TP.
    outcome
        (n,) `TP`, `FP` or `FN`.
    sq_distance_m2
        (n,) squared distance of each TP to its reference sign, m²; ignored elsewhere, where it may be NaN.
    length_m
        Of the road, metres.

    Raises
    ------
    InputError
        The arrays have unlike lengths, a station is outside of the road, an outcome is unknown, a TP has no distance,
        or the road has no length.
    """

    station_m: Floats
    outcome: NDArray[np.str_]
    sq_distance_m2: Floats
    length_m: float

    def __post_init__(self) -> None:
        n = len(self.station_m)
        if not len(self.outcome) == len(self.sq_distance_m2) == n:
            raise InputError(
                f"{n} stations, {len(self.outcome)} outcomes and {len(self.sq_distance_m2)} distances", where="road"
            )
        if not 0 < self.length_m < math.inf:
            raise InputError(f"the road is {self.length_m} m long", where="road", todo="Give its length in metres.")
        outside = np.count_nonzero(~((self.station_m >= 0) & (self.station_m <= self.length_m)))
        if outside:
            raise InputError(f"{outside} of {n} stations are not within 0 … {self.length_m} m", where="road")
        unknown = np.setdiff1d(self.outcome, _OUTCOMES)
        if unknown.size:
            raise InputError(f"outcome {str(unknown[0])!r}", where="road", todo="Give TP, FP or FN.")
        of_tp = self.sq_distance_m2[self.outcome == "TP"]
        if not ((of_tp >= 0) & (of_tp < math.inf)).all():
            raise InputError("a TP has no squared distance", where="road", todo="Give one a TP, not negative.")

    def sums(self) -> Floats:
        """Return TP, FP, FN and Σd² of each row, (n, 4)."""
        is_of = [self.outcome == name for name in _OUTCOMES]
        return np.column_stack((*is_of, np.where(is_of[0], self.sq_distance_m2, 0.0))).astype(np.float64)


def road_outcomes(
    station_m: ArrayLike, outcome: ArrayLike, sq_distance_m2: ArrayLike, *, length_m: float
) -> RoadOutcomes:
    """Make `RoadOutcomes` of anything that numpy reads, e.g. the columns of a `matches` table.

    Raises
    ------
    InputError
        See `RoadOutcomes`.
    """
    return RoadOutcomes(
        np.asarray(station_m, np.float64),
        np.asarray(outcome, np.str_),
        np.asarray(sq_distance_m2, np.float64),
        length_m,
    )


def _checked(xy_m: Floats) -> Floats:
    xy = np.asarray(xy_m, np.float64)
    if xy.shape == (0,):
        return xy.reshape(0, _PLANE)
    if xy.ndim != _PLANE or xy.shape[1] != _PLANE or not np.isfinite(xy).all():
        raise InputError("positions are not (n, 2) finite numbers", where="stations", todo="Give east and north.")
    return xy


def _without_gaps(line: DriveLine) -> Floats:
    steps_m = np.diff(line.along_m)
    steps_m[line.starts[1:-1] - 1] = 0.0
    return np.concatenate(([0.0], np.cumsum(steps_m)))


def _hilbert(cell: Ints) -> Ints:
    """Return the index of each cell (n, 2) on the Hilbert curve through 2^16 by 2^16 cells."""
    x, y = cell[:, 0].copy(), cell[:, 1].copy()
    index = np.zeros(len(cell), np.int64)
    for bit in range(_CURVE_BITS - 1, -1, -1):
        side = 1 << bit
        right, upper = (x & side) > 0, (y & side) > 0
        index += side * side * ((3 * right) ^ upper)
        # turn the quadrant so that the curve within it starts where the last one ended
        flipped = right & ~upper
        x[flipped], y[flipped] = side - 1 - (x[flipped] & (side - 1)), side - 1 - (y[flipped] & (side - 1))
        x[~upper], y[~upper] = y[~upper], x[~upper].copy()
    return index
