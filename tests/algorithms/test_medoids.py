"""PAM against the GPL package `kmedoids` (when installed), brute force and what its parts promise."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from geofleet.algorithms.medoids import build, fasterpam
from geofleet.errors import InputError


def loss(xy, rows):
    return cdist(xy, xy[rows]).min(axis=1).sum()


@pytest.mark.parametrize("seed", range(20))
def test_no_single_swap_lowers_the_loss(seed):
    rng = np.random.default_rng(seed)
    n, k = int(rng.integers(6, 60)), int(rng.integers(1, 6))
    xy = rng.normal(0, 30, (n, 2))
    start = build(xy, k)
    found = fasterpam(xy, start)
    assert found.loss_m == pytest.approx(loss(xy, found.rows))
    assert found.loss_m <= loss(xy, start) + 1e-9
    assert found.labels.tolist() == cdist(xy, xy[found.rows]).argmin(axis=1).tolist()
    swapped = [np.append(np.delete(found.rows, place), row) for place in range(k) for row in range(n)]
    assert min(loss(xy, rows) for rows in swapped) >= found.loss_m - 1e-9


@pytest.mark.parametrize("seed", range(5))
def test_separate_groups_get_the_best_medoids_there_are(seed):
    rng = np.random.default_rng(seed)
    xy = np.repeat([[0, 0], [100, 0], [0, 100]], 5, axis=0) + rng.normal(0, 2, (15, 2))
    best = min(combinations(range(15), 3), key=lambda rows: loss(xy, list(rows)))
    assert sorted(fasterpam(xy, build(xy, 3)).rows.tolist()) == list(best)


def test_build_is_greedy_and_a_smaller_one_is_its_beginning():
    xy = np.random.default_rng(4).normal(0, 20, (80, 2))
    rows = build(xy, 9).tolist()
    assert rows[:4] == build(xy, 4).tolist()
    for place in range(9):
        losses = [loss(xy, [*rows[:place], row]) for row in range(80)]
        assert rows[place] == int(np.argmin(losses))


def test_equal_to_the_package_kmedoids():
    kmedoids = pytest.importorskip("kmedoids", reason="GPL: install it in an environment of your own")
    for seed in range(30):
        rng = np.random.default_rng(seed)
        n = int(rng.integers(60, 300))
        k = int(rng.integers(2, n // 8))  # few pairs, whose two medoids would be equally good
        xy = rng.normal(0, 30, (n, 2))
        distances = cdist(xy, xy)
        assert set(build(xy, k).tolist()) == set(kmedoids.pam_build(distances, k).medoids.tolist())
        theirs = kmedoids.fasterpam(distances, k, init="build", n_cpu=1)
        assert fasterpam(xy, build(xy, k)).loss_m == pytest.approx(theirs.loss, rel=1e-9)


def test_one_medoid_is_the_most_central_point_and_copies_are_no_trouble():
    xy = np.array([[0.0, 0], [1, 0], [2, 0], [9, 0]])
    assert fasterpam(xy, build(xy, 1)).rows.tolist() == [1]
    same = fasterpam(np.zeros((5, 2)), build(np.zeros((5, 2)), 3))
    assert same.loss_m == 0
    assert len(set(same.rows.tolist())) == 3


@pytest.mark.parametrize("k", [0, 5])
def test_more_medoids_than_points_or_none_are_refused(k):
    with pytest.raises(InputError, match=f"{k} medoids of 4 points"):
        build(np.zeros((4, 2)), k)
