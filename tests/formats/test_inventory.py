from __future__ import annotations

import contextlib
import json
import random
import struct
import zipfile
from collections import Counter
from datetime import UTC, datetime

import geopandas
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pyogrio
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import Geod, Transformer

from geofleet.errors import ConfigError, InputError
from geofleet.formats.inventory import read_signs
from geofleet.formats.inventory_columns import parse_facings, parse_numbers, parse_times
from geofleet.formats.inventory_files import detect
from geofleet.formats.positions import SUSPICIOUS, doubts
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import build_table, lonlat, to_geodataframe

GEOD = Geod(ellps="WGS84")
GHENT = (3.72, 51.05)


def rows_of(layer):
    return layer.table.drop_columns(["geometry"]).to_pylist()


def column(layer, name):
    return layer.table[name].to_pylist()


def geojson(*features, **members):
    return json.dumps({"type": "FeatureCollection", **members, "features": list(features)})


def feature(coordinates=GHENT, kind="Point", **properties):
    geometry = None if coordinates is None else {"type": kind, "coordinates": coordinates}
    return {"type": "Feature", "properties": properties, "geometry": geometry}


@pytest.fixture
def write(tmp_path):
    def make(text, name="signs.geojson", encoding="utf-8"):
        path = tmp_path / name
        path.write_bytes(text if isinstance(text, bytes) else text.encode(encoding))
        return path

    return make


# --- real files --------------------------------------------------------------------------------------------------


def test_the_inventory_of_hansbeke(shared_data):
    layer = read_signs(shared_data / "inventory" / "hansbeke_traffic-signs.geojson")
    assert layer.table.num_rows == 467
    assert len(set(column(layer, "raw_code"))) == 65
    assert layer.found["signs without a code"] == 9
    assert Counter(column(layer, "facing_deg")) == {270.0: 122, 0.0: 119, 180.0: 118, 90.0: 108}
    assert Counter(column(layer, "kind"))["other"] == 9
    assert layer.found["country BE (guessed from codes and place)"] == 467
    assert not any(reason.startswith(SUSPICIOUS) for reason in layer.found)
    # C43 is the speed limit; its number is in a column of its own
    limits = {row["sign_class"] for row in rows_of(layer) if row["raw_code"] == "C43"}
    assert limits == {"speed_limit", "speed_limit:50", "speed_limit:70"}


def test_equal_plates_at_one_point_stay_two_rows(shared_data, write):
    same = geojson(feature(code="B1", id=1), feature(code="B1", id=2))
    assert column(read_signs(write(same), country="BE"), "sign_id") == ["1", "2"]
    layer = read_signs(shared_data / "inventory" / "hansbeke_traffic-signs.geojson")
    lon, lat = lonlat(layer.table)
    groups = Counter(zip(lon.tolist(), lat.tolist(), strict=True))
    assert sum(count > 1 for count in groups.values()) == 77


def test_signs_among_other_objects_of_openstreetmap(shared_data):
    layer = read_signs(shared_data / "inventory" / "neukoelln_man_made.geojson")
    assert len(set(column(layer, "source_ref"))) == 165
    assert layer.skipped == {"other objects, without a sign": 8885 - 165}
    facing = {row["source_ref"]: row["facing_deg"] for row in rows_of(layer)}
    assert sum(value is not None for value in facing.values()) == 111
    stack = [row for row in rows_of(layer) if row["source_ref"] == "node/3116871578"]
    assert [(row["raw_code"], row["kind"]) for row in stack] == [("DE:356", "main"), ("DE:1000-21", "plate")]
    assert stack[1]["parent_id"] == stack[0]["sign_id"]
    assert {row["support_id"] for row in stack} == {"node/3116871578"}


def test_flanders_as_geojson_and_as_lambert_72_table_agree(shared_data):
    folder = shared_data / "inventory"
    degrees = read_signs(folder / "flanders_road_signs_20220218.geojson")
    metres = read_signs(folder / "flanders_road_signs_lambert72_20220218.csv", crs="EPSG:31370")
    assert degrees.table.num_rows == metres.table.num_rows == 2480
    assert not degrees.skipped
    assert not metres.skipped
    for name in ("sign_id", "sign_class", "kind", "first_seen"):
        assert degrees.table[name].equals(metres.table[name])
    assert GEOD.inv(*lonlat(degrees.table), *lonlat(metres.table))[2].max() < 0.01
    # one date is written day first, 1053 can only be month first
    assert column(degrees, "first_seen").count(None) == 0
    assert min(column(degrees, "first_seen")) >= datetime(2021, 11, 1, tzinfo=UTC)


def test_lambert_72_without_its_crs_is_refused(shared_data):
    with pytest.raises(InputError, match=r"no longitudes and latitudes \(x 30135.*EPSG:31370"):
        read_signs(shared_data / "inventory" / "flanders_road_signs_lambert72_20220218.csv")


def test_the_mapillary_export_of_bremen(shared_data):
    layer = read_signs(shared_data / "mapillary" / "mapillary_traffic-signs_DE-HB.parquet")
    table = layer.table
    assert layer.file_format == "geoparquet"
    assert table.num_rows == 22_836
    assert len(table["raw_code"].unique()) == 266
    assert table["first_seen"].null_count == table["last_seen"].null_count == 0
    assert min(column(layer, "first_seen")) == datetime(2011, 7, 1, tzinfo=UTC)
    assert max(column(layer, "last_seen")) == datetime(2026, 1, 5, tzinfo=UTC)
    assert layer.found["unknown codes"] < 0.05 * 22_836
    assert not layer.skipped


# --- formats -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def frame():
    lon = np.array([3.72, 3.7201, 3.73])
    columns = {"code": ["B9", "C43", "B1"], "facing": ["N", "90", "WSW"], "text_on_sign": ["", "50", ""]}
    return geopandas.GeoDataFrame(columns, geometry=shapely.points(lon, [51.05, 51.06, 51.07]), crs="OGC:CRS84")


def to_shapefile(path, frame):
    frame.rename(columns={"text_on_sign": "text_on_si"}).to_file(path)  # ten letters are all that it keeps


def zipped(path, frame):
    to_shapefile(path.with_suffix(".shp"), frame)
    with zipfile.ZipFile(path, "w") as archive:
        for part in path.parent.glob(f"{path.stem}.*"):
            if part != path:
                archive.write(part, f"folder/{part.name}")


def to_csv(path, frame):
    columns = {"lon": frame.geometry.x, "lat": frame.geometry.y}
    frame.drop(columns="geometry").assign(**columns).to_csv(path, index=False)


WRITERS = {
    "a.geojson": lambda path, frame: frame.to_file(path),
    "a.geojsonl": lambda path, frame: frame.to_file(path, driver="GeoJSONSeq"),
    "a.gpkg": lambda path, frame: frame.to_file(path),
    "a.shp": to_shapefile,
    "a.zip": zipped,
    "a.fgb": lambda path, frame: frame.to_file(path, SPATIAL_INDEX="NO"),
    "a-1.0.parquet": lambda path, frame: frame.to_parquet(path, schema_version="1.0.0"),
    "a-1.1.parquet": lambda path, frame: frame.to_parquet(path, schema_version="1.1.0", write_covering_bbox=True),
    "a-point.parquet": lambda path, frame: frame.to_parquet(path, schema_version="1.1.0", geometry_encoding="geoarrow"),
    "a.csv": to_csv,
}
NAMES = {"geojsonl": "geojsonseq", "gpkg": "gpkg", "shp": "shapefile", "zip": "shapefile.zip", "fgb": "flatgeobuf"}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("crs", ["OGC:CRS84", "EPSG:31370"])
def test_every_format_gives_the_same_signs(frame, tmp_path, name, crs):
    path = tmp_path / name
    is_json = name.endswith("geojsonl")  # RFC 8142 knows no CRS
    WRITERS[name](path, frame if is_json else frame.to_crs(crs))
    layer = read_signs(path, country="BE", **({"crs": crs} if name == "a.csv" else {}))
    rows = sorted(rows_of(layer), key=lambda row: row["bbox"]["xmin"])
    assert [row["sign_class"] for row in rows] == ["priority_road", "speed_limit:50", "yield"]
    assert [row["facing_deg"] for row in rows] == [0.0, 90.0, 247.5]
    assert GEOD.inv(*lonlat(layer.table), frame.geometry.x, frame.geometry.y)[2].max() < 0.01
    assert not layer.skipped


def test_the_format_is_told_from_the_content_and_not_from_the_name(frame, tmp_path):
    path = tmp_path / "signs.csv"
    frame.to_parquet(path)
    assert read_signs(path, country="BE").file_format == "geoparquet"
    frame.to_file(tmp_path / "signs.gpkg")
    (tmp_path / "signs.gpkg").rename(path)  # GDAL goes by the name: it would read SQLite as CSV
    with pytest.raises(InputError, match=r"the content is gpkg.*Rename it"):
        read_signs(path, country="BE")
    assert detect(b"<?xml version='1.0'?>") == ""
    assert detect(b"\x00\x01\x02") == ""


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("bord;x;y;straat\nB9;3,72;51,05;Café\nC43;3,73;51,06;\n", "utf-8"),
        ("bord;x;y;straat\nB9;3,72;51,05;Café\nC43;3,73;51,06;\n", "cp1252"),
        ("bord;x;y;straat\nB9;3,72;51,05;Café\nC43;3,73;51,06;\n", "utf-8-sig"),
        ("bord\tx\ty\nB9\t3.72\t51.05\nC43\t3.73\t51.06\n", "utf-16"),
        ("bord|x|y\nB9|3.72|51.05\nC43|3.73|51.06\n", "utf-8"),
        ('bord,x,y,"a, b"\nB9,"3,72","51,05","x\ny"\nC43,3.73,51.06,\n', "utf-8"),
        ("bord;wkt\nB9;POINT (3.72 51.05)\nC43;POINT (3.73 51.06)\n", "utf-8"),
    ],
)
def test_csv_of_every_fashion(write, text, encoding):
    layer = read_signs(write(text, "a.csv", encoding), columns={"code": "bord"}, country="BE")
    assert column(layer, "concept") == ["priority_road", "speed_limit"]
    lon, lat = lonlat(layer.table)
    assert lon == pytest.approx([3.72, 3.73])
    assert lat == pytest.approx([51.05, 51.06])
    assert ("read as Windows-1252, since it is not UTF-8" in layer.found) == (encoding == "cp1252")


def test_codes_of_a_table_stay_text(write):
    layer = read_signs(write("vz_nr,lon,lat\n274.10,13.4,52.5\n0205,13.4,52.5\n", "a.csv"), country="DE")
    assert sorted(column(layer, "raw_code")) == ["0205", "274.10"]


def test_columns_and_options_from_toml(write):
    path = write("bord;oost;noord;kijk\nB9;175676,391;210394,656;Z\n", "a.csv")
    columns = ['code = "bord"', 'x = "oost"', 'y = "noord"', 'facing = "kijk"']
    toml = write("\n".join(['crs = "EPSG:31370"', 'country = "BE"', "[columns]", *columns]), "a.toml")
    (row,) = rows_of(read_signs(path, columns=toml))
    assert (row["concept"], row["facing_deg"]) == ("priority_road", 180.0)
    assert row["bbox"]["xmin"] == pytest.approx(4.73613, abs=1e-5)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": {"code": "nothing"}}, "no column 'nothing'"),
        ({"columns": {"colour": "code"}}, "'colour' is nothing"),
        ({"colour": 1}, "unknown option colour"),
        ({"layer": "no"}, "no layer 'no'"),
    ],
)
def test_options_that_do_not_fit_are_refused(write, options, message):
    with pytest.raises(ConfigError, match=message):
        read_signs(write(geojson(feature(code="B1"))), **options)


def test_a_toml_file_that_is_none_is_refused(write):
    with pytest.raises(ConfigError, match="TOML"):
        read_signs(write(geojson(feature(code="B1"))), columns=write("= =", "a.toml"))


def test_guesses_are_told_and_can_be_overridden(write):
    path = write(geojson(feature(code="B1", sign_code="B9", azimuth=45, id=7)))
    layer = read_signs(path, country="BE")
    assert layer.found == {
        "code read from column sign_code (guessed)": 1,
        "facing read from column azimuth (guessed)": 1,
        "sign_id read from column id (guessed)": 1,
    }
    (row,) = rows_of(read_signs(path, country="BE", columns={"code": "code", "facing": "", "id": "azimuth"}))
    assert (row["concept"], row["facing_deg"], row["sign_id"]) == ("yield", None, "45")


# --- codes -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("code", "separator"), [("B9 | C43 |M2", None), ("B9;C43;M2", None), ("B9/C43/M2", "/")])
def test_stacks_are_taken_apart(write, code, separator):
    layer = read_signs(write(geojson(feature(code=code, id="p"))), country="BE", separator=separator)
    rows = sorted(rows_of(layer), key=lambda row: row["sign_id"])
    assert [(r["sign_id"], r["raw_code"]) for r in rows] == [("p", "B9"), ("p-2", "C43"), ("p-3", "M2")]
    assert {row["support_id"] for row in rows} == {"p"}
    assert [row["parent_id"] for row in rows] == [None, None, "p-2" if rows[2]["kind"] == "plate" else None]


@pytest.mark.parametrize(
    ("codes", "options", "concepts"),
    [
        (["regulatory--yield--g1"], {}, ["yield"]),
        (["DE:274.1[30];DE:240"], {}, ["speed_zone", "shared_path"]),
        (["B9", "F34b1", "C43"], {}, ["priority_road", None, "speed_limit"]),
        (["A,1c"], {"scheme": "vienna"}, ["double_curve_left"]),
        (["qq", ""], {"country": "BE"}, ["raw:qq", "unspecified"]),
    ],
)
def test_schemes_are_told_from_the_codes(write, codes, options, concepts):
    layer = read_signs(write(geojson(*(feature(code=code) for code in codes))), **options)
    found = [row["concept"] for row in sorted(rows_of(layer), key=lambda r: (int(r["source_ref"][4:]), r["sign_id"]))]
    assert len(found) == len(concepts)
    assert all(expected in {None, one} for one, expected in zip(found, concepts, strict=True))


def test_equal_ids_are_told_apart(write):
    text = geojson(*(feature(code="B1", id=i) for i in ("a", "a", "a-2", "a", None)))
    layer = read_signs(write(text), country="BE")
    assert sorted(column(layer, "sign_id")) == ["a", "a-2", "a-3", "a-4", "row/5"]
    assert sorted(column(layer, "source_ref")) == ["a", "a", "a", "a-2", "row/5"]


# --- geometry ----------------------------------------------------------------------------------------------------


def test_signs_on_lines_and_areas_are_told_apart(write):
    square = [[[3.0, 51.0], [3.1, 51.0], [3.1, 51.1], [3.0, 51.1], [3.0, 51.0]]]
    text = geojson(
        feature(code="B1", id="point"),
        feature([[3.0, 51.0], [3.2, 51.0]], "LineString", code="B1", id="line"),
        feature([[[3.0, 51.0], [3.2, 51.0]], [[4.0, 51.0], [4.4, 51.0]]], "MultiLineString", code="B1", id="lines"),
        feature(square, "Polygon", code="B1", id="area"),
        feature([list(GHENT), [3.8, 51.0]], "MultiPoint", code="B1", id="points"),
    )
    layer = read_signs(write(text), country="BE")
    kinds = {row["sign_id"]: row["kind"] for row in rows_of(layer)}
    assert kinds == {
        "point": "main", "line": "other", "lines": "other", "area": "other", "points": "main", "points-2": "main",
    }  # fmt: skip
    assert layer.found["signs tagged on a line or an area (kind other)"] == 3
    places = {row["sign_id"]: (row["bbox"]["xmin"], row["bbox"]["ymin"]) for row in rows_of(layer)}
    assert places["line"] == pytest.approx((3.1, 51.0))
    assert shapely.Polygon(square[0]).contains(shapely.Point(places["area"]))


def test_rows_without_a_good_position_are_counted(write):
    text = geojson(
        feature(code="B1"),
        feature(None, code="B1"),
        feature([], code="B1"),
        feature(["a", 2], code="B1"),
        feature([0.0, 0.0], code="B1"),
        feature([3.72, 151.0], code="B1"),
        feature([3.73, 51.0], code="B1"),
        feature([3.74, 51.0], code="B1"),
    )
    layer = read_signs(write(text), country="BE")
    assert layer.table.num_rows == 3
    assert layer.skipped == {
        "without a geometry": 3,
        "coordinates out of range": 1,
        "at 0° N 0° E, in the Gulf of Guinea": 1,
    }
    table = "code,lon,lat\nB1,3.7,51\nB1,3.7,51,9\n"
    table += "B1,x,51\nB1,NaN,51\nB1,,51\nB1,inf,51\nB1,3.7,-91\nB1,3.8,51\nB1,3.8,51\n"
    layer = read_signs(write(table, "a.csv"), country="BE")
    assert layer.table.num_rows == 3
    assert layer.skipped == {
        "rows with another number of columns than the header": 1,
        "coordinates that are no number": 4,
        "coordinates out of range": 1,
    }


def test_a_nan_in_the_file_is_rejected(tmp_path):
    geometry = [struct.pack("<BIdd", 1, 1, 3.7, 51.0), struct.pack("<BIdd", 1, 1, np.nan, 51.0), b"\x01\x01", None]
    geo = {"version": "1.0.0", "primary_column": "g", "columns": {"g": {"encoding": "WKB", "geometry_types": []}}}
    table = pa.table({"code": ["B1"] * 4, "g": geometry}).replace_schema_metadata({"geo": json.dumps(geo)})
    pq.write_table(table, tmp_path / "a.parquet")
    layer = read_signs(tmp_path / "a.parquet", country="BE")
    assert layer.table.num_rows == 1
    assert sum(layer.skipped.values()) == 3


# --- wrong coordinate systems ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("coordinates", "options", "message"),
    [
        ((175676.0, 210394.0), {}, r"no longitudes and latitudes.*--crs"),
        ((103.72, 31.05), {"crs": "EPSG:31370"}, r"look like degrees"),
        ((0.2, 0.3), {}, r"Gulf of Guinea"),
        ((51.05, 3.72), {}, r"outside of BE, and inside with the axes swapped"),
        ((-33.9, 151.2), {}, r"axes look swapped"),
        (GHENT, {"crs": "EPSG:999999"}, r"'EPSG:999999' cannot be used"),
    ],
)
def test_a_wrong_crs_is_named(write, coordinates, options, message):
    with pytest.raises(InputError, match=message):
        read_signs(write(geojson(feature(list(coordinates), code="B9"))), country="BE", **options)


def test_swapped_axes_can_be_swapped_back(write):
    layer = read_signs(write(geojson(feature(list(GHENT[::-1]), code="B9"))), country="BE", swap_xy=True)
    assert lonlat(layer.table) == (pytest.approx([GHENT[0]]), pytest.approx([GHENT[1]]))


def test_positions_outside_of_the_country_or_far_from_all_others_are_told(write):
    near = [feature([3.7 + i / 100, 51.0], code="B9") for i in range(9)]
    layer = read_signs(write(geojson(*near, feature([3.7, 53.0], code="B9"))), country="BE")
    assert {k: v for k, v in layer.found.items() if k.startswith(SUSPICIOUS)} == {
        f"{SUSPICIOUS}outside of BE; is the CRS right?": 1,
        f"{SUSPICIOUS}over 100 km from any other; are these positions right?": 1,
    }
    assert layer.table.num_rows == 10
    assert doubts(np.array([3.7]), np.array([51.0]), "BE", where="here") == {}


@pytest.mark.parametrize(
    ("crs", "xy"),
    [
        (None, GHENT),
        ({"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}, GHENT),
        ({"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::31370"}}, None),
        ({"type": "name", "properties": {"name": "EPSG:31370"}}, None),
    ],
)
def test_the_crs_member_of_geojson(write, crs, xy):
    xy = xy or Transformer.from_crs("OGC:CRS84", "EPSG:31370", always_xy=True).transform(*GHENT)
    text = geojson(feature(list(xy), code="B9"), **({"crs": crs} if crs else {}))
    lon, lat = lonlat(read_signs(write(text), country="BE").table)
    assert GEOD.inv(lon[0], lat[0], *GHENT)[2] < 0.01


@pytest.mark.parametrize("kind", ["name", "link"])
def test_a_crs_that_cannot_be_known_is_refused(write, kind):
    crs = {"type": kind, "properties": {"name": "Lambert, I believe"}}
    with pytest.raises(InputError, match="Lambert, I believe"):
        read_signs(write(geojson(feature(code="B9"), crs=crs)))


# --- text --------------------------------------------------------------------------------------------------------


def test_numbers_of_every_country():
    texts = ["1.5", "1,5", "1.234,5", "1,234.5", "1 234,5", "1\u00a0234,5", "-.5", "1e3", "", None, "x", "1.2.3", "0x1"]
    expected = [1.5, 1.5, 1234.5, 1234.5, 1234.5, 1234.5, -0.5, 1000.0, *[np.nan] * 5]
    np.testing.assert_allclose(parse_numbers(texts), expected)


def test_facings_of_every_fashion():
    facing, n_bad = parse_facings(["N", "e", "SSW", "90", "90°", "-90", "270,5", "noord", "Z", None, "", "up", "9999"])
    expected = [0, 90, 202.5, 90, 90, 270, 270.5, 0, 180, *[np.nan] * 4]
    np.testing.assert_allclose(facing, expected)
    assert n_bad == 2


@pytest.mark.parametrize(
    ("texts", "day_first", "expected"),
    [
        (["2021-11-15", "2021-11-15T10:00:00+02:00"], None, ["2021-11-15", "2021-11-15T08:00"]),
        (["11/15/2021", "1/2/2022"], None, ["2021-11-15", "2022-01-02"]),
        (["15/11/2021", "1/2/2022"], None, ["2021-11-15", "2022-02-01"]),
        (["15.11.2021 10:30", "1.2.22"], None, ["2021-11-15T10:30", "2022-02-01"]),
        (["1/2/2022", "3/3/2022"], None, [None, "2022-03-03"]),
        (["1/2/2022"], True, ["2022-02-01"]),
        (["15/11/2021", "11/15/2021", "1/2/2022"], None, ["2021-11-15", "2021-11-15", None]),
        (["20211115", "1636934400000", "1636934400", "soon", "0/0/0", ""], None, ["2021-11-15"] * 3 + [None] * 3),
    ],
)
def test_dates_in_both_orders(texts, day_first, expected):
    times, told = parse_times(pa.chunked_array([texts]), day_first=day_first)
    assert times == [value and datetime.fromisoformat(value).replace(tzinfo=UTC) for value in expected]
    assert sum(told.values()) == sum(time is None and text != "" for time, text in zip(times, texts, strict=True))


# --- own layers --------------------------------------------------------------------------------------------------

_letters = st.characters(codec="utf-8", exclude_categories=("Cc", "Cs", "Zl", "Zp"))
_text = st.text(_letters, min_size=1, max_size=9).map(str.strip).filter(bool)
_times = st.integers(946_684_800, 1_893_456_000).map(lambda second: datetime.fromtimestamp(second, tz=UTC))
_row = st.fixed_dictionaries(
    {
        "lon": st.floats(3.0, 6.0),
        "lat": st.floats(50.0, 51.0),
        "raw_code": _text,
        "value": st.none() | st.floats(0.0, 200.0),
        "facing_deg": st.none() | st.floats(0.0, 359.0),
        "road_id": st.none() | _text,
        "first_seen": st.none() | _times,
    }
)


@pytest.mark.parametrize("name", ["a.geojson", "a.gpkg", "a.fgb", "a-1.1.parquet"])
@given(rows=st.lists(_row, min_size=1, max_size=5))
@settings(max_examples=15, deadline=None, database=None)
def test_a_layer_written_by_any_tool_comes_back(tmp_path_factory, name, rows):
    columns = {key: [row[key] for row in rows] for key in rows[0] if key not in {"lon", "lat"}}
    columns |= {"sign_id": [f"s{i}" for i in range(len(rows))], "kind": "main", "concept": "stop", "sign_class": "stop"}
    columns |= {"source": "test", "source_ref": "none"}
    place = (np.array([row["lon"] for row in rows]), np.array([row["lat"] for row in rows]))
    table = build_table(SIGNS, columns, place)
    path = tmp_path_factory.mktemp("layer") / name
    write_layer(name, path, table)
    back = read_signs(path).table
    for column_name in columns:
        assert back[column_name].to_pylist() == table[column_name].to_pylist(), column_name
    np.testing.assert_allclose(lonlat(back), lonlat(table), rtol=0, atol=1e-9)


def write_layer(name, path, table):
    frame = to_geodataframe(table)
    if name.endswith("geojson"):
        pyogrio.write_dataframe(frame, path, COORDINATE_PRECISION=12, SIGNIFICANT_FIGURES=17)
    else:
        WRITERS[name](path, frame)


# --- hostile files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "content",
    [
        b"", b"\x00" * 100, b"<osm/>", b"{}", b"[", b"[" * 100_000, b'{"type":"FeatureCollection"}', b"PAR1",
        b"fgb\x03", b"PK\x03\x04", b"SQLite format 3\x00", b"\x00\x00\x27\x0a", b"code", b"code,lon,lat",
        b"a,a,b\n1,2,3\n",
        b'code,lon,lat\n"B1,3,51\nB1,3,51\n', b"\xff\xfe\x00", b"id,lon,lat\n1,3,51\n",
        b'{"type":"gdal_streamed_alg","command_line":"gdal vector pipeline ! read x.gpkg"}',
    ],
)  # fmt: skip
def test_what_is_no_inventory_is_refused(write, content):
    path = write(content, "signs.bin")
    with pytest.raises(InputError, match=r"signs\.bin"):
        read_signs(path)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        read_signs(tmp_path / "none.gpkg")


def test_one_endless_line_is_refused(write):
    with pytest.raises(InputError, match="damaged or not csv"):
        read_signs(write("code,lon,lat\nB1," + "9" * 40_000_000 + ",51\n", "a.csv"))


def test_a_zip_that_grows_beyond_measure_is_refused(tmp_path):
    path = tmp_path / "bomb.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.shp", b"\0" * 1000)
    data = bytearray(path.read_bytes())
    at = data.index(b"PK\x01\x02") + 24  # uncompressed size in the directory
    data[at : at + 4] = struct.pack("<I", 0xFFFFFFF0)
    data[data.index(b"PK\x01\x02") + 20 : data.index(b"PK\x01\x02") + 24] = struct.pack("<I", 10)
    path.write_bytes(data + b"")
    with pytest.raises(InputError, match=r"zip"):
        read_signs(path)


@contextlib.contextmanager
def reads_or_says_why(path):
    """Any error but an InputError that names the file fails the test."""
    try:
        yield
    except InputError as error:
        if str(path) not in str(error):
            pytest.fail(f"the message does not name the file: {error}")


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "a.shp"])
def test_damaged_files_never_give_another_error(frame, tmp_path, name):
    whole = tmp_path / name
    WRITERS[name](whole, pd.concat([frame] * 20, ignore_index=True))
    data = whole.read_bytes()
    rng = random.Random(name)  # noqa: S311  (damage, not secrets)
    for turn in range(40):
        path = tmp_path / f"damaged{turn}{whole.suffix}"
        broken = bytearray(data[: rng.randrange(1, len(data))] if turn % 2 else data)
        for _ in range(rng.randrange(8) if turn % 4 else 0):
            broken[rng.randrange(len(broken))] = rng.randrange(256)
        path.write_bytes(broken)
        with reads_or_says_why(path):
            read_signs(path, country="BE")


# ---- a layer in the wrong place --------------------------------------------------------------------------------------


def shifted(tmp_path, *, lon, lat, country):
    rows = "".join(f"{i},{lon + i * 1e-3},{lat},205,{country}\n" for i in range(9))
    path = tmp_path / "shifted.csv"
    path.write_text(f"id,lon,lat,code,country\n{rows}", encoding="utf-8")
    return read_signs(path).found


@pytest.mark.parametrize(
    ("lon", "lat", "country", "is_told"),
    [
        (8.8, 53.1, "DE", False),
        (10.8, 55.1, "DE", True),  # Bremen two degrees off, in the Danish sea, and within any box around Germany
        (6.8, 51.1, "DE", False),  # two degrees off, and still in Germany: nothing in the file can tell
        (24.94, 60.17, "FI", False),
        (26.94, 58.17, "FI", True),
        (3.5, 51.1, "BE", False),
        (5.5, 53.1, "BE", True),
        (-93.0, 45.0, "US", False),
        (-16.0, 28.3, "ES", False),  # islands are land, too
        (20.0, 60.2, "FI", False),
    ],
)
def test_a_layer_two_degrees_off_is_told(tmp_path, lon, lat, country, is_told):
    told = [name for name in shifted(tmp_path, lon=lon, lat=lat, country=country) if name.startswith(SUSPICIOUS)]
    assert bool(told) == is_told
    assert all(country in name or "any land" in name for name in told)


def test_a_layer_in_the_sea_is_told_without_a_country(tmp_path):
    told = [n for n in shifted(tmp_path, lon=-30.0, lat=45.0, country="") if n.startswith(SUSPICIOUS)]
    assert told == [f"{SUSPICIOUS}over 30 km from any land; is the CRS right?"]


def test_a_crs_that_is_not_for_the_place_is_told(tmp_path):
    path = tmp_path / "far.csv"
    path.write_text("id,x,y,code\n1,900000,900000,B1\n2,900100,900000,B1\n", encoding="utf-8")
    told = [name for name in read_signs(path, crs="EPSG:31370").found if name.startswith(SUSPICIOUS)]
    assert any("Belgium" in name for name in told)


# ---- heads of tables, and empty ones ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "# exported by a tool\n# in 2020\nid,lon,lat,code\n1,8.4,49.0,DE:205\n",
        "sep=;\nid;lon;lat;code\n1;8,4;49,0;DE:205\n",
        "ID;Längengrad;Breitengrad;Zeichen\n1;8,4;49,0;DE:205\n",
        "id,lon,lat,sign\n1,8.4,49.0,DE:205\n",
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "cp1252"])
def test_what_stands_before_and_in_the_header(tmp_path, text, encoding):
    path = tmp_path / "signs.csv"
    path.write_bytes(text.encode(encoding))
    row = read_signs(path).table.to_pylist()[0]
    assert (row["sign_class"], row["bbox"]["xmin"], row["bbox"]["ymin"]) == ("yield", 8.4, 49.0)


def test_a_collection_without_features_is_an_empty_layer(tmp_path):
    path = tmp_path / "empty.geojson"
    path.write_text('{"type": "FeatureCollection", "features": []}', encoding="utf-8")
    assert read_signs(path).table.num_rows == 0


def test_a_table_whose_positions_cannot_be_read_is_refused(tmp_path):
    path = tmp_path / "dms.csv"
    path.write_text('id,lon,lat,code\n1,"8 east","49 north",DE:205\n', encoding="utf-8")
    with pytest.raises(InputError, match="none of 1 rows has a position that can be used"):
        read_signs(path)


@pytest.mark.parametrize(
    ("name", "cell"),
    [
        ("location", '"60.17, 24.94"'),
        ("coordinates", '"(60.17,24.94)"'),
        ("GPS", "60.17 24.94"),
        ("lon_lat", '"24.94, 60.17"'),
        ("latlng", '"60,17; 24,94"'),
    ],
)
def test_both_coordinates_in_one_column(write, name, cell):
    layer = read_signs(write(f"code,{name}\nFI:B6,{cell}\nFI:B5,somewhere\n", "signs.csv"))
    assert lonlat(layer.table) == ([24.94], [60.17])
    assert layer.skipped == {"coordinates that are no number": 1}


def test_a_street_beside_coordinates_is_no_place(write):
    layer = read_signs(write("code,location,lon,lat\nFI:B6,Mannerheimintie 1,24.94,60.17\n", "signs.csv"))
    assert lonlat(layer.table) == ([24.94], [60.17])


def test_esri_json(write):
    sets = {
        "geometryType": "esriGeometryPoint",
        "spatialReference": {"wkid": 3067},
        "fields": [{"name": "merkkikoodi", "type": "esriFieldTypeString", "length": 9}],
        "features": [{"attributes": {"merkkikoodi": "FI:B6"}, "geometry": {"x": 385000.0, "y": 6672000.0}}],
    }
    layer = read_signs(write(json.dumps(sets), "signs.json"))
    assert column(layer, "concept") == ["stop"]
    (lon,), (lat,) = lonlat(layer.table)
    assert Transformer.from_crs(4326, 3067, always_xy=True).transform(lon, lat) == pytest.approx((385000.0, 6672000.0))
