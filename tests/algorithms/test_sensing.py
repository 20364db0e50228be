"""Every equation of the paper's detection simulation on its own, by its statistics; fixed seeds, p > 0.001."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from geofleet.algorithms.sensing import (
    GHOST,
    Calibration,
    Sightings,
    SignField,
    draw_calibration,
    ghost_frames,
    ghosts,
    in_view_of,
    keep_detected,
    measured,
    projected,
    recognised,
    reported_poses,
)
from geofleet.algorithms.sensing_chain import sense_pass
from geofleet.algorithms.sensor_model import SensorModel
from geofleet.algorithms.streams import pass_streams
from geofleet.algorithms.trajectory import Poses, drive_line, resample, wander
from geofleet.errors import InputError

P_MIN = 0.001
EXACT = SensorModel(range_m=50.0, fov_deg=60.0)
NOISY = SensorModel(50.0, 60.0, 1.7, 0.5, 2.4, 1.2, 0.3, 0.2, 0.1, 0.9, "frame", 2.0)


def poses_at(*rows: tuple[float, float, float]) -> Poses:
    east, north, heading = np.array(rows, dtype=float).T
    return Poses(np.column_stack((east, north)), heading, np.arange(len(rows)) * 2.0)


def field_of(*places: tuple[float, float], cell_m: float = 50.0) -> SignField:
    return SignField(np.array(places, dtype=float), np.arange(len(places)), n_classes=len(places), cell_m=cell_m)


@pytest.fixture(scope="module")
def street() -> tuple[Poses, SignField]:
    rng = np.random.default_rng(5)
    along = np.arange(0.0, 600.0)
    line = drive_line(np.column_stack((along, 20 * np.sin(along / 80))), np.zeros(600, dtype=np.int64))
    beside = np.column_stack((rng.uniform(0, 600, 40), rng.uniform(-30, 30, 40)))
    signs = SignField(beside, rng.integers(0, 7, 40), n_classes=7, cell_m=50.0)
    return resample(line, spacing_m=2.0, heading_baseline_m=9.0), signs


@pytest.mark.parametrize(
    ("place", "fov_deg", "is_seen"),
    [
        ((49.999, 0.0), 60.0, True),
        ((50.0, 0.0), 60.0, False),  # d < r is strict
        ((0.001, 10.0), 180.0, True),
        ((0.0, 10.0), 180.0, False),  # |θ| < FOV/2 is strict
        ((10.0, 5.7), 60.0, True),  # 29.7°
        ((10.0, -5.8), 60.0, False),  # 30.1° to the right
        ((-10.0, 0.1), 360.0, True),
        ((-10.0, 0.0), 360.0, False),  # θ = π
        ((0.0, 0.0), 60.0, False),  # without a distance there is no bearing
    ],
)
def test_view_cone(place: tuple[float, float], fov_deg: float, *, is_seen: bool) -> None:
    seen = in_view_of(poses_at((0.0, 0.0, 0.0)), field_of(place), SensorModel(50.0, fov_deg))
    assert len(seen.sign) == is_seen


def test_bearing_is_positive_to_the_left() -> None:
    seen = in_view_of(poses_at((0.0, 0.0, np.pi / 2)), field_of((-1.0, 10.0)), EXACT)
    assert seen.bearing_rad == pytest.approx([np.arctan(0.1)])
    assert seen.range_m == pytest.approx([np.sqrt(101)])


@pytest.mark.parametrize("fov_deg", [40.0, 120.0, 200.0, 360.0])
def test_the_grid_finds_what_comparing_all_with_all_finds(fov_deg: float) -> None:
    rng = np.random.default_rng(1)
    places = rng.uniform(-200, 200, (500, 2))
    poses = Poses(rng.uniform(-300, 300, (300, 2)), rng.uniform(-np.pi, np.pi, 300), np.arange(300.0))
    seen = in_view_of(poses, SignField(places, np.zeros(500), n_classes=1, cell_m=60.0), SensorModel(45.0, fov_deg))
    step = places[None] - poses.xy_m[:, None]
    bearing = np.arctan2(step[..., 1], step[..., 0]) - poses.heading_rad[:, None]
    bearing = np.arctan2(np.sin(bearing), np.cos(bearing))
    expected = np.argwhere((np.hypot(*step.T).T < 45.0) & (np.abs(bearing) < np.deg2rad(fov_deg) / 2))
    found = np.column_stack((seen.frame, seen.sign))
    assert len(expected) > 300
    np.testing.assert_array_equal(found[np.lexsort(found.T[::-1])], expected)
    np.testing.assert_allclose(seen.bearing_rad, bearing[seen.frame, seen.sign], atol=1e-12)


def test_a_field_refuses_a_sensor_that_sees_further_than_its_cells() -> None:
    with pytest.raises(ValueError, match="cells as wide"):
        in_view_of(poses_at((0.0, 0.0, 0.0)), field_of((1.0, 0.0), cell_m=20.0), EXACT)


def test_visibility_is_that_of_the_true_pose(street: tuple[Poses, SignField]) -> None:
    poses, signs = street
    lost = replace(EXACT, gnss_sigma_m=30.0, heading_sigma_deg=40.0)
    truly = sense_pass(poses, signs, EXACT, pass_streams(0, replicate=0, vehicle=0)).in_view
    still = sense_pass(poses, signs, lost, pass_streams(0, replicate=0, vehicle=0)).in_view
    np.testing.assert_array_equal(truly.sign, still.sign)


def test_without_noise_every_visible_sign_is_reported_at_its_place(street: tuple[Poses, SignField]) -> None:
    poses, signs = street
    result = sense_pass(poses, signs, EXACT, pass_streams(3, replicate=0, vehicle=7))
    np.testing.assert_array_equal(result.detections.sign, result.in_view.sign)
    np.testing.assert_array_equal(result.detections.class_code, signs.class_code[result.in_view.sign])
    assert len(np.unique(result.detections.sign)) > 20
    assert np.abs(result.detections.xy_m - signs.xy_m[result.detections.sign]).max() < 1e-9


def test_sensor_setting_error_is_normal_and_drawn_once_a_sensor() -> None:
    drawn = [draw_calibration(NOISY, pass_streams(2, replicate=0, vehicle=v).calibration) for v in range(3000)]
    range_m, bearing_deg = np.array([(c.range_bias_m, np.rad2deg(c.bearing_bias_rad)) for c in drawn]).T
    assert stats.kstest(range_m, "norm", (0, 2.4)).pvalue > P_MIN
    assert stats.kstest(bearing_deg, "norm", (0, 1.2)).pvalue > P_MIN
    assert stats.pearsonr(range_m, bearing_deg).pvalue > P_MIN
    again = pass_streams(2, replicate=0, vehicle=17, pass_number=4).calibration
    assert draw_calibration(NOISY, again) == drawn[17]


def test_measurement_noise_is_normal_and_independent_between_frames() -> None:
    n = 5000
    true = Sightings(np.arange(n), np.zeros(n, dtype=np.int64), np.full(n, 30.0), np.full(n, 0.2))
    out = measured(true, Calibration(1.5, np.deg2rad(-2.0)), NOISY, np.random.default_rng(3))
    range_error, bearing_error = out.range_m - 30.0, np.rad2deg(out.bearing_rad - 0.2)
    assert stats.kstest(range_error, "norm", (1.5, 0.3)).pvalue > P_MIN
    assert stats.kstest(bearing_error, "norm", (-2.0, 0.2)).pvalue > P_MIN
    for errors in (range_error, bearing_error):
        assert stats.pearsonr(errors[1:], errors[:-1]).pvalue > P_MIN
    assert stats.pearsonr(range_error, bearing_error).pvalue > P_MIN


def test_reported_pose_is_off_by_one_offset_and_one_turn_a_pass() -> None:
    poses = poses_at((0.0, 0.0, 0.1), (5.0, 1.0, 0.2), (10.0, 2.0, 0.3))
    offsets, turns = [], []
    for vehicle in range(3000):
        reported = reported_poses(poses, NOISY, pass_streams(4, replicate=1, vehicle=vehicle).pose)
        offset, turn = reported.xy_m - poses.xy_m, reported.heading_rad - poses.heading_rad
        np.testing.assert_allclose(offset, offset[[0, 0, 0]], atol=1e-12)
        np.testing.assert_allclose(turn, turn[0], atol=1e-12)
        offsets.append(offset[0])
        turns.append(np.rad2deg(turn[0]))
    east, north = np.array(offsets).T
    assert stats.kstest(east, "norm", (0, 1.7)).pvalue > P_MIN
    assert stats.kstest(north, "norm", (0, 1.7)).pvalue > P_MIN
    assert stats.kstest(turns, "norm", (0, 0.5)).pvalue > P_MIN
    assert stats.pearsonr(east, north).pvalue > P_MIN


def test_projection_turns_range_and_bearing_by_the_reported_heading() -> None:
    seen = Sightings(np.array([1]), np.array([0]), np.array([10.0]), np.array([np.pi / 6]))
    xy_m, azimuth_rad = projected(seen, poses_at((9.0, 9.0, 9.0), (100.0, 50.0, np.pi / 3)))
    np.testing.assert_allclose(xy_m, [[100.0, 60.0]], atol=1e-12)  # 60° + 30°: north
    np.testing.assert_allclose(azimuth_rad, np.pi / 2)


@pytest.mark.parametrize("rate", [0.0, 0.1, 0.37, 1.0])
def test_signs_are_missed_at_the_false_negative_rate(rate: float) -> None:
    kept = keep_detected(20_000, rate, np.random.default_rng(6))
    assert stats.binomtest(int((~kept).sum()), 20_000, rate).pvalue > P_MIN
    if 0 < rate < 1:
        both = np.histogram2d(kept[1:], kept[:-1], bins=2)[0]
        assert stats.chi2_contingency(both).pvalue > P_MIN  # one frame says nothing about the next


def test_recognition_keeps_the_class_or_takes_any_other_alike() -> None:
    true = np.full(30_000, 2)
    seen = recognised(true, n_classes=6, semantic_rate=0.9, rng=np.random.default_rng(7))
    counts = np.bincount(seen, minlength=6)
    assert stats.binomtest(int(counts[2]), 30_000, 0.9).pvalue > P_MIN
    assert stats.chisquare(np.delete(counts, 2)).pvalue > P_MIN
    never = recognised(true, n_classes=6, semantic_rate=0.0, rng=np.random.default_rng(7))
    assert not (never == 2).any()


def test_one_class_cannot_be_confused() -> None:
    true = np.zeros(5, dtype=np.int64)
    assert (recognised(true, n_classes=1, semantic_rate=1.0, rng=np.random.default_rng(0)) == 0).all()
    with pytest.raises(ValueError, match="one class"):
        recognised(true, n_classes=1, semantic_rate=0.9, rng=np.random.default_rng(0))


@pytest.mark.parametrize(("draw", "is_constant"), [("track", True), ("frame", False)])
def test_classes_are_drawn_once_a_sign_and_pass_or_once_a_frame(
    street: tuple[Poses, SignField], draw: str, *, is_constant: bool
) -> None:
    model = replace(EXACT, semantic_rate=0.5, semantic_draw=draw)
    rates = []
    for vehicle in range(60):
        seen = sense_pass(*street, model, pass_streams(8, replicate=0, vehicle=vehicle)).detections
        order = np.argsort(seen.sign, kind="stable")
        changes = (np.diff(seen.class_code[order]) != 0) & (np.diff(seen.sign[order]) == 0)
        assert changes.any() != is_constant
        first = np.unique(seen.sign, return_index=True)[1]
        rates.append(seen.class_code[first] == street[1].class_code[seen.sign[first]])
    kept = np.concatenate(rates)
    assert stats.binomtest(int(kept.sum()), len(kept), 0.5).pvalue > P_MIN


def test_ghost_rate_is_per_hectare_and_frame() -> None:
    paper = SensorModel(100.0, 60.0, ghost_rate_per_ha=0.02)
    assert paper.cone_area_m2 == pytest.approx(5235.99, abs=0.01)  # ½ r² FOV
    assert paper.ghosts_per_frame == pytest.approx(0.010472, abs=1e-6)


def test_ghosts_are_poisson_and_uniform_over_the_cone() -> None:
    n_frames = 20_000
    rng = np.random.default_rng(9)
    seen, class_code = ghosts(ghost_frames(n_frames, NOISY, rng), n_classes=5, model=NOISY, rng=rng)
    rate = NOISY.ghosts_per_frame
    assert rate == pytest.approx(2.0 * 0.1309, rel=1e-3)
    counts = np.bincount(np.minimum(np.bincount(seen.frame, minlength=n_frames), 3), minlength=4)
    chances = stats.poisson.pmf(np.arange(3), rate)
    assert stats.chisquare(counts, n_frames * np.append(chances, 1 - chances.sum())).pvalue > P_MIN
    assert stats.kstest((seen.range_m / 50.0) ** 2, "uniform").pvalue > P_MIN
    assert stats.kstest(np.rad2deg(seen.bearing_rad), "uniform", (-30.0, 60.0)).pvalue > P_MIN
    assert stats.chisquare(np.bincount(class_code, minlength=5)).pvalue > P_MIN
    assert (seen.sign == GHOST).all()
    assert (np.diff(seen.frame) >= 0).all()


def test_ghosts_join_the_signs_in_frame_order(street: tuple[Poses, SignField]) -> None:
    seen = sense_pass(*street, NOISY, pass_streams(1, replicate=0, vehicle=0)).detections
    assert (np.diff(seen.frame) >= 0).all()
    assert (seen.sign == GHOST).sum() > 20
    assert len(seen.frame) == len(seen.sign) == len(seen.class_code) == len(seen.xy_m) == len(seen.azimuth_rad)


def test_a_draw_depends_on_seed_replicate_vehicle_and_pass_alone() -> None:
    def first(seed: int, **keys: int) -> tuple[float, ...]:
        streams = pass_streams(seed, **keys)
        return tuple(
            float(getattr(streams, name).random()) for name in ("calibration", "pose", "frames", "classes", "ghosts")
        )

    draws = [
        first(seed, replicate=r, vehicle=v, pass_number=p)
        for seed in (0, 1)
        for r in (0, 1)
        for v in (0, 1)
        for p in (0, 1)
    ]
    assert first(1, replicate=0, vehicle=1, pass_number=1) == draws[11]
    assert len({number for draw in draws for number in draw[1:]}) == 16 * 4
    assert len({draw[0] for draw in draws}) == 8  # a vehicle keeps its calibration


def test_streams_are_those_of_numpys_spawn_keys() -> None:
    for seed, replicate, vehicle, pass_number in ((0, 0, 0, 0), (7, 3, 99_999, 1), (2**63 - 1, 99_999, 12, 0)):
        ours = pass_streams(seed, replicate=replicate, vehicle=vehicle, pass_number=pass_number).frames
        spawned = np.random.SeedSequence(seed, spawn_key=(replicate, vehicle, pass_number, 2))
        np.testing.assert_array_equal(ours.random(8), np.random.Generator(np.random.PCG64(spawned)).random(8))


def test_one_error_source_leaves_the_draws_of_the_others_alone(street: tuple[Poses, SignField]) -> None:
    quiet = replace(NOISY, ghost_rate_per_ha=0.0)
    with_ghosts = sense_pass(*street, NOISY, pass_streams(1, replicate=0, vehicle=0)).detections
    without = sense_pass(*street, quiet, pass_streams(1, replicate=0, vehicle=0)).detections
    real = with_ghosts.sign != GHOST
    np.testing.assert_array_equal(with_ghosts.xy_m[real], without.xy_m)


def test_frames_are_equally_spaced_and_head_along_the_drive() -> None:
    along = np.array([0.0, 3.0, 10.0, 11.0, 40.0])
    line = drive_line(np.column_stack((along, along)), np.zeros(5, dtype=np.int64))
    poses = resample(line, spacing_m=2.0, heading_baseline_m=9.0)
    np.testing.assert_allclose(np.hypot(*np.diff(poses.xy_m, axis=0).T), 2.0)
    np.testing.assert_allclose(poses.heading_rad, np.pi / 4)
    assert len(poses.along_m) == 29  # 56.6 m


def test_corners_turn_smoothly_and_the_heading_is_that_of_the_averaged_line() -> None:
    corner = np.concatenate((np.column_stack((np.arange(0, 50.0), np.zeros(50))), [(50.0, y) for y in range(50)]))
    poses = resample(drive_line(corner, np.zeros(100, dtype=np.int64)), spacing_m=1.0, heading_baseline_m=9.0)
    turns = np.diff(np.rad2deg(poses.heading_rad))
    assert turns.max() < 20
    assert turns.sum() == pytest.approx(90.0)
    assert poses.heading_rad[50] == pytest.approx(np.pi / 4)


def test_standing_still_is_no_motion() -> None:
    rng = np.random.default_rng(2)
    moving = np.column_stack((np.arange(0, 100.0), np.zeros(100)))
    parked = moving[50] + rng.normal(0, 0.02, (500, 2))
    line = drive_line(np.concatenate((moving[:50], parked, moving[50:])), np.zeros(600, dtype=np.int64))
    assert line.along_m[-1] == pytest.approx(99.0, abs=0.2)
    with pytest.raises(InputError, match="no motion"):
        drive_line(parked, np.zeros(500, dtype=np.int64))


def test_no_frame_lies_in_a_gap() -> None:
    ends = np.array([(0.0, 0.0), (10.0, 0.0), (60.0, 0.0), (60.0, 10.0), (90.0, 90.0)])
    line = drive_line(ends, np.array([0, 0, 1, 1, 2]))  # segment 2 is one point: it has no heading
    poses = resample(line, spacing_m=5.0, heading_baseline_m=9.0)
    np.testing.assert_allclose(poses.xy_m, [(0, 0), (5, 0), (10, 0), (60, 0), (60, 5), (60, 10)])
    np.testing.assert_allclose(poses.heading_rad, [0, 0, 0, np.pi / 2, np.pi / 2, np.pi / 2], atol=1e-12)


@pytest.mark.parametrize(
    ("points", "message"),
    [([(0.0, 0.0)], "no motion"), ([(0.0, 0.0), (np.nan, 1.0)], "not finite"), ([(0.0, 0.0), (1.0, 0.0)], "spacing")],
)
def test_a_drive_that_goes_nowhere_is_refused(points: list[tuple[float, float]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        resample(drive_line(np.array(points), np.zeros(len(points), int)), spacing_m=2.0, heading_baseline_m=9.0)


def test_lateral_wander_has_its_sigma_and_correlation() -> None:
    base = Poses(np.column_stack((np.arange(0, 400.0, 2), np.zeros(200))), np.zeros(200), np.arange(0, 400.0, 2))
    rng = np.random.default_rng(11)
    passes = [wander(base, sigma_m=0.4, correlation_m=50.0, spacing_m=2.0, rng=rng) for _ in range(2000)]
    offset = np.array([way.xy_m[:, 1] for way in passes])
    for frame in (0, 100, 199):  # stationary: as wide at the ends as in the middle
        assert stats.kstest(offset[:, frame], "norm", (0, 0.4)).pvalue > P_MIN
    correlation = np.corrcoef(offset[:, 100], offset[:, 125])[0, 1]
    assert correlation == pytest.approx(np.exp(-0.5), abs=0.04)  # 50 m apart
    way = passes[0]
    motion = np.arctan2(*np.diff(way.xy_m, axis=0).T[::-1])
    np.testing.assert_allclose((way.heading_rad[1:] + way.heading_rad[:-1]) / 2, motion, atol=1e-3)
    assert wander(base, sigma_m=0.0, correlation_m=50.0, spacing_m=2.0, rng=rng) is base
