from __future__ import annotations

import csv
import json
import re
from collections import Counter, defaultdict

import numpy as np
import osmium
import pyarrow.parquet as pq
import pytest

from geofleet.config import load_config, packaged_scenarios
from geofleet.formats.osm_tags import split_value, tagged_signs
from geofleet.taxonomy import load_taxonomy, reader

TAXONOMY = load_taxonomy()


@pytest.fixture(scope="module")
def rows(repo):
    with (repo / "geofleet" / "taxonomy" / "taxonomy.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def test_the_file_has_the_columns_of_its_design(rows):
    assert list(rows[0]) == [
        *("concept", "group", "kind", "value_rule", "unit", "scheme", "country", "code_pattern", "source"),
    ]
    for row in rows:
        assert row["concept"], row
        assert row["group"], row
        assert row["source"], row
        assert re.fullmatch(r"[a-z][a-z0-9_]*", row["concept"])
        assert row["kind"] in {"main", "plate", "light", "marking", "other"}
        assert re.fullmatch(r"number|=\d+|", row["value_rule"])
        assert bool(row["unit"]) == bool(row["value_rule"]), row


def test_a_concept_has_one_group_and_one_kind(rows):
    seen = defaultdict(set)
    for row in rows:
        seen[row["concept"]].add((row["group"], row["kind"]))
    assert {name: found for name, found in seen.items() if len(found) > 1} == {}
    assert len(seen) >= 60


def test_the_groups_and_schemes_asked_for_exist(rows):
    assert set(TAXONOMY.groups) >= {
        *("warning", "priority", "prohibition", "mandatory", "crossing", "parking", "information", "place", "plate"),
        *("marking", "light"),
    }
    schemes = {row["scheme"] for row in rows}
    assert schemes >= {"stvo", "fi-1982", "fi-2020", "fr", "be", "mutcd", "vienna", "osm", "lanelet2", "mapillary"}
    for name in packaged_scenarios():
        assert set(load_config(name).scene.groups) <= set(TAXONOMY.groups)


def test_no_pattern_is_shadowed_by_an_equal_one(rows):
    patterns = Counter((row["scheme"], row["code_pattern"]) for row in rows)
    assert [key for key, n in patterns.items() if n > 1] == []


@pytest.mark.parametrize(
    ("code", "country", "sign_class"),
    [
        ("206", "DE", "stop"),
        ("274-50", "DE", "speed_limit:50"),
        ("274-56", "DE", "speed_limit:60"),  # the numbers of before 2017
        ("274[30]", "DE", "speed_limit:30"),
        ("274.1:30", "DE", "speed_zone:30"),
        ("274.1(30)", "DE", "speed_zone:30"),
        ("274.2-20", "DE", "end_speed_zone:20"),
        ("278-70", "DE", "end_speed_limit:70"),
        ("262:18", "DE", "weight_limit:18"),
        ("1022-10", "DE", "plate_except"),
        ("231", "FI", "yield"),
        ("232", "FI", "stop"),
        ("361[20]", "FI", "speed_limit:20"),
        ("363[40]", "FI", "speed_zone:40"),
        ("C32[80]", "FI", "speed_limit:80"),
        ("B5", "FI", "yield"),
        ("C37", "FI", "no_stopping"),
        ("371", "FI", "no_stopping"),
        ("372", "FI", "no_parking"),
        ("511", "FI", "pedestrian_crossing"),
        ("521", "FI", "parking"),
        ("344[4.5t]", "FI", "weight_limit:4.5"),
        ("347[16 t]", "FI", "bogie_load_limit:16"),
        ("115[10 %]", "FI", "steep_descent:10"),
        ("413[right]", "FI", "turn_right_ahead"),
        ("855a[9-21 (9-18)]", "FI", "plate_payment"),
        ("632[FI:672[up] FI:667[3]]", "FI", "direction_sign"),
        ("AB4", "FR", "stop"),
        ("B14_(30)", "FR", "speed_limit:30"),
        ("B30-30", "FR", "speed_zone:30"),
        ("C43-50", "BE", "speed_limit:50"),
        ("B1", "BE", "yield"),
        ("R1-1", "US", "stop"),
        ("S5-1[20]", "US", "speed_zone:20mph"),
        ("52.10a[30]", "AT", "speed_limit:30"),
        ("52.11a[52.10a[30]]", "AT", "speed_zone:30"),
        ("52.7a-2[7.5]", "AT", "no_trucks:7.5"),
        ("§52.8c", "AT", "no_bicycles"),
        ("54[ausgenommen Anrainerverkehr]", "AT", "plate_other"),
        ("B-20", "PL", "stop"),
        ("B-33[70]", "PL", "speed_limit:70"),
        ("d42", "PL", "built_up_area"),
        ("C-16/13", "PL", "shared_path"),
        ("R-19[60]", "BR", "speed_limit:60"),
        ("R-6a", "BR", "no_parking"),
        ("A-18", "BR", "bump"),
        ("R1-2", "AU", "yield"),
        ("NSW:R8-2", "AU", "shared_path"),
        ("R4-1[80]", "AU", "speed_limit:80"),
        ("ON:Ra-1", "CA", "stop"),
        ("QC:P-010", "CA", "stop"),
        ("R2-1[25]", "US", "speed_limit:25mph"),
        ("give_way", None, "yield"),
        ("maxspeed[70]", "", "speed_limit:70"),
        ("city_limit", "DE", "built_up_area"),
    ],
)
def test_national_codes(code, country, sign_class):
    assert TAXONOMY.classify([code], country=country).sign_class.tolist() == [sign_class]


@pytest.mark.parametrize(
    ("code", "scheme", "sign_class"),
    [
        ("de205", "lanelet2", "yield"),
        ("de274_1", "lanelet2", "speed_zone"),
        ("usR1-1", "lanelet2", "stop"),
        ("stop_sign", "lanelet2", "stop"),
        ("regulatory--yield--g1", "mapillary", "yield"),
        ("regulatory--maximum-speed-limit-30--g1", "mapillary", "speed_limit:30"),
        ("regulatory--maximum-speed-limit-led-120--g1", "mapillary", "speed_limit:120"),
        ("C,14[80]", "vienna", "speed_limit:80"),
        ("1000001", "opendrive", "traffic_light"),
    ],
)
def test_codes_of_schemes(code, scheme, sign_class):
    assert TAXONOMY.classify([code], scheme=scheme).sign_class.tolist() == [sign_class]


def test_a_raw_class_read_again_is_the_same_class():
    assert TAXONOMY.meaning("raw:077[7]").sign_class == "raw:077[7]"
    assert TAXONOMY.meaning("raw:").sign_class == "raw:"


def test_an_unknown_code_keeps_its_text_and_is_a_class_of_its_own():
    found = TAXONOMY.classify(["077[7]", "206"], country=["FI", "DE"])
    assert found.sign_class.tolist() == ["raw:077[7]", "stop"]
    assert found.concept.tolist() == ["raw:077[7]", "stop"]
    assert found.known.tolist() == [False, True]
    assert found.kind.tolist() == ["main", "main"]
    assert np.isnan(found.value).all()
    assert TAXONOMY.group_of(["raw:077[7]", "stop"]).tolist() == ["other", "priority"]
    assert TAXONOMY.kind_of(["raw:077[7]", "plate_text"]).tolist() == ["main", "plate"]


def test_no_codes_give_empty_columns():
    assert len(TAXONOMY.classify([]).concept) == 0


def taginfo_share(shared_data, country):
    known = total = 0
    for value, n in json.loads((shared_data / "taxonomy" / f"taginfoTrafficSignData_{country}.json").read_text()):
        for _, _, land, code in split_value(value):
            total += n
            known += n * bool(TAXONOMY.meaning(code, country=land).known)
    return known / total


@pytest.mark.parametrize(
    ("country", "share"),
    [("DE", 0.999), ("FR", 0.99), ("BE", 0.95), ("AT", 0.95), ("PL", 0.99), ("BR", 0.97), ("CA", 0.97), ("AU", 0.85)],
)
def test_real_values_of_the_map_are_known(shared_data, country, share):
    assert taginfo_share(shared_data, country) >= share


def test_codes_in_helsinki_are_known(repo):
    known = [
        TAXONOMY.meaning(sign.code, country=sign.country).known
        for node in osmium.FileProcessor(repo / "data" / "raw" / "helsinki.osm.pbf", osmium.osm.NODE)
        for sign in tagged_signs(dict(node.tags))
    ]
    assert len(known) > 3000
    assert np.mean(known) >= 0.99


def test_classes_of_mapillary_in_bremen_are_known(shared_data):
    file = shared_data / "mapillary" / "mapillary_traffic-signs_DE-HB.parquet"
    found = TAXONOMY.classify(pq.read_table(file)["value"].to_pylist(), scheme="mapillary")
    assert len(found.known) == 22_836
    assert found.known.mean() >= 0.95


@pytest.mark.parametrize("country", ["DE", "FI", "FR", "US", ""])
def test_looking_plain_codes_up_finds_what_trying_every_rule_finds(country):
    rules = reader._rules_for(country, "")
    codes = {
        part.replace("{n}", "30").replace("\\", "").strip("()?*+[]")
        for rule in rules.rules
        for part in rule.text.replace(reader.NUMBER, "30").split("|")
    }
    for code in sorted(codes | {f"{code}[50]" for code in codes} | {code.upper() for code in codes}):
        candidates = (code, reader._without_bracket(code))
        every = (rule for rule in rules.rules if any(rule.pattern.fullmatch(one) for one in candidates))
        chosen = (r for r in rules.that_may_match(candidates) if any(r.pattern.fullmatch(one) for one in candidates))
        assert next(chosen, None) is next(every, None), code


@pytest.mark.parametrize(
    ("country", "code", "found"),
    [
        ("FR", "B6b1", "no_parking_zone"), ("FR", "B6b2", "alternate_parking"), ("FR", "B6b4", "parking_zone"),
        ("FR", "B50a", "end_no_parking_zone"), ("FR", "B50d", "end_parking_zone"),
        ("FR", "B12a[10]", "axle_load_limit:10"),
        ("FR", "AK1b", "curve_left"), ("FR", "AK3a", "road_narrows_right"), ("FR", "A21b", "warn_cyclists"),
        ("FR", "C24b", "lane_arrangement"), ("FR", "B27b", "trams_only"), ("FR", "C25a", "speed_overview"),
        ("FR", "C109", "pedestrian_zone"), ("FR", "C62", "toll"), ("FR", "KD4", "direction_sign"),
        ("FR", "M9v", "plate_except"), ("FR", "M10b", "plate_text"), ("FR", "M5[150 m]", "plate_distance:150"),
        ("US", "W1-15L", "curve_left"), ("US", "W7-6", "crest"), ("US", "W11-21", "wild_animals"),
        ("US", "W9-1R", "lanes_merge"), ("US", "R2-4[45]", "minimum_speed:45mph"), ("US", "S5-2", "end_speed_zone"),
        ("BE", "A7b", "road_narrows_left"), ("BE", "F79", "lanes_merge"), ("BE", "E11", "alternate_parking"),
    ],
)  # fmt: skip
def test_codes_that_were_held_against_the_acts(country, code, found):
    assert TAXONOMY.meaning(code, country=country).sign_class == found
