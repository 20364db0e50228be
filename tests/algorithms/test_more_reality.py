"""What the paper leaves out, each option on its own by its statistics; fixed seeds, p > 0.001."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from geofleet.algorithms.billboards import Billboards, place_billboards
from geofleet.algorithms.confusion import confusion_matrix, read_classes
from geofleet.algorithms.occlusion import occluded
from geofleet.algorithms.pose_errors import gauss_markov, wrong_fixes
from geofleet.algorithms.sensing import (
    FIRST_BILLBOARD,
    Calibration,
    SignField,
    ghost_tracks,
    in_view_of,
    miss_rate,
)
from geofleet.algorithms.sensing_chain import sense_pass
from geofleet.algorithms.sensor_model import SensorModel
from geofleet.algorithms.streams import pass_streams
from geofleet.algorithms.trajectory import (
    Poses,
    beside,
    drive_line,
    frames_in_time,
    resample,
    travel_times,
    wander,
)
from geofleet.errors import InputError

P_MIN = 0.001
EXACT = SensorModel(range_m=50.0, fov_deg=60.0)


def straight(n: int = 300, step_m: float = 2.0) -> Poses:
    along = step_m * np.arange(n)
    return Poses(np.column_stack((along, np.zeros(n))), np.zeros(n), along, along / 10.0)


def test_drift_is_stationary_and_forgets_exponentially():
    times = np.cumsum(np.random.default_rng(0).uniform(0.5, 3.0, 200_000))
    drift = gauss_markov(times, sigma_m=1.5, correlation_s=20.0, rng=np.random.default_rng(1))
    apart = drift[:: int(200 / 1.75)]  # ten times the correlation
    for axis in range(2):
        assert stats.kstest(apart[:, axis], "norm", (0, 1.5)).pvalue > P_MIN
    assert stats.pearsonr(*apart.T).pvalue > P_MIN
    step = drift[1:] - np.exp(-np.diff(times) / 20.0)[:, None] * drift[:-1]
    fresh = step / (1.5 * np.sqrt(1 - np.exp(-2 * np.diff(times) / 20.0)))[:, None]
    assert stats.kstest(fresh[:20_000].ravel(), "norm").pvalue > P_MIN
    assert stats.pearsonr(fresh[1:, 0], fresh[:-1, 0]).pvalue > P_MIN


def test_wrong_fixes_come_at_their_rate_last_and_shift_as_long_as_they_say():
    along = np.arange(0, 2_000_000.0, 1.0)
    offset = wrong_fixes(along, per_km=0.1, length_m=80.0, sigma_m=12.0, rng=np.random.default_rng(2))
    lost = np.any(offset != 0, axis=1)
    edges = np.flatnonzero(np.diff(lost.astype(int), prepend=0, append=0))
    begin, end = edges[::2], edges[1::2]
    assert stats.poisson.cdf(len(begin), 200) == pytest.approx(0.5, abs=0.499)
    assert stats.kstest((end - begin) - 0.5, "expon", (0, 80.0)).pvalue > P_MIN
    assert stats.kstest(offset[begin].ravel(), "norm", (0, 12.0)).pvalue > P_MIN


def test_reported_poses_carry_drift_and_wrong_fixes_beside_the_offset():
    poses = straight()
    model = replace(EXACT, gnss_drift_sigma_m=2.0, wrong_fixes_per_km=5.0)
    signs = SignField(np.array([[100.0, 5.0]]), np.array([0]), n_classes=1, cell_m=50.0)
    plain = sense_pass(poses, signs, EXACT, pass_streams(0, replicate=0, vehicle=0))
    result = sense_pass(poses, signs, model, pass_streams(0, replicate=0, vehicle=0))
    moved = result.reported.xy_m - plain.reported.xy_m
    assert moved.std() > 1.0
    at = result.detections.frame
    np.testing.assert_allclose(result.detections.xy_m - plain.detections.xy_m, moved[at], atol=1e-9)
    with pytest.raises(ValueError, match="times"):
        sense_pass(replace(poses, elapsed_s=None), signs, model, pass_streams(0, replicate=0, vehicle=0))


@pytest.mark.parametrize(("share", "frames"), [(0.2, 5.0), (0.5, 2.0), (0.05, 12.0)])
def test_occlusion_hides_a_share_of_frames_in_runs_of_geometric_length(share, frames):
    n_frames, n_signs = 3000, 30
    frame, sign = np.repeat(np.arange(n_frames), n_signs), np.tile(np.arange(n_signs), n_frames)
    hidden = occluded(frame, sign, share=share, mean_frames=frames, rng=np.random.default_rng(3))
    grid = hidden.reshape(n_frames, n_signs)
    assert stats.binomtest(int(grid[0::150].sum()), grid[0::150].size, share).pvalue > P_MIN
    runs = np.concatenate([run_lengths(column) for column in grid.T])
    assert abs(runs.mean() - frames) < 4 * runs.std() / np.sqrt(len(runs))
    counts = np.bincount(np.minimum(runs, 8), minlength=9)[1:]
    expected = stats.geom.pmf(np.arange(1, 9), 1 / frames)
    expected[-1] = 1 - expected[:-1].sum()
    assert stats.chisquare(counts, expected * counts.sum()).pvalue > P_MIN
    assert stats.pearsonr(grid[:, 0].astype(float), grid[:, 1].astype(float)).statistic < 0.1


def run_lengths(hidden: np.ndarray) -> np.ndarray:
    edges = np.flatnonzero(np.diff(hidden.astype(int), prepend=0, append=0))
    inner = (edges[::2] > 0) & (edges[1::2] < len(hidden))
    return (edges[1::2] - edges[::2])[inner]


def test_occlusion_goes_on_over_frames_out_of_view():
    n = 40_000
    frame = np.column_stack((np.zeros(n), np.full(n, 3))).T.ravel().astype(int)  # frames 1 and 2 are out of view
    hidden = occluded(frame, np.tile(np.arange(n), 2), share=0.3, mean_frames=4.0, rng=np.random.default_rng(4))
    first, later = hidden[:n], hidden[n:]
    expected = 0.3 + 0.7 * (1 - 0.25 - 0.3 / 0.7 * 0.25) ** 3
    assert stats.binomtest(int(later[first].sum()), int(first.sum()), expected).pvalue > P_MIN
    with pytest.raises(ValueError, match="needs at least 9 frames"):
        occluded(frame, frame, share=0.9, mean_frames=2.0, rng=np.random.default_rng(4))


def test_detection_falls_with_range_to_half_where_it_says():
    model = replace(EXACT, false_negative_rate=0.1, fade_range_m=60.0, fade_width_m=8.0)
    np.testing.assert_allclose(1 - miss_rate(np.array([60.0, 0.0]), model), [0.45, 0.9 / (1 + np.exp(-7.5))])
    poses, signs = straight(), SignField(np.array([[300.0, 1.0]]), np.array([0]), n_classes=1, cell_m=100.0)
    model = replace(model, range_m=100.0)
    seen, there = np.zeros(5), np.zeros(5)
    for vehicle in range(300):
        result = sense_pass(poses, signs, model, pass_streams(1, replicate=0, vehicle=vehicle))
        seen += np.histogram(result.detections.range_m, bins=5, range=(0, 100))[0]
        there += np.histogram(result.in_view.range_m, bins=5, range=(0, 100))[0]
    expected = [quad_mean(model, low, low + 20.0) for low in range(0, 100, 20)]
    for k in range(5):
        assert stats.binomtest(int(seen[k]), int(there[k]), expected[k]).pvalue > P_MIN


def quad_mean(model: SensorModel, low: float, high: float) -> float:
    distance = 300.0 - 2.0 * np.arange(150)
    distance = np.hypot(distance, 1.0)
    inside = (distance >= low) & (distance < high)
    return float(np.mean(1 - miss_rate(distance[inside], model)))


def test_similar_signs_are_confused_more_often():
    groups = ["warning"] * 3 + ["priority"] * 2 + ["other"]
    matrix = confusion_matrix(groups, semantic_rate=0.9, in_group=0.8)
    np.testing.assert_allclose(matrix.sum(axis=1), 1.0)
    np.testing.assert_allclose(matrix[0], [0.9, 0.04, 0.04, 0.02 / 3, 0.02 / 3, 0.02 / 3])
    np.testing.assert_allclose(matrix[5], [0.02] * 5 + [0.9])  # alone in its group
    read = read_classes(np.full(40_000, 0), matrix, np.random.default_rng(5))
    assert stats.chisquare(np.bincount(read, minlength=6), 40_000 * matrix[0]).pvalue > P_MIN
    one_group = confusion_matrix(["warning"] * 3, semantic_rate=0.7, in_group=0.0)
    np.testing.assert_allclose(one_group[1], [0.15, 0.7, 0.15])
    with pytest.raises(ValueError, match="one class alone"):
        confusion_matrix(["warning"], semantic_rate=0.9, in_group=0.5)


def test_confusion_by_a_matrix_is_that_of_the_sensor():
    signs = SignField(np.array([[100.0, 5.0]]), np.array([1]), n_classes=3, cell_m=50.0)
    model = replace(EXACT, semantic_draw="frame", confusion=np.array([[1.0, 0, 0], [0, 0, 1.0], [0, 0, 1.0]]))
    result = sense_pass(straight(), signs, model, pass_streams(0, replicate=0, vehicle=0))
    assert set(result.detections.class_code.tolist()) == {2}


def test_a_sign_is_seen_from_its_front_only():
    place = np.tile([[40.0, 3.0]], (4, 1))
    facing = np.deg2rad([180.0, 0.0, 100.0, np.nan])  # towards the car, away, towards by 80°, unknown
    field = SignField(place, np.zeros(4, int), n_classes=1, cell_m=50.0, facing_rad=facing)
    seen = in_view_of(straight(1), field, EXACT)
    assert sorted(seen.sign.tolist()) == [0, 2, 3]
    back = Poses(np.array([[80.0, 0.0]]), np.array([np.pi]), np.zeros(1))
    assert sorted(in_view_of(back, field, EXACT).sign.tolist()) == [1, 3]


def test_billboards_stand_beside_the_drive_at_their_rate():
    line = drive_line(np.column_stack((np.arange(0, 50_000, 5.0), np.zeros(10_000))), np.zeros(10_000, int))
    made = place_billboards(
        (line,), per_km=8.0, share=(0.3, 0.6), corridor_m=15.0, n_classes=4, rng=np.random.default_rng(6)
    )
    n = len(made.share)
    assert stats.poisson.cdf(n, 8.0 * line.along_m[-1] / 1000) == pytest.approx(0.5, abs=0.499)
    assert stats.kstest(made.xy_m[:, 1], "uniform", (-15, 30)).pvalue > P_MIN
    assert stats.kstest(made.xy_m[:, 0], "uniform", (0, line.along_m[-1])).pvalue > P_MIN
    assert stats.kstest(made.share, "uniform", (0.3, 0.3)).pvalue > P_MIN
    assert stats.chisquare(np.bincount(made.class_code, minlength=4)).pvalue > P_MIN


def test_a_billboard_is_reported_by_its_share_of_passes_always_as_the_same_class():
    board = Billboards(np.array([[200.0, 5.0], [400.0, -5.0]]), np.array([2, 1]), np.array([0.4, 1.0]))
    signs = SignField(np.array([[100.0, 5.0]]), np.array([0]), n_classes=3, cell_m=50.0)
    model = replace(EXACT, semantic_rate=0.5, false_negative_rate=0.1)
    reports = 0
    for vehicle in range(400):
        result = sense_pass(straight(), signs, model, pass_streams(8, replicate=0, vehicle=vehicle), board)
        sign = result.detections.sign
        assert (result.in_view.sign == 0).all()
        reports += FIRST_BILLBOARD in sign
        assert set(result.detections.class_code[sign == FIRST_BILLBOARD].tolist()) <= {2}
        assert set(result.detections.class_code[sign == FIRST_BILLBOARD - 1].tolist()) == {1}
    assert stats.binomtest(reports, 400, 0.4).pvalue > P_MIN


def test_backward_is_the_same_line_from_its_end_on_the_other_side():
    xy_m = np.column_stack((np.arange(0, 301.0), 10 * np.sin(np.arange(0, 301.0) / 50)))
    line = drive_line(xy_m, np.repeat([0, 1], [150, 151]), np.arange(301.0))
    back = line.backward()
    assert (back.along_m[0], back.along_m[-1]) == (0.0, line.along_m[-1])
    np.testing.assert_array_equal(np.diff(back.starts), np.diff(line.starts)[::-1])
    np.testing.assert_array_equal(back.recorded_s, line.recorded_s)
    there, home = (resample(way, spacing_m=2.0, heading_baseline_m=9.0) for way in (line, back))
    middle = np.argmin(np.hypot(*(home.xy_m - there.xy_m[40]).T))
    turned = home.heading_rad[middle] - there.heading_rad[40]
    assert np.cos(turned) == pytest.approx(-1, abs=1e-3)
    left = beside(there, 3.5).xy_m - there.xy_m
    np.testing.assert_allclose(np.hypot(*left.T), 3.5)
    assert (left[:, 1] > 0).all()


def test_frames_in_time_follow_the_recorded_speed_and_skip_standstill():
    # 100 m at 10 m/s, a standstill of 60 s, 100 m at 5 m/s, a gap of 40 m in 4 s, 50 m at 10 m/s
    east = np.concatenate((np.arange(0, 101), np.arange(101, 201), np.arange(240, 291))).astype(float)
    steps = np.concatenate((np.full(100, 0.1), [60.2], np.full(99, 0.2), [4.0], np.full(50, 0.1)))
    times = np.concatenate(([0.0], np.cumsum(steps)))
    line = drive_line(np.column_stack((east, np.zeros(len(east)))), (east > 210).astype(int), times)
    way = resample(line, spacing_m=1.0, heading_baseline_m=9.0)
    clock = travel_times(line, speed_mps=10.0, recorded=True)
    frames = frames_in_time(way, line, times_s=clock, rate_hz=5.0)
    spacing = np.diff(frames.along_m)
    fast, slow = frames.along_m[1:] < 99, (frames.along_m[1:] > 104) & (frames.along_m[1:] < 199)
    np.testing.assert_allclose(spacing[fast], 2.0)
    np.testing.assert_allclose(spacing[slow], 1.0)
    assert not ((frames.along_m > 200.001) & (frames.along_m < 239.999)).any()
    np.testing.assert_allclose(frames.xy_m[:, 0], frames.along_m, atol=1e-9)
    assert frames.elapsed_s[-1] == pytest.approx(times[-1], abs=0.3)
    with pytest.raises(InputError, match="no times"):
        travel_times(replace(line, recorded_s=None), speed_mps=10.0, recorded=True)
    with pytest.raises(InputError, match="do not grow"):
        travel_times(replace(line, recorded_s=0 * times), speed_mps=10.0, recorded=True)


def test_lateral_wander_keeps_the_times():
    moved = wander(straight(), sigma_m=0.4, correlation_m=50.0, spacing_m=2.0, rng=np.random.default_rng(0))
    np.testing.assert_array_equal(moved.elapsed_s, straight().elapsed_s)


def test_a_fault_of_the_calibration_shifts_every_measurement_alike():
    signs = SignField(np.array([[100.0, 5.0], [220.0, -4.0]]), np.array([0, 1]), n_classes=2, cell_m=50.0)
    for vehicle in range(3):
        streams = pass_streams(0, replicate=0, vehicle=vehicle)
        result = sense_pass(straight(), signs, replace(EXACT, range_bias_m=5.0, bearing_bias_deg=-3.0), streams)
        np.testing.assert_allclose(result.detections.range_m - result.in_view.range_m, 5.0)
        turned = result.detections.azimuth_rad - result.in_view.bearing_rad  # the car drives east
        np.testing.assert_allclose(turned, np.deg2rad(-3.0))


def test_the_sensor_setting_error_drifts_as_a_stationary_process_beside_its_constant():
    """Two minutes apart the drift has forgotten itself (τ = 20 s); 2 s apart it keeps exp(-0.1)."""
    poses, drift = straight(1300), []
    signs = SignField(
        np.column_stack((np.arange(20.0, 2600, 8), np.full(323, 2.0))), np.zeros(323, int), n_classes=1, cell_m=50.0
    )
    model = replace(
        EXACT, range_bias_drift_sigma_m=1.5, bearing_bias_drift_sigma_deg=0.8, bias_drift_correlation_s=20.0
    )
    for vehicle in range(200):
        result = sense_pass(poses, signs, model, pass_streams(3, replicate=0, vehicle=vehicle))
        off_m = result.detections.range_m - result.in_view.range_m
        off_deg = np.rad2deg(result.detections.azimuth_rad - result.in_view.bearing_rad)
        frame = result.detections.frame
        _, first = np.unique(frame, return_index=True)
        for axis in (off_m, off_deg):
            np.testing.assert_allclose(axis, axis[first][np.searchsorted(frame[first], frame)], atol=1e-9)  # by frame
        at = [first[frame[first] == k][0] for k in (0, 10, 600, 1200)]
        drift.append(np.column_stack((off_m[at], off_deg[at])))
    drift = np.array(drift)  # (pass, time, axis)
    for axis, sigma in enumerate((1.5, 0.8)):
        apart = drift[:, [0, 2, 3], axis]
        assert stats.kstest(apart.ravel(), "norm", (0, sigma)).pvalue > P_MIN
        assert stats.pearsonr(apart[:, 0], apart[:, 1]).pvalue > P_MIN
        fresh = (drift[:, 1, axis] - np.exp(-0.1) * drift[:, 0, axis]) / (sigma * np.sqrt(1 - np.exp(-0.2)))
        assert stats.kstest(fresh, "norm").pvalue > P_MIN
    assert stats.pearsonr(*drift[:, 0].T).pvalue > P_MIN


def test_a_bias_drift_leaves_all_other_draws_alone_and_needs_times():
    signs = SignField(np.array([[100.0, 5.0]]), np.array([0]), n_classes=1, cell_m=50.0)
    noisy = replace(EXACT, gnss_sigma_m=1.0, range_bias_sigma_m=1.0, range_noise_sigma_m=0.5, false_negative_rate=0.2)
    plain, other = (
        sense_pass(straight(), signs, model, pass_streams(0, replicate=0, vehicle=0))
        for model in (noisy, replace(noisy, range_bias_drift_sigma_m=2.0))
    )
    np.testing.assert_array_equal(plain.detections.frame, other.detections.frame)
    np.testing.assert_array_equal(plain.reported.xy_m, other.reported.xy_m)
    np.testing.assert_array_equal(plain.detections.azimuth_rad, other.detections.azimuth_rad)
    assert np.std(other.detections.range_m - plain.detections.range_m) > 0
    with pytest.raises(ValueError, match="times"):
        sense_pass(
            replace(straight(), elapsed_s=None),
            *(signs, replace(EXACT, range_bias_drift_sigma_m=2.0), pass_streams(0, replicate=0, vehicle=0)),
        )


def test_ghosts_that_last_come_at_their_rate_stay_at_their_place_and_last_as_long_as_they_say():
    rng, model = np.random.default_rng(9), replace(EXACT, ghost_tracks_per_km=6.0, ghost_track_frames=5.0)
    exact, n_ghosts, lengths, square, classes = Calibration(0.0, 0.0), 0, [], [], []
    for _ in range(300):
        seen, class_code = ghost_tracks(straight(), 4, exact, model, rng, first=-7)
        for ghost in np.unique(seen.sign):
            rows = np.flatnonzero(seen.sign == ghost)
            assert (np.diff(seen.frame[rows]) == 1).all()
            assert len(set(class_code[rows].tolist())) == 1
            place = 2.0 * seen.frame[rows] + seen.range_m[rows] * np.exp(1j * seen.bearing_rad[rows])
            np.testing.assert_allclose(place, place[0], atol=1e-9)
            classes.append(class_code[rows[0]])
            square.append((seen.range_m[rows[0]] / 50.0) ** 2)
            ahead_m = place[0].real - 2.0 * seen.frame[rows[0]] - abs(place[0].imag) * np.sqrt(3)
            if ahead_m > 2.0 * 9 and seen.frame[rows[0]] < 290:  # in view for nine frames more
                lengths.append(len(rows))
        assert seen.sign.max(initial=-7) <= -7
        n_ghosts += len(np.unique(seen.sign))
    expected = 300 * 6.0 * 0.598
    assert stats.poisson.cdf(n_ghosts, expected) == pytest.approx(0.5, abs=0.499)
    assert stats.kstest(square, "uniform").pvalue > P_MIN
    assert stats.chisquare(np.bincount(classes, minlength=4)).pvalue > P_MIN
    counts = np.bincount(np.minimum(lengths, 10), minlength=11)[1:]
    share = stats.geom.pmf(np.arange(1, 11), 1 / 5.0)
    share[-1] = 1 - share[:-1].sum()
    assert stats.chisquare(counts, share * counts.sum()).pvalue > P_MIN


def test_ghosts_that_last_are_missed_as_signs_are_and_carry_the_bias():
    model = replace(EXACT, ghost_tracks_per_km=40.0, ghost_track_frames=30.0, false_negative_rate=0.3)
    kept, all_ = (
        sum(
            len(ghost_tracks(straight(), 2, Calibration(bias_m, 0.0), m, np.random.default_rng(k), first=-2)[0].frame)
            for k in range(40)
        )
        for m, bias_m in ((model, 4.0), (replace(model, false_negative_rate=0.0), 0.0))
    )
    assert stats.binomtest(kept, all_, 0.7).pvalue > P_MIN
    off, exact = (
        ghost_tracks(straight(), 2, Calibration(bias_m, 0.0), model, np.random.default_rng(0), first=-2)[0].range_m
        for bias_m in (4.0, 0.0)
    )
    np.testing.assert_allclose(off - exact, 4.0)
