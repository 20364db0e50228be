"""Codes against what the public lists say: those that were once wrong, and their neighbours.

Vienna: annex 1 of the Convention on Road Signs and Signals as amended in 1995. France: the order of 24 November 1967.
Belgium: the royal order of 1 December 1975. United States: tables 2B-1 and 2C-1 of the MUTCD.
"""

from __future__ import annotations

import pytest

from geofleet.taxonomy import load_taxonomy

VIENNA = {
    "A,1a": "curve_left", "A,1b": "curve_right", "A,1c": "double_curve_left", "A,1d": "double_curve_right",
    "A,2c": "steep_descent", "A,3b": "steep_ascent", "A,4b": "road_narrows", "A,7b": "bump", "A,7c": "uneven_road",
    "A,12b": "warn_pedestrian_crossing", "A,17c": "warn_traffic_signals", "A,18c": "crossroads",
    "A,19a": "priority_at_next", "A,20": "yield_ahead", "A,21b": "stop_ahead", "A,22": "warn_roundabout",
    "A,24": "traffic_queue", "A,25": "level_crossing_gated", "A,26b": "level_crossing_open", "A,27": "warn_tram",
    "A,28b": "level_crossing_cross", "A,29c": "level_crossing_approach", "A,30": "aircraft", "A,31": "crosswind",
    "A,32": "other_danger", "B,2b": "stop", "B,5": "yield_to_oncoming", "B,6": "priority_over_oncoming",
    "C,1b": "no_entry", "C,3a": "no_cars", "C,3b": "no_motorcycles", "C,3c": "no_bicycles", "C,3d": "no_mopeds",
    "C,3e": "no_trucks", "C,3f": "no_trailers", "C,3g": "no_trailers", "C,3h": "no_dangerous_goods",
    "C,3i": "no_pedestrians", "C,3j": "no_animal_carts", "C,3k": "no_handcarts", "C,3l": "no_tractors",
    "C,17a": "end_all_restrictions", "C,17d": "end_no_overtaking_trucks", "C,18": "no_parking", "C,19": "no_stopping",
    "D,3": "roundabout", "D,7": "minimum_speed", "D,9": "snow_chains", "E,2a": "bus_lane", "E,9b": "no_parking_zone",
    "E,9c": "parking_zone", "E,9d": "speed_zone", "E,10d": "end_speed_zone", "E,12b": "pedestrian_crossing",
    "E,13a": "service", "G,13": "dead_end", "G,17": "advisory_speed",
}  # fmt: skip
FRANCE = {
    "AB3a": "yield", "AB3b": "yield_ahead", "AB4": "stop", "AB5": "stop_ahead", "AB25": "warn_roundabout",
    "A13a": "children", "A13b": "warn_pedestrian_crossing", "AK2": "uneven_road", "AK5": "road_works",
    "AK17": "warn_traffic_signals", "B6a1": "no_parking", "B6a2": "alternate_parking", "B6a3": "alternate_parking",
    "B6d": "no_stopping", "B7a": "no_motor_vehicles", "B7b": "no_motor_vehicles", "B9a": "no_pedestrians",
    "B9b": "no_bicycles", "B9c": "no_animal_carts", "B9d": "no_tractors", "B9e": "no_handcarts", "B9f": "no_buses",
    "B9g": "no_mopeds", "B9h": "no_motorcycles", "B9i": "no_trailers", "C113": "cycleway", "C114": "end_cycleway",
    "C115": "reserved_road", "C116": "end_reserved_road", "G1": "level_crossing_cross",
    "G1bis": "level_crossing_cross", "J10": "level_crossing_approach",
}  # fmt: skip
BELGIUM = {
    "A1a": "curve_left", "A1b": "curve_right", "A19": "falling_rocks", "A50": "traffic_queue", "B1": "yield",
    "B3": "yield_ahead", "B5": "stop", "B7": "stop_ahead", "C7": "no_motorcycles", "C13": "no_animal_carts",
    "C15": "no_riding", "C17": "no_handcarts", "C19": "no_pedestrians", "C22": "no_buses", "C27": "width_limit",
    "C29": "height_limit", "F18": "bus_lane", "F19": "one_way", "F43": "place_name", "F4a": "speed_zone",
}  # fmt: skip
UNITED_STATES = {
    "R3-1": "no_right_turn", "R3-2": "no_left_turn", "R3-4": "no_u_turn", "R3-17": "cycle_lane",
    "R4-1": "no_overtaking", "R4-2": "end_no_overtaking", "R4-7a": "keep_right", "R4-8": "keep_left",
    "R5-1": "no_entry", "R5-2": "no_trucks", "R5-3": "no_motor_vehicles", "R5-6": "no_bicycles",
    "R5-8": "no_motorcycles", "R5-10b": "no_pedestrians_bicycles", "R5-10c": "no_pedestrians", "R6-2": "one_way",
    "R8-5": "no_stopping", "R9-14": "no_riding", "R9-15": "no_snowmobiles", "W8-2": "uneven_road",
}  # fmt: skip
CASES = [
    (scheme, country, code, concept)
    for scheme, country, codes in (
        ("vienna", "", VIENNA),
        ("fr", "FR", FRANCE),
        ("be", "BE", BELGIUM),
        ("mutcd", "US", UNITED_STATES),
    )
    for code, concept in codes.items()
]


@pytest.mark.parametrize(("scheme", "country", "code", "concept"), CASES)
def test_a_code_means_what_the_list_says(scheme, country, code, concept):
    assert load_taxonomy().meaning(code, country=country, scheme=scheme).concept == concept


@pytest.mark.parametrize(("scheme", "code"), [("vienna", "D,10a"), ("be", "D8"), ("be", "D6"), ("be", "A18")])
def test_what_is_no_such_sign_is_not_known(scheme, code):
    assert not load_taxonomy().meaning(code, scheme=scheme).known
