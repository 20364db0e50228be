from __future__ import annotations

import bz2
import gzip
import json

import pytest

from geofleet.errors import InputError
from geofleet.formats import layers
from geofleet.formats.osm import read_lanes, read_signs

HEAD = {"version": 0.6, "generator": "Overpass API 0.7.62", "osm3s": {"copyright": "ODbL"}}
SIGN = {"type": "node", "id": 3, "lat": 50.0, "lon": 10.0001, "tags": {"traffic_sign": "DE:206,1004-31;DE:240"}}
BODY = [
    {"type": "way", "id": 7, "nodes": [1, 2, 99], "tags": {"highway": "residential"}},
    {"type": "node", "id": 1, "lat": 49.999, "lon": 10.0},
    {"type": "node", "id": 2, "lat": 50.001, "lon": 10.0},
    SIGN,
    {"type": "relation", "id": 1, "members": [{"type": "way", "ref": 7, "role": ""}]},
]
POINTS = [{"lat": 49.999, "lon": 10.0}, {"lat": 50.001, "lon": 10.0}, None]
GEOM = [SIGN, {"type": "way", "id": 7, "nodes": [1, 2, 99], "geometry": POINTS, "tags": {"highway": "residential"}}]
NAMELESS = [SIGN, {"type": "way", "id": 7, "geometry": POINTS[:2], "tags": {"highway": "residential"}}]


def answer(elements, **more):
    return json.dumps(HEAD | {"elements": elements} | more, indent=2).encode()


@pytest.mark.parametrize("elements", [BODY, GEOM, NAMELESS])
@pytest.mark.parametrize("pack", [bytes, gzip.compress, bz2.compress])
def test_an_overpass_answer_in_every_form(tmp_path, elements, pack):
    path = tmp_path / "answer.dat"
    path.write_bytes(pack(answer(elements)))
    assert layers.recognise(path) == "osm"
    rows = read_signs(path).table.to_pylist()
    assert [(r["sign_id"], r["kind"], r["parent_id"], r["road_id"]) for r in rows] == [
        ("n3-0", "main", None, "w7"),
        ("n3-1", "plate", "n3-0", "w7"),
        ("n3-2", "main", None, "w7"),
    ]
    assert rows[0]["facing_deg"] == pytest.approx(180.0, abs=0.01)
    assert read_lanes(path).table["lane_id"].to_pylist() == ["w7"]


def test_a_byte_order_mark_and_one_line_make_no_difference(tmp_path):
    path = tmp_path / "answer.json"
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps(HEAD | {"elements": BODY}).encode())
    assert read_signs(path).table.num_rows == 3


def test_elements_beyond_the_first_read_are_read(tmp_path):
    path = tmp_path / "answer.json"
    many = [SIGN | {"id": n, "tags": {"traffic_sign": "DE:206", "note": "ü" * 500}} for n in range(1, 5001)]
    path.write_text(json.dumps(HEAD | {"elements": many}), encoding="utf-8")
    assert path.stat().st_size > 1 << 20
    assert read_signs(path, roads=False).table.num_rows == 5000


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (answer(BODY)[:-40], "cut off or damaged"),
        (answer(BODY)[:300], "cut off or damaged"),
        (json.dumps(HEAD | {"remark": "runtime error: Query timed out"}).encode(), "Query timed out"),
        (answer(BODY, remark="runtime error: Query timed out after 180 seconds"), "could not answer in full"),
        (answer([]), "no nodes"),
        (answer([7]), "an element that is none"),
        (answer([{"type": "node", "id": "x"}]), "an element that is none"),
        (answer([{"type": "node", "id": 1, "lat": "x", "lon": 1}]), "a position that is none"),
        (gzip.compress(answer(BODY))[:-20], "damaged"),
        (bz2.compress(answer(BODY))[:-20], "damaged"),
    ],
)
def test_an_answer_that_is_none_is_refused_with_its_name(tmp_path, content, message):
    path = tmp_path / "answer.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_signs(path)
    assert str(path) in str(caught.value)


def test_a_position_beyond_the_poles_is_counted(tmp_path):
    path = tmp_path / "answer.json"
    path.write_bytes(answer([SIGN, SIGN | {"id": 4, "lat": 95}]))
    layer = read_signs(path)
    assert layer.table.num_rows == 3
    assert layer.skipped == {"nodes without a valid position": 1}


def test_geojson_is_not_taken_for_an_answer(tmp_path):
    path = tmp_path / "a.geojson"
    path.write_text('{"type": "FeatureCollection", "generator": "Overpass Turbo", "features": []}')
    assert layers.recognise(path) == "inventory"
