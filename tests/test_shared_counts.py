"""Counts that `../shared/data/README.md` states and no other test holds, each by the reader that users have."""

from __future__ import annotations

import csv
import json
from collections import Counter

import numpy as np
import osmium
import pytest
from pyproj import Geod

from geofleet.formats import lanelet2, opendrive, osm, rtklib
from geofleet.formats.drives import read_drive
from geofleet.tables.store import lonlat, to_geodataframe

GEOD = Geod(ellps="WGS84")


def length_m(table):
    lon, lat = lonlat(table)
    return float(np.abs(GEOD.line_length(lon, lat)))


def test_helsinki(shared_data):
    path = shared_data / "osm" / "Helsinki.osm.pbf"
    n_nodes, highways, signs = 0, Counter(), []
    for node in osmium.FileProcessor(str(path), osmium.osm.NODE):
        n_nodes += 1
        highways[node.tags.get("highway")] += 1
        if "traffic_sign" in node.tags:
            signs.append({tag.k: tag.v for tag in node.tags})
    assert n_nodes == 24_260
    assert len(signs) == 1_671
    assert (highways["crossing"], highways["traffic_signals"], highways["give_way"]) == (620, 135, 19)
    more = sum(any(key.startswith("traffic_sign:") and key[13:].isdigit() for key in tags) for tags in signs)
    assert more / len(signs) == pytest.approx(0.48, abs=0.01)
    read = set(osm.read_signs(path, roads=False).table["support_id"].to_pylist())
    assert len(read) >= len(signs)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("nagoya/reference_1Hz.pos", (None, 1230, 4.18, 0.45)),
        ("colorado/demo5_b34f_f.pos", (0.98, 4520, 21.25, 0.58)),
        ("colorado/gnss_1934_sf.pos", (0.996, 549, 4.05, None)),
    ],
)
def test_recorded_drives(shared_data, name, expected):
    n_fixed, duration_s, length_km, standing = expected
    path = shared_data / "trajectory" / name
    raw, *_ = rtklib.read_epochs(path)
    layer = read_drive(path)
    assert raw.seconds()[-1] == pytest.approx(duration_s, abs=1)
    assert length_m(layer.table) / 1000 == pytest.approx(length_km, rel=0.01)
    assert n_fixed is None or np.mean(raw.quality == "fixed") == pytest.approx(n_fixed, abs=0.005)
    assert standing is None or layer.found["epochs standing still"] / len(raw.lon) == pytest.approx(standing, abs=0.03)


def test_nagoya_by_rtk(shared_data):
    raw, *_ = rtklib.read_epochs(shared_data / "trajectory" / "nagoya" / "rover_rtk.pos")
    step_s = np.diff(raw.seconds())
    assert Counter(raw.quality.tolist()) == {"fixed": 1_799, "float": 3_596}
    assert (step_s > 0.5).sum() == 13
    assert step_s.max() == pytest.approx(47, abs=0.1)


def test_the_motorway_a9(shared_data):
    path = shared_data / "opendrive" / "a9_nord_excerpt_bssd.xodr"
    signs = opendrive.read_signs(path).table
    codes = Counter(row["raw_code"] for row in signs.to_pylist() if row["kind"] == "main")
    assert (signs.num_rows, codes.total(), codes["276"]) == (38, 20, 8)
    lines = to_geodataframe(opendrive.read_lanes(path).table)
    reference = lines[lines["kind"] == "reference_line"].geometry
    assert len(reference) == 9
    assert sum(GEOD.geometry_length(line) for line in reference) / 1000 == pytest.approx(4.64, abs=0.01)


def test_maps_without_signals(shared_data):
    path = shared_data / "opendrive" / "carla_Town01_partial_georef.xodr"
    assert opendrive.read_signs(path, origin=(49.0, 8.0)).table.num_rows == 0


def test_length_of_the_lanelets_of_karlsruhe(shared_data):
    lanes = to_geodataframe(lanelet2.read_lanes(shared_data / "lanelet2" / "fzi_mapping_example.osm").table)
    drivable = lanes[lanes["kind"].isin(["road", "highway"])]
    assert len(drivable) == 345
    assert sum(GEOD.geometry_length(line) for line in drivable.geometry) > 4_970


def test_a_street_of_hansbeke(shared_data):
    text = (shared_data / "inventory" / "hansbeke_traffic-signs.geojson").read_text(encoding="utf-8")
    streets = Counter(feature["properties"].get("street") for feature in json.loads(text)["features"])
    assert streets["Vaartstraat"] == 36


def test_the_types_of_osi(shared_data):
    with (shared_data / "taxonomy" / "osi_stvo_types.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 290
    assert sum(bool(row["stvo_codes_in_comment"]) for row in rows) == 268
