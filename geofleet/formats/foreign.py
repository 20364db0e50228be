"""Files that people have beside those that are read: what each is, and how to make one of it that is read."""

from __future__ import annotations

import re
import zipfile
from dataclasses import dataclass
from typing import TYPE_CHECKING

from geofleet.errors import InputError
from geofleet.formats.reading import ZIP, read_head

if TYPE_CHECKING:
    from pathlib import Path

_GPSBABEL = "`gpsbabel -i {0} -f {{name}} -o gpx -F drive.gpx` converts it."
_SAVE_AS_CSV = "Save the sheet as CSV."
_SOLVE = "Solve them with RTKLIB (rnx2rtkp, convbin before it), and give the .pos."
_AS_CSV = "Export the positions as CSV with time, lat, lon."


@dataclass(frozen=True, slots=True)
class _Foreign:
    pattern: re.Pattern[bytes]
    what: str
    todo: str


def _foreign(pattern: bytes, what: str, todo: str) -> _Foreign:
    return _Foreign(re.compile(pattern, re.DOTALL), what, todo)


# Matched from the first byte on
_KNOWN = (
    _foreign(rb".{8}\.FIT", "a FIT recording", _GPSBABEL.format("garmin_fit")),
    _foreign(rb"[^<]*<.*<TrainingCenterDatabase", "a Garmin TCX recording", _GPSBABEL.format("gtrnctr")),
    _foreign(rb"[^<]*<.*<gx:(?:Multi)?Track", "a KML track", _GPSBABEL.format("kml")),
    _foreign(rb"A[A-Z]{3}[^\n]*\n(?:[A-Z][^\n]*\n)*HFDTE", "an IGC flight log", _GPSBABEL.format("igc")),
    _foreign(
        rb"[^<]*<.*<fcd-export",
        "floating-car data of SUMO",
        "Write it with --fcd-output.geo, and convert it: traceExporter.py --fcd-input {name} --gpx-output drive.gpx.",
    ),
    _foreign(
        rb"[^\n]{0,200}(?:[#%][A-Z0-9]+S?A,[^\n;]*;|<BESTPOS|<INSPVA)|\xaa\x44[\x12\x13]",
        "a log of a NovAtel receiver",
        "Log or convert it to NMEA: GPGGA and GPRMC; or export it as CSV with week, tow, lat, lon.",
    ),
    _foreign(
        rb"(?:HDR [^\n]*\n)*DIR FRAME ",
        "a solution of CSRS-PPP",
        "Write date and time (GPS time, 18 s ahead of UTC), latitude and longitude as CSV.",
    ),
    _foreign(
        rb"\$(?:POS|VELACC|CLK|ION|TROP|SAT),",
        "the statistics of an RTKLIB solution (.pos.stat)",
        "Give the .pos beside it.",
    ),
    _foreign(rb"LASF|#? ?\.PCD|ply\r?\n", "a cloud of points", "Give the signs or the drive themselves."),
    _foreign(
        rb"[^<]*<.*<net\s[^>]*(?:version|junctionCornerDetail)=",
        "a network of SUMO",
        "It holds no signs; `netconvert -s {name} --opendrive-output map.xodr` makes OpenDRIVE of its roads.",
    ),
    _foreign(
        rb"[^<]*<.*<commonRoad\s",
        "a CommonRoad scenario",
        "Convert its map to Lanelet2 with the CommonRoad Scenario Designer (crdesigner).",
    ),
    _foreign(rb"[^<]*<.*<OpenSCENARIO", "an OpenSCENARIO scenario", "Give the .xodr that its LogicFile names."),
    _foreign(
        rb"[^<]*<.*<(?:\w+:)?CityModel[\s>]",
        "a CityGML model",
        "Convert its traffic signs to GeoJSON with ogr2ogr of GDAL.",
    ),
    _foreign(rb"\$@..", "a log of a Septentrio receiver (SBF)", "Convert it to NMEA: GGA and RMC."),
    _foreign(rb" {0,8}\d\.\d\d {10,}(?:OBSERVATION|NAVIGATION|O |N )", "raw observations (RINEX)", _SOLVE),
    _foreign(rb"\xd3[\0-\3]", "raw observations (RTCM 3)", _SOLVE),
    _foreign(
        rb"\s*Project:.*Program:\s*(?:Inertial Explorer|GrafNav)",
        "an export of Inertial Explorer or GrafNav",
        "Take out the lines before that of the names, name degrees, minutes and seconds as one column, or export CSV.",
    ),
    _foreign(rb"\[header\]|File created on .{0,60}\[header\]", "a recording of a VBOX", _AS_CSV),
    _foreign(
        rb"This file is created using RaceChrono",
        "an export of RaceChrono with a preamble",
        "Take out the lines before that of the names, and the one of the units.",
    ),
    _foreign(
        rb"Geolife trajectory",
        "a PLT file of OziExplorer or Geolife",
        "Replace its six lines of preamble by one of names: lat,lon,zero,altitude,days,date,time.",
    ),
    _foreign(rb"#ROSBAG V", "a ROS bag", "`rostopic echo -b {name} -p /fix > drive.csv` writes what is read."),
    _foreign(rb"\x89MCAP0", "a recording in MCAP", _AS_CSV),
    _foreign(rb"\x89HDF|MATLAB 5\.0|\x93NUMPY", "a file of arrays (HDF5, MATLAB or NumPy)", _AS_CSV),
    _foreign(rb"ULog\x01\x12\x35", "a ULog of PX4", "`ulog2csv {name}` writes what is read: the file of the GPS."),
    _foreign(rb"MDF     |UnFinMF", "a measurement in MDF", _AS_CSV),
    _foreign(rb"\xd4\xc3\xb2\xa1|\x0a\x0d\x0d\x0a", "a capture of packets", _AS_CSV),
    _foreign(rb"\xd0\xcf\x11\xe0", "a spreadsheet of Excel", _SAVE_AS_CSV),
    _foreign(rb"%PDF", "a PDF", "Give the data themselves."),
    _foreign(
        rb'\s*\{[^{}]*"class"\s*:\s*"(?:VERSION|TPV|DEVICES|WATCH)"',
        "a log of gpsd",
        "Log it as NMEA (`gpspipe -r`), or convert it to GPX (`gpxlogger`).",
    ),
    _foreign(
        rb'\s*\{\s*"locations"\s*:\s*\[\s*\{.*"latitudeE7"|\s*\{\s*"semanticSegments"|\s*\[\s*\{[^\]]*"(?:timelinePath|startTime)"',
        "a location history of Google",
        "Its points are minutes apart and tens of metres off: give a drive. CSV with time, lat, lon is read.",
    ),
)
_MEMBERS = {
    "xl/workbook.xml": ("a spreadsheet of Excel", _SAVE_AS_CSV),
    "content.xml": ("a spreadsheet of OpenDocument", _SAVE_AS_CSV),
    "doc.kml": ("KMZ", "Unpack it, and convert its doc.kml with ogr2ogr of GDAL or gpsbabel."),
}
# Numbers alone, as KITTI writes its 30 of an epoch
_OXTS = re.compile(rb"(?:[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)? ){29}[+-]?\d+\s*(?:\n|\Z)", re.IGNORECASE)


def refuse_foreign(path: Path) -> None:
    """Look at the first bytes of a file for a format that is known, but not read.

    Raises
    ------
    InputError
        It is one: what it is, and what to make of it.
    """
    head = read_head(path)
    if head.startswith(ZIP):
        found = _of_archive(path)
    elif _OXTS.match(head):
        found = (
            "epochs of KITTI's OXTS, without times",
            "Put them into one file with a line of names: lat,lon,alt and on, and the times beside them.",
        )
    else:
        found = next(((known.what, known.todo) for known in _KNOWN if known.pattern.match(head)), None)
    if found:
        what, todo = found
        raise InputError(f"{what}: not read here.", where=str(path), todo=todo.format(name=path.name))


def _of_archive(path: Path) -> tuple[str, str] | None:
    try:
        with zipfile.ZipFile(path) as archive:
            names = set(archive.namelist())
    except (zipfile.BadZipFile, NotImplementedError, OSError):
        return None
    return next((told for member, told in _MEMBERS.items() if member in names), None)
