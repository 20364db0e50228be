"""Codes against what the public lists say: those that were once wrong, and their neighbours.

Vienna: annex 1 of the Convention on Road Signs and Signals as amended in 1995. France: the order of 24 November 1967.
Belgium: the royal order of 1 December 1975. United States: tables 2B-1 and 2C-1 of the MUTCD. Finland: annex 3 of the
Road Traffic Act 729/2018, and the decree 182/1982 that it took the place of, as the Finnish road agency lists them.
OpenStreetMap: the words of its wiki's page on `traffic_sign`.
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
FINLAND_2020 = {
    "A1.1": "curve_right", "A2.2": "double_curve_left", "A3.1": "steep_ascent", "A3.2": "steep_descent",
    "A7": "quay", "A8": "traffic_queue", "A14": "soft_verge", "A15": "warn_pedestrian_crossing",
    "A16": "warn_pedestrians", "A19": "ski_track", "A20.3": "wild_animals", "A22.4": "side_road",
    "A26": "level_crossing_open", "A27": "level_crossing_gated", "A29.2": "level_crossing_cross",
    "B3": "priority_over_oncoming", "B4": "yield_to_oncoming", "B7": "yield_at_cycle_crossing", "C3": "no_trucks",
    "C4": "no_trailers", "C11": "no_bicycles", "C12": "no_bicycles_mopeds", "C14": "no_pedestrians_bicycles",
    "C15": "no_pedestrians_bicycles_mopeds", "C25": "weight_limit_combination", "C27": "bogie_load_limit",
    "C36": "lane_restriction", "C41": "taxi_rank", "C42": "taxi_stop", "C43": "loading_place",
    "C44.1": "alternate_parking", "C45": "customs_stop", "C46": "checkpoint_stop", "C47": "minimum_distance",
    "C48": "no_studded_tyres", "D1.2": "turn_left_here", "D1.4": "turn_right_ahead", "D1.8": "left_or_right",
    "D2": "roundabout", "D3.3": "pass_either_side", "D7.2": "segregated_path_cycle_right", "D8": "snowmobile_route",
    "D11": "end_minimum_speed", "E3.4": "parking", "E4.2": "parking", "E5": "passing_place", "E8": "taxi_station",
    "E9.2": "bus_lane", "E10.2": "end_bus_lane", "E11.2": "tram_lane", "E12.1": "end_tram_lane",
    "E13.2": "cycle_lane", "E17": "expressway", "E21": "emergency_bay", "E28": "cycle_street",
    "E30": "lanes_merge", "F1.2": "direction_sign", "F7.6": "lane_arrangement", "F8.1": "lanes_merge",
    "F24.3": "dead_end", "F25": "advisory_speed", "F27.1": "place_name", "F54.1": "direction_sign", "G22": "service",
    "G41.2": "service",
    "H1": "plate_arrow", "H3": "plate_length", "H5": "plate_distance", "H8": "plate_clearance",
    "H11": "plate_arrow", "H12.13": "plate_vehicle", "H13.2": "plate_parking_manner",
    "H15": "plate_dangerous_goods", "H18": "plate_time", "H20": "plate_payment", "H21": "plate_other",
    "H22.2": "plate_priority_course", "H23.2": "plate_cycle_two_way", "H24": "plate_text", "H25": "plate_except",
    "H26": "plate_other", "I6": "hazard_board", "I12.1": "delineator", "I13": "removal_notice",
    "I14": "location_marker", "I15": "speed_camera", "I17.2": "reindeer_area", "I18": "speed_overview",
    "I19": "state_border",
}  # fmt: skip
FINLAND_1982 = {
    "113": "double_curve_right", "116": "steep_ascent", "133": "traffic_queue", "147": "soft_verge",
    "156": "wild_animals", "163": "side_road", "175": "level_crossing_approach", "177": "level_crossing_cross",
    "189": "other_danger", "212": "end_priority_road", "317": "no_snowmobiles", "319": "no_buses",
    "322": "no_bicycles_mopeds", "331": "no_entry", "345": "weight_limit_combination", "354":
    "end_no_overtaking_trucks", "365": "lane_restriction", "375": "taxi_rank", "376": "taxi_stop",
    "382": "alternate_parking", "391": "customs_stop", "415": "left_or_right", "416": "roundabout",
    "418": "pass_either_side", "424": "segregated_path_cycle_left", "426": "snowmobile_route", "520": "parking",
    "521a": "parking", "522": "passing_place", "532": "bus_stop", "533": "tram_stop", "534": "taxi_station",
    "541b": "bus_lane", "542a": "end_bus_lane", "543a": "tram_lane", "544b": "end_tram_lane", "567": "emergency_bay",
    "576": "end_pedestrian_zone", "611": "direction_sign", "622": "lane_arrangement", "623": "lanes_merge",
    "644": "direction_sign", "652": "dead_end", "653": "advisory_speed", "662": "place_name",
    "677": "direction_sign", "722": "service", "813": "plate_arrow", "814": "plate_length", "816": "plate_distance",
    "823": "plate_clearance", "828": "plate_arrow", "836": "plate_vehicle", "845": "plate_parking_manner",
    "848": "plate_dangerous_goods", "854": "plate_time", "855a": "plate_payment", "856b": "plate_time",
    "861b": "plate_priority_course", "862": "plate_other", "863": "plate_cycle_two_way", "871": "plate_text",
    "880": "plate_other", "916": "hazard_board", "941": "hazard_board",
}  # fmt: skip
OSM_WORDS = {
    "city_limit": "built_up_area", "maxspeed": "speed_limit", "stop": "stop", "give_way": "yield",
    "overtaking": "no_overtaking", "maxwidth": "width_limit", "maxheight": "height_limit",
    "maxlength": "length_limit", "maxweight": "weight_limit", "maxaxleload": "axle_load_limit",
    "hazard": "other_danger", "hgv": "no_trucks", "variable_message": "variable_sign", "destination":
    "direction_sign", "hamlet_limit": "built_up_area", "crosswalk": "pedestrian_crossing", "toll": "toll",
}  # fmt: skip
CASES = [
    (scheme, country, code, concept)
    for scheme, country, codes in (
        ("vienna", "", VIENNA),
        ("fr", "FR", FRANCE),
        ("be", "BE", BELGIUM),
        ("mutcd", "US", UNITED_STATES),
        ("", "FI", FINLAND_2020),
        ("", "FI", FINLAND_1982),
        ("osm", "", OSM_WORDS),
    )
    for code, concept in codes.items()
]


@pytest.mark.parametrize(("scheme", "country", "code", "concept"), CASES)
def test_a_code_means_what_the_list_says(scheme, country, code, concept):
    assert load_taxonomy().meaning(code, country=country, scheme=scheme).concept == concept


@pytest.mark.parametrize(("scheme", "code"), [("vienna", "D,10a"), ("be", "D8"), ("be", "D6"), ("be", "A18")])
def test_what_is_no_such_sign_is_not_known(scheme, code):
    assert not load_taxonomy().meaning(code, scheme=scheme).known
