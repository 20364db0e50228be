from __future__ import annotations

import json
from datetime import UTC, datetime

import geopandas
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely

from geofleet.errors import ConfigError, InputError
from geofleet.formats.detections import read_detections
from geofleet.tables.store import lonlat


def csv_file(tmp_path, text, name="fleet.csv", encoding="utf-8"):
    path = tmp_path / name
    path.write_text(text, encoding=encoding)
    return path


def one(path, **options):
    (read,) = read_detections(path, **options)
    return read


def test_position_and_class_are_enough(tmp_path):
    read = one(csv_file(tmp_path, "lon,lat,sign_class\n8.5,53.1,speed_limit:50\n8.6,53.2,stop\n"))
    rows = read.table.to_pylist()
    assert [row["sign_class"] for row in rows] == ["speed_limit:50", "stop"]
    assert [row["pass_id"] for row in rows] == ["row-0000000001", "row-0000000002"]
    assert [(row["run_id"], row["vehicle_id"], row["track_id"]) for row in rows] == [("fleet", "fleet", 0)] * 2
    assert all(rows[0][name] is None for name in ("t_first", "n_frames", "sigma_e_m", "class_confidence", "view_deg"))
    assert read.rejected.num_rows == 0


def test_every_column_by_other_names_in_another_crs(tmp_path):
    text = "E;N;label;car;trip;nr;seen;F;conf\n 486000,5;5885000,25;274.1[30];7;t1;3;2024-05-01 12:00:00+02:00;9;0,75\n"
    columns = {"x": "E", "y": "N", "code": "label", "vehicle_id": "car", "pass_id": "trip", "track_id": "nr"}
    columns |= {"t_first": "seen", "n_frames": "F", "class_confidence": "conf"}
    read = one(csv_file(tmp_path, text), columns=columns, crs="EPSG:25832", country="DE", run_id="pilot")
    (row,) = read.table.to_pylist()
    lon, lat = lonlat(read.table)
    assert (lon[0], lat[0]) == pytest.approx((8.79, 53.12), abs=0.01)
    assert (row["run_id"], row["vehicle_id"], row["pass_id"], row["track_id"]) == ("pilot", "7", "7/t1", 3)
    assert (row["raw_code"], row["country"], row["class_confidence"], row["n_frames"]) == ("274.1[30]", "DE", 0.75, 9)
    assert row["t_first"] == datetime(2024, 5, 1, 10, tzinfo=UTC)
    assert not row["sign_class"].startswith("raw:")


def test_bad_rows_come_back_with_reason_number_and_text(tmp_path):
    text = (
        "lon,lat,code\n8,53,DE:206\nNaN,53,DE:206\nhello,53,DE:206\n8,99,DE:206\n8,53,\n0,0,DE:206\n8,53\n8,53,DE:205\n"
    )
    read = one(csv_file(tmp_path, text), scheme="osm")
    assert read.table.num_rows == 2
    reasons = {row["row"]: row["reason"] for row in read.rejected.to_pylist()}
    assert reasons[2] == reasons[3] == "position missing or no number"
    assert reasons[4] == "position out of range"
    assert reasons[5] == "class missing"
    assert "Gulf of Guinea" in reasons[6]
    assert sum(read.skipped.values()) == read.rejected.num_rows == 6
    assert any("another number of fields" in reason for reason in read.skipped)
    assert "hello" in "".join(read.rejected["content"].to_pylist())


def test_what_cannot_be_read_in_an_optional_column_is_missing_and_counted(tmp_path):
    text = "lon,lat,sign_class,n_frames,t_first\n8,53,stop,many,yesterday\n8,53,stop,4,1714557600\n"
    read = one(csv_file(tmp_path, text))
    assert read.table["n_frames"].to_pylist() == [None, 4]
    assert read.table.num_rows == 2
    assert read.found["n_frames that cannot be read, left out"] == 1
    assert read.found["t_first that cannot be read, left out"] == 1


def test_geojson_with_schemes_guessed(tmp_path):
    codes = ["regulatory--stop--g1", "regulatory--yield--g1"]
    features = [
        {"type": "Feature", "properties": {"value": c}, "geometry": {"type": "Point", "coordinates": [8.8, 53.1]}}
        for c in codes
    ]
    path = csv_file(tmp_path, json.dumps({"type": "FeatureCollection", "features": features}), "fleet.geojson")
    read = one(path)
    assert read.table["sign_class"].to_pylist() == ["stop", "yield"]
    assert read.table["raw_code"].to_pylist() == codes
    assert read.found["codes read as mapillary (guessed)"] == 1


def test_parquet_with_numbers_dictionaries_times_and_wkb(tmp_path):
    table = pa.table(
        {
            "geometry": pa.array([shapely.to_wkb(shapely.Point(8.8, 53.1)), None], pa.binary()),
            "sign_class": pa.array(["stop", "stop"]).dictionary_encode(),
            "vehicle_id": pa.array([7.0, 8.0]),
            "pass_id": pa.array([1, 2]),
            "t_first": pa.array(np.array(["2024-05-01", "2024-05-02"], "datetime64[ns]")),
        }
    )
    pq.write_table(table, tmp_path / "fleet.parquet")
    read = one(tmp_path / "fleet.parquet")
    (row,) = read.table.to_pylist()
    assert (row["vehicle_id"], row["pass_id"]) == ("7", "7/1")
    assert row["t_first"] == datetime(2024, 5, 1, tzinfo=UTC)
    assert read.skipped == {"position missing or no number": 1}


def test_letters_of_windows_far_down_are_read_and_told_and_broken_lines_kept(tmp_path):
    row = b"8.8,53.1,stop,a\n"
    path = tmp_path / "fleet.csv"
    path.write_bytes(b"lon,lat,sign_class,vehicle_id\n" + row * 80_000 + b"8.8,53.1,stop,M\xfcller,too,many\n" + row)
    read = list(read_detections(path))
    assert sum(part.table.num_rows for part in read) == 80_001
    (rejected,) = [line for part in read for line in part.rejected["content"].to_pylist()]
    assert rejected == "8.8,53.1,stop,M\u00fcller,too,many"
    assert read[0].found["read as Windows-1252, since it is not UTF-8"] == 1


def test_options_from_a_toml_file(tmp_path):
    toml = csv_file(tmp_path, 'crs = "EPSG:4326"\nscheme = "osm"\n[columns]\nx = "a"\ny = "b"\ncode = "c"\n', "m.toml")
    read = one(csv_file(tmp_path, "a,b,c\n8,53,stop\n"), columns=toml)
    assert read.table["sign_class"].to_pylist() == ["stop"]
    with pytest.raises(ConfigError, match="colour"):
        one(csv_file(tmp_path, "a,b,c\n8,53,stop\n"), columns={"colour": "c"})
    with pytest.raises(ConfigError, match=r"no column 'z'.*a, b, c"):
        one(csv_file(tmp_path, "a,b,c\n8,53,stop\n"), columns={"x": "z"})


@pytest.mark.parametrize("suffix", [".gpkg", ".fgb", ".shp", ".geojson"])
def test_detections_of_a_gis(tmp_path, suffix):
    points = geopandas.points_from_xy([485000.0, 485100.0], [5885000.0, 5885100.0], crs="EPSG:25832")
    frame = geopandas.GeoDataFrame({"code": ["274.1[30]", "206"], "car": [7, 8]}, geometry=points)
    path = tmp_path / f"fleet{suffix}"
    (frame.to_crs(4326) if suffix == ".geojson" else frame).to_file(path)
    read = one(path, columns={"vehicle_id": "car"}, country="DE")
    columns = (read.table["vehicle_id"].to_pylist(), read.table["sign_class"].to_pylist(), *lonlat(read.table))
    found = {vehicle: (sign_class, x, y) for vehicle, sign_class, x, y in zip(*columns, strict=True)}
    places = frame.to_crs(4326).get_coordinates().to_numpy()
    for vehicle, sign_class, place in zip(("7", "8"), ("speed_zone:30", "stop"), places, strict=True):
        assert found[vehicle][0] == sign_class
        assert found[vehicle][1:] == pytest.approx(tuple(place), abs=1e-8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("lon,lat,sign_class\n53.1,508.8,stop\n", "no longitudes and latitudes"),
        ("lon,lat,sign_class\n0.1,0.1,stop\n0.2,0.1,stop\n", "Gulf of Guinea.*the CRS is wrong"),
        ("lon,lat,code,country\n53.1,8.8,206,DE\n", None),
        ("a,b\n1,2\n", "looks like a position"),
        ("lon,lat\n1,2\n", "looks like a class"),
        ("lon,lat,code", "holds no rows"),
        ("<html>", "no format of detections"),
    ],
)
def test_what_makes_no_sense_is_named(tmp_path, text, message):
    path = csv_file(tmp_path, text)
    if message is None:
        with pytest.raises(InputError, match=r"outside of DE.*axes swapped"):
            one(path, country="DE")
        return
    with pytest.raises(InputError, match=message) as caught:
        one(path)
    assert str(path) in str(caught.value)


def test_a_line_without_end_is_refused_by_its_number(tmp_path):
    path = csv_file(tmp_path, "lon,lat,code\n8,53,206\n" + "8" * (2 << 20))
    with pytest.raises(InputError, match="line 3: the line is longer"):
        list(read_detections(path))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.99])
def test_a_truncated_parquet_file_is_refused(tmp_path, share):
    path = tmp_path / "fleet.parquet"
    pq.write_table(pa.table({"lon": [8.0] * 99, "lat": [53.0] * 99, "sign_class": ["stop"] * 99}), path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(InputError, match="damaged"):
        list(read_detections(path))


def test_values_of_openstreetmap_name_their_country_or_none(tmp_path):
    read = one(csv_file(tmp_path, "lon,lat,code\n8,53,DE:274[50]\n8,53,stop\n8,53,FI:361[40]\n"), scheme="osm")
    assert read.table["sign_class"].to_pylist() == ["speed_limit:50", "stop", "speed_limit:40"]
    assert "codes that the vocabulary does not know" not in read.found


def test_track_ids_of_text_become_numbers_that_stay_the_same(tmp_path):
    text = "pass_id,track_id,lon,lat,code\np,3,13,52,n\np,a7,13,52,a\nq,a7,13,52,a\np,b,13,52,b\n"
    rows = one(csv_file(tmp_path, text)).table.to_pylist()
    tracks = {row["raw_code"]: {r["track_id"] for r in rows if r["raw_code"] == row["raw_code"]} for row in rows}
    assert tracks["n"] == {3}
    assert len(tracks["a"]) == len(tracks["b"]) == 1
    assert tracks["a"] != tracks["b"]
    again = one(csv_file(tmp_path, "pass_id,track_id,lon,lat,code\np,a7,13,52,a\n", "b.csv"))
    assert set(again.table["track_id"].to_pylist()) == tracks["a"]


@pytest.mark.parametrize(
    ("header", "values", "reason"),
    [
        ("sigma_e_m,sigma_n_m,cov_en_m2", "0.5,0.5,0.3", "cov_en_m2 beyond what the sigmas allow"),
        ("sigma_e_m,sigma_n_m,cov_en_m2", "0.5,0.5,0.25", None),
        ("sigma_e_m", "-0.1", "sigma_e_m below zero"),
        ("class_confidence", "90", "class_confidence outside of 0 to 1"),
        ("range_mean_m", "-1", "range_mean_m below zero"),
        ("n_frames", "0", "n_frames below one"),
        ("t_last,t_first", "2024-01-01T00:00:00Z,2024-01-01T00:00:01Z", "t_last before t_first"),
    ],
)
def test_what_no_detection_can_have_is_left_out_and_told(tmp_path, header, values, reason):
    read = one(csv_file(tmp_path, f"lon,lat,class,{header}\n13,52,stop,{values}\n"))
    last = header.split(",")[-1] if "cov" in header else header.split(",")[0]
    assert (read.table[last][0].as_py() is None) == (reason is not None)
    assert not reason or read.found[f"{reason}, left out"] == 1


def test_swapped_axes_are_refused_where_the_rows_name_their_country(tmp_path):
    rows = "".join(f"52.{n},13.{n},206,DE\n" for n in range(3))
    with pytest.raises(InputError, match=r"outside of DE, and inside with the axes swapped"):
        one(csv_file(tmp_path, "lon,lat,code,country\n" + rows))


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(InputError, match=r"a folder, not a file.*/\*"):
        one(tmp_path)


def test_classes_that_name_no_concept_are_told(tmp_path):
    read = one(
        csv_file(tmp_path, "lon,lat,sign_class\n13,52,stop\n13,52,Stop Sign\n13,52,raw:x\n13,52,speed_limit:30\n")
    )
    assert read.table["sign_class"].to_pylist() == ["stop", "Stop Sign", "raw:x", "speed_limit:30"]
    assert read.found["codes that the vocabulary does not know"] == 1


def test_text_of_parquet_that_is_not_utf_8_is_refused(tmp_path):
    text = pa.array([b"stop", b"\xff\xfe"]).view(pa.string())
    pq.write_table(pa.table({"lon": [13.0, 13.1], "lat": [52.0, 52.1], "sign_class": text}), tmp_path / "fleet.parquet")
    with pytest.raises(InputError, match=r"damaged or not parquet.*UTF8"):
        list(read_detections(tmp_path / "fleet.parquet"))


def test_detections_as_spreadsheets_and_phones_write_them(tmp_path):
    path = tmp_path / "fleet.csv"
    path.write_text(
        "Fahrzeug;Zeit;Breite;Länge;Zeichen;Konfidenz\n"
        "v1;Thu Mar 21 14:05:06 GMT+01:00 2024;48°06'00\"N;11°30'00\"E;206;90%\n"
        "v1;20240321130507;48,1001° N;11,5° E;Zeichen 274-50;0,8\n"
        "v1;2024-03-21 13:05:08Z;4806.0120N;01130.0000E;205;sure\n",
        encoding="cp1252",
    )
    (read,) = read_detections(path)
    assert read.table["vehicle_id"].to_pylist() == ["v1"] * 3
    assert [t.isoformat() for t in read.table["t_first"].to_pylist()] == [
        f"2024-03-21T13:05:0{s}+00:00" for s in (6, 7, 8)
    ]
    np.testing.assert_allclose(lonlat(read.table), ([11.5] * 3, [48.1, 48.1001, 48.1002]))
    assert read.table["sign_class"].to_pylist() == ["stop", "speed_limit:50", "yield"]
    assert read.table["class_confidence"].to_pylist() == [0.9, 0.8, None]
    assert read.found["class_confidence that cannot be read, left out"] == 1


def test_frames_in_place_of_tracks_are_told(tmp_path):
    path = tmp_path / "fleet.csv"
    path.write_text("pass_id,track_id,frame,lat,lon,class\n" + "".join(f"p,1,{n},48.1,11.5,stop\n" for n in range(5)))
    (read,) = read_detections(path)
    assert [n for what, n in read.found.items() if "a track that came before" in what] == [4]
