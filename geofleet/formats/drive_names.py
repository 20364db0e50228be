"""What people call the columns of a trajectory, in spreadsheets, on phones, in loggers and in ROS."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping

DATE_PARTS = ("year", "month", "day", "hour", "minute", "second")
THINGS = (
    *("time", "nanoseconds", "date", *DATE_PARTS, "week", "tow", "x", "y", "x_side", "y_side", "lat_lon", "height"),
    *("speed", "quality", "satellites", "sigma_e", "sigma_n", "drive"),
)
# Compared in lower case, letters and digits only; most telling first
_NAMES = {
    "time": "tutc timeutcusec utc utime timestamp timestampns unixtime datetime time gpstime timeutc utctime epoch "
    "zeit zeitstempel uhrzeit heure fixtime gpsdatetime unixtimemillis timestampms timems timens unixtimestamp tst "
    "devicetime locationtimestamp recordedat createdat rosbagtimestamp timestampmsec timesec times seconds t",
    "date": "date datum gpsdate utcdate dateutc",
    "week": "week gpsweek weeknumber wn gpsweekno",
    "tow": "tow gpstow sow gpssow timeofweek itow towms gpsms",
    "x": "lon longitude lng long londeg lngdeg longitudedeg longitudedegrees gpslon gpslng gpslong gpslongitude "
    "positionlong positionlon poslon longitudeew längengrad laengengrad länge laenge",
    "y": "lat latitude latdeg latitudedeg latitudedegrees gpslat gpslatitude positionlat poslat latitudens "
    "breitengrad breite",
    "lat_lon": "latlon latlng latlong lonlat lnglat longlat latitudelongitude position coordinates coordinate location "
    "wkt geom geometry thegeom point",
    "height": "ellipsoidheight ellipsoidalheight heightellipsoidal althae heightm height",
    "quality": "fixquality quality fix q",
    "satellites": "nsatellites numsatellites satellites nsat nsats numsat numsats numsv ns",
    "sigma_e": "sigmaem sigmae sde sdem",
    "sigma_n": "sigmanm sigman sdn sdnm",
    "drive": "driveid drive tripid trip trackid vehicleid vehicle carid deviceid trackfid",
}
# Of coordinates that are not degrees, which only a CRS can tell
_PROJECTED_NAMES = {"x": "x easting xm e rechtswert utmx utmeasting", "y": "y northing ym n hochwert utmy utmnorthing"}
# What a name may have around it: `%time,field.latitude` of rostopic, and units that change nothing
_AROUND = re.compile(r"^(?:%|field\.)|\s*[(\[](?:s|sec|seconds?|deg|degrees|°|m|meters|utc|gmt)[)\]]$", re.IGNORECASE)
_PATH = re.compile(r"[./]")
_SIDES = {"x_side": "ew eastwest ewindicator londir", "y_side": "ns northsouth nsindicator latdir"}
_SIDE_OF = {"x_side": ("lon", "longitude"), "y_side": ("lat", "latitude")}
_SIDE_ENDS = ("hemisphere", "hemi", "dir", "direction", "ref", "indicator")
_PART_NAMES = {"minute": "minute min", "second": "second sec seconds"}
_SECONDS = re.compile(r"(?P<of>.*?)(?:secs?|seconds)")
_NANOSECONDS = ("nsec", "nsecs", "nanosec", "nanosecs", "nanoseconds")


def guess_columns(header: list[str], given: Mapping[str, str], *, is_projected: bool) -> dict[str, str]:
    """Return a column for each thing that is not given, by its name; a date without a time of day beside it is one.

    Of paths, as ROS and what reads it write them (`/gps/fix/latitude`), the last part counts where nothing else does.
    """
    plain = _plain(header)
    last = _plain([_PATH.split(name)[-1] for name in header], header) if any(map(_PATH.search, header)) else {}
    taken = set(given.values())
    guessed = _paired(plain, given, taken)
    for thing, names in _NAMES.items():
        wanted = f"{names} {_PROJECTED_NAMES.get(thing, '')}".split() if is_projected else names.split()
        free = (known[n] for known in (plain, last) for n in wanted if n in known and known[n] not in taken)
        name = next(free, "")
        if name and not {thing} & (given.keys() | guessed.keys()) and not (thing == "time" and "tow" in given):
            guessed[thing] = name
            taken.add(name)
    return _settled(guessed, given)


def _plain(names: list[str], columns: list[str] | None = None) -> dict[str, str]:
    """Return columns by what their names come down to; of equal ones the first."""
    pairs = list(zip(names, columns or names, strict=True))
    return {re.sub(r"[\W_]+", "", _AROUND.sub("", name.lower())): column for name, column in reversed(pairs)}


def _paired(plain: Mapping[str, str], given: Mapping[str, str], taken: set[str]) -> dict[str, str]:
    """Return what is told by two columns or more together: seconds and nanoseconds, hemispheres, parts of a date."""
    found: dict[str, str] = {}
    for thing, side in _SIDES.items():
        names = [*side.split(), *(f"{name}{end}" for name in _SIDE_OF[thing] for end in _SIDE_ENDS)]
        column = next((plain[name] for name in names if name in plain), "")
        found |= {thing: column} if column and thing not in given else {}
    if len(found) < len(_SIDES):  # a lone `ns` counts satellites
        found = {}
    parts = {part: next((n for n in _PART_NAMES.get(part, part).split() if n in plain), "") for part in DATE_PARTS}
    if all(parts.values()) and "time" not in given:
        found |= {part: plain[name] for part, name in parts.items()}
    for name, column in plain.items():
        match = _SECONDS.fullmatch(name)
        partner = next((match["of"] + ns for ns in _NANOSECONDS if match["of"] + ns in plain), "") if match else ""
        if partner and not {"time", "nanoseconds", "second"} & (given.keys() | found.keys()):
            found |= {"time": column, "nanoseconds": plain[partner]}
    taken |= set(found.values())
    return found


def _settled(guessed: dict[str, str], given: Mapping[str, str]) -> dict[str, str]:
    """Return the guesses without those that others make needless."""
    known = guessed.keys() | given.keys()
    if "year" in known:
        guessed = {thing: name for thing, name in guessed.items() if thing not in {"time", "date", "week", "tow"}}
    elif "time" in guessed or not {"week", "tow"} <= known:
        guessed = {thing: name for thing, name in guessed.items() if thing not in {"week", "tow"}}
    if "date" in guessed and not {"time", "tow"} & (guessed.keys() | given.keys()):
        guessed["time"] = guessed.pop("date")
    if {"x", "y"} <= known:
        guessed.pop("lat_lon", None)
    return guessed
