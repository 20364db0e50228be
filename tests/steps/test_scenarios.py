"""Every packaged scenario on a real map: fleets the paper could not run."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING

import pyarrow.compute as pc
import pytest

from geofleet.config import load_config
from geofleet.steps.ingest import ingest_drive
from geofleet.steps.simulate import SimulateResult, simulate
from geofleet.tables.schemas import DETECTIONS, PASSES, TRUTH
from geofleet.tables.store import read_table

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def derive(repo):
    spec = importlib.util.spec_from_file_location("derive_map_drive", repo / "scripts" / "derive_map_drive.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.derive


def run(scenario: str, signs: Path, drive: Path, out: Path, n_vehicles: int = 12, **overrides) -> SimulateResult:
    return simulate(signs, drive, out, config=load_config(scenario, overrides), n_vehicles=n_vehicles)


def share_right(out: Path) -> float:
    """Return the share of sent tracks that are of a sign and have its class."""
    return pc.mean(read_table(TRUTH, out / "truth")["semantic_correct"]).as_py()


def test_urban_on_the_shipped_helsinki(repo, tmp_path):
    drive = tmp_path / "drive.parquet"
    ingest_drive([repo / "data" / "raw" / "helsinki_derived.pos"], drive)
    result = run("urban", repo / "data" / "raw" / "helsinki.osm.pbf", drive, tmp_path / "out")
    assert (result.n_signs, result.n_passes) == (33, 12)
    assert share_right(tmp_path / "out") > 0.8
    detections = read_table(DETECTIONS, tmp_path / "out" / "detections")
    assert detections["info_matrix"].null_count == 0


def test_mixed_on_the_shipped_helsinki(repo, tmp_path):
    drive = tmp_path / "drive.parquet"
    ingest_drive([repo / "data" / "raw" / "helsinki_derived.pos"], drive)
    run("mixed", repo / "data" / "raw" / "helsinki.osm.pbf", drive, tmp_path / "out", 40)
    passes = read_table(PASSES, tmp_path / "out" / "passes.parquet")
    kinds = dict(zip(*(passes[name].to_pylist() for name in ("sensor_kind", "range_m")), strict=True))
    assert kinds == {"camera": 100.0, "high_end": 100.0, "telephone": 60.0}
    count = passes["sensor_kind"].to_pylist().count
    assert (2 <= count("high_end") <= 15, 4 <= count("telephone") <= 20) == (True, True)


@pytest.mark.parametrize(
    ("scenario", "map_file", "street", "least_signs", "length_m"),
    [
        ("urban", "opendrive/ingolstadt_cityhall.xodr", None, 10, (400, 1500)),
        ("highway", "opendrive/a9_nord_excerpt_bssd.xodr", None, 8, (800, 5000)),
        ("rural", "inventory/hansbeke_traffic-signs.geojson", "Vaartstraat", 8, (1100, 1500)),
    ],
)
def test_scenarios_on_real_maps(  # noqa: PLR0917 - fixtures and parameters
    shared_data, derive, tmp_path, scenario, map_file, street, least_signs, length_m
):
    derive(shared_data / map_file, tmp_path / "drive.parquet", street)
    result = run(scenario, shared_data / map_file, tmp_path / "drive.parquet", tmp_path / "out")
    assert result.n_signs >= least_signs
    assert length_m[0] < result.drive_length_m < length_m[1]
    assert result.n_detections > 12
    assert share_right(tmp_path / "out") > 0.7


def test_a_recorded_drive_over_its_lanelet2_map(shared_data, tmp_path):
    """The five signs of this map are stop signs: one class, which cannot be confused."""
    drive = tmp_path / "drive.parquet"
    places = shared_data / "trajectory" / "tartu" / "wp_utm_raadi_to_delta.csv"
    ingest_drive([places], drive)
    signs = shared_data / "lanelet2" / "roosi.osm"
    result = run("urban", signs, drive, tmp_path / "out", semantic_rate=1.0, billboards_per_km=0.0)
    assert result.n_classes == 1
    assert result.n_detections > 0
