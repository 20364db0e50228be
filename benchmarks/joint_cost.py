"""Time and memory of joint fusion on made tracks: 33 signs a kilometre, all in view of every pass."""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from typing import Any

import numpy as np

from geofleet.algorithms.joint import fuse_joint
from geofleet.algorithms.joint_tracks import UNKNOWN_FRAME, Passes, Tracks, tracks_of_means

SIZES = ((33, 50), (33, 500), (330, 50), (1000, 50), (1000, 100), (1000, 200), (1000, 500))
SPACING_M = 30.0
N_CLASSES = 14
REPORTED, MISREAD = 0.9, 0.05


def fleet(n_signs: int, n_passes: int) -> tuple[Tracks, Passes]:
    """Return tracks of every sign by every pass, one in ten missing, one in twenty misread."""
    rng = np.random.default_rng(0)
    sign_xy = np.column_stack((SPACING_M * np.arange(n_signs), rng.choice([-5.0, 5.0], n_signs)))
    sign_xy += rng.normal(0, 3.0, sign_xy.shape)
    classes = rng.integers(0, N_CLASSES, n_signs)
    code, sign = np.nonzero(rng.random((n_passes, n_signs)) < REPORTED)
    n = len(code)
    offset, bias = rng.normal(0, 1.3, (n_passes, 2)), rng.normal(0, 1, (n_passes, 2)) * [2.9, np.radians(3.7)]
    reach = rng.uniform(15, 60, n)
    xy = sign_xy[sign] + offset[code] + rng.normal(0, 0.2, (n, 2))
    xy += np.column_stack((bias[code, 0], reach * bias[code, 1]))  # looking east
    matrix, vector = tracks_of_means(
        xy,
        n_frames=np.full(n, 20.0),
        spread=np.full((n, 3), np.nan),
        range_m=reach,
        azimuth_rad=np.zeros(n),
        bias_sigma=np.zeros((n, 2)),
    )
    read = np.where(rng.random(n) < MISREAD, rng.integers(0, N_CLASSES, n), classes[sign])
    none, zero = np.full(n, UNKNOWN_FRAME), np.zeros(n)
    tracks = Tracks(code, read, xy, matrix, vector, none, none, zero, zero)
    declared = np.tile([2.9, np.radians(3.7)], (n_passes, 1))
    return tracks, Passes(np.full(n_passes, 1.3), declared, np.zeros(n_passes, np.int64))


def measure_cost() -> list[dict[str, Any]]:
    """Return seconds and peak memory of every size, each in a process of its own."""
    rows = []
    for n_signs, n_passes in SIZES:
        command = [sys.executable, __file__, str(n_signs), str(n_passes)]
        said = subprocess.run(command, check=True, capture_output=True, text=True).stdout  # noqa: S603 - ourselves
        row = dict(
            zip(
                ("tracks", "seconds", "cpu_seconds", "peak_mb", "rounds", "settled", "found"),
                map(float, said.split()),
                strict=True,
            )
        )
        rows.append({"signs": n_signs, "passes": n_passes, **row})
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    n_signs, n_passes = map(int, sys.argv[1:])
    fuse_joint(*fleet(10, 5), n_classes=N_CLASSES)  # compiled
    tracks, passes = fleet(n_signs, n_passes)
    began, cpu = time.perf_counter(), time.process_time()
    fused = fuse_joint(tracks, passes, n_classes=N_CLASSES)
    took, cpu = time.perf_counter() - began, time.process_time() - cpu
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(
        len(tracks.pass_code),
        took,
        cpu,
        peak_mb,
        fused.n_rounds,
        int(fused.is_settled),
        int((fused.n_passes > n_passes / 2).sum()),
    )


if __name__ == "__main__":
    main()
