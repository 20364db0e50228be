r"""Derive a drive from a map that comes without one: along the lanes of a road map, or past the signs of a street.

Nobody drove it. Along lanes, the longest line is followed to both ends through lines that go on where it stops. Past
signs, the signs of a street are put in order along it, and the middle between its two sides, smoothed, is moved to the
right carriageway. Both are written as a `drives` table of quality `derived`, at a constant speed and without times.

    python scripts/derive_map_drive.py ../shared/data/opendrive/a9_nord_excerpt_bssd.xodr drive.parquet
    python scripts/derive_map_drive.py ../shared/data/inventory/hansbeke_traffic-signs.geojson drive.parquet \
        --street Vaartstraat
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import shapely
from scipy.ndimage import gaussian_filter1d

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.steps.ingest import ingest_lanes
from geofleet.tables.schemas import DRIVES, LANES
from geofleet.tables.store import build_table, read_table, write_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

JOIN_M = 1.0
SHARPEST_TURN_RAD = np.deg2rad(60)
SMOOTHING_M = 40.0
CARRIAGEWAY_M = 1.75


def along_lanes(lines: list[Floats]) -> Floats:
    """Return the longest of some lines, (n, 2) metres each, extended to both ends by lines that go on there."""
    left = sorted(lines, key=_length, reverse=True)
    way = left.pop(0)
    for _ in range(2):
        while (following := _next(way, left)) is not None:
            way = np.concatenate((way, following[1:]))
        way = way[::-1]
    return way


def _next(way: Floats, left: list[Floats]) -> Floats | None:
    """Take from the lines left the longest that begins where the way ends, without a sharp turn, either way round."""
    ahead = way[-1] - way[-2]
    for k, line in enumerate(left):
        for candidate in (line, line[::-1]):
            step = candidate[1] - candidate[0]
            turn = np.arctan2(ahead[0] * step[1] - ahead[1] * step[0], ahead @ step)
            if np.hypot(*(candidate[0] - way[-1])) < JOIN_M and abs(turn) < SHARPEST_TURN_RAD:
                left.pop(k)
                return candidate
    return None


def past_signs(xy_m: Floats) -> Floats:
    """Return a way past the signs of a street: their order along its axis, smoothed, on the right carriageway."""
    centred = xy_m - xy_m.mean(axis=0)
    axis = np.linalg.svd(centred, full_matrices=False)[2][0]
    side = np.array([-axis[1], axis[0]])
    along, order = np.unique(centred @ axis, return_index=True)
    grid = np.arange(along[0] - 30, along[-1] + 30)  # a car comes from before the first sign
    across = gaussian_filter1d(np.interp(grid, along, (centred @ side)[order]), SMOOTHING_M, mode="nearest")
    way: Floats = xy_m.mean(axis=0) + grid[:, None] * axis + (across - CARRIAGEWAY_M)[:, None] * side
    return way


def write_drive(out: Path, frame: EnuFrame, way: Floats, *, name: str, source: str) -> None:
    """Write a way as a `drives` table."""
    columns = {"drive_id": name, "seq": np.arange(len(way)), "segment": np.zeros(len(way), dtype=np.int64)}
    columns |= {"source": source, "fix_quality": "derived"}
    write_table(DRIVES, build_table(DRIVES, columns, geometry=frame.to_lonlat(way)), out)


def derive(map_path: Path, out: Path, street: str | None = None) -> None:
    """Derive a drive from a road map, or from the signs of a street in a GeoJSON inventory with a property `street`."""
    if street is None:
        with tempfile.TemporaryDirectory() as folder:
            ingest_lanes([map_path], Path(folder) / "lanes.parquet")
            table = read_table(LANES, Path(folder) / "lanes.parquet")
        lines = [shapely.get_coordinates(line) for line in shapely.from_wkb(table["geometry"].to_numpy(False))]  # noqa: FBT003 - Arrow's signature
        frame = EnuFrame.around(*np.concatenate(lines).T)
        way = along_lanes([frame.to_enu(*line.T) for line in lines if len(line) > 1])
    else:
        signs = json.loads(map_path.read_text(encoding="utf-8"))["features"]
        lonlat = np.array([s["geometry"]["coordinates"] for s in signs if s["properties"]["street"] == street])
        frame = EnuFrame.around(*lonlat.T)
        way = past_signs(frame.to_enu(*lonlat.T))
    write_drive(out, frame, way, name=street or map_path.stem, source=f"derived from {map_path.name}")


def _length(line: Floats) -> float:
    return float(np.hypot(*np.diff(line, axis=0).T).sum())


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--street")
    arguments = parser.parse_args()
    derive(arguments.map, arguments.out, arguments.street)
