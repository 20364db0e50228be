"""Speed of the simulator, side by side with a plain loop: KD-tree for the view, scipy's Hungarian for the tracks.

    python benchmarks/simulate.py                 # kernels beside the plain loop, growth, memory
    python benchmarks/simulate.py --passes 200    # and the whole step, tables written, with this many passes

Both sides do the same work on the same noise: signs in view of every frame, measured, projected, tracked by exact
assignment with the paper's rules. Their tracks must be equal, or nothing is printed. Signs are real (© OpenStreetMap
contributors, ODbL), the drive is derived, detections are simulated.
"""

from __future__ import annotations

import argparse
import resource
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from geofleet.algorithms.kalman import track_kalman
from geofleet.algorithms.sensing_chain import sense_pass
from geofleet.algorithms.streams import pass_streams
from geofleet.algorithms.tracking import TrackerModel, track_paper
from geofleet.config import load_config
from geofleet.formats.layers import read_layer
from geofleet.steps.ingest import ingest_drive, ingest_signs
from geofleet.steps.simulate import simulate
from geofleet.tables.fleets import Fleet, load_fleet

if TYPE_CHECKING:
    from collections.abc import Callable

    from geofleet.algorithms.sensing import FrameDetections
    from geofleet.algorithms.trajectory import Poses

RAW = Path(__file__).parent.parent / "data" / "raw"
FORBIDDEN = 1e6


def plain_view(poses: Poses, fleet: Fleet) -> list[tuple[int, int, float, float]]:
    """Return frame, sign, range and bearing of all signs in view, frame by frame through a KD-tree."""
    sensor, xy_m = fleet.kinds[0].sensor, fleet.scene.field.xy_m
    tree = cKDTree(xy_m)
    rows = []
    for frame in range(len(poses.heading_rad)):
        for sign in sorted(tree.query_ball_point(poses.xy_m[frame], sensor.range_m)):
            step = xy_m[sign] - poses.xy_m[frame]
            bearing = np.arctan2(step[1], step[0]) - poses.heading_rad[frame]
            bearing = np.arctan2(np.sin(bearing), np.cos(bearing))
            distance = np.hypot(*step)
            if distance < sensor.range_m and abs(bearing) < sensor.half_fov_rad:
                rows.append((frame, sign, distance, bearing))
    return rows


def plain_tracks(seen: FrameDetections, poses: Poses, model: TrackerModel) -> np.ndarray:
    """Track frame by frame: Euclidean costs, pairs beyond the gate forbidden, scipy's Hungarian method."""
    track = np.full(len(seen.frame), -1)
    last_row: list[int] = []
    live: list[int] = []
    start = np.searchsorted(seen.frame, np.arange(seen.n_frames + 1))
    for frame in range(seen.n_frames):
        live = [t for t in live if frame - seen.frame[last_row[t]] - 1 <= model.max_missed_frames]
        rows = np.arange(start[frame], start[frame + 1])
        if live and len(rows):
            distance = cdist(seen.xy_m[[last_row[t] for t in live]], seen.xy_m[rows])
            allowed = distance < model.track_gate_m
            for k, j in zip(*linear_sum_assignment(np.where(allowed, distance, FORBIDDEN)), strict=True):
                if allowed[k, j]:
                    track[rows[j]] = live[k]
                    last_row[live[k]] = int(rows[j])
        for i in rows[track[rows] < 0]:
            track[i] = len(last_row)
            live.append(len(last_row))
            last_row.append(int(i))
        if model.end_on_leaving_view:
            live = [
                t for t in live if last_row[t] >= start[frame] or plain_in_cone(seen, last_row[t], poses, frame, model)
            ]
    return track


def plain_in_cone(seen: FrameDetections, row: int, poses: Poses, frame: int, model: TrackerModel) -> bool:
    """Return whether a track's last place is in the view cone of the reported pose."""
    step = seen.xy_m[row] - poses.xy_m[frame]
    bearing = np.arctan2(step[1], step[0]) - poses.heading_rad[frame]
    bearing = np.arctan2(np.sin(bearing), np.cos(bearing))
    return bool(np.hypot(*step) < model.range_m and abs(bearing) < model.half_fov_rad)


def timed(work: Callable[[], object], least_s: float = 1.0) -> float:
    """Return the least seconds of a call, over as many calls as fill a second, after one to compile.

    The least, because others may work on the machine.
    """
    work()
    begin, least = perf_counter(), np.inf
    while perf_counter() - begin < least_s:
        start = perf_counter()
        work()
        least = min(least, perf_counter() - start)
    return least


def compare(fleet: Fleet) -> None:
    """Print ours beside the plain loop on one pass, and ours on two threads."""
    kind, field = fleet.kinds[0], fleet.scene.field
    streams = pass_streams(0, replicate=0, vehicle=0)
    true = fleet.start(0, streams).true
    sensed = sense_pass(true, field, kind.sensor, streams)
    seen, reported = sensed.detections, sensed.reported
    n = len(seen.frame)

    def ours() -> None:
        again = pass_streams(0, replicate=0, vehicle=0)
        out = sense_pass(true, field, kind.sensor, again)
        track_paper(out.detections, out.reported, kind.tracker)

    def plain() -> None:
        plain_view(true, fleet)
        plain_tracks(seen, reported, kind.tracker)

    view = plain_view(true, fleet)
    assert [row[:2] for row in sorted(view)] == sorted(
        zip(sensed.in_view.frame.tolist(), sensed.in_view.sign.tolist(), strict=True)
    )
    np.testing.assert_array_equal(plain_tracks(seen, reported, kind.tracker), track_paper(seen, reported, kind.tracker))
    plain_s, ours_s = timed(plain), timed(ours)
    print(f"one pass: {len(true.heading_rad)} frames, {n} frame detections; equal views and tracks")
    print(f"  plain loop (view and tracks alone)   {plain_s * 1e3:8.2f} ms   {n / plain_s / 1e6:6.3f} M detections/s")
    print(f"  geofleet (noise and classes as well) {ours_s * 1e3:8.2f} ms   {n / ours_s / 1e6:6.3f} M detections/s")
    print(f"  ratio {plain_s / ours_s:.1f}x")
    tracker_s = timed(lambda: track_paper(seen, reported, kind.tracker))
    kalman_s = timed(lambda: track_kalman(seen, reported, kind.tracker))
    with ThreadPoolExecutor(2) as pool:
        two_s = timed(lambda: list(pool.map(lambda _: ours(), range(64)))) / 64
    print(f"  two threads, sense and track         {two_s * 1e3:8.2f} ms   {n / two_s / 1e6:6.3f} M detections/s")
    print(f"  tracker alone: paper {n / tracker_s / 1e6:.2f} M, kalman {n / kalman_s / 1e6:.3f} M detections/s a core")


def whole_step(folder: Path, scenario: str, n_passes: int) -> None:
    """Print what the step costs at three sizes of fleet, tables written."""
    print("whole step, tables written:")
    for n in (n_passes // 4, n_passes // 2, n_passes):
        begin = perf_counter()
        result = simulate(
            *(folder / "signs.parquet", folder / "drive.parquet", folder / f"out-{n}"),
            config=load_config(scenario),
            n_vehicles=n,
        )
        took = perf_counter() - begin
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        rate = result.n_frame_detections / took / 1e6
        print(f"  {n:6d} passes  {took:6.1f} s  {rate:.2f} M frame detections/s  peak {peak:.0f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--passes", type=int, default=0)
    args = parser.parse_args()
    with TemporaryDirectory() as name:
        folder = Path(name)
        ingest_signs([RAW / "helsinki.osm.pbf"], folder / "signs.parquet")
        ingest_drive([RAW / "helsinki_derived.pos"], folder / "drive.parquet")
        signs = folder / "signs.parquet"
        compare(
            load_fleet(
                read_layer(signs).table, folder / "drive.parquet", source=signs, config=load_config(args.scenario)
            )
        )
        if args.passes:
            whole_step(folder, args.scenario, args.passes)


if __name__ == "__main__":
    main()
