"""Passes that are simulated together: each draws, sees and sends what it does alone."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from geofleet.algorithms.billboards import Billboards
from geofleet.algorithms.information import Information, PolarNoise
from geofleet.algorithms.sensing import SignField
from geofleet.algorithms.sensing_chain import sense_pass, sense_passes
from geofleet.algorithms.sensing_kernels import by_frame
from geofleet.algorithms.sensor_model import SensorModel
from geofleet.algorithms.streams import PassesRandom, pass_streams
from geofleet.algorithms.tracking import TrackerModel, track_pass, track_passes
from geofleet.algorithms.trajectory import Poses

PLAIN = SensorModel(
    *(100.0, 60.0),
    gnss_sigma_m=1.7,
    range_bias_sigma_m=2.4,
    bearing_bias_sigma_deg=1.2,
    range_noise_sigma_m=0.3,
    bearing_noise_sigma_deg=0.2,
    false_negative_rate=0.1,
    semantic_rate=0.95,
    ghost_rate_per_ha=0.1,
)
ODD = replace(
    PLAIN,
    semantic_draw="frame",
    heading_sigma_deg=0.5,
    gnss_drift_sigma_m=0.8,
    wrong_fixes_per_km=3.0,
    fade_range_m=70.0,
    range_bias_drift_sigma_m=0.5,
    ghost_tracks_per_km=8.0,
    occluded_share=0.2,
)
BLIND = replace(PLAIN, false_negative_rate=1.0, ghost_rate_per_ha=0.0)
PAPER = TrackerModel(
    tracker="paper",
    track_gate_m=2.0,
    track_reference="last",
    max_missed_frames=3,
    min_track_frames=3,
    end_on_leaving_view=True,
    range_m=100.0,
    half_fov_rad=np.pi / 6,
    noise=PolarNoise(0.3, 0.0035, 2.4, 0.021),
)
BOARDS = Billboards(np.array([[150.0, 8.0], [260.0, -9.0]]), np.array([2, 5]), np.array([0.5, 0.9]))


def drives(n_frames):
    """Return passes of several lengths side by side, one of a single frame among them."""
    passes = []
    for k, n in enumerate(n_frames):
        along = 2.0 * np.arange(n)
        passes.append(Poses(np.column_stack((along, np.full(n, 0.3 * k))), np.full(n, 0.01 * k), along, along / 10))
    return passes


@pytest.fixture
def field():
    rng = np.random.default_rng(3)
    places = np.column_stack((rng.uniform(20, 600, 40), rng.choice([-6.0, 6.0], 40)))
    places[30:] = places[:10]  # two plates on a pole
    return SignField(places, rng.integers(0, 7, 40), n_classes=7, cell_m=100.0)


def streams(n):
    return [pass_streams(4, replicate=1, vehicle=vehicle) for vehicle in range(n)]


@pytest.mark.parametrize("sensor", [PLAIN, ODD, BLIND], ids=["plain", "odd", "blind"])
@pytest.mark.parametrize("tracker", ["paper", "kalman", "ideal"])
def test_a_pass_sees_and_sends_the_same_whichever_passes_are_beside_it(field, sensor, tracker):
    true, lengths = drives([250, 1, 90, 300]), [250, 1, 90, 300]
    model = replace(PAPER, tracker=tracker, send_information=True, split_track_rate=0.4)
    boards = BOARDS if sensor is ODD else None
    together_streams = streams(4)
    together = sense_passes(true, field, sensor, together_streams, boards)
    sent = track_passes(together.detections, together.reported, model, together_streams)
    assert together.detections.pass_start.tolist() == np.cumsum([0, *lengths]).tolist()
    assert (len(sent.sign) > 50) == (sensor is not BLIND)
    for k, own in enumerate(streams(4)):
        first, last = together.detections.pass_start[k : k + 2]
        alone = sense_pass(true[k], field, sensor, own, boards)
        np.testing.assert_array_equal(together.reported.xy_m[first:last], alone.reported.xy_m)
        same_rows(together.in_view, alone.in_view, first, last)
        same_rows(together.detections, alone.detections, first, last)
        same_tracks(sent, track_pass(alone.detections, alone.reported, model, own), k)


def same_rows(together, alone, first, last):
    rows = slice(*np.searchsorted(together.frame, (first, last)))
    np.testing.assert_array_equal(together.frame[rows] - first, alone.frame)
    for field in fields(alone):
        if field.name not in {"frame", "n_frames", "later_passes"}:
            np.testing.assert_array_equal(getattr(together, field.name)[rows], getattr(alone, field.name))


def same_tracks(together, alone, number):
    own = together.pass_number == number
    for field in fields(alone):
        if field.name not in {"pass_number", "information"}:
            np.testing.assert_array_equal(getattr(together, field.name)[own], getattr(alone, field.name))
    for field in fields(Information):
        np.testing.assert_array_equal(
            getattr(together.information, field.name)[own], getattr(alone.information, field.name)
        )


def test_random_numbers_of_passes_are_those_of_each():
    start = np.array([0, 4, 4, 9])
    for draw in (
        lambda rng, n: rng.random(n),
        lambda rng, n: rng.standard_normal(n),
        lambda rng, n: rng.integers(0, 1000, n),
        lambda rng, n: rng.poisson(3.5, n),
    ):
        together = PassesRandom([np.random.default_rng(k) for k in range(3)], start)
        alone = [np.random.default_rng(k) for k in range(3)]
        for _ in range(2):  # they go on where they are
            parts = [draw(rng, n) for rng, n in zip(alone, np.diff(start), strict=True)]
            np.testing.assert_array_equal(draw(together, 9), np.concatenate(parts))


def test_rows_are_merged_by_frame_those_of_the_first_before_those_of_the_second():
    rng = np.random.default_rng(0)
    for n, m in ((0, 0), (0, 3), (5, 0), (30, 20)):
        first, second = np.sort(rng.integers(0, 12, n)), np.sort(rng.integers(0, 12, m))
        expected = np.argsort(np.concatenate((first, second)), kind="stable")
        np.testing.assert_array_equal(by_frame(first, second), expected)
