from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest

from geofleet.errors import InputError
from geofleet.formats.drives import detect, read_drive

HEAD = '<?xml version="1.0"?>\n<gpx version="{}" xmlns="http://www.topografix.com/GPX/{}">'


def point(second, lat, extra="", tag="trkpt"):
    return f'<{tag} lat="{lat}" lon="10.5"><time>2024-05-01T12:00:{second:02d}Z</time>{extra}</{tag}>'


def gpx(tmp_path, body, version="1.1"):
    path = tmp_path / "drive.gpx"
    path.write_text(HEAD.format(version, version.replace(".", "/")) + body + "</gpx>", encoding="utf-8")
    return path


def track(*segments):
    return "<trk>" + "".join(f"<trkseg>{''.join(points)}</trkseg>" for points in segments) + "</trk>"


@pytest.mark.parametrize("version", ["1.0", "1.1"])
def test_a_track_of_two_segments(tmp_path, version):
    first = [point(s, 50 + s * 1e-4) for s in range(5)]
    second = [point(s, 50 + s * 1e-4) for s in range(5, 9)]
    path = gpx(tmp_path, track(first, second), version)
    assert detect(path.read_bytes()) == "gpx"
    table = read_drive(path).table
    assert table["segment"].to_pylist() == [0] * 5 + [1] * 4
    assert table["t_utc"][0].as_py() == datetime(2024, 5, 1, 12, tzinfo=UTC)
    np.testing.assert_allclose(table["speed_mps"].to_numpy(), 11.12, atol=0.01)


def test_heights_are_above_the_ellipsoid_or_not_taken(tmp_path):
    body = track([point(0, 50, "<ele>100</ele><geoidheight>47</geoidheight>"), point(1, 50.0001, "<ele>100</ele>")])
    layer = read_drive(gpx(tmp_path, body))
    assert layer.table["height_m"].to_pylist() == [147.0, None]
    assert layer.found["heights above sea level, not taken"] == 1


def test_points_without_a_fix_or_place_are_left_out(tmp_path):
    bad = '<trkpt lat="abc" lon="1"/>' + point(2, 95) + point(3, 50, "<fix>none</fix>")
    layer = read_drive(gpx(tmp_path, track([point(0, 50, "<fix>dgps</fix>"), point(1, 50.0001), bad])))
    assert layer.skipped == {"epochs without a valid position": 3}
    assert layer.table["fix_quality"].to_pylist() == ["dgps", None]


def test_offsets_and_fractions_of_times(tmp_path):
    body = '<trk><trkseg><trkpt lat="50" lon="10"><time>2024-05-01T14:00:00.250+02:00</time></trkpt></trkseg></trk>'
    time = read_drive(gpx(tmp_path, body)).table["t_utc"][0].as_py()
    assert time == datetime(2024, 5, 1, 12, 0, 0, 250_000, tzinfo=UTC)


def test_a_route_without_times_keeps_its_order(tmp_path):
    body = "<rte>" + "".join(f'<rtept lat="{50 - i * 1e-3}" lon="10"/>' for i in range(4)) + "</rte>"
    layer = read_drive(gpx(tmp_path, body))
    assert layer.table["t_utc"].null_count == layer.table["speed_mps"].null_count == 4
    assert layer.table["heading_deg"].to_pylist() == pytest.approx([180.0] * 4)
    assert layer.found["epochs without a time"] == 4


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (HEAD.format("1.1", "1/1") + '<wpt lat="50" lon="10"/></gpx>', "no point of a track or route"),
        (HEAD.format("1.1", "1/1") + track([point(0, 50)])[:60], "not well-formed"),
        ('<!DOCTYPE gpx [<!ENTITY a "b">]><gpx>&a;</gpx>', "document type"),
        (HEAD.format("1.1", "1/1") + track(['<trkpt lat="x" lon="y"/>']) + "</gpx>", "no point has a valid position"),
    ],
)
def test_what_is_no_track_is_refused(tmp_path, content, message):
    path = tmp_path / "drive.gpx"
    path.write_text(content, encoding="utf-8")
    with pytest.raises(InputError, match=message):
        read_drive(path)


def test_tracks_of_the_same_time_are_drives_of_their_own(tmp_path):
    one = [point(s, 50 + s * 1e-4) for s in range(9)]
    other = [point(s, 51 + s * 1e-4) for s in range(3, 12)]
    layer = read_drive(gpx(tmp_path, track(one[:4], one[4:]) + track(other)))
    assert layer.table["drive_id"].to_pylist() == ["drive-1"] * 9 + ["drive-2"] * 9
    assert layer.table["segment"].to_pylist() == [0] * 4 + [1] * 5 + [0] * 9
    assert "duplicate epochs" not in layer.skipped
    # one after the other, and the same one again, they are one drive
    layer = read_drive(gpx(tmp_path, track(one[:4]) + track(one[3:]) + track(one)))
    assert layer.table["drive_id"].to_pylist() == ["drive"] * 9
    assert layer.table["segment"].to_pylist() == [0] * 4 + [1] * 5
    assert layer.skipped == {"points that an earlier track has": 10}
