"""Codes of signs as inventories, maps and answers of Overpass nest, prefix and place them."""

from __future__ import annotations

import json

import pyarrow as pa
import pytest

from geofleet.errors import InputError
from geofleet.formats.countries import country_code
from geofleet.formats.inventory import read_signs
from geofleet.formats.inventory_codes import guess_country, plain_codes
from geofleet.formats.inventory_columns import texts
from geofleet.formats.lanelet2 import read_signs as read_lanelet2
from geofleet.formats.osm import read_signs as read_osm
from geofleet.tables.store import lonlat
from geofleet.taxonomy import load_taxonomy


@pytest.mark.parametrize(
    ("nested", "plain"),
    [
        ('["206", "1010-51"]', "206|1010-51"),
        ("['206', '1010-51']", "206|1010-51"),
        ("{206,1010-51}", "206|1010-51"),
        ("{205}", "205"),
        ('{"code": "206", "label": "Stop"}', "206"),
        ('{"Code": 274, "value": 30}', "274[30]"),
        ('[{"code": "274-30", "maxspeed": 30}, {"sign": "1040-30"}]', "274-30[30]|1040-30"),
        ("[]", ""),
        ('{"shape": "round"}', '{"shape": "round"}'),
        ('{"code": ', '{"code": '),
        ("[" * 5000, "[" * 5000),
        ("FI:632[FI:672]", "FI:632[FI:672]"),
        (None, None),
    ],
)
def test_nested_codes_become_plain_ones(nested, plain):
    assert plain_codes([nested]) == [plain]


def test_nested_columns_of_every_format_are_read(tmp_path):
    wanted = [("stop", "main"), ("plate_vehicle", "plate"), ("speed_limit:30", "main"), ("yield", "main")]
    nested = [[{"code": "206"}, {"code": "1010-51"}], [{"code": "274", "value": 30}], [{"code": "205"}]]
    features = [
        {
            "type": "Feature",
            "properties": {"signs": one},
            "geometry": {"type": "Point", "coordinates": [11.5, 48.1 + i / 1e3]},
        }
        for i, one in enumerate(nested)
    ]
    (tmp_path / "a.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    rows = [{"id": i, "lat": 48.1 + i / 1e3, "lon": 11.5, "signs": one} for i, one in enumerate(nested)]
    (tmp_path / "b.json").write_text(json.dumps(rows))
    for name in ("a.geojson", "b.json"):
        table = read_signs(tmp_path / name).table
        assert list(zip(table["sign_class"].to_pylist(), table["kind"].to_pylist(), strict=True)) == wanted
    assert (
        texts(pa.table({"signs": nested}), "signs")[0]
        == '[{"code": "206", "value": null}, {"code": "1010-51", "value": null}]'
    )


def test_a_code_of_a_land_far_away_is_not_guessed_from_a_few():
    assert guess_country(["R1-1"], {"DE"}) is None
    assert guess_country(["A1", "B6", "C2"], {"DK"}) is None
    assert guess_country(["R1-1"], {"AU"}) == "AU"
    assert guess_country(["206", "205", "274-50", "306", "301", "1010-51"], {"FR"}) == "DE"  # a CRS that is wrong


def test_rows_that_are_all_too_long_are_no_empty_layer(tmp_path):
    path = tmp_path / "signs.csv"
    path.write_text("id;code;location\n1;206;SRID=25832;POINT (691000 5331000)\n")
    with pytest.raises(InputError, match=r"no row can be read .1 rows with another number of columns"):
        read_signs(path)


def test_well_known_text_in_a_column_of_places(tmp_path):
    path = tmp_path / "signs.csv"
    path.write_text(
        'id,device_type_code,direction,location,value\n1,B6,90,"SRID=3879;POINT Z (25496000 6672000 0)",\n'
        '2,C32,180,"SRID=3879;POINT Z (25496100 6672100 0)",40\n'
    )
    layer = read_signs(path)
    assert layer.table["sign_class"].to_pylist() == ["stop", "speed_limit"]
    assert layer.table["facing_deg"].to_pylist() == [90.0, 180.0]
    assert lonlat(layer.table)[0] == pytest.approx([24.92797, 24.92976], abs=1e-5)
    assert "3879" in layer.datum.crs


@pytest.mark.parametrize(
    ("code", "country", "sign_class"),
    [
        ("VZ 206", "DE", "stop"),
        ("Zeichen 274-50", "DE", "speed_limit:50"),
        ("Z283", "DE", "no_stopping"),
        ("Nr. 306", "DE", "priority_road"),
        ("274-1", "DE", "speed_zone"),
        ("274-10", "DE", "speed_limit:10"),
        ("274.1", "DE", "speed_zone"),
        ("§52-24", "AT", "stop"),
        ("§ 52 Z 24", "AT", "stop"),
        ("52.24", "AT", "stop"),
        ("Ra-1", "CA", "stop"),
        ("Rb-1 (50)", "CA", "speed_limit:50"),
    ],
)
def test_codes_as_inventories_write_them(code, country, sign_class):
    assert load_taxonomy().meaning(code, country=country).sign_class == sign_class


@pytest.mark.parametrize(
    ("code", "sign_class"),
    [
        ("frB14_50", "speed_limit:50"),
        ("frB14-70", "speed_limit:70"),
        ("usR2-1_25", "speed_limit:25mph"),
        ("us_R1_1", "stop"),
        ("DE:206", "stop"),
        ("de_206", "stop"),
        ("FR:B14[50]", "speed_limit:50"),
        ("de274_1", "speed_zone"),
        ("de274_50", "speed_limit:50"),
        ("de1022_10", "plate_except"),
        ("stop_sign", "stop"),
    ],
)
def test_codes_as_lanelet2_maps_write_them(tmp_path, code, sign_class):
    path = tmp_path / "map.osm"
    path.write_text(
        "<osm version='0.6'><node id='1' lat='48.1' lon='2.35'/><node id='2' lat='48.1' lon='2.350004'/>"
        f"<way id='3'><nd ref='1'/><nd ref='2'/><tag k='type' v='traffic_sign'/><tag k='subtype' v='{code}'/></way>"
        "<relation id='4'><member type='way' ref='3' role='left'/><member type='way' ref='3' role='right'/>"
        "<tag k='type' v='lanelet'/></relation></osm>"
    )
    table = read_lanelet2(path).table
    assert table["sign_class"].to_pylist() == [sign_class]
    assert table["country"].to_pylist() == [None if code == "stop_sign" else code[:2].upper()]


@pytest.mark.parametrize(
    ("text", "country", "sign_class"),
    [
        ("Speed limit (50km/h)", "", "speed_limit:50"),
        ("speed_limit_50", "", "speed_limit:50"),
        ("maxspeed:50", "DE", "speed_limit:50"),
        ("Speed limit 35", "US", "speed_limit:35mph"),
        ("speed limit 30 mph", "", "speed_limit:30mph"),
        ("No entry", "FR", "no_entry"),
        ("Give way", "", "yield"),
        ("Speed limit [30]", "", "speed_limit:30"),
        ("maxspeed", "", "speed_limit"),
        ("maxspeed:end", "", "end_speed_limit"),
        ("speed_limit:60", "", "speed_limit:60"),
        ("speed_limit:25mph", "US", "speed_limit:25mph"),
        ("stop:4", "", "raw:stop:4"),
        ("Zone 30 ahead", "", "raw:Zone 30 ahead"),
    ],
)
def test_words_and_classes_in_a_column_of_codes(text, country, sign_class):
    meaning = load_taxonomy().meaning(text, country=country)
    assert meaning.sign_class == sign_class
    assert meaning.known is not sign_class.startswith("raw:")


def test_a_language_with_its_country_names_the_country():
    assert [country_code(text) for text in ("de-DE", "fr_FR", "DEU", "US-CA")] == ["DE", "FR", "DE", None]


def test_what_mapillary_finds_beside_signs_is_no_main_sign():
    taxonomy = load_taxonomy()
    codes = [
        "object--street-light",
        "marking--discrete--other",
        "regulatory--new-one--g1",
        "object--traffic-light--other",
    ]
    assert [taxonomy.meaning(code, scheme="mapillary").kind for code in codes] == ["other", "marking", "main", "light"]
    assert taxonomy.kind_of(["raw:object--street-light", "raw:B6", "stop"]).tolist() == ["other", "main", "main"]


@pytest.mark.parametrize(
    ("elements", "message"),
    [
        (
            [{"type": "way", "id": 5, "center": {"lat": 48.1, "lon": 11.5}, "tags": {"highway": "service"}}],
            "out center",
        ),
        (
            [{"type": "way", "id": 5, "center": {"lat": 48.1, "lon": 11.5}, "nodes": [1, 2], "tags": {}}] * 2,
            "2 ways or relations by their centres .* only, and no node: .* node.traffic_sign.",
        ),
        ([{"type": "relation", "id": 5, "bounds": {"minlat": 1, "minlon": 2, "maxlat": 3, "maxlon": 4}}], "out bb"),
        ([{"type": "count", "id": 0, "tags": {"nodes": "12"}}], "1 counts only"),
        ([{"type": "way", "id": 5, "nodes": [1, 2]}], "ways by the ids of their nodes"),
        ([], "holds no nodes"),
    ],
)
def test_answers_without_a_node_say_what_they_hold(tmp_path, elements, message):
    path = tmp_path / "answer.json"
    path.write_text(json.dumps({"version": 0.6, "generator": "Overpass API", "elements": elements}))
    with pytest.raises(InputError, match=message):
        read_osm(path)
