"""What can be said of each drive in a `drives` table: how long, how far, how well fixed, where it is broken."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyarrow.compute as pc
from pyproj import Geod

from geofleet.tables.store import lonlat

if TYPE_CHECKING:
    import pyarrow as pa

_GEOD = Geod(ellps="WGS84")
_US_PER_S = 1e6


@dataclass(frozen=True, slots=True)
class DriveInfo:
    """One drive.

    Parameters
    ----------
    drive_id
        Its name.
    n_epochs, n_segments
        Epochs, and stretches without a gap, in the table.
    t_first, t_last
        UTC, ISO 8601; None when the file has no clock.
    duration_s, longest_gap_s
        Between the first and the last epoch, and the longest time between two segments, s; None without times.
    length_m
        Along the ellipsoid from epoch to epoch, gaps left out, m.
    fix_quality
        Epochs of each quality, most first.
    """

    drive_id: str
    n_epochs: int
    n_segments: int
    t_first: str | None
    t_last: str | None
    duration_s: float | None
    longest_gap_s: float | None
    length_m: float
    fix_quality: dict[str, int]


def drives_in(drives: pa.Table) -> list[DriveInfo]:
    """Return what can be said of each drive of a `drives` table, in the order of their names."""
    names = pc.unique(drives["drive_id"]).to_pylist()
    return [_drive(drives.filter(pc.equal(drives["drive_id"], name))) for name in sorted(names)]


def _drive(epochs: pa.Table) -> DriveInfo:
    lon, lat = lonlat(epochs)
    segment = epochs["segment"].to_numpy()
    joined = np.diff(segment) == 0
    _, _, step_m = _GEOD.inv(lon[:-1], lat[:-1], lon[1:], lat[1:])
    times = epochs["t_utc"]
    t_s = times.cast("int64").to_numpy().astype(np.float64) / _US_PER_S if not times.null_count else None
    gap_s = np.diff(t_s)[~joined] if t_s is not None else np.zeros(0)
    quality = Counter(name or "unknown" for name in epochs["fix_quality"].to_pylist())
    return DriveInfo(
        drive_id=epochs["drive_id"][0].as_py(),
        n_epochs=epochs.num_rows,
        n_segments=len(np.unique(segment)),
        t_first=times[0].as_py().isoformat() if t_s is not None else None,
        t_last=times[-1].as_py().isoformat() if t_s is not None else None,
        duration_s=float(t_s[-1] - t_s[0]) if t_s is not None else None,
        longest_gap_s=float(gap_s.max()) if len(gap_s) else None,
        length_m=float(np.asarray(step_m)[joined].sum()),
        fix_quality=dict(quality.most_common()),
    )
