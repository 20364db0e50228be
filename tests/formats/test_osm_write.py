"""OpenStreetMap XML and osmChange: valid to libosmium, and true in OpenStreetMap's own grammar."""

from __future__ import annotations

from collections import Counter

import osmium
import pyarrow as pa
import pytest
from shapely import LineString

from geofleet.errors import InputError
from geofleet.formats.layers import read_layer, recognise
from geofleet.formats.osm_nodes import sign_nodes
from geofleet.formats.osm_tags import node_signs
from geofleet.formats.osm_value import sign_value
from geofleet.formats.osm_write import write_osc, write_osm
from geofleet.tables.schemas import LANES, SIGNS
from geofleet.tables.store import build_table, lonlat
from geofleet.taxonomy import load_taxonomy
from geofleet.taxonomy.codes import codes_of, example

COUNTRIES = [None, "BE", "DE", "FI", "FR", "SE", "US"]


@pytest.mark.parametrize("country", COUNTRIES)
@pytest.mark.parametrize("raw_code", ["", "object--no-code", "A1", "17"])
def test_every_concept_can_be_said_in_the_grammar(country, raw_code):
    for concept in load_taxonomy().concepts.values():
        for value in (None, 7.5, 30.0) if concept.unit else (None,):
            wanted = concept.name if value is None else f"{concept.name}:{value:g}"
            said = sign_value(sign_class=wanted, raw_code=raw_code, country=country, value=value)
            (sign,) = node_signs({"traffic_sign": said})
            assert sign.meaning.sign_class == wanted, said


@pytest.mark.parametrize(
    ("said", "sign"),
    [
        ("DE:274.1[30]", ("speed_zone:30", "274.1[30]", "DE", 30.0)),
        ("DE:205", ("yield", "de205", "DE", None)),
        ("FI:231", ("yield", "regulatory--yield--g1", "FI", None)),
        ("stop", ("stop", "stop", "DE", None)),
        ("SE:X9", ("raw:X9", "X9", "SE", None)),
        ("maxspeed[30mph]", ("speed_limit:30mph", "", None, 30.0)),
        ("unknown", ("raw:a;b", "a;b", "DE", None)),
        ("unknown", ("raw:", "", None, None)),
    ],
)
def test_a_code_keeps_its_country_and_else_the_concept_is_said(said, sign):
    sign_class, raw_code, country, value = sign
    assert sign_value(sign_class=sign_class, raw_code=raw_code, country=country, value=value) == said


@pytest.mark.parametrize(
    ("pattern", "text"),
    [
        ("103(-[1-9]\\d)?", "103"),
        ("A\\.1[12]|B", "A.11"),
        ("(?:a|b)+c*d", "ad"),
        ("give_?\\s?way", "giveway"),
        ("(regulatory|information)--speed-{n}", "regulatory--speed-{n}"),
        ("411\\[.*left.*\\]", "411[left]"),
    ],
)
def test_the_example_of_a_pattern_is_the_shortest(pattern, text):
    assert example(pattern) == text


def test_codes_of_the_country_come_first():
    assert codes_of("stop", country="DE")[0] == "DE:206"
    assert codes_of("yield", country="FR")[0].startswith("FR:")
    assert codes_of("no such concept") == ()


def test_signs_of_one_node_are_one_node_again_and_others_are_new(make_signs):
    signs = make_signs(
        [(0, 0), (0, 0), (5, 0), (0, 0)],
        ["stop", "yield", "no_entry", "parking"],
        source_ref=["node/123", "node/123", "signal/4", "way/5"],
        facing_deg=[90.0, None, 12.5, None],
    )
    new, other, known = sign_nodes(signs)
    assert (new.node_id, other.node_id, known.node_id) == (-1, -2, 123)
    assert known.tags["traffic_sign:direction"] == "90"
    assert "direction" not in known.tags
    assert new.tags["direction"] == "12.5"
    assert [sign.meaning.sign_class for sign in node_signs(known.tags)] == ["stop", "yield"]
    assert [sign.facing_deg for sign in node_signs(known.tags)] == [90.0, None]


def test_a_plate_stands_behind_its_main_sign(make_signs):
    signs = make_signs(
        [(0, 0), (0, 0)],
        ["stop", "plate_distance:100"],
        concept=["stop", "plate_distance"],
        kind=["main", "plate"],
        value=[None, 100.0],
        parent_id=[None, "s0"],
        country="DE",
        raw_code=["206", "1004"],
        source_ref="node/1",
    )
    (node,) = sign_nodes(signs)
    assert node.tags["traffic_sign"] == "DE:206,DE:1004[100]"


def test_one_node_at_two_places_is_two(make_signs):
    nodes = sign_nodes(make_signs([(0, 0), (9, 0)], ["stop", "stop"], source_ref="node/-4"))
    assert sorted(node.node_id for node in nodes) == [-5, -4]


@pytest.mark.parametrize(("write", "suffix"), [(write_osm, ".osm"), (write_osc, ".osc")])
def test_libosmium_reads_what_is_written(write, suffix, make_signs, tmp_path):
    signs = make_signs(
        [(0, 0), (30.25, -7), (0, 1)],
        ["stop", "yield", "raw:<&\"'>\n"],
        source_ref=["node/123", "signal/4", "x"],
        raw_code=["DE:206", "DE:205", "<&\"'>\n"],
    )
    path = tmp_path / f"signs{suffix}"
    write(SIGNS, signs, path)
    found = {node.id: (node.location.lon, node.location.lat, dict(node.tags)) for node in osmium.FileProcessor(path)}
    assert sorted(found) == [-2, -1, 123]
    lon, lat = lonlat(signs)
    for number, row in ((123, 0), (-1, 1), (-2, 2)):
        assert found[number][0] == pytest.approx(lon[row], abs=6e-8)  # libosmium counts in 1e-7 degrees
        assert found[number][1] == pytest.approx(lat[row], abs=6e-8)
    assert found[123][2]["traffic_sign"] == "DE:206"
    assert found[-1][2]["traffic_sign"] == "DE:205"
    assert found[-2][2]["geofleet:raw_code"] == "<&\"'>\n"


def test_a_change_creates_what_is_new_and_modifies_what_is_known(make_signs, tmp_path):
    write_osc(SIGNS, make_signs([(0, 0), (9, 0)], ["stop", "stop"], source_ref=["node/5", "s"]), tmp_path / "a.osc")
    text = (tmp_path / "a.osc").read_text()
    assert text.index("<create>") < text.index('id="-1"') < text.index("<modify>") < text.index('id="5" version="1"')


def test_roads_that_meet_share_a_node(tmp_path):
    columns = {"lane_id": ["w7", "r-1"], "road_id": ["w7", "r"], "kind": ["residential", "driving"], "source": "x"}
    columns["speed_limit_kmh"] = pa.array([30.0, None])
    lines = [LineString([(24.9, 60.1), (24.91, 60.1)]), LineString([(24.91, 60.1), (24.92, 60.11)])]
    write_osm(LANES, build_table(LANES, columns, lines), tmp_path / "roads.osm")
    ways = (o for o in osmium.FileProcessor(tmp_path / "roads.osm") if o.is_way())
    found = {way.id: ([node.ref for node in way.nodes], dict(way.tags)) for way in ways}
    assert sorted(found) == [-1, 7]
    assert found[7][0][-1] in found[-1][0]
    assert found[7][1]["maxspeed"] == "30"
    again = read_layer(tmp_path / "roads.osm", LANES).table
    assert Counter(again["kind"].to_pylist()) == {"residential": 1, "road": 1}


@pytest.mark.parametrize(
    ("broken", "told"),
    [
        (('lat="', 'lat="9'), "nowhere on Earth"),
        (('k="geofleet:value" v="5', 'k="geofleet:value" v="x5'), "no double"),
        (("</osm>", ""), "not well-formed"),
    ],
)
def test_a_damaged_file_of_ours_is_refused(broken, told, make_signs, tmp_path):
    path = tmp_path / "signs.osm"
    write_osm(SIGNS, make_signs([(0, 0)], ["speed_limit:50"], value=[50.0]), path)
    path.write_text(path.read_text().replace(*broken))
    assert recognise(path) == "geofleet-osm"
    with pytest.raises(InputError, match=told):
        read_layer(path)


def test_what_an_editor_saved_is_a_map_like_any_other(make_signs, tmp_path):
    path = tmp_path / "signs.osm"
    write_osm(SIGNS, make_signs([(0, 0)], ["stop"], country="DE", raw_code="206"), path)
    path.write_text(path.read_text().replace('generator="geofleet"', 'generator="JOSM"').replace("DE:206", "DE:205"))
    assert read_layer(path).table["sign_class"].to_pylist() == ["yield"]
