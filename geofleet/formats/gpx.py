"""GPX 1.0 and 1.1: track points, else route points. A track segment is a stretch of its own.

Tracks one after the other are one drive; tracks that were recorded at the same time are of several cars.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from geofleet.errors import InputError
from geofleet.formats.drive_epochs import NO_POSITION, Epochs
from geofleet.formats.xml import iter_elements, root_tag

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

_QUALITY = {"2d": "single", "3d": "single", "pps": "single", "dgps": "dgps"}
_NO_FIX = "none"


def detect(head: bytes) -> bool:
    """Tell whether a file's first bytes are GPX."""
    return root_tag(head).lower() == "gpx"


def read_epochs(path: Path) -> tuple[dict[str, Epochs], dict[str, int], dict[str, int]]:
    """Read every point of the tracks of a file, or of its routes when it has no track.

    `ele` is above sea level: it becomes a height above the ellipsoid where `geoidheight` stands beside it.

    Returns
    -------
    tuple
        The epochs with a position by drive ("" for the only one, else the number of its track), the numbers left out
        by reason, and other counts.

    Raises
    ------
    InputError
        The file is not well-formed, has a document type, or holds no point of a track or route.
    """
    rows = list(_rows(path, "trk", "trkseg", "trkpt")) or list(_rows(path, "rte", "rte", "rtept"))
    if not rows:
        raise InputError("holds no point of a track or route.", where=str(path), todo="Waypoints are no drive.")
    track, part, lat, lon, ele, geoid, text, fix = zip(*rows, strict=True)
    times = pd.to_datetime(pd.Series(text, dtype="string"), format="ISO8601", utc=True, errors="coerce")
    no_fix = np.array([name == _NO_FIX for name in fix], bool)
    epochs = Epochs.of(
        np.where(no_fix, np.nan, lon),
        np.where(no_fix, np.nan, lat),
        t_utc=times.dt.tz_localize(None).to_numpy("datetime64[us]"),
        height_m=np.array(ele, np.float64) + np.array(geoid, np.float64),
        quality=np.array([_QUALITY.get(name) for name in fix], object),
        part=np.array(part, np.int64),
    )
    placed = epochs.is_placed()
    if not placed.any():
        raise InputError("no point has a valid position.", where=str(path), todo="Export the track again.")
    n_low = int((~np.isnan(np.array(ele, np.float64)) & np.isnan(epochs.height_m)).sum())
    unread = int(times.isna().sum()) - sum(not value for value in text)
    found = {"heights above sea level, not taken": n_low, "times that cannot be read": unread}
    skipped = {NO_POSITION: int((~placed).sum())}
    drives, n_again = _by_car(epochs.take(placed), np.array(track, np.int64)[placed])
    skipped |= {"points that an earlier track has": n_again} if n_again else {}
    return drives, skipped, {name: count for name, count in found.items() if count}


def _by_car(epochs: Epochs, track: NDArray[np.int64]) -> tuple[dict[str, Epochs], int]:
    """Return every track as a drive when some of them overlap in time, else all as one; and how many points are copies.

    The same points again, as some programs write them, are no second car.
    """
    points = pd.DataFrame({"t": epochs.t_utc, "lon": epochs.lon, "lat": epochs.lat, "track": track})
    copy = points.duplicated(["t", "lon", "lat"]) & ~points.duplicated() & points["t"].notna()
    own = ~copy.to_numpy(bool)
    epochs, track = epochs.take(own), track[own]
    span = points[own].groupby("track")["t"].agg(["min", "max"]).dropna().sort_values("min")
    overlap = span["min"].to_numpy()[1:] < span["max"].cummax().to_numpy()[:-1]
    drives = {"": epochs}
    if overlap.any():
        drives = {str(number + 1): epochs.take(track == number) for number in np.unique(track).tolist()}
    return drives, int((~own).sum())


def _rows(
    path: Path, track: str, stretch: str, point: str
) -> Iterator[tuple[int, int, float, float, float, float, str | None, str]]:
    """Yield track, stretch, latitude, longitude, elevation, geoid's height, time and kind of fix of every point."""
    tracks = iter_elements(path, (track,), root="gpx", without=("extensions",))
    parts = ((number, part) for number, element in enumerate(tracks) for part in element.iter(stretch))
    for number, (of_track, element) in enumerate(parts):
        for one in element.iter(point):
            own = {child.tag: (child.text or "").strip() for child in one}
            yield (
                of_track,
                number,
                _number(one.get("lat")),
                _number(one.get("lon")),
                _number(own.get("ele")),
                _number(own.get("geoidheight")),
                own.get("time") or None,
                own.get("fix", "").lower(),
            )


def _number(text: str | None) -> float:
    try:
        value = float(text or "")
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan
