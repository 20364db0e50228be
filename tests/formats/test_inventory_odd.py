"""Inventories as other tools write them: places in words, geometry in text or bytes, layers, nested values."""

from __future__ import annotations

import bz2
import gzip
import json
import zipfile
from datetime import UTC, datetime

import geopandas
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely

from geofleet.errors import ConfigError, InputError
from geofleet.formats import layers
from geofleet.formats.detections import read_detections
from geofleet.formats.inventory import read_signs
from geofleet.formats.inventory_columns import coordinates, texts
from geofleet.tables.store import lonlat

LON, LAT = 13.4100, 52.5100
POINT = shapely.Point(LON, LAT)


@pytest.fixture
def write(tmp_path):
    def make(text, name="signs.csv", encoding="utf-8"):
        path = tmp_path / name
        path.write_text(text, encoding=encoding, newline="")
        return path

    return make


@pytest.mark.parametrize(
    "text",
    [
        "52°30'36\" N",
        "52° 30.6' N",
        "N 52°30\u203236,0\u2033",
        "52:30:36N",
        "52.51 N",
        "52,51N",
        "52° 30' 36'' N",
    ],
)
def test_degrees_minutes_and_seconds(text):
    table = pa.table({"lat": [text, text.replace("N", "S")]})
    north, south = coordinates(table, "lat")
    assert north == pytest.approx(52.51)
    assert south == pytest.approx(-52.51 if "N" in text else 52.51)


@pytest.mark.parametrize("text", ["52d30m36s", "52°61'", "13°24' O", "north", "", "1°2'3\"4", "52°30'36\" NS"])
def test_what_could_be_anything_is_no_angle(text):
    assert np.isnan(coordinates(pa.table({"lat": [text]}), "lat")).all()


def test_a_table_in_degrees_and_minutes(write):
    layer = read_signs(write("code;lat;lon\n206;52°30'36\"N;13°24'36\"E\n"))
    assert np.ravel(lonlat(layer.table)) == pytest.approx([LON, LAT])


@pytest.mark.parametrize(
    ("text", "crs"),
    [
        (f"POINT ({LON} {LAT})", None),
        (f"SRID=4326;POINT ({LON} {LAT})", "WGS 84 (EPSG:4326)"),
        (shapely.to_wkb(POINT, hex=True), None),
        (shapely.to_wkb(shapely.set_srid(POINT, 4326), hex=True, include_srid=True), "WGS 84 (EPSG:4326)"),
        (json.dumps({"type": "Point", "coordinates": [LON, LAT]}), None),
    ],
)
def test_geometry_in_a_column_of_text(write, text, crs):
    quoted = text.replace('"', '""')
    layer = read_signs(write(f'code,geom\n206,"{quoted}"\n205,nonsense\n'))
    assert np.ravel(lonlat(layer.table)) == pytest.approx([LON, LAT])
    assert layer.skipped["geometries that cannot be read"] == 1
    assert ("no CRS stated, taken as OGC:CRS84" in layer.found) == (crs is None)
    assert crs is None or layer.datum.crs == crs


def test_an_srid_of_metres_is_used(write):
    x, y = geopandas.GeoSeries([POINT], crs=4326).to_crs(25833).get_coordinates().to_numpy()[0]
    layer = read_signs(write(f'code;geom\n206;"SRID=25833;POINT ({x} {y})"\n'))
    assert np.ravel(lonlat(layer.table)) == pytest.approx([LON, LAT], abs=1e-7)


def test_layers_are_chosen_by_name_and_listed(tmp_path):
    frame = geopandas.GeoDataFrame({"code": ["206"]}, geometry=[POINT], crs=4326)
    path = tmp_path / "two.gpkg"
    frame.to_file(path, layer="signs")
    frame.assign(code="205").to_file(path, layer="old")
    with pytest.raises(InputError, match=r"2 layers: signs, old\. Name one: --layer 'signs'"):
        read_signs(path)
    assert read_signs(path, layer="old").table["sign_class"].to_pylist() == ["yield"]
    with pytest.raises(ConfigError, match="no layer 'new'"):
        read_signs(path, layer="new")


def test_parquet_without_geo_metadata(tmp_path):
    path = tmp_path / "signs.parquet"
    pd.DataFrame({"code": ["206"], "photo": [b"\xff\xd8"], "place": [shapely.to_wkb(POINT)]}).to_parquet(path)
    assert np.ravel(lonlat(read_signs(path).table)) == pytest.approx([LON, LAT])
    pd.DataFrame({"code": ["206"], "at": [{"lon": LON, "lat": LAT}]}).to_parquet(path)
    with pytest.raises(InputError, match=r"there are code, at\.lon, at\.lat.*--columns x=…,y=…"):
        read_signs(path)
    layer = read_signs(path, columns={"x": "at.lon", "y": "at.lat"})
    assert np.ravel(lonlat(layer.table)) == pytest.approx([LON, LAT])


@pytest.mark.parametrize(
    ("geo", "message"),
    [
        (b"no json", "geo metadata is damaged"),
        (b"{}", "lacks 'primary_column'"),
        (b"[]", "geo metadata is damaged"),
        (b'{"primary_column": "g", "columns": {"g": {"encoding": "WKB"}}}', "geo metadata is damaged"),
    ],
)
def test_damaged_geo_metadata_is_named(tmp_path, geo, message):
    path = tmp_path / "signs.parquet"
    pq.write_table(pa.table({"code": ["206"]}).replace_schema_metadata({b"geo": geo}), path)
    with pytest.raises(InputError, match=message):
        read_signs(path)


def collection(*properties):
    at = {"type": "Point", "coordinates": [LON, LAT]}
    features = [{"type": "Feature", "properties": p, "geometry": at} for p in properties]
    return json.dumps({"type": "FeatureCollection", "features": features})


def test_tags_in_an_object_are_those_of_openstreetmap(write):
    layer = read_signs(write(collection({"tags": {"traffic_sign": "DE:274-50", "name": "x"}}), "signs.geojson"))
    assert layer.table["sign_class"].to_pylist() == ["speed_limit:50"]


def test_a_list_of_codes_is_a_stack(write):
    rows = read_signs(write(collection({"code": ["206", "1010-13"]}), "signs.geojson")).table.to_pylist()
    assert [(row["kind"], row["parent_id"]) for row in rows] == [("main", None), ("plate", "row/1")]


def test_codes_that_are_numbers_stay_as_written():
    assert texts(pa.table({"code": [206.0, 274.1, None, 1e17]}), "code") == ["206", "274.1", None, "100000000000000000"]


@pytest.mark.parametrize(
    ("text", "encoding", "message"),
    [
        ('{"code": "206", "lat": 52.5, "lon": 13.4}', "utf-8", "JSON, but no GeoJSON"),
        (collection({"code": "206"}), "utf-16", "in UTF-16"),
        (collection({}), "utf-8", "geometries without any attribute"),
        (json.dumps({"type": "Point", "coordinates": [LON, LAT]}), "utf-8", "geometries without any attribute"),
        (collection({"code": "206"}) + "}", "utf-8", "damaged or not geojson"),
    ],
)
def test_json_that_is_no_layer_says_why(write, text, encoding, message):
    with pytest.raises(InputError, match=message):
        read_signs(write(text, "signs.geojson", encoding))


FEATURE = {"type": "Feature", "properties": {"code": "206"}, "geometry": {"type": "Point", "coordinates": [11.5, 48.1]}}
PACKED = {"type": "FeatureCollection", "features": [FEATURE]}


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("signs.csv", "Nr;Breite;Länge;VZ\n1;48,1;11,5;206\n"),
        ("signs.geojson", json.dumps(PACKED)),
    ],
)
def test_packed_files_are_read_as_what_is_in_them(tmp_path, name, text):
    gz, bz, archive = (tmp_path / f"{name}.{suffix}" for suffix in ("gz", "bz2", "zip"))
    gz.write_bytes(gzip.compress(text.encode()))
    bz.write_bytes(bz2.compress(text.encode()))
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr(name, text)
    for path in (gz, bz, archive):
        assert layers.recognise(path) == "inventory"
        table = layers.read_layer(path).table
        assert table["sign_class"].to_pylist() == ["stop"]
        assert lonlat(table)[0] == [11.5]


def test_a_map_in_a_zip_is_read(tmp_path):
    text = "<osm version='0.6'><node id='1' lat='52.5' lon='13.4'><tag k='traffic_sign' v='DE:206'/></node></osm>"
    with zipfile.ZipFile(tmp_path / "map.zip", "w") as file:
        file.writestr("map.osm", text)
    assert layers.recognise(tmp_path / "map.zip") == "osm"
    assert layers.read_layer(tmp_path / "map.zip").table["sign_class"].to_pylist() == ["stop"]


ANSWER = [
    {
        "id": "498763468214164",
        "geometry": {"type": "Point", "coordinates": [LON, LAT]},
        "object_value": "regulatory--yield--g1",
        "first_seen_at": "2014-05-13T11:28:10+0000",
    },
    {"id": 2, "geometry": {"type": "Point", "coordinates": [LON + 0.01, LAT]}, "object_value": None},
]


@pytest.mark.parametrize(
    "text",
    [
        json.dumps({"data": ANSWER, "paging": {}}),
        json.dumps(ANSWER, indent=2),
        "\n".join(json.dumps(row) for row in ANSWER),
    ],
)
def test_rows_as_json(write, text):
    path = write(text, "signs.json")
    assert layers.recognise(path) == "inventory"
    layer = read_signs(path)
    assert dict(zip(*(layer.table[name].to_pylist() for name in ("sign_id", "sign_class")), strict=True)) == {
        "2": "unspecified",
        "498763468214164": "yield",
    }
    assert layer.table["first_seen"].drop_null().to_pylist() == [datetime(2014, 5, 13, 11, 28, 10, tzinfo=UTC)]
    read = list(read_detections(path))
    assert [lonlat(one.table)[0].tolist() for one in read] == [[LON]]
    assert [one.skipped for one in read] == [{"class missing": 1}]


def test_elements_of_openstreetmap_in_a_list_are_read_by_their_tags(write):
    node = {"type": "node", "id": 1, "lat": LAT, "lon": LON, "tags": {"traffic_sign": "DE:206"}}
    assert read_signs(write(json.dumps([node]), "signs.json")).table["sign_class"].to_pylist() == ["stop"]


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ('[{"a": 1}, 2]', "not a list of objects"),
        ('{"data": [{"a": 1}', "damaged or not json"),
        ("[" + '{"a":' * 3000 + "1" + "}" * 3000 + "]", "nested too deeply|damaged or not json|looks like the code"),
        (json.dumps([{f"k{n}": 1} for n in range(1001)]), "1001 different names"),
    ],
)
def test_json_that_is_no_rows_gives_one_message(write, text, why):
    with pytest.raises(InputError, match=why):
        read_signs(write(text, "signs.json"))


def test_json_that_would_fill_the_memory_is_refused(write):
    path = write('[{"a": 1},', "signs.json")
    with path.open("r+b") as file:
        file.truncate(257 << 20)  # takes no room on the disk
    with pytest.raises(InputError, match="larger than 256 MiB"):
        read_signs(path)
