"""The vehicle's tracker: exact assignment, the life of a track, and what is sent."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, permutations

import numpy as np
import pytest
from scipy import stats
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from geofleet.algorithms.sensing import GHOST, FrameDetections, SignField
from geofleet.algorithms.sensing_chain import sense_pass
from geofleet.algorithms.sensor_model import SensorModel
from geofleet.algorithms.streams import pass_streams
from geofleet.algorithms.tracking import TrackerModel, split_tracks, summarise, track_ideal, track_paper, track_pass
from geofleet.algorithms.tracking_kernels import match_within
from geofleet.algorithms.trajectory import Poses

GATE_M = 2.0
PAPER = TrackerModel(
    tracker="paper",
    track_gate_m=GATE_M,
    track_reference="last",
    max_missed_frames=3,
    min_track_frames=1,
    end_on_leaving_view=False,
    range_m=100.0,
    half_fov_rad=np.deg2rad(30),
)


def frames_of(
    *rows: tuple[int, float, float], classes: list[int] | None = None, signs: list[int] | None = None
) -> tuple[FrameDetections, Poses]:
    """Detections (frame, east, north) of a car that drives east at 2 m a frame from the origin."""
    frame, east, north = np.array(rows, dtype=float).T
    n, n_frames = len(rows), int(frame.max()) + 6
    seen = FrameDetections(
        frame.astype(np.int64),
        np.array(signs or [0] * n),
        np.array(classes or [0] * n),
        np.column_stack((east, north)),
        np.linspace(10, 20, n),
        np.zeros(n),
        n_frames,
    )
    along = 2.0 * np.arange(n_frames)
    return seen, Poses(np.column_stack((along, np.zeros(n_frames))), np.zeros(n_frames), along)


def cost_of(distance: np.ndarray, partner: np.ndarray) -> tuple[int, float]:
    rows = np.flatnonzero(partner >= 0)
    assert len(set(partner[rows])) == len(rows)
    chosen = distance[rows, partner[rows]]
    assert (chosen < GATE_M).all()
    return -len(rows), float(chosen.sum())


def brute_force(distance: np.ndarray) -> tuple[int, float]:
    n_rows, n_columns = distance.shape
    best = (0, 0.0)
    for size in range(1, min(n_rows, n_columns) + 1):
        for rows in combinations(range(n_rows), size):
            for columns in permutations(range(n_columns), size):
                chosen = distance[list(rows), list(columns)]
                if (chosen < GATE_M).all():
                    best = min(best, (-size, float(chosen.sum())))
    return best


def by_scipy(distance: np.ndarray) -> np.ndarray:
    """Return the partner of each row: pairs beyond the gate cost more than all others together."""
    partner = np.full(len(distance), -1)
    allowed = distance < GATE_M
    rows, columns = linear_sum_assignment(np.where(allowed, distance, 1e4))
    kept = allowed[rows, columns]
    partner[rows[kept]] = columns[kept]
    return partner


def test_assignment_equals_brute_force_on_small_cases() -> None:
    rng = np.random.default_rng(0)
    contested = 0
    for _ in range(400):
        a, b = rng.uniform(0, 4, (rng.integers(1, 5), 2)), rng.uniform(0, 4, (rng.integers(1, 5), 2))
        distance = cdist(a, b)
        assert cost_of(distance, match_within(a, b, GATE_M)) == pytest.approx(brute_force(distance))
        contested += int(((distance < GATE_M).sum(axis=0) > 1).any())
    assert contested > 100


@pytest.mark.parametrize(("n_a", "n_b", "width_m"), [(40, 40, 8.0), (60, 25, 12.0), (10, 80, 10.0), (50, 50, 60.0)])
def test_assignment_equals_scipy_on_random_cases(n_a: int, n_b: int, width_m: float) -> None:
    rng = np.random.default_rng(n_a)
    for _ in range(50):
        a, b = rng.uniform(0, width_m, (n_a, 2)), rng.uniform(0, width_m, (n_b, 2))
        distance = cdist(a, b)
        assert cost_of(distance, match_within(a, b, GATE_M)) == pytest.approx(cost_of(distance, by_scipy(distance)))


def test_more_pairs_win_over_nearer_ones() -> None:
    tracks, seen = np.array([[0.0, 0.0], [1.0, 0.0]]), np.array([[1.1, 0.0], [2.5, 0.0]])
    np.testing.assert_array_equal(match_within(tracks, seen, GATE_M), [0, 1])


def test_the_gate_is_strict() -> None:
    here = np.array([[0.0, 0.0]])
    assert match_within(here, np.array([[2.0, 0.0]]), GATE_M)[0] == -1
    assert match_within(here, np.array([[1.999, 0.0]]), GATE_M)[0] == 0


@pytest.mark.parametrize(("last_frame", "n_tracks"), [(4, 1), (5, 2)])
def test_a_track_survives_three_missed_frames(last_frame: int, n_tracks: int) -> None:
    seen, poses = frames_of((0, 50.0, 0.0), (last_frame, 50.0, 0.0))
    assert track_paper(seen, poses, PAPER).max() + 1 == n_tracks


def test_the_reference_is_the_last_position_or_the_mean() -> None:
    rows = [(frame, 50.0 + 0.9 * frame, 0.0) for frame in range(6)]  # a bias moves the projection
    seen, poses = frames_of(*rows)
    assert track_paper(seen, poses, PAPER).max() == 0
    # means 50, 50.45, 50.9 … lag behind: frame 4 is 2.25 m away
    np.testing.assert_array_equal(track_paper(seen, poses, replace(PAPER, track_reference="mean")), [0, 0, 0, 0, 1, 1])


def test_a_track_out_of_view_ends_when_asked() -> None:
    # at frame 3 the car is at 6 m; (7, 5) lies 79° to the left, outside the cone of 60°
    seen, poses = frames_of((0, 17.0, 5.0), (1, 7.0, 5.0), (2, 17.0, 5.0), (4, 7.0, 5.0), (5, 17.0, 5.0))
    assert track_paper(seen, poses, PAPER).tolist() == [0, 1, 0, 1, 0]
    assert track_paper(seen, poses, replace(PAPER, end_on_leaving_view=True)).tolist() == [0, 1, 0, 2, 0]


def test_short_tracks_are_not_sent_and_the_rest_keep_their_order() -> None:
    seen, poses = frames_of(
        (0, 90.0, 0.0), (0, 50.0, 0.0), (1, 50.1, 0.0), (1, 30.0, 9.0), (2, 50.2, 0.0), (2, 30.0, 9.0)
    )
    sent = track_pass(seen, poses, replace(PAPER, min_track_frames=2))
    np.testing.assert_allclose(sent.xy_m, [[50.1, 0.0], [30.0, 9.0]])
    assert sent.n_frames.tolist() == [3, 2]
    assert sent.frame_first.tolist() == [0, 1]
    assert sent.frame_last.tolist() == [2, 2]


def test_mean_and_spread_are_those_of_numpy_with_one_degree_of_freedom_less() -> None:
    rng = np.random.default_rng(3)
    points = np.array([5e4, -3e4]) + rng.normal(0, 0.3, (50, 2))
    seen, _ = frames_of(*((k, *point) for k, point in enumerate(points)))
    sent = summarise(seen, np.repeat([0, 1], [49, 1]), min_track_frames=1)
    cov = np.cov(points[:49].T, ddof=1)
    np.testing.assert_allclose(sent.xy_m, [points[:49].mean(axis=0), points[49]], atol=1e-9)
    np.testing.assert_allclose([sent.sigma_e_m[0], sent.sigma_n_m[0]], np.sqrt(np.diag(cov)), rtol=1e-6)
    np.testing.assert_allclose(sent.cov_en_m2[0], cov[0, 1], rtol=1e-6)
    assert np.isnan([sent.sigma_e_m[1], sent.sigma_n_m[1], sent.cov_en_m2[1]]).all()  # F = 1
    np.testing.assert_allclose(sent.range_mean_m, [seen.range_m[:49].mean(), 20.0])


def test_direction_of_view_is_averaged_round_the_circle() -> None:
    seen, _ = frames_of((0, 0.0, 0.0), (1, 0.0, 0.0))
    west = replace(seen, azimuth_rad=np.deg2rad([175.0, -175.0]))
    assert abs(summarise(west, np.zeros(2, int), min_track_frames=1).azimuth_rad[0]) == pytest.approx(np.pi)


def test_class_and_origin_by_vote() -> None:
    rows = [(k, 50.0, 0.0) for k in range(5)]
    seen, _ = frames_of(*rows, classes=[4, 1, 4, 1, 0], signs=[7, 7, GHOST, 7, GHOST])
    sent = summarise(seen, np.zeros(5, int), min_track_frames=1)
    assert (sent.class_code[0], sent.class_confidence[0], sent.sign[0]) == (1, 0.4, 7)  # of equals the smallest
    tie, _ = frames_of(*rows[:2], signs=[GHOST, 3])
    assert summarise(tie, np.zeros(2, int), min_track_frames=1).sign[0] == 3
    lone, _ = frames_of(*rows[:1], signs=[GHOST])
    assert summarise(lone, np.zeros(1, int), min_track_frames=1).sign[0] == GHOST


def test_ideal_gives_one_track_a_sign_and_one_a_ghost() -> None:
    seen, poses = frames_of(*((k, 50.0 + 9 * k, 0.0) for k in range(6)), signs=[5, GHOST, 2, 5, GHOST, 2])
    assert track_ideal(seen).tolist() == [0, 1, 2, 0, 3, 2]
    assert track_pass(seen, poses, replace(PAPER, tracker="ideal")).sign.tolist() == [5, GHOST, 2, GHOST]


def test_a_pass_without_detections_sends_nothing() -> None:
    none = np.empty(0, dtype=np.int64)
    seen = FrameDetections(none, none, none, np.empty((0, 2)), np.empty(0), np.empty(0), 5)
    poses = frames_of((0, 0.0, 0.0))[1]
    for tracker in ("paper", "ideal"):
        assert len(track_pass(seen, poses, replace(PAPER, tracker=tracker)).n_frames) == 0


@pytest.fixture(scope="module")
def sensed() -> tuple[FrameDetections, Poses]:
    rng = np.random.default_rng(4)
    places = np.column_stack((rng.uniform(0, 800, 60), rng.choice([-6.0, 6.0], 60)))
    places = np.concatenate((places, places[:20] + np.array([0.05, 0.0])))  # shared poles
    along = np.arange(0, 700, 2.0)
    poses = Poses(np.column_stack((along, np.zeros(350))), np.zeros(350), along)
    signs = SignField(places, rng.integers(0, 9, 80), n_classes=9, cell_m=100.0)
    noisy = SensorModel(100.0, 60.0, 1.7, 0.0, 2.4, 1.2, 0.5, 0.3, 0.1, 0.95, "frame", 0.5)
    result = sense_pass(poses, signs, noisy, pass_streams(0, replicate=0, vehicle=3))
    return result.detections, result.reported


@pytest.mark.parametrize("reference", ["last", "mean"])
@pytest.mark.parametrize("end_on_leaving_view", [False, True])
def test_the_tracker_equals_a_plain_loop_with_scipy(
    sensed: tuple[FrameDetections, Poses], reference: str, *, end_on_leaving_view: bool
) -> None:
    model = replace(PAPER, track_reference=reference, end_on_leaving_view=end_on_leaving_view)
    track = track_paper(*sensed, model)
    assert track.max() > 100
    np.testing.assert_array_equal(track, plain_tracker(*sensed, model))


def plain_tracker(seen: FrameDetections, poses: Poses, model: TrackerModel) -> np.ndarray:
    """Track frame by frame in Python, to be read beside the paper."""
    track = np.full(len(seen.frame), -1)
    members: list[list[int]] = []
    live: list[int] = []
    for frame in range(seen.n_frames):
        live = [t for t in live if frame - seen.frame[members[t][-1]] - 1 <= model.max_missed_frames]
        rows = np.flatnonzero(seen.frame == frame)
        places = {t: seen.xy_m[members[t]] for t in live}
        at = {t: p.mean(axis=0) if model.track_reference == "mean" else p[-1] for t, p in places.items()}
        if live and len(rows):
            distance = cdist(np.array([at[t] for t in live]), seen.xy_m[rows])
            for t, column in zip(live, by_scipy(distance), strict=True):
                if column >= 0:
                    track[rows[column]] = t
                    members[t].append(int(rows[column]))
        for i in rows[track[rows] < 0]:
            track[i] = len(members)
            members.append([int(i)])
            live.append(int(track[i]))
        if model.end_on_leaving_view:
            live = [t for t in live if seen.frame[members[t][-1]] == frame or _in_cone(at[t], poses, frame, model)]
    return track


def _in_cone(place: np.ndarray, poses: Poses, frame: int, model: TrackerModel) -> bool:
    step = place - poses.xy_m[frame]
    bearing = np.arctan2(step[1], step[0]) - poses.heading_rad[frame]
    bearing = np.arctan2(np.sin(bearing), np.cos(bearing))
    return bool(np.hypot(*step) < model.range_m and abs(bearing) < model.half_fov_rad)


def test_a_share_of_the_tracks_is_sent_in_two_parts_that_never_share_a_frame() -> None:
    length = np.tile([4, 6, 9, 30], 1000)
    track = np.random.default_rng(1).permutation(np.repeat(np.arange(len(length)), length))
    order = np.unique(track, return_index=True)[1].argsort()
    track = np.argsort(order)[track]  # by birth
    length = np.bincount(track)
    parts = split_tracks(track, rate=0.3, min_track_frames=3, rng=np.random.default_rng(2))
    first_row = np.unique(parts, return_index=True)[1]
    assert (np.diff(first_row) > 0).all()  # numbered by birth
    origin, size = track[first_row], np.bincount(parts)
    n_parts = np.bincount(origin)
    assert (n_parts[length < 6] == 1).all()
    assert stats.binomtest(int((n_parts[length >= 6] == 2).sum()), int((length >= 6).sum()), 0.3).pvalue > 0.001
    assert size.min() >= 3
    last_row = len(parts) - 1 - np.unique(parts[::-1], return_index=True)[1]
    two = np.flatnonzero(n_parts[origin] == 2)
    for k in range(len(length)):
        if n_parts[k] == 2:
            a, b = two[origin[two] == k]
            assert last_row[a] < first_row[b]
    longest = two[(length[origin[two]] == 30) & (first_row[two] == np.unique(track, return_index=True)[1][origin[two]])]
    assert stats.chisquare(np.bincount(size[longest], minlength=28)[3:28]).pvalue > 0.001


def test_to_split_tracks_takes_random_numbers() -> None:
    seen, reported = frames_of(*[(k, 30.0, 5.0) for k in range(10)])
    model = replace(PAPER, split_track_rate=1.0)
    with pytest.raises(ValueError, match="streams of the pass"):
        track_pass(seen, reported, model)
    halves = track_pass(seen, reported, model, pass_streams(0, replicate=0, vehicle=0))
    assert len(halves.n_frames) == 2
