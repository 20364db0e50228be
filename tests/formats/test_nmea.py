from __future__ import annotations

import random
from datetime import UTC, datetime
from functools import reduce
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geofleet.errors import SUSPICIOUS, InputError
from geofleet.formats.drives import detect, read_drive
from geofleet.formats.nmea import checksums, read_epochs
from geofleet.tables.store import lonlat


def sentence(body):
    return f"${body}*{reduce(lambda a, b: a ^ b, body.encode()):02X}\r\n"


def gga(clock, lat="4846.0000000", *, quality=4, talker="GN", side="N"):
    return sentence(f"{talker}GGA,{clock},{lat},{side},00854.0000000,E,{quality},12,0.5,400.0,M,47.5,M,,")


def rmc(clock, date="200420", status="A"):
    return sentence(f"GNRMC,{clock},{status},4846.5,N,00854.5,E,10.0,0.0,{date},,,R,V")


def log(tmp_path, *sentences):
    path = tmp_path / "drive.nmea"
    path.write_text("".join(sentences), encoding="latin-1", newline="")
    return path


def times(path):
    return [str(t) for t in read_epochs(path)[0].t_utc]


def test_position_height_quality_and_sigma_of_an_epoch(tmp_path):
    gst = sentence("GNGST,092542.00,1.0,,,,0.02,0.03,0.05")
    path = log(tmp_path, rmc("092542.00"), gga("092542.00", "4846.4008666"), gst)
    row = read_drive(path).table.to_pylist()[0]
    lon, lat = lonlat(read_drive(path).table)
    assert (lon[0], lat[0]) == pytest.approx((8.9, 48 + 46.4008666 / 60), abs=1e-12)
    assert row["t_utc"] == datetime(2020, 4, 20, 9, 25, 42, tzinfo=UTC)
    assert (row["height_m"], row["fix_quality"]) == (447.5, "fixed")
    assert (row["sigma_n_m"], row["sigma_e_m"]) == (0.02, 0.03)


def test_rmc_alone_gives_a_position_south_and_west(tmp_path):
    body = "GPRMC,000001.0,A,3300.0,S,07030.0,W,0.0,,010203,,,D"
    epochs, _, _ = read_epochs(log(tmp_path, sentence(body)))
    assert (epochs.lon[0], epochs.lat[0], epochs.quality[0]) == (-70.5, -33.0, "dgps")


@pytest.mark.parametrize("talker", ["GP", "GN", "GL", "GA", "GB"])
def test_every_constellation_may_talk(tmp_path, talker):
    path = log(tmp_path, gga("092542.00", talker=talker))
    assert detect(path.read_bytes()) == "nmea"
    assert len(read_epochs(path)[0].lon) == 1


def test_wrong_checksums_are_left_out_and_missing_ones_taken(tmp_path):
    wrong = gga("092543.00").replace("00854", "00855")
    half = gga("092544.00").replace("\r\n", "")[:-1] + "\r\n"
    bare = gga("092545.00").partition("*")[0] + "\r\n"
    epochs, skipped, found = read_epochs(log(tmp_path, rmc("092542.00"), gga("092542.00"), wrong, half, bare))
    assert [str(t)[11:19] for t in epochs.t_utc] == ["09:25:42", "09:25:45"]
    assert skipped["sentences with a wrong checksum"] == 2
    assert found["sentences without a checksum"] == 1


def test_the_day_rolls_over_before_and_after_the_date_is_known(tmp_path):
    path = log(
        tmp_path,
        gga("235958.00"),
        gga("235959.00"),
        gga("000000.00"),
        rmc("000001.00", "010320"),
        gga("000001.00"),
        gga("120000.00"),
        gga("235959.50"),
        gga("000000.50"),
    )
    assert times(path) == [
        *("2020-02-29T23:59:58.000000", "2020-02-29T23:59:59.000000", "2020-03-01T00:00:00.000000"),
        *("2020-03-01T00:00:01.000000", "2020-03-01T12:00:00.000000", "2020-03-01T23:59:59.500000"),
        "2020-03-02T00:00:00.500000",
    ]


def test_two_digits_of_a_year_and_a_leap_second(tmp_path):
    assert times(log(tmp_path, rmc("120000", "010199")))[0].startswith("1999-01-01")
    assert times(log(tmp_path, rmc("235960", "311216"))) == ["2017-01-01T00:00:00.000000"]


def test_zda_tells_the_date_too(tmp_path):
    zda = sentence("GPZDA,092542.00,20,04,2020,00,00")
    assert times(log(tmp_path, zda, gga("092542.00"))) == ["2020-04-20T09:25:42.000000"]


def test_without_a_date_the_seconds_still_count(tmp_path):
    layer = read_drive(log(tmp_path, *(gga(f"0925{s:02d}", f"48{46 + s * 0.01:07.4f}") for s in range(40, 50))))
    assert layer.table["t_utc"].null_count == 10
    assert layer.table["speed_mps"].to_numpy() == pytest.approx(18.53, rel=0.01)
    assert layer.found["no date in the log: times are not known"] == 10


def gns(clock, modes="RRNN"):
    return sentence(f"GNGNS,{clock},4846.0000000,N,01125.0000000,E,{modes},11,0.8,455.0,45.0,1.0,0000,V")


def test_gns_alone_is_as_good_as_gga(tmp_path):
    path = log(tmp_path, gns("060430.00"), sentence("GNZDA,060430.00,11,07,2023,00,00"), gns("060431.00", "NRAN"))
    table = read_drive(path).table
    assert table["fix_quality"].to_pylist() == ["fixed", "fixed"]
    assert table["height_m"].to_pylist() == [500.0, 500.0]
    assert times(path)[0] == "2023-07-11T06:04:30.000000"


def test_a_date_before_the_rollover_is_suspicious(tmp_path):
    layer = read_drive(log(tmp_path, rmc("060430.00", date="251103")))
    assert any(told.startswith(SUSPICIOUS) and "1024" in told for told in layer.found)


def test_binary_messages_before_and_between_sentences_are_passed_over(tmp_path):
    path = tmp_path / "mixed.ubx"
    ubx = b"\xb5\x62\x01\x07\x5c\x00" + bytes(range(92)) + b"\xff\x0a"
    path.write_bytes(60 * ubx + gga("060430.00").encode() + b"\r\n" + ubx + gga("060431.00").encode() + b"\r\n")
    assert read_drive(path).table.num_rows == 2
    path.write_bytes(ubx)
    with pytest.raises(InputError, match="binary messages"):
        read_drive(path)


def test_a_log_of_other_sentences_names_them(tmp_path):
    path = log(tmp_path, sentence("GPGLL,4800.0,N,01100.0,E,060430.00,A,A"))
    with pytest.raises(InputError, match=r"1 sentences read, GLL, 0 of them"):
        read_drive(path)


def test_epochs_without_a_fix_are_left_out(tmp_path):
    epochs, skipped, _ = read_epochs(log(tmp_path, gga("1", quality=1), gga("092542", quality=0), gga("092543")))
    assert len(epochs.lon) == 1
    assert skipped["epochs without a valid position"] == 1
    assert skipped["sentences without a readable time"] == 1
    with pytest.raises(InputError, match="no epoch with a position"):
        read_epochs(log(tmp_path, rmc("092542", status="V")))


@pytest.mark.parametrize(
    ("name", "n", "wrong", "missing"),
    [
        ("nmea.log", 120, 0, 0),
        ("nmea_w_correct_checksum.nmea", 2, 0, 0),
        ("nmea_w_wrong_checksum.nmea", 2, 2, 0),
        ("nmea_no_checksum.nmea", 2, 0, 4),
        ("pygpsdata-nmeabadck.log", 1, 2, 0),
        ("pygpsdata-nmeabadck2.log", 1, 1, 0),
        ("pygpsdata-mixed.log", 2, 0, 0),
        ("pixel6.nmea", 48, 0, 0),
    ],
)
def test_real_logs(shared_data, name, n, wrong, missing):
    epochs, skipped, found = read_epochs(shared_data / "trajectory" / "nmea" / name)
    assert len(epochs.lon) == n
    assert skipped["sentences with a wrong checksum"] == wrong
    assert found.get("sentences without a checksum", 0) == missing


def test_positions_are_those_of_pynmea2(shared_data):
    pynmea2 = pytest.importorskip("pynmea2")
    path = shared_data / "trajectory" / "nmea" / "nmea.log"
    lines = path.read_text(encoding="ascii").split()
    oracle = [pynmea2.parse(line, check=True) for line in lines if "GGA" in line]
    epochs, _, _ = read_epochs(path)
    np.testing.assert_allclose(epochs.lat, [m.latitude for m in oracle], atol=1e-12)
    np.testing.assert_allclose(epochs.lon, [m.longitude for m in oracle], atol=1e-12)


@settings(max_examples=25)
@given(
    st.lists(
        st.tuples(st.integers(0, 89), st.integers(0, 179), st.integers(1, 59_999_999), st.sampled_from(["NE", "SW"])),
        min_size=1,
        max_size=20,
    )
)
def test_made_up_positions_are_those_of_pynmea2(places):
    pynmea2 = pytest.importorskip("pynmea2")
    lines = [rmc("092500.00").strip()]
    for second, (lat, lon, part, (north, east)) in enumerate(places):
        minutes = f"{part // 1_000_000:02d}.{part % 1_000_000:06d}"
        clock = f"0925{second:02d}.00"
        lines.append(
            sentence(f"GNGGA,{clock},{lat:02d}{minutes},{north},{lon:03d}{minutes},{east},4,12,0.5,9.0,M,,M,,")
        )
    lines = [line.strip() for line in lines]
    oracle = [pynmea2.parse(line, check=True) for line in lines if "GGA" in line]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "made.nmea"
        path.write_text("\r\n".join([*lines, ""]), encoding="ascii")
        epochs, skipped, _ = read_epochs(path)
    assert not skipped["sentences with a wrong checksum"]
    np.testing.assert_allclose(epochs.lat, [one.latitude for one in oracle], atol=1e-12)
    np.testing.assert_allclose(epochs.lon, [one.longitude for one in oracle], atol=1e-12)
    clocks = [str(one.timestamp)[:8] for one in oracle]
    assert [str(time)[11:19] for time in epochs.t_utc] == clocks


def test_checksums_are_the_exclusive_or_of_their_bytes():
    content = random.Random(0).randbytes(1000)  # noqa: S311 - not a secret
    spans = np.array([[0, 0], [0, 1000], [3, 77], [999, 1000]])
    expected = [reduce(lambda a, b: a ^ b, content[a:b], 0) for a, b in spans]
    assert checksums(content, spans[:, 0], spans[:, 1]).tolist() == expected


def test_a_line_without_end_is_refused_by_its_number(tmp_path):
    path = tmp_path / "drive.nmea"
    path.write_bytes(rmc("092542").encode() + b"$GPGGA," + b"0" * (2 << 20))
    with pytest.raises(InputError, match="line 2: the line is longer"):
        read_drive(path)


@pytest.mark.parametrize("seed", range(30))
def test_damage_gives_an_input_error_or_a_drive(tmp_path, seed):
    draw = random.Random(seed)  # noqa: S311 - not a secret
    sentences = [rmc(f"0925{s:02d}.00") + gga(f"0925{s:02d}.00") for s in range(40)]
    content = bytearray("".join(sentences).encode())
    for _ in range(draw.randint(1, 40)):
        content[draw.randrange(len(content))] ^= 1 << draw.randrange(8)
    path = tmp_path / "drive.nmea"
    path.write_bytes(content[: draw.randrange(200, len(content))])
    try:
        assert read_drive(path).table.num_rows > 0
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017 - either outcome is right
