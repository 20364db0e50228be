from __future__ import annotations

import bz2
import contextlib
import gzip
import random
from collections import Counter

import numpy as np
import pytest
import shapely
from pyproj import Geod

from geofleet.errors import ConfigError, InputError
from geofleet.formats import layers
from geofleet.formats.lanelet2 import is_lanelet2, read_lanes, read_signs
from geofleet.formats.lanelet2_lanes import parse_speed_kmh
from geofleet.tables.store import lonlat

GEOD = Geod(ellps="WGS84")

# Mean of the points of every traffic_sign way in the map that lanelet2 1.2.3 loads (io.loadRobust) with a UtmProjector
# of origin 49.0 N 8.42 E, each point taken back to degrees with projector.reverse
ORACLE = {
    "44952": ("de274_1", 8.4231577163, 49.0110361179),
    "44954": ("de301", 8.4231171826, 49.0110579336),
    "44956": ("de205", 8.4233215762, 49.0110237734),
    "49669": ("de205", 8.4157457528, 49.0053904793),
    "57654": ("de205", 8.4156460639, 49.0054192153),
    "81723": ("de301", 8.4159057265, 49.0051745844),
    "81735": ("de301", 8.4159566257, 49.0052763853),
    "85773": ("de205", 8.4155100717, 49.0049507931),
    "85824": ("de205", 8.4156068526, 49.0049315250),
    "85842": ("de301", 8.4152116114, 49.0051006572),
    "85900": ("de301", 8.4152521378, 49.0051918863),
}


@pytest.fixture
def fzi(shared_data):
    return shared_data / "lanelet2" / "fzi_mapping_example.osm"


@pytest.fixture
def roosi(shared_data):
    return shared_data / "lanelet2" / "roosi.osm"


def rows_of(layer):
    return {row["sign_id"]: row for row in layer.table.drop_columns(["geometry"]).to_pylist()}


# A road of 100 m to the north of 49 N 8 E, three metres wide, with one sign across it at its end
def small_map(*, sign="", lanelet="", rules="", nodes="", extra="", node_ids=("1", "2", "3", "4", "5", "6")):
    east = 3.0 / (111_320.0 * np.cos(np.radians(49.0)))
    places = [(0.0, 0.0), (0.0, 9e-4), (east, 0.0), (east, 9e-4), (2 * east, 8e-4), (2.2 * east, 8e-4)]
    points = "".join(
        f'<node id="{i}" lat="{49 + dy:.10f}" lon="{8 + dx:.10f}"/>'
        for i, (dx, dy) in zip(node_ids, places, strict=True)
    )
    a, b, c, d, e, f = node_ids
    stop = '<tag k="type" v="traffic_sign"/><tag k="subtype" v="usR1-1"/>'
    rule = '<tag k="type" v="regulatory_element"/><tag k="subtype" v="traffic_sign"/>'
    return (
        '<?xml version="1.0"?><osm version="0.6">' + (nodes or points)
        + f'<way id="10"><nd ref="{a}"/><nd ref="{b}"/></way><way id="11"><nd ref="{c}"/><nd ref="{d}"/></way>'
        + (sign or f'<way id="12"><nd ref="{e}"/><nd ref="{f}"/>{stop}</way>')
        + '<relation id="20"><member type="way" ref="10" role="left"/><member type="way" ref="11" role="right"/>'
        + (lanelet or '<member type="relation" ref="30" role="regulatory_element"/><tag k="subtype" v="road"/>')
        + '<tag k="type" v="lanelet"/></relation>'
        + (rules or f'<relation id="30"><member type="way" ref="12" role="refers"/>{rule}</relation>')
        + extra + "</osm>"
    )  # fmt: skip


@pytest.fixture
def write(tmp_path):
    def make(text, name="map.osm"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return make


def assert_reads_or_says_why(reader, path):
    """Any error but an InputError that names the file fails the test."""
    with contextlib.suppress(InputError), explained_by(path):
        reader(path)


@contextlib.contextmanager
def explained_by(path):
    try:
        yield
    except InputError as error:
        if str(path) not in str(error):
            pytest.fail(f"the message does not name the file: {error}")
        raise


def test_signs_of_the_fzi_map_stand_where_lanelet2_puts_them(fzi):
    layer = read_signs(fzi)
    signs = {key: row for key, row in rows_of(layer).items() if row["kind"] == "main"}
    assert {key[1:]: row["raw_code"] for key, row in signs.items()} == {key: code for key, (code, *_) in ORACLE.items()}
    for key, (_, lon, lat) in ORACLE.items():
        box = signs[f"w{key}"]["bbox"]
        assert GEOD.inv(box["xmin"], box["ymin"], lon, lat)[2] < 1e-3
        assert signs[f"w{key}"]["source_ref"] == f"way/{key}"
    assert layer.skipped == {"deleted elements": 1}


def drawn_map(draw):
    """Return a map of a few winding lanelets in some direction, each with a sign of one to four points."""
    nodes, ways, relations = [], [], []

    def line(number, points, tags=""):
        first = len(nodes) + 1
        nodes.extend(points)
        refs = "".join(f'<nd ref="{n}"/>' for n in range(first, len(nodes) + 1))
        ways.append(f'<way id="{number}">{refs}{tags}</way>')

    for lane in range(draw.randint(1, 5)):
        course, width = draw.uniform(0, 2 * np.pi), draw.uniform(2, 5)
        n = draw.randint(2, 12)
        along = np.cumsum([draw.uniform(1, 20) for _ in range(n)])
        across = np.cumsum([draw.uniform(-0.5, 0.5) for _ in range(n)])
        for side in (0, 1):
            x, y = along * np.cos(course) - (across - side * width) * np.sin(course), along * np.sin(course)
            y = y + (across - side * width) * np.cos(course)
            places = [(49.01 + b / 111_200 + lane * 1e-3, 8.42 + a / 73_000) for a, b in zip(x, y, strict=True)]
            line(1_000 + 10 * lane + side, places[:: draw.choice((1, 1, 2))] if n > 4 else places)
        sign = '<tag k="type" v="traffic_sign"/><tag k="subtype" v="de205"/>'
        line(1_005 + 10 * lane, [(a + 1e-6 * k, o + 2e-6 * k) for k, (a, o) in enumerate(places[-3:])], sign)
        sides = f'<member type="way" ref="{1_000 + 10 * lane}" role="left"/>'
        sides += f'<member type="way" ref="{1_001 + 10 * lane}" role="right"/>'
        relations.append(
            f'<relation id="{2_000 + lane}">{sides}<tag k="type" v="lanelet"/><tag k="subtype" v="road"/></relation>'
        )
    points = "".join(f'<node id="{n + 1}" lat="{lat:.11f}" lon="{lon:.11f}"/>' for n, (lat, lon) in enumerate(nodes))
    return f'<osm version="0.6">{points}{"".join(ways)}{"".join(relations)}</osm>'


@pytest.mark.parametrize("seed", range(12))
def test_a_drawn_map_agrees_with_the_lanelet2_package(seed, write):
    path = write(drawn_map(random.Random(seed)))  # noqa: S311 - not a secret
    map_, projector = agrees_with_the_package(path)
    signs = rows_of(read_signs(path))
    theirs = [way for way in map_.lineStringLayer if dict(way.attributes).get("type") == "traffic_sign"]
    assert len(theirs) == len(signs) > 0
    for way in theirs:
        degrees = [projector.reverse(lanelet2_point(one)) for one in way]
        lon, lat = np.mean([(one.lon, one.lat) for one in degrees], axis=0)
        box = signs[f"w{way.id}"]["bbox"]
        assert GEOD.inv(box["xmin"], box["ymin"], lon, lat)[2] < 1e-3


def test_the_whole_fzi_map_agrees_with_the_lanelet2_package(fzi):
    agrees_with_the_package(fzi)


def lanelet2_point(point):
    return pytest.importorskip("lanelet2").core.BasicPoint3d(point.x, point.y, 0)


def agrees_with_the_package(path):
    lanelet2 = pytest.importorskip("lanelet2", reason="the oracle is not installed")
    projector = lanelet2.projection.UtmProjector(lanelet2.io.Origin(49.0, 8.42))
    map_, _ = lanelet2.io.loadRobust(str(path), projector)
    lanes = dict(zip(*(read_lanes(path).table[name].to_pylist() for name in ("lane_id", "geometry")), strict=True))
    assert len(list(map_.laneletLayer)) > 0
    for lanelet in map_.laneletLayer:
        line = shapely.get_coordinates(shapely.from_wkb(lanes[f"r{lanelet.id}"]))
        centre = list(lanelet.centerline)
        for ours, theirs in ((line[0], centre[0]), (line[-1], centre[-1])):
            place = projector.reverse(lanelet2_point(theirs))
            assert GEOD.inv(*ours, place.lon, place.lat)[2] < 1e-3
    return map_, projector


def test_counts_of_the_fzi_map(fzi):
    layer = read_signs(fzi)
    counted = Counter(zip(layer.table["kind"].to_pylist(), layer.table["sign_class"].to_pylist(), strict=True))
    assert counted == {
        ("main", "priority_at_next"): 5,
        ("main", "yield"): 5,
        ("main", "speed_zone"): 1,
        ("light", "traffic_light"): 10,
        ("marking", "stop_line"): 28,
        ("marking", "zebra_marking"): 8,
    }
    assert set(layer.table.filter(layer.table["kind"].to_numpy() == "main")["country"].to_pylist()) == {"DE"}
    assert layer.table["height_m"].null_count == layer.table.num_rows


def test_lanes_of_the_fzi_map(fzi):
    table = read_lanes(fzi).table
    kinds = Counter(table["kind"].to_pylist())
    assert kinds == {"road": 337, "highway": 8, "bicycle_lane": 14, "crosswalk": 8, "rail": 2, "walkway": 2}
    lines = shapely.from_wkb(table["geometry"].to_numpy(zero_copy_only=False))
    drivable = [
        line for line, kind in zip(lines, table["kind"].to_pylist(), strict=True) if kind in {"road", "highway"}
    ]
    # lanelet2.geometry.length2d sums to 5031.92 m over the same 345 lanelets, along its own centre lines in UTM
    assert sum(GEOD.geometry_length(line) for line in drivable) == pytest.approx(5031.92, rel=1e-3)


def test_facings_of_the_fzi_map_are_known_for_signs_in_a_regulatory_element_only(fzi):
    rows = rows_of(read_signs(fzi))
    known = {
        key: row["facing_deg"] for key, row in rows.items() if row["kind"] == "main" and row["facing_deg"] is not None
    }
    assert known.keys() == {"w81723", "w81735", "w85773", "w85824"}
    assert known["w85773"] == pytest.approx(199.7, abs=0.1)
    assert rows["w85773"]["road_id"] == "r45014"  # a lanelet that has to yield, as the sign tells its drivers
    assert rows["w81723"]["road_id"] == "r45070"  # one that has the right of way


def test_counts_of_the_roosi_map(roosi):
    layer = read_signs(roosi)
    counted = Counter(zip(layer.table["kind"].to_pylist(), layer.table["concept"].to_pylist(), strict=True))
    assert counted == {
        ("main", "stop"): 5,
        ("light", "traffic_light"): 26,
        ("marking", "stop_line"): 30,
        ("marking", "zebra_marking"): 72,
    }
    rows = rows_of(layer).values()
    assert all(row["facing_deg"] is not None for row in rows if row["kind"] in {"main", "light"})
    # ele of the lights above an otherwise flat map; the stop signs are drawn on the ground
    assert {row["height_m"] for row in rows if row["kind"] == "light"} <= {2.3, 2.6, 2.8, 3.0}
    assert {row["height_m"] for row in rows if row["kind"] != "light"} == {None}
    lanes = read_lanes(roosi).table
    assert lanes.num_rows == 633
    assert set(lanes["speed_limit_kmh"].drop_null().to_pylist()) <= {20.0, 30.0, 40.0, 50.0}
    assert lanes["speed_limit_kmh"].null_count == 36


def test_local_coordinates_with_their_projection_give_the_same_place(roosi):
    # local_x and local_y of this map are Estonian national coordinates minus a round number
    local, degrees = (read_signs(roosi, utm=("EPSG:3301", 650_000.0, 6_465_000.0)), read_signs(roosi))
    assert local.table["sign_id"].equals(degrees.table["sign_id"])
    assert GEOD.inv(*lonlat(local.table), *lonlat(degrees.table))[2].max() < 1e-3
    assert not local.found


def test_local_coordinates_in_the_wrong_place_are_told(roosi):
    found = read_signs(roosi, utm=("EPSG:3301", 652_000.0, 6_465_000.0)).found
    assert found == {"nodes whose lat/lon lie over 1 m from where local_x/local_y put them": 6166}


@pytest.mark.parametrize("place", ['lat="" lon=""', 'lat="0" lon="0"', ""])
def test_local_coordinates_need_an_origin(write, place):
    nodes = "".join(
        f'<node id="{i}" {place}><tag k="local_x" v="{x}"/><tag k="local_y" v="{y}"/></node>'
        for i, x, y in ((1, 0, 0), (2, 0, 100), (3, 3, 0), (4, 3, 100), (5, 6, 90), (6, 6.6, 90))
    )
    path = write(small_map(nodes=nodes))
    with pytest.raises(InputError, match=r"local_x and local_y only.*--origin"):
        read_signs(path)
    layer = read_signs(path, origin=(49.0, 8.0))
    lon, lat = lonlat(layer.table)
    azimuth, _, distance_m = GEOD.inv(8.0, 49.0, lon[0], lat[0])
    assert distance_m == pytest.approx(np.hypot(6.3, 90.0), rel=5e-4)  # UTM scale 0.9996 and grid north
    assert azimuth == pytest.approx(np.degrees(np.arctan2(6.3, 90.0)), abs=1.0)


@pytest.mark.parametrize(
    "options",
    [
        {"origin": (49.0, 8.0), "utm": ("EPSG:32632", 0.0, 0.0)},
        {"origin": (149.0, 8.0)},
        {"utm": ("EPSG:999999", 0.0, 0.0)},
        {"utm": ("EPSG:4326", 0.0, 0.0)},
    ],
)
def test_projections_that_make_no_sense_are_refused(write, options):
    with pytest.raises(ConfigError):
        read_signs(write(small_map()), **options)


def test_a_sign_faces_the_traffic_of_the_lanelet_it_addresses(write):
    (row,) = rows_of(read_signs(write(small_map()))).values()
    assert row["concept"] == "stop"
    assert row["country"] == "US"
    assert row["road_id"] == "r20"
    assert row["facing_deg"] == pytest.approx(180.0, abs=0.01)  # traffic runs north


def test_a_lanelet_runs_so_that_its_left_bound_is_to_the_left(write):
    there = write(small_map())
    back = write(
        small_map()
        .replace('ref="10" role="left"', 'ref="10" role="right"')
        .replace('ref="11" role="right"', 'ref="11" role="left"'),
        "back.osm",
    )
    turned = write(small_map().replace('<nd ref="3"/><nd ref="4"/>', '<nd ref="4"/><nd ref="3"/>'), "turned.osm")
    (north,), (south,), (same,) = (
        shapely.from_wkb(read_lanes(path).table["geometry"].to_pylist()) for path in (there, back, turned)
    )
    assert north.coords[0][1] < north.coords[-1][1]
    assert list(south.coords) == list(north.coords)[::-1]
    assert list(same.coords) == list(north.coords)
    assert np.cos(np.radians(read_signs(back).table["facing_deg"][0].as_py())) == pytest.approx(1.0, abs=1e-6)


def test_a_sign_along_its_lane_or_outside_of_every_element_has_no_facing(write):
    along = small_map(
        sign='<way id="12"><nd ref="1"/><nd ref="2"/><tag k="type" v="traffic_sign"/><tag k="subtype" v="de205"/></way>'
    )
    layer = read_signs(write(along))
    assert layer.table["facing_deg"].null_count == 1
    assert layer.found == {"signs and lights whose line does not show which way they face": 1}
    free = read_signs(write(small_map(rules=" "), "free.osm"))
    assert free.table["facing_deg"].null_count == 1
    assert free.table["road_id"].null_count == 1


def test_signs_of_every_style(write):
    way = '<way id="{}"><nd ref="5"/><nd ref="6"/><tag k="type" v="traffic_sign"/><tag k="subtype" v="{}"/></way>'
    codes = ["de205", "de274_1", "usR1-1", "stop_sign", "de274-60", "zz99"]
    signs = "".join(way.format(100 + i, code) for i, code in enumerate(codes))
    bare = '<way id="200"><nd ref="5"/><tag k="type" v="traffic_sign"/></way><way id="201"><nd ref="6"/></way>'
    post = '<node id="7" lat="49.0005" lon="8"><tag k="type" v="traffic_sign"/><tag k="subtype" v="de206"/></node>'
    rule = (
        '<relation id="30"><member type="way" ref="201" role="refers"/><tag k="type" v="regulatory_element"/>'
        '<tag k="subtype" v="traffic_sign"/><tag k="sign_type" v="de301"/></relation>'
    )
    layer = read_signs(write(small_map(sign=signs + bare, rules=rule, extra=post)))
    rows = {key: (row["kind"], row["sign_class"], row["raw_code"]) for key, row in rows_of(layer).items()}
    assert rows == {
        "w100": ("main", "yield", "de205"),
        "w101": ("main", "speed_zone", "de274_1"),
        "w102": ("main", "stop", "usR1-1"),
        "w103": ("main", "stop", "stop_sign"),
        "w104": ("main", "speed_limit:60", "de274-60"),
        "w105": ("main", "raw:zz99", "zz99"),
        "w200": ("other", "unspecified", ""),
        "w201": ("main", "priority_at_next", "de301"),
        "n7": ("main", "stop", "de206"),
    }
    shapeless = "signs and lights whose line does not show which way they face"  # way 201 is one point
    assert layer.found == {"unknown codes": 1, "signs without a code": 1, shapeless: 1}


@pytest.mark.parametrize("first", [-9, 9037740909199276460])
def test_ids_are_text(write, first):
    ids = tuple(str(first + i) for i in range(6))
    text = small_map(node_ids=ids).replace('id="20"', f'id="{first}"').replace("12", str(first + 3))
    assert rows_of(read_signs(write(text))).keys() == {f"w{first + 3}"}
    assert read_lanes(write(text)).table["lane_id"].to_pylist() == [f"r{first}"]


@pytest.mark.parametrize(
    ("lanelet", "rules", "expected"),
    [
        ('<tag k="speed_limit" v="40"/>', " ", 40.0),
        ('<tag k="speed_limit" v="30 mph"/>', " ", 48.28032),
        ("", '<member type="way" ref="12" role="refers"/>', 60.0),
        ("", '<tag k="sign_type" v="50 km/h"/>', 50.0),
        ("", '<tag k="sign_type" v="de274-70"/>', 70.0),
        ("", "", None),
    ],
)
def test_speed_limits_from_the_tag_or_the_regulatory_element(write, lanelet, rules, expected):
    sign = (
        '<way id="12"><nd ref="5"/><nd ref="6"/><tag k="type" v="traffic_sign"/><tag k="subtype" v="de274-60"/></way>'
    )
    rule = (
        f'<relation id="30"><tag k="type" v="regulatory_element"/><tag k="subtype" v="speed_limit"/>{rules}</relation>'
    )
    path = write(
        small_map(
            sign=sign, rules=rule, lanelet=lanelet + '<member type="relation" ref="30" role="regulatory_element"/>'
        )
    )
    (speed,) = read_lanes(path).table["speed_limit_kmh"].to_pylist()
    assert speed == (None if expected is None else pytest.approx(expected))


def test_speeds_are_read_with_their_units():
    assert parse_speed_kmh("13.9 mps") == pytest.approx(50.04)
    assert np.isnan(parse_speed_kmh("fast"))
    assert np.isnan(parse_speed_kmh("-30"))


def test_broken_parts_are_counted(write):
    text = small_map(
        extra='<node id="1" lat="1" lon="1"/><node id="8" lat="NaN" lon="8"/><node id="9" lat="95" lon="8"/>'
        '<node lat="1" lon="1"/><way id="10"/>'
        '<way id="40"><nd ref="8"/><nd ref="77"/><tag k="type" v="traffic_sign"/></way>'
        '<relation id="50"><member type="way" ref="99" role="left"/><tag k="type" v="lanelet"/></relation>'
        '<relation id="50"><tag k="type" v="lanelet"/></relation><way id="41" action="delete"/>'
    )
    path = write(text)
    expected = {
        "nodes whose id the file has already": 1,
        "nodes without a valid position": 2,
        "elements without an id": 1,
        "ways whose id the file has already": 1,
        "traffic_sign ways without a valid point": 1,
        "relations whose id the file has already": 1,
        "deleted elements": 1,
    }
    layer = read_signs(path)
    assert layer.skipped == expected
    assert layer.found == {"nodes that ways refer to and the file does not hold": 1}
    assert read_lanes(path).skipped == expected | {"lanelets without a left and a right bound": 1}


def test_lanelet2_is_told_apart_from_openstreetmap(write, fzi, shared_data):
    assert is_lanelet2(fzi)
    assert is_lanelet2(write(small_map(rules=" ")))
    assert not is_lanelet2(shared_data / "osm" / "bautzen.osm")
    node = write('<osm><node id="1" lat="1" lon="1"><tag k="type" v="traffic_sign"/></node></osm>', "osm.osm")
    assert not is_lanelet2(node)
    way = write("<osm><way id='1'><tag v='traffic_sign' k='type'/></way></osm>", "way.osm")
    assert is_lanelet2(way)


def test_a_map_of_openstreetmap_is_refused(shared_data):
    with pytest.raises(InputError, match=r"bautzen\.osm: no lanelets.*--format osm"):
        read_signs(shared_data / "osm" / "bautzen.osm")


@pytest.mark.parametrize(
    ("name", "encode"),
    [
        ("map.osm.gz", lambda text: gzip.compress(text.encode())),
        ("map.osm.bz2", lambda text: bz2.compress(text.encode())),
        ("map.osm", lambda text: ("\ufeff" + text).encode()),
        ("map.osm", lambda text: text.replace('1.0"', '1.0" encoding="UTF-16"').encode("utf-16")),
    ],
)
def test_packed_or_in_another_encoding(tmp_path, name, encode):
    path = tmp_path / name
    path.write_bytes(encode(small_map()))
    assert layers.recognise(path) == "lanelet2"
    assert read_signs(path).table["sign_id"].to_pylist() == ["w12"]


def test_a_map_without_any_valid_position_is_refused(write):
    with pytest.raises(InputError, match="none of 6 nodes has a valid position"):
        read_signs(write(small_map().replace('lat="', 'lat="9')))


def test_a_map_without_signs_gives_an_empty_table(write):
    assert read_signs(write(small_map(sign=" ", rules=" "))).table.num_rows == 0


@pytest.mark.parametrize("reader", [read_signs, read_lanes, is_lanelet2])
@pytest.mark.parametrize(
    "text",
    [
        "",
        "not xml",
        "<osm>",
        "<gpx></gpx>",
        '<!DOCTYPE a [<!ENTITY b "c">]><osm><way id="1"><tag k="type" v="traffic_sign"/></way></osm>',
    ],
)
def test_what_is_no_map_is_refused(write, reader, text):
    path = write(text)
    if reader is is_lanelet2 and text and "DOCTYPE" not in text:
        assert not is_lanelet2(path)
        return
    with pytest.raises(InputError):
        reader(path)


def test_damaged_maps_never_give_another_error(fzi, tmp_path):
    whole = fzi.read_bytes()
    # The relations stand at the end: keep the file short and all kinds of elements in it
    whole = whole[:60_000] + whole[-120_000:]
    rng = random.Random(0)  # noqa: S311  (damage, not secrets)
    path = tmp_path / "damaged.osm"
    for _ in range(30):
        data = bytearray(whole[: rng.randrange(len(whole))])
        for _ in range(rng.randrange(20)):
            data[rng.randrange(len(data))] = rng.randrange(256)
        path.write_bytes(data)
        for reader in (is_lanelet2, read_signs, read_lanes):
            assert_reads_or_says_why(reader, path)


def test_damaged_numbers_and_references_never_give_another_error(write):
    rng = random.Random(1)  # noqa: S311  (as above)
    words = [
        "NaN",
        "inf",
        "1e400",
        "",
        "-",
        "1_0",
        "é",
        "99999999999999999999",
        "traffic_sign",
        "lanelet",
        "left",
        "30",
        "1",
    ]
    for turn in range(200):
        parts = small_map().split('"')
        for _ in range(rng.randrange(1, 6)):
            parts[rng.randrange(5, len(parts) // 2) * 2 + 1] = rng.choice(words)
        path = write('"'.join(parts), f"map{turn % 3}.osm")
        for reader in (is_lanelet2, read_signs, read_lanes):
            assert_reads_or_says_why(reader, path)
