from __future__ import annotations

import bz2
import gzip
import io
import random
import zipfile
from datetime import UTC, datetime

import numpy as np
import pytest
from pyproj import Geod, Transformer

from geofleet.algorithms.geodesy import to_ecef
from geofleet.errors import InputError
from geofleet.formats.drive_quality import motion_of
from geofleet.formats.drives import read_drive
from geofleet.formats.gnss_time import LEAP_DAYS, gpst_to_utc
from geofleet.tables.store import lonlat
from geofleet.workflows.anyfile import kind_of

TITLE = "%  {}                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)\n"
TAIL = "  100.0   1   9   0.0100   0.0200   0.0300   0.0   0.0   0.0   0.00    3.0\n"


def pos(tmp_path, text, name="drive.pos"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


def rows(times, lats=None, lon=10.0, tail=TAIL):
    lats = lats or [50.0 + i * 1e-4 for i in range(len(times))]
    return "".join(f"{t}   {lat:.9f}  {lon:.9f}{tail}" for t, lat in zip(times, lats, strict=True))


def first_time(path):
    return read_drive(path).table["t_utc"][0].as_py()


@pytest.mark.parametrize(
    ("name", "n", "quality", "gaps"),
    [
        ("nagoya/reference_1Hz.pos", 1231, {"fixed"}, 0),
        ("nagoya/rover_rtk.pos", 5395, {"fixed", "float"}, 22),
        ("nagoya/rover_1Hz_spp.pos", 550, {"single"}, 26),
        ("nagoya/static_rover_rtk.pos", 301, {"fixed"}, 0),
        ("colorado/demo5_b34f_f.pos", 4521, {"fixed", "float"}, 0),
        ("colorado/gnss_1934_sf.pos", 2197, {"fixed", "float"}, 0),
    ],
)
def test_real_solutions(shared_data, name, n, quality, gaps):
    layer = read_drive(shared_data / "trajectory" / name)
    assert layer.table.num_rows + sum(layer.skipped.values()) == n
    assert set(layer.table["fix_quality"].to_pylist()) == quality
    assert layer.found["gaps"] == gaps
    assert layer.table["seq"].to_pylist() == list(range(layer.table.num_rows))


def test_two_headers_of_one_drive_give_one_time(shared_data):
    by_week = first_time(shared_data / "trajectory" / "nagoya" / "rover_rtk.pos")
    by_date = first_time(shared_data / "trajectory" / "nagoya" / "reference_1Hz.pos")
    assert by_week == by_date == datetime(2023, 7, 11, 6, 4, 12, tzinfo=UTC)  # 06:04:30 GPST


def test_a_height_whose_square_is_no_number_warns_nobody(tmp_path):
    times = [f"2024/05/01 10:00:0{i}.000" for i in range(4)]
    lines = rows(times).splitlines(keepends=True)
    lines[2] = lines[2].replace("  100.0 ", "  1e308 ", 1)
    assert read_drive(pos(tmp_path, TITLE.format("GPST") + "".join(lines))).table.num_rows == 4


def test_the_length_of_a_real_drive(shared_data):
    layer = read_drive(shared_data / "trajectory" / "nagoya" / "reference_1Hz.pos")
    lon, lat = lonlat(layer.table)
    assert np.linalg.norm(np.diff(to_ecef(lon, lat), axis=0), axis=1).sum() == pytest.approx(4180, rel=0.01)
    assert layer.found["epochs standing still"] / 1231 == pytest.approx(0.45, abs=0.01)


def test_a_parked_car_is_one_stop_and_has_no_heading(shared_data):
    layer = read_drive(shared_data / "trajectory" / "nagoya" / "static_rover_rtk.pos")
    assert layer.table["heading_deg"].null_count == 2
    assert layer.found["epochs standing still"] == 301
    assert layer.skipped == {"epochs inside of a stop": 299}


@pytest.mark.parametrize(("name", "n"), [("helsinki_derived", 1284), ("helsinki_derived_b", 1359)])
def test_a_clean_drive_comes_through_quality_control_untouched(repo, name, n):
    layer = read_drive(repo / "data" / "raw" / f"{name}.pos")
    assert layer.table.num_rows == n
    assert layer.skipped == {}
    assert not any(layer.found.values())
    lines = (repo / "data" / "raw" / f"{name}.pos").read_text(encoding="utf-8").splitlines()
    fields = np.array([line.split()[2:4] for line in lines if not line.startswith("%")], float)
    np.testing.assert_array_equal(np.column_stack(lonlat(layer.table)[::-1]), fields)
    # heading and speed as plain central differences on the ellipsoid give them
    lat, lon = fields.T
    azimuth, _, distance_m = Geod(ellps="WGS84").inv(lon[:-2], lat[:-2], lon[2:], lat[2:])
    np.testing.assert_array_equal(layer.table["heading_deg"].to_numpy()[1:-1], np.asarray(azimuth) % 360)
    np.testing.assert_allclose(layer.table["speed_mps"].to_numpy()[1:-1], np.asarray(distance_m) / 0.2, rtol=1e-12)
    assert set(layer.table["segment"].to_pylist()) == {0}


def test_a_baseline_solution_is_refused_with_the_reason(shared_data):
    with pytest.raises(InputError, match=r"baseline.*out-solformat=llh"):
        read_drive(shared_data / "trajectory" / "misc" / "demo1_out.pos")


@pytest.mark.parametrize("title", ["%  GPST   x-ecef(m)  y-ecef(m)  z-ecef(m)   Q  ns\n", ""])
def test_an_earth_centred_solution_is_turned_into_degrees_and_its_sigmas_too(tmp_path, title):
    lon, lat = 10.0, 50.0
    rotation = np.array(list(topocentric_axes(lon, lat)))
    enu_m2 = np.array([[4.0, 0.6, -0.5], [0.6, 9.0, 1.0], [-0.5, 1.0, 25.0]]) * 1e-4
    ecef_m2 = rotation.T @ enu_m2 @ rotation
    x, y, z = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(lon, lat, 300.0)
    signed = np.sign(ecef_m2) * np.sqrt(np.abs(ecef_m2))
    sigmas = " ".join(f"{signed[i, j]:.9f}" for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (2, 0)))
    text = f"{title}2023/07/11 06:04:30.000 {x:.4f} {y:.4f} {z:.4f} 1 12 {sigmas} 0.0 5.0\n"
    row = read_drive(pos(tmp_path, text)).table.to_pylist()[0]
    assert (row["sigma_e_m"], row["sigma_n_m"], row["height_m"]) == pytest.approx((0.02, 0.03, 300.0), abs=1e-3)
    assert (row["fix_quality"], row["t_utc"].second) == ("fixed", 12)
    assert np.ravel(lonlat(read_drive(pos(tmp_path, text)).table)) == pytest.approx([10, 50], abs=1e-8)


def topocentric_axes(lon, lat):
    """Return the rows east, north, up in Earth-centred axes, by differences of pyproj."""
    to_ecef_3d = Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    at = np.array(to_ecef_3d.transform(lon, lat, 0.0))
    for step in ((1e-6, 0, 0), (0, 1e-6, 0), (0, 0, 1.0)):
        axis = np.array(to_ecef_3d.transform(lon + step[0], lat + step[1], step[2])) - at
        yield axis / np.linalg.norm(axis)


def test_a_baseline_without_a_header_is_refused_by_its_speed(tmp_path):
    lines = [f"2023/07/11 06:04:{s:02d}.000 {30 + 1.2 * s:.4f} {50 + s:.4f} 2.0 {TAIL}\n" for s in range(20)]
    with pytest.raises(InputError, match="kilometres a second: a baseline solution"):
        read_drive(pos(tmp_path, "".join(lines)))


def test_positions_in_the_tokyo_datum_are_refused(tmp_path):
    head = "% program : RTKLIB\n% (lat/lon/height=Tokyo/ellipsoidal,Q=1:fix)\n"
    with pytest.raises(InputError, match=r"Tokyo datum.*Solve again in WGS84"):
        read_drive(pos(tmp_path, head + TITLE.format("GPST") + rows(["2023/07/11 06:04:30.000"])))


def test_heights_above_sea_level_are_told_and_not_taken(tmp_path):
    head = "% program : RTKLIB\n% (lat/lon/height=WGS84/geodetic,Q=1:fix)\n"
    layer = read_drive(pos(tmp_path, head + TITLE.format("GPST") + rows(["2023/07/11 06:04:30.000"])))
    assert layer.table["height_m"].null_count == 1
    assert layer.found["heights above sea level, not taken"] == 1


def test_a_byte_order_mark_is_no_line(tmp_path):
    layer = read_drive(pos(tmp_path, "\ufeff" + TITLE.format("GPST") + rows(["2023/07/11 06:04:30.000"])))
    assert (layer.table.num_rows, layer.skipped) == (1, {})


@pytest.mark.parametrize(
    ("head", "time", "expected"),
    [
        (TITLE.format("GPST"), "2023/07/11 06:04:30.000", datetime(2023, 7, 11, 6, 4, 12, tzinfo=UTC)),
        (TITLE.format("UTC"), "2023/07/11 06:04:30.000", datetime(2023, 7, 11, 6, 4, 30, tzinfo=UTC)),
        (TITLE.format("JST"), "2023/07/11 06:04:30.000", datetime(2023, 7, 10, 21, 4, 30, tzinfo=UTC)),
        (TITLE.format("GPST"), "2270 194670.000", datetime(2023, 7, 11, 6, 4, 12, tzinfo=UTC)),
        (
            "% obs start : 2023/07/11 06:04:30.0 GPST\n" + TITLE.format("GPST"),
            "222 194670.000",
            datetime(2023, 7, 11, 6, 4, 12, tzinfo=UTC),
        ),
        (
            "% obs start : 2018/07/11 06:04:30.0 GPST\n" + TITLE.format("GPST"),
            "985 194670.000",
            datetime(2018, 7, 10, 6, 4, 12, tzinfo=UTC),
        ),
        (TITLE.format("GPST"), "2010/01/01 00:00:60.000", datetime(2010, 1, 1, 0, 0, 45, tzinfo=UTC)),
        ("", "2023/07/11 06:04:30.000", datetime(2023, 7, 11, 6, 4, 12, tzinfo=UTC)),
        ("", "2023/07/11,06:04:30.000,", datetime(2023, 7, 11, 6, 4, 12, tzinfo=UTC)),
    ],
)
def test_times_of_every_header(tmp_path, head, time, expected):
    assert first_time(pos(tmp_path, head + rows([time]))) == expected


def test_leap_seconds_begin_on_their_day():
    assert len(LEAP_DAYS) == 18
    utc = np.array(["2016-12-31T23:59:58", "2017-01-01T00:00:00"], "datetime64[us]")
    gpst = utc + np.array([17, 18], "timedelta64[s]")
    np.testing.assert_array_equal(gpst_to_utc(gpst), utc)


def test_degrees_minutes_and_seconds(tmp_path):
    text = "%  GPST   latitude(d'\") longitude(d'\")  height(m)   Q  ns\n"
    text += f"2023/07/11 06:04:30.000  -35 09 55.2999  -136 52 53.0711 {TAIL}"
    lon, lat = lonlat(read_drive(pos(tmp_path, text)).table)
    assert (lon[0], lat[0]) == pytest.approx((-136.8814086, -35.1653611), abs=1e-6)


def test_columns_of_quality_height_and_sigma(tmp_path):
    text = TITLE.format("GPST") + "2023/07/11 06:04:30.0 50.0 10.0 123.4 4.0000 9.0 0.01 0.02 0.03\n"
    row = read_drive(pos(tmp_path, text)).table.to_pylist()[0]
    assert (row["height_m"], row["fix_quality"]) == (123.4, "dgps")
    assert (row["sigma_n_m"], row["sigma_e_m"]) == (0.01, 0.02)
    assert row["drive_id"] == "drive"


def test_gaps_duplicates_disorder_and_bad_lines_are_counted(tmp_path):
    seconds = [0, 1, 2, 2, 4, 3, 30, 31]
    times = [f"2023/07/11 06:04:{s:02d}.000" for s in seconds]
    text = TITLE.format("GPST") + rows(times, [50 + s * 1e-4 for s in seconds])
    text += "garbage\n2023/07/11 06:04:32.000 95.0 10.0 1 1 1\n2023/13/11 06:04:33.000 50.0 10.0 1 1 1\n"
    layer = read_drive(pos(tmp_path, text))
    assert layer.table["segment"].to_pylist() == [0] * 5 + [1] * 2
    assert layer.found["gaps"] == 1
    assert layer.found["epochs out of order"] == 1
    assert layer.skipped == {"lines that are no epoch": 2, "epochs without a valid position": 1, "duplicate epochs": 1}


def test_motion_of_a_drive_north_then_east():
    lat = np.array([50.0, 50.0001, 50.0002, 50.0002, 50.0002])
    lon = np.array([10.0, 10.0, 10.0, 10.0002, 10.0002])
    motion = motion_of(np.arange(5.0), lon, lat)
    assert motion.heading_deg[:2] == pytest.approx([0.0, 0.0], abs=1e-6)
    assert motion.heading_deg[3:] == pytest.approx(
        [90.0, 90.0], abs=1e-3
    )  # the last epoch stands and keeps its heading
    assert motion.speed_mps[0] == pytest.approx(11.12, abs=0.01)
    assert motion.speed_mps[4] == pytest.approx(0.0)


def test_motion_of_one_epoch_is_unknown(tmp_path):
    row = read_drive(pos(tmp_path, rows(["2023/07/11 06:04:30.000"]))).table.to_pylist()[0]
    assert (row["heading_deg"], row["speed_mps"], row["segment"]) == (None, None, 0)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "the file is empty"),
        (b"hello\n", "not a trajectory in a format"),
        (b"a,b\n50,10\n", "no columns that look like a position; there are a, b"),
        (b"\x1f\x8b\x08\0", "damaged"),
        (b"% program   : RTKLIB\n", "holds no epoch"),
        (b"% program   : RTKLIB\n1 2 3\n", "holds no epoch"),
    ],
)
def test_what_is_no_solution_is_refused(tmp_path, content, message):
    path = tmp_path / "drive.pos"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_drive(path)
    assert str(path) in str(caught.value)


def zipped(content: bytes) -> bytes:
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("logs/drive.pos", content)
    return out.getvalue()


@pytest.mark.parametrize(("pack", "suffix"), [(gzip.compress, ".gz"), (bz2.compress, ".bz2"), (zipped, ".zip")])
def test_a_packed_drive_is_the_drive(tmp_path, pack, suffix):
    plain = pos(tmp_path, rows(["2023/07/11 06:04:30.000", "2023/07/11 06:04:31.000"]))
    packed = tmp_path / f"{plain.name}{suffix}"
    packed.write_bytes(pack(plain.read_bytes()))
    assert read_drive(packed).table.equals(read_drive(plain).table)
    packed.write_bytes(pack(b"% program   : RTKLIB\n1 2 3\n"))
    with pytest.raises(InputError, match="holds no epoch") as caught:
        read_drive(packed)
    assert str(packed) in str(caught.value)


def test_a_packed_log_is_told_by_what_is_in_it(shared_data, tmp_path):
    plain = shared_data / "trajectory" / "nagoya" / "reference_1Hz.pos"
    packed = tmp_path / "drive"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    assert kind_of(packed) == "drives"
    assert read_drive(packed).table.num_rows == read_drive(plain).table.num_rows


@pytest.mark.parametrize("seed", range(30))
def test_damage_gives_an_input_error_or_a_drive(repo, tmp_path, seed):
    draw = random.Random(seed)  # noqa: S311 - not a secret
    content = bytearray((repo / "data" / "raw" / "helsinki_derived.pos").read_bytes()[:6000])
    for _ in range(draw.randint(1, 30)):
        content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    path = tmp_path / "damaged.pos"
    path.write_bytes(content)
    try:
        assert read_drive(path).table.num_rows > 0
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017 - either outcome is right
