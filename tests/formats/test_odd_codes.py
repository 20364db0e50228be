"""Codes that nobody foresaw, in every format: kept as they are, each a class of its own, none dropped, all listed."""

from __future__ import annotations

import csv
import json
from xml.sax.saxutils import quoteattr

import geopandas
import pytest

from geofleet.formats.layers import read_layer
from geofleet.steps.ingest_detections import ingest_detections
from geofleet.tables.schemas import DETECTIONS
from geofleet.tables.store import read_table
from geofleet.taxonomy import load_taxonomy
from geofleet.workflows.info import info

# Of one plate each, in every grammar
UNKNOWN = [
    *(
        "?",
        "0",
        "-1",
        "{x",
        "null",
        "NaN",
        "206",
        "274-30",
        "raw:206",
        "DE:",
        "XX:999",
        "XX:foo bar",
        "x/y",
        "Ü99",
        "🚸",
    ),
    *("日本:とまれ", "regulatory--unknown-thing--g1", "object--banner", "DE:274]30[", "DE:raw:206", "a" * 240, "1e999"),
    *("zone:no parking", "<stop>", "'stop\"", "raw:", "hazards", "DE:Ü99", "9" * 40),
]
# What is written so often that it must not be lost: value, and classes of its plates
KNOWN = {
    "DE:274[30],DE:1010-51;DE:237": ["speed_limit:30", "plate_vehicle", "cycleway"],
    "DE:260;DE:1020-30[Anlieger frei]": ["no_motor_vehicles", "plate_except"],
    "DE:274[[30]]": ["speed_limit:30"], "DE:274[30": ["speed_limit:30"], "de:274-30": ["speed_limit:30"],
    "De:206": ["stop"], " DE:239 ": ["footway"], "DE:250;;;DE:254": ["no_vehicles", "no_bicycles"],
    "FI:361[50]": ["speed_limit:50"], "US:R1-1": ["stop"], "BE:C43[50]": ["speed_limit:50"],
    "FR:B14[50]": ["speed_limit:50"], "NL:A1[30]": ["speed_limit:30"], "CH:3.01": ["stop"],
    "DE:274.1-30": ["speed_zone:30"], "DE:274.2-30": ["end_speed_zone:30"], "DE:274[abc]": ["speed_limit"],
    "maxspeed;city_limit": ["speed_limit", "built_up_area"], "hazard": ["other_danger"], "stop": ["stop"],
    "yes": ["unspecified"], "no": ["no_sign"], "none": ["no_sign"], "DE:206;DE:206": ["stop", "stop"],
}  # fmt: skip
INVENTORIES = ("csv", "geojson", "gpkg", "fgb", "shp", "parquet")


def lat(place):
    return 52 + place / 1000


def nodes(codes):
    return "".join(
        f'<node id="{n + 1}" lat="{lat(n)}" lon="13"><tag k="traffic_sign" v={quoteattr(code)}/></node>'
        for n, code in enumerate(codes)
    )


def overpass(codes):
    elements = [
        {"type": "node", "id": n + 1, "lat": lat(n), "lon": 13, "tags": {"traffic_sign": code}}
        for n, code in enumerate(codes)
    ]
    return json.dumps({"version": 0.6, "elements": elements})


def lanelet2(codes):
    ways = "".join(
        f'<node id="{2 * n + 1}" lat="{lat(n)}" lon="13"/><node id="{2 * n + 2}" lat="{lat(n)}" lon="13.00001"/>'
        f'<way id="{n + 1000}"><nd ref="{2 * n + 1}"/><nd ref="{2 * n + 2}"/><tag k="type" v="traffic_sign"/>'
        f'<tag k="subtype" v={quoteattr(code)}/></way>'
        for n, code in enumerate(codes)
    )
    lanelet = '<relation id="8"><member type="way" ref="1000" role="left"/><member type="way" ref="1001" role="right"/>'
    return f'<osm version="0.6">{ways}{lanelet}<tag k="type" v="lanelet"/></relation></osm>'


def opendrive(codes):
    signals = "".join(
        f'<signal s="{n + 1}" t="-5" id="{n}" dynamic="no" orientation="+" zOffset="2" country="SE" subtype="-1" '
        f'value="-1" type={quoteattr(code)}/>'
        for n, code in enumerate(codes)
    )
    return (
        '<OpenDRIVE><header revMajor="1" revMinor="6"><geoReference>EPSG:25832</geoReference></header><road id="1" '
        'length="200" junction="-1"><planView><geometry s="0" x="500000" y="5400000" hdg="0" length="200"><line/>'
        '</geometry></planView><lanes><laneSection s="0"><center><lane id="0"/></center></laneSection></lanes>'
        f"<signals>{signals}</signals></road></OpenDRIVE>"
    )


TEXTS = {
    "odd.osm": lambda codes: f'<osm version="0.6">{nodes(codes)}</osm>',
    "odd.json": overpass,
    "lanelet2.osm": lanelet2,
    "odd.xodr": opendrive,
}


def write(folder, name, codes):
    path = folder / name
    if name in TEXTS:
        path.write_text(TEXTS[name](codes), encoding="utf-8")
    elif path.suffix == ".csv":
        with path.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows([["lon", "lat", "code"], *([13, lat(n), code] for n, code in enumerate(codes))])
    else:
        points = geopandas.points_from_xy([13.0] * len(codes), [lat(n) for n in range(len(codes))])
        frame = geopandas.GeoDataFrame({"code": codes}, geometry=points, crs=4326)
        if path.suffix == ".parquet":
            frame.to_parquet(path)
        elif path.suffix == ".geojson":
            path.write_text(frame.to_json(), encoding="utf-8")
        else:
            frame.to_file(path, encoding="utf-8")
    return path


@pytest.mark.parametrize("name", [*TEXTS, *(f"odd.{suffix}" for suffix in INVENTORIES)])
def test_an_unknown_code_is_a_row_a_class_and_a_line_of_info(name, tmp_path):
    untyped = {"-1", "null"} if name.endswith(".xodr") else set()  # which is how OpenDRIVE says that there is no type
    codes = [code for code in UNKNOWN if code not in untyped]
    path = write(tmp_path, name, [*codes, *codes[:3]])
    rows = read_layer(path).table.to_pylist()
    assert len(rows) == len(codes) + 3
    raw = [row["raw_code"] for row in rows]
    assert sorted(raw) == sorted([*codes, *codes[:3]])
    for row in rows:
        bare = row["raw_code"].removeprefix(f"{row['country']}:")
        assert row["sign_class"] in {f"raw:{row['raw_code']}", f"raw:{bare}", bare}
        assert bare != row["sign_class"] or bare.startswith("raw:")
    assert len({row["sign_class"] for row in rows if row["raw_code"] != "DE:raw:206"}) >= len(codes) - 3
    listed = info(path).unknown_codes
    assert sum(listed.values()) == len(rows)
    assert all(any(code.endswith(one.rpartition("raw:")[2]) for code in listed) for one in codes)


@pytest.mark.parametrize("name", ["odd.osm", "odd.json", *(f"odd.{suffix}" for suffix in INVENTORIES)])
def test_values_of_openstreetmap_are_understood_wherever_they_stand(name, tmp_path):
    found = {}
    for row in read_layer(write(tmp_path, name, list(KNOWN))).table.to_pylist():
        found.setdefault(round(row["bbox"]["ymin"], 4), []).append(row["sign_class"])
    assert [sorted(found[round(lat(n), 4)]) for n in range(len(KNOWN))] == [sorted(one) for one in KNOWN.values()]


@pytest.mark.parametrize("scheme", ["", "osm", "mapillary"])
def test_detections_of_unknown_codes_are_kept(scheme, tmp_path):
    path = tmp_path / "fleet.csv"
    with path.open("w", newline="", encoding="utf-8") as file:
        lines = ([13, lat(n), code, "p1"] for n, code in enumerate(UNKNOWN))
        csv.writer(file).writerows([["lon", "lat", "raw_code", "pass_id"], *lines])
    result = ingest_detections([path], tmp_path / "out.parquet", **({"scheme": scheme} if scheme else {}))
    rows = read_table(DETECTIONS, tmp_path / "out.parquet").to_pylist()
    assert (result.n_rows, result.n_rejected) == (len(UNKNOWN), 0)
    assert sorted(row["raw_code"] for row in rows) == sorted(UNKNOWN)
    assert all(row["sign_class"].startswith("raw:") for row in rows)
    assert sum(info(tmp_path / "out.parquet").unknown_codes.values()) == len(UNKNOWN)


def test_a_code_without_any_text_is_a_sign_that_nobody_described(tmp_path):
    rows = read_layer(write(tmp_path, "odd.csv", ["", "  ", "206"]), country="DE").table.to_pylist()
    assert sorted(row["sign_class"] for row in rows) == ["stop", "unspecified", "unspecified"]


def test_a_code_that_names_another_country_is_looked_up_there():
    taxonomy = load_taxonomy()
    assert taxonomy.meaning("US:R1-1", country="DE").sign_class == "stop"
    assert taxonomy.meaning("CA:R2-1[35]", country="US").sign_class == "speed_limit:35mph"  # California's
    assert not taxonomy.meaning("XX:R1-1", country="DE").known
    assert not taxonomy.meaning("US:R1-1", scheme="vienna").known
