"""The shipped inputs: registered, unchanged, made by the scripts in the repository, and what they claim to be."""

from __future__ import annotations

import csv
import hashlib
import runpy
from collections import Counter

import numpy as np
import osmium
import pytest
import shapely

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.config import load_config
from geofleet.formats.drives import read_drive
from geofleet.formats.osm import read_signs
from geofleet.tables.store import lonlat
from geofleet.taxonomy import load_taxonomy


@pytest.fixture(scope="module")
def raw(repo):
    return repo / "data" / "raw"


@pytest.fixture(scope="module")
def core(raw):
    """Node, class and position of every sign of the paper's groups."""
    table = read_signs(raw / "helsinki.osm.pbf").table
    groups = load_taxonomy().group_of(table["concept"].to_pylist())
    keep = np.isin(groups, load_config("paper").scene.groups) & (np.array(table["kind"].to_pylist()) == "main")
    table = table.filter(keep)
    lon, lat = lonlat(table)
    return table["support_id"].to_pylist(), table["sign_class"].to_pylist(), lon, lat


def test_every_file_is_registered_with_its_digest(raw):
    with (raw / "SOURCES.csv").open(encoding="utf-8", newline="") as file:
        rows = {row["file"]: row for row in csv.DictReader(file)}
    files = {path.name for path in raw.iterdir()} - {"SOURCES.csv"}
    assert set(rows) == files
    for name, row in rows.items():
        assert hashlib.sha256((raw / name).read_bytes()).hexdigest() == row["sha256"], name
        assert row["licence"]
        assert row["how"]
    assert all(
        "OpenStreetMap contributors" in row["attribution"] for row in rows.values() if row["licence"] == "ODbL-1.0"
    )
    assert "OpenStreetMap contributors" in (raw / "NOTICE.md").read_text(encoding="utf-8")


def test_the_cut_comes_out_of_the_script_again(raw, repo, shared_data, tmp_path):
    script = runpy.run_path(str(repo / "scripts" / "cut_helsinki.py"))
    script["cut"](shared_data / "osm" / "Helsinki.osm.pbf", tmp_path / "cut.osm.pbf")
    assert (tmp_path / "cut.osm.pbf").read_bytes() == (raw / "helsinki.osm.pbf").read_bytes()


def test_the_cut_refuses_another_file(repo, raw, tmp_path):
    script = runpy.run_path(str(repo / "scripts" / "cut_helsinki.py"))
    with pytest.raises(SystemExit, match="SHA-256"):
        script["cut"](raw / "helsinki.osm.pbf", tmp_path / "cut.osm.pbf")


def test_the_cut_holds_every_sign_node_and_nobody_s_name(raw):
    counts = Counter()
    for item in osmium.FileProcessor(raw / "helsinki.osm.pbf"):
        counts["signs"] += item.is_node() and "traffic_sign" in item.tags
        counts[item.tags["highway"] if item.is_node() and "highway" in item.tags else "other"] += 1
        counts["ways"] += item.is_way()
        assert not item.user
    assert {name: counts[name] for name in ("signs", "ways", "crossing", "traffic_signals", "give_way")} == {
        "signs": 1671,
        "ways": 913,
        "crossing": 620,
        "traffic_signals": 135,
        "give_way": 19,
    }


@pytest.mark.slow  # osmnx
def test_the_drives_come_out_of_the_script_again(raw, repo, tmp_path):
    runpy.run_path(str(repo / "scripts" / "derive_drive.py"))["derive"](tmp_path)
    for name in ("helsinki_derived.pos", "helsinki_derived_b.pos"):
        assert (tmp_path / name).read_bytes() == (raw / name).read_bytes()


def test_the_core_signs_are_those_counted_before(core):
    nodes, classes, _, _ = core
    assert len(nodes) == 894
    assert len(set(nodes)) == 722
    assert len(set(zip(nodes, classes, strict=True))) == 874


@pytest.mark.parametrize(("name", "n_classes"), [("helsinki_derived", 14), ("helsinki_derived_b", 17)])
def test_a_drive_is_derived_and_passes_33_signs(raw, core, name, n_classes):
    nodes, classes, lon, lat = core
    drive = read_drive(raw / f"{name}.pos").table
    assert set(drive["fix_quality"].to_pylist()) == {"derived"}
    assert "derived" in (raw / f"{name}.pos").read_text().splitlines()[0]
    assert np.ptp(drive["t_utc"].to_numpy()) / np.timedelta64(1, "s") == pytest.approx((len(drive) - 1) / 10)
    frame = EnuFrame.around(*lonlat(drive))
    line = shapely.LineString(frame.to_enu(*lonlat(drive)))
    assert 1100 < line.length < 1300
    near = np.flatnonzero(shapely.dwithin(line, shapely.points(frame.to_enu(lon, lat)), 15.0))
    passed = {(nodes[i], classes[i]) for i in near}
    assert len(passed) == 33
    assert len({sign_class for _, sign_class in passed}) == n_classes
    speed = np.array(drive["speed_mps"].to_pylist())
    assert 1.0 < speed.min() <= speed.max() < 10.1


def test_data_from_outside_that_the_package_carries_is_registered(repo, raw):
    folder = repo / "geofleet" / "formats"
    with (folder / "SOURCES.csv").open(encoding="utf-8", newline="") as file:
        reader = csv.DictReader(file)
        entries = list(reader)
    with (raw / "SOURCES.csv").open(encoding="utf-8", newline="") as file:
        assert reader.fieldnames == csv.DictReader(file).fieldnames
    ours = {"SOURCES.csv", "drive_profiles.toml"}  # written for geofleet
    carried = {path.name for path in folder.iterdir() if path.is_file() and path.suffix not in {".py", ".pyi"}}
    assert {entry["file"] for entry in entries} == carried - ours
    for entry in entries:
        assert hashlib.sha256((folder / entry["file"]).read_bytes()).hexdigest() == entry["sha256"]
        assert entry["licence"].startswith("Public domain")
        assert (repo / entry["how"].split(";")[0]).is_file()
