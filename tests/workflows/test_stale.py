"""An outdated copy of a layer: shares, places, variances, and that it depends on ids and seed alone."""

from __future__ import annotations

import csv
from collections import Counter

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Geod

from geofleet.algorithms.staleness import (
    KEPT,
    MOVED,
    REMOVED,
    RETYPED,
    Staleness,
    make_stale,
    sign_keys,
)
from geofleet.config import load_config
from geofleet.errors import ConfigError, InputError
from geofleet.formats.layers import read_layer
from geofleet.steps.evaluate import evaluate
from geofleet.steps.ingest import ingest_drive
from geofleet.steps.simulate import simulate
from geofleet.tables.schemas import REFERENCE, SIGNS
from geofleet.tables.store import lonlat, read_table, write_table
from geofleet.workflows.stale import stale

GEOD = Geod(ellps="WGS84")
USUAL = Staleness(0.15, 0.10, 0.10, 0.10, moved_m=5.0, sigma_m=0.15)


def street(n, seed=0):
    """Signs every 20 m along a street, of four classes."""
    rng = np.random.default_rng(seed)
    xy = np.column_stack((20.0 * np.arange(n), rng.normal(0, 3, n)))
    frame_lon, frame_lat = 24.94 + xy[:, 0] / 55_500, 60.17 + xy[:, 1] / 111_300
    return sign_keys([f"node/{i}" for i in range(n)]), frame_lon, frame_lat, rng.integers(0, 4, n)


@given(st.integers(0, 10**6), st.integers(2, 300))
def test_shares_are_met_and_no_sign_has_two_fates(seed, n):
    keys, lon, lat, codes = street(n)
    codes[:2] = 0, 1
    copy = make_stale(keys, lon, lat, codes, USUAL, seed=seed)
    wanted = [int(np.floor(share * n + 0.5)) for share in (0.15, 0.10, 0.10, 0.10)]
    assert [int((copy.fate == fate).sum()) for fate in (REMOVED, RETYPED, MOVED)] == wanted[:3]
    assert len(copy.key) == len(copy.like) == len(copy.lon_deg) - n == wanted[3]
    changed = codes[copy.class_of[:n]] != codes
    assert (changed == (copy.fate == RETYPED)).all()


def test_the_order_of_the_signs_plays_no_part():
    keys, lon, lat, codes = street(200)
    copy = make_stale(keys, lon, lat, codes, USUAL, seed=3)
    order = np.random.default_rng(1).permutation(200)
    other = make_stale(keys[order], lon[order], lat[order], codes[order], USUAL, seed=3)
    assert (other.fate == copy.fate[order]).all()
    assert (other.lon_deg[:200] == copy.lon_deg[order]).all()
    assert (codes[order][other.class_of] == codes[copy.class_of[np.append(order, np.arange(200, 220))]]).all()
    assert (other.key == copy.key).all()
    assert (other.lat_deg[200:] == copy.lat_deg[200:]).all()


def test_positions_are_off_by_what_is_asked_for():
    keys, lon, lat, codes = street(4000)
    copy = make_stale(keys, lon, lat, codes, Staleness(sigma_m=0.15), seed=5)
    azimuth, _, away_m = GEOD.inv(lon, lat, copy.lon_deg, copy.lat_deg)
    east, north = away_m * np.sin(np.radians(azimuth)), away_m * np.cos(np.radians(azimuth))
    assert np.std(east) == pytest.approx(0.15, rel=0.05)
    assert np.std(north) == pytest.approx(0.15, rel=0.05)
    assert abs(np.corrcoef(east, north)[0, 1]) < 0.05
    assert abs(np.mean(east)) < 0.01
    moved = make_stale(keys, lon, lat, codes, Staleness(moved=0.1, moved_m=5.0, shift_m=(3.0, 4.0)), seed=5)
    azimuth, _, away_m = GEOD.inv(lon, lat, moved.lon_deg, moved.lat_deg)
    assert away_m[moved.fate == KEPT] == pytest.approx(5.0, abs=1e-6)
    assert azimuth[moved.fate == KEPT] == pytest.approx(np.degrees(np.arctan2(3, 4)), abs=1e-4)
    alone = make_stale(keys, lon, lat, codes, Staleness(moved=0.1, moved_m=5.0), seed=5)
    assert np.asarray(GEOD.inv(lon, lat, alone.lon_deg, alone.lat_deg)[2])[alone.fate == MOVED] == pytest.approx(5.0)


def test_obsolete_signs_stand_along_the_street_and_clear_of_their_like():
    keys, lon, lat, codes = street(500)
    copy = make_stale(keys, lon, lat, codes, Staleness(obsolete=0.2), seed=9)
    for place in range(500, 600):
        away_m = np.asarray(
            GEOD.inv(*(np.full(500, side[place]) for side in (copy.lon_deg, copy.lat_deg)), lon, lat)[2]
        )
        assert away_m[codes == codes[copy.class_of[place]]].min() >= 5.0
        assert away_m.min() < 90.0
    counts = np.bincount(codes[copy.class_of[500:]], minlength=4)
    assert counts.min() > 5, "classes are drawn from the layer's"


def test_a_lonely_sign_has_obsolete_company(make_signs, tmp_path):
    write_table(SIGNS, make_signs([(0, 0)], ["stop"]), tmp_path / "in.parquet")
    result = stale(tmp_path / "in.parquet", tmp_path / "out.parquet", Staleness(obsolete=1.0))
    assert (result.n_signs, result.fates["obsolete"]) == (2, 1)


@pytest.fixture
def poles(make_signs, tmp_path):
    """Forty main signs, a plate below each of the first ten, a light apart."""
    xy = [(25.0 * i, 0.0) for i in range(40)] + [(25.0 * i, 0.0) for i in range(10)] + [(500.0, 30.0)]
    classes = [("stop", "yield", "speed_limit:30")[i % 3] for i in range(40)] + ["plate"] * 10 + ["light"]
    columns = {
        "kind": ["main"] * 40 + ["plate"] * 10 + ["light"],
        "parent_id": pa.array([None] * 40 + [f"s{i}" for i in range(10)] + [None], pa.string()),
    }
    write_table(SIGNS, make_signs(xy, classes, **columns), tmp_path / "poles.parquet")
    return tmp_path / "poles.parquet"


def test_plates_go_with_their_sign_and_the_rest_stays(poles, tmp_path):
    stale(poles, tmp_path / "out.parquet", Staleness(removed=0.5, moved=0.5, moved_m=8.0), seed=2)
    before, after = read_layer(poles).table, read_layer(tmp_path / "out.parquet").table
    place = dict(zip(after["sign_id"].to_pylist(), zip(*lonlat(after), strict=True), strict=True))
    for plate, parent in zip(before["sign_id"].to_pylist(), before["parent_id"].to_pylist(), strict=True):
        if parent is not None:
            assert (plate in place) == (parent in place)
            if plate in place:
                assert place[plate] == pytest.approx(place[parent], abs=1e-12)
    assert Counter(after["kind"].to_pylist())["main"] == 20
    assert Counter(after["kind"].to_pylist())["light"] == 1


def test_the_variance_grows_by_the_noise(make_signs, tmp_path):
    known = make_signs([(0, 0), (50, 0)], ["stop", "yield"], var_e_m2=[0.04, None], var_n_m2=[0.09, None])
    write_table(SIGNS, known, tmp_path / "in.parquet")
    stale(tmp_path / "in.parquet", tmp_path / "out.parquet", Staleness(sigma_m=0.1))
    after = read_layer(tmp_path / "out.parquet").table
    assert after["var_e_m2"].to_pylist() == pytest.approx([0.05, 0.01])
    assert after["var_n_m2"].to_pylist() == pytest.approx([0.10, 0.01])
    stale(tmp_path / "in.parquet", tmp_path / "exact.parquet", Staleness())
    assert read_layer(tmp_path / "exact.parquet").table["var_e_m2"].to_pylist() == [0.04, None]


def test_what_is_outdated_is_told_apart_from_the_layer(poles, tmp_path):
    result = stale(poles, tmp_path / "out.parquet", USUAL, seed=4)
    assert result.fates == {"kept": 26, "removed": 6, "retyped": 4, "moved": 4, "obsolete": 4}
    with result.changes.open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert Counter(row["fate"] for row in rows) == result.fates
    layer = read_layer(result.out).table
    classes = dict(zip(layer["sign_id"].to_pylist(), layer["sign_class"].to_pylist(), strict=True))
    for row in rows:
        assert classes.get(row["sign_id"], "") == row["stale_class"]
        assert (row["true_class"] != row["stale_class"]) == (row["fate"] in {"removed", "retyped", "obsolete"})
    assert "change" not in layer.column_names, "what a method reads says nothing of it"
    assert all("simulated, seed 4" in source for source in layer["source"].to_pylist())


def test_same_bytes_from_the_same_seed_and_other_bytes_from_another(poles, tmp_path):
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        stale(poles, tmp_path / f"{name}.parquet", USUAL, seed=seed)
    a, b, c = ((tmp_path / f"{name}.parquet").read_bytes() for name in "abc")
    assert a == b != c


def test_a_reference_of_many_runs_gives_one_copy(repo, tmp_path):
    raw = repo / "data" / "raw"
    ingest_drive([raw / "helsinki_derived.pos"], tmp_path / "drive.parquet")
    simulate(
        *(raw / "helsinki.osm.pbf", tmp_path / "drive.parquet", tmp_path / "sim"),
        config=load_config("paper"),
        n_vehicles=1,
        n_replicates=3,
    )
    reference = tmp_path / "sim" / "reference.parquet"
    result = stale(reference, tmp_path / "out.geojson", USUAL)
    assert (result.n_main, result.n_signs) == (33, 31)
    table = read_table(REFERENCE, reference)
    write_table(REFERENCE, table.filter(pc.equal(table["run_id"], table["run_id"][0])), tmp_path / "one.parquet")
    scores = evaluate(result.out, tmp_path / "one.parquet", tmp_path / "scores", config=load_config("paper"))
    (one,) = scores.totals
    assert one["tp"] == 33 - 5 - 3 - 3, "what was removed, retyped or moved no longer matches"


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"removed": 1.5}, "removed is 1.5"),
        ({"removed": 0.5, "retyped": 0.4, "moved": 0.2}, "more than 1"),
        ({"sigma_m": -1.0}, "sigma_m"),
        ({"shift_m": (float("nan"), 0.0)}, "shift_m"),
    ],
)
def test_impossible_shares_are_refused(wrong, says):
    with pytest.raises(InputError, match=says):
        Staleness(**wrong)


def test_what_cannot_be_made_outdated_is_refused(make_signs, tmp_path):
    source, out = tmp_path / "in.parquet", tmp_path / "out.parquet"
    write_table(SIGNS, make_signs([(0, 0), (9, 0)], ["stop", "stop"]), source)
    with pytest.raises(InputError, match="one class"):
        stale(source, out, Staleness(retyped=1.0))
    with pytest.raises(ConfigError, match="seed"):
        stale(source, out, Staleness(), seed=-1)
    with pytest.raises(ConfigError, match="no format to write"):
        stale(source, tmp_path / "out.kml", Staleness())
    write_table(SIGNS, make_signs([(0, 0)], ["light"], kind=["light"]), source)
    with pytest.raises(InputError, match="no main sign"):
        stale(source, out, Staleness())
    two = make_signs([(0, 0), (9, 0)], ["stop", "stop"], method=["a", "b"], run_id=["r", "r"], n_vehicles=[1, 1])
    write_table(SIGNS, two, source)
    with pytest.raises(ConfigError, match="several maps"):
        stale(source, out, Staleness())
    assert [path.name for path in tmp_path.iterdir()] == ["in.parquet"]
