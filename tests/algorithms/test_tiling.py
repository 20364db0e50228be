"""Quadkeys, and clusters that come out the same whatever tiles they were found in."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod
from scipy.sparse.csgraph import connected_components
from sklearn.cluster import DBSCAN

from geofleet.algorithms import clustering
from geofleet.algorithms.clustering import dbscan, split_groups
from geofleet.algorithms.fusion import fuse, information_weights, name_hashes, vote
from geofleet.algorithms.geodesy import EnuFrame, to_ecef
from geofleet.algorithms.geodesy_kernels import ecef_points
from geofleet.algorithms.tiling import cluster_tiles, halo_m, join_open, quadkey_bounds, quadkeys, split_chains
from geofleet.errors import InputError
from geofleet.tables.database import connect

EPS_M = 4.0


def tile_everything(lon, lat, codes, zoom, min_samples):
    """Cluster tile by tile with halos found by brute force; return a label a point, -1 for noise."""
    keys = np.array(quadkeys(lon, lat, zoom))
    names = sorted(set(keys.tolist()))
    bounds = quadkey_bounds(names)
    centres = np.column_stack((bounds[:, [0, 2]].mean(axis=1), bounds[:, [1, 3]].mean(axis=1)))
    point, tile = [], []
    for number in range(len(names)):
        frame = EnuFrame(*centres[number])
        corners = frame.to_enu(bounds[number, [0, 2, 0, 2]], bounds[number, [1, 1, 3, 3]])
        margin = halo_m(EPS_M) + 0.5  # a tile's edge bends by less than this in its plane
        low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
        xy = frame.to_enu(lon, lat)
        inside = np.flatnonzero(((xy >= low) & (xy <= high)).all(axis=1))
        point.append(inside)
        tile.append(np.full(inside.size, number))
    point, tile = np.concatenate(point), np.concatenate(tile)
    owned = keys[point] == np.array(names)[tile]
    found = cluster_tiles(
        lon[point],
        lat[point],
        tile=tile,
        tile_centres_deg=centres,
        is_owned=owned,
        codes=codes[point],
        eps_m=EPS_M,
        min_samples=min_samples,
    )
    labels = np.full(lon.size, -1)
    assert np.bincount(point[found.closed_row], minlength=lon.size).max() <= 1
    labels[point[found.closed_row]] = found.closed_cluster
    row, cluster = join_open(point[found.open_row], found.open_cluster, found.open_is_core, owned[found.open_row])
    joined = point[found.open_row][row]
    assert (labels[joined] == -1).all()  # owned once: by a closed cluster, or by a joined one
    labels[joined] = cluster + lon.size
    return labels, found.open_row.size


def same_partition(a, b):
    pairs = set(zip(a.tolist(), b.tolist(), strict=True))
    return len(pairs) == len(set(a.tolist())) == len(set(b.tolist())) and ((a < 0) == (b < 0)).all()


def whole(lon, lat, codes, origin, min_samples):
    xy = EnuFrame(*origin).to_enu(lon, lat)
    far = np.column_stack((xy, codes * 1e4))  # classes far apart in a third dimension
    return DBSCAN(eps=EPS_M, min_samples=min_samples, algorithm="kd_tree").fit_predict(far)


ORIGINS = {
    "a corner of four zoom-12 tiles": (11.42578125, 48.748945343432936),
    "antimeridian": (180.0, 61.0),
    "70 degrees north": (25.751953125, 70.0),
    "equator and prime meridian": (0.0, 0.0),
}


@pytest.mark.parametrize("name", ORIGINS)
@settings(max_examples=12, deadline=None)
@given(seed=st.integers(0, 10_000), zoom=st.integers(12, 20), min_samples=st.integers(2, 6))
def test_tiles_do_not_show(name, seed, zoom, min_samples):
    origin, rng = ORIGINS[name], np.random.default_rng(seed)
    centres = rng.uniform(-60, 60, (50, 2))
    xy = np.repeat(centres, 8, axis=0) + rng.normal(0, 2.0, (400, 2))
    lon, lat = EnuFrame(*origin).to_lonlat(xy)
    codes = rng.integers(0, 2, 400)
    labels, _ = tile_everything(lon, lat, codes, zoom, min_samples)
    assert same_partition(labels, whole(lon, lat, codes, origin, min_samples))


def test_a_cluster_longer_than_many_tiles_stays_one():
    # a chain of 1500 m over tiles of zoom 20 (19 m here): no halo could hold it
    xy = np.column_stack((np.arange(-750, 750, 1.5), np.zeros(1000)))
    lon, lat = EnuFrame(24.94, 60.17).to_lonlat(xy)
    labels, n_open = tile_everything(lon, lat, np.zeros(1000, int), 20, 3)
    assert n_open > 1000
    assert len(set(labels.tolist())) == 1
    assert labels[0] >= 0


def test_nothing_open_joins_to_nothing():
    nothing = np.empty(0, np.int64)
    assert [a.size for a in join_open(nothing, nothing, nothing.astype(bool), nothing.astype(bool))] == [0, 0]


def test_a_border_point_goes_to_the_cluster_whose_first_core_comes_first():
    # point 5 is reached by clusters 0 (cores 7, 8) and 1 (cores 3, 4); 4 shows that cluster 2 is part of cluster 1
    point = np.array([7, 8, 5, 3, 4, 5, 4, 1])
    cluster = np.array([0, 0, 0, 1, 1, 1, 2, 2])
    core = np.array([True, True, False, True, True, False, True, False])
    owned = np.array([True, True, True, True, True, True, False, True])
    row, joined = join_open(point, cluster, core, owned)
    of = dict(zip(point[row].tolist(), joined.tolist(), strict=True))
    assert sorted(of) == [1, 3, 4, 5, 7, 8]
    assert of[5] == of[3] == of[4] == of[1] != of[7] == of[8]


@pytest.mark.parametrize("zoom", [1, 12, 16, 20, 23])
def test_quadkeys_equal_those_of_duckdb(zoom):
    rng = np.random.default_rng(zoom)
    lon = np.append(rng.uniform(-180, 180, 500), [180.0, -180.0, 0.0, 11.42578125])
    lat = np.append(rng.uniform(-85.05, 85.05, 500), [0.0, 0.0, 85.05, -85.05])
    connection = connect()
    rows = [
        connection.execute("SELECT ST_QuadKey(?, ?, ?)", [*p, zoom]).fetchone()[0] for p in zip(lon, lat, strict=True)
    ]
    connection.close()
    assert quadkeys(lon, lat, zoom) == rows


def test_bounds_hold_their_points_half_open():
    rng = np.random.default_rng(2)
    lon, lat = rng.uniform(-180, 180, 200), rng.uniform(-85, 85, 200)
    west, south, east, north = quadkey_bounds(quadkeys(lon, lat, 17)).T
    assert ((west <= lon) & (lon < east) & (south <= lat) & (lat <= north)).all()
    assert quadkey_bounds(["0"]).tolist() == [[-180.0, 0.0, 0.0, pytest.approx(85.0511287798)]]
    assert quadkeys([], [], 16) == []
    assert quadkey_bounds([]).shape == (0, 4)


@pytest.mark.parametrize(
    ("lon", "lat", "zoom"), [(math.nan, 0, 16), (0, 85.06, 16), (181, 0, 16), (0, 0, 0), (0, 0, 24)]
)
def test_positions_outside_web_mercator_are_refused(lon, lat, zoom):
    with pytest.raises(InputError):
        quadkeys([lon], [lat], zoom)


def test_a_text_that_is_no_quadkey_is_refused():
    with pytest.raises(InputError, match="'12x' is not a quadkey"):
        quadkey_bounds(["12x"])


@pytest.mark.parametrize("place_deg", [(24.9, 60.2), (25.75, 70.0), (179.99999, 70.0), (-180.0, 61.0), (10.0, 0.0)])
def test_distances_are_those_on_the_ground_to_a_millimetre_in_two_kilometres(place_deg):
    geod, rng = Geod(ellps="WGS84"), np.random.default_rng(0)
    n = 500
    lon0, lat0 = np.full(n, place_deg[0]), np.full(n, place_deg[1])
    distance_m = rng.uniform(0.0, 2000.0, n)
    lon, lat, _ = geod.fwd(lon0, lat0, rng.uniform(0.0, 360.0, n), distance_m)
    chord_m = np.linalg.norm(ecef_points(lon, lat) - ecef_points(lon0, lat0), axis=1)  # what clusters are made by
    assert np.abs(chord_m - distance_m).max() < 1e-3
    assert np.abs(np.linalg.norm(EnuFrame(*place_deg).to_enu(lon, lat), axis=1) - distance_m).max() < 1e-3
    assert np.abs(ecef_points(lon, lat) - to_ecef(lon, lat)).max() < 1e-8


def test_centroid_is_the_weighted_mean_on_the_ground():
    # three quarters of the way along 8 m of geodesic, at 70° N beside the antimeridian
    geod = Geod(ellps="WGS84")
    lon1, lat1, _ = geod.fwd(179.99999, 70.0, 60.0, 8.0)
    fused = fuse(
        np.array([179.99999, lon1]),
        np.array([70.0, lat1]),
        weight=np.array([1.0, 3.0]),
        pass_code=np.array([0, 1]),
        first=np.array([0, 2]),
    )
    azimuth, _, distance = geod.inv(179.99999, 70.0, fused.lon_deg[0], fused.lat_deg[0])
    assert distance == pytest.approx(6.0, abs=2e-4)
    assert azimuth == pytest.approx(60.0, abs=2e-3)


def test_covariance_is_that_of_the_mean_of_passes():
    # four passes with one detection each at (±2, 0), (0, ±1) and equal weights: S/P with P - 1 in S
    lon, lat = EnuFrame(10.0, 50.0).to_lonlat(np.array([[2.0, 0], [-2, 0], [0, 1], [0, -1]]))
    ones = np.ones(4)
    fused = fuse(lon, lat, weight=ones, pass_code=np.arange(4), first=np.array([0, 4]))
    assert fused.var_e_m2[0] == pytest.approx(8 / 3 / 4, rel=1e-5)
    assert fused.var_n_m2[0] == pytest.approx(2 / 3 / 4, rel=1e-5)
    assert fused.cov_en_m2[0] == pytest.approx(0.0, abs=1e-5)
    # ten copies within the passes add nothing: errors of a pass are common
    again = fuse(
        np.repeat(lon, 10),
        np.repeat(lat, 10),
        weight=np.ones(40),
        pass_code=np.repeat(np.arange(4), 10),
        first=np.array([0, 40]),
    )
    assert again.var_e_m2[0] == pytest.approx(fused.var_e_m2[0])
    assert (again.n_passes[0], again.n_detections[0]) == (4, 40)
    single = fuse(lon, lat, weight=ones, pass_code=np.zeros(4, int), first=np.array([0, 4]))
    assert np.isnan(single.var_e_m2[0])


def test_covariance_is_unbiased_for_unequal_weights():
    rng = np.random.default_rng(4)
    n_clusters, weight = 4000, np.array([1.0, 2.0, 5.0])
    xy = rng.normal(0, 1.0, (3 * n_clusters, 2))
    lon, lat = EnuFrame(10.0, 0.0).to_lonlat(xy)
    fused = fuse(
        lon,
        lat,
        weight=np.tile(weight, n_clusters),
        pass_code=np.tile(np.arange(3), n_clusters),
        first=np.arange(0, 3 * n_clusters + 1, 3),
    )
    truth = (weight**2).sum() / weight.sum() ** 2
    assert fused.var_e_m2.mean() == pytest.approx(truth, rel=0.06)
    assert fused.var_n_m2.mean() == pytest.approx(truth, rel=0.06)
    assert np.var((fused.lon_deg - 10) * 111319.49) == pytest.approx(truth, rel=0.06)


def test_weights_work_on_whatever_is_there():
    weights = information_weights(np.array([1.0, 0.0, 0.4, math.inf]))
    assert weights.tolist() == pytest.approx([0.5, 1.0, 1 / 1.4, 0.0])


def test_votes_and_ties():
    code, confidence = vote(np.array([2, 1, 2, 3, 1]), np.array([0.5, 1.0, math.nan, 1.0, 0.8]), np.array([0, 3, 5]))
    assert code.tolist() == [2, 1]
    assert confidence.tolist() == [0.5, 0.4]


def test_colliding_ids_are_told_apart():
    hashes = np.array([0x1, 0xABCDEF0123450000, 0xABCDEF012345FFFF, 0xABCDEF0123460000], np.uint64)
    names = [name.decode() for name in name_hashes(hashes).tolist()]
    assert names == ["f000000000000", "fabcdef012345", "fabcdef012345-2", "fabcdef012346"]
    assert name_hashes(hashes[:0]).size == 0


def chain(rng, n_passes, gap_m=13.0):
    """Two signs of a class whose far-out detections meet between them, in any order."""
    xy = np.concatenate([rng.normal((at, 0), 1.7, (n_passes, 2)) for at in (0.0, gap_m)])
    xy = xy[rng.permutation(len(xy))]
    return xy, *EnuFrame(24.9, 60.2).to_lonlat(xy)


def same_groups(labels, others):
    """Whether two labellings have the same noise and the same groups."""
    is_noise_same = np.array_equal(labels < 0, others < 0)
    n_pairs = len(np.unique(np.column_stack((labels, others)), axis=0))
    return is_noise_same and n_pairs == len(np.unique(labels)) == len(np.unique(others))


def largest_count(xy, eps_m):
    return int((np.linalg.norm(xy[:, None] - xy[None], axis=2) <= eps_m).sum(axis=1).max())


@pytest.mark.parametrize(("n_passes", "gap_m"), [(600, 13.0), (60, 12.0)])
def test_a_core_rule_that_follows_the_densest_place_splits_what_a_fixed_one_chains(n_passes, gap_m):
    xy, lon, lat = chain(np.random.default_rng(0), n_passes, gap_m)
    assert dbscan(xy, 4.0, 3).max() == 0  # one chain
    split = split_chains(lon, lat, np.zeros(len(lon), np.int64), eps_m=4.0, min_samples=3, share=0.7)
    most = largest_count(xy, 4.0)
    assert same_groups(split, dbscan(xy, 4.0, math.ceil(0.7 * most - 2 * math.sqrt(most))))
    first, second = (xy[split == label, 0] for label in np.unique(split[split >= 0]))
    assert sorted((round(first.mean() / gap_m, 1), round(second.mean() / gap_m, 1))) == [0.0, 1.0]


def test_a_quiet_sign_in_a_chain_with_a_busy_one_is_kept(monkeypatch):
    """Sixty passes report one, six hundred the other: with the core rule of the busy one the quiet one were noise."""
    rng = np.random.default_rng(4)
    xy = np.concatenate((rng.normal((0, 0), 1.7, (600, 2)), rng.normal((13, 0), 1.7, (60, 2))))
    xy = xy[rng.permutation(660)]
    places = EnuFrame(24.9, 60.2).to_lonlat(xy)
    assert dbscan(xy, 4.0, 3).max() == 0  # one chain

    def found():
        split = split_chains(*places, np.zeros(660, np.int64), eps_m=4.0, min_samples=3, share=0.7)
        return sorted(round(float(xy[split == label, 0].mean())) for label in np.unique(split[split >= 0]))

    assert found() == [0, 13]
    monkeypatch.setattr(clustering, "PEAK_STEPS", 60)
    assert found() == [0]


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000), n_signs=st.integers(1, 6), sigma_m=st.floats(0.5, 4), share=st.floats(0.3, 1))
def test_the_core_rule_is_the_one_that_is_written_down(seed, n_signs, sigma_m, share):
    rng = np.random.default_rng(seed)
    n_seen = rng.integers(5, 120, n_signs)
    xy = np.repeat(rng.uniform(0, 30, (n_signs, 2)), n_seen, axis=0) + rng.normal(0, sigma_m, (n_seen.sum(), 2))
    labels = dbscan(xy, 4.0, 3)
    xy, labels = xy[labels >= 0], labels[labels >= 0]
    near = np.linalg.norm(xy[:, None] - xy[None], axis=2) <= 4.0
    near &= labels[:, None] == labels[None]
    count = near.sum(axis=1)
    most = count
    for _ in range(3):
        most = np.where(near, most[None], 0).max(axis=1)
    core = count >= np.maximum(3, np.ceil(share * most - 2 * np.sqrt(most)))
    _, component = connected_components(near & core[:, None] & core[None])
    found = split_groups(xy, labels, eps_m=4.0, min_samples=3, share=share) if len(xy) else labels
    assert same_groups(found[core], component[core])
    assert ((found >= 0) == (near & core[None]).any(axis=1)).all()  # borders, and nothing else besides
    for row in np.flatnonzero(~core & (found >= 0)).tolist():
        assert found[row] in found[near[row] & core]


def test_the_rule_has_no_scale():
    """Errors three times as large, eps with them: the same groups."""
    xy, lon, lat = chain(np.random.default_rng(1), 200)
    wide_lon, wide_lat = EnuFrame(24.9, 60.2).to_lonlat(3 * xy)
    one = np.zeros(len(lon), np.int64)
    split = split_chains(lon, lat, one, eps_m=4.0, min_samples=3, share=0.7)
    assert same_groups(split, split_chains(wide_lon, wide_lat, one, eps_m=12.0, min_samples=3, share=0.7))


def test_a_wide_sign_stays_one():
    """Few of its passes agree within eps, which no sign between two is to be told from; it is not taken for noise."""
    xy = np.random.default_rng(2).normal(0, 5.0, (400, 2))
    split = split_chains(
        *EnuFrame(24.9, 60.2).to_lonlat(xy), np.zeros(400, np.int64), eps_m=4.0, min_samples=3, share=0.8
    )
    assert split.max() == split[split >= 0].min()
    assert (split >= 0).mean() > 0.5


def test_few_detections_leave_clusters_as_they_are():
    _, lon, lat = chain(np.random.default_rng(0), 6)  # 12 members: at most ceil(8.4 - 6.9) = 2 make a core
    clusters = np.full(12, 4)
    assert split_chains(lon, lat, clusters, eps_m=4.0, min_samples=3, share=0.7) is clusters
    _, lon, lat = chain(np.random.default_rng(0), 600)
    clusters = np.full(1200, 4)
    assert split_chains(lon, lat, clusters, eps_m=4.0, min_samples=3, share=0.0) is clusters


def test_only_clusters_with_many_detections_in_one_place_are_split():
    """A long chain of few a place stays whole beside one that falls apart."""
    xy, lon, lat = chain(np.random.default_rng(0), 300)
    along = np.column_stack((np.arange(0, 200, 2.0), np.full(100, 500.0)))  # five within eps of each
    more_lon, more_lat = EnuFrame(24.9, 60.2).to_lonlat(along)
    cluster = np.repeat([3, 7], [len(xy), len(along)])
    split = split_chains(
        np.append(lon, more_lon), np.append(lat, more_lat), cluster, eps_m=4.0, min_samples=3, share=0.8
    )
    assert len(set(split[len(xy) :].tolist())) == 1
    assert len(set(split[: len(xy)].tolist()) - {-1}) == 2
    assert not set(split[: len(xy)].tolist()) & set(split[len(xy) :].tolist())
