"""Every packaged scenario on a real map: fleets the paper could not run."""

from __future__ import annotations

import importlib
import itertools
import sys
from collections import Counter
from typing import TYPE_CHECKING

import numpy as np
import pyarrow.compute as pc
import pytest
from scipy import stats

from geofleet.algorithms.trajectory import resample
from geofleet.config import load_config
from geofleet.steps.ingest import ingest_drive
from geofleet.steps.simulate import SimulateResult, simulate
from geofleet.tables.scenes import load_drive, load_drives
from geofleet.tables.schemas import DETECTIONS, DRIVES, PASSES, REFERENCE, SIGNS, TRUTH
from geofleet.tables.store import lonlat, read_table

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture(scope="module")
def script(repo):
    """Return a loader of the scripts by name, which may import each other."""
    sys.path.insert(0, str(repo / "scripts"))
    yield importlib.import_module
    sys.path.remove(str(repo / "scripts"))


@pytest.fixture(scope="module")
def derive(script):
    return script("derive_map_drive").derive


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


@pytest.mark.parametrize(
    ("recorded", "side", "scenario"),
    [("nagoya/reference.csv", "left", "urban"), ("colorado/gnss_1934_sf.pos", "right", "highway")],
)
def test_recorded_drives_with_signs_placed_along_them_say_so(  # noqa: PLR0917 - fixtures and parameters
    shared_data, script, tmp_path, recorded, side, scenario
):
    drive, signs, out = tmp_path / "drive.parquet", tmp_path / "signs.parquet", tmp_path / "out"
    ingest_drive([shared_data / "trajectory" / recorded], drive)
    placing = script("place_signs")
    n = placing.place(drive, signs, per_km=15.0, gap_m=10.0, side=side, like=placing.HELSINKI, seed=0)
    assert n == pytest.approx(15 * 4.1 * 1.2, rel=0.25)
    result = run(scenario, signs, drive, out, 6, speed_profile="recorded", respect_facing=True)
    assert result.n_signs > 0.9 * n
    assert share_right(out) > 0.7
    reference = read_table(REFERENCE, out / "reference.parquet")
    assert all(source.startswith("placed along ") for source in reference["source"].to_pylist())
    assert all(name.startswith("placed-") for name in reference["sign_id"].to_pylist())
    in_view = np.asarray(reference["n_passes_in_view"])
    assert np.mean(in_view == 6) > 0.9  # they face the car that comes; one beside the start is behind it


def test_placed_signs_keep_their_gap_their_side_and_the_shares_of_real_classes(repo, script, tmp_path):
    drive, signs = tmp_path / "drive.parquet", tmp_path / "signs.parquet"
    ingest_drive([repo / "data" / "raw" / "helsinki_derived.pos"], drive)
    placing = script("place_signs")
    along = placing.poles_along(100_000.0, per_km=20.0, gap_m=10.0, rng=np.random.default_rng(0))
    gaps = np.diff(along)
    assert gaps.min() >= 10
    assert stats.kstest(gaps - 10, "expon", (0, 40)).pvalue > 0.001
    with pytest.raises(SystemExit, match="lower --per-km"):
        placing.poles_along(1000.0, per_km=200.0, gap_m=10.0, rng=np.random.default_rng(0))
    classes = placing.real_classes(placing.HELSINKI)
    pole, row = placing.plates_on(4000, classes, np.random.default_rng(1))
    assert (np.diff(pole) >= 0).all()
    name = np.array(classes["sign_class"].to_pylist())
    twins = np.flatnonzero(np.diff(pole) == 0)
    assert (name[row[twins]] != name[row[twins + 1]]).all()
    real, placed = (
        np.unique(values, return_counts=True) for values in (name, name[row[np.unique(pole, return_index=True)[1]]])
    )
    often = real[1] / len(name) * 4000 > 5
    expected = real[1] / len(name) * 4000
    drawn = np.array([dict(zip(*placed, strict=True)).get(key, 0) for key in real[0]])
    counts = np.append(drawn[often], drawn[~often].sum())
    assert stats.chisquare(counts, np.append(expected[often], expected[~often].sum())).pvalue > 0.001
    for side in ("left", "right"):
        placing.place(drive, signs, per_km=20.0, gap_m=10.0, side=side, like=placing.HELSINKI, seed=3)
        layer, driven = read_table(SIGNS, signs), load_drive(read_table(DRIVES, drive), drive)
        xy_m = driven.frame.to_enu(*lonlat(layer))
        way = resample(driven.line, spacing_m=1.0, heading_baseline_m=9.0)
        near = np.argmin(np.hypot(*(xy_m[:, None] - way.xy_m).transpose(2, 0, 1)), axis=1)
        off = xy_m - way.xy_m[near]
        left_m = np.cos(way.heading_rad[near]) * off[:, 1] - np.sin(way.heading_rad[near]) * off[:, 0]
        assert ((left_m if side == "left" else -left_m) > 2).all()
        facing = np.deg2rad(90.0 - layer["facing_deg"].to_numpy())
        assert (np.cos(facing - way.heading_rad[near]) < -0.9).all()


def test_city_drives_cover_the_roads_legally_and_have_their_length(repo, script, tmp_path):
    city = script("derive_city_drives")
    city.derive(repo / "data" / "raw" / "helsinki.osm.pbf", tmp_path / "drives.parquet", n_drives=3, length_m=900.0)
    table = read_table(DRIVES, tmp_path / "drives.parquet")
    assert len(set(table["drive_id"].to_pylist())) == 3
    assert set(table["fix_quality"].to_pylist()) == {"derived"}
    drives = load_drives(table, tmp_path / "drives.parquet")
    for driven in drives:
        assert driven.line.along_m[-1] == pytest.approx(900, rel=0.05)
    roads = city.connected(city.read_graph(repo / "data" / "raw" / "helsinki.osm.pbf"))
    xy_m = {node: np.array([hash(node) % 97, node % 89.0]) for node in roads.nodes}
    driven = Counter()
    nodes = city.walk(roads, xy_m, driven, 3000.0)
    assert all(roads.has_edge(a, b) for a, b in itertools.pairwise(nodes))  # one-way roads only their way
    assert sum(roads.edges[a, b]["length"] for a, b in itertools.pairwise(nodes)) >= 3000
    result = run(
        "urban", repo / "data" / "raw" / "helsinki.osm.pbf", tmp_path / "drives.parquet", tmp_path / "out", drives="all"
    )
    assert result.n_signs > 33
