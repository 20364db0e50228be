"""Fleets the paper could not run, through the step: mixed sensors, several drives, both directions, large fleets."""

from __future__ import annotations

import tomllib

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
import shapely
from scipy import stats

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.config import load_config
from geofleet.errors import ConfigError, InputError
from geofleet.steps.aggregate import aggregate
from geofleet.steps.simulate import simulate
from geofleet.tables.schemas import DETECTIONS, DRIVES, PASSES, REFERENCE, RUNS, SIGNS, TRUTH
from geofleet.tables.store import build_table, lonlat, read_table, write_table

FRAME = EnuFrame(24.9450453, 60.1677108)  # that of make_signs
CLASSES = ["yield", "no_entry", "straight_only", "pedestrian_crossing"]


def write_drives(path, *lines, is_timed=True):
    tables = []
    for k, line in enumerate(lines):
        n = len(line)
        columns = {"drive_id": f"d{k}", "seq": np.arange(n), "segment": np.zeros(n, int), "source": "test"}
        if is_timed:
            times = np.datetime64("2024-05-01T08:00:00", "us") + np.arange(n) * np.timedelta64(100, "ms")
            columns["t_utc"] = pa.array(times, pa.timestamp("us", tz="UTC"))
        tables.append(build_table(DRIVES, columns, geometry=FRAME.to_lonlat(np.asarray(line, float))))
    write_table(DRIVES, pa.concat_tables(tables), path)
    return path


def straight(north_m=0.0):
    return np.column_stack((np.arange(0, 300.0), np.full(300, north_m)))


@pytest.fixture
def signs(tmp_path, make_signs):
    xy_m = [(60 + 40 * k, 5.0 if k % 2 else -5.0) for k in range(6)] + [(100.0, 205.0), (200.0, 195.0)]
    facing = [270.0, 90.0] * 4  # towards a car that drives east, and away from it
    table = make_signs(xy_m, [CLASSES[k % 4] for k in range(8)], facing_deg=facing)
    write_table(SIGNS, table, tmp_path / "signs.parquet")
    return tmp_path / "signs.parquet"


def run(signs, drive, out, n_vehicles=20, **overrides):
    return simulate(signs, drive, out, config=load_config("paper", overrides), n_vehicles=n_vehicles)


def test_a_mixed_fleet_has_kinds_by_their_shares(signs, tmp_path):
    scenario = tmp_path / "mine.toml"
    scenario.write_text("[mixed.good]\nshare = 0.25\ngnss_sigma_m = 0.1\n[mixed.near]\nshare = 0.5\nrange_m = 40.0\n")
    drive, out = write_drives(tmp_path / "drive.parquet", straight()), tmp_path / "out"
    simulate(signs, drive, out, config=load_config(scenario), n_vehicles=200)
    passes = read_table(PASSES, out / "passes.parquet")
    kinds = np.array(passes["sensor_kind"].to_pylist())
    share = {kind: float((kinds == kind).mean()) for kind in ("good", "near", "camera")}
    assert share == pytest.approx({"good": 0.25, "near": 0.5, "camera": 0.25}, abs=0.1)
    ranges, declared = passes["range_m"].to_numpy(), passes["gnss_sigma_m"].to_numpy()
    assert set(ranges[kinds == "near"]) == {40.0}
    assert set(declared[kinds == "good"]) == {0.1}
    detections = read_table(DETECTIONS, out / "detections")
    near = pa.array([f"v{k:05d}" for k in np.flatnonzero(kinds == "near")])
    assert pc.max(detections.filter(pc.is_in(detections["vehicle_id"], near))["range_mean_m"]).as_py() < 48


def test_a_kind_leaves_the_draws_of_the_others_as_they_were(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    scenario = tmp_path / "mine.toml"
    scenario.write_text("[mixed.odd]\nshare = 0.4\nrange_m = 30.0\n")
    plain, mixed = tmp_path / "plain", tmp_path / "mixed"
    run(signs, drive, plain)
    simulate(signs, drive, mixed, config=load_config(scenario), n_vehicles=20)
    kinds = read_table(PASSES, mixed / "passes.parquet")["sensor_kind"].to_pylist()
    same = [k for k, kind in enumerate(kinds) if kind == "camera"]
    assert 0 < len(same) < 20
    for k in same:
        a, b = (next(out.glob(f"detections/*/vehicle_id=v{k:05d}/part-0.parquet")) for out in (plain, mixed))
        assert a.read_bytes() == b.read_bytes()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[mixed.a]\nshare = 0.7\n[mixed.b]\nshare = 0.6", "add up to 1.3"),
        ("[mixed.a]\nrange_m = 30.0", "share"),
        ("[mixed.a]\nshare = 0.5\nrang_m = 3", r"unknown scenario key 'mixed\.a\.rang_m'"),
        ("[mixed.a]\nshare = 0.5\ngnss_sigma_m = -1", "gnss_sigma_m"),
        ("[mixed]\nshare = 0.5", "a section"),
    ],
)
def test_bad_kinds_are_named(tmp_path, text, message):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_config(path)


def test_options_that_are_off_leave_a_run_its_name_and_others_change_it():
    sections = ("scene", "fleet", "sensor", "tracking", "mixed")
    paper = load_config().digest(*sections)
    assert paper == "027bf9844ca1322b"  # as before there were any options
    off = tomllib.loads("a = [0.3, 0.6]")["a"]
    assert load_config("paper", {"billboard_share": off, "occluded_share": 0.0}).digest(*sections) == paper
    changed = [
        load_config("paper", [text]).digest(*sections)
        for text in ("occluded_share=0.1", "direction=both", "send_information=true", "mixed.a.share=0.1")
    ]
    assert len({paper, *changed}) == 5


def test_every_vehicle_takes_one_of_several_drives(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight(), straight(200.0))
    result = run(signs, drive, tmp_path / "out", 60, drives="all")
    assert result.n_signs == 8
    assert result.drive_length_m == pytest.approx(598, abs=0.1)
    taken = read_table(PASSES, tmp_path / "out" / "passes.parquet")["drive_id"].to_pylist()
    assert 15 < taken.count("d0") < 45
    assert taken.count("d0") + taken.count("d1") == 60


def test_both_directions_are_driven_and_facing_parts_their_signs(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    seen = {}
    for direction in ("forward", "backward", "both"):
        out = tmp_path / direction
        run(signs, drive, out, 30, direction=direction, respect_facing=True, range_m=50.0)
        reference = read_table(REFERENCE, out / "reference.parquet")
        seen[direction] = dict(zip(*(reference[c].to_pylist() for c in ("sign_id", "n_passes_in_view")), strict=True))
    assert [seen["forward"][f"s{k}"] for k in range(6)] == [30, 0] * 3
    assert [seen["backward"][f"s{k}"] for k in range(6)] == [0, 30] * 3
    assert all(5 < n < 25 for n in seen["both"].values())


def test_a_layer_without_facing_cannot_respect_it(tmp_path, make_signs):
    write_table(SIGNS, make_signs([(60, 5), (90, 5)], CLASSES[:2]), tmp_path / "signs.parquet")
    drive = write_drives(tmp_path / "drive.parquet", straight())
    with pytest.raises(InputError, match="none of the 2 signs of the scene has a facing"):
        run(tmp_path / "signs.parquet", drive, tmp_path / "out", respect_facing=True)


def test_what_cannot_be_is_refused_before_anything_is_simulated(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight(), is_timed=False)
    with pytest.raises(InputError, match="no times to take the speed from"):
        run(signs, drive, tmp_path / "out", speed_profile="recorded")
    with pytest.raises(ConfigError, match=r"over a view cone of 0\.524 ha makes 5\.24e\+03 ghosts a frame"):
        run(signs, drive, tmp_path / "out", ghost_rate_per_ha=1e4)
    with pytest.raises(ConfigError, match="needs episodes of 9 frames or more"):
        run(signs, drive, tmp_path / "out", occluded_share=0.9)
    assert not (tmp_path / "out").exists()


def test_billboards_are_ghosts_in_truth(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    for tracker in ("paper", "ideal", "kalman"):
        out = tmp_path / tracker
        run(signs, drive, out, 10, billboards_per_km=30.0, tracker=tracker)
        assert 5 < pc.sum(read_table(TRUTH, out / "truth")["is_ghost"]).as_py() < 200


def test_large_fleets_share_buckets_and_give_the_same_map(signs, tmp_path, monkeypatch):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    run(signs, drive, tmp_path / "folders", 30)
    monkeypatch.setattr("geofleet.steps.simulate.FOLDER_A_VEHICLE", 20)
    monkeypatch.setattr("geofleet.steps.simulate.VEHICLES_A_PART", 12)
    run(signs, drive, tmp_path / "buckets", 30)
    assert list((tmp_path / "buckets" / "detections").rglob("bucket=*/part-2.parquet"))
    keys = [("pass_id", "ascending"), ("track_id", "ascending")]
    one, other = (
        read_table(DETECTIONS, tmp_path / name / "detections").sort_by(keys) for name in ("folders", "buckets")
    )
    assert one.equals(other)
    a, b = (read_table(PASSES, tmp_path / name / "passes.parquet") for name in ("folders", "buckets"))
    assert a.equals(b)
    for name in ("folders", "buckets"):
        aggregate(tmp_path / name / "detections", tmp_path / f"{name}.parquet", config=load_config())
    assert read_table(SIGNS, tmp_path / "folders.parquet").equals(read_table(SIGNS, tmp_path / "buckets.parquet"))


DECLARED = {
    "gnss_sigma_m": 1.7,
    "range_bias_sigma_m": 2.4,
    "bearing_bias_sigma_deg": 1.2,
    "range_noise_sigma_m": 0.3,
    "bearing_noise_sigma_deg": 0.2,
}


def declared(out, kind):
    passes = read_table(PASSES, out / "passes.parquet")
    rows = passes.filter(pc.equal(passes["sensor_kind"], kind)).select([*DECLARED, "false_negative_rate"]).to_pylist()
    assert rows
    assert all(row == rows[0] for row in rows)
    return rows[0]


def test_passes_say_what_the_vehicle_declares_and_a_scale_misstates_sigmas_alone(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    run(signs, drive, tmp_path / "right", 4, heading_sigma_deg=0.9, send_information=True)
    assert declared(tmp_path / "right", "camera") == pytest.approx(
        DECLARED | {"bearing_bias_sigma_deg": 1.5, "false_negative_rate": 0.1}
    )
    run(signs, drive, tmp_path / "wrong", 4, heading_sigma_deg=0.9, send_information=True, declared_sigma_scale=0.5)
    assert declared(tmp_path / "wrong", "camera") == pytest.approx(
        {name: value / 2 for name, value in DECLARED.items()}
        | {"bearing_bias_sigma_deg": 0.75, "false_negative_rate": 0.1}
    )
    right, wrong = (read_table(DETECTIONS, tmp_path / name / "detections") for name in ("right", "wrong"))
    np.testing.assert_array_equal(right["sigma_e_m"], wrong["sigma_e_m"])  # the draws are the same
    s0 = [np.asarray(table["info_s0"]).sum() for table in (right, wrong)]
    assert s0[1] / s0[0] == pytest.approx(4, rel=0.02)  # each residual weighs four times as much
    assert s0[0] / np.asarray(right["info_dof"]).sum() == pytest.approx(1, abs=0.1)


def test_a_kind_may_declare_the_sigmas_of_the_fleet_although_it_is_worse(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    scenario = tmp_path / "mine.toml"
    worse = "share = 0.5\nrange_noise_sigma_m = 0.9\nbearing_noise_sigma_deg = 0.6\nfalse_negative_rate = 0.4\n"
    scenario.write_text(f'[tracking]\nsend_information = true\n[mixed.liar]\n{worse}declares = "fleet"\n')
    simulate(signs, drive, tmp_path / "out", config=load_config(scenario), n_vehicles=60)
    assert (
        declared(tmp_path / "out", "liar")
        == declared(tmp_path / "out", "camera")
        == DECLARED | {"false_negative_rate": 0.1}
    )
    passes, sent = (
        read_table(PASSES, tmp_path / "out" / "passes.parquet"),
        read_table(DETECTIONS, tmp_path / "out" / "detections"),
    )
    kind = dict(zip(passes["pass_id"].to_pylist(), passes["sensor_kind"].to_pylist(), strict=True))
    is_liar = np.array([kind[name] == "liar" for name in sent["pass_id"].to_pylist()])
    s0, dof = np.asarray(sent["info_s0"]), np.asarray(sent["info_dof"])
    assert s0[~is_liar].sum() / dof[~is_liar].sum() == pytest.approx(1, abs=0.1)
    assert s0[is_liar].sum() / dof[is_liar].sum() > 3  # nine, less what the gate of the tracker cuts off


def test_an_rtk_car_in_the_fleet_knows_where_it_is(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    scenario = tmp_path / "mine.toml"
    scenario.write_text("[mixed.rtk]\nshare = 0.3\ngnss_sigma_m = 0.05\n")
    simulate(*(signs, drive, tmp_path / "out"), config=load_config(scenario, {"lateral_sigma_m": 0.0}), n_vehicles=120)
    passes = read_table(PASSES, tmp_path / "out" / "passes.parquet")
    is_rtk = np.array(passes["sensor_kind"].to_pylist()) == "rtk"
    north_m = FRAME.to_enu(
        *np.array([shapely.get_coordinates(shapely.from_wkb(g))[0] for g in passes["geometry"].to_pylist()]).T
    )[:, 1]
    for sigma_m, of_kind in ((0.05, is_rtk), (1.7, ~is_rtk)):
        assert stats.kstest(north_m[of_kind], "norm", (0, sigma_m)).pvalue > 0.001


def test_a_kalman_fleet_may_send_means_alone(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    for name, options in (("both", {}), ("mean", {"send_information": False})):
        run(signs, drive, tmp_path / name, 3, tracker="kalman", **options)
    both, mean = (read_table(DETECTIONS, tmp_path / name / "detections") for name in ("both", "mean"))
    assert [name for name in both.column_names if name not in mean.column_names] == [
        f"info_{part}" for part in ("lon", "lat", "matrix", "vector", "s0", "dof")
    ]
    assert both.select([name for name in mean.column_names if name != "run_id"]).equals(mean.drop_columns("run_id"))
    for name, upload in (("both", "information"), ("mean", "mean")):
        assert read_table(RUNS, tmp_path / name / "runs.parquet")["upload"].to_pylist() == [upload]


def test_ghosts_that_last_get_past_every_tracker_and_single_ones_past_none(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    n_ghosts = {}
    for tracker in ("ideal", "kalman", "paper"):
        for name, options in (("single", {"ghost_rate_per_ha": 0.2}), ("lasting", {"ghost_tracks_per_km": 20.0})):
            out = tmp_path / f"{tracker}-{name}"
            run(signs, drive, out, 40, tracker=tracker, **options)
            n_ghosts[tracker, name] = pc.sum(read_table(TRUTH, out / "truth")["is_ghost"]).as_py()
    assert n_ghosts["ideal", "single"] == 0
    # 20 a km over 0.298 km and 40 passes make 238; those of fewer than three detections are not sent
    assert all(70 < n_ghosts[tracker, "lasting"] < 238 for tracker in ("ideal", "kalman", "paper"))


def test_a_kind_with_a_fault_of_its_calibration_reports_signs_too_far(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    scenario = tmp_path / "mine.toml"
    scenario.write_text("[mixed.broken]\nshare = 0.5\nrange_bias_m = 8.0\n")
    exact = {"gnss_sigma_m": 0.0, "range_bias_sigma_m": 0.0, "bearing_bias_sigma_deg": 0.0, "tracker": "ideal"}
    simulate(signs, drive, tmp_path / "out", config=load_config(scenario, exact), n_vehicles=20)
    passes = read_table(PASSES, tmp_path / "out" / "passes.parquet")
    assert set(passes["range_bias_sigma_m"].to_pylist()) == {0.0}  # it does not know
    kind = dict(zip(passes["pass_id"].to_pylist(), passes["sensor_kind"].to_pylist(), strict=True))
    sent, truth = read_table(DETECTIONS, tmp_path / "out" / "detections"), read_table(TRUTH, tmp_path / "out" / "truth")
    keys = [("pass_id", "ascending"), ("track_id", "ascending")]
    sent, truth = sent.sort_by(keys), truth.sort_by(keys)
    layer = read_table(SIGNS, signs)
    place = dict(zip(layer["sign_id"].to_pylist(), FRAME.to_enu(*lonlat(layer)), strict=True))
    off_m = FRAME.to_enu(*lonlat(sent)) - np.array([place[name] for name in truth["ref_sign_id"].to_pylist()])
    is_broken = np.array([kind[name] == "broken" for name in sent["pass_id"].to_pylist()])
    assert off_m[~is_broken].mean(axis=0) == pytest.approx([0, 0], abs=0.05)
    assert off_m[is_broken, 0].mean() == pytest.approx(8.0, abs=0.3)  # ahead of the car, which drives east


def test_half_of_the_long_tracks_are_sent_in_two(signs, tmp_path):
    drive = write_drives(tmp_path / "drive.parquet", straight())
    n = {}
    for rate in (0.0, 0.5):
        out = tmp_path / f"{rate}"
        run(signs, drive, out, 40, tracker="ideal", split_track_rate=rate)
        truth = read_table(TRUTH, out / "truth")
        n[rate] = truth.group_by(["pass_id", "ref_sign_id"]).aggregate([("track_id", "count")])["track_id_count"]
    assert set(n[0.0].to_pylist()) == {1}
    counts = np.bincount(n[0.5].to_pylist())
    assert len(counts) == 3
    assert stats.binomtest(int(counts[2]), int(counts.sum()), 0.5).pvalue > 0.001
