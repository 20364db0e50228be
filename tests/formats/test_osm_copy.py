"""Changes, histories and Overpass XML: what is there now, with the points that ways bring along."""

from __future__ import annotations

import gzip

import osmium
import pytest
from osmium.osm import mutable

from geofleet.errors import InputError
from geofleet.formats.osm import read_lanes, read_signs

HEAD = '<?xml version="1.0" encoding="UTF-8"?><osm version="0.6" generator="Overpass API">'
STOP = '<tag k="traffic_sign" v="DE:206"/>'
SECOND = 'version="2"'
ROAD = '<tag k="highway" v="residential"/>'


def node(number, tags="", more='version="1"', lat=52.5):
    return f'<node id="{number}" lat="{lat}" lon="13.4" {more}>{tags}</node>'


@pytest.fixture
def write(tmp_path):
    def make(text, name="map.osm"):
        path = tmp_path / name
        path.write_bytes(gzip.compress(text.encode()) if name.endswith(".gz") else text.encode())
        return path

    return make


def names(path):
    return read_signs(path).table["sign_id"].to_pylist()


@pytest.mark.parametrize("name", ["changes.osc", "changes.osc.gz"])
def test_of_a_change_file_what_is_created_or_modified_is_read(write, name):
    text = (
        f'<?xml version="1.0"?><osmChange version="0.6"><create>{node(1, STOP)}</create><modify>'
        f"{node(2, STOP)}{node(4, STOP)}{node(4, more=SECOND)}</modify>"
        f'<delete>{node(3, STOP)}<node id="2" version="2"/></delete></osmChange>'
    )
    assert names(write(text, name)) == ["n1-0"]


def test_of_a_history_the_last_version_counts(write):
    text = (
        node(1, STOP) + node(1, '<tag k="traffic_sign" v="DE:205"/>', 'version="2" visible="true"')
        + node(2, STOP) + '<node id="2" version="2" visible="false"/>'
    )  # fmt: skip
    table = read_signs(write(HEAD + text + "</osm>")).table
    assert table["sign_class"].to_pylist() == ["yield"]


def test_a_history_in_pbf_is_read_in_the_same_way(tmp_path):
    path = tmp_path / "history.osh.pbf"
    with osmium.SimpleWriter(str(path)) as writer:
        for number, version, visible in ((1, 1, True), (1, 2, True), (2, 1, True), (2, 2, False)):
            tags = {"traffic_sign": "DE:205" if version > 1 else "DE:206"}
            writer.add_node(mutable.Node(id=number, version=version, visible=visible, location=(13.4, 52.5), tags=tags))
    assert read_signs(path).table["sign_class"].to_pylist() == ["yield"]


@pytest.mark.parametrize("extra", ['<center lat="52.5" lon="13.4"/>', '<bounds minlat="52" minlon="13" maxlat="53"/>'])
def test_overpass_xml_with_points_inside_of_ways(write, extra):
    points = "".join(f'<nd ref="{n}" lat="{52.5 + n / 1000}" lon="13.4"/>' for n in range(3))
    path = write(f'{HEAD}{node(9, STOP)}<way id="5">{extra}{points}{ROAD}</way></osm>')
    lanes = read_lanes(path).table
    assert lanes["lane_id"].to_pylist() == ["w5"]
    assert names(path) == ["n9-0"]


def test_overpass_xml_that_broke_off_is_refused_with_its_reason(write):
    remark = '<remark> runtime error: Query timed out in "query" at line 3 after 26 seconds. </remark>'
    with pytest.raises(InputError, match=r"could not answer in full \(runtime error: Query timed out"):
        read_signs(write(HEAD + node(1, STOP) + remark + "</osm>"))
