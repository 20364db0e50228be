from __future__ import annotations

import bz2
import gzip
import random
from collections import Counter

import numpy as np
import osmium
import pytest

from geofleet.errors import InputError
from geofleet.formats.osm import read_lanes, read_signs
from geofleet.tables.store import lonlat

HEAD = '<?xml version="1.0" encoding="UTF-8"?><osm version="0.6">'


def xml(tmp_path, body, name="map.osm"):
    path = tmp_path / name
    path.write_text(f"{HEAD}{body}</osm>", encoding="utf-8")
    return path


def node(number, lon, lat, **tags):
    inside = "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())
    return f'<node id="{number}" lon="{lon}" lat="{lat}">{inside}</node>'


def way(number, refs, **tags):
    inside = "".join(f'<nd ref="{ref}"/>' for ref in refs) + "".join(f'<tag k="{k}" v="{v}"/>' for k, v in tags.items())
    return f'<way id="{number}">{inside}</way>'


@pytest.fixture(scope="module")
def helsinki(repo):
    return repo / "data" / "raw" / "helsinki.osm.pbf"


def test_helsinki_s_signs(helsinki):
    layer = read_signs(helsinki)
    kinds = Counter(layer.table["kind"].to_pylist())
    assert kinds == {"main": 2163, "plate": 1169, "light": 135, "other": 22}
    assert layer.found["unknown codes"] == 2
    assert layer.found["way nodes beyond the edge of the file"] == 109
    assert layer.skipped == {"highway=stop, give_way within 25 m of the sign itself": 19}
    codes = Counter(layer.table["raw_code"].to_pylist())
    assert codes["FI:372"] >= 254
    assert codes["FI:363[40]"] >= 31
    parents = set(layer.table["parent_id"].to_pylist()) - {None}
    mains = {
        i
        for i, k in zip(layer.table["sign_id"].to_pylist(), layer.table["kind"].to_pylist(), strict=True)
        if k != "plate"
    }
    assert parents <= mains


def test_one_node_in_full(helsinki):
    rows = [r for r in read_signs(helsinki).table.to_pylist() if r["support_id"] == "n2282947488"]
    assert [(r["sign_id"], r["kind"], r["parent_id"], r["raw_code"]) for r in rows][:2] == [
        ("n2282947488-0", "main", None, rows[0]["raw_code"]),
        ("n2282947488-1", "plate", "n2282947488-0", rows[1]["raw_code"]),
    ]
    assert {r["source"] for r in rows} == {"helsinki.osm.pbf"}
    assert {r["source_ref"] for r in rows} == {"node/2282947488"}
    assert {r["country"] for r in rows} == {"FI"}
    assert rows[0]["road_id"].startswith("w")


def test_positions_are_those_that_osmium_reads(helsinki):
    place = {f"n{n.id}": (n.location.lon, n.location.lat) for n in osmium.FileProcessor(helsinki, osmium.osm.NODE)}
    table = read_signs(helsinki, roads=False).table
    lon, lat = lonlat(table)
    expected = np.array([place[support] for support in table["support_id"].to_pylist()])
    np.testing.assert_array_equal(np.column_stack((lon, lat)), expected)


def test_without_roads_nothing_is_inferred(helsinki):
    layer = read_signs(helsinki, roads=False)
    assert layer.table["road_id"].null_count == layer.table.num_rows
    assert layer.table.num_rows - layer.table["facing_deg"].null_count == layer.found["facings in the tags"] == 3


def test_pbf_gzip_and_whole_extract_give_the_same_signs(helsinki, shared_data, tmp_path):
    cut = read_signs(helsinki, roads=False).table.drop_columns(["source"])
    packed = read_signs(shared_data / "osm" / "helsinki_signs_roads.osm.gz", roads=False).table.drop_columns(["source"])
    whole = read_signs(shared_data / "osm" / "Helsinki.osm.pbf").table.drop_columns(["source"])
    assert packed.equals(cut)
    assert whole.equals(read_signs(helsinki).table.drop_columns(["source"]))
    renamed = tmp_path / "map.dat"
    renamed.write_bytes(
        bz2.compress(gzip.decompress((shared_data / "osm" / "helsinki_signs_roads.osm.gz").read_bytes()))
    )
    assert read_signs(renamed, roads=False).table.drop_columns(["source"]).equals(cut)


@pytest.mark.parametrize(
    ("name", "classes"),
    [
        ("bautzen.osm", {"speed_limit:130": 1, "speed_limit:100": 1, "speed_limit:120": 1}),
        ("north-bayreuth.osm.gz", {"built_up_area": 24, "shared_path": 3, "traffic_light": 5}),
        ("osm2streets_neukolln_input.osm", {"children": 3, "keep_right": 2}),
    ],
)
def test_real_files_of_other_places(shared_data, name, classes):
    counts = Counter(read_signs(shared_data / "osm" / name).table["sign_class"].to_pylist())
    assert {key: counts[key] for key in classes} == classes


def crossroads(tmp_path, signs, **tags):
    """Return facing and road of signs beside a road that runs north through (10, 50); id to (lon, lat, tags)."""
    nodes = node(1, 10.0, 49.999) + node(2, 10.0, 50.001)
    nodes += "".join(node(number, lon, lat, **own) for number, (lon, lat, own) in signs.items())
    body = nodes + way(7, [1, 2], **({"highway": "residential"} | tags))
    rows = read_signs(xml(tmp_path, body)).table.to_pylist()
    return {int(r["support_id"][1:]): (r["facing_deg"], r["road_id"]) for r in rows}


def test_a_sign_faces_the_traffic_of_its_side_of_the_road(tmp_path):
    stop = {"traffic_sign": "DE:206"}
    found = crossroads(
        tmp_path,
        {
            11: (10.0001, 50.0, stop),  # east of the road: for those who drive north, so it looks south
            12: (9.9999, 50.0, stop),
            13: (10.01, 50.0, stop),  # 700 m off
            14: (10.0001, 50.0, {"traffic_sign": "GB:601.1"}),  # on the right where one drives on the left
            15: (10.0001, 50.0, stop | {"direction": "N"}),
            16: (10.0001, 50.0, {"traffic_sign:backward": "DE:206"}),
        },
    )
    assert found[11] == (pytest.approx(180.0, abs=0.01), "w7")
    assert found[12][0] == pytest.approx(0.0, abs=0.01) or found[12][0] == pytest.approx(360.0, abs=0.01)
    assert found[13] == (None, None)
    assert np.cos(np.radians(found[14][0])) == pytest.approx(1.0)
    assert found[15] == (0.0, "w7")
    assert np.cos(np.radians(found[16][0])) == pytest.approx(1.0)


@pytest.mark.parametrize(("oneway", "cosine"), [("yes", -1.0), ("-1", 1.0)])
def test_on_a_one_way_road_both_sides_face_its_traffic(tmp_path, oneway, cosine):
    signs = {11: (10.0001, 50.0, {"traffic_sign": "DE:206"}), 12: (9.9999, 50.0, {"traffic_sign": "DE:206"})}
    for facing, _ in crossroads(tmp_path, signs, oneway=oneway).values():
        assert np.cos(np.radians(facing)) == pytest.approx(cosine)


def test_the_nearest_road_is_found_far_from_the_first(tmp_path):
    body = "".join(node(i, 10.0 + i, 50.0) + node(100 + i, 10.0 + i, 50.001) for i in range(1, 6))
    body += "".join(node(200 + i, 10.0001 + i, 50.0005, traffic_sign="DE:206") for i in range(1, 6))
    body += "".join(way(i, [i, 100 + i], highway="primary") for i in range(1, 6))
    rows = read_signs(xml(tmp_path, body)).table.to_pylist()
    assert [r["road_id"] for r in rows] == ["w1", "w2", "w3", "w4", "w5"]
    assert [r["facing_deg"] for r in rows] == pytest.approx([180.0] * 5, abs=0.01)


def test_roads_become_lanes_in_pieces_where_nodes_are_missing(tmp_path):
    body = "".join(node(i, 10.0 + i * 1e-3, 50.0) for i in (1, 2, 4, 5))
    body += way(7, [1, 2, 3, 4, 5], highway="primary", maxspeed="30 mph") + way(8, [1, 2], highway="footway")
    layer = read_lanes(xml(tmp_path, body))
    rows = layer.table.to_pylist()
    assert [(r["lane_id"], r["road_id"], r["kind"]) for r in rows] == [
        ("w7", "w7", "primary"),
        ("w7-1", "w7", "primary"),
    ]
    assert rows[0]["speed_limit_kmh"] == pytest.approx(48.28032)
    assert layer.found == {"way nodes beyond the edge of the file": 1}


def test_a_map_without_signs_gives_an_empty_layer(tmp_path):
    path = xml(tmp_path, node(1, 10.0, 50.0, amenity="bench"))
    assert read_signs(path).table.num_rows == 0
    assert read_lanes(path).table.num_rows == 0


def test_ways_tagged_with_signs_are_counted_and_no_signs(tmp_path):
    corners = [node(n, 11.5 + n * 1e-3, 48.1) for n in (1, 2, 3)]
    ways = [
        way(1, (1, 2), highway="residential", traffic_sign="DE:274.1"),
        way(2, (2, 3), highway="footway", **{"traffic_sign:forward": "DE:239", "traffic_sign": "DE:239"}),
        way(3, (1, 3), landuse="grass", traffic_sign="city_limit"),
        way(4, (1, 3), highway="residential", traffic_signals="no", **{"traffic_sign:note": "none"}),
    ]
    layer = read_signs(xml(tmp_path, "".join(corners + ways)))
    assert layer.table.num_rows == 0
    assert layer.skipped == {"ways tagged with signs, which say what holds there and not where a sign stands": 3}


def test_ids_may_be_negative_or_long_and_positions_missing(tmp_path):
    body = node(-12, 10.0, 50.0, traffic_sign="DE:206") + node(9_000_000_000_000_000_000, 10.0, 50.0, highway="stop")
    body += '<node id="3"><tag k="traffic_sign" v="DE:206"/></node>'
    layer = read_signs(xml(tmp_path, body), roads=False)
    assert layer.table["sign_id"].to_pylist() == ["n-12-0"]
    assert layer.skipped["nodes without a valid position"] == 1
    assert sum(layer.skipped.values()) == 2


BOMB = '<?xml version="1.0"?><!DOCTYPE osm [<!ENTITY a "aa"><!ENTITY b "&a;&a;">]><osm version="0.6">' + node(
    1, 1, 1, traffic_sign="&b;"
)
EXTERNAL = '<?xml version="1.0"?><!DOCTYPE osm [<!ENTITY x SYSTEM "file:///etc/hostname">]><osm version="0.6">' + node(
    1, 1, 1, traffic_sign="&x;"
)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"\x00" * 100, "not an OpenStreetMap file"),
        (b"<html><body>osm</body></html>", "not an OpenStreetMap file"),
        (f"{HEAD}</osm>".encode(), "holds no nodes"),
        (HEAD.encode() + node(1, 10, 50).encode(), "damaged"),
        (f"{HEAD}{node(1, 500, 95, traffic_sign='x')}</osm>".encode(), "damaged"),
        (f"{HEAD}{node(1, 'ten', 50, traffic_sign='x')}</osm>".encode(), "damaged"),
        (f"{BOMB}</osm>".encode(), "entities are not supported"),
        (f"{EXTERNAL}</osm>".encode(), "entities are not supported"),
        (gzip.compress(b"hello", mtime=0), "damaged"),
    ],
)
def test_a_file_that_is_no_map_is_refused_with_its_name(tmp_path, content, message):
    path = tmp_path / "map.osm"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_signs(path)
    assert str(path) in str(caught.value)
    assert caught.value.todo


def test_a_missing_file_and_a_folder_are_refused(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_signs(tmp_path / "none.osm")
    with pytest.raises(InputError, match="a folder, not a file"):
        read_lanes(tmp_path)


def test_a_lanelet2_map_is_told_apart(shared_data):
    for name in ("fzi_mapping_example.osm", "roosi.osm"):
        with pytest.raises(InputError, match="Lanelet2"):
            read_signs(shared_data / "lanelet2" / name)


@pytest.mark.parametrize("seed", range(40))
def test_damage_gives_an_input_error_or_a_layer(helsinki, tmp_path, seed):
    draw = random.Random(seed)  # noqa: S311 - not a secret
    content = bytearray(helsinki.read_bytes())
    if seed % 3 == 0:
        path = tmp_path / "whole.osm"
        with osmium.SimpleWriter(path) as writer:
            for item in osmium.FileProcessor(helsinki, osmium.osm.NODE):
                if "traffic_sign" in item.tags and item.id % 9 == 0:
                    writer.add(item)
        content = bytearray(path.read_bytes())
    if seed % 2:
        del content[draw.randrange(1, len(content)) :]
    else:
        for _ in range(draw.randint(1, 8)):
            content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    damaged = tmp_path / "damaged.osm"
    damaged.write_bytes(content)
    try:
        assert read_signs(damaged).table.num_rows >= 0
    except InputError as error:
        assert str(damaged) in str(error)  # noqa: PT017 - either outcome is right


@pytest.mark.parametrize(
    ("lon", "lat", "told"),
    [(10.0, 50.0, []), (17.4, 54.5, ["outside of DE; is the CRS right?"])],
)
def test_signs_outside_of_their_country_are_told(tmp_path, lon, lat, told):
    body = "".join(node(i, lon, lat + i * 1e-4, traffic_sign="DE:206") for i in range(1, 8))
    layer = read_signs(xml(tmp_path, body))
    assert layer.table.num_rows == 7
    assert [n.removeprefix("SUSPICIOUS: ") for n in layer.found if n.startswith("SUSPICIOUS: ")] == told


@pytest.mark.parametrize(("lon", "lat", "message"), [(0.2, 0.1, "Gulf of Guinea"), (50.0, 10.0, "axes swapped")])
def test_a_map_in_the_wrong_place_is_refused(tmp_path, lon, lat, message):
    body = "".join(node(i, lon, lat + i * 1e-4, traffic_sign="DE:206") for i in range(1, 8))
    with pytest.raises(InputError, match=message):
        read_signs(xml(tmp_path, body)).table.num_rows  # noqa: B018 - rows are read when asked for


def test_what_an_editor_has_deleted_is_not_there(tmp_path):
    body = node(1, 10.0, 50.0, traffic_sign="DE:205").replace("<node ", '<node action="delete" ')
    body += node(-2, 10.1, 50.0, traffic_sign="DE:206").replace("<node ", '<node action="modify" ')
    assert read_signs(xml(tmp_path, body)).table["support_id"].to_pylist() == ["n-2"]


def test_utf_16_is_read_like_utf_8(tmp_path):
    path = tmp_path / "map.osm"
    text = HEAD.replace("UTF-8", "UTF-16") + node(1, 10.0, 50.0, traffic_sign="DE:205") + "</osm>"
    path.write_bytes(text.encode("utf-16"))
    assert read_signs(path).table["sign_class"].to_pylist() == ["yield"]


@pytest.mark.parametrize("key", ["road_marking", "road_marking:forward"])
def test_a_sign_painted_on_the_road_is_a_marking(tmp_path, key):
    body = (
        f'<node id="1" lat="50" lon="10"><tag k="{key}" v="traffic_sign"/><tag k="traffic_sign" v="DE:274[30]"/></node>'
    )
    assert read_signs(xml(tmp_path, body)).table.select(["kind", "sign_class"]).to_pylist() == [
        {"kind": "marking", "sign_class": "speed_limit:30"}
    ]
    other = body.replace('v="traffic_sign"/><tag', 'v="through"/><tag')
    assert read_signs(xml(tmp_path, other, "b.osm")).table["kind"].to_pylist() == ["main"]
