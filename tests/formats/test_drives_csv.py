from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from geofleet.algorithms.geodesy import to_ecef
from geofleet.errors import ConfigError, InputError
from geofleet.formats.drives import detect, read_drive
from geofleet.tables.store import lonlat


def csv_file(tmp_path, text, name="drive.csv"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8", newline="")
    return path


def length_m(table):
    return np.linalg.norm(np.diff(to_ecef(*lonlat(table)), axis=0), axis=1).sum()


@pytest.mark.parametrize(
    ("name", "n", "first", "expected"),
    [
        ("nagoya/reference.csv", 6151, datetime(2023, 7, 11, 6, 4, 12, tzinfo=UTC), (4180, (136.86, 35.14))),
        ("tartu/wp_utm_raadi_to_delta.csv", 1462, None, (3080, (26.71, 58.38))),
        (
            "toronto/radar_poses_2021-08-05-13-34.csv",
            4477,
            datetime(2021, 8, 5, 17, 34, 46, 551599, tzinfo=UTC),
            (7930, (-79.47, 43.78)),
        ),
        ("berlin/Berlin_Potsdamer_Platz_GT.txt", 1372, None, (1550, (13.37, 52.50))),
        ("berlin/Berlin_Gendarmenmarkt_GT.txt", 5921, None, (4890, (13.39, 52.51))),
        (
            "gsdc/gsdc_2021_Pixel4_ground_truth.csv",
            199,
            datetime(2020, 5, 14, 22, 10, 45, 442000, tzinfo=UTC),
            (None, (-122.1, 37.42)),
        ),
    ],
)
def test_shared_trajectories_by_their_profiles(shared_data, name, n, first, expected):
    length, box = expected
    layer = read_drive(shared_data / "trajectory" / name)
    assert layer.table.num_rows + sum(layer.skipped.values()) == n
    assert layer.table["t_utc"][0].as_py() == first
    assert length is None or length_m(layer.table) == pytest.approx(length, rel=0.01)
    assert np.median(np.column_stack(lonlat(layer.table)), axis=0) == pytest.approx(box, abs=0.05)
    assert any(told.startswith("profile ") for told in layer.found)
    assert set(layer.table["segment"].to_pylist()) == {0}


def test_times_from_velocities_give_the_velocities_back(shared_data):
    path = shared_data / "trajectory" / "tartu" / "wp_utm_raadi_to_delta.csv"
    table = read_drive(path).table
    stated = np.loadtxt(path, delimiter=",", skiprows=1, usecols=4)
    moving = stated > 2
    off = np.abs(table["speed_mps"].to_numpy()[moving] / stated[moving] - 1)
    assert np.median(off) < 0.01
    assert off.max() < 0.25  # where it starts and stops


def test_an_origin_that_is_given_wins_over_the_profile(shared_data):
    path = shared_data / "trajectory" / "tartu" / "wp_utm_raadi_to_delta.csv"
    north = lonlat(read_drive(path, origin=(59.385345, 26.726272)).table)[1]
    np.testing.assert_allclose(north - lonlat(read_drive(path).table)[1], 1.0, atol=1e-3)
    by_utm = read_drive(path, utm=("EPSG:32635", 0.0, 6_400_000.0))
    assert not any(told.startswith("origin") for told in by_utm.found)


@pytest.mark.parametrize(
    ("time", "expected"),
    [
        ("2024-05-01T12:00:00Z", datetime(2024, 5, 1, 12, tzinfo=UTC)),
        ("1714564800", datetime(2024, 5, 1, 12, tzinfo=UTC)),
        ("1714564800250", datetime(2024, 5, 1, 12, 0, 0, 250_000, tzinfo=UTC)),
        ("1714564800000000000", datetime(2024, 5, 1, 12, tzinfo=UTC)),
        ("12.5", None),
    ],
)
def test_times_are_told_by_their_size(tmp_path, time, expected):
    layer = read_drive(csv_file(tmp_path, f"timestamp;lat;lon\r\n{time};50;10\r\n"))
    assert layer.table["t_utc"][0].as_py() == expected
    assert any("times read as" in told for told in layer.found)


def test_named_columns_formats_and_crs(tmp_path):
    text = "a,b,c,d\n" + "".join(f"{1398600018 + s},{486000 + 10 * s},5885000,z{s % 2}\n" for s in range(6))
    columns = {"time": "a", "x": "b", "y": "c", "drive": "d", "time_format": "gps_s"}
    table = read_drive(csv_file(tmp_path, text), columns=columns, crs="EPSG:25832").table
    assert table["drive_id"].to_pylist() == ["drive-z0"] * 3 + ["drive-z1"] * 3
    assert table["t_utc"][0].as_py() == datetime(2024, 5, 1, 12, tzinfo=UTC)
    assert table["speed_mps"].to_numpy() == pytest.approx(10, rel=1e-3)
    assert table["heading_deg"].to_numpy() == pytest.approx(90, abs=0.5)


def test_a_toml_file_says_the_same(tmp_path):
    toml = csv_file(tmp_path, 'crs = "EPSG:25832"\n[columns]\nx = "b"\ny = "c"\ntime = "a"\n', "m.toml")
    layer = read_drive(csv_file(tmp_path, "a,b,c\n1714564800,486000,5885000\nx,y,z\n"), columns=toml)
    assert layer.table.num_rows == 1
    assert layer.skipped == {"lines that are no epoch": 1}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"columns": {"colour": "a"}}, "unknown: colour"),
        ({"columns": {"x": "nope"}}, "no column 'nope'"),
        ({"columns": {"x": "lon", "time_format": "lunar"}}, "unknown time_format"),
        ({"crs": "EPSG:4326", "origin": (50.0, 10.0)}, "contradict"),
        ({"origin": (95.0, 10.0)}, "outside of UTM"),
        ({"crs": "EPSG:nope"}, "unknown CRS"),
        ({"crs": "EPSG:4978"}, "third coordinate"),
    ],
)
def test_options_that_make_no_sense_are_named(tmp_path, options, message):
    path = csv_file(tmp_path, "time,lat,lon\n1714564800,50,10\n")
    with pytest.raises(ConfigError, match=message):
        read_drive(path, **options)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,lat,lon\n1,0.1,0.1\n2,0.1,0.2\n", "Gulf of Guinea"),
        ("time,lat,lon\n1,136.9,35.1\n2,136.9,35.2\n", "axes look swapped"),
        ("time,lat,lon\n1,nan,inf\n", "no epoch with a position"),
        ("time,lat,lon\n", "no epoch with a position"),
        ("time,lat,lon\n" + "9" * (2 << 20), "line 2: the line is longer"),
    ],
)
def test_what_makes_no_sense_is_refused(tmp_path, text, message):
    path = csv_file(tmp_path, text)
    assert detect(path.read_bytes()[:4096]) == "csv"
    with pytest.raises(InputError, match=message) as caught:
        read_drive(path)
    assert str(path) in str(caught.value)


def test_an_inventory_is_no_drive():
    assert detect(b"id,lat,lon,code\n1,50,10,206\n") == ""


LINES = [
    ("2024-05-01T12:00:00Z", 48.0, 11.0),
    ("2024-05-01T12:00:01Z", 48.0001, 11.0),
    ("2024-05-01T12:00:02Z", 48.0002, 11.0),
]


def rows(pattern):
    return "".join(pattern.format(t=t, day=t[:10], clock=t[11:19], lat=lat, lon=lon) for t, lat, lon in LINES)


@pytest.mark.parametrize(
    ("text", "encoding"),
    [
        ("time;lat;lon;height\n" + rows("{t};{lat};{lon};500.25\n").replace(".", ","), "utf-8"),
        ("Zeit;Breite;Länge\n" + rows("01.05.2024 {clock};{lat};{lon}\n").replace("48.", "48,"), "cp1252"),
        ("sep=;\ntime;lat;lon\n" + rows("{t};{lat};{lon}\n"), "utf-8-sig"),
        ("# a drive\n\ntime,lat,lon\n" + rows("{t},{lat},{lon}\n"), "utf-8"),
        ("time\tlat\tlon\n" + rows("{t}\t{lat}\t{lon}\n"), "utf-16"),
        ('"time","lat","lon"\n' + rows('"{t}","{lat}","{lon}"\n'), "utf-8"),
        ("date,time,lat,lon\n" + rows("{day},{clock},{lat},{lon}\n"), "utf-8"),
        ("date|lat|lon\n" + rows("{t}|{lat}|{lon}\n"), "utf-8"),
        ("timestamp;lat;lon\n" + "1714564800,0;48;11\n1714564801,0;48,0001;11\n1714564802,0;48,0002;11\n", "utf-8"),
    ],
)
def test_tables_of_spreadsheets_are_read_alike(tmp_path, text, encoding):
    path = tmp_path / "drive.csv"
    path.write_text(text, encoding=encoding, newline="")
    table = read_drive(path).table
    assert table["t_utc"].to_pylist() == [datetime(2024, 5, 1, 12, 0, s, tzinfo=UTC) for s in range(3)]
    np.testing.assert_allclose(lonlat(table), ([11, 11, 11], [48, 48.0001, 48.0002]))


def test_a_date_that_could_be_two_is_told_and_settled_by_an_option(tmp_path):
    path = csv_file(tmp_path, "time,lat,lon\n05/01/2024 12:00:00,48,11\n05/01/2024 12:00:01,48.0001,11\n")
    layer = read_drive(path)
    assert any("day or the month first" in told for told in layer.found)
    assert layer.table["t_utc"].null_count == 2
    toml = csv_file(tmp_path, "day_first = false\n", "m.toml")
    assert read_drive(path, columns=toml).table["t_utc"][0].as_py() == datetime(2024, 5, 1, 12, tzinfo=UTC)


def test_times_without_a_zone_are_taken_as_utc_and_told(tmp_path):
    layer = read_drive(csv_file(tmp_path, "time,lat,lon\n2024-05-01 12:00:00,48,11\n2024-05-01 14:00:01+02:00,48,11\n"))
    assert layer.found["times without a zone, taken as UTC"] == 1
    assert layer.table["t_utc"][1].as_py() == datetime(2024, 5, 1, 12, 0, 1, tzinfo=UTC)


def test_metres_called_x_and_y_are_a_position_once_a_crs_is_known(tmp_path):
    path = csv_file(tmp_path, "t,x,y\n2024-05-01T12:00:00Z,691000,5331000\n")
    with pytest.raises(InputError, match="no columns that look like a position; there are t, x, y"):
        read_drive(path)
    lon, lat = lonlat(read_drive(path, crs="EPSG:25832").table)
    assert (lon[0], lat[0]) == pytest.approx((11.5657, 48.1036), abs=1e-3)


def test_a_drive_in_the_middle_of_the_sea_is_told(tmp_path):
    layer = read_drive(csv_file(tmp_path, "time,lat,lon\n2024-05-01T12:00:00Z,-40,-120\n"))
    assert any("from any land" in told for told in layer.found)


@pytest.mark.parametrize(
    "header",
    ["%time,field.header.seq,field.latitude,field.longitude", "utime,seq,Latitude (deg),Longitude [deg]"],
)
def test_names_as_robots_write_them(tmp_path, header):
    lines = "".join(f"{1714564800_000000000 + s * 10**9},{s},{48 + s * 1e-4},11\n" for s in range(5))
    layer = read_drive(csv_file(tmp_path, f"{header}\n{lines}"))
    assert layer.file_format == "csv"
    assert layer.table["t_utc"][0].as_py() == datetime(2024, 5, 1, 12, tzinfo=UTC)
    np.testing.assert_allclose(lonlat(layer.table)[1], 48 + np.arange(5) * 1e-4)


def test_cars_of_one_file_are_drives_of_their_own(tmp_path):
    lines = "".join(f"v{s % 2},2024-05-01T12:00:{s:02d}Z,{48 + s % 2 + s * 1e-4},11\n" for s in range(10))
    table = read_drive(csv_file(tmp_path, f"vehicle_id,time,lat,lon\n{lines}")).table
    assert table["drive_id"].to_pylist() == ["drive-v0"] * 5 + ["drive-v1"] * 5


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("time,lat,lon", "2024-05-01 12:00:{s:02d} UTC,{lat},11"),
        ("time,lat,lon", "2024-05-01T12:00:{s:02d}GMT,{lat},11"),
        ("gps_week,tow,lat,lon", "2312,{tow},{lat},11"),
        ("time  lat   lon  alt", "{unix}   {lat} 11  512"),
    ],
)
def test_times_and_columns_as_tools_write_them(tmp_path, header, line):
    lines = "".join(line.format(s=s, lat=48 + s * 1e-4, tow=302418 + s, unix=1714564800 + s) + "\n" for s in range(5))
    path = csv_file(tmp_path, f"{header}\n{lines}")
    assert detect(path.read_bytes()) == "csv"
    layer = read_drive(path)
    assert layer.table["t_utc"].to_pylist() == [datetime(2024, 5, 1, 12, 0, s, tzinfo=UTC) for s in range(5)]
    np.testing.assert_allclose(lonlat(layer.table)[1], 48 + np.arange(5) * 1e-4)
    assert min(layer.found.values()) >= 0


def test_times_in_a_zone_that_has_but_a_name_are_told(tmp_path):
    layer = read_drive(csv_file(tmp_path, "time,lat,lon\n2024-05-01 12:00:00 CEST,48,11\n2024-05-01T12:00:01Z,48,11\n"))
    assert any(name.startswith("times that cannot be read") and n == 1 for name, n in layer.found.items())
    assert "times without a zone, taken as UTC" not in layer.found
