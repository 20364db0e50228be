"""The Kalman tracker and the information form: one track a sign, and numbers that mean what they say."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from geofleet.algorithms.fragments import join_fragments
from geofleet.algorithms.information import (
    RANK_TOLERANCE,
    PolarNoise,
    TrackRows,
    information_form,
    linearised,
    pass_bias,
)
from geofleet.algorithms.information_kernels import misfit
from geofleet.algorithms.kalman import track_kalman
from geofleet.algorithms.sensing import GHOST, FrameDetections, SignField
from geofleet.algorithms.sensing_chain import sense_pass
from geofleet.algorithms.sensor_model import SensorModel
from geofleet.algorithms.streams import pass_streams
from geofleet.algorithms.tracking import TrackerModel, track_ideal, track_paper, track_pass
from geofleet.algorithms.trajectory import Poses
from geofleet.config import load_config
from geofleet.formats.layers import read_drives, read_layer
from geofleet.steps.ingest import ingest_drive, ingest_signs
from geofleet.tables.fleets import Fleet, load_fleet

if TYPE_CHECKING:
    from pathlib import Path

P_MIN = 0.001
NOISE = PolarNoise(0.3, np.deg2rad(0.2), 2.4, np.deg2rad(1.2))
SENSOR = SensorModel(100.0, 60.0, 1.7, 0.0, 2.4, 1.2, 0.3, 0.2, 0.1, 0.95, "track", 0.02)
TRACKER = TrackerModel("kalman", 2.0, "last", 3, 3, True, 100.0, np.deg2rad(30), noise=NOISE)  # noqa: FBT003 - a dataclass


@pytest.fixture(scope="module")
def inputs(tmp_path_factory, repo) -> tuple[Path, Path]:
    folder, raw = tmp_path_factory.mktemp("helsinki"), repo / "data" / "raw"
    ingest_signs([raw / "helsinki.osm.pbf"], folder / "signs.parquet")
    ingest_drive([raw / "helsinki_derived.pos"], folder / "drive.parquet")
    return folder / "signs.parquet", folder / "drive.parquet"


def fleet_of(inputs: tuple[Path, Path], scenario: str) -> Fleet:
    signs, drive = inputs
    config = load_config(scenario, {"tracker": "kalman"})
    return load_fleet(read_layer(signs).table, read_drives(drive).table, source=signs, drive=drive, config=config)


def front_end(fleet: Fleet, tracker, n_passes: int) -> tuple[float, float]:
    """Return the share of signs seen that more than one track of a pass stands for, and the purity on shared poles."""
    model, field = fleet.kinds[0].tracker, fleet.scene.field
    poles = {i for pair in cKDTree(field.xy_m).query_pairs(1.0) for i in pair}
    n_signs = n_split = n_frames = n_pure = 0
    for vehicle in range(n_passes):
        streams = pass_streams(77, replicate=0, vehicle=vehicle)
        sensed = sense_pass(fleet.start(vehicle, streams).true, field, fleet.kinds[0].sensor, streams)
        seen = sensed.detections
        track = tracker(seen, sensed.reported, model)
        tracks_of: Counter[int] = Counter()
        for t in np.flatnonzero(np.bincount(track) >= model.min_track_frames):
            sign, frames = Counter(seen.sign[track == t].tolist()).most_common(1)[0]
            tracks_of[sign] += sign != GHOST
            if sign in poles:
                n_frames += int((track == t).sum())
                n_pure += frames
        n_signs += len(tracks_of)
        n_split += sum(n > 1 for n in tracks_of.values())
    return n_split / n_signs, n_pure / n_frames


@pytest.mark.parametrize("scenario", ["paper", "paper-50m", "paper-ideal"])
def test_one_track_a_sign_also_on_shared_poles(inputs, scenario):
    fleet = fleet_of(inputs, scenario)
    split, purity = front_end(fleet, track_kalman, 20)
    assert split <= 0.01
    assert purity >= 0.98
    split_by_paper, purity_by_paper = front_end(fleet, track_paper, 5)
    assert split_by_paper > 0.2
    assert purity_by_paper < 0.8


def street_pass(vehicle: int, sensor: SensorModel = SENSOR) -> tuple[FrameDetections, Poses]:
    along = np.arange(0.0, 600.0, 2.0)
    poses = Poses(np.column_stack((along, np.zeros(300))), np.zeros(300), along)
    rng = np.random.default_rng(2)
    places = np.column_stack((np.linspace(60, 640, 25), rng.choice([-6.0, 6.0], 25)))
    field = SignField(places, rng.integers(0, 9, 25), n_classes=9, cell_m=100.0)
    sensed = sense_pass(poses, field, sensor, pass_streams(5, replicate=0, vehicle=vehicle))
    return sensed.detections, sensed.reported


def test_classes_part_the_plates_of_a_pole():
    poses = Poses(np.column_stack((np.arange(0, 80, 2.0), np.zeros(40))), np.zeros(40), np.arange(0, 80, 2.0))
    field = SignField(np.array([[90.0, 5.0], [90.0, 5.0]]), np.array([3, 7]), n_classes=9, cell_m=100.0)
    seen = sense_pass(poses, field, SENSOR, pass_streams(1, replicate=0, vehicle=1)).detections
    track = track_kalman(seen, poses, TRACKER)
    for sign in (0, 1):
        assert len(set(track[seen.sign == sign].tolist())) == 1
    assert track[seen.sign == 0][0] != track[seen.sign == 1][0]


def test_pairs_join_unless_their_groups_share_a_frame():
    frame = np.array([0, 1, 3, 4, 1, 8])
    rows = TrackRows.of(np.array([0, 0, 1, 1, 2, 3]))
    pairs = np.array([[0, 1], [1, 2], [2, 3]])  # 2 shares frame 1 with 0, which 1 has joined by then
    group = join_fragments(rows.start, rows.order, frame, pairs[:, 0], pairs[:, 1], 9)
    assert group.tolist() == [0, 0, 1, 1]


def test_the_information_form_is_the_least_squares_problem_of_the_track():
    seen, reported = street_pass(3)
    rows = TrackRows.of(track_ideal(seen))
    form = information_form(seen, reported, rows, NOISE, pass_bias(seen, reported, rows, NOISE).mean)
    prior = np.diag([0, 0, 1 / NOISE.range_bias_sigma_m**2, 1 / NOISE.bearing_bias_sigma_rad**2])
    n_checked = 0
    for t in np.flatnonzero(np.diff(rows.start) >= 20):
        k = rows.order[rows.start[t] : rows.start[t + 1]]

        def residual(x, k=k, origin=form.origin_xy_m[t]):
            step = origin + x[:2] - reported.xy_m[seen.frame[k]]
            angle = seen.azimuth_rad[k] - np.arctan2(step[:, 1], step[:, 0]) - x[3]
            of_frames = (seen.range_m[k] - np.hypot(*step.T) - x[2]) / NOISE.range_sigma_m
            turned = (angle + np.pi) % (2 * np.pi) - np.pi
            return np.concatenate((of_frames, turned / NOISE.bearing_sigma_rad, np.sqrt(np.diag(prior)[2:]) * x[2:]))

        solved = least_squares(residual, np.zeros(4), x_scale=[1, 1, 1, 0.01], xtol=1e-12, ftol=1e-12, gtol=1e-12)
        estimate = np.linalg.solve(form.matrix[t] + prior, form.vector[t])
        sigma = np.sqrt(np.diag(np.linalg.inv(form.matrix[t] + prior)))
        assert np.abs((estimate - solved.x) / sigma).max() < 0.2  # it is linearised at one place
        n_checked += 1
    assert n_checked >= 10


def test_the_residual_is_chi_squared_with_its_degrees_of_freedom():
    probability = []
    for vehicle in range(20):
        seen, reported = street_pass(vehicle)
        rows = TrackRows.of(track_ideal(seen))
        bias = pass_bias(seen, reported, rows, NOISE)
        form = information_form(seen, reported, rows.at_least(10), NOISE, bias.mean)
        probability += stats.chi2.cdf(form.s0, form.dof).tolist()
    assert len(probability) > 300
    assert stats.kstest(probability, "uniform").pvalue > P_MIN


def test_elimination_finds_the_residual_and_rank_that_eigenvalues_do():
    seen, reported = street_pass(4)
    rows = TrackRows.of(track_ideal(seen))
    bias = pass_bias(seen, reported, rows, NOISE).mean
    form = information_form(seen, reported, rows, NOISE, bias)
    _, matrix, gradient, square = linearised(seen, reported, rows, NOISE, bias[rows.pass_of(seen)])
    unit = np.array([1.0, 1.0, 1.0, NOISE.range_sigma_m / NOISE.bearing_sigma_rad])
    s0, rank = misfit(matrix, gradient, square, unit, RANK_TOLERANCE)
    assert set(rank.tolist()) == {2, 4}  # a single frame, of a ghost, sees a place or a bias
    np.testing.assert_array_equal(2 * np.diff(rows.start) - rank, form.dof)
    np.testing.assert_allclose(s0, form.s0, rtol=1e-6, atol=1e-6)


def test_a_bias_from_a_good_start_needs_one_round():
    seen, reported = street_pass(6)
    rows = TrackRows.of(track_ideal(seen))
    bias = pass_bias(seen, reported, rows, NOISE)
    again = pass_bias(seen, reported, rows, NOISE, start=bias.mean, n_rounds=1)
    np.testing.assert_allclose(again.mean, bias.mean, atol=1e-5)
    np.testing.assert_allclose(again.cov, bias.cov, rtol=1e-5)


def test_the_bias_of_a_pass_is_found_as_sure_as_it_says():
    chi2 = []
    for vehicle in range(300):
        seen, reported = street_pass(vehicle)
        bias = pass_bias(seen, reported, TrackRows.of(track_ideal(seen)), NOISE)
        range_unit, bearing_unit = pass_streams(5, replicate=0, vehicle=vehicle).calibration.standard_normal(2)
        error = bias.mean[0] - [2.4 * range_unit, np.deg2rad(1.2) * bearing_unit]
        chi2.append(error @ np.linalg.solve(bias.cov[0], error))
    assert np.sqrt(np.diag(bias.cov[0])) == pytest.approx([0, 0], abs=0.05)  # 5 cm, and far below a degree
    assert stats.kstest(chi2, "chi2", (2,)).pvalue > P_MIN


def test_a_bias_known_to_be_none_stays_none_and_exact_detections_give_exact_places():
    exact = SensorModel(100.0, 60.0)
    noise = PolarNoise(0.05, np.deg2rad(0.05), 0.0, 0.0)
    seen, reported = street_pass(0, exact)
    rows = TrackRows.of(track_ideal(seen))
    bias = pass_bias(seen, reported, rows, noise)
    assert bias.mean.tolist() == [[0.0, 0.0]]
    form = information_form(seen, reported, rows, noise, bias.mean)
    np.testing.assert_allclose(form.origin_xy_m[track_ideal(seen)], seen.xy_m, atol=1e-6)
    assert form.s0.max() < 1e-6


def test_a_pass_without_detections_has_no_tracks():
    none = np.empty(0, dtype=np.int64)
    seen = FrameDetections(none, none, none, np.empty((0, 2)), np.empty(0), np.empty(0), 5)
    tracks = track_pass(seen, street_pass(0)[1], replace(TRACKER, send_information=True))
    assert tracks.information is not None
    assert len(tracks.n_frames) == len(tracks.information.s0) == 0
