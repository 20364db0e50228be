"""Detections to signs: the same layer for any tiles, workers, batches and row order; bad rows told and set aside."""

from __future__ import annotations

import json
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from pyproj import Geod
from sklearn.cluster import DBSCAN

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.config import load_config
from geofleet.engines.local import run_tasks
from geofleet.errors import ConfigError, InputError, TableError
from geofleet.steps.aggregate import aggregate, tiles
from geofleet.tables.schemas import DETECTIONS, SIGNS
from geofleet.tables.store import build_table, lonlat, read_table, write_table

HELSINKI = EnuFrame(24.9450453, 60.1677108)
PLACES = {
    "Helsinki": HELSINKI,
    "antimeridian": EnuFrame(180.0, 61.0),
    "north": EnuFrame(25.751953125, 70.0),
    "corner": EnuFrame(11.42578125, 48.748945343432936),
}
CLASSES = ("speed_limit:50", "stop", "raw:FI:999")


def make_detections(xy, *, frame=HELSINKI, run_id="run-a", **columns):
    n = len(xy)
    vehicles = [f"{k:03}" for k in np.arange(n) % 10]
    given = {
        "run_id": run_id,
        "vehicle_id": vehicles,
        "pass_id": vehicles,
        "track_id": np.arange(n),
        "sign_class": "stop",
        "n_frames": 5,
        "sigma_e_m": 0.5,
        "sigma_n_m": 0.5,
    }
    return build_table(DETECTIONS, given | columns, geometry=frame.to_lonlat(np.asarray(xy, float).reshape(-1, 2)))


def scene(seed=0, n_signs=60, frame=HELSINKI, *, run_id="run-a", n_seen=10, reach_m=200, sigma_m=1.2):
    rng = np.random.default_rng(seed)
    places = rng.uniform(-reach_m, reach_m, (n_signs, 2))
    xy = np.repeat(places, n_seen, axis=0) + rng.normal(0, sigma_m, (n_seen * n_signs, 2))
    classes = np.repeat(np.array(CLASSES)[rng.integers(0, 3, n_signs)], n_seen)
    flips = rng.random(len(xy)) < 0.1
    classes[flips] = np.array(CLASSES)[rng.integers(0, 3, flips.sum())]
    return make_detections(xy, frame=frame, run_id=run_id, sign_class=classes, n_frames=rng.integers(1, 40, len(xy)))


def run_on(tmp_path, table, *, name="fused", n_workers=1, n_vehicles=None, **overrides):
    source, out = tmp_path / f"{name}_detections.parquet", tmp_path / f"{name}.parquet"
    write_table(DETECTIONS, table, source)
    config = load_config(overrides=overrides)
    return aggregate(source, out, config=config, n_vehicles=n_vehicles, n_workers=n_workers)


@pytest.mark.parametrize(
    ("place", "semantic", "zooms"),
    [
        ("Helsinki", "first", (12, 14, 18, 20)),
        ("Helsinki", "after", (12, 20)),
        ("antimeridian", "first", (12, 20)),
        ("north", "first", (12, 20)),
        ("corner", "first", (12, 20)),
    ],
)
def test_tiles_workers_batches_and_row_order_do_not_show(tmp_path, monkeypatch, place, semantic, zooms):
    table = scene(seed=3, frame=PLACES[place])
    mixed = table.take(np.random.default_rng(1).permutation(table.num_rows))
    whole = run_on(tmp_path, table, semantic=semantic, tile_zoom=16)
    assert whole.n_signs > 30
    expected = whole.out.read_bytes()
    monkeypatch.setattr(tiles, "COARSER_BY", 0)  # the very tiles asked for
    for zoom in zooms:
        monkeypatch.setattr(tiles, "BATCH_ROWS", 5 * zoom)
        result = run_on(tmp_path, mixed, tile_zoom=zoom, n_workers=2, semantic=semantic)
        assert result.out.read_bytes() == expected, zoom
    assert result.n_tiles > 60


@settings(max_examples=6, phases=[Phase.generate])  # without shrinking, which takes minutes here
@given(
    st.integers(0, 10_000),
    st.sampled_from(sorted(PLACES)),
    st.sampled_from(["first", "after"]),
    st.tuples(st.integers(12, 20), st.integers(20, 3000), st.integers(1, 4)),
    st.integers(3, 8),
)
def test_tiles_do_not_show_where_dense_places_ask_for_more(seed, place, semantic, how, min_samples):
    """Signs of a hundred detections, chained by a core of three; clusters across tiles are split as all others are."""
    zoom, batch_rows, n_workers = how
    rule = {"semantic": semantic, "min_samples": min_samples, "min_samples_share": 0.7}
    table = scene(seed=seed, frame=PLACES[place], n_signs=30, n_seen=100, reach_m=60, sigma_m=1.8)
    with TemporaryDirectory() as name, pytest.MonkeyPatch.context() as patch:
        whole = run_on(Path(name), table, **rule, tile_zoom=12)
        plain = run_on(Path(name), table, name="plain", **rule | {"min_samples_share": 0.0}, tile_zoom=12)
        assert plain.out.read_bytes() != whole.out.read_bytes()
        patch.setattr(tiles, "COARSER_BY", 0)
        patch.setattr(tiles, "BATCH_ROWS", batch_rows)
        mixed = table.take(np.random.default_rng(seed).permutation(table.num_rows))
        parts = run_on(Path(name), mixed, name="parts", **rule, tile_zoom=zoom, n_workers=n_workers)
        assert parts.out.read_bytes() == whole.out.read_bytes()


@pytest.mark.parametrize("n_seen", [10, 80])
def test_signs_are_the_clusters_of_scikit_learn(tmp_path, n_seen):
    table = scene(seed=8, n_seen=n_seen)
    result = run_on(tmp_path, table, min_samples=3, min_support=1, min_support_share=0.0)
    xy, classes = HELSINKI.to_enu(*lonlat(table)), np.array(table["sign_class"].to_pylist())
    expected = []
    for name in CLASSES:
        of_class = xy[classes == name]
        labels = DBSCAN(eps=4.0, min_samples=3, algorithm="kd_tree").fit_predict(of_class)
        expected += [(name, int((labels == k).sum())) for k in range(labels.max() + 1)]
    fused = read_table(SIGNS, result.out)
    found = zip(fused["sign_class"].to_pylist(), fused["n_detections"].to_pylist(), strict=True)
    assert sorted(found) == sorted(expected)
    assert result.n_clusters == result.n_signs == len(expected)


def test_a_sign_worked_out_by_hand(tmp_path):
    # three passes 0, 1 and 2 m east of the origin: equal weights, so the mean is 1 m and the variance 1/3 m²
    table = make_detections([[0, 0], [1, 0], [2, 0]], sign_class="speed_limit:50", class_confidence=[0.5, 0.75, 1.0])
    (sign,) = read_table(SIGNS, run_on(tmp_path, table, min_support_share=0.0).out).to_pylist()
    lon, lat = HELSINKI.to_lonlat(np.array([[1.0, 0.0]]))
    assert Geod(ellps="WGS84").inv(sign["bbox"]["xmin"], sign["bbox"]["ymin"], lon[0], lat[0])[2] < 1e-4
    assert sign["var_e_m2"] == pytest.approx(1 / 3, rel=1e-5)
    assert sign["var_n_m2"] == pytest.approx(0, abs=1e-9)
    assert (sign["concept"], sign["value"], sign["unit"]) == ("speed_limit", 50.0, "km/h")
    assert (sign["n_passes"], sign["n_detections"], sign["n_vehicles"]) == (3, 3, 3)
    assert (sign["kind"], sign["method"], sign["run_id"], sign["source"]) == (
        "main",
        "dbscan-peaks",
        "run-a",
        "geofleet",
    )
    assert sign["class_confidence"] == pytest.approx(0.75)
    assert sign["sign_id"].startswith("f")
    assert len(sign["sign_id"]) == 13


def test_class_by_vote_after_clustering(tmp_path):
    table = make_detections([[0, 0], [0, 1], [1, 0], [1, 1]], sign_class=["stop", "yield", "stop", "stop"])
    (sign,) = read_table(SIGNS, run_on(tmp_path, table, semantic="after").out).to_pylist()
    assert (sign["sign_class"], sign["class_confidence"], sign["n_detections"]) == ("stop", 0.75, 4)
    assert (sign["value"], sign["unit"], sign["method"]) == (None, None, "dbscan-peaks-after")


@pytest.mark.parametrize(
    ("settings", "label"),
    [
        ({}, "dbscan-peaks"),
        ({"semantic": "after"}, "dbscan-peaks-after"),
        ({"min_samples": 3}, "dbscan-first"),
        ({"min_samples": 3, "semantic": "after"}, "dbscan-after"),
        ({"min_samples_share": 0.0}, "dbscan-first"),
        ({"min_samples": 4, "min_samples_share": 0.5}, "dbscan-peaks"),
        ({"method": "hdbscan"}, "hdbscan-first"),
    ],
)
def test_a_layer_and_its_manifest_say_which_core_rule_made_it(tmp_path, settings, label):
    result = run_on(tmp_path, scene(), **settings)
    assert set(read_table(SIGNS, result.out)["method"].to_pylist()) == {label}
    manifest = json.loads((tmp_path / "fused_manifest.json").read_text())
    assert manifest["settings"]["label"] == label


def test_support_counts_passes_not_detections(tmp_path):
    table = make_detections([[0, 0], [1, 0], [0, 1]], pass_id=["a", "a", "b"])
    assert run_on(tmp_path, table, min_support=3).n_signs == 0
    assert run_on(tmp_path, table, min_support=2).n_signs == 1
    many = make_detections(np.zeros((40, 2)))  # ten vehicles
    assert run_on(tmp_path, many, min_support=1, min_support_share=1.0).n_signs == 1
    part = many.filter(pa.compute.less(many["track_id"], 39))
    lonely = pa.concat_tables([part, make_detections([[90, 90]] * 3, track_id=[90, 91, 92])])
    assert run_on(tmp_path, lonely, min_support=1, min_support_share=0.5).n_signs == 1


def test_runs_are_never_mixed(tmp_path):
    tables = [make_detections([[0, 0], [1, 0]], run_id=name) for name in ("a", "b")]
    assert run_on(tmp_path, pa.concat_tables(tables)).n_clusters == 0
    both = pa.concat_tables([scene(seed=1, run_id="a"), scene(seed=2, run_id="b")])
    together = read_table(SIGNS, run_on(tmp_path, both).out)
    alone = [read_table(SIGNS, run_on(tmp_path, scene(seed=s, run_id=r)).out) for s, r in ((1, "a"), (2, "b"))]
    assert together.to_pylist() == sorted(pa.concat_tables(alone).to_pylist(), key=lambda row: row["sign_id"])


def test_a_small_fleet_is_the_first_vehicles(tmp_path):
    table = scene(seed=5)
    few = table.filter(pa.compute.less(table["vehicle_id"], "004"))
    result = run_on(tmp_path, table, n_vehicles=4)
    assert result.out.read_bytes() == run_on(tmp_path, few, name="few", n_vehicles=4).out.read_bytes()
    assert result.n_used == few.num_rows
    assert set(read_table(SIGNS, result.out)["n_vehicles"].to_pylist()) == {4}
    assert result.notes == ()
    assert run_on(tmp_path, few, n_vehicles=9).notes == ("Run run-a: 4 of the 9 vehicles asked for have detections.",)


def test_a_partitioned_folder_gives_the_same_and_keeps_ids_as_text(tmp_path):
    table, folder = scene(seed=6, run_id="a run/1"), tmp_path / "detections"
    partitioning = ds.partitioning(table.select(["run_id", "vehicle_id"]).schema, flavor="hive")
    ds.write_dataset(table, folder, format="parquet", partitioning=partitioning)
    from_folder = aggregate(folder, tmp_path / "folder.parquet", config=load_config())
    assert from_folder.run_ids == ("a run/1",)
    assert from_folder.out.read_bytes() == run_on(tmp_path, table).out.read_bytes()


def test_missing_frames_and_spreads_widen_but_do_not_stop(tmp_path):
    blank = dict.fromkeys(("n_frames", "sigma_e_m", "sigma_n_m", "class_confidence"))
    table = make_detections(
        [[0, 0], [1, 0], [2, 0]], **{k: pa.nulls(3, DETECTIONS.arrow().field(k).type) for k in blank}
    )
    (sign,) = read_table(SIGNS, run_on(tmp_path, table).out).to_pylist()
    assert sign["class_confidence"] == 1.0
    assert sign["var_e_m2"] == pytest.approx(1 / 3, rel=1e-5)
    assert (sign["first_seen"], sign["last_seen"]) == (None, None)


def test_times_span_the_members(tmp_path):
    kind = DETECTIONS.arrow().field("t_first").type
    firsts, lasts = pa.array([5, None, 3], kind), pa.array([6, None, 9], kind)
    table = make_detections([[0, 0], [1, 0], [2, 0]], t_first=firsts, t_last=lasts)
    fused = read_table(SIGNS, run_on(tmp_path, table).out)
    assert fused["first_seen"].cast(pa.int64()).to_pylist() == [3]
    assert fused["last_seen"].cast(pa.int64()).to_pylist() == [9]


def with_positions(table, lon, lat):
    """Replace positions, bad ones too, which no writer of ours lets through."""
    box = pa.StructArray.from_arrays(
        [pa.array(v, pa.float64()) for v in (lon, lat, lon, lat)], ["xmin", "ymin", "xmax", "ymax"]
    )
    return table.set_column(table.schema.get_field_index("bbox"), table.schema.field("bbox"), box)


def test_bad_rows_are_counted_and_set_aside_with_the_reason(tmp_path):
    good = make_detections([[0, 0], [1, 0], [2, 0], [1, 1]], track_id=[0, 1, 2, 2], pass_id=["a", "b", "c", "c"])
    bad = make_detections(np.zeros((4, 2)), track_id=np.arange(10, 14), sign_class=["stop", "stop", "stop", " "])
    bad = with_positions(bad, [np.nan, 24.9, 190.0, 24.9], [60.0, 85.06, 60.0, 60.0])
    source, out = tmp_path / "bad.parquet", tmp_path / "fused.parquet"
    pq.write_table(pa.concat_tables([good, bad]), source)
    result = aggregate(source, out, config=load_config())
    rejected = pq.read_table(result.rejected)
    assert sorted(zip(rejected["track_id"].to_pylist(), rejected["reason"].to_pylist(), strict=True)) == [
        (2, "key repeated"),
        (10, "position not finite"),
        (11, "position out of range"),
        (12, "position out of range"),
        (13, "class missing"),
    ]
    assert (result.n_detections, result.n_rejected, result.n_used) == (8, 5, 3)
    assert result.skipped == {
        "class missing": 1,
        "key repeated": 1,
        "position not finite": 1,
        "position out of range": 2,
    }
    assert any("5 detections could not be used (1 class missing, " in line for line in result.summary())
    assert json.loads((tmp_path / "fused_manifest.json").read_text())["counts"]["skipped"] == result.skipped
    assert read_table(SIGNS, out)["n_detections"].to_pylist() == [3]
    clean = run_on(tmp_path, good.slice(0, 3))
    assert clean.rejected is None
    assert not (tmp_path / "fused_rejected.parquet").exists()


def test_detections_outside_the_stated_area_are_set_aside(tmp_path):
    table, out = make_detections([[0, 0], [1, 0], [0, 1], [300, 0], [301, 0], [300, 1]]), tmp_path / "fused.parquet"
    write_table(DETECTIONS, table, tmp_path / "d.parquet")
    lon, lat = (np.round(value, 4) for value in HELSINKI.to_lonlat(np.array([[-50.0, -50.0], [50.0, 50.0]])))
    area = (lon[0], lat[0], lon[1], lat[1])
    config = load_config(overrides={"min_samples": 3})
    assert aggregate(tmp_path / "d.parquet", out, config=config).n_signs == 2
    result = aggregate(tmp_path / "d.parquet", out, config=config, area=area)
    assert (result.n_signs, result.n_used, result.skipped) == (1, 3, {"outside the area": 3})
    assert pq.read_table(result.rejected)["track_id"].to_pylist() == [3, 4, 5]
    assert json.loads((tmp_path / "fused_manifest.json").read_text())["settings"]["area"] == list(area)
    elsewhere = aggregate(tmp_path / "d.parquet", out, config=config, area=(10.0, 50.0, 11.0, 51.0))
    assert (elsewhere.n_signs, elsewhere.skipped) == (0, {"outside the area": 6})
    assert read_table(SIGNS, out).num_rows == 0


def test_an_area_may_span_the_antimeridian(tmp_path):
    table = make_detections([[-90, 0], [90, 0], [9000, 0]], frame=EnuFrame(180.0, 61.0))
    write_table(DETECTIONS, table, tmp_path / "d.parquet")
    config = load_config(overrides={"min_samples": 1, "min_support": 1})
    found = aggregate(tmp_path / "d.parquet", tmp_path / "f.parquet", config=config, area=(179.9, 60, -179.9, 62))
    assert (found.n_signs, found.n_rejected) == (2, 1)


@pytest.mark.parametrize("area", [(1, 2, 1, 3), (1, 3, 2, 3), (-181, 2, 1, 3), (1, 2, 3, 91), (np.nan, 0, 1, 1)])
def test_an_area_that_cannot_be_meant_is_refused(tmp_path, area):
    with pytest.raises(ConfigError, match="is no area"):
        aggregate(tmp_path / "d.parquet", tmp_path / "f.parquet", config=load_config(), area=area)


@pytest.mark.parametrize("method", ["dbscan", "hdbscan", "joint"])
def test_classes_that_the_vocabulary_does_not_know_are_told_and_kept_or_set_aside(tmp_path, method):
    names = ["stop"] * 6 + ["speed_limit:50"] * 3 + ["raw:FI:999"] * 2 + ["odd", "odd:7"]
    table = make_detections(np.arange(26).reshape(13, 2) / 20, sign_class=names)
    kept = run_on(tmp_path, table, method=method)
    assert (kept.n_used, kept.unknown_classes) == (13, {"raw:FI:999": 2, "odd": 1, "odd:7": 1})
    assert kept.skipped == {}
    strict = run_on(tmp_path, table, method=method, unknown_classes="reject")
    assert (strict.n_used, strict.unknown_classes, strict.skipped) == (9, {}, {"class unknown": 4})
    rejected = pq.read_table(strict.rejected)
    assert sorted(rejected["sign_class"].to_pylist()) == ["odd", "odd:7", "raw:FI:999", "raw:FI:999"]
    counts = json.loads((tmp_path / "fused_manifest.json").read_text())["counts"]
    assert (counts["skipped"], counts["unknown_classes"]) == (strict.skipped, {})


def test_many_unknown_classes_are_told_as_a_few(tmp_path):
    table = make_detections(np.zeros((60, 2)), sign_class=[f"odd:{min(k, 29)}" for k in range(60)])
    told = run_on(tmp_path, table).unknown_classes
    assert list(told.items())[:2] == [("odd:29", 31), ("odd:0", 1)]
    assert (len(told), told["10 more"]) == (21, 10)


def test_no_detections_give_an_empty_layer_and_say_so(tmp_path):
    result = run_on(tmp_path, scene().slice(0, 0))
    assert read_table(SIGNS, result.out).num_rows == 0
    assert (result.n_signs, result.n_detections, result.run_ids) == (0, 0, ())
    assert "There are no detections: the layer is empty." in result.summary()


def test_only_noise_gives_an_empty_layer(tmp_path):
    result = run_on(tmp_path, make_detections([[0, 0], [50, 0]]))
    assert read_table(SIGNS, result.out).num_rows == 0
    assert result.run_ids == ("run-a",)


def test_a_missing_column_is_named(tmp_path):
    source = tmp_path / "d.parquet"
    pq.write_table(scene().drop_columns(["sign_class"]), source)
    with pytest.raises(TableError, match="missing column sign_class"):
        aggregate(source, tmp_path / "f.parquet", config=load_config())
    assert [p.name for p in tmp_path.iterdir()] == ["d.parquet"]


@pytest.mark.parametrize("column", ["n_frames", "track_id", "sigma_e_m", "sign_class", "t_first"])
def test_a_mistyped_column_is_named(tmp_path, column):
    table, source = scene(), tmp_path / "d.parquet"
    wrong = pa.array([b"x"] * table.num_rows, pa.binary())
    pq.write_table(table.set_column(table.schema.get_field_index(column), column, wrong), source)
    with pytest.raises(TableError, match=f"column {column} is BLOB"):
        aggregate(source, tmp_path / "f.parquet", config=load_config())


def test_what_is_no_table_is_refused(tmp_path):
    (tmp_path / "text.parquet").write_text("no")
    (tmp_path / "empty").mkdir()
    for name, message in (("text.parquet", "not a Parquet"), ("empty", "holds no Parquet"), ("none", "no such file")):
        with pytest.raises(InputError, match=message):
            aggregate(tmp_path / name, tmp_path / "f.parquet", config=load_config())


def square(number):
    return number * number


def test_tasks_come_back_in_order_and_their_errors_come_through():
    seen = []
    found = list(run_tasks(square, range(20), n_workers=3, progress=lambda done, total: seen.append((done, total))))
    assert found == [k * k for k in range(20)]
    assert seen == [(k, 20) for k in range(1, 21)]
    with pytest.raises(TypeError):
        list(run_tasks(square, [1, "x", 3], n_workers=2))
    with pytest.raises(ConfigError, match="0 workers"):
        list(run_tasks(square, [1], n_workers=0))
