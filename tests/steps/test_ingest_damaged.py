"""Damage to files of every kind, through the whole of `ingest`: a valid table, or one message and nothing written."""

from __future__ import annotations

import bz2
import gzip
import json
import random
import re

import geopandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from geofleet.errors import GeofleetError
from geofleet.steps.ingest import ingest_drive, ingest_lanes, ingest_signs
from geofleet.steps.ingest_detections import ingest_detections
from geofleet.tables.schemas import DETECTIONS, DRIVES, LANES, SIGNS
from geofleet.tables.store import read_table
from geofleet.workflows.info import info

STEPS = {
    "signs": (ingest_signs, SIGNS),
    "lanes": (ingest_lanes, LANES),
    "drive": (ingest_drive, DRIVES),
    "detections": (ingest_detections, DETECTIONS),
}
ROUNDS = 12
TOKENS = [
    *(b"nan", b"1e999", b"-1", b"0", b"", b"99999999999999999999", b"\xff\xfe", b"\x00", b'"', b"<", b"1,5", b"null"),
    *(b"2024-02-30T00:00:00Z", b"0001-01-01T00:00:00Z", b"a" * 300, b"1e-320", b"\n", b"{}"),
]
XODR = (
    '<OpenDRIVE><header revMajor="1" revMinor="6"><geoReference>EPSG:25832</geoReference></header>'
    '<road id="1" length="100" junction="-1"><planView><geometry s="0" x="500000" y="5400000" hdg="0" length="100">'
    '<spiral curvStart="0" curvEnd="0.01"/></geometry></planView><lanes><laneSection s="0"><center><lane id="0"/>'
    '</center><right><lane id="-1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></right>'
    '</laneSection></lanes><signals><signal s="50" t="-5" id="7" dynamic="no" orientation="+" zOffset="2" country="DE" '
    'type="274" subtype="50" value="50"/></signals></road></OpenDRIVE>'
)
LANELET2 = (
    '<osm version="0.6"><node id="1" lat="49.0" lon="8.0"/><node id="2" lat="49.001" lon="8.0"/>'
    '<node id="3" lat="49.0" lon="8.0001"/><node id="4" lat="49.001" lon="8.0001"><tag k="mgrs_code" v="32UMV"/>'
    '<tag k="local_x" v="1"/><tag k="local_y" v="2"/></node><way id="5"><nd ref="1"/><nd ref="2"/></way>'
    '<way id="6"><nd ref="3"/><nd ref="4"/></way><way id="7"><nd ref="1"/><nd ref="3"/><tag k="type" v="traffic_sign"/>'
    '<tag k="subtype" v="de205"/></way><relation id="8"><member type="way" ref="5" role="left"/>'
    '<member type="way" ref="6" role="right"/><tag k="type" v="lanelet"/></relation></osm>'
)
OSM = (
    '<osm version="0.6"><node id="1" lat="52.5" lon="13.4"><tag k="traffic_sign" v="DE:274[30],1040;stop"/></node>'
    '<node id="2" lat="52.4" lon="13.4"/><node id="3" lat="52.6" lon="13.4"/><way id="4"><nd ref="2"/><nd ref="3"/>'
    '<tag k="highway" v="residential"/><tag k="maxspeed" v="30"/></way></osm>'
)
GEOJSON = {
    "type": "FeatureCollection",
    "features": [
        {
            "type": "Feature",
            "properties": {"code": "206", "facing": "N", "sign_class": "stop", "first_seen_at": 1577836800000},
            "geometry": {"type": "Point", "coordinates": [13.4 + n / 100, 52.5]},
        }
        for n in range(4)
    ],
}
OVERPASS = {
    "version": 0.6,
    "elements": [
        {"type": "node", "id": 1, "lat": 52.5, "lon": 13.4, "tags": {"traffic_sign": "DE:206"}},
        {
            "type": "way",
            "id": 2,
            "nodes": [1],
            "geometry": [{"lat": 52.5, "lon": 13.4}],
            "tags": {"highway": "service"},
        },
    ],
}
EPOCHS = [(s, 48 + s * 1e-4, 11.5) for s in range(20)]
POS = "%  GPST  latitude(deg) longitude(deg)  height(m)   Q  ns\n" + "".join(
    f"2024/05/01 12:00:{s:06.3f} {lat:.7f} {lon:.7f} 512.1 1 12 0.01 0.01 0.02 0 0 0 1 3\n" for s, lat, lon in EPOCHS
)
NMEA = "".join(f"$GPGGA,1200{s:02d}.00,48{s / 100:07.4f},N,01130.0000,E,4,12,0.6,512,M,47,M,1,0\n" for s, *_ in EPOCHS)
GPX = "".join(
    f'<trkpt lat="{lat}" lon="{lon}"><time>2024-05-01T12:00:{s:02d}Z</time></trkpt>' for s, lat, lon in EPOCHS
)
DRIVE_CSV = "vehicle_id,time,lat,lon\n" + "".join(
    f"v{s % 2},2024-05-01T12:00:{s:02d}Z,{lat},{lon}\n" for s, lat, lon in EPOCHS
)
DETECTIONS_CSV = "lon,lat,sign_class,pass_id,track_id,t_first,n_frames,sigma_e_m\n" + "".join(
    f"{lon},{lat},stop,p{s % 3},{s},2024-05-01T12:00:{s:02d}Z,{s + 1},0.5\n" for s, lat, lon in EPOCHS
)
INVENTORY_CSV = "id;lat;lon;code;facing;first_seen\n" + "".join(
    f"{s};{lat:.4f};{lon:.4f};206;N;2020-01-{s + 1:02d}\n".replace(".", ",") for s, lat, lon in EPOCHS
)
TEXTS = {
    "map.xodr": (XODR, "signs lanes"),
    "lanelet2.osm": (LANELET2, "signs lanes"),
    "map.osm": (OSM, "signs lanes"),
    "overpass.json": (json.dumps(OVERPASS, indent=1), "signs lanes"),
    "signs.geojson": (json.dumps(GEOJSON, indent=1), "signs detections"),
    "signs.csv": (INVENTORY_CSV, "signs"),
    "drive.pos": (POS, "drive"),
    "drive.nmea": (NMEA, "drive"),
    "drive.gpx": (
        f'<gpx version="1.1"><trk><trkseg>{GPX}</trkseg></trk><trk><trkseg>{GPX}</trkseg></trk></gpx>',
        "drive",
    ),
    "drive.csv": (DRIVE_CSV, "drive"),
    "fleet.csv": (DETECTIONS_CSV, "detections"),
}
BINARY = ("map.osm.pbf", "map.osm.gz", "map.osm.bz2", "signs.gpkg", "signs.fgb", "signs.parquet", "fleet.parquet")


@pytest.fixture(scope="module")
def binaries(repo, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    frame = geopandas.GeoDataFrame.from_features(GEOJSON["features"], crs=4326)
    frame.to_file(folder / "signs.gpkg")
    frame.to_file(folder / "signs.fgb", driver="FlatGeobuf")
    frame.to_parquet(folder / "signs.parquet")
    frame.to_parquet(folder / "fleet.parquet")
    packed = {"map.osm.gz": gzip.compress(OSM.encode()), "map.osm.bz2": bz2.compress(OSM.encode())}
    whole = {name: packed.get(name) or (folder / name).read_bytes() for name in BINARY if name != "map.osm.pbf"}
    return whole | {"map.osm.pbf": (repo / "data" / "raw" / "helsinki.osm.pbf").read_bytes()}


def damaged(content, draw, *, is_text):
    """Change a word of a text, or bytes of anything: other ones, none, or some of them twice."""
    data = bytearray(content)
    for _ in range(draw.choice((1, 1, 2, 4))):
        at = draw.randrange(len(data))
        words = list(re.finditer(rb"[\w.:+-]+", data[max(0, at - 40) : at + 80])) if is_text else []
        if words and draw.random() < 0.7:
            word = draw.choice(words)
            data[max(0, at - 40) + word.start() : max(0, at - 40) + word.end()] = draw.choice(TOKENS)
            continue
        size = draw.choice((1, 8, 200))
        data[at : at + draw.choice((0, size))] = draw.choice((b"", draw.randbytes(size), bytes(data[:size])))
        if not data:
            return b"\n"
    return bytes(data)


def survives(kind, path, out):
    """Ingest a file; return whether a table came of it."""
    step, schema = STEPS[kind]
    message = ""
    try:
        step([path], out)
    except GeofleetError as error:
        message = str(error)
    if message:
        assert "\n" not in message
        assert not list(out.parent.glob("*"))
        return False
    assert not list(out.parent.glob(".*"))
    read_table(schema, out)
    return True


@pytest.mark.parametrize(
    ("name", "kind"), [(name, kind) for name, (_, kinds) in TEXTS.items() for kind in kinds.split()]
)
def test_damaged_text_gives_a_table_or_one_message(tmp_path, name, kind):
    draw = random.Random(f"{name} {kind}")  # noqa: S311 - damage, not secrets
    content = TEXTS[name][0].encode()
    path = tmp_path / name
    path.write_bytes(content)
    assert survives(kind, path, tmp_path / "whole" / "out.parquet")
    for n in range(ROUNDS):
        path.write_bytes(damaged(content, draw, is_text=True))
        survives(kind, path, tmp_path / str(n) / "out.parquet")


@pytest.mark.parametrize("name", BINARY)
def test_damaged_binaries_give_a_table_or_one_message(tmp_path, name, binaries):
    draw = random.Random(name)  # noqa: S311 - as above
    kind = "detections" if name.startswith("fleet") else "signs"
    path = tmp_path / name
    path.write_bytes(binaries[name])
    assert survives(kind, path, tmp_path / "whole" / "out.parquet")
    for n in range(ROUNDS):
        path.write_bytes(damaged(binaries[name], draw, is_text=False))
        survives(kind, path, tmp_path / str(n) / "out.parquet")


def test_a_car_whose_name_is_a_null_character_keeps_its_epochs(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text(DRIVE_CSV.replace("v0,", "\0,", 1))
    assert survives("drive", path, tmp_path / "out" / "out.parquet")


def test_an_empty_point_is_a_detection_without_a_position(tmp_path):
    features = [GEOJSON["features"][0] | {"geometry": {"type": "Point", "coordinates": []}}, *GEOJSON["features"][1:]]
    path = tmp_path / "fleet.geojson"
    path.write_text(json.dumps(GEOJSON | {"features": features}))
    result = ingest_detections([path], tmp_path / "out.parquet")
    assert (result.n_rows, result.skipped) == (3, {"position missing or no number": 1})


def test_years_of_no_clock_are_no_times(tmp_path):
    path = tmp_path / "drive.pos"
    path.write_text(POS.replace("2024/05/01 12:00:05", "-1/05/01 12:00:05"))
    result = info(path)
    assert result.skipped["epochs without a time"] == 1
    assert result.t_first.startswith("2024-05-01")
    times = pa.array([10**18, None, 10**15], pa.timestamp("us", "UTC"))
    for column, said in (("t_first", "t_first that cannot be read, left out"), ("first_seen", "dates that cannot be")):
        table = {"lon": [13.4] * 3, "lat": [52.5] * 3, column: times, "code": ["206"] * 3}
        table |= {"pass_id": ["a"] * 3} if column == "t_first" else {}
        pq.write_table(pa.table(table), tmp_path / "far.parquet")
        far = info(tmp_path / "far.parquet")
        assert far.t_first.startswith("2001-09-09")
        assert [n for name, n in far.found.items() if name.startswith(said)] == [1]


def test_a_message_is_one_line_whatever_the_file_holds(tmp_path):
    path = tmp_path / "signs.csv"
    path.write_text('id,"code\n\x1b[31mred\r\n",place\n1,206,here\n')
    assert not survives("signs", path, tmp_path / "out" / "out.parquet")
