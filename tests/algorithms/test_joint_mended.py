"""Ways in which joint fusion went wrong on simulated fleets, each made small, and properties of the algebra."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geofleet.algorithms.joint import fuse_joint
from geofleet.algorithms.joint_alignment import align_passes
from geofleet.algorithms.joint_association import Places, sweep
from geofleet.algorithms.joint_evidence import recognition
from geofleet.algorithms.joint_merging import merge
from geofleet.algorithms.joint_search import PriorMap, believed
from geofleet.algorithms.joint_solution import solve
from geofleet.algorithms.joint_tracks import Passes, Tracks, tracks_of_means

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.algorithms.joint import JointMap

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

N_CLASSES = 4
BIRTH_COST = float(np.log(N_CLASSES) - np.log(1e-3))
CONFUSION = recognition(np.array([0.05]), N_CLASSES).log_confusion
LOG_PRIOR = np.full(N_CLASSES, -np.log(N_CLASSES))


def point_tracks(pass_code: Ints, class_code: Ints, xy_m: Floats, sigma_m: float) -> Tracks:
    n = len(pass_code)
    matrix = np.zeros((n, 4, 4))
    matrix[:, 0, 0] = matrix[:, 1, 1] = sigma_m**-2
    unknown, none = np.full(n, -1), np.zeros(n)
    return Tracks(pass_code, class_code, xy_m, matrix, np.zeros((n, 4)), unknown, unknown, none, none)


def one_place(east_m: Floats, sigma_m: float = 0.1, pass_code: Ints | None = None) -> Places:
    """Return tracks of one class in a row, of a pass each, where all passes drove."""
    n = len(east_m)
    code = np.arange(n) if pass_code is None else pass_code
    n_passes = int(code.max()) + 1
    variance = np.full(n, sigma_m**2)
    return Places(
        np.column_stack((east_m, np.zeros(n))),
        np.column_stack((variance, variance, np.zeros(n))),
        np.zeros(n, np.int64),
        np.zeros(n, np.int64),
        np.full(n, -1),
        np.full(n, -1),
        np.searchsorted(code, np.arange(n_passes + 1)),
        np.full(n, n_passes),
    )


def test_one_outlying_track_does_not_grow_into_a_twin_of_its_sign() -> None:
    """The last track is 0.5 m off, a sign of its own; one at 0.3 m is nearer to it by chance and must not follow."""
    east_m = np.append(np.linspace(-0.1, 0.1, 10), [0.3, 0.5])
    twin = np.append(np.zeros(10, np.int64), [0, 1])
    found = sweep(one_place(east_m), twin, CONFUSION, LOG_PRIOR, birth_cost=BIRTH_COST)
    assert (found[:11] == 0).all()


def test_without_others_around_the_nearer_sign_takes_the_track() -> None:
    """The same where it is not known who drove by: only the distance counts, and the track at 0.3 m goes."""
    east_m = np.append(np.linspace(-0.1, 0.1, 10), [0.3, 0.5])
    places = one_place(east_m)._replace(n_around=np.zeros(12, np.int64))
    found = sweep(places, np.append(np.zeros(10, np.int64), [0, 1]), CONFUSION, LOG_PRIOR, birth_cost=BIRTH_COST)
    assert found[10] == found[11] != 0


def halves(apart_m: float) -> tuple[Floats, Ints]:
    """Return tracks of six passes that agree on one place, and of six that agree on another; and the two signs."""
    jitter = 0.02 * np.array([-1, 0, 1, -1, 0, 1])
    return np.concatenate((jitter, apart_m + jitter)), np.repeat([0, 1], 6)


@pytest.mark.parametrize(("apart_m", "n_signs"), [(1.5, 1), (6.0, 2)])
def test_passes_that_are_laid_askew_together_do_not_make_two_signs(apart_m: float, n_signs: int) -> None:
    """Each half reports the one place only; their covariances know nothing of what a half has in common."""
    east_m, sign = halves(apart_m)
    found = merge(one_place(east_m), sign, CONFUSION, LOG_PRIOR, birth_cost=BIRTH_COST)
    assert len(np.unique(found)) == n_signs


def test_two_signs_that_passes_report_both_stay_two() -> None:
    east_m, sign = halves(1.5)
    order = np.argsort(np.tile(np.arange(6), 2), kind="stable")
    both = one_place(east_m[order], pass_code=np.repeat(np.arange(6), 2))
    assert len(np.unique(merge(both, sign[order], CONFUSION, LOG_PRIOR, birth_cost=BIRTH_COST))) == 2


@pytest.mark.parametrize(("n_signs", "apart_m", "seed"), [(2, 9.0, 108), (4, 6.0, 26)])
def test_passes_that_made_two_copies_of_the_map_end_on_one(n_signs: int, apart_m: float, seed: int) -> None:
    """Two draws of twelve passes in which four and five of them found each other, a sign further on, and stayed."""
    rng = np.random.default_rng(seed)
    signs = np.column_stack((np.arange(n_signs) * apart_m, np.zeros(n_signs)))
    offset = rng.normal(0, 2.0, (12, 2))
    xy_m = (signs[None] + offset[:, None] + rng.normal(0, 0.3, (12, n_signs, 2))).reshape(-1, 2)
    n = len(xy_m)
    first = np.arange(0, n + 1, n_signs)
    found = align_passes(xy_m, np.full(n, 0.09), np.zeros(n, np.int64), first, np.full(12, 2.0), cell_m=100.0)
    apart = found - offset
    assert np.hypot(*(apart - np.median(apart, axis=0)).T).max() < 2


def fused(tracks: Tracks, n_passes: int, prior: PriorMap | None = None, sigma_m: float = 1.5) -> JointMap:
    passes = Passes(np.full(n_passes, sigma_m), np.zeros((n_passes, 2)), np.zeros(n_passes, np.int64))
    return fuse_joint(tracks, passes, n_classes=N_CLASSES, prior=prior)


@pytest.mark.parametrize("n_passes", [1, 4])
def test_a_run_of_a_single_track_is_that_track(n_passes: int) -> None:
    """Also where other passes drove and report nothing."""
    track = point_tracks(np.array([0]), np.array([2]), np.array([[12.0, -7.0]]), 0.1)
    for prior in (None, PriorMap(np.array([[500.0, 0.0]]), np.array([0.15]), np.array([1]), np.zeros((1, 2)))):
        found = fused(track, n_passes, prior)
        assert found.is_settled
        np.testing.assert_allclose(found.xy_m[found.sign_of_track[0]], [12.0, -7.0], atol=1e-6)
        assert found.class_code[found.sign_of_track[0]] == 2
        sigma_m = np.sqrt(found.cov_m2[found.sign_of_track[0], 0, 0])
        assert sigma_m == pytest.approx(np.hypot(1.5, 0.1), rel=0.05)


def street(n_passes: int = 6, n_signs: int = 20, seed: int = 5) -> tuple[Floats, Ints, Tracks]:
    """Return signs, classes, and tracks of passes whose offsets sum to zero."""
    rng = np.random.default_rng(seed)
    signs = np.column_stack((np.arange(n_signs) * 23.7, rng.uniform(-8, 8, n_signs)))
    classes = rng.integers(0, N_CLASSES, n_signs)
    offset = rng.normal(0, 1.0, (n_passes, 2))
    code, sign = (values.ravel() for values in np.indices((n_passes, n_signs)))
    xy_m = signs[sign] + (offset - offset.mean(axis=0))[code] + rng.normal(0, 0.05, (len(code), 2))
    return signs, classes, point_tracks(code, classes[sign], xy_m, 0.1)


def outdated(fault: str, signs: Floats, classes: Ints) -> tuple[Floats, Ints]:
    """Return a map with one fault."""
    old, old_classes = signs.copy(), classes.copy()
    if fault == "removed":
        return np.delete(old, [3, 11], axis=0), np.delete(old_classes, [3, 11])
    if fault == "retyped":
        old_classes[[4, 9]] = (old_classes[[4, 9]] + 1) % N_CLASSES
    elif fault == "moved":
        old[[5, 12]] += [[5.0, 0.0], [-3.0, 4.0]]
    elif fault == "obsolete":
        return np.vstack((old, [[37.0, 20.0], [180.0, -20.0]])), np.append(old_classes, [0, 2])
    return old, old_classes


@pytest.mark.parametrize("fault", ["none", "removed", "retyped", "moved", "obsolete"])
def test_every_fault_of_a_prior_map_alone_is_put_right(fault: str) -> None:
    """Obsolete entries aside, which need paths to be told: all signs, their classes, and no sign beside another."""
    signs, classes, tracks = street()
    old, old_classes = outdated(fault, signs, classes)
    prior = PriorMap(old, np.full(len(old), 0.15), old_classes, np.zeros_like(old))
    found = fused(tracks, 6, prior)
    kept = (found.n_passes > 0) & (found.existence > 0.5)
    order = np.argsort(found.xy_m[kept, 0])
    np.testing.assert_allclose(found.xy_m[kept][order], signs, atol=0.3)
    np.testing.assert_array_equal(found.class_code[kept][order], classes)
    assert ((found.n_passes == 0) & (found.existence > 0.5)).sum() == (2 if fault == "obsolete" else 0)


def bound_tracks(seed: int = 3, n_passes: int = 5, n_signs: int = 7) -> tuple[Tracks, Passes, Ints]:
    """Return tracks that bind place and bias together, of an association that is known."""
    rng = np.random.default_rng(seed)
    code, sign = (values.ravel() for values in np.indices((n_passes, n_signs)))
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
    tracks = replace(point_tracks(code, np.zeros(n, np.int64), xy_m, 1.0), matrix=matrix, vector=vector)
    return tracks, Passes(np.full(n_passes, 1.3), bias_sigma, np.zeros(n_passes, np.int64)), sign


@settings(max_examples=25, deadline=None)
@given(st.floats(0.01, 100.0), st.integers(0, 1000))
def test_another_unit_of_length_scales_places_and_covariances(factor: float, seed: int) -> None:
    """Metres or feet: places and range biases scale, bearings do not."""
    tracks, passes, sign = bound_tracks(seed)
    unit = np.array([factor, factor, factor, 1.0])
    scaled = replace(
        tracks,
        origin_xy_m=tracks.origin_xy_m * factor,
        matrix=tracks.matrix / unit[:, None] / unit,
        vector=tracks.vector / unit,
    )
    wide = replace(passes, gnss_sigma_m=passes.gnss_sigma_m * factor, bias_sigma=passes.bias_sigma * unit[2:])
    one = solve(tracks, passes, sign, 7, np.zeros((5, 4)), with_cov=True)
    two = solve(scaled, wide, sign, 7, np.zeros((5, 4)), with_cov=True)
    np.testing.assert_allclose(two.xy_m, one.xy_m * factor, rtol=1e-6, atol=1e-6 * factor)
    np.testing.assert_allclose(two.cov_m2, one.cov_m2 * factor**2, rtol=1e-6)
    np.testing.assert_allclose(two.nuisance, one.nuisance * unit, rtol=1e-6, atol=1e-7 * factor)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 4), st.integers(0, 1000))
def test_what_passes_say_of_a_sign_adds_up(n_first: int, seed: int) -> None:
    """Of one sign: information and its vector are those of some passes plus those of the others."""
    tracks, passes, sign = bound_tracks(seed)
    one_sign = tracks.take(sign == 2)

    def said(rows: Ints) -> tuple[Floats, Floats]:
        mine = np.isin(one_sign.pass_code, rows)
        part = solve(one_sign.take(mine), passes, np.zeros(mine.sum(), np.int64), 1, np.zeros((5, 4)), with_cov=True)
        information = np.linalg.inv(part.cov_m2[0])
        return information, information @ part.xy_m[0]

    whole, first, rest = said(np.arange(5)), said(np.arange(n_first)), said(np.arange(n_first, 5))
    np.testing.assert_allclose(first[0] + rest[0], whole[0], rtol=1e-8)
    np.testing.assert_allclose(first[1] + rest[1], whole[1], rtol=1e-7, atol=1e-9)


def moved(tracks: Tracks, pass_code: int, east_m: float) -> Tracks:
    xy_m = tracks.origin_xy_m.copy()
    xy_m[tracks.pass_code == pass_code, 0] += east_m
    return replace(tracks, origin_xy_m=xy_m)


def reported(found: JointMap) -> Floats:
    """Return the places of the signs that passes agree on, along the street."""
    there = found.xy_m[found.n_passes > 1]
    return there[np.argsort(there[:, 0])]


def test_a_car_with_a_gross_offset_draws_no_other_along() -> None:
    """8 m off where 1.5 m are declared: believed as declared it would draw the map along by a sixth of it."""
    signs, _, tracks = street()
    found = fused(moved(tracks, 2, 8.0), 6)
    others = fused(tracks.take(tracks.pass_code != 2), 6)
    assert found.nuisance[2, 0] > 6
    assert np.abs(reported(found) - reported(others)).max() < 0.25
    assert np.abs(reported(found) - signs).max() < 0.5


def test_a_sound_car_is_believed_as_it_declares() -> None:
    passes = Passes(np.array([1.5, 1.5]), np.array([[2.0, 0.05], [2.0, 0.05]]), np.zeros(2, np.int64))
    nuisance = np.array([[3.0, -3.0, 5.0, 0.1], [6.0, 6.0, 5.0, 0.2]])  # χ² 8 and 10.3; 32 and 22.3
    found = believed(passes, nuisance, 2)
    np.testing.assert_allclose(found.gnss_sigma_m, [1.5, 1.5 * 4])
    np.testing.assert_allclose(found.bias_sigma, [[2.0, 0.05], np.array([2.0, 0.05]) * np.sqrt(22.25 / 2)])


def test_a_prior_map_that_is_off_makes_no_fault_of_what_an_rtk_car_sees() -> None:
    """The map declares 0.15 m and lies off by 1.5 m; one car of six knows its place to 0.05 m."""
    signs, classes, tracks = street()
    own = tracks.pass_code == 0
    xy_m = tracks.origin_xy_m.copy()
    sign = np.argmin(np.hypot(*(xy_m[own, None] - signs[None]).transpose(2, 0, 1)), axis=1)
    xy_m[own] = signs[sign]
    passes = Passes(np.append(0.05, np.full(5, 1.5)), np.zeros((6, 2)), np.zeros(6, np.int64))
    off = PriorMap(signs + np.array([0.9, 1.2]), np.full(len(signs), 0.15), classes, np.zeros_like(signs))
    found = fuse_joint(replace(tracks, origin_xy_m=xy_m), passes, n_classes=N_CLASSES, prior=off)
    assert np.hypot(*found.nuisance[0, :2]) < 0.05
    assert np.abs(reported(found) - signs).max() < 0.2
