"""Counts that `../shared/data/README.md` states and no other test holds, each by the reader that users have.

Some of them the files bear out as another thing only: the times of Mapillary in Bremen begin in 2011, not in
2007; its 695 duplicates are signs at one place of whatever class; the 22 `direction` tags of Helsinki are at no sign;
the 219 km of Bayreuth are with its service roads, and the 92 poles of Ingolstadt those of signs among 170.
"""

from __future__ import annotations

import csv
import json
from collections import Counter
from xml.etree import ElementTree as ET

import numpy as np
import osmium
import pytest
from pyproj import Geod

from geofleet.formats import drive_csv, lanelet2, opendrive, osm, rtklib
from geofleet.formats.drives import read_drive
from geofleet.formats.inventory import read_signs as read_inventory
from geofleet.formats.osm_tags import is_drivable
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


def test_what_carries_the_signs_of_ingolstadt(shared_data):
    root = ET.parse(shared_data / "opendrive" / "ingolstadt_cityhall.xodr").getroot()  # noqa: S314  (a file of ours)
    header = root.find("header")
    assert (header.get("revMajor"), header.get("revMinor")) == ("1", "4")
    poles = Counter(one.get("name") for one in root.iter("object") if one.get("type") == "pole")
    assert (poles["trafficSign"], poles.total()) == (92, 170)


def test_speed_limits_of_the_a9(shared_data):
    rows = opendrive.read_signs(shared_data / "opendrive" / "a9_nord_excerpt_bssd.xodr").table.to_pylist()
    limits = Counter(row["sign_class"] for row in rows)
    assert (limits["speed_limit:100"], limits["speed_limit:120"]) == (4, 2)


def test_how_signs_are_drawn_in_karlsruhe(shared_data):
    root = ET.parse(shared_data / "lanelet2" / "fzi_mapping_example.osm").getroot()  # noqa: S314  (a file of ours)
    tags = {one: {tag.get("k"): tag.get("v") for tag in one.iter("tag")} for one in root}
    place = {one.get("id"): (float(one.get("lon")), float(one.get("lat"))) for one in root.iter("node")}
    signs = [way for way in root.iter("way") if tags[way].get("type") == "traffic_sign"]
    assert Counter(tags[way]["subtype"] for way in signs) == {"de301": 5, "de205": 5, "de274_1": 1}
    lines = [[place[nd.get("ref")] for nd in way.iter("nd")] for way in signs]
    assert {len(line) for line in lines} == {2, 3}
    length = [GEOD.line_length(*zip(*line, strict=True)) for line in lines]
    assert (round(min(length), 2), round(max(length), 2)) == (0.13, 0.61)
    assert sum("ele" in tags[node] for node in root.iter("node")) == 4
    rules = [one for one in root.iter("relation") if tags[one].get("type") == "regulatory_element"]
    assert Counter(tags[one]["subtype"] for one in rules) == {"traffic_light": 6, "right_of_way": 2, "speed_limit": 1}
    named = {member.get("ref") for one in rules for member in one.iter("member")}
    assert sum(way.get("id") in named for way in signs if tags[way]["subtype"] != "de274_1") == 4


def test_where_and_how_signs_of_helsinki_are_tagged(shared_data):
    path = shared_data / "osm" / "Helsinki.osm.pbf"
    values, tagged, roads, directions = Counter(), set(), set(), Counter()
    for one in osmium.FileProcessor(str(path)):
        tags = {tag.k: tag.v for tag in one.tags}
        if one.is_node() and "traffic_sign" in tags:
            values[tags["traffic_sign"]] += 1
            tagged.add(one.id)
        if one.is_node() and "direction" in tags:
            directions["traffic_sign" in tags] += 1
        if one.is_way() and is_drivable(tags):
            roads.update(node.ref for node in one.nodes)
    often = {"FI:372": 254, "FI:511": 204, "FI:371": 154, "FI:521": 140, "FI:363[40]": 31, "FI:231": 24}
    assert {value: values[value] for value in often} == often
    assert {"round", "rectangle"} <= set(values)
    assert directions == {False: 22}
    assert not tagged & roads
    lines = to_geodataframe(osm.read_lanes(path).table)
    assert sum(GEOD.geometry_length(line) for line in lines.geometry) / 1000 == pytest.approx(20, abs=1.5)
    signs = to_geodataframe(osm.read_signs(path, roads=False).table)
    signs = signs[signs["support_id"].isin({f"n{number}" for number in tagged})].drop_duplicates("support_id")
    assert len(signs) == 1_671
    lines, signs = (frame.to_crs("EPSG:3879") for frame in (lines, signs))
    apart_m = lines.sindex.nearest(signs.geometry, return_distance=True, return_all=False)[1]
    assert np.median(apart_m) == pytest.approx(6.1, abs=0.4)


def test_other_maps_of_openstreetmap(shared_data):
    folder = shared_data / "osm"
    found = {}
    for name in ("north-bayreuth.osm.gz", "osm2streets_neukolln_input.osm", "bautzen.osm"):
        nodes = osmium.FileProcessor(str(folder / name), osmium.osm.NODE)
        found[name] = Counter(node.tags["traffic_sign"] for node in nodes if "traffic_sign" in node.tags)
    rural, streets, motorway = found.values()
    assert (rural.total(), rural["city_limit"]) == (35, 24)
    assert {"DE:240,DE:1022-11", "DE:262:18"} <= set(rural)
    assert (streets.total(), streets["DE:136-10"], streets["DE:222"]) == (8, 3, 2)
    assert motorway == {"DE:274-130": 1, "DE:274-100": 1, "DE:274-120": 1}
    service_km = 0.0
    for way in osmium.FileProcessor(str(folder / "north-bayreuth.osm.gz")).with_locations():
        if way.is_way() and way.tags.get("highway") == "service":
            service_km += GEOD.line_length(*zip(*((n.lon, n.lat) for n in way.nodes), strict=True)) / 1000
    lines = to_geodataframe(osm.read_lanes(folder / "north-bayreuth.osm.gz").table)
    own_km = sum(GEOD.geometry_length(line) for line in lines.geometry) / 1000
    assert own_km + service_km == pytest.approx(219, abs=2)
    assert [round((folder / f"helsinki_signs_roads.osm{end}").stat().st_size / 1000) for end in (".pbf", ".gz")] == [
        94,
        162,
    ]


def test_the_longest_way_in_a_street_of_hansbeke(shared_data):
    text = (shared_data / "inventory" / "hansbeke_traffic-signs.geojson").read_text(encoding="utf-8")
    features = [one for one in json.loads(text)["features"] if one["properties"]["street"] == "Vaartstraat"]
    lon, lat = np.array([one["geometry"]["coordinates"] for one in features]).T
    every = np.repeat(np.arange(len(lon)), len(lon)), np.tile(np.arange(len(lon)), len(lon))
    apart_m = GEOD.inv(lon[every[0]], lat[every[0]], lon[every[1]], lat[every[1]])[2]
    assert max(apart_m) == pytest.approx(1_160, abs=5)


def test_signs_at_one_place_in_bremen(shared_data):
    signs = read_inventory(shared_data / "mapillary" / "mapillary_traffic-signs_DE-HB.parquet").table
    places = Counter(zip(*(axis.tolist() for axis in lonlat(signs)), strict=True))
    assert sum(count - 1 for count in places.values()) == 695


@pytest.mark.parametrize(
    ("name", "rate_hz", "length_km"),
    [
        ("nagoya/reference.csv", 5, 4.18),
        ("tartu/wp_utm_raadi_to_delta.csv", None, 3.08),
        ("toronto/radar_poses_2021-08-05-13-34.csv", 4, 7.93),
        ("berlin/Berlin_Gendarmenmarkt_GT.txt", 5, 4.89),
        ("berlin/Berlin_Potsdamer_Platz_GT.txt", 5, 1.55),
        ("gsdc/gsdc_2021_Pixel4_ground_truth.csv", 1, None),
    ],
)
def test_recorded_drives_in_columns(shared_data, name, rate_hz, length_km):
    path = shared_data / "trajectory" / name
    drives, *_ = drive_csv.read_epochs(path)
    (epochs,) = drives.values()
    assert rate_hz is None or 1 / np.median(np.diff(epochs.seconds())) == pytest.approx(rate_hz, rel=0.01)
    assert length_km is None or length_m(read_drive(path).table) / 1000 == pytest.approx(length_km, rel=0.01)


def test_how_long_and_how_often_the_reference_of_nagoya_stands(shared_data):
    layer = read_drive(shared_data / "trajectory" / "nagoya" / "reference.csv")
    (epochs,) = drive_csv.read_epochs(shared_data / "trajectory" / "nagoya" / "reference.csv")[0].values()
    assert np.ptp(epochs.seconds()) == pytest.approx(1_230, abs=1)
    assert layer.found["epochs standing still"] / len(epochs.lon) == pytest.approx(0.45, abs=0.01)


@pytest.mark.parametrize(("name", "gap_s"), [("rover_1Hz_spp.pos", 69), ("rover_1Hz_rtk.pos", 56)])
def test_gaps_of_nagoya_once_a_second(shared_data, name, gap_s):
    epochs, *_ = rtklib.read_epochs(shared_data / "trajectory" / "nagoya" / name)
    assert np.diff(epochs.seconds()).max() == gap_s


def test_lists_of_codes(shared_data):
    with (shared_data / "taxonomy" / "taxonomy_seed.csv").open(encoding="utf-8", newline="") as file:
        assert len(list(csv.DictReader(file))) == 25
    assert len(list((shared_data / "taxonomy").glob("taginfoTrafficSignData_??.json"))) == 8
