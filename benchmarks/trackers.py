"""How often tracks split or swap, and which ghosts get past the tracker: a table of docs/paper.md.

    python benchmarks/trackers.py --passes 30 --seed 1000

*split*: share of the signs seen that more than one sent track of a pass stands for. *purity*: share of the frames of
tracks on poles with two plates or more that come from the main sign of their track. *ghosts*: sent tracks a km of which
most frames come from no sign, at the ghost rate of the scenario, at ten times that, and with one lasting ghost a km
(`ghost_tracks_per_km`) beside. Signs and roads are real (© OpenStreetMap contributors, ODbL), the drives derived, the
detections simulated.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from geofleet.algorithms.kalman import track_kalman
from geofleet.algorithms.sensing_chain import sense_pass
from geofleet.algorithms.streams import pass_streams
from geofleet.algorithms.tracking import track_ideal, track_paper, track_pass
from geofleet.config import load_config
from geofleet.formats.layers import read_drives, read_layer
from geofleet.steps.ingest import ingest_signs
from geofleet.tables.fleets import Fleet, load_fleet

if TYPE_CHECKING:
    from geofleet.algorithms.sensing import FrameDetections

RAW = Path(__file__).resolve().parents[1] / "data" / "raw"
DRIVES = {"demo drive": "helsinki_derived.pos", "second drive": "helsinki_derived_b.pos"}
SCENARIOS = ("paper", "paper-50m", "paper-ideal")
TRACKERS = ("paper", "kalman", "ideal")
SAME_POLE_M = 1.0


class Counts(NamedTuple):
    """Signs seen, those split, frames on poles, those of the main sign of their track."""

    n_signs: int
    n_split: int
    n_frames: int
    n_pure: int


def count(seen: FrameDetections, track: np.ndarray, poles: np.ndarray, least_frames: int) -> Counts:
    """Count what the sent tracks of a pass stand for."""
    n_signs = len(poles)
    frames = np.zeros((int(track.max()) + 1, n_signs + 1), dtype=np.int64)
    np.add.at(frames, (track, np.where(seen.sign < 0, n_signs, seen.sign)), 1)
    frames = frames[frames.sum(axis=1) >= least_frames]
    main = frames.argmax(axis=1)
    tracks_of = np.bincount(main, minlength=n_signs + 1)[:n_signs]
    on_pole = np.append(poles, False)[main]  # a ghost is on none
    return Counts(
        int((tracks_of > 0).sum()),
        int((tracks_of > 1).sum()),
        int(frames[on_pole].sum()),
        int(frames[on_pole].max(axis=1, initial=0).sum()),
    )


def front_end(fleet: Fleet, tracker: str, n_passes: int, seed: int) -> tuple[float, float]:
    """Return split and purity over the first passes of a run."""
    kind, field = fleet.kinds[0], fleet.scene.field
    poles = np.zeros(len(field.xy_m), dtype=bool)
    poles[cKDTree(field.xy_m).query_pairs(SAME_POLE_M, output_type="ndarray").ravel()] = True
    rows = []
    for vehicle in range(n_passes):
        streams = pass_streams(seed, replicate=0, vehicle=vehicle)
        sensed = sense_pass(fleet.start(vehicle, streams).true, field, kind.sensor, streams)
        seen, reported = sensed.detections, sensed.reported
        if tracker == "ideal":
            track = track_ideal(seen)
        else:
            track = (track_paper if tracker == "paper" else track_kalman)(seen, reported, kind.tracker)
        rows.append(count(seen, track, poles, kind.tracker.min_track_frames))
    total = Counts(*np.sum(rows, axis=0).tolist())
    return total.n_split / total.n_signs, total.n_pure / total.n_frames


def ghosts_per_km(fleet: Fleet, n_passes: int, seed: int) -> float:
    """Return the sent tracks that came from no sign, a km driven."""
    kind, n_ghosts = fleet.kinds[0], 0
    for vehicle in range(n_passes):
        streams = pass_streams(seed, replicate=0, vehicle=vehicle)
        sensed = sense_pass(fleet.start(vehicle, streams).true, fleet.scene.field, kind.sensor, streams)
        n_ghosts += int((track_pass(sensed.detections, sensed.reported, kind.tracker, streams).sign < 0).sum())
    return n_ghosts / (n_passes * fleet.length_m / 1000)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--passes", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1000)
    args = parser.parse_args()
    with TemporaryDirectory() as name:
        signs = Path(name) / "signs.parquet"
        ingest_signs([RAW / "helsinki.osm.pbf"], signs)
        layer = read_layer(signs).table
        for title, file in DRIVES.items():
            drive = RAW / file
            driven = read_drives(drive).table
            print(f"{title}, {args.passes} passes, seed {args.seed}")
            print("scenario      tracker   split   purity   ghosts a km: as it is   x10   one lasting a km")
            for scenario in SCENARIOS:
                plain = load_config(scenario)
                rate = plain.sensor.ghost_rate_per_ha
                for tracker in TRACKERS:
                    fleets = [
                        load_fleet(
                            *(layer, driven),
                            source=signs,
                            drive=drive,
                            config=load_config(scenario, {"tracker": tracker} | extra),
                        )
                        for extra in ({}, {"ghost_rate_per_ha": 10 * rate}, {"ghost_tracks_per_km": 1.0})
                    ]
                    split, purity = front_end(fleets[0], tracker, args.passes, args.seed)
                    ghosts = "   ".join(f"{ghosts_per_km(fleet, args.passes, args.seed):6.2f}" for fleet in fleets)
                    print(f"{scenario:12s}  {tracker:7s}  {split:6.1%}   {purity:.3f}   {ghosts}", flush=True)


if __name__ == "__main__":
    main()
