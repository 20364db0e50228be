"""Codes against what the public lists say: those that were once wrong, and their neighbours.

Vienna: annex 1 of the Convention on Road Signs and Signals as amended in 1995. France: the order of 24 November 1967.
Belgium: the royal order of 1 December 1975. United States: tables 2B-1, 2C-1, 2I-1, 7B-1, 8B-1 and 9A-1 of the MUTCD
of 2023, figure 2B-4 of that of 2009. The Netherlands: annex 1 of the RVV 1990. Switzerland: annex 2 of the SSV.
Austria: sections 50 to 54 of the StVO 1960, and Poland: the regulation of 31 July 2002, as OpenStreetMap lists their
signs. Germany: the StVO as amended in 2020 and the VzKat of 2017. Finland: annex 3 of the Road Traffic Act 729/2018,
and the decree 182/1982 that it took the place of, as the Finnish road agency lists them. Australia: AS 1743-2023, by
a transcription of its drawings. Brazil: annex 2 of the CTB. OpenStreetMap: the words of its wiki's page on
`traffic_sign`.
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
    "A7b": "road_narrows_left", "A7c": "road_narrows_right", "B13": "end_priority_road",
    "C5-C7-C9": "no_motor_vehicles",
    "C31a": "no_left_turn", "C31g": "no_left_turn", "C31d": "no_right_turn", "C47": "toll", "D05": "roundabout",
    "D1a": "direction_ahead", "E9a": "parking", "E9f": "parking_on_sidewalk", "E9g": "parking", "E11":
    "alternate_parking", "F13": "lane_arrangement", "F15": "lane_arrangement", "F21": "pass_either_side",
    "F39": "direction_sign", "F47": "end_road_works", "F50bis": "bicycle_crossing", "F59": "parking", "F62": "service",
    "F81": "lanes_merge", "F85": "two_way_traffic", "F91": "lane_arrangement", "F95": "escape_lane",
    "F98": "emergency_bay",
}  # fmt: skip
AUSTRIA = {
    "50.2a": "curve_right", "50.2b": "curve_left", "50.2c": "double_curve_right", "50.2d": "double_curve_left",
    "50.4": "priority_at_next", "50.6c-1l": "level_crossing_approach", "50.7": "steep_descent", "50.7a": "steep_ascent",
    "50.8b": "road_narrows_left", "50.8c": "road_narrows_right", "50.10a": "crosswind", "50.10b": "falling_rocks",
    "50.10c": "aircraft", "50.13a": "domestic_animals", "50.13b": "wild_animals", "52.3a": "no_left_turn",
    "52.3b": "no_right_turn", "52.6a": "no_cars", "52.6b": "no_motorcycles", "52.6c": "no_motor_vehicles",
    "52.7c": "no_animal_carts", "52.7d": "no_dangerous_goods", "52.8a": "no_bicycles_mopeds", "52.8b": "no_mopeds",
    "52.8c": "no_bicycles", "52.13c-a": "alternate_parking", "52.14": "no_horn", "52.14a": "no_riding",
    "52.14b": "no_pedestrians", "52.16a": "end_cycleway", "52.17c": "end_footway", "52.17a-b": "segregated_path",
    "52.19a": "end_minimum_speed", "52.21": "u_turn_only", "52.22": "snow_chains", "53.2c": "pedestrian_crossing",
    "53.7a": "priority_over_oncoming", "53.13b": "direction_sign", "53.24": "buses_only", "53.26": "cycle_street",
    "53.27": "cycleway", "53.28a": "shared_path", "53.28b": "segregated_path",
}  # fmt: skip
POLAND = {
    "A-1": "curve_right", "A-3": "double_curve_right", "A-6b": "side_road", "A-9": "level_crossing_gated",
    "A-12b": "road_narrows_right", "A-22": "steep_descent", "A-27": "quay", "B-3": "no_cars",
    "B-3/4": "no_motor_vehicles", "B-3-4-10": "no_motor_vehicles", "B-6-8": "no_tractors", "B-12": "no_handcarts",
    "B-13": "no_explosives", "B-13a": "no_dangerous_goods", "B-19": "axle_load_limit", "B-20": "stop",
    "B-21": "no_left_turn", "B-32": "customs_stop", "B-32a": "checkpoint_stop", "B-37": "alternate_parking",
    "B-42": "end_all_restrictions", "C-1": "turn_right_here", "C-2": "turn_right_ahead", "C-13-16": "shared_path",
    "D-5": "priority_over_oncoming", "D-11": "bus_lane", "D-13": "lane_arrangement", "D-14": "lane_arrangement",
    "D-44": "parking_zone", "D-46": "internal_road", "D-47": "end_internal_road", "D-52": "traffic_zone",
    "D-53": "end_traffic_zone", "D-54": "environmental_zone", "D-55": "end_environmental_zone",
}  # fmt: skip
AUSTRALIA = {
    "R1-1": "stop", "R1-3": "roundabout", "R2-2(L)": "one_way", "R2-3": "keep_left", "R2-3(R)": "keep_right",
    "R2-6(L)": "no_left_turn", "R2-7": "straight_only", "R2-9(L)": "lane_use", "R2-11": "two_way_traffic",
    "R2-14(R)": "turn_right_ahead", "R4-4": "living_street", "R4-5": "end_living_street", "R4-8": "speed_zone",
    "R4-9": "end_speed_zone", "R4-12": "end_speed_limit", "R4-13": "end_speed_zone", "R5-2/2": "parking",
    "R5-16": "parking", "R5-23": "loading_place", "R5-35": "no_stopping", "R5-40": "no_parking", "R5-50": "no_stopping",
    "R5-61": "parking_zone", "R5-63": "end_parking_zone", "R5-80": "no_parking_zone", "R5-83": "end_no_parking_zone",
    "R5-85(L)": "emergency_bay", "R6-1": "no_overtaking", "R6-3": "weight_limit", "R6-10-3": "no_bicycles",
    "R6-11": "height_limit", "R6-13": "no_pedestrians_bicycles", "R6-15": "no_pedestrians", "R6-19": "motorway",
    "R6-21": "end_motorway", "R6-25": "level_crossing_cross", "R6-33": "length_limit", "R7-1-1": "bus_lane",
    "R7-1-4": "cycle_lane", "R7-4": "plate_other", "R7-7-1": "preferential_lane", "R8-2": "shared_path",
    "R9-1-1": "plate_time", "R9-4": "plate_except", "W1-7(L)": "curve_left", "W1-2": "double_curve",
    "W2-8": "side_road", "W3-3-1": "warn_traffic_signals", "W3-4-1": "bump", "W4-3": "road_narrows",
    "W4-4": "divided_road", "W4-8": "height_limit", "W4-11": "two_way_traffic", "W5-6": "floodway",
    "W5-19": "pavement_ends", "W5-34(L)": "lanes_merge", "W5-41": "warn_tram", "W6-2": "warn_pedestrian_crossing",
    "W7-8": "level_crossing_approach", "W7-15": "level_crossing_gated", "W8-2": "plate_advisory_speed",
    "W8-5": "plate_distance", "W8-7": "plate_other",
}  # fmt: skip
BRAZIL = {
    "A-1a": "curve_left", "A-4b": "double_curve_right", "A-20a": "steep_descent", "A-21b": "road_narrows_left",
    "A-26b": "two_way_traffic", "A-32a": "warn_pedestrians", "A-39": "level_crossing_open", "A-42c": "divided_road",
    "A-46": "weight_limit", "A-47": "axle_load_limit", "A-48": "length_limit", "R-15": "height_limit",
    "R-16": "width_limit", "R-24a": "one_way", "R-36a": "segregated_path_cycle_left",
    "R-36b": "segregated_path_cycle_right", "R-46": "shared_path",
}  # fmt: skip
GERMANY = {
    "277": "no_overtaking_trucks", "277.1": "no_overtaking_two_wheelers", "281.1": "end_no_overtaking_two_wheelers",
    "223.1": "lane_use", "223.3-51": "lane_use", "342": "wait_line", "350.1": "cycle_highway",
    "350.2": "end_cycle_highway", "354": "water_protection_area", "359": "service", "264": "width_limit",
    "265-3,8": "height_limit", "525-31": "lane_arrangement",
}  # fmt: skip
UNITED_STATES = {
    "R3-1": "no_right_turn",
    "R3-2": "no_left_turn",
    "R3-4": "no_u_turn",
    "R3-17": "cycle_lane",
    "R4-1": "no_overtaking",
    "R4-2": "end_no_overtaking",
    "R4-7a": "keep_right",
    "R4-8": "keep_left",
    "R5-1": "no_entry",
    "R5-2": "no_trucks",
    "R5-3": "no_motor_vehicles",
    "R5-6": "no_bicycles",
    "R5-8": "no_motorcycles",
    "R5-10b": "no_pedestrians_bicycles",
    "R5-10c": "no_pedestrians",
    "R6-2": "one_way",
    "R8-5": "no_stopping",
    "R9-14": "no_riding",
    "R9-15": "no_snowmobiles",
    "W8-2": "uneven_road",
    "R1-5b": "pedestrian_crossing",
    "R1-9a": "pedestrian_crossing",
    "R2-13": "end_speed_limit",
    "R3-1c": "no_right_turn",
    "R3-3": "no_turns",
    "R3-5": "lane_use",
    "R3-5L": "turn_left_ahead",
    "R3-5a": "straight_only",
    "R3-5bP": "plate_other",
    "R3-7R": "lane_use",
    "R3-7bP": "plate_except",
    "R3-9b": "lane_use",
    "R3-14": "preferential_lane",
    "R3-27": "no_straight",
    "R4-10": "escape_lane",
    "R4-16": "lane_use",
    "R5-1a": "no_entry",
    "R5-2b": "no_trucks",
    "R5-10": "no_pedestrians_bicycles_mopeds",
    "R6-3": "divided_road",
    "R6-6": "one_way",
    "R7-8": "parking",
    "R7-8aP": "plate_other",
    "R7-107a": "no_parking",
    "R8-3a": "no_parking",
    "R9-3": "no_pedestrians",
    "R10-11": "regulatory_text",
    "R10-18": "speed_camera",
    "R10-19P": "plate_other",
    "R11-3a": "no_vehicles",
    "R12-2": "axle_load_limit",
    "R14-2": "direction_sign",
    "R15-1": "level_crossing_cross",
    "R15-2P": "plate_other",
    "S1-1": "children",
    "S4-3P": "plate_other",
    "S4-5": "speed_limit_ahead",
    "S5-1": "speed_zone",
    "W1-4": "double_curve",
    "W1-10b": "curve",
    "W2-4": "side_road",
    "W3-5": "speed_limit_ahead",
    "W3-6": "movable_bridge",
    "W4-2R": "lanes_merge",
    "W5-3": "road_narrows",
    "W6-1": "divided_road",
    "W7-4b": "escape_lane",
    "W8-3": "pavement_ends",
    "W8-8": "uneven_road",
    "W8-17": "soft_verge",
    "W8-17P": "plate_other",
    "W8-26": "dead_end",
    "W9-4": "lanes_merge",
    "W10-3": "level_crossing_approach",
    "W11-15": "warn_cyclists",
    "W13-1P": "plate_advisory_speed",
    "W13-2": "advisory_speed_warning",
    "W14-2a": "dead_end",
    "W16-7P": "plate_arrow",
    "W16-20P": "plate_except",
    "W19-3": "end_motorway",
    "W20-1": "road_works",
    "W20-7": "road_works",
    "W26-1": "traffic_queue",
    "OM3-L": "hazard_board",
    "D9-7": "service",
    "D10-2a": "location_marker",
    "D11-1": "direction_sign",
    "D11-1bP": "plate_other",
    "G20-2": "end_road_works",
    "M1-1": "direction_sign",
}
NETHERLANDS = {
    "A1": "speed_limit",
    "A2": "end_speed_limit",
    "A4": "advisory_speed",
    "B1": "priority_road",
    "B05": "priority_at_next",
    "B6": "yield",
    "B7": "stop",
    "C1": "no_vehicles",
    "C2": "no_entry",
    "C3": "one_way",
    "C6": "no_cars",
    "C12": "no_motor_vehicles",
    "C15": "no_bicycles_mopeds",
    "C20": "axle_load_limit",
    "C22a": "environmental_zone",
    "D1": "roundabout",
    "D2": "pass_on_shown_side",
    "D3": "pass_either_side",
    "E1": "no_parking",
    "E2": "no_stopping",
    "E5": "taxi_rank",
    "E8": "parking",
    "F1": "no_overtaking",
    "F5": "yield_to_oncoming",
    "F6": "priority_over_oncoming",
    "F7": "no_u_turn",
    "F13": "bus_lane",
    "G1": "motorway",
    "G5": "living_street",
    "G11": "cycleway",
    "G12": "end_cycleway",
    "H1": "built_up_area",
    "J1": "uneven_road",
    "J16": "road_works",
    "J38": "bump",
    "K6": "direction_sign",
    "L2": "pedestrian_crossing",
    "L8": "dead_end",
    "OB501": "plate_other",
}
SWITZERLAND = {
    "1.01": "curve_right", "1.13a": "falling_rocks", "1.22": "warn_pedestrian_crossing", "2.02": "no_entry", "2.14":
    "no_motor_vehicles", "2.30": "speed_limit", "2.34": "keep_right", "2.41.1": "roundabout", "2.43": "no_left_turn",
    "2.49": "no_stopping", "2.50": "no_parking", "2.53": "end_speed_limit", "2.59.1": "speed_zone", "2.59.2e":
    "end_no_parking_zone", "2.59.5a": "living_street", "2.60": "cycleway", "2.63": "segregated_path", "2.63.1":
    "shared_path", "3.01": "stop", "3.02": "yield", "3.03": "priority_road", "3.06": "priority_to_right", "4.01":
    "motorway", "4.08": "one_way", "4.11": "pedestrian_crossing", "4.17": "parking", "4.24": "escape_lane",
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
        ("stvo-at", "AT", AUSTRIA),
        ("pl", "PL", POLAND),
        ("as1742", "AU", AUSTRALIA),
        ("contran", "BR", BRAZIL),
        ("stvo", "DE", GERMANY),
        ("rvv", "NL", NETHERLANDS),
        ("ssv", "CH", SWITZERLAND),
        ("", "FI", FINLAND_2020),
        ("", "FI", FINLAND_1982),
        ("osm", "", OSM_WORDS),
    )
    for code, concept in codes.items()
]


@pytest.mark.parametrize(("scheme", "country", "code", "concept"), CASES)
def test_a_code_means_what_the_list_says(scheme, country, code, concept):
    assert load_taxonomy().meaning(code, country=country, scheme=scheme).concept == concept


@pytest.mark.parametrize(
    ("scheme", "code"),
    [
        ("vienna", "D,10a"),
        ("be", "D8"),
        ("be", "D6"),
        ("be", "A18"),
        ("stvo-at", "50.7b"),
        ("stvo-at", "52.15a"),
        ("stvo-at", "52.22a"),
        ("stvo-at", "53.12"),
        ("pl", "D-20"),
        ("pl", "D-51b"),
        ("pl", "A-T-1"),
        ("as1742", "R5-51"),
        ("as1742", "R6-8"),
    ],
)
def test_what_is_no_such_sign_is_not_known(scheme, code):
    assert not load_taxonomy().meaning(code, scheme=scheme).known


@pytest.mark.parametrize(
    ("country", "code", "sign_class"),
    [
        ("US", "W12-2[12'6\"]", "height_limit:12.5ft"), ("US", "W12-2[12'-6\"]", "height_limit:12.5ft"),
        ("US", "W12-2a[13 ft 6 in]", "height_limit:13.5ft"), ("US", "W12-2[13]", "height_limit:13ft"),
        ("US", "R12-1[10]", "weight_limit:10st"), ("US", "R12-1[20000 lbs]", "weight_limit:20000lbs"),
        ("US", "R2-1[40 km/h]", "speed_limit:40"), ("US", "R2-1-35", "speed_limit:35mph"),
        ("US", "W13-1P[35]", "plate_advisory_speed:35mph"), ("US", "W16-2aP[500]", "plate_distance:500ft"),
        ("US", "S5-1[20]", "speed_zone:20mph"), ("US", "W3-5[45]", "speed_limit_ahead:45mph"),
        ("GB", "maxheight[14'9\"]", "height_limit:14.75ft"), ("", "maxspeed[20 mph]", "speed_limit:20mph"),
        ("BE", "C21[3500 kg]", "weight_limit:3500kg"), ("BE", "C43[50]", "speed_limit:50"),
        ("DE", "1001[2 km]", "plate_length:2km"), ("DE", "265[3,8 m]", "height_limit:3.8"),
        ("DE", "262[55 kN]", "weight_limit"), ("DE", "274[30 @ (22:00-06:00)]", "speed_limit:30"),
        ("NL", "A1[30]", "speed_limit:30"), ("NL", "A1-50", "speed_limit:50"), ("NL", "A0130zb", "speed_zone:30"),
        ("NL", "A01100", "speed_limit:100"), ("CH", "2.30[80]", "speed_limit:80"),
        ("CH", "2.59.1[30]", "speed_zone:30"),
        ("FR", "B14[50]", "speed_limit:50"), ("FI", "361[50]", "speed_limit:50"), ("DE", "274-30", "speed_limit:30"),
    ],
)  # fmt: skip
def test_a_number_has_the_unit_of_its_sign(country, code, sign_class):
    assert load_taxonomy().meaning(code, country=country).sign_class == sign_class


def test_plates_of_the_united_states_are_no_main_signs():
    """The designations of plaques end in P; two signs are plaques by design only."""
    taxonomy = load_taxonomy()
    plaques = (
        "R1-2aP R2-4P R3-5gP R3-9cP R5-2aP R7-8aP R7-201P R9-3bP R10-20aP R15-2P W3-5aP W4-4P W7-3bP W8-5bP W10-1aP"
    )
    plaques += " W11-12P W13-1P W16-1P W16-2P W16-4P W16-9P W16-13P S4-1P D9-6P D12-1bP M2-1P G20-5aP"
    assert {code for code in plaques.split() if taxonomy.meaning(code, country="US").kind != "plate"} == set()
    assert taxonomy.meaning("R6-5P", country="US").concept == "roundabout"
