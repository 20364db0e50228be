"""Joint fusion through the step: simulated fleets, a prior map, real detections without passes, and bad options."""

from __future__ import annotations

import json
from pathlib import Path

import pyarrow as pa
import pyarrow.compute as pc
import pytest

from geofleet.algorithms.staleness import Staleness
from geofleet.config import load_config
from geofleet.errors import ConfigError, InputError
from geofleet.steps.aggregate import aggregate, beside, explain
from geofleet.steps.evaluate import evaluate
from geofleet.steps.ingest import ingest_drive, ingest_signs
from geofleet.steps.ingest_detections import ingest_detections
from geofleet.steps.simulate import simulate
from geofleet.tables.manifest import manifest_path
from geofleet.tables.schemas import DETECTIONS, EVIDENCE, NUISANCE, PASSES, REFERENCE, SIGNS
from geofleet.tables.store import build_table, lonlat, read_table, write_table
from geofleet.workflows.stale import stale

RAW = Path(__file__).parents[2] / "data" / "raw"
BREMEN = Path(__file__).parents[3] / "shared" / "data" / "mapillary" / "mapillary_traffic-signs_DE-HB.parquet"
JOINT = load_config("paper-ideal", {"method": "joint", "tracker": "kalman"})


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    """Return a simulated fleet of eight past the shipped signs, two replicates."""
    folder = tmp_path_factory.mktemp("fleet")
    ingest_signs([RAW / "helsinki.osm.pbf"], folder / "signs.parquet")
    ingest_drive([RAW / "helsinki_derived.pos"], folder / "drives.parquet")
    simulate(
        folder / "signs.parquet",
        folder / "drives.parquet",
        folder / "simulation",
        config=JOINT,
        n_vehicles=8,
        n_replicates=2,
        seed=42,
    )
    return folder / "simulation"


def fused(fleet, out, **options):
    return aggregate(fleet / "detections", out, config=JOINT, passes=fleet / "passes.parquet", **options)


def test_eight_cars_find_every_sign(fleet, tmp_path):
    fused(fleet, tmp_path / "fused.parquet")
    totals = evaluate(
        tmp_path / "fused.parquet", fleet / "reference.parquet", tmp_path / "evaluation", config=JOINT
    ).totals
    assert [total["method"] for total in totals] == ["joint"] * 2
    assert min(total["f1"] for total in totals) > 0.98
    assert max(total["gospa_m"] for total in totals) < 1.5


def test_the_map_says_how_sure_it_is_and_what_is_behind_it(fleet, tmp_path):
    result = fused(fleet, tmp_path / "fused.parquet")
    signs = read_table(SIGNS, tmp_path / "fused.parquet")
    assert pc.min(signs["existence"]).as_py() > 0.5
    assert pc.min(signs["n_opportunities"]).as_py() >= 1
    assert 0.1 < pc.mean(signs["var_e_m2"]).as_py() ** 0.5 < 1.0  # 1.3 m over the root of eight, and the geometry
    evidence = read_table(EVIDENCE, beside(tmp_path / "fused.parquet", "evidence"))
    assert evidence.num_rows == result.n_used
    assert pc.mean(evidence.filter(evidence["is_in_map"])["chi2"]).as_py() < 3.0
    nuisance = read_table(NUISANCE, beside(tmp_path / "fused.parquet", "nuisance"))
    assert nuisance.num_rows == 16
    some = signs["sign_id"][0].as_py()
    rows = explain(tmp_path / "fused.parquet", some)
    assert rows.num_rows == signs["n_detections"][0].as_py()
    with pytest.raises(InputError, match="no detection belongs"):
        explain(tmp_path / "fused.parquet", "f0")


def test_a_car_with_a_gross_fault_is_told_and_spoils_nothing(fleet, tmp_path):
    """Fifteen cars calibrated to 0.5 m and 0.5 degrees; some measure 10 m too far and 5 degrees askew."""
    settings = {
        "range_bias_sigma_m": 0.5,
        "bearing_bias_sigma_deg": 0.5,
        "mixed.faulty.share": 0.1,
        "mixed.faulty.range_bias_m": 10.0,
        "mixed.faulty.bearing_bias_deg": 5.0,
    }
    config = load_config("paper-ideal", {"method": "joint", "tracker": "kalman", **settings})
    simulate(
        fleet.parent / "signs.parquet",
        fleet.parent / "drives.parquet",
        tmp_path / "faulty",
        config=config,
        n_vehicles=15,
        n_replicates=1,
        seed=7,
    )
    out = tmp_path / "fused.parquet"
    result = aggregate(tmp_path / "faulty/detections", out, config=config, passes=tmp_path / "faulty/passes.parquet")
    kinds = read_table(PASSES, tmp_path / "faulty/passes.parquet").select(["pass_id", "sensor_kind"]).to_pylist()
    faulty = {row["pass_id"] for row in kinds if row["sensor_kind"] == "faulty"}
    rows = read_table(NUISANCE, beside(out, "nuisance")).to_pylist()
    assert faulty
    assert {row["pass_id"] for row in rows if row["is_suspect"]} == faulty
    for row in rows:
        assert row["range_bias_m"] == pytest.approx(10.0 if row["pass_id"] in faulty else 0.0, abs=2.0)
        assert row["bearing_bias_deg"] == pytest.approx(5.0 if row["pass_id"] in faulty else 0.0, abs=2.0)
    note = next(line for line in result.summary() if "far from what they declare" in line)
    assert all(name in note for name in faulty)
    assert json.loads(manifest_path(out).read_text())["counts"]["n_suspect_passes"] == len(faulty)
    totals = evaluate(out, tmp_path / "faulty/reference.parquet", tmp_path / "evaluation", config=config).totals
    assert totals[0]["f1"] > 0.98
    assert totals[0]["gospa_m"] < 1.0


@pytest.mark.parametrize("north_deg", [7e-5, 25e-5])  # 7.8 m, where 1.3 m are declared; and 28 m: it finds no other
def test_a_car_that_is_not_where_it_says_is_told_and_draws_no_other_along(fleet, tmp_path, north_deg):
    whole = read_table(DETECTIONS, fleet / "detections")
    pass_id = pc.min(whole["pass_id"]).as_py()
    is_off = pc.equal(whole["pass_id"], pass_id)
    lon, lat = lonlat(whole)
    columns = {name: whole[name] for name in whole.column_names if name not in {"geometry", "bbox"}}
    columns["info_lat"] = pc.add(columns["info_lat"], pc.if_else(is_off, north_deg, 0.0))
    place = (lon, lat + north_deg * is_off.to_numpy())
    tables = {
        "off": build_table(DETECTIONS, columns, geometry=place),
        "without": whole.filter(pc.invert(is_off)),
    }
    totals, rows = {}, {}
    for name, table in tables.items():
        write_table(DETECTIONS, table, tmp_path / f"{name}.parquet")
        out = tmp_path / f"{name}_map.parquet"
        aggregate(tmp_path / f"{name}.parquet", out, config=JOINT, passes=fleet / "passes.parquet")
        rows[name] = read_table(NUISANCE, beside(out, "nuisance")).to_pylist()
        totals[name] = evaluate(out, fleet / "reference.parquet", tmp_path / name, config=JOINT).totals
    assert [row["pass_id"] for row in rows["off"] if row["is_suspect"]] == [pass_id] * 2  # of two runs
    for with_it, without in zip(totals["off"], totals["without"], strict=True):
        assert with_it["f1"] >= without["f1"] - 0.02
        assert with_it["gospa_m"] < without["gospa_m"] + 0.25


def test_a_prior_map_that_is_shifted_is_told(fleet, tmp_path):
    reference = read_table(REFERENCE, fleet / "reference.parquet")
    first = reference.filter(pc.equal(reference["run_id"], reference["run_id"][0]))
    write_table(REFERENCE, first, tmp_path / "scene.parquet")
    stale(tmp_path / "scene.parquet", tmp_path / "old.parquet", Staleness(shift_m=(2.5, 0.0)))
    result = fused(fleet, tmp_path / "fused.parquet", prior=tmp_path / "old.parquet")
    assert sum("the prior map lies +" in line for line in result.summary()) == 2


def test_the_same_bytes_whatever_the_workers_and_the_order_of_rows(fleet, tmp_path):
    fused(fleet, tmp_path / "one.parquet", n_workers=1)
    detections = read_table(DETECTIONS, fleet / "detections")
    write_table(
        DETECTIONS, detections.take(pa.array(range(detections.num_rows - 1, -1, -1))), tmp_path / "turned.parquet"
    )
    aggregate(
        tmp_path / "turned.parquet",
        tmp_path / "two.parquet",
        config=JOINT,
        passes=fleet / "passes.parquet",
        n_workers=2,
    )
    assert (tmp_path / "one.parquet").read_bytes() == (tmp_path / "two.parquet").read_bytes()


def test_tiles_do_not_enter(fleet, tmp_path):
    maps = []
    for zoom in (12, 18):
        config = load_config("paper-ideal", {"method": "joint", "tracker": "kalman", "tile_zoom": zoom})
        aggregate(fleet / "detections", tmp_path / "map.parquet", config=config, passes=fleet / "passes.parquet")
        maps.append((tmp_path / "map.parquet").read_bytes())
    assert maps[0] == maps[1]


def test_one_car_and_a_prior_map(fleet, tmp_path):
    fused(fleet, tmp_path / "fused.parquet", n_vehicles=1, prior=fleet / "reference.parquet")
    totals = evaluate(
        tmp_path / "fused.parquet", fleet / "reference.parquet", tmp_path / "evaluation", config=JOINT
    ).totals
    assert [total["method"] for total in totals] == ["joint-prior"] * 2
    assert min(total["f1"] for total in totals) > 0.95
    assert max(total["gospa_m"] for total in totals) < 0.5
    nuisance = read_table(NUISANCE, beside(tmp_path / "fused.parquet", "nuisance"))
    assert nuisance["pass_id"].to_pylist().count("prior map") == 2


@pytest.mark.parametrize(
    ("options", "given", "message"),
    [
        ({"method": "dbscan"}, {"prior": RAW / "helsinki.osm.pbf"}, "takes no prior map"),
        ({"method": "joint", "correct_bias": True}, {}, "solves the bias"),
        ({"method": "joint", "k": 5}, {}, "takes no K"),
    ],
)
def test_options_that_do_not_go_together(fleet, tmp_path, options, given, message):
    with pytest.raises(ConfigError, match=message):
        aggregate(fleet / "detections", tmp_path / "x.parquet", config=load_config("paper", options), **given)
    assert not list(tmp_path.iterdir())


def test_no_detections_give_an_empty_layer(tmp_path):
    write_table(DETECTIONS, DETECTIONS.arrow(()).empty_table(), tmp_path / "none.parquet")
    result = aggregate(tmp_path / "none.parquet", tmp_path / "fused.parquet", config=JOINT)
    assert result.n_signs == 0
    assert read_table(SIGNS, tmp_path / "fused.parquet").num_rows == 0


@pytest.mark.slow
@pytest.mark.skipif(not BREMEN.exists(), reason="../shared/data is absent")
def test_real_detections_without_passes(tmp_path):
    ingest_detections([BREMEN], tmp_path / "detections", scheme="mapillary")
    result = aggregate(tmp_path / "detections", tmp_path / "fused.parquet", config=JOINT)
    assert result.n_used > 22_000
    signs = read_table(SIGNS, tmp_path / "fused.parquet")
    assert 0.6 * result.n_used < signs.num_rows < 0.9 * result.n_used
    evidence = read_table(EVIDENCE, beside(tmp_path / "fused.parquet", "evidence"))
    assert evidence["sign_class"].equals(evidence["read_class"])  # rows without a pass never merge across classes
    assert pc.max(evidence["residual_e_m"]).as_py() < 15.0
