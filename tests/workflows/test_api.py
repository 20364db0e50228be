from __future__ import annotations

from pathlib import Path

import geopandas
import pytest
import shapely

import geofleet as gf
from geofleet.errors import ConfigError, InputError

RAW = Path(__file__).parents[2] / "data" / "raw"


@pytest.fixture(scope="module")
def signs():
    return gf.read_signs(RAW / "helsinki.osm.pbf")


@pytest.fixture(scope="module")
def drive():
    return gf.read_drive(RAW / "helsinki_derived.pos")


@pytest.fixture(scope="module")
def run(signs, drive):
    return gf.simulate(signs, drive, scenario="paper", n_vehicles=20, seed=3)


def test_the_way_of_the_readme(run):
    fused = gf.aggregate(run.detections)
    score = gf.score_map(fused, run.reference)
    assert score.tp + score.fn == len(run.reference) == 33
    assert score.f1 > 0.7
    assert 0 < score.gospa_m < 2
    assert score.gospa_m**2 == pytest.approx(score.mse_m2 + 2 * (score.fn + score.fp) / score.tp)


def test_a_smaller_fleet_is_the_first_vehicles_of_a_larger_one(signs, drive, run):
    few = gf.simulate(signs, drive, scenario="paper", n_vehicles=5, seed=3)
    first = run.detections[run.detections["vehicle_id"].isin(set(few.detections["vehicle_id"]))]
    assert few.detections.equals(first.reset_index(drop=True))


def test_overrides_reach_the_step(signs, drive):
    ideal = gf.simulate(signs, drive, n_vehicles=3, seed=3, tracker="ideal", ghost_rate_per_ha=0.0)
    assert not ideal.truth["is_ghost"].any()
    assert not ideal.truth.duplicated(["run_id", "pass_id", "ref_sign_id"]).any()


def test_maps_in_any_crs_score_the_same(run):
    fused = gf.aggregate(run.detections)
    projected = gf.score_map(fused.to_crs(3879), run.reference.to_crs(3857))
    assert projected.gospa_m == pytest.approx(gf.score_map(fused, run.reference).gospa_m, abs=1e-6)


def test_faults_are_named(signs, drive):
    with pytest.raises(ConfigError, match="unknown scenario key 'colour'"):
        gf.simulate(signs, drive, colour=1)
    with pytest.raises(InputError, match="no such file"):
        gf.read_signs("absent.osm")
    nowhere = geopandas.GeoDataFrame({"a": [1]}, geometry=shapely.points([[0.0, 0.0]]), crs=4326)
    with pytest.raises(InputError, match="missing column"):
        gf.score_map(nowhere, nowhere)


def test_the_package_has_no_other_names():
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = gf.nothing


def test_detections_that_cannot_be_used_are_told():
    names = ["a", "b", "c", "d", "e", "f"]
    table = geopandas.GeoDataFrame(
        {"run_id": "r", "vehicle_id": names, "pass_id": names, "track_id": 1, "sign_class": ["odd"] * 4 + ["", "odd"]},
        geometry=shapely.points([24.9] * 3 + [float("nan"), 24.9, 25.9], [60.2] * 6),
        crs=4326,
    )
    with pytest.warns(UserWarning, match=r"2 of 6 detections are left out: 1 class missing, 1 position not finite\."):
        fused = gf.aggregate(table)
    assert fused["n_passes"].tolist() == [3]
    assert fused.attrs == {
        "skipped": {"class missing": 1, "position not finite": 1},
        "unknown_classes": {"odd": 4},
    }
    with pytest.warns(UserWarning, match="1 outside the area"):
        assert gf.aggregate(table, area=(24.0, 60.0, 25.0, 61.0)).attrs["unknown_classes"] == {"odd": 3}
