"""Trajectories as `drives`: solutions of RTKLIB (`.pos`) in every variant of header and time that it writes.

Times become UTC (GPS time is ahead by the leap seconds of its day), gaps start a segment, duplicate epochs and
impossible jumps are left out and counted, heading and speed come from the motion.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from pyproj import Geod

from geofleet.errors import InputError
from geofleet.formats.reading import LayerRead, read_head
from geofleet.formats.rtklib import detect, read_epochs
from geofleet.tables.schemas import DRIVES, TIME
from geofleet.tables.store import build_table

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.formats.rtklib import Epochs

    Floats = NDArray[np.float64]
    Flags = NDArray[np.bool_]

__all__ = ["FORMAT", "detect", "read_drive"]

FORMAT = "rtklib"
GAP_FACTOR = 2.5  # one epoch may be missing, two make a gap
GAP_S = 0.5
STANDING_M = 0.3
JUMP_M = 10.0
JUMP_MPS2 = 20.0
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
        Over the neighbouring epochs; NaN in a segment of one epoch, shape (n,).
    """

    segment: NDArray[np.int64]
    heading_deg: Floats
    speed_mps: Floats


def read_drive(path: Path) -> LayerRead:
    """Read an RTKLIB solution as one drive.

    Raises
    ------
    InputError
        The file is missing, empty, not an RTKLIB solution, a baseline solution, or holds no epoch with a position.
    """
    if not detect(read_head(path)):
        raise InputError(
            "not an RTKLIB solution.",
            where=str(path),
            todo="Give a .pos file with latitude, longitude and height.",
        )
    epochs, skipped = read_epochs(path)
    order = np.argsort(epochs.t_utc, kind="stable")
    epochs = epochs.take(order)
    again = np.concatenate(([False], epochs.t_utc[1:] == epochs.t_utc[:-1]))
    epochs = epochs.take(~again)
    jump = jumps(epochs.seconds(), epochs.lon, epochs.lat)
    epochs = epochs.take(~jump)
    motion = motion_of(epochs.seconds(), epochs.lon, epochs.lat)
    skipped |= {"duplicate epochs": int(again.sum()), "impossible jumps": int(jump.sum())}
    found = {
        "epochs out of order": int((np.diff(order) < 0).sum()),
        "gaps": int(motion.segment[-1]),
        "epochs standing still": int((motion.speed_mps < STANDING_M).sum()),
    }
    table = build_table(DRIVES, _columns(epochs, motion, path), (epochs.lon, epochs.lat))
    return LayerRead(table, FORMAT, {reason: n for reason, n in skipped.items() if n}, found)


def motion_of(t_s: Floats, lon: Floats, lat: Floats) -> Motion:
    """Derive segments, headings and speeds from times (seconds, ascending) and positions (degrees)."""
    n = len(t_s)
    dt_s = np.diff(t_s)
    usual_s = float(np.median(dt_s)) if n > 1 else 0.0
    segment = np.concatenate(([0], np.cumsum(dt_s > max(GAP_FACTOR * usual_s, GAP_S)))).astype(np.int64)
    # Central differences, one-sided at the ends of a segment.
    at = np.arange(n)
    before, after = np.maximum(at - 1, 0), np.minimum(at + 1, n - 1)
    before = np.where(segment[before] == segment, before, at)
    after = np.where(segment[after] == segment, after, at)
    azimuth, _, distance_m = _GEOD.inv(lon[before], lat[before], lon[after], lat[after])
    elapsed_s = t_s[after] - t_s[before]
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = np.asarray(distance_m) / elapsed_s
    heading = np.where(np.asarray(distance_m) > STANDING_M, np.asarray(azimuth) % 360.0, np.nan)
    return Motion(segment, _hold(heading, segment), speed)


def jumps(t_s: Floats, lon: Floats, lat: Floats) -> Flags:
    """Tell which single epochs lie where no car can have been between their neighbours.

    An epoch is a jump when it stands off the line between its neighbours by more than `JUMP_M` and more than
    `JUMP_MPS2` could bring about in that time, and more than theirs do.
    """
    n = len(t_s)
    found = np.zeros(n, bool)
    if n < 3:  # noqa: PLR2004 - a jump needs two neighbours
        return found
    share = (t_s[1:-1] - t_s[:-2]) / (t_s[2:] - t_s[:-2])
    middle_lon = lon[:-2] + share * (lon[2:] - lon[:-2])
    middle_lat = lat[:-2] + share * (lat[2:] - lat[:-2])
    _, _, off_m = _GEOD.inv(middle_lon, middle_lat, lon[1:-1], lat[1:-1])
    allowed_m = np.maximum(JUMP_M, JUMP_MPS2 / 2 * (t_s[1:-1] - t_s[:-2]) * (t_s[2:] - t_s[1:-1]))
    off = np.concatenate(([0.0], np.asarray(off_m), [0.0]))
    found[1:-1] = (off[1:-1] > allowed_m) & (off[1:-1] > off[:-2]) & (off[1:-1] >= off[2:])
    return found


def _hold(heading_deg: Floats, segment: NDArray[np.int64]) -> Floats:
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


def _columns(epochs: Epochs, motion: Motion, path: Path) -> dict[str, object]:
    return {
        "drive_id": path.stem,
        "seq": np.arange(len(epochs.lon)),
        "t_utc": pa.array(epochs.t_utc, TIME),
        "height_m": epochs.height_m,
        "heading_deg": motion.heading_deg,
        "speed_mps": motion.speed_mps,
        "fix_quality": epochs.quality,
        "sigma_e_m": epochs.sigma_e_m,
        "sigma_n_m": epochs.sigma_n_m,
        "segment": motion.segment,
        "source": path.name,
    }
