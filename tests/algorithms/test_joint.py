"""Joint fusion against arithmetic by hand, a dense solver, and what must hold whatever the fleet."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from geofleet.algorithms import joint_solution
from geofleet.algorithms.joint import fuse_joint
from geofleet.algorithms.joint_alignment import align_passes
from geofleet.algorithms.joint_evidence import Support, class_posterior, existence, recognition
from geofleet.algorithms.joint_search import PriorMap
from geofleet.algorithms.joint_solution import solve
from geofleet.algorithms.joint_tracks import Passes, Tracks, tracks_of_means

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.joint import JointMap

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

GNSS_SIGMA_M, TRACK_SIGMA_M = 1.5, 0.1


def point_tracks(pass_code: Ints, class_code: Ints, xy_m: Floats, sigma_m: float) -> Tracks:
    """Return tracks that know their place to `sigma_m` an axis and nothing of the bias; their frames are not told."""
    n = len(pass_code)
    matrix = np.zeros((n, 4, 4))
    matrix[:, 0, 0] = matrix[:, 1, 1] = sigma_m**-2
    unknown, none = np.full(n, -1), np.zeros(n)
    return Tracks(pass_code, class_code, xy_m, matrix, np.zeros((n, 4)), unknown, unknown, none, none)


def plain_passes(n: int, sigma_m: float = GNSS_SIGMA_M) -> Passes:
    return Passes(np.full(n, sigma_m), np.zeros((n, 2)), np.zeros(n, np.int64))


def fleet(n_passes: int = 8, n_signs: int = 24, noise_m: float = 0.0, seed: int = 1) -> tuple[Floats, Ints, Tracks]:
    """Return signs, their classes, and tracks of passes whose offsets sum to zero (the common one is out of reach)."""
    rng = np.random.default_rng(seed)
    signs = np.column_stack((np.arange(n_signs) * 23.7, rng.uniform(-8, 8, n_signs)))
    classes = rng.integers(0, 4, n_signs)
    offset = rng.normal(0, GNSS_SIGMA_M, (n_passes, 2))
    offset -= offset.mean(axis=0)
    code, sign = (a.ravel() for a in np.indices((n_passes, n_signs)))
    xy_m = signs[sign] + offset[code] + rng.normal(0, noise_m, (len(code), 2))
    return signs, classes, point_tracks(code, classes[sign], xy_m, TRACK_SIGMA_M)


def fused(tracks: Tracks, n_passes: int = 8, prior: PriorMap | None = None) -> JointMap:
    return fuse_joint(tracks, plain_passes(n_passes), n_classes=4, prior=prior)


def by_place(found: JointMap) -> Floats:
    order = np.lexsort((found.xy_m[:, 1], np.round(found.xy_m[:, 0], 3)))
    return found.xy_m[order]


def test_two_cars_and_three_signs_by_hand() -> None:
    """The digits of docs/fusion.md."""
    tracks = point_tracks(
        np.array([0, 0, 1, 1]), np.zeros(4, np.int64), np.array([[1.0, 0], [11, 0], [9, 0], [19, 0]]), 0.5
    )
    found = solve(tracks, plain_passes(2, 1.0), np.array([0, 1, 1, 2]), 3, np.zeros((2, 4)), with_cov=True)
    np.testing.assert_allclose(found.xy_m, [[0.2, 0], [10, 0], [19.8, 0]], atol=1e-9)
    np.testing.assert_allclose(found.nuisance[:, :2], [[0.8, 0], [-0.8, 0]], atol=1e-9)
    np.testing.assert_allclose(found.cov_m2, np.array([0.85, 0.625, 0.85])[:, None, None] * np.eye(2), atol=1e-9)


def with_bias(n_signs: int = 7, seed: int = 3) -> tuple[Tracks, Passes, Ints, int]:
    """Return tracks that bind place and bias together, of an association that is known."""
    rng = np.random.default_rng(seed)
    n_passes = 5
    code, sign = (a.ravel() for a in np.indices((n_passes, n_signs)))
    n = len(code)
    bias_sigma = np.tile([2.0, 0.05], (n_passes, 1))
    xy_m = np.column_stack((sign * 20.0, np.zeros(n))) + rng.normal(0, 1, (n, 2))
    matrix, vector = tracks_of_means(
        xy_m,
        n_frames=np.full(n, 9.0),
        spread=rng.uniform(0.5, 2, (n, 3)) * [1, 1, 0.1],
        range_m=rng.uniform(10, 40, n),
        azimuth_rad=rng.uniform(-3, 3, n),
        bias_sigma=bias_sigma[code],
    )
    plain = point_tracks(code, np.zeros(n, np.int64), xy_m, 1.0)
    return (
        replace(plain, matrix=matrix, vector=vector),
        Passes(np.full(n_passes, 1.3), bias_sigma, np.zeros(n_passes, np.int64)),
        sign,
        n_signs,
    )


def dense(tracks: Tracks, passes: Passes, sign: Ints, n_signs: int) -> tuple[Floats, Floats]:
    """Return all unknowns, signs first, from one least-squares problem with nothing eliminated; and the covariance."""
    n = 2 * n_signs + 4 * len(passes.gnss_sigma_m)
    sigma = np.column_stack((passes.gnss_sigma_m, passes.gnss_sigma_m, passes.bias_sigma))
    system, right = np.zeros((n, n)), np.zeros(n)
    system[2 * n_signs :, 2 * n_signs :] = np.diag(1 / sigma.ravel() ** 2)
    for i, (j, v) in enumerate(zip(sign, tracks.pass_code, strict=True)):
        design = np.zeros((4, n))
        design[:2, 2 * j : 2 * j + 2] = np.eye(2)
        design[:, 2 * n_signs + 4 * v : 2 * n_signs + 4 * v + 4] = np.eye(4)
        system += design.T @ tracks.matrix[i] @ design
        about = np.append(tracks.origin_xy_m[i], [0, 0])
        right += design.T @ (tracks.vector[i] + tracks.matrix[i] @ about)
    return np.linalg.solve(system, right), np.linalg.inv(system)


@pytest.mark.parametrize("dense_share", [0.05, 2.0])
@pytest.mark.parametrize("dense_unknowns", [5000, 0])
@pytest.mark.parametrize("n_signs", [7, 12])  # of five passes: of the more, signs are eliminated where that is dense
def test_elimination_equals_least_squares_with_all_unknowns(
    monkeypatch: pytest.MonkeyPatch, n_signs: int, dense_unknowns: int, dense_share: float
) -> None:
    monkeypatch.setattr(joint_solution, "DENSE_UNKNOWNS", dense_unknowns)
    monkeypatch.setattr(joint_solution, "DENSE_SHARE", dense_share)
    tracks, passes, sign, _ = with_bias(n_signs)
    found = solve(tracks, passes, sign, n_signs, np.zeros((5, 4)), with_cov=True, marginal_of=2)
    x, cov = dense(tracks, passes, sign, n_signs)
    np.testing.assert_allclose(found.xy_m.ravel(), x[: 2 * n_signs], atol=1e-8)
    np.testing.assert_allclose(found.nuisance.ravel(), x[2 * n_signs :], atol=1e-8)
    for j in range(n_signs):
        block = slice(2 * j, 2 * j + 2)
        np.testing.assert_allclose(found.cov_m2[j], cov[block, block], atol=1e-9)
    third = slice(2 * n_signs + 8, 2 * n_signs + 12)
    assert found.marginal_cov is not None
    np.testing.assert_allclose(found.marginal_cov, cov[third, third], atol=1e-9)


def test_covariances_of_signs_that_nothing_couples_are_found_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each pass here reports a sign or two: what the sparse solver finds part by part, the dense one finds at once."""
    rng = np.random.default_rng(4)
    sign = np.array([0, 1, 1, 2, 3, 3, 4, 5])
    passes = np.array([0, 0, 1, 2, 3, 4, 5, 5])
    tracks = point_tracks(passes, np.zeros(8, np.int64), rng.normal(0, 50, (8, 2)), 0.3)
    whole = solve(tracks, plain_passes(6), sign, 6, np.zeros((6, 4)), with_cov=True)
    monkeypatch.setattr(joint_solution, "DENSE_UNKNOWNS", 0)
    by_part = solve(tracks, plain_passes(6), sign, 6, np.zeros((6, 4)), with_cov=True)
    np.testing.assert_allclose(by_part.cov_m2, whole.cov_m2, atol=1e-9)
    np.testing.assert_allclose(by_part.xy_m, whole.xy_m, atol=1e-9)


def test_where_it_is_expanded_about_does_not_matter() -> None:
    tracks, passes, sign, n_signs = with_bias()
    one = solve(tracks, passes, sign, n_signs, np.zeros((5, 4)), with_cov=False)
    two = solve(tracks, passes, sign, n_signs, np.full((5, 4), 0.3), with_cov=False)
    np.testing.assert_allclose(one.xy_m, two.xy_m, atol=1e-8)


def test_without_noise_the_map_is_exact() -> None:
    signs, classes, tracks = fleet()
    found = fused(tracks)
    np.testing.assert_allclose(by_place(found), signs, atol=1e-6)
    assert found.is_settled
    assert sorted(found.class_code) == sorted(classes)
    assert (found.n_passes == 8).all()


def test_a_track_on_the_edge_of_a_cell_keeps_its_sign() -> None:
    """Signs 25 m apart put tracks 15 cells of 15 m from the least one, where rounding decides which cell it is."""
    _, _, tracks = fleet()
    number = np.tile(np.arange(24), 8)
    xy_m = tracks.origin_xy_m + np.column_stack((number * (25.0 - 23.7), np.zeros(len(number))))
    assert fused(replace(tracks, origin_xy_m=xy_m)).is_settled


def test_a_rigid_motion_of_everything_moves_the_map() -> None:
    _, _, tracks = fleet(noise_m=0.1)
    turn = np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]])
    moved = fused(replace(tracks, origin_xy_m=tracks.origin_xy_m @ turn.T + [120.0, -45.0]))
    np.testing.assert_allclose(by_place(moved), _sorted(fused(tracks).xy_m @ turn.T + [120.0, -45.0]), atol=1e-5)


def _sorted(xy_m: Floats) -> Floats:
    return xy_m[np.lexsort((xy_m[:, 1], np.round(xy_m[:, 0], 3)))]


def test_order_of_tracks_within_a_pass_does_not_matter() -> None:
    _, _, tracks = fleet(noise_m=0.1)
    order = np.lexsort((np.random.default_rng(5).random(len(tracks.pass_code)), tracks.pass_code))
    np.testing.assert_allclose(by_place(fused(tracks.take(order))), by_place(fused(tracks)), atol=1e-6)


def test_order_of_passes_does_not_matter() -> None:
    _, _, tracks = fleet(noise_m=0.1)
    code = np.random.default_rng(6).permutation(8)[tracks.pass_code]
    order = np.argsort(code, kind="stable")
    other = replace(tracks, pass_code=code).take(order)
    np.testing.assert_allclose(by_place(fused(other)), by_place(fused(tracks)), atol=1e-4)


def test_the_same_twice() -> None:
    _, _, tracks = fleet(noise_m=0.1)
    one, two = fused(tracks), fused(tracks)
    assert one.xy_m.tobytes() == two.xy_m.tobytes()
    assert one.cov_m2.tobytes() == two.cov_m2.tobytes()


@pytest.mark.parametrize(("last", "n_signs"), [(9, 2), (20, 3)])
def test_tracks_of_a_pass_are_two_signs_when_they_share_a_frame_and_one_when_they_do_not(
    last: int, n_signs: int
) -> None:
    separation_m = 0.4  # within what two fragments may differ by: 2.8 sigmas
    xy_m = np.array([[0.0, 0], [separation_m, 0], [60, 0]])
    tracks = point_tracks(np.zeros(3, np.int64), np.array([1, 1, 2]), xy_m, TRACK_SIGMA_M)
    told = replace(tracks, frame_first=np.array([0, 10, 0]), frame_last=np.array([last, 30, 9]))
    assert len(fused(told, 1).xy_m) == n_signs


def test_a_sign_of_nearly_all_passes_is_kept_and_a_ghost_of_some_is_not() -> None:
    n = np.array([95.0, 40.0, 1.0])
    view = np.full(3, 100.0)
    found = existence(Support(n, view, view, np.zeros(3), None, np.full(3, -1), 100, n_classes=4))
    assert found.probability[0] > 0.95
    assert (found.probability[1:] < 0.1).all()


def prior_support(n_passes: list[int], chances: float, in_view: int, moved_to: list[int] | None = None) -> Support:
    """Return evidence for signs of a fleet of `in_view` passes, the last of which the prior map does not hold."""
    n = np.array(n_passes, np.float64)
    every = np.ones(len(n))
    return Support(
        n,
        in_view * every,
        chances * every,
        0 * every,
        np.arange(len(n)) < len(n) - 1,
        np.array(moved_to) if moved_to else np.full(len(n), -1),
        in_view,
        n_classes=15,
    )


def test_an_entry_that_passes_drove_by_in_full_view_goes_and_one_in_brief_view_stays() -> None:
    many = [2] * 20
    assert existence(prior_support([0, *many], 2.0, 2)).probability[0] < 0.5
    assert existence(prior_support([0, *many], 0.5, 2)).probability[0] > 0.5


def test_missed_by_all_in_brief_view_is_no_proof_but_by_many_it_counts() -> None:
    """A brief view is alike for all passes: fifty misses are no fifty independent ones."""
    gone = [existence(prior_support([0, 50, 50], 0.3 * n, n)).probability[0] for n in (3, 50)]
    assert gone[0] > 0.5 > gone[1]
    assert gone[1] > 0.001


def test_an_entry_beside_a_new_sign_of_its_class_moved_there() -> None:
    """Unseen, it would stay; the new sign is likelier the same, moved, than a second of its class within ten metres."""
    reported = [1] * 20
    alone = existence(prior_support([0, *reported], 0.5, 1)).probability
    moved = existence(prior_support([0, *reported], 0.5, 1, [20, *[-1] * 20])).probability
    assert moved[0] < 0.5 < alone[0]
    np.testing.assert_allclose(moved[1:], alone[1:], atol=0.05)


def test_how_many_entries_stand_is_learnt_from_those_in_full_view() -> None:
    """Where most entries have gone, one that nobody could judge is likelier gone too."""
    n = np.array([1.0] * 30 + [0.0] * 31)
    view = np.append(np.ones(60), 0.0)
    fresh = existence(Support(np.append(np.ones(60), 0.0), view, view, 0 * n, n >= 0, np.full(61, -1), 1, 15))
    stale = existence(Support(n, view, view, 0 * n, n >= 0, np.full(61, -1), 1, 15))
    assert fresh.probability[-1] > 0.95
    assert 0.4 < stale.probability[-1] < 0.7


def test_classes_are_a_vote_of_log_confusions() -> None:
    read = recognition(np.array([0.1]), 3)
    log_posterior = class_posterior(np.zeros(3, np.int64), 1, np.array([0, 0, 1]), np.zeros(3, np.int64), read)
    likely = np.array([0.9**2 * 0.05, 0.05**2 * 0.9, 0.05**3])
    np.testing.assert_allclose(np.exp(log_posterior[0]), likely / likely.sum(), rtol=1e-9)


def test_passes_are_laid_right_although_signs_repeat_every_nine_metres() -> None:
    rng = np.random.default_rng(2)
    signs = np.column_stack((np.arange(12) * 9.0, np.zeros(12)))
    offset = np.vstack(([0.0, 0.0], rng.uniform(-3, 3, (5, 2))))
    xy_m = (signs[None] + offset[:, None]).reshape(-1, 2)
    found = align_passes(
        xy_m, np.full(72, 0.01), np.zeros(72, np.int64), np.arange(0, 73, 12), np.full(6, 3.0), cell_m=100.0
    )
    np.testing.assert_allclose(found - found[0], offset, atol=0.05)


@pytest.mark.parametrize("n_passes", [0, 3])
def test_without_tracks_the_map_is_empty(n_passes: int) -> None:
    none = point_tracks(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), 1.0)
    found = fused(none, n_passes)
    assert len(found.xy_m) == 0
    assert found.is_settled


def test_rows_that_are_passes_of_their_own_average() -> None:
    rng = np.random.default_rng(4)
    xy_m = rng.normal(0, 1.0, (30, 2))
    tracks = point_tracks(np.arange(30), np.ones(30, np.int64), xy_m, TRACK_SIGMA_M)
    found = fused(tracks, 30)
    assert len(found.xy_m) == 1
    np.testing.assert_allclose(found.xy_m[0], xy_m.mean(axis=0), atol=1e-6)


def prior_of(xy_m: Floats, classes: Ints) -> PriorMap:
    return PriorMap(xy_m, np.full(len(xy_m), 0.15), classes, np.zeros_like(xy_m))


def test_a_stale_prior_map_is_put_right() -> None:
    """Removed, moved, retyped and obsolete entries, all together, against a fleet of eight."""
    signs, classes, tracks = fleet(noise_m=0.05)
    old, old_classes = signs.copy(), classes.copy()
    old[5] += [5.0, 0.0]
    old_classes[9] = (old_classes[9] + 1) % 4
    kept = np.arange(len(signs)) != 2
    old = np.vstack((old[kept], [[37.0, 20.0]]))
    found = fused(tracks, prior=prior_of(old, np.append(old_classes[kept], 0)))
    reported = found.n_passes > 0
    np.testing.assert_allclose(_sorted(found.xy_m[reported]), signs, atol=0.3)
    order = np.argsort(found.xy_m[reported, 0])
    np.testing.assert_array_equal(found.class_code[reported][order], classes)


def test_an_entry_whose_sign_moved_is_not_a_second_sign_though_nobody_is_known_to_have_driven_by() -> None:
    signs, classes, tracks = fleet(3, noise_m=0.05)
    old = signs.copy()
    old[5] += [5.0, 0.0]
    old[9] += [20.0, 0.0]  # too far to have moved: a sign that is gone, or not yet seen
    some = slice(4, 12)
    found = fuse_joint(tracks, plain_passes(3), n_classes=4, prior=prior_of(old[some], classes[some]))
    there = found.xy_m[found.existence > 0.5]
    near = [(np.hypot(*(there - place).T) < 1).sum() for place in (signs[5], old[5], signs[9], old[9])]
    assert near == [1, 0, 1, 1]


def test_the_covariance_covers_a_prior_map_that_is_shifted() -> None:
    signs, classes, tracks = fleet(noise_m=0.05)
    found = fused(tracks, prior=prior_of(signs + np.array([1.0, 0.0]), classes))
    order = np.argsort(found.xy_m[:, 0])
    error = found.xy_m[order] - signs
    sigma = np.sqrt(np.diagonal(found.cov_m2[order], axis1=1, axis2=2))
    assert (np.abs(error) < 3 * sigma).all()
