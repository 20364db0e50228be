from __future__ import annotations

import bz2
import gzip
import re
from collections import Counter

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Geod, Transformer

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.road_geometry import reference_points
from geofleet.errors import ConfigError, InputError
from geofleet.formats import layers
from geofleet.formats.countries import country_code
from geofleet.formats.opendrive import detect, read_lanes, read_signs
from geofleet.formats.opendrive_signals import BEYOND, NO_ID, NO_NUMBER, NO_PLACE, NO_ROAD
from geofleet.formats.opendrive_xml import header_and_roads, read_road
from geofleet.formats.reading import read_head
from geofleet.tables.store import lonlat

ORIGIN = (48.76, 11.42)
FRAME = EnuFrame(11.42, 48.76)
UTM = "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs"
STRAIGHT = '<geometry s="0" x="0" y="0" hdg="0" length="200"><line/></geometry>'
LANES = """<lanes><laneSection s="0">
<left><lane id="1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></left>
<center><lane id="0" type="none"/></center>
<right><lane id="-1" type="driving"><width sOffset="0" a="3.5" b="0" c="0" d="0"/></lane></right>
</laneSection></lanes>"""


def road(*, plan=STRAIGHT, signals="", objects="", lanes="", extra="", road_id="7", length=200):
    return (
        f'<road id="{road_id}" length="{length}" junction="-1">{extra}<planView>{plan}</planView>{lanes}'
        f"<objects>{objects}</objects><signals>{signals}</signals></road>"
    )


def signal(signal_id="1", inside="", **attributes):
    given = {"s": 100, "t": -5, "zOffset": 2.5, "orientation": "+", "dynamic": "no", "country": "DE", "type": "205"}
    given |= {"subtype": "-1", "value": "-1"} | attributes
    text = " ".join(f'{name}="{value}"' for name, value in given.items() if value is not None)
    return f'<signal id="{signal_id}" {text}>{inside}</signal>'


def document(*roads, header="", namespace=""):
    return f'<OpenDRIVE{namespace}><header revMajor="1" revMinor="8">{header}</header>{"".join(roads)}</OpenDRIVE>'


@pytest.fixture
def path(tmp_path):
    def write(content):
        file = tmp_path / "map.xodr"
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        return file

    return write


@pytest.fixture
def signs(path):
    """Read signals of one document in the local frame at ORIGIN, as rows by id."""

    def read(*roads, **options):
        layer = read_signs(path(document(*roads)), **({"origin": ORIGIN} | options))
        return {row["sign_id"]: row | xy for row, xy in zip(layer.table.to_pylist(), metres(layer.table), strict=True)}

    return read


def metres(table, frame=FRAME):
    xy = frame.to_enu(*lonlat(table))
    return [{"x": x, "y": y} for x, y in xy.tolist()]


# ---- positions ----------------------------------------------------------------------------------------------------


def test_a_signal_stands_beside_its_road(signs):
    row = signs(road(signals=signal()))["1"]
    assert (row["x"], row["y"]) == pytest.approx((100, -5), abs=1e-4)
    assert row["facing_deg"] == pytest.approx(270, abs=0.01)  # traffic drives east, the face looks west
    assert (row["height_m"], row["road_id"], row["source_ref"], row["source"]) == (2.5, "7", "signal/1", "map.xodr")
    assert (row["kind"], row["sign_class"], row["raw_code"], row["country"]) == ("main", "yield", "205", "DE")


@pytest.mark.parametrize(
    ("orientation", "h_offset", "facing"),
    [("+", 0, 270), ("-", 0, 90), ("+", np.pi / 6, 240), ("-", -np.pi / 6, 120), ("none", 0, None), (None, 1, None)],
)
def test_facing_is_against_the_traffic_addressed(signs, orientation, h_offset, facing):
    row = signs(road(signals=signal(orientation=orientation, hOffset=h_offset)))["1"]
    assert row["facing_deg"] == (facing if facing is None else pytest.approx(facing, abs=0.01))


def test_facing_is_clockwise_from_true_north_not_from_the_grid(path):
    # Far from the central meridian grid north is 2.26° off: a road along the grid's x axis does not run east.
    header = f"<geoReference><![CDATA[{UTM}]]></geoReference>"
    plan = STRAIGHT.replace('x="0" y="0"', 'x="720000" y="5400000"')
    table = read_signs(path(document(road(plan=plan, signals=signal()), header=header))).table
    (lon,), (lat,) = lonlat(table)
    ahead = Transformer.from_crs(UTM, "OGC:CRS84", always_xy=True).transform(720110, 5399995)
    azimuth = Geod(ellps="WGS84").inv(lon, lat, *ahead)[0]
    assert table["facing_deg"].to_pylist()[0] == pytest.approx((azimuth + 180) % 360, abs=1e-3)
    assert abs(azimuth - 90) > 2


def test_superelevation_and_header_offset(path):
    tilt = '<lateralProfile><superelevation s="0" a="0.5" b="0" c="0" d="0"/></lateralProfile>'
    header = f"<geoReference>{UTM}</geoReference><offset x='680000' y='5400000' z='0' hdg='{np.pi / 2}'/>"
    table = read_signs(path(document(road(extra=tilt, signals=signal()), header=header))).table
    x, y = Transformer.from_crs("OGC:CRS84", UTM, always_xy=True).transform(*lonlat(table))
    assert (x[0], y[0]) == pytest.approx((680000 + 5 * np.cos(0.5), 5400100), abs=1e-4)


def test_a_place_of_its_own(signs):
    rows = signs(
        road(
            extra='<elevationProfile><elevation s="0" a="400" b="0" c="0" d="0"/></elevationProfile>',
            signals=signal("1", '<positionInertial x="30" y="40" z="402.5" hdg="0"/>')
            + signal("2", '<positionRoad roadId="8" s="10" t="2" zOffset="3" hOffset="0"/>')
            + signal("3", '<positionRoad roadId="9" s="10" t="2" zOffset="3" hOffset="0"/>'),
        ),
        road(road_id="8", plan=STRAIGHT.replace('hdg="0"', f'hdg="{np.pi / 2}"')),
    )
    assert (rows["1"]["x"], rows["1"]["y"]) == pytest.approx((30, 40), abs=1e-4)
    assert (rows["1"]["height_m"], rows["1"]["facing_deg"]) == pytest.approx((2.5, 270), abs=0.01)
    assert (rows["2"]["x"], rows["2"]["y"]) == pytest.approx((-2, 10), abs=1e-4)
    assert (rows["2"]["height_m"], rows["2"]["facing_deg"], rows["2"]["road_id"]) == pytest.approx((3, 180, "7"))
    assert "3" not in rows


# ---- what a signal is ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("attributes", "kind", "sign_class", "raw_code"),
    [
        ({"type": "274", "subtype": "120", "value": "120", "unit": "km/h"}, "main", "speed_limit:120", "274-120"),
        ({"type": "274", "subtype": "", "value": "50"}, "main", "speed_limit:50", "274[50]"),
        ({"type": "274", "subtype": "", "value": "3e1", "unit": "mph"}, "main", "speed_limit:30mph", "274[30 mph]"),
        ({"type": "274", "value": "25", "unit": "m/s"}, "main", "speed_limit:90", "274[90 km/h]"),
        ({"type": "274.1", "subtype": "20"}, "main", "speed_zone:20", "274.1-20"),
        ({"type": "274.1", "subtype": "20", "value": "30"}, "main", "speed_zone:30", "274.1-20[30]"),
        ({"type": "1004", "value": ".2", "unit": "km"}, "plate", "plate_distance:200", "1004[200 m]"),
        ({"type": "1042", "subtype": "33"}, "plate", "plate_time", "1042-33"),
        ({"type": "1042", "country": ""}, "plate", "raw:1042", "1042"),
        ({"type": "294"}, "marking", "stop_line", "294"),
        ({"type": "1000001", "country": "OpenDRIVE"}, "light", "traffic_light", "1000001"),
        ({"type": "-1", "dynamic": "yes", "name": "Wechselzeichen"}, "light", "raw:Wechselzeichen", "Wechselzeichen"),
        ({"type": "-1", "name": "Privat"}, "other", "raw:Privat", "Privat"),
        ({"type": None, "name": None}, "other", "raw:untyped", "untyped"),
        ({"type": "605", "subtype": "10"}, "main", "hazard_board", "605-10"),
        ({"type": "shi", "value": "50", "country": "cn"}, "main", "raw:shi[50]", "shi[50]"),
        ({"type": "205", "country": ""}, "main", "raw:205", "205"),
    ],
)  # fmt: skip
def test_kinds_and_classes(signs, attributes, kind, sign_class, raw_code):
    row = signs(road(signals=signal(**attributes)))["1"]
    assert (row["kind"], row["sign_class"], row["raw_code"]) == (kind, sign_class, raw_code)


def test_signals_without_a_country_can_be_given_one(signs):
    row = signs(road(signals=signal(country="")), country="DE")["1"]
    assert (row["sign_class"], row["country"]) == ("yield", "DE")


@pytest.mark.parametrize(("code", "found"), [("206", "stop"), ("274", "speed_limit:30"), ("1000001", "traffic_light")])
def test_signals_of_the_country_opendrive_have_the_numbers_of_the_stvo(signs, code, found):
    value = "30" if code == "274" else "-1"
    row = signs(road(signals=signal(country="OpenDRIVE", type=code, value=value)))["1"]
    assert (row["sign_class"], row["country"]) == (found, None)
    assert signs(road(signals=signal(country="", type="206")))["1"]["sign_class"] == "raw:206"


def test_the_revision_of_the_catalogue_is_kept(signs):
    assert signs(road(signals=signal(countryRevision="2017")))["1"]["country_revision"] == "2017"
    assert signs(road(signals=signal()))["1"]["country_revision"] is None


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("DE", "DE"), ("DEU", "DE"), ("Germany", "DE"), ("se", "SE"), ("cn", "CN"), ("USA", "US"), (" uk ", "GB"),
        ("Österreich", "AT"), ("", None), ("OpenDRIVE", None), ("-1", None),
    ],
)  # fmt: skip
def test_countries(text, code):
    assert country_code(text) == code


@pytest.mark.parametrize("link", ['<dependency id="{}" type="x"/>', '<reference elementType="signal" elementId="{}"/>'])
def test_plates_hang_on_their_main_sign(signs, link):
    rows = signs(
        road(
            signals=signal("1")
            + signal("2", link.format("1"), type="1042")  # the plate points at the sign
            + signal("3", link.format("4"))  # the sign points at the plate
            + signal("4", type="1042")
            + signal("5", link.format("2"), type="1012")  # a plate below a plate
            + signal("6", link.format("7"), type="1012")  # nothing there
            + signal("8", link.format("9"), type="1012")  # a circle
            + signal("9", link.format("8"), type="1012")
        )
    )
    parents = {name: row["parent_id"] for name, row in rows.items()}
    assert parents == dict.fromkeys("13689") | {"2": "1", "4": "3", "5": "1"}


def test_references_to_signals_are_counted_and_are_no_signs(path):
    again = '<signalReference s="1" t="0" id="1" orientation="+"/>'
    layer = read_signs(path(document(road(signals=signal() + again), road(road_id="8", signals=again))), origin=ORIGIN)
    assert (layer.table.num_rows, layer.found) == (1, {"signal references": 2})


def test_supports_are_poles_nearby_or_named(signs):
    poles = (
        '<object type="pole" id="p" s="100.2" t="-5.1"/><object type="pole" name="delineator" id="d" s="100" t="-5"/>'
    )
    named = '<reference elementType="object" elementId="gantry"/>'
    other = '<object type="pole" id="q" s="60" t="0"/><object type="tree" id="t" s="50" t="-5"/>'
    rows = signs(
        road(
            signals=signal("1") + signal("2", named) + signal("3", s=50) + signal("4", type="294"),
            objects=poles + other,
        )
    )
    assert {name: row["support_id"] for name, row in rows.items()} == {"1": "p", "2": "gantry", "3": None, "4": None}


def test_repeated_ids_stay_two_signs(signs):
    rows = signs(road(signals=signal("1") + signal("1", s=20) + signal("1-2", s=30)))
    assert {name: round(row["x"]) for name, row in rows.items()} == {"1": 100, "1-3": 20, "1-2": 30}


# ---- what is wrong with a file ------------------------------------------------------------------------------------


def test_signals_that_cannot_be_placed_are_counted(path):
    wrong = (
        signal("1", s="abc")
        + signal("2", t=None)
        + signal("3", s=500)
        + signal("", s=1)
        + signal("5", '<positionRoad roadId="9" s="10" t="2"/>')
        + signal("6", value="many")
        + signal("7", s="200.4")
    )
    layer = read_signs(path(document(road(signals=wrong))), origin=ORIGIN)
    assert layer.skipped == {NO_PLACE: 2, BEYOND: 1, NO_ID: 1, NO_ROAD: 1}
    assert layer.found == {NO_NUMBER: 1}
    assert layer.table["sign_id"].to_pylist() == ["6", "7"]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (road(plan=STRAIGHT.replace("<line/>", "<bezier/>")), 'road "7": unknown geometry: <bezier>'),
        (road(plan=STRAIGHT.replace("<line/>", "")), "unknown geometry: nothing"),
        (road(plan=STRAIGHT.replace('x="0"', 'x="zero"')), r'<geometry>, road "7": x="zero" is no number'),
        (road(plan=STRAIGHT.replace('hdg="0"', "")), "hdg is missing"),
        (road(plan=STRAIGHT.replace('length="200"', 'length="-2"')), "length=-2 is no length"),
        (road(plan=STRAIGHT.replace('length="200"', 'length="0"')), "the reference line has no length"),
        (road(plan=STRAIGHT.replace("<line/>", "<spiral curvStart='0'/>")), "curvEnd is missing"),
        (road(plan=STRAIGHT.replace('s="0"', 's="1e15"')), "s of the geometry goes beyond 200 km"),
        (road(length="long"), 'length="long" is no number'),
        (road(road_id=""), "id is missing"),
        (road() + road(), 'road "7": another road has the same id'),
        (road(plan=STRAIGHT.replace("<line/>", "<paramPoly3 pRange='all'/>")), 'pRange="all" is unknown'),
    ],
)
def test_roads_that_cannot_be_read_are_named(path, content, message):
    for read in (read_signs, read_lanes):
        with pytest.raises(InputError, match=message) as caught:
            read(path(document(content)), origin=ORIGIN)
        assert "map.xodr: line 1" in str(caught.value)


def test_lanes_that_cannot_be_read_are_named(path):
    for old, new, message in [
        ('a="3"', 'a="x"', 'line 2: <width>, road "7": a="x" is no number'),
        ('id="-1"', "", "id is missing"),
        ('a="3"', 'a="1e308"', 'road "7": the numbers of lane line 7/0/1 are too large'),
        ('laneSection s="0"', "laneSection", "<laneSection>.*s is missing"),
        ("<width", "<speed max='3' unit='knots'/><width", 'unit="knots" is unknown'),
    ]:
        assert old in LANES or old == "<width"
        with pytest.raises(InputError, match=message):
            read_lanes(path(document(road(lanes=LANES.replace(old, new, 1)))), origin=ORIGIN)


# ---- where it is --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        UTM,
        f"<![CDATA[{UTM}]]>",
        "EPSG:32632",
        "+init=epsg:32632",
        CRS.from_epsg(32632).to_wkt().replace("<", "&lt;").replace('"', "&quot;"),
        f"<![CDATA[{CRS.from_epsg(32632).to_json()}]]>",
        "+proj=tmerc +lat_0=0 +lon_0=9 +k=0.9996 +x_0=500000 +y_0=0 +datum=WGS84 +vunits=m +geoidgrids=egm96_5.gtx",
    ],
)
def test_every_form_of_geo_reference(path, text):
    plan = STRAIGHT.replace('x="0" y="0"', 'x="680000" y="5400000"')
    header = f"<geoReference>\n {text}\n</geoReference>"
    layer = read_signs(path(document(road(plan=plan, signals=signal()), header=header)))
    expected = Transformer.from_crs("EPSG:32632", "OGC:CRS84", always_xy=True).transform(680100, 5399995)
    np.testing.assert_allclose(np.concatenate(lonlat(layer.table)), expected, atol=1e-9)


def test_crs_option_takes_the_place_of_the_files_own(path):
    file = path(document(road(signals=signal()), header="<geoReference>nonsense</geoReference>"))
    crs = "+proj=tmerc +lat_0=48.76 +lon_0=11.42 +datum=WGS84"
    (row,) = metres(read_signs(file, crs=crs).table)
    assert (row["x"], row["y"]) == pytest.approx((100, -5), abs=1e-3)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "no geoReference. Give the projection with --crs .* or .* --origin"),
        ("+lat_0=49 +lon_0=8", r'"\+lat_0=49 \+lon_0=8" is not a projection: it has no \+proj=.*"\+proj=tmerc \+lat_0'),
        ("+proj=longlat +datum=WGS84", "is geographic, in degrees"),
        ("EPSG:4326", "is geographic, in degrees"),
        ("EPSG:4978", "geocentric"),
        ("PROJCS[", "not understood"),
        ("+proj=tmerc +lat_0=99", "not understood"),
        ("+proj=tmerc +lat_0=0 +lon_0=0", "Gulf of Guinea"),
        ('LOCAL_CS["here"]', "no projection of the Earth"),
    ],
)
def test_files_without_a_place(path, text, message):
    file = path(document(road(signals=signal()), header=f"<geoReference>{text}</geoReference>" if text else ""))
    with pytest.raises(InputError, match=message):
        read_signs(file)


@pytest.mark.parametrize(
    "options", [{"crs": "EPSG:1"}, {"origin": (91, 0)}, {"origin": (np.nan, 0)}, {"crs": UTM, "origin": ORIGIN}]
)
def test_options_that_are_no_place(path, options):
    with pytest.raises(ConfigError):
        read_signs(path(document(road(signals=signal()))), **options)


def test_coordinates_outside_of_the_projection(path):
    plan = STRAIGHT.replace('x="0"', 'x="1e12"')
    with pytest.raises(InputError, match="outside of the projection"):
        read_signs(path(document(road(plan=plan, signals=signal()))), crs=UTM)


# ---- forms of the file --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "wrap",
    [
        str.encode,
        lambda text: b"\xef\xbb\xbf<?xml version='1.0' encoding='utf-8'?>" + text.encode(),
        lambda text: b"<!-- exported -->\n<?xml version='1.0' standalone='yes'?>" + text.encode(),
        lambda text: gzip.compress(text.encode()),
        lambda text: f'<?xml version="1.0" encoding="utf-16"?>{text}'.encode("utf-16"),
        lambda text: text.replace("<OpenDRIVE", '<OpenDRIVE xmlns="http://code.asam.net/simulation/standard/opendrive"').encode(),
        lambda text: re.sub(r"<(/?)(\w)", r"<\1o:\2", text).replace("<o:OpenDRIVE", '<o:OpenDRIVE xmlns:o="http://o"').encode(),
    ],
)  # fmt: skip
def test_every_form_of_document(path, wrap):
    file = path(wrap(document(road(signals=signal(), lanes=LANES))))
    assert detect(read_head(file))
    assert read_signs(file, origin=ORIGIN).table.num_rows == 1
    assert read_lanes(file, origin=ORIGIN).table.num_rows == 6


@pytest.mark.parametrize(
    "head", [b"<osm version='0.6'/>", b"PAR1", b"<!-- <OpenDRIVE> --><map/>", b"", b"\x1f\x8b\x08"]
)
def test_other_files_are_not_taken_for_it(head):
    assert not detect(head)


def test_another_root_is_refused(path):
    with pytest.raises(InputError, match="root element is <osm>, not <OpenDRIVE>"):
        read_signs(path("<osm/>"))


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damaged_files_only_raise_input_errors(tmp_path_factory, data):
    spiral = '<geometry s="200" x="200" y="0" hdg="0" length="50"><spiral curvStart="0" curvEnd="0.02"/></geometry>'
    objects = '<object type="pole" id="p" s="100.2" t="-5.1"/>'
    header = f"<geoReference>{UTM}</geoReference><offset x='680000' y='5400000' z='0' hdg='0'/>"
    whole = document(road(plan=STRAIGHT + spiral, signals=signal(), objects=objects, lanes=LANES), header=header)
    text = whole
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(text)))
        tokens = st.sampled_from(["", "0", "-", "9e99", "nan", "x", '"', ">", "<line/>", "é", "1e308", "\0"])
        text = text[:at] + data.draw(tokens) + text[at + data.draw(st.integers(0, 6)) :]
    if data.draw(st.booleans()):
        text = text[: data.draw(st.integers(0, len(text)))]
    file = tmp_path_factory.getbasetemp() / "damaged.xodr"
    file.write_text(text or " ")
    for read in (read_signs, read_lanes):
        message, rows = str(file), 0
        try:
            rows = read(file).table.num_rows
        except InputError as error:
            message = str(error)
        assert str(file) in message
        assert rows <= 6


# ---- lanes --------------------------------------------------------------------------------------------------------


@pytest.fixture
def lanes(path):
    """Read lanes of one document in the local frame at ORIGIN: kind, limit and points in metres by id."""

    def read(*roads):
        table = read_lanes(path(document(*roads)), origin=ORIGIN).table
        lines = shapely.from_wkb(table["geometry"].to_numpy(zero_copy_only=False))
        points = [FRAME.to_enu(*shapely.get_coordinates(line).T) for line in lines]
        rows = zip(table["kind"].to_pylist(), table["speed_limit_kmh"].to_pylist(), points, strict=True)
        return dict(zip(table["lane_id"].to_pylist(), rows, strict=True))

    return read


def test_lanes_of_a_straight_road(lanes):
    found = lanes(road(lanes=LANES, extra='<type s="0" type="town"><speed max="50" unit="km/h"/></type>'))
    expected = {
        "7/reference_line": ("reference_line", 50, 0),
        "7/0/0/boundary": ("boundary", None, 0),
        "7/0/1": ("driving", 50, 1.5),
        "7/0/1/boundary": ("boundary", None, 3),
        "7/0/-1": ("driving", 50, -1.75),
        "7/0/-1/boundary": ("boundary", None, -3.5),
    }
    assert set(found) == set(expected)
    for name, (kind, limit, t) in expected.items():
        assert found[name][:2] == (kind, limit)
        np.testing.assert_allclose(found[name][2], [[0, t], [200, t]], atol=1e-3)


def test_offsets_borders_and_sections(lanes):
    shifted = """<lanes><laneOffset s="0" a="0.5" b="0" c="0" d="0"/><laneSection s="0"><right>
    <lane id="-2" type="shoulder"><border sOffset="0" a="-5" b="0" c="0" d="0"/></lane>
    <lane id="-1" type="driving"><border sOffset="0" a="-3" b="0" c="0" d="0"/></lane></right></laneSection>
    <laneSection s="150"><right><lane id="-1" type="driving"><width sOffset="0" a="3" b="0.02" c="0" d="0"/></lane>
    </right></laneSection><laneSection s="200"><right><lane id="-1" type="driving"/></right></laneSection></lanes>"""
    found = lanes(road(lanes=shifted))
    np.testing.assert_allclose(found["7/0/-1"][2], [[0, -1], [150, -1]], atol=1e-3)
    np.testing.assert_allclose(found["7/0/-2"][2], [[0, -3.5], [150, -3.5]], atol=1e-3)
    np.testing.assert_allclose(found["7/1/-1/boundary"][2], [[150, -2.5], [200, -3.5]], atol=1e-3)
    assert not any(name.startswith("7/2") for name in found)


def test_single_sided_sections_leave_the_other_side_alone(lanes):
    second = '<laneSection s="80" singleSide="true"><left><lane id="1" type="biking"/></left></laneSection></lanes>'
    found = lanes(road(lanes=LANES.replace("</lanes>", second)))
    ends = {name: found[name][2][:, 0].round(2).tolist() for name in ("7/0/1", "7/1/1", "7/0/-1")}
    assert ends == {"7/0/1": [0, 80], "7/1/1": [80, 200], "7/0/-1": [0, 200]}


def test_a_change_of_the_limit_divides_a_lane(lanes):
    types = '<type s="0" type="rural"><speed max="100" unit="kmh"/></type><type s="60"><speed max="100" unit="km/h"/>'
    types += '</type><type s="120.3" type="town"><speed max="30" unit="mph"/></type>'
    own = '<speed sOffset="0" max="20" unit="km/h"/><speed sOffset="50" max="no limit"/>'
    found = lanes(road(lanes=LANES.replace("</lane></left>", f"{own}</lane></left>"), extra=types))
    limits = {name: (found[name][1], *found[name][2][:, 0].round(2)) for name in found if "boundary" not in name}
    assert limits == {
        "7/reference_line": (None, 0, 200),
        "7/0/1/0": (20, 0, 50),
        "7/0/1/1": (None, 50, 200),
        "7/0/-1/0": (pytest.approx(100), 0, 120.3),
        "7/0/-1/1": (pytest.approx(48.28032), 120.3, 200),
    }


def test_lines_keep_within_a_centimetre_of_a_curve(lanes):
    arc = '<geometry s="0" x="0" y="0" hdg="0" length="60"><arc curvature="0.05"/></geometry>'
    found = lanes(road(plan=arc, lanes=LANES, length=60))
    for name, radius in (("7/reference_line", 20), ("7/0/-1/boundary", 23.5), ("7/0/1", 18.5)):
        line = shapely.segmentize(shapely.linestrings(found[name][2]), 0.1)
        distance = np.hypot(*(shapely.get_coordinates(line) - [0, 20]).T)
        np.testing.assert_allclose(distance, radius, atol=0.01)


# ---- real files ---------------------------------------------------------------------------------------------------


def test_ingolstadt_has_every_signal(shared_data):
    layer = read_signs(shared_data / "opendrive" / "ingolstadt_cityhall.xodr")
    table = layer.table
    kinds = Counter(table["kind"].to_pylist())
    assert kinds == {"main": 200, "plate": 107, "light": 30, "marking": 28, "other": 52}
    assert layer.skipped == {}
    assert layer.found["signal references"] == 81
    lon, lat = lonlat(table)
    bounds = (lon.min().round(4), lon.max().round(4), lat.min().round(4), lat.max().round(4))
    assert bounds == (11.4221, 11.4262, 48.7587, 48.7629)
    assert set(table["country"].to_pylist()) == {"DE"}
    rows = {row["sign_id"]: row for row in table.to_pylist()}
    plates = [row for row in rows.values() if row["kind"] == "plate"]
    assert sum(row["parent_id"] is not None for row in plates) == 99
    assert layer.found["plates without a main sign"] == 8
    assert all(rows[row["parent_id"]]["kind"] == "main" for row in rows.values() if row["parent_id"])
    assert rows["5009206"]["sign_class"] == "speed_limit:30"
    assert rows["5008887"]["parent_id"] == "5009206"
    assert rows["5008887"]["support_id"] == rows["5009206"]["support_id"] == "4018835"
    main = [row["sign_class"] for row in rows.values() if row["kind"] == "main"]
    assert not any(sign_class.startswith("raw:") for sign_class in main)
    # 124 of the main signs stand within half a metre of another, and differ in height
    is_main = table["kind"].to_numpy(zero_copy_only=False) == "main"
    place = EnuFrame(11.424, 48.761).to_enu(lon, lat)[is_main]
    gap = np.hypot(*(place[:, None] - place[None]).transpose(2, 0, 1)) + np.eye(len(place)) * 9
    assert (gap.min(axis=1) < 0.5).sum() == 124


def test_ingolstadt_and_its_offset_twin_are_one_place(shared_data):
    folder = shared_data / "opendrive"
    for read in (read_signs, read_lanes):
        one, other = (read(folder / f"ingolstadt_cityhall{end}.xodr").table for end in ("", "_offset"))
        drop = ["geometry", "bbox", "source", *(["facing_deg"] if "facing_deg" in one.column_names else [])]
        assert one.drop_columns(drop).equals(other.drop_columns(drop))
        places = [
            shapely.get_coordinates(shapely.from_wkb(t["geometry"].to_numpy(zero_copy_only=False)))
            for t in (one, other)
        ]
        apart = Geod(ellps="WGS84").inv(*places[0].T, *places[1].T)[2]
        assert apart.max() < 0.01


def test_ingolstadt_lanes(shared_data):
    layer = read_lanes(shared_data / "opendrive" / "ingolstadt_cityhall.xodr")
    kinds = Counter(layer.table["kind"].to_pylist())
    assert (kinds["reference_line"], kinds["boundary"], kinds["driving"], kinds["sidewalk"]) == (71, 3490, 617, 757)
    rows = layer.table.to_pylist()
    limits = Counter(row["speed_limit_kmh"] for row in rows if row["speed_limit_kmh"] is not None)
    assert limits == {30: 512, 20: 79, 50: 24, 7: 2}
    lines = shapely.from_wkb([row["geometry"] for row in rows if row["kind"] == "reference_line"])
    points = [shapely.get_coordinates(line).T for line in lines]
    length = sum(Geod(ellps="WGS84").line_length(*xy) for xy in points)
    assert length == pytest.approx(2390, abs=5)


def test_a9_signals(shared_data):
    layer = read_signs(shared_data / "opendrive" / "a9_nord_excerpt_bssd.xodr")
    rows = layer.table.to_pylist()
    assert Counter(row["kind"] for row in rows) == {"main": 20, "plate": 12, "other": 6}
    main = Counter(row["sign_class"] for row in rows if row["kind"] == "main")
    assert (main["no_overtaking"], main["speed_limit:100"], main["speed_limit:120"]) == (8, 4, 2)
    assert {row["country"] for row in rows} == {"DE"}
    assert layer.found["signal references"] == 2


def test_traps(shared_data):
    folder = shared_data / "opendrive"
    for name in ("bssd_analyze_signal_elements", "esmini_straight_500m_signs"):
        with pytest.raises(InputError, match="no geoReference"):
            read_signs(folder / f"{name}.xodr")
    with pytest.raises(InputError, match=r"has no \+proj="):
        read_signs(folder / "carla_Town01_partial_georef.xodr")
    mixed = read_signs(folder / "bssd_analyze_signal_elements.xodr", origin=ORIGIN).table.to_pylist()
    assert Counter(row["country"] for row in mixed) == {"DE": 6, "US": 1, None: 1}
    assert {row["sign_class"] for row in mixed} >= {"speed_limit:50", "no_entry", "regulatory_text", "raw:274-80"}
    letters = read_signs(folder / "esmini_straight_500m_signs.xodr", origin=ORIGIN).table.to_pylist()
    assert len(letters) == 19
    assert Counter(row["country"] for row in letters) == {"SE": 9, "DE": 7, "CN": 2, None: 1}
    assert Counter(row["sign_class"] for row in letters)["raw:c-31[5]"] == 4


def test_every_record_of_ingolstadt_starts_where_the_one_before_ends(shared_data):
    gaps = []
    for element in header_and_roads(shared_data / "opendrive" / "ingolstadt_cityhall.xodr", ("lanes", "objects")):
        if element.tag == "road":
            plan = read_road(element).plan
            ends = reference_points(plan, np.nextafter(plan.s[1:], 0))
            gaps.extend(np.hypot(ends[0] - plan.x[1:], ends[1] - plan.y[1:]))
    assert len(gaps) == 459
    assert max(gaps) < 1e-3


GEOMETRIES = {
    "line": "<line/>",
    "arc": '<arc curvature="{}"/>',
    "spiral": '<spiral curvStart="{}" curvEnd="0.004"/>',
    "poly3": '<poly3 a="0" b="0" c="{}" d="-0.00001"/>',
    "paramPoly3": '<paramPoly3 pRange="normalized" aU="0" bU="50" cU="-1" dU="0" aV="0" bV="0" cV="{}" dV="1"/>',
}


@pytest.mark.parametrize("kind", GEOMETRIES)
@pytest.mark.parametrize("bend", [-0.01, 0.0001, 0.02])
def test_one_geometry_agrees_with_pyxodr(kind, bend, path):
    body = GEOMETRIES[kind].format(bend)
    plan = f'<geometry s="0" x="20" y="-30" hdg="0.7" length="50">{body}</geometry>'
    agrees_with_pyxodr(path(document(road(plan=plan, length=50))), 0.1)


def test_reference_lines_agree_with_pyxodr(shared_data):
    # Theirs is interpolated linearly: on tight bends it nears ours with its resolution (71, 4.5, 0.8 mm off in
    # Ingolstadt at 0.5, 0.2, 0.1 m)
    named = {"ingolstadt_cityhall": 0.1, "a9_nord_excerpt_bssd": 0.2, "carla_Town01_partial_georef": 0.2}
    for name, resolution in named.items():
        agrees_with_pyxodr(shared_data / "opendrive" / f"{name}.xodr", resolution)


def agrees_with_pyxodr(file, resolution):
    etree = pytest.importorskip("lxml.etree", reason="pyxodr, an oracle, is not installed")
    network = pytest.importorskip("pyxodr.road_objects.road", reason="pyxodr, an oracle, is not installed")
    theirs = {
        r.get("id"): network.Road(r, resolution=resolution) for r in etree.parse(str(file)).getroot().iter("road")
    }
    n_roads = 0
    for element in header_and_roads(file, ("lanes", "objects")):
        if element.tag == "road":
            ours, n_roads = read_road(element), n_roads + 1
            x, y, _ = reference_points(ours.plan, np.linspace(0, ours.plan.end_m, 4000))
            line = shapely.linestrings(np.column_stack((x, y)))
            points = shapely.points(theirs[ours.road_id].reference_line[:, :2])
            assert shapely.distance(line, points).max() < 0.001
    assert n_roads == len(theirs) > 0


@pytest.fixture
def read(path):
    """Read a document of one road that runs east from the origin, with some signals."""
    return lambda *signals: read_signs(path(document(road(signals="".join(signals)))), origin=ORIGIN)


BOARD = """<staticBoard>
<sign id="535" Country="DE" type="274" subtype="60" v="-0.5" z="1.5" value="60" unit="km/h">
<signalDependency id="536"/></sign>
<sign id="536" Country="DE" type="1010" subtype="51" v="-0.75" z="0.9"/>
<sign id="537" country="DE" type="276" subtype="-1" v="0.75" z="1.5"/>
</staticBoard>"""


@pytest.mark.parametrize("orientation", ["+", "-"])
def test_signs_on_a_board_stand_where_the_board_has_them(read, orientation):
    board = signal("534", BOARD, type="staticBoard", country="OpenDRIVE", zOffset=5, orientation=orientation)
    layer = read(board)
    table = layer.table
    rows = {row["sign_id"]: row for row in table.to_pylist()}
    place = dict(zip(table["sign_id"].to_pylist(), metres(table), strict=True))
    assert {name: row["sign_class"] for name, row in rows.items()} == {
        "534": "unspecified",
        "535": "speed_limit:60",
        "536": "plate_vehicle",
        "537": "no_overtaking",
    }
    assert {name: row["kind"] for name, row in rows.items()} == {
        "534": "other",
        "535": "main",
        "536": "plate",
        "537": "main",
    }
    assert rows["536"]["parent_id"] == "535"
    assert rows["535"]["height_m"] == pytest.approx(6.5)
    assert [row["facing_deg"] for row in rows.values()] == pytest.approx([rows["534"]["facing_deg"]] * 4, abs=1e-5)
    # The road runs east; left of who looks along it is north
    left = 1.0 if orientation == "+" else -1.0
    assert place["535"] == pytest.approx({"x": 100.0, "y": -5.0 - 0.5 * left}, abs=1e-3)
    assert place["537"] == pytest.approx({"x": 100.0, "y": -5.0 + 0.75 * left}, abs=1e-3)
    assert layer.found["signs on boards"] == 3


def test_a_board_may_have_a_place_of_its_own_and_signs_without_an_offset(read):
    inside = '<positionInertial x="50" y="20" z="3" hdg="0"/>' + BOARD
    table = read(signal("534", inside, type="multiBoard", dynamic="yes")).table
    place = dict(zip(table["sign_id"].to_pylist(), metres(table), strict=True))
    assert place["534"] == pytest.approx({"x": 50.0, "y": 20.0}, abs=1e-3)
    assert place["537"] == pytest.approx({"x": 50.0, "y": 20.75}, abs=1e-3)
    rows = {row["sign_id"]: row for row in table.to_pylist()}
    assert (rows["534"]["sign_class"], rows["534"]["kind"]) == ("variable_sign", "main")
    assert read(signal("1", '<staticBoard><sign id="2" type="206"/></staticBoard>')).table.num_rows == 2
    broken = read(signal("1", '<staticBoard><sign id="2" v="x" type="206"/></staticBoard>'))
    assert broken.skipped == {NO_PLACE: 1}


@pytest.mark.parametrize(
    ("inside", "kind", "sign_class"),
    [
        ('<semantics><speed type="maximum" value="60" unit="km/h"/></semantics>', "main", "speed_limit:60"),
        ('<semantics><speed type="maximum" value="60" unit="mph"/></semantics>', "main", "speed_limit:60mph"),
        ('<semantics><priority type="stopLine"/></semantics>', "marking", "stop_line"),
        ('<semantics><supplementaryTime type="day" value="1"/></semantics>', "plate", "plate_other"),
        ("<semantics><tourist/></semantics>", "main", "raw:X9"),
        ("<semantics/>", "main", "raw:X9"),
    ],
)
def test_semantics_say_what_an_unknown_code_means(read, inside, kind, sign_class):
    row = read(signal("1", inside, type="X9", country="")).table.to_pylist()[0]
    assert (row["kind"], row["sign_class"], row["raw_code"]) == (kind, sign_class, "X9")
    known = read(signal("1", '<semantics><priority type="stop"/></semantics>')).table.to_pylist()[0]
    assert known["sign_class"] == "yield"


def test_a_road_without_a_plan_view_is_counted_with_its_signals(path):
    bare = road(road_id="9", plan="", signals=signal())
    layer = read_signs(path(document(bare, road(signals=signal()))), origin=ORIGIN)
    assert layer.table["road_id"].to_pylist() == ["7"]
    assert layer.skipped == {"roads without a planView": 1, "signals of roads without a planView": 1}
    with pytest.raises(InputError, match="none of 1 roads has a planView with a geometry"):
        read_signs(path(document(bare)), origin=ORIGIN)
    assert read_lanes(path(document(bare, road())), origin=ORIGIN).skipped["roads without a planView"] == 1


def test_a_reference_to_a_signal_that_is_not_there_is_told(path):
    references = '<signalReference s="1" t="2" id="1"/><signalReference s="2" t="2" id="99"/>'
    layer = read_signs(path(document(road(signals=signal() + references))), origin=ORIGIN)
    assert layer.found["signal references"] == 2
    assert layer.found["signal references to a signal that the file does not hold"] == 1


@pytest.mark.parametrize("pack", [gzip.compress, bz2.compress])
def test_a_packed_file_is_recognised(tmp_path, pack):
    packed = tmp_path / "map.xodr.packed"
    packed.write_bytes(pack(document(road(signals=signal())).encode()))
    assert layers.recognise(packed) == "opendrive"
    assert read_signs(packed, origin=ORIGIN).table.num_rows == 1
