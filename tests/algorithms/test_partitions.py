"""Methods that see a set as a whole: scikit-learn's meaning, K by silhouette, stated limits."""

from __future__ import annotations

import numpy as np
import pytest
from sklearn.cluster import HDBSCAN, KMeans
from sklearn.metrics import silhouette_score

from geofleet.algorithms import partitions
from geofleet.algorithms.partitions import choose, partition_groups, silhouette
from geofleet.errors import InputError


def blobs(n_places, *, seed=0, n_each=12, spacing_m=40.0):
    rng = np.random.default_rng(seed)
    places = np.column_stack((np.arange(n_places) * spacing_m, rng.uniform(-5, 5, n_places)))
    return np.repeat(places, n_each, axis=0) + rng.normal(0, 1.0, (n_places * n_each, 2))


def same_groups(a, b):
    pairs = set(zip(a.tolist(), b.tolist(), strict=True))
    return len(pairs) == len(set(a.tolist())) == len(set(b.tolist())) and all((x < 0) == (y < 0) for x, y in pairs)


def test_kmeans_and_hdbscan_are_those_of_scikit_learn_a_group():
    xy = np.random.default_rng(2).uniform(0, 60, (300, 2))
    groups = np.arange(300) % 2
    found = partition_groups(xy, groups, method="kmeans", n_clusters=np.array([4, 7]))
    clustered = partition_groups(xy, groups, method="hdbscan", min_cluster_size=5)
    for group, k in ((0, 4), (1, 7)):
        mine = groups == group
        expected = KMeans(n_clusters=k, n_init=10, random_state=0).fit_predict(xy[mine])
        assert same_groups(found.labels[mine], expected)
        assert same_groups(clustered.labels[mine], HDBSCAN(min_cluster_size=5, copy=True).fit_predict(xy[mine]))
    assert len(set(found.labels.tolist())) == 11
    assert not found.is_medoid.any()


@pytest.mark.parametrize("method", ["kmeans", "kmedoids"])
@pytest.mark.parametrize("n_places", [1, 2, 7])
def test_k_is_chosen_by_silhouette_and_one_place_stays_one(method, n_places):
    found = choose(blobs(n_places), method, 30)
    assert same_groups(found.labels, np.repeat(np.arange(n_places), 12))
    assert found.is_medoid.sum() == (n_places if method == "kmedoids" else 0)


@pytest.mark.parametrize("method", ["kmeans", "kmedoids"])
def test_few_points_and_copies_have_no_more_clusters_than_places(method):
    for xy in (np.zeros((1, 2)), np.zeros((4, 2)), np.array([[0.0, 0], [90, 0]])):
        assert choose(xy, method, 30).labels.max() == 0
        given = partition_groups(xy, np.zeros(len(xy), int), method=method, n_clusters=np.array([9]))
        assert len(set(given.labels.tolist())) == len(np.unique(xy, axis=0))


def test_a_group_that_is_given_no_cluster_and_a_group_too_small_are_noise():
    xy, groups = blobs(2), np.repeat([0, 1], 12)
    assert set(partition_groups(xy, groups, method="kmeans", n_clusters=np.array([0, 1])).labels[:12].tolist()) == {-1}
    small = partition_groups(xy[:4], np.zeros(4, int), method="hdbscan", min_cluster_size=5)
    assert small.labels.tolist() == [-1] * 4
    assert partition_groups(np.empty((0, 2)), np.empty(0, int), method="kmeans").labels.tolist() == []


def test_silhouette_is_that_of_scikit_learn():
    rng = np.random.default_rng(5)
    xy, labels = rng.uniform(0, 10, (200, 2)), np.append(rng.integers(0, 6, 199), 6)  # the last is alone
    assert silhouette(xy, labels) == pytest.approx(silhouette_score(xy, labels), abs=1e-12)


@pytest.mark.parametrize("method", ["kmeans", "kmedoids", "hdbscan"])
def test_a_set_beyond_the_limit_is_refused(method, monkeypatch):
    monkeypatch.setitem(partitions.MAX_POINTS, method, 20)
    with pytest.raises(InputError, match="24 detections are to be clustered as one set; the limit is 20"):
        partition_groups(blobs(2), np.zeros(24, int), method=method, n_clusters=np.array([2]))
