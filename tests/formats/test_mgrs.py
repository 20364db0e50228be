"""Squares of MGRS beside the package `mgrs` (GEOTRANS), and Lanelet2 maps whose positions are in them."""

from __future__ import annotations

import mgrs
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from pyproj import Geod, Transformer

from geofleet.errors import InputError
from geofleet.formats.lanelet2 import read_lanes, read_signs
from geofleet.formats.mgrs import square_of
from geofleet.tables.store import lonlat

GEOD = Geod(ellps="WGS84")
ORACLE = mgrs.MGRS()


@given(lat=st.floats(-80.0, 83.99), lon=st.floats(-180.0, 179.999))
@example(lat=60.39, lon=5.32)  # Bergen: 32V, which is wider than six degrees
@example(lat=63.99, lon=3.01)  # its north-western corner: a row further north than the band's others
@example(lat=78.22, lon=15.65)  # Svalbard: 33X
@example(lat=79.5, lon=8.99)  # 31X, nine degrees wide
@example(lat=83.99, lon=20.99)
@example(lat=0.0, lon=-78.5)  # the equator is in the north
@example(lat=-1e-6, lon=36.8)
@example(lat=-80.0, lon=-179.999)
@example(lat=-33.9, lon=151.2)
def test_a_square_lies_where_the_oracle_has_it(lat, lon):
    code = ORACLE.toMGRS(lat, lon)
    square = square_of(code)
    assert square is not None, code
    zone, hemisphere, easting, northing = ORACLE.MGRSToUTM(code)
    assert square.crs == f"EPSG:{(32600 if hemisphere == 'N' else 32700) + zone}"
    assert square.easting_m == easting // 1e5 * 1e5
    assert square.northing_m == northing // 1e5 * 1e5
    # and the whole way: what lies in the square by its digits lies where it came from
    x_m, y_m = float(code[-10:-5]), float(code[-5:])
    to_degrees = Transformer.from_crs(square.crs, "OGC:CRS84", always_xy=True)
    back = to_degrees.transform(square.easting_m + x_m, square.northing_m + y_m)
    assert GEOD.inv(*back, lon, lat)[2] < 1.5  # digits are cut to whole metres


@pytest.mark.parametrize(
    "code",
    [
        "", "99XXX000000", "54SIE815501", "54SUW815501", "54SAE815501", "00SUE", "61SUE", "ZAH", "54S", "54SUEX",
        "31NAQ",  # a row that lies 900 km north of band N
    ],
)  # fmt: skip
def test_what_is_no_square_is_none(code):
    assert square_of(code) is None


@pytest.mark.parametrize("code", ["54SUE815501", "54sue", " 54 SUE 815 501 ", "54SUE8159650194"])
def test_a_square_is_read_however_it_is_written(code):
    square = square_of(code)
    assert (square.name, square.crs, square.easting_m, square.northing_m) == ("54SUE", "EPSG:32654", 3e5, 3.9e6)


# Nodes as Autoware's editors wrote them, with lat and lon: mgrs_code, local_x, local_y, lat, lon
NODES = (
    ("54SUE815501", 81596.1357, 50194.0803, 35.68855194431519, 139.69142711058254),
    ("54SVE045729", 4542.5099, 72957.9607, 35.89625133963436, 139.94226577007007),
    ("31UDP453968", 45359.0525, 96868.3611, 48.72244562283628, 2.257069031480778),
)


def autoware_map(nodes, *, place='lat="" lon=""'):
    points = "".join(
        f'<node id="{n}" {place}>'
        + (f'<tag k="mgrs_code" v="{code}"/>' if code else "")
        + f'<tag k="local_x" v="{x}"/><tag k="local_y" v="{y}"/><tag k="ele" v="3.1"/></node>'
        for n, (code, x, y) in enumerate(nodes, start=1)
    )
    signs = "".join(
        f'<way id="{100 + n}"><nd ref="{n}"/><tag k="type" v="traffic_sign"/><tag k="subtype" v="stop_sign"/></way>'
        for n in range(1, len(nodes) + 1)
    )
    return f'<osm version="0.6"><MetaInfo format_version="1" map_version="2"/>{points}{signs}</osm>'


@pytest.mark.parametrize("place", ['lat="" lon=""', 'lat="0" lon="0"', "", 'lat="35.8xxxxx" lon="139.6xxxxx"'])
def test_a_map_with_squares_only_lies_where_its_twin_in_degrees_does(tmp_path, place):
    path = tmp_path / "map.osm"
    path.write_text(autoware_map([node[:3] for node in NODES], place=place))
    layer = read_signs(path)
    lon, lat = lonlat(layer.table)
    apart_m = GEOD.inv(lon, lat, [node[4] for node in NODES], [node[3] for node in NODES])[2]
    assert np.max(apart_m) < 1e-3
    assert layer.found["nodes placed by mgrs_code, local_x and local_y"] == 3
    assert layer.datum.crs == "MGRS, square 31UDP, 54SUE, 54SVE"


def test_nodes_without_a_code_are_in_the_square_of_the_others(tmp_path):
    path = tmp_path / "map.osm"
    (code, x, y, *_), *_ = NODES
    path.write_text(autoware_map([(code, x, y), ("", x + 30.0, y + 40.0), ("99XXX0-1000", x, y - 10.0)]))
    lon, lat = lonlat(read_signs(path).table)
    assert GEOD.inv(lon[0], lat[0], lon[1], lat[1])[2] == pytest.approx(50.0, rel=1e-3)
    assert GEOD.inv(lon[0], lat[0], lon[2], lat[2])[2] == pytest.approx(10.0, rel=1e-3)
    # in a map of two squares nobody knows which one it is
    path.write_text(autoware_map([(code, x, y), NODES[1][:3], ("", x, y)]))
    layer = read_signs(path)
    assert layer.table.num_rows == 2
    assert layer.skipped["nodes without a valid position"] == 1


def test_degrees_that_a_map_has_are_used_before_its_squares(tmp_path):
    path = tmp_path / "map.osm"
    (code, x, y, lat, lon), *_ = NODES
    text = autoware_map([(code, x, y), (code, x, y)])
    path.write_text(text.replace('lat="" lon=""', f'lat="{lat + 0.01}" lon="{lon}"', 1))
    found = read_signs(path)
    assert lonlat(found.table)[1] == pytest.approx([lat + 0.01, lat], abs=1e-7)
    assert found.found["nodes placed by mgrs_code, local_x and local_y"] == 1


def test_a_map_with_placeholders_for_squares_is_refused(tmp_path):
    path = tmp_path / "map.osm"
    path.write_text(autoware_map([("99XXX000000", 22.2356, 87.4506), ("99XXX000000", 23.0, 88.0)]))
    with pytest.raises(InputError, match=r"'99XXX000000' is none.*--origin"):
        read_signs(path)


def test_an_option_goes_before_the_squares(tmp_path):
    path = tmp_path / "map.osm"
    path.write_text(autoware_map([NODES[0][:3]]))
    lon, _ = lonlat(read_signs(path, utm=("EPSG:32633", 3e5, 3.9e6)).table)
    assert 12.0 < lon[0] < 15.0


def test_lanes_of_a_map_with_squares(tmp_path):
    path = tmp_path / "map.osm"
    code, x, y = NODES[0][:3]
    text = autoware_map([(code, x, y), (code, x, y + 50.0), (code, x + 3.0, y), (code, x + 3.0, y + 50.0)])
    lanelet = (
        '<way id="1"><nd ref="1"/><nd ref="2"/></way><way id="2"><nd ref="3"/><nd ref="4"/></way>'
        '<relation id="9"><member type="way" ref="1" role="left"/><member type="way" ref="2" role="right"/>'
        '<tag k="type" v="lanelet"/><tag k="subtype" v="road"/></relation>'
    )
    path.write_text(text.replace("</osm>", f"{lanelet}</osm>"))
    lanes = read_lanes(path).table
    assert lanes.num_rows == 1
