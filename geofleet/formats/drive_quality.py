"""Quality control of a drive, the same for every format: order, duplicates, jumps, gaps, stops, heading and speed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from pyproj import Geod

from geofleet.algorithms.drive_quality import (
    BACKING_SATELLITES,
    find_jumps,
    find_stops,
    find_tears,
    hasty_fixes,
    standing_radius_m,
    unbacked_fixes,
)
from geofleet.algorithms.geodesy import to_ecef

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.formats.drive_epochs import Epochs

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]

GAP_FACTOR = 2.5  # one epoch may be missing, two make a gap
GAP_S = 0.5
GAP_STEPS, GAP_M = 10.0, 20.0  # of places without a clock
STANDING_M = 0.3
FIXED, FLOAT = "fixed", "float"
WRONG_FIXES = f"wrong fixes: they do not hold, and fewer than {BACKING_SATELLITES} satellites back them"
JUMPS = "impossible jumps"
_GEOD = Geod(ellps="WGS84")


@dataclass(frozen=True, slots=True)
class Motion:
    """Motion at each epoch of a drive.

    Parameters
    ----------
    segment
        Number of the stretch without a gap, shape (n,).
    heading_deg
        Clockwise from north; while standing that of the last motion (before it, of the first); NaN in a segment
        without any, shape (n,).
    speed_mps
        Over the neighbouring epochs, 0 while standing; NaN in a segment of one epoch, shape (n,).
    """

    segment: Ints
    heading_deg: Floats
    speed_mps: Floats

    def take(self, rows: Flags) -> Motion:
        """Return the motion at some of the epochs."""
        return Motion(self.segment[rows], self.heading_deg[rows], self.speed_mps[rows])


@dataclass(frozen=True, slots=True)
class Judged:
    """The epochs that can be used, in the order driven, their motion, and what was left out or found."""

    epochs: Epochs
    motion: Motion
    skipped: dict[str, int]
    found: dict[str, int]


def judge_epochs(epochs: Epochs) -> Judged:
    """Put the epochs of one drive in order and leave out what cannot be true or says nothing new.

    Epochs are sorted by time; of equal times the first is kept; jumps are left out; of a stop the first and the last
    epoch are kept. A gap in time, an impossible step, and a stretch that the file sets apart start a segment. Fixes
    that do not hold are called float, and left out where too few satellites back them. Epochs without any time are left
    as they are.
    """
    if np.isnan(epochs.seconds()).all():
        part = np.zeros(len(epochs.lon), np.int64) if epochs.part is None else _numbered(epochs.part)
        motion = replace(_motion(np.arange(len(part)), epochs, part, STANDING_M), speed_mps=np.full(len(part), np.nan))
        return Judged(epochs, motion, {}, {"epochs without a time": len(part), "segments": int(part[-1]) + 1})
    epochs, skipped, found = _in_order(epochs)
    epochs, left_out, told = _credible(epochs)
    t_s, xyz_m = epochs.seconds(), to_ecef(epochs.lon, epochs.lat)
    segment, n_gaps, n_tears = _segments(t_s, xyz_m, epochs.part, has_clock=epochs.has_clock)
    stops = find_stops(t_s, xyz_m, segment)
    standing, inside = stops.is_standing(len(t_s)), stops.is_inside(len(t_s))
    motion = _motion(t_s, epochs, segment, standing_radius_m(t_s, xyz_m), standing)
    skipped |= left_out | {"epochs inside of a stop": int(inside.sum())}
    found |= {
        "gaps": n_gaps,
        "impossible steps that start a segment": n_tears,
        "stops": len(stops.first),
        "epochs standing still": int(standing.sum()),
    }
    return Judged(epochs.take(~inside), motion.take(~inside), skipped, found | told)


def _in_order(epochs: Epochs) -> tuple[Epochs, dict[str, int], dict[str, int]]:
    """Return the epochs that have a time, ascending, one of each time; what was left out, and what was found."""
    no_time = np.isnan(epochs.seconds())
    epochs = epochs.take(~no_time)
    order = np.argsort(epochs.seconds(), kind="stable")
    epochs = epochs.take(order)
    again = np.concatenate(([False], np.diff(epochs.seconds()) <= 0))
    skipped = {"epochs without a time": int(no_time.sum()), "duplicate epochs": int(again.sum())}
    return epochs.take(~again), skipped, {"epochs out of order": int((np.diff(order) < 0).sum())}


def _credible(epochs: Epochs) -> tuple[Epochs, dict[str, int], dict[str, int]]:
    """Return the epochs that one car can have driven, their fixes judged; what was left out, and what was found."""
    t_s, xyz_m = epochs.seconds(), to_ecef(epochs.lon, epochs.lat)
    jump = find_jumps(t_s, xyz_m) if epochs.has_clock else np.zeros(len(t_s), bool)
    epochs, t_s, xyz_m = epochs.take(~jump), t_s[~jump], xyz_m[~jump]
    segment, _, _ = _segments(t_s, xyz_m, epochs.part, has_clock=epochs.has_clock)
    is_fixed = epochs.quality == FIXED
    hasty = hasty_fixes(t_s, is_fixed, segment)
    wrong = unbacked_fixes(hasty, epochs.n_satellites)
    epochs = replace(epochs, quality=np.where(hasty, FLOAT, epochs.quality))
    skipped = {JUMPS: int(jump.sum()), WRONG_FIXES: int(wrong.sum())}
    found = {"fixes that do not hold, called float": int((hasty & ~wrong).sum())}
    if is_fixed.any():
        held_s = np.concatenate((t_s[:1], t_s[is_fixed & ~hasty], t_s[-1:]))
        found["seconds without a fix that holds, at the longest"] = int(np.diff(held_s).max())
    return epochs.take(~wrong), skipped, found


def motion_of(t_s: Floats, lon: Floats, lat: Floats) -> Motion:
    """Derive segments, headings and speeds from times (seconds, ascending) and positions (degrees)."""
    from geofleet.formats.drive_epochs import Epochs  # noqa: PLC0415  (only typed above)

    xyz_m = to_ecef(lon, lat)
    segment, _, _ = _segments(t_s, xyz_m, None, has_clock=True)
    standing = find_stops(t_s, xyz_m, segment).is_standing(len(t_s))
    return _motion(t_s, Epochs.of(lon, lat), segment, standing_radius_m(t_s, xyz_m), standing)


def _segments(t_s: Floats, xyz_m: Floats, part: Ints | None, *, has_clock: bool) -> tuple[Ints, int, int]:
    """Return the number of each epoch's segment, how many gaps there are, and how many impossible steps."""
    if len(t_s) < 2:  # noqa: PLR2004 - one epoch is one segment
        return np.zeros(len(t_s), np.int64), 0, 0
    if has_clock:
        dt_s = np.diff(t_s)
        gap = dt_s > max(GAP_FACTOR * float(np.median(dt_s)), GAP_S)
        torn = find_tears(t_s, xyz_m) & ~gap
    else:
        step_m = np.linalg.norm(np.diff(xyz_m, axis=0), axis=1)
        gap = step_m > max(GAP_STEPS * float(np.median(step_m)), GAP_M)
        torn = np.zeros(len(gap), bool)
    apart = gap | torn if part is None else gap | torn | (np.diff(part) != 0)
    segment = np.concatenate(([0], np.cumsum(apart))).astype(np.int64)
    return segment, int(gap.sum()), int(torn.sum())


def _motion(
    t_s: Floats | Ints, epochs: Epochs, segment: Ints, radius_m: float, standing: Flags | None = None
) -> Motion:
    """Return headings and speeds by central differences, one-sided at the ends of a segment."""
    n = len(t_s)
    at = np.arange(n)
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, n - 1)
    before = np.where(segment[before] == segment, before, at)
    after = np.where(segment[after] == segment, after, at)
    lon, lat = epochs.lon, epochs.lat
    azimuth, _, distance_m = map(np.asarray, _GEOD.inv(lon[before], lat[before], lon[after], lat[after]))
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = distance_m / (t_s[after] - t_s[before])
    moves = distance_m > max(STANDING_M, radius_m)
    if standing is not None:
        speed, moves = np.where(standing, 0.0, speed), moves & ~standing
    heading = np.where(moves, azimuth % 360.0, np.nan)
    return Motion(segment, _hold(heading, segment), speed)


def _hold(heading_deg: Floats, segment: Ints) -> Floats:
    """Fill NaN with the last value before it in its segment, else with the first after it."""
    n = len(heading_deg)
    known = ~np.isnan(heading_deg)
    at = np.arange(n)
    last = np.maximum.accumulate(np.where(known, at, -1))
    following = np.minimum.accumulate(np.where(known, at, n)[::-1])[::-1]
    from_last = (last >= 0) & (segment[last] == segment)
    from_next = (following < n) & (segment[np.minimum(following, n - 1)] == segment)
    source = np.where(from_last, last, np.where(from_next, following, at))
    return np.asarray(heading_deg[source], np.float64)


def _numbered(part: Ints) -> Ints:
    """Return the stretches numbered from 0 in their order."""
    return np.concatenate(([0], np.cumsum(np.diff(part) != 0))).astype(np.int64)
