from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from geofleet.formats.osm_tags import (
    is_drivable,
    node_signs,
    oneway_of,
    speed_kmh,
    split_outside_brackets,
    split_value,
    tagged_signs,
)


def codes(value: str) -> list[str]:
    return [f"{country}:{code}" if country else code for _, _, country, code in split_value(value)]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("DE:205", ["DE:205"]),
        ("DE:205;215", ["DE:205", "DE:215"]),
        ("DE:620-40, 620-41", ["DE:620-40", "DE:620-41"]),
        ("DE:260,DE:1026-36", ["DE:260", "DE:1026-36"]),
        ("FI:632[FI:672[up] FI:667[3]]", ["FI:632[FI:672[up] FI:667[3]]"]),
        ("FI:342[2,8 m]", ["FI:342[2,8 m]"]),
        ("FI:612[a;b];FI:511", ["FI:612[a;b]", "FI:511"]),
        (";FI:331", ["FI:331"]),
        ("BR: R-1", ["BR:R-1"]),
        ("CA-ON:Ra-1;CA:QC:P-010", ["CA:ON:Ra-1", "CA:QC:P-010"]),  # a province may follow the country
        ("traffic_sign=BR:A-17", ["BR:A-17"]),  # the key pasted along
        (
            "AT:52.11a[52.10a[30];52.7a-2[3.5],54[x]],54[y;z]",
            ["AT:52.11a[52.10a[30];52.7a-2[3.5],54[x]]", "AT:54[y;z]"],
        ),
        ("FI:632[FI:811[left];FI:231", ["FI:632[FI:811[left]", "FI:231"]),  # a bracket that never closes holds nothing
        ("city_limit,FR:EB10", ["city_limit", "FR:EB10"]),
        ("", []),
        (" ; , ", []),
    ],
)
def test_a_value_splits_at_separators_outside_brackets(value, expected):
    assert codes(value) == expected


def test_a_value_tells_signs_from_what_follows_them():
    parts = [(group, follows) for group, follows, _, _ in split_value("DE:240,1022-10;DE:260,1026-36,1040-30[6-21]")]
    assert parts == [(0, False), (0, True), (1, False), (1, True), (1, True)]


@given(st.text(alphabet="A1;,[]: x", max_size=40))
def test_no_letter_of_a_value_is_lost(value):
    for separator in ";,":
        assert separator.join(split_outside_brackets(value, separator)) == value


@given(
    st.dictionaries(st.sampled_from(["traffic_sign", "traffic_sign:2", "direction", "maxspeed", "highway"]), st.text())
)
def test_any_tags_are_survived(tags):
    for sign in node_signs(tags):
        assert sign.raw_code
        assert sign.facing_deg is None or 0 <= sign.facing_deg < 360


def test_slots_come_in_order_and_prefixes_carry_from_one_to_the_next():
    tags = {
        "traffic_sign:10": "855a",
        "traffic_sign:2": "FI:855b[9-21]",
        "traffic_sign": "FI:372",
        "traffic_sign:note": "x",
    }
    assert [(s.slot, s.country, s.code) for s in tagged_signs(tags)] == [
        (1, "FI", "372"),
        (2, "FI", "855b[9-21]"),
        (10, "FI", "855a"),
    ]


def test_plates_hang_on_their_main_sign():
    signs = node_signs({"traffic_sign": "DE:1000-32,205;DE:260,1026-36", "traffic_sign:2": "DE:1040-30"})
    assert [(s.raw_code, s.kind, s.parent) for s in signs] == [
        ("DE:1000-32", "plate", 1),
        ("DE:205", "main", None),
        ("DE:260", "main", None),
        ("DE:1026-36", "plate", 2),
        ("DE:1040-30", "plate", 2),
    ]


def test_two_main_signs_may_stand_after_a_comma_and_unknown_plates_are_plates():
    signs = node_signs({"traffic_sign": "DE:205,DE:215,nur bei Nacht"})
    assert [(s.meaning.concept, s.kind) for s in signs] == [
        ("yield", "main"),
        ("roundabout", "main"),
        ("raw:nur bei Nacht", "plate"),
    ]


def test_the_same_plate_twice_stays_two_signs():
    assert [s.raw_code for s in node_signs({"traffic_sign": "FI:511;FI:511"})] == ["FI:511", "FI:511"]


@pytest.mark.parametrize(
    ("tags", "sign_class"),
    [
        ({"traffic_sign": "maxspeed", "maxspeed": "50"}, "speed_limit:50"),
        ({"traffic_sign": "maxspeed", "maxspeed": "30 mph"}, "speed_limit:30mph"),
        ({"traffic_sign": "DE:274.1", "maxspeed": "30"}, "speed_zone:30"),
        ({"traffic_sign": "DE:274", "maxspeed": "none"}, "speed_limit"),
        ({"traffic_sign": "maxheight", "maxheight": "3.8"}, "height_limit:3.8"),
        ({"traffic_sign": "FI:342[2,8 m]"}, "height_limit:2.8"),
        ({"traffic_sign": "FI:363[40]"}, "speed_zone:40"),
        ({"traffic_sign": "city_limit", "city_limit": "end"}, "end_built_up_area"),
        ({"highway": "stop"}, "stop"),
        ({"highway": "give_way", "traffic_sign": "DE:205"}, "yield"),
    ],
)
def test_a_number_comes_from_the_code_or_from_the_tag_of_its_name(tags, sign_class):
    assert [s.meaning.sign_class for s in node_signs(tags)] == [sign_class]


@pytest.mark.parametrize(
    ("tags", "facing", "side"),
    [
        ({"direction": "90"}, [90.0], ""),
        ({"direction": "NW"}, [315.0], ""),
        ({"direction": "450°"}, [90.0], ""),
        ({"direction": "forward"}, [None], "forward"),
        ({"direction": "nonsense"}, [None], ""),
        ({"traffic_sign:facing": "230;310", "direction": "10"}, [230.0], ""),
    ],
)
def test_facing_is_read_from_the_tags(tags, facing, side):
    signs = node_signs({"traffic_sign": "DE:206", **tags})
    assert [s.facing_deg for s in signs] == facing
    assert [s.side for s in signs] == [side]


def test_forward_and_backward_keys_say_whom_a_sign_is_for():
    signs = node_signs({"traffic_sign:forward": "DE:276", "traffic_sign:backward": "DE:280"})
    assert {(s.meaning.concept, s.side) for s in signs} == {
        ("no_overtaking", "forward"),
        ("end_no_overtaking", "backward"),
    }


def test_roads_for_cars():
    assert is_drivable({"highway": "residential"})
    assert is_drivable({"highway": "motorway_link"})
    assert not is_drivable({"highway": "residential", "access": "private"})
    assert not is_drivable({"highway": "trail"})
    assert not is_drivable({"railway": "rail"})
    assert [oneway_of({"oneway": v}) for v in ("yes", "-1", "no")] == [1, -1, 0]
    assert oneway_of({"highway": "motorway"}) == 1
    assert oneway_of({"junction": "roundabout", "oneway": "no"}) == 0
    assert [speed_kmh(v) for v in ("50", "30 mph", "none", None)] == [50.0, pytest.approx(48.28032), None, None]


def test_every_real_value_of_eight_countries_is_read(shared_data):
    n = 0
    for file in sorted((shared_data / "taxonomy").glob("taginfo*.json")):
        for value, _ in json.loads(file.read_text()):
            signs = node_signs({"traffic_sign": value})
            assert signs, value
            n += len(signs)
    assert n > 1000


CODES = st.from_regex(r"[A-Z]?[0-9]{1,3}([.-][0-9]{1,2})?", fullmatch=True)
BRACKETS = st.recursive(
    st.text("abc 0123456789.;,", min_size=1, max_size=8),
    lambda inner: st.builds(
        "{}[{}]{}".format, st.sampled_from(["", "FI:672", "up "]), inner, st.sampled_from(["", " x"])
    ),
    max_leaves=4,
)
PLATES = st.tuples(st.sampled_from(["", "DE", "FI", "BE"]), CODES, st.one_of(st.just(""), BRACKETS))


@given(st.lists(st.lists(PLATES, min_size=1, max_size=3), min_size=1, max_size=4))
def test_a_value_that_is_written_is_read_back(groups):
    expected = []
    written = []
    carried = ""
    for number, group in enumerate(groups):
        parts = []
        for position, (country, code, inside) in enumerate(group):
            text = f"{code}[{inside}]" if inside else code
            carried = country or carried
            parts.append(f"{country}:{text}" if country else text)
            expected.append((number, position > 0, carried, text))
        written.append(",".join(parts))
    assert list(split_value(";".join(written))) == expected


@given(st.dictionaries(st.sampled_from(["", ":2", ":3", ":10", ":12", ":forward:4"]), CODES, min_size=1))
def test_every_slot_is_read_in_the_order_of_its_number(values):
    number = {"": 1, ":2": 2, ":3": 3, ":10": 10, ":12": 12, ":forward:4": 4}
    found = tagged_signs({f"traffic_sign{slot}": code for slot, code in values.items()})
    assert [(sign.slot, sign.code) for sign in found] == sorted((number[slot], code) for slot, code in values.items())


def test_the_two_orders_of_slot_and_side_mean_the_same():
    for key in ("traffic_sign:2:backward", "traffic_sign:backward:2"):
        assert [(s.slot, s.side) for s in tagged_signs({key: "DE:276"})] == [(2, "backward")]
    assert [s.side for s in tagged_signs({"traffic_sign:left": "DE:276", "traffic_sign:both": "DE:280"})] == ["", ""]
    assert tagged_signs({"traffic_sign:id": "x", "traffic_sign:2:direction": "90", "traffic_signals": "yes"}) == []
