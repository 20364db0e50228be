"""DBSCAN against scikit-learn: same groups, same noise, same border points, same numbers."""

from __future__ import annotations

import time

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from sklearn.cluster import DBSCAN

from geofleet.algorithms.clustering import dbscan, dbscan_groups
from geofleet.algorithms.geodesy import EnuFrame, to_ecef
from geofleet.errors import InputError


def oracle(xy, eps_m, min_samples):
    # a tree, not brute force: below eleven points scikit-learn's brute force takes distances from dot products
    return DBSCAN(eps=eps_m, min_samples=min_samples, algorithm="kd_tree").fit_predict(xy)


LATTICE = st.tuples(st.integers(-6, 6), st.integers(-6, 6))
PLANE = st.tuples(*[st.floats(-20, 20, allow_subnormal=False, width=32)] * 2)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(LATTICE, min_size=1, max_size=60),
    st.sampled_from([1.0, 2.0, 2.5, 5.0]),
    st.integers(1, 6),
)
@example([(0, 0)], 1.0, 1)
@example([(0, 0), (3, 4)], 5.0, 2)
def test_lattices_with_ties_and_duplicates_equal_scikit_learn(points, eps_m, min_samples):
    xy = np.array(points, float)
    assert dbscan(xy, eps_m, min_samples).tolist() == oracle(xy, eps_m, min_samples).tolist()


@settings(max_examples=100, deadline=None)
@given(st.lists(PLANE, min_size=1, max_size=80), st.floats(0.5, 8), st.integers(1, 6))
def test_scattered_points_equal_scikit_learn(points, eps_m, min_samples):
    xy = np.array(points, float)
    assert dbscan(xy, eps_m, min_samples).tolist() == oracle(xy, eps_m, min_samples).tolist()


@pytest.mark.parametrize("min_samples", [1, 3, 5, 12])
@pytest.mark.parametrize("extent_m", [3.0, 30.0, 120.0, 2000.0])
def test_dense_and_sparse_clouds_equal_scikit_learn(extent_m, min_samples):
    xy = np.random.default_rng(7).uniform(0, extent_m, (3000, 2)) + 1e6
    assert dbscan(xy, 4.0, min_samples).tolist() == oracle(xy, 4.0, min_samples).tolist()


def test_border_points_between_clusters_equal_scikit_learn():
    # rows of cores with single points between them: with five neighbours asked for, borders have a choice
    rng = np.random.default_rng(3)
    centres = rng.uniform(0, 60, (60, 2))
    xy = np.repeat(centres, 6, axis=0) + rng.normal(0, 0.8, (360, 2))
    found = dbscan_groups(xy, np.zeros(len(xy), int), eps_m=1.5, min_samples=6)
    assert found.contested_point.size > 0
    assert found.labels.tolist() == oracle(xy, 1.5, 6).tolist()


def test_empty_and_single():
    assert dbscan(np.empty((0, 2)), 4.0, 3).tolist() == []
    assert dbscan([[1.0, 2.0]], 4.0, 1).tolist() == [0]
    assert dbscan([[1.0, 2.0]], 4.0, 2).tolist() == [-1]


def test_far_apart_points_do_not_need_a_wide_grid():
    xy = np.array([[0, 0], [0.5, 0], [1e9, 1e9], [1e9 + 0.5, 1e9], [-1e12, 4]])
    assert dbscan(xy, 1.0, 2).tolist() == [0, 0, 1, 1, -1]
    assert dbscan(xy, 0.51, 2).tolist() == [0, 0, 1, 1, -1]


def test_a_million_points_in_one_place_are_not_quadratic():
    xy = np.random.default_rng(1).uniform(0, 10, (400_000, 2))
    dbscan(xy[:10], 4.0, 3)
    start = time.perf_counter()
    labels = dbscan(xy, 4.0, 3)
    assert labels.max() == 0
    assert time.perf_counter() - start < 5.0  # a quadratic pass takes minutes


def test_groups_equal_one_call_a_group():
    rng = np.random.default_rng(5)
    xy, groups = rng.uniform(0, 100, (2000, 2)), rng.integers(0, 7, 2000)
    found = dbscan_groups(xy, groups, eps_m=4.0, min_samples=3)
    for group in range(7):
        of_group = found.labels[groups == group]
        expected = oracle(xy[groups == group], 4.0, 3)
        pairs = set(zip(of_group.tolist(), expected.tolist(), strict=True))
        assert len(pairs) == len(set(of_group.tolist())) == len(set(expected.tolist()))
        assert all((a < 0) == (b < 0) for a, b in pairs)
    of_cluster = {(label, group) for label, group in zip(found.labels, groups, strict=True) if label >= 0}
    assert len(of_cluster) == found.n_clusters


def test_distances_between_earth_centred_coordinates_do_not_depend_on_the_frame():
    rng = np.random.default_rng(11)
    lon, lat = 179.9999 + rng.uniform(0, 0.002, 3000), 70 + rng.uniform(0, 0.001, 3000)
    lon = (lon + 180) % 360 - 180
    results = [
        dbscan_groups(
            EnuFrame(*origin).to_enu(lon, lat), np.zeros(3000, int), eps_m=4.0, min_samples=5, ecef_m=to_ecef(lon, lat)
        ).labels.tolist()
        for origin in ((180.0, 70.0), (-179.95, 70.1))
    ]
    assert results[0] == results[1] == oracle(EnuFrame(180.0, 70.0).to_enu(lon, lat), 4.0, 5).tolist()


@pytest.mark.parametrize(
    ("xy", "eps_m", "min_samples", "message"),
    [
        ([[0.0, np.nan]], 4.0, 3, "1 of 1 points"),
        ([[0.0, 0.0, 0.0]], 4.0, 3, "shape"),
        ([[0.0, 0.0]], 0.0, 3, "eps_m"),
        ([[0.0, 0.0]], np.nan, 3, "eps_m"),
        ([[0.0, 0.0]], 4.0, 0, "min_samples"),
        ([[0.0, 0.0], [1e300, 0.0]], 4.0, 3, "apart"),
    ],
)
def test_bad_input_is_refused(xy, eps_m, min_samples, message):
    with pytest.raises(InputError, match=message):
        dbscan(xy, eps_m, min_samples)
