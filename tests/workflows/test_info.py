"""What `info` tells of files of every kind, by counts that are known otherwise."""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
import pyarrow as pa
import pytest

from geofleet.cli import main
from geofleet.errors import ConfigError, InputError
from geofleet.formats.datum import datum_of
from geofleet.tables.schemas import DETECTIONS, DRIVES, LANES, SIGNS
from geofleet.tables.store import build_table, write_table
from geofleet.workflows.info import info

CSV = "code;x;y\nB1;152000,5;170000\nC3;152010;170010\nXYZ 1;152020;170020\n"


def test_a_surveyed_city(shared_data):
    found = info(shared_data / "opendrive" / "ingolstadt_cityhall.xodr")
    assert (found.file_format, found.table, found.n_rows) == ("opendrive", "signs", 417)
    assert found.counts["kind"] == {"main": 200, "plate": 107, "other": 52, "light": 30, "marking": 28}
    assert sum(found.counts["concept"].values()) == 417
    assert sum(found.unknown_codes.values()) == found.found["unknown codes"]
    assert found.extent_deg == pytest.approx((11.4221, 48.7587, 11.4262, 48.7629), abs=1e-4)
    assert found.to_wgs84 == "projection only"
    assert found.accuracy_m == 0.0
    assert found.lanes["reference_line"] == 71
    assert found.warnings == ()


def test_a_recorded_drive(shared_data):
    found = info(shared_data / "trajectory" / "nagoya" / "rover_rtk.pos")
    (drive,) = found.drives
    assert (found.file_format, found.table) == ("rtklib", "drives")
    assert drive.n_epochs == found.n_rows == sum(drive.fix_quality.values())
    assert drive.duration_s == pytest.approx(1230.0)
    assert drive.longest_gap_s == pytest.approx(48.6, abs=0.1)  # 47 s in the file; wrong fixes beside it are left out
    assert 3500 < drive.length_m < 4200
    assert found.found["epochs standing still"] > 1000
    assert found.skipped["impossible jumps"] > 0
    assert "base stations" in found.to_wgs84
    assert found.accuracy_m is None


def test_a_national_grid_names_its_transformation(tmp_path):
    (tmp_path / "borden.csv").write_text(CSV)
    found = info(tmp_path / "borden.csv", crs="EPSG:31370")
    assert found.table == "signs"
    assert found.n_rows == 3
    assert "EPSG:31370" in found.crs
    assert "BD72 to WGS 84" in found.to_wgs84
    assert found.accuracy_m >= 0.01
    assert found.unknown_codes == {"BE:XYZ 1": 1}
    assert found.warnings == ()


@pytest.mark.parametrize(
    ("crs", "operation", "accuracy_m", "doubt"),
    [
        ("OGC:CRS84", "none needed", 0.0, ""),
        ("EPSG:32632", "projection only", 0.0, ""),
        ("EPSG:25832", "ETRS89 to WGS 84", 1.0, "null transformation"),
        ("EPSG:4258", "ETRS89 to WGS 84", 1.0, "null transformation"),
        ("EPSG:31467", "DHDN to WGS 84", 3.0, ""),
        ("+proj=tmerc +lon_0=9 +k=0.9996 +x_0=500000 +ellps=GRS80", "Ballpark", None, "does not name a datum"),
    ],
)
def test_the_datum_operation_and_its_accuracy(crs, operation, accuracy_m, doubt):
    found = datum_of(crs, np.array([11.4]), np.array([48.7]))
    assert operation in found.to_wgs84
    assert found.accuracy_m == accuracy_m
    assert doubt in found.doubt
    assert bool(doubt) == bool(found.doubt)


def test_a_datum_taken_as_equal_is_a_warning(tmp_path):
    (tmp_path / "signs.csv").write_text("code,x,y\nDE:206,700000,5400000\nDE:205,700010,5400000\n")
    found = info(tmp_path / "signs.csv", crs="EPSG:25832")
    assert any("up to a metre" in warning for warning in found.warnings)
    assert any(line.strip().startswith("WARNING") for line in found.lines())


def test_suspicious_positions_are_a_warning(tmp_path):
    rows = "".join(f"DE:206,{11.4 + n / 1000},48.7\n" for n in range(9))
    (tmp_path / "signs.csv").write_text(f"code,x,y\n{rows}DE:205,100.0,48.7\n")
    assert any(warning.startswith("SUSPICIOUS") for warning in info(tmp_path / "signs.csv").warnings)


def test_detections_are_told_from_inventories_and_drives_by_their_columns(tmp_path):
    rows = "lon,lat,code,vehicle_id,timestamp\n24.9,60.1,regulatory--stop--g1,7,2024-01-01T00:00:00Z\n"
    (tmp_path / "fleet.csv").write_text(rows + "x,60.1,regulatory--stop--g1,7,\n")
    found = info(tmp_path / "fleet.csv")
    assert (found.table, found.n_rows) == ("detections", 1)
    assert found.counts == {"sign_class": {"stop": 1}}
    assert sum(found.skipped.values()) == 1
    (tmp_path / "drive.csv").write_text(
        "time,lon,lat\n2024-01-01T00:00:00Z,24.9,60.1\n2024-01-01T00:00:01Z,24.9001,60.1\n"
    )
    assert info(tmp_path / "drive.csv").table == "drives"


@pytest.mark.parametrize(
    ("schema", "columns", "geometry"),
    [
        (DRIVES, {"drive_id": "d", "seq": [0, 1], "segment": [0, 1], "source": "x"}, ([24.9, 24.91], [60.1, 60.1])),
        (LANES, {"lane_id": ["a"], "road_id": "r", "kind": "driving", "source": "x"}, None),
        (
            DETECTIONS,
            {"run_id": "r", "vehicle_id": "v", "pass_id": "p", "track_id": [0, 1], "sign_class": ["stop", "raw:9"]},
            ([24.9, 24.91], [60.1, 60.1]),
        ),
    ],
)
def test_tables_of_geofleet(schema, columns, geometry, tmp_path):
    from shapely import LineString  # noqa: PLC0415 (only here)

    places = [LineString([(24.9, 60.1), (24.91, 60.2)])] if geometry is None else tuple(map(np.array, geometry))
    table = build_table(schema, columns, places)
    write_table(schema, table, tmp_path / "table" / "part.parquet")
    for path in (tmp_path / "table" / "part.parquet", tmp_path / "table"):
        if path.is_dir() and not schema.partitions:
            continue
        found = info(path)
        assert (found.table, found.n_rows, found.file_format) == (schema.name, table.num_rows, "geofleet")
        assert found.extent_deg[:2] == (24.9, 60.1)
        assert found.to_wgs84 == "none needed"


def test_long_lists_are_cut_for_people_and_whole_for_machines(make_signs, tmp_path):
    classes = [f"raw:{n}" for n in range(20)]
    signs = make_signs([(n, 0) for n in range(20)], classes, concept=classes)
    write_table(SIGNS, signs, tmp_path / "signs.parquet")
    found = info(tmp_path / "signs.parquet")
    assert len(found.unknown_codes) == 20
    assert any("8 more 8" in line for line in found.lines())
    assert json.loads(json.dumps(asdict(found)))["n_rows"] == 20


def test_a_table_without_geometry_has_no_place(tmp_path):
    from geofleet.tables.schemas import TRUTH  # noqa: PLC0415 (only here)

    columns = {"run_id": "r", "pass_id": "p", "track_id": pa.array([0]), "semantic_correct": True, "is_ghost": False}
    write_table(TRUTH, build_table(TRUTH, columns), tmp_path / "truth.parquet")
    found = info(tmp_path / "truth.parquet")
    assert found.extent_deg is None
    assert len(found.lines()) == 1


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("absent.xodr", None, "no such file"),
        ("empty.pos", b"", "empty"),
        ("picture.png", b"\x89PNG\r\n\x1a\n\0", "not known"),
        ("signs.kml", b"<?xml version='1.0'?><kml><Document/></kml>", "KML, which is not read; `ogr2ogr"),
        ("log.csv", b"Sign list,,\n\nlat,lon,code\n60,24,FI:B6\n", "what stands before the header"),
    ],
)
def test_what_cannot_be_read_is_told(name, content, told, tmp_path):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=told):
        info(tmp_path / name)


def test_options_that_are_not_for_a_file_are_refused(shared_data, tmp_path):
    with pytest.raises(ConfigError, match="scheme"):
        info(shared_data / "trajectory" / "nagoya" / "rover_rtk.pos", scheme="osm")
    with pytest.raises(ConfigError, match="matches"):
        info(shared_data / "trajectory" / "nagoya" / "rover_rtk.pos", table="matches")
    with pytest.raises(InputError, match="no table"):
        info(tmp_path)


def test_the_command_prints_lines_or_one_object_and_refuses_in_one_message(shared_data, tmp_path, capsys, monkeypatch):
    city = str(shared_data / "opendrive" / "ingolstadt_cityhall.xodr")
    for arguments, code in ((["info", city], 0), (["info", city, "--json"], 0), (["info", "absent.pos"], 2)):
        monkeypatch.setattr("sys.argv", ["geofleet", *arguments])
        with pytest.raises(SystemExit) as stop:
            main()
        out, err = capsys.readouterr()
        assert (stop.value.code or 0) == code
        if code:
            assert err == "geofleet: absent.pos: there is no such file. Check the path.\n"
        elif "--json" in arguments:
            assert json.loads(out)["n_rows"] == 417
        else:
            assert "417 signs, OpenDRIVE" in out
    assert not list(tmp_path.iterdir())
