"""Methods that see a run as a whole, K and where it comes from, and support relative to the passes in view."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
import shapely
from sklearn.cluster import DBSCAN

from geofleet.algorithms import partitions
from geofleet.algorithms.geodesy import EnuFrame
from geofleet.config import load_config
from geofleet.errors import ConfigError, InputError, TableError
from geofleet.steps.aggregate import aggregate, tiles
from geofleet.steps.ingest_detections import ingest_detections
from geofleet.tables import staging
from geofleet.tables.schemas import DETECTIONS, PASSES, REFERENCE, SIGNS
from geofleet.tables.store import build_table, lonlat, read_table, write_table

FRAME = EnuFrame(24.9450453, 60.1677108)
PLACES = np.array([[0.0, 0], [60, 0], [0, 60], [60, 60]])
CLASSES = ("stop", "stop", "yield", "yield")


def detections(run_id="a", n_passes=20, seed=0):
    rng = np.random.default_rng(seed)
    xy = np.repeat(PLACES, n_passes, axis=0) + rng.normal(0, 1.0, (4 * n_passes, 2))
    names = [f"{k:03}" for k in range(n_passes)] * 4
    columns = {
        "run_id": run_id,
        "vehicle_id": names,
        "pass_id": names,
        "track_id": np.repeat(np.arange(4), n_passes),
        "sign_class": np.repeat(CLASSES, n_passes),
        "n_frames": rng.integers(1, 40, len(xy)),
    }
    return build_table(DETECTIONS, columns, geometry=FRAME.to_lonlat(xy))


def reference(run_id="a"):
    columns = {
        "run_id": run_id,
        "sign_id": list("wxyz"),
        "kind": "main",
        "concept": CLASSES,
        "sign_class": CLASSES,
        "raw_code": CLASSES,
        "source": "test",
        "source_ref": "none",
        "n_passes_in_view": 1,
        "n_frames_in_view": 1,
    }
    return build_table(REFERENCE, columns, geometry=FRAME.to_lonlat(PLACES))


def passes(n_passes, paths, run_id="a"):
    columns = {
        "run_id": run_id,
        "pass_id": [f"{k:03}" for k in range(n_passes)],
        "vehicle_id": [f"{k:03}" for k in range(n_passes)],
        "sensor_id": "s",
        "sensor_kind": "camera",
        "drive_id": "d",
        "range_m": 50.0,
        "fov_deg": 90.0,
        "frame_spacing_m": 2.0,
    }
    lines = [shapely.LineString(np.column_stack(FRAME.to_lonlat(np.asarray(path, float)))) for path in paths]
    return build_table(PASSES, columns, geometry=lines)


def save(schema, table, path):
    write_table(schema, table, path)
    return path


def run_on(tmp_path, table, *, name="fused", k_from=None, passes_path=None, n_vehicles=None, **overrides):
    source = save(DETECTIONS, table, tmp_path / "detections.parquet")
    return aggregate(
        source,
        tmp_path / f"{name}.parquet",
        config=load_config(overrides=overrides),
        k_from=k_from,
        passes=passes_path,
        n_vehicles=n_vehicles,
    )


def distances_m(layer):
    xy = FRAME.to_enu(*lonlat(layer))
    return np.hypot(*(xy[:, None] - PLACES).transpose(2, 0, 1)).min(axis=0)


@pytest.mark.parametrize("semantic", ["first", "after"])
@pytest.mark.parametrize("method", ["kmeans", "kmedoids", "hdbscan"])
def test_every_method_finds_four_signs_and_tiles_and_rows_do_not_show(tmp_path, monkeypatch, method, semantic):
    table = detections()
    whole = run_on(tmp_path, table, method=method, semantic=semantic)
    layer = read_table(SIGNS, whole.out)
    assert layer.num_rows == 4
    assert distances_m(layer).max() < 1.0
    assert set(layer["method"].to_pylist()) == {f"{method}-{semantic}"}
    monkeypatch.setattr(tiles, "BATCH_ROWS", 7)
    mixed = table.take(np.random.default_rng(1).permutation(table.num_rows))
    again = run_on(tmp_path, mixed, name="again", method=method, semantic=semantic, tile_zoom=20)
    assert again.out.read_bytes() == whole.out.read_bytes()


def test_plain_means_members_and_weighted_means(tmp_path):
    table = detections()
    xy, frames = FRAME.to_enu(*lonlat(table)), table["n_frames"].to_numpy()
    mine = np.hypot(*(xy - PLACES[3]).T) < 20
    of = {}
    for method in ("kmeans", "kmedoids", "hdbscan"):
        layer = read_table(SIGNS, run_on(tmp_path, table, method=method).out)
        at = FRAME.to_enu(*lonlat(layer))
        of[method] = at[np.hypot(*(at - PLACES[3]).T).argmin()]
    weight = 1 / (1 + 1 / frames[mine])
    assert of["kmeans"] == pytest.approx(xy[mine].mean(axis=0), abs=2e-4)
    assert of["hdbscan"] == pytest.approx((xy[mine] * weight[:, None]).sum(axis=0) / weight.sum(), abs=2e-4)
    assert np.abs(xy[mine] - of["kmedoids"]).max(axis=1).min() < 2e-4


def test_the_oracle_gives_k_a_class_and_is_named(tmp_path):
    table = pa.concat_tables([detections("a"), detections("b", seed=1)])
    truth = pa.concat_tables([reference("a"), reference("b").slice(0, 3)])
    k_from = save(REFERENCE, truth, tmp_path / "reference.parquet")
    for semantic, n_b in (("first", 3), ("after", 3)):
        layer = read_table(SIGNS, run_on(tmp_path, table, method="kmeans", semantic=semantic, k_from=k_from).out)
        assert layer["run_id"].to_pylist().count("a") == 4
        assert layer["run_id"].to_pylist().count("b") == n_b
        assert set(layer["method"].to_pylist()) == {f"kmeans-{semantic}-oracle-k"}


def test_k_as_a_number(tmp_path):
    layer = read_table(SIGNS, run_on(tmp_path, detections(), method="kmedoids", semantic="after", k=2).out)
    assert layer["method"].to_pylist() == ["kmedoids-after-k2"] * 2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"method": "kmeans", "semantic": "first", "k": 4}, "k=4 is for all classes together"),
        ({"method": "dbscan", "k": 4}, "dbscan takes no K"),
        ({"method": "hdbscan", "k": 4}, "hdbscan takes no K"),
    ],
)
def test_a_k_that_cannot_be_meant_is_refused(tmp_path, settings, message):
    with pytest.raises(ConfigError, match=message):
        run_on(tmp_path, detections(), **settings)
    k_from = save(REFERENCE, reference(), tmp_path / "reference.parquet")
    with pytest.raises(ConfigError, match="K is given twice"):
        run_on(tmp_path, detections(), method="kmeans", semantic="after", k=3, k_from=k_from)


def test_what_is_too_large_or_too_wide_is_refused_and_leaves_nothing(tmp_path, monkeypatch):
    monkeypatch.setitem(partitions.MAX_POINTS, "kmeans", 30)
    for semantic in ("first", "after"):
        with pytest.raises(InputError, match="the limit is 30"):
            run_on(tmp_path, detections(), method="kmeans", semantic=semantic)
    far = build_table(
        DETECTIONS,
        {"run_id": "a", "vehicle_id": "v", "pass_id": "p", "track_id": [0, 1], "sign_class": "stop"},
        geometry=(np.array([10.0, 12.0]), np.array([50.0, 50.0])),
    )
    with pytest.raises(InputError, match="72 km from their middle"):
        run_on(tmp_path, far, method="hdbscan", semantic="after")
    assert [path.name for path in tmp_path.iterdir()] == ["detections.parquet"]


def test_no_detections_and_only_noise_are_empty_layers(tmp_path):
    for table in (detections().slice(0, 0), detections().slice(0, 2)):
        for method in ("hdbscan", "kmeans"):
            assert read_table(SIGNS, run_on(tmp_path, table, method=method).out).num_rows == 0


def test_support_is_relative_to_the_passes_that_had_the_place_in_view(tmp_path):
    # ten passes drive towards the first place, all twenty towards the last
    def path(row_m):
        return [[x, row_m] for x in range(-60, 40, 2)]

    driven = passes(20, [path(0)] * 10 + [path(60)] * 10)
    source = save(PASSES, driven, tmp_path / "passes.parquet")
    layer = read_table(SIGNS, run_on(tmp_path, detections(), passes_path=source).out)
    assert layer["n_opportunities"].to_pylist() == [10] * 4
    few = detections().filter(pa.compute.less(detections()["pass_id"], "008"))  # eight passes report each sign
    assert run_on(tmp_path, few, passes_path=source, min_support_share=0.8).n_signs == 4
    assert run_on(tmp_path, few, passes_path=source, min_support_share=0.9).n_signs == 0
    layer = read_table(SIGNS, run_on(tmp_path, detections(), passes_path=source, n_vehicles=10).out)
    assert sorted(layer["n_opportunities"].to_pylist()) == [0, 0, 10, 10]
    other = save(PASSES, passes(1, [path(0)], run_id="b"), tmp_path / "other.parquet")
    with pytest.raises(TableError, match="no pass of run a"):
        run_on(tmp_path, detections(), passes_path=other)


def test_repeated_keys_are_found_however_far_apart_the_ids_are(tmp_path, monkeypatch):
    table = detections()
    twice = pa.concat_tables([table, table.slice(3, 2)])
    for bits in (staging.MAX_ID_BITS, 0):
        monkeypatch.setattr(staging, "MAX_ID_BITS", bits)
        result = run_on(tmp_path, twice)
        assert (result.n_rejected, result.n_used, result.n_signs) == (2, 80, 4)


def test_hot_tiles_are_split(tmp_path, monkeypatch):
    whole = run_on(tmp_path, detections(), tile_zoom=12)
    assert whole.n_tiles == 1
    monkeypatch.setattr(tiles, "BATCH_ROWS", 40)
    split = run_on(tmp_path, detections(), name="split", tile_zoom=12)
    assert split.n_tiles > 1
    assert split.out.read_bytes() == whole.out.read_bytes()


BREMEN = Path(__file__).parents[3] / "shared" / "data" / "mapillary" / "mapillary_traffic-signs_DE-HB.parquet"


@pytest.mark.skipif(not BREMEN.is_file(), reason=f"{BREMEN} is not on this machine")
def test_bremen_as_mapillary_has_it_becomes_a_layer_without_copies(tmp_path):
    """22,836 rows without covariance, passes or confidence; 695 stand where another row does, most of another class."""
    ingest_detections([BREMEN], tmp_path / "detections", scheme="mapillary")
    options = {"min_samples": 1, "min_support": 1}
    result = aggregate(tmp_path / "detections", tmp_path / "fused.parquet", config=load_config(overrides=options))
    table, fused = read_table(DETECTIONS, tmp_path / "detections"), read_table(SIGNS, result.out)
    lon, lat = lonlat(table)
    xy = EnuFrame.around(lon, lat).to_enu(lon, lat)
    of_class = np.array(table["sign_class"].to_pylist())
    places, of_place = np.unique(np.column_stack((lon, lat)), axis=0, return_inverse=True)
    assert (len(lon), len(lon) - len(places)) == (22_836, 695)
    assert len(set(table["pass_id"].to_pylist())) == 22_836  # each row is a pass of its own
    assert result.skipped == {}
    n_copies = len(lon) - len(set(zip(of_place.tolist(), of_class.tolist(), strict=True)))
    assert n_copies == 109  # of one class; the other 586 are several signs of one pole
    expected = Counter()
    for name in set(of_class.tolist()):
        of_name = xy[of_class == name]
        labels = DBSCAN(eps=4.0, min_samples=1, algorithm="kd_tree").fit_predict(of_name)
        for label in range(labels.max() + 1):
            members = of_name[labels == label]
            assert np.ptp(members, axis=0).max() <= 4.0 * (len(members) - 1) + 1e-6  # no wider than its links
            expected[name, len(members)] += 1
    assert Counter(zip(fused["sign_class"].to_pylist(), fused["n_detections"].to_pylist(), strict=True)) == expected
    assert sum(fused["n_detections"].to_pylist()) == 22_836
    at = list(zip(fused["sign_class"].to_pylist(), *(np.round(v, 9).tolist() for v in lonlat(fused)), strict=True))
    assert len(set(at)) == len(at) == result.n_signs == 22_026
    again = aggregate(
        tmp_path / "detections",
        tmp_path / "after.parquet",
        config=load_config(overrides=options | {"semantic": "after"}),
    )
    spots = np.column_stack(lonlat(read_table(SIGNS, again.out)))
    assert len(np.unique(spots, axis=0)) == len(spots) < len(places)  # class after: no spot twice, whatever its classes
