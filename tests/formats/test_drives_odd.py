"""Trajectories as phones, loggers, spreadsheets and ROS write them: the same drive in many shapes."""

from __future__ import annotations

import json
import zipfile
from datetime import UTC, datetime, timedelta

import geopandas as gpd
import numpy as np
import pytest

from geofleet.errors import ConfigError, InputError
from geofleet.formats.drives import read_drive
from geofleet.formats.inventory_columns import angle
from geofleet.steps.ingest import ingest_drive
from geofleet.tables.store import lonlat
from geofleet.workflows.info import info

BEGIN = datetime(2024, 3, 21, 13, 5, 57, tzinfo=UTC)  # the minute changes on the way
N = 8
LAT = 48.10 + np.arange(N) * 1e-4
LON = 11.50 + np.arange(N) * 1.2e-4
TIMES = [BEGIN + timedelta(seconds=s) for s in range(N)]
UNIX = [t.timestamp() for t in TIMES]
DAYS = [45372.5 + (t - datetime(2024, 3, 21, 12, tzinfo=UTC)).total_seconds() / 86400 for t in TIMES]
TOW = [(u - 315964800 + 18) % 604800 for u in UNIX]


def written(tmp_path, header, line, name="drive.csv"):
    """Write a drive: what a line says of time and place is filled in."""
    rows = [
        line.format(
            t=TIMES[i],
            local=TIMES[i] + timedelta(hours=1),
            unix=int(UNIX[i]),
            days=DAYS[i],
            day=int(DAYS[i]),
            fraction=DAYS[i] % 1,
            tow=int(TOW[i]),
            s=i,
            lat=LAT[i],
            lon=LON[i],
            minutes_lat=(LAT[i] - 48) * 60,
            minutes_lon=(LON[i] - 11) * 60,
            seconds_lat=(LAT[i] - 48) * 3600 - 360,
            seconds_lon=(LON[i] - 11) * 3600 - 1800,
            e7_lat=round(LAT[i] * 1e7),
            e7_lon=round(LON[i] * 1e7),
            semi_lat=round(LAT[i] * 2**31 / 180),
            semi_lon=round(LON[i] * 2**31 / 180),
        )
        for i in range(N)
    ]
    path = tmp_path / name
    path.write_text("\n".join([header, *rows, ""]), encoding="utf-8")
    return path


def assert_places(table, *, sign=1):
    np.testing.assert_allclose(lonlat(table), (sign * LON, sign * LAT), rtol=0, atol=2e-7)


PLACE = "{lat:.7f},{lon:.7f}"


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("Time,Latitude,Longitude", "{days:.9f}," + PLACE),
        ("Date,Time,Latitude,Longitude", "{day},{fraction:.9f}," + PLACE),
        ("GPS Time, Device Time, Latitude, Longitude,Speed (OBD)(km/h)",
         "{local:%a %b %d %H:%M:%S} GMT+01:00 2024,{local:%d-%b-%Y %H:%M:%S}.000," + PLACE + ",-"),
        ("Device Time,Latitude,Longitude", "{t:%d-%b-%Y %H:%M:%S}.000," + PLACE),
        ("time,lat,lon", "Do. 21 März 2024 {t:%H:%M:%S}," + PLACE),
        ("time,lat,lon", "{t:%a %b %d %H:%M:%S %Y}," + PLACE),
        ("time,lat,lon", '"{t:%b %d, %Y %I:%M:%S %p}",' + PLACE),
        ("time,lat,lon", "{t:%m/%d/%Y %I:%M:%S %p}," + PLACE),
        ("time,lat,lon", '"{t:%a, %d %b %Y %H:%M:%S} +0000",' + PLACE),
        ("Timestamp,Lat,Lon", "{t:%Y%m%d%H%M%S}," + PLACE),
        ("Timestamp,Lat,Lon", "{t:%Y%m%d%H%M%S}000," + PLACE),
        ("Date,Time,Lat,Lon", "{t:%Y%m%d},{t:%H%M%S}.00," + PLACE),
        ("UTC Date,UTC Time,Lat,Lon", "{t:%Y/%m/%d},{t:%H:%M:%S}.00," + PLACE),
        ("Date (UTC),Time (UTC),Lat,Lon", "{t:%d/%m/%Y},{t:%H:%M:%S}.00," + PLACE),
        ("iTOW,year,month,day,hour,min,sec,lat,lon", "{tow}000,2024,3,21,{t.hour},{t.minute},{t.second}," + PLACE),
        ("week,iTOW,lat,lon", "2306,{tow}000," + PLACE),
        ("header.stamp.sec,header.stamp.nanosec,latitude,longitude", "{unix},0," + PLACE),
        ("/fix/header/stamp/secs,/fix/header/stamp/nsecs,/fix/latitude,/fix/longitude", "{unix},0," + PLACE),
        ("%time,field.latitude,field.longitude,field.altitude", "{unix}000000000," + PLACE + ",500"),
        ("__time,/gps/fix/latitude,/gps/fix/longitude", "{unix}.0," + PLACE),
        ("#timestamp [ns],lat [deg],lon [deg]", "{unix}000000000," + PLACE),
        ("# time lat lon", "{unix}.0 {lat:.7f} {lon:.7f}"),
        ("tripId,UnixTimeMillis,LatitudeDegrees,LongitudeDegrees", "drive,{unix}000," + PLACE),
        ("timestamp,time_utc_usec,lat,lon", "{s}000000,{unix}000000,{e7_lat},{e7_lon}"),
        ("timestamp,position_lat,position_long", "{t:%Y-%m-%d %H:%M:%S+00:00},{semi_lat},{semi_lon}"),
        ("time,lat,N/S,lon,E/W", "{unix},48{minutes_lat:010.7f},N,011{minutes_lon:010.7f},E"),
        ("time,lat,lon", "{unix},48{minutes_lat:010.7f},11{minutes_lon:010.7f}"),
        ("time,lat,lon", "{unix},48{minutes_lat:010.7f}N,011{minutes_lon:010.7f}E"),
        ("time;lat;lon", "{unix};48°{minutes_lat:.6f}'N;11°{minutes_lon:.6f}'E"),
        ("time;lat;lon", "{unix};48°06'{seconds_lat:.4f}\" N;11° 30' {seconds_lon:.4f}\" E"),
        ("time;lat;lon", "{unix};{lat:.7f}°;{lon:.7f}°"),
        ("time;position", "{unix};{lat:.7f}, {lon:.7f}"),
        ("time;geom", "{unix};POINT ({lon:.7f} {lat:.7f})"),
        ("id,deviceId,type,fixTime,latitude,longitude,attributes",
         "{s},7,,{t:%Y-%m-%dT%H:%M:%S}.000+00:00," + PLACE + ",{{}}"),
    ],
)  # fmt: skip
def test_the_same_drive_in_many_shapes(tmp_path, header, line):
    layer = read_drive(written(tmp_path, header, line))
    assert_places(layer.table)
    off_s = [
        abs((t - expected).total_seconds()) for t, expected in zip(layer.table["t_utc"].to_pylist(), TIMES, strict=True)
    ]
    assert max(off_s) < 1e-4
    assert sum(layer.skipped.values()) == 0


@pytest.mark.parametrize(
    ("header", "line"),
    [
        ("time,lat,lon", "{t:%H%M%S}.00," + PLACE),
        ("time,lat,lon", "{t:%H:%M:%S}," + PLACE),
        ("Date,UTC,lat,lon", "{t:%d%m%y},{t:%H%M%S}.00," + PLACE),
        ("Timestamp(ms),lat,lon", "{s}000," + PLACE),
        ("t,lat,lon", "{s}000000," + PLACE),
    ],
)
def test_times_that_do_not_say_the_day_give_the_speeds(tmp_path, header, line):
    table = read_drive(written(tmp_path, header, line)).table
    assert table["t_utc"].null_count == N
    assert table["speed_mps"].to_numpy() == pytest.approx(14.27, abs=0.02)


def test_a_date_of_six_figures_waits_for_the_user(tmp_path):
    path = written(tmp_path, "Date,UTC,lat,lon", "{t:%d%m%y},{t:%H%M%S}.00," + PLACE)
    assert any("six figures" in told for told in read_drive(path).found)
    toml = tmp_path / "m.toml"
    toml.write_text("day_first = true\n")
    assert read_drive(path, columns=toml).table["t_utc"].to_pylist() == TIMES


def test_hemispheres_beside_the_numbers_count(tmp_path):
    for header, line in (
        ("time,lat,NS,lon,EW", "{unix},{lat:.7f},S,{lon:.7f},W"),
        ("time,latitude,latitude_hemisphere,longitude,longitude_hemisphere", "{unix},{lat:.7f},s,{lon:.7f},w"),
        ("time,lat,lon", "{unix},{lat:.7f}S,{lon:.7f} W"),
    ):
        assert_places(read_drive(written(tmp_path, header, line)).table, sign=-1)
    near_equator = tmp_path / "equator.csv"
    near_equator.write_text("time,lat,NS,lon,EW\n1711026306,0030.6000,S,03630.0000,E\n")
    assert np.hstack(lonlat(read_drive(near_equator).table)) == pytest.approx((36.5, -0.51))


def test_satellites_in_a_column_ns_are_no_hemisphere(tmp_path):
    layer = read_drive(written(tmp_path, "time,lat,lon,ns", "{unix}," + PLACE + ",12"))
    assert any(told.startswith("satellites read from column ns") for told in layer.found)
    assert_places(layer.table)


def test_nmea_angles_are_not_cut_in_the_wrong_place():
    assert angle("0806.1200N") == pytest.approx(8.102)
    assert angle("01130.6000 W") == pytest.approx(-11.51)
    assert angle("48.5N") == 48.5
    assert np.isnan(angle("4861.0N"))


def test_a_drive_that_is_mostly_jumps_is_a_warning(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text("time,lat,lon\n" + "".join(f"{s * 1e-3:.3f},{48 + s * 1e-3:.4f},11\n" for s in range(40)))
    told = info(path, columns={"time": "time", "x": "lon", "y": "lat", "time_format": "relative_s"}).warnings
    assert any("impossible jumps, the most of a drive" in warning for warning in told)


def test_a_time_that_cannot_be_read_is_shown(tmp_path):
    found = read_drive(written(tmp_path, "time,lat,lon", "{t:%a %b %d %H:%M:%S} CET 2024," + PLACE)).found
    assert any("such as 'Thu Mar 21 13:05:57 CET 2024'" in told for told in found)


def test_a_first_line_of_values_is_called_that(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text("1711026306000,48.1,11.5,500\n1711026307000,48.1001,11.5,500\n")
    with pytest.raises(InputError, match=r"the first line names no columns, it holds values .* time,lat,lon"):
        read_drive(path)


def test_positions_of_a_fleet_without_a_class_are_drives(tmp_path):
    path = written(tmp_path, "id,deviceId,type,fixTime,latitude,longitude", "{s},7,,{t:%Y-%m-%dT%H:%M:%SZ}," + PLACE)
    assert info(path).table == "drives"
    path = written(
        tmp_path, "id,deviceId,type,fixTime,latitude,longitude", "{s},7,stop,{t:%Y-%m-%dT%H:%M:%SZ}," + PLACE
    )
    assert info(path).table == "detections"


def test_fixes_of_gnss_logger(tmp_path):
    head = (
        "# \n# Header Description:\n# \n# Raw,utcTimeMillis,TimeNanos\n# \n# Fix,Provider,LatitudeDegrees,"
        "LongitudeDegrees,AltitudeMeters,SpeedMps,AccuracyMeters,BearingDegrees,UnixTimeMillis\n# "
    )
    fix = "Fix,{0},{{lat:.7f}},{{lon:.7f}},500,14,{1},37,{{unix}}000"
    line = "\n".join(["Raw,{unix}000,1", fix.format("NLP", 60).replace("{lat", "{s"), fix.format("GPS", 4)])
    path = written(tmp_path, head, line, "gnss_log.txt")
    layer = read_drive(path)
    assert layer.file_format == "gnsslogger"
    assert_places(layer.table)
    assert layer.table["t_utc"].to_pylist() == TIMES
    assert layer.skipped["fixes of others than GPS"] == N
    assert layer.found["lines of measurements or statuses"] == N
    assert info(path).table == "drives"
    path.write_text(head + "\nRaw,1,2\n")
    with pytest.raises(InputError, match=r"holds no fix \(0 lines of fixes, 1 others\)"):
        read_drive(path)


def line_feature(properties, *, at=slice(None)):
    coordinates = [[x, y, 500.0] for x, y in zip(LON[at].tolist(), LAT[at].tolist(), strict=True)]
    return {"type": "Feature", "properties": properties, "geometry": {"type": "LineString", "coordinates": coordinates}}


STATED = [f"{t:%Y-%m-%dT%H:%M:%SZ}" for t in TIMES]


@pytest.mark.parametrize(
    "features",
    [
        [line_feature({"name": "x", "coordTimes": STATED})],
        [line_feature({"name": "x", "coordinateProperties": {"times": STATED}})],
        [line_feature({"times": STATED[:4]}, at=slice(4)), line_feature({"times": STATED[4:]}, at=slice(4, None))],
        [
            {
                "type": "Feature",
                "properties": {"time": t, "speed": 14.0},
                "geometry": {"type": "Point", "coordinates": [x, y]},
            }
            for t, x, y in zip(STATED, LON.tolist(), LAT.tolist(), strict=True)
        ],
    ],
)
def test_drives_in_geojson(tmp_path, features):
    path = tmp_path / "drive.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    table = read_drive(path).table
    assert_places(table)
    assert table["t_utc"].to_pylist() == TIMES
    assert len(set(table["segment"].to_pylist())) == (2 if len(features) == 2 else 1)


def test_drives_in_the_files_of_a_gis_keep_their_crs(tmp_path):
    points = gpd.GeoDataFrame(
        {"time": TIMES, "track_fid": [0] * N}, geometry=gpd.points_from_xy(LON, LAT), crs="OGC:CRS84"
    )
    for name in ("drive.gpkg", "drive.fgb"):
        points.to_crs("EPSG:25832").to_file(tmp_path / name)
        layer = read_drive(tmp_path / name)
        assert_places(layer.table)
        assert layer.table["t_utc"].to_pylist() == TIMES
        assert "25832" in layer.datum.crs
        assert info(tmp_path / name).table == "drives"


def test_a_line_without_times_is_a_path(tmp_path):
    path = tmp_path / "drive.geojson"
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [line_feature({"coordTimes": STATED[:3]})]}))
    layer = read_drive(path)
    assert_places(layer.table)
    assert layer.table["t_utc"].null_count == N
    assert layer.found["lines with another number of times than of vertices"] == 1


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.fit", b"\x0e\x10\x5d\x08\0\0\0\0.FIT\0\0", "FIT recording.*gpsbabel -i garmin_fit -f a.fit"),
        ("a.tcx", b"<?xml version='1.0'?>\n<TrainingCenterDatabase><a/>", "TCX.*gpsbabel -i gtrnctr"),
        ("a.kml", b"<?xml version='1.0'?><kml><gx:Track><when>", "KML track.*gpsbabel -i kml"),
        ("a.log", b"#BESTPOSA,COM1,0,78.5,FINESTEERING,2306,392724.0,0,b1f6,15761;SOL_COMPUTED,", "NovAtel.*NMEA"),
        ("a.log", b"%INSPVASA,2306,392724.0;2306,392724.0,48.1,11.5", "NovAtel.*NMEA"),
        ("a.xml", b"<?xml version='1.0'?>\n<fcd-export>\n<timestep", "SUMO.*traceExporter"),
        ("a.24o", b"     3.04           OBSERVATION DATA    M: MIXED", "RINEX.*rnx2rtkp"),
        ("a.txt", b"1.5 2.5 3 " + b"0.1 " * 22 + b"4 10 4 4 0\n", "KITTI"),
        ("a.bag", b"#ROSBAG V2.0\n", "ROS bag.*rostopic echo -b a.bag"),
        ("a.json", b'{"locations":[{"latitudeE7":481,"longitudeE7":115}]}', "location history of Google"),
        ("a.json", b'{"class":"VERSION","release":"3.25"}\n{"class":"TPV"}', "gpsd.*gpspipe"),
        ("a.plt", b"Geolife trajectory\r\nWGS 84\r\n", "Geolife.*lat,lon,zero,altitude,days,date,time"),
        ("a.pos", b"DIR FRAME        STN         DAYofYEAR YEAR-MM-DD", "CSRS-PPP.*GPS time"),
        ("a.stat", b"$POS,2306,392724.000,1,4182105.1", "statistics of an RTKLIB solution"),
        (
            "a.xml",
            b"<?xml version='1.0'?>\n<net version='1.9' x='y'><location/>",
            "network of SUMO.*netconvert -s a.xml",
        ),
        ("a.xml", b"<?xml version='1.0'?><commonRoad x='y'>", "CommonRoad.*Lanelet2"),
        ("a.xosc", b"<?xml version='1.0'?><OpenSCENARIO>", "OpenSCENARIO.*LogicFile"),
        ("a.gml", b"<?xml version='1.0'?><core:CityModel x='y'>", "CityGML.*ogr2ogr"),
        ("a.mat", b"MATLAB 5.0 MAT-file", "arrays"),
    ],
)
def test_what_is_not_read_is_named_with_what_to_make_of_it(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    for read in (read_drive, info):
        with pytest.raises(InputError, match=f"{message}|{name}.*{message}"):
            read(path)


def test_a_spreadsheet_is_named(tmp_path):
    path = tmp_path / "drive.xlsx"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("[Content_Types].xml", "<Types/>")
        archive.writestr("xl/workbook.xml", "<workbook/>")
    for read in (read_drive, info):
        with pytest.raises(InputError, match=r"spreadsheet of Excel: not read here. Save the sheet as CSV"):
            read(path)


@pytest.mark.parametrize(
    ("geometry", "properties"),
    [
        ({"type": "Point", "coordinates": [11.5, 48.1]}, {"code": "206"}),
        ({"type": "LineString", "coordinates": [[11.5, 48.1], [11.6, 48.1]]}, {"highway": "primary"}),
    ],
)
def test_signs_and_streets_are_no_drive(tmp_path, geometry, properties):
    path = tmp_path / "map.geojson"
    feature = {"type": "Feature", "properties": properties, "geometry": geometry}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature] * 3}))
    with pytest.raises(InputError, match="without times, which are no drive"):
        read_drive(path)


def test_a_date_that_holds_the_clock_stands_alone(tmp_path):
    path = written(tmp_path, "Date,Time,lat,lon", "{t:%Y-%m-%d %H:%M:%S},{t:%H:%M:%S}," + PLACE)
    assert read_drive(path).table["t_utc"].to_pylist() == TIMES


def test_options_of_csv_are_refused_for_other_formats_by_name(tmp_path):
    path = tmp_path / "drive.gpx"
    path.write_text('<gpx><trk><trkseg><trkpt lat="48" lon="11"/></trkseg></trk></gpx>')
    with pytest.raises(ConfigError, match="crs cannot be given for gpx"):
        ingest_drive([path], tmp_path / "drives.parquet", crs="EPSG:4326")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.csv", b'time,"lat,lon\n1,48,11\n', "cannot be read as columns"),
        ("a.csv", b'id,code,"po""sition"\n1,206,"48, 11"\n', "line of names cannot be read: .* is lost"),
        ("a.geojson", json.dumps(
            {"type": "FeatureCollection", "features": [line_feature({"coordTimes": STATED})]}
        ).encode().replace(b"2024-03-21T13:05:58Z", b"2024-03\xc121"), "not UTF-8"),
    ],
)  # fmt: skip
def test_damaged_files_are_refused(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        read_drive(path)


def test_numbers_that_are_no_time_are_left_out(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text(
        "time,lat,lon\n" + "".join(f"{t},{48 + i * 1e-4},11\n" for i, t in enumerate([0, 1, 2, "1e308", 3]))
    )
    layer = read_drive(path)
    assert layer.table.num_rows == 4
    assert layer.skipped == {"epochs without a time": 1}
    path.write_text("week,tow,lat,lon\n" + "".join(f"{w},{i},48,11\n" for i, w in enumerate([2306, "1e308", 2306])))
    assert read_drive(path).table["t_utc"].null_count == 0


def test_of_the_layers_of_a_converted_gpx_the_points_of_its_tracks_are_the_drive(tmp_path):
    path = tmp_path / "drive.gpkg"
    points = gpd.GeoDataFrame({"time": TIMES}, geometry=gpd.points_from_xy(LON, LAT), crs="OGC:CRS84")
    for layer in ("waypoints", "routes", "track_points"):
        points.to_file(path, layer=layer)
    assert_places(read_drive(path).table)
    other = tmp_path / "other.gpkg"
    for layer in ("monday", "tuesday"):
        points.to_file(other, layer=layer)
    with pytest.raises(InputError, match=r"2 layers: monday, tuesday\. Export the layer of the drive alone"):
        read_drive(other)
