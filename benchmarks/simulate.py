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
from time import perf_counter, process_time
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from geofleet.algorithms.kalman import track_kalman
from geofleet.algorithms.sensing_chain import sense_passes
from geofleet.algorithms.streams import pass_streams
from geofleet.algorithms.tracking import TrackerModel, track_paper
from geofleet.config import load_config
from geofleet.formats.layers import read_drives, read_layer
from geofleet.steps.ingest import ingest_drive, ingest_signs
from geofleet.steps.simulate import simulate
from geofleet.tables.fleets import Fleet, load_fleet

if TYPE_CHECKING:
    from collections.abc import Callable

    from geofleet.algorithms.sensing import FrameDetections, PassSensing
    from geofleet.algorithms.streams import PassStreams
    from geofleet.algorithms.trajectory import Poses

RAW = Path(__file__).parent.parent / "data" / "raw"
FORBIDDEN = 1e6
A_BATCH = 10


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


class Timing(NamedTuple):
    """The least wall time of a call, the least CPU time of one, and how many cores the fastest call had."""

    wall_s: float
    cpu_s: float
    n_cores: float

    def line(self, name: str, n_detections: int) -> str:
        """Return the rates of so many detections a call."""
        a_second, a_cpu_second = n_detections / self.wall_s / 1e6, n_detections / self.cpu_s / 1e6
        rates = f"{a_second:7.3f} M a second  {a_cpu_second:7.3f} M a CPU second"
        return f"  {name:<38}{rates}  ({self.n_cores:.1f} cores busy)"


def timed(work: Callable[[], object], least_s: float = 2.0) -> Timing:
    """Return the least seconds of a call, over as many calls as fill two seconds, after one to compile.

    The least, because others may work on the machine.
    """
    work()
    begin, best, cpu_s = perf_counter(), (np.inf, 0.0), np.inf
    while perf_counter() - begin < least_s:
        start, start_cpu = perf_counter(), process_time()
        work()
        took, took_cpu = perf_counter() - start, process_time() - start_cpu
        best, cpu_s = min(best, (took, took_cpu)), min(cpu_s, took_cpu)
    return Timing(best[0], cpu_s, best[1] / best[0])


def compare(fleet: Fleet) -> None:
    """Print ours beside the plain loop, on one core and on two."""
    kind, field = fleet.kinds[0], fleet.scene.field

    def streams() -> list[PassStreams]:
        return [pass_streams(0, replicate=0, vehicle=vehicle) for vehicle in range(A_BATCH)]

    true = [fleet.start(vehicle, own).true for vehicle, own in enumerate(streams())]

    def ours(_: int = 0) -> PassSensing:
        out = sense_passes(true, field, kind.sensor, streams())
        track_paper(out.detections, out.reported, kind.tracker)
        return out

    def plain() -> None:
        plain_view(true[0], fleet)
        plain_tracks(seen, reported, kind.tracker)

    alone = sense_passes(true[:1], field, kind.sensor, streams()[:1])
    seen, reported = alone.detections, alone.reported
    assert [row[:2] for row in sorted(plain_view(true[0], fleet))] == sorted(
        zip(alone.in_view.frame.tolist(), alone.in_view.sign.tolist(), strict=True)
    )
    np.testing.assert_array_equal(plain_tracks(seen, reported, kind.tracker), track_paper(seen, reported, kind.tracker))
    n, batch = len(seen.frame), ours()
    many, said = batch.detections, batch.reported
    n_many = len(many.frame)
    print(f"one pass: {len(true[0].heading_rad)} frames, {n} frame detections; equal views and tracks")
    by_loop, by_us = timed(plain), timed(ours)
    print(by_loop.line("plain loop (view and tracks alone)", n))
    print(by_us.line("geofleet (noise and classes as well)", n_many))
    print(f"  ratio in CPU time {by_loop.cpu_s / n * n_many / by_us.cpu_s:.1f}x")
    with ThreadPoolExecutor(2) as pool:
        two = timed(lambda: list(pool.map(ours, range(16))))
    print(two.line("two threads, sense and track", 16 * n_many))
    print(timed(lambda: track_paper(many, said, kind.tracker)).line("paper's tracker alone", n_many))
    print(timed(lambda: track_kalman(many, said, kind.tracker)).line("Kalman tracker alone", n_many))


def whole_step(folder: Path, scenario: str, n_passes: int) -> None:
    """Print what the step costs at three sizes of fleet, tables written."""
    print("whole step, tables written:")
    for n in (n_passes // 4, n_passes // 2, n_passes):
        begin, begin_cpu = perf_counter(), process_time()
        result = simulate(
            *(folder / "signs.parquet", folder / "drive.parquet", folder / "out"),
            config=load_config(scenario),
            n_vehicles=n,
        )
        took, cpu_s = perf_counter() - begin, process_time() - begin_cpu
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        n_millions = result.n_frame_detections / 1e6
        print(
            f"  {n:6d} passes  {took:6.1f} s  {cpu_s:6.1f} CPU s  {n_millions / took:.2f} M frame detections a second  "
            f"{n_millions / cpu_s:.2f} M a CPU second  peak {peak:.0f} MB"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="paper")
    parser.add_argument("--passes", type=int, default=0)
    args = parser.parse_args()
    with TemporaryDirectory() as name:
        folder = Path(name)
        ingest_signs([RAW / "helsinki.osm.pbf"], folder / "signs.parquet")
        ingest_drive([RAW / "helsinki_derived.pos"], folder / "drive.parquet")
        signs, drive = folder / "signs.parquet", folder / "drive.parquet"
        layer, driven = read_layer(signs).table, read_drives(drive).table
        compare(load_fleet(layer, driven, source=signs, drive=drive, config=load_config(args.scenario)))
        if args.passes:
            whole_step(folder, args.scenario, args.passes)


if __name__ == "__main__":
    main()
