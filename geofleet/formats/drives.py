"""Trajectories as `drives`: RTKLIB, NMEA, GPX, CSV and others, told by their content, under one quality control.

Times become UTC (GPS time is ahead by the leap seconds of its day), gaps start a segment, duplicate epochs, impossible
jumps and what lies inside of a stop are left out and counted, heading and speed come from the motion.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from geofleet.errors import SUSPICIOUS, ConfigError, InputError
from geofleet.formats import (
    drive_csv,
    drive_features,
    drive_layout,
    gnss_logger,
    gpx,
    inventory_files,
    nmea,
    rtklib,
)
from geofleet.formats.datum import datum_of
from geofleet.formats.drive_quality import JUMPS, judge_epochs
from geofleet.formats.foreign import refuse_foreign
from geofleet.formats.positions import PlaceCheck, area_doubt, reject_null_island
from geofleet.formats.reading import Datum, LayerRead, content_head, read_head, unpacked
from geofleet.formats.text_tables import is_header
from geofleet.tables.schemas import DRIVES, TIME
from geofleet.tables.store import build_table, lonlat

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from geofleet.formats.drive_epochs import Epochs
    from geofleet.formats.drive_quality import Judged

__all__ = ["FORMATS", "detect", "read_drive"]

RTKLIB, NMEA, GPX, GNSS_LOGGER, GIS, CSV = "rtklib", "nmea", "gpx", "gnsslogger", "gis", "csv"
FORMATS = {
    RTKLIB: "RTKLIB solution (.pos)",
    NMEA: "NMEA 0183 log with GGA or RMC",
    GPX: "GPX track or route",
    GNSS_LOGGER: "fixes of Android's GnssLogger",
    GIS: "GeoJSON, GeoPackage, Shapefile or FlatGeobuf with points that have a time, or lines",
    CSV: "CSV or columns of numbers, with a profile or columns named",
}
_MOSTLY_JUMPS = (
    f"{SUSPICIOUS}left out as impossible jumps, the most of a drive; are its times and their unit right (time_format)?"
)
_AS_RECEIVED = Datum(
    "OGC:CRS84",
    "none: taken as WGS 84, but corrected positions (RTK, PPP) are in the datum of their base stations, such as ETRS89",
    None,
)
DETECTORS = {
    RTKLIB: rtklib.detect,
    GPX: gpx.detect,
    NMEA: nmea.detect,
    GNSS_LOGGER: gnss_logger.detect,
    CSV: drive_csv.detect,
}
_READERS = {RTKLIB: rtklib.read_epochs, NMEA: nmea.read_epochs, GNSS_LOGGER: gnss_logger.read_epochs}


def detect(head: bytes) -> str:
    """Return the name of the format that a file's first bytes show, or ""."""
    return next((name for name, is_it in DETECTORS.items() if is_it(head)), "")


def recognise(path: Path) -> str:
    """Return the name of the format of what is known to be a drive, or "" when it is none of ours.

    Columns of text are one, whatever they are called: their reader says what is missing.

    Raises
    ------
    InputError
        The file is missing, unreadable or empty.
    """
    head = content_head(path)
    if found := detect(head):
        return found
    refuse_foreign(path)
    of_map = inventory_files.detect(head)
    if of_map in drive_features.FORMATS:
        return GIS
    return CSV if of_map == CSV and is_header(drive_layout.columns_of(head)) else ""


def read_drive(
    path: Path,
    file_format: str = "auto",
    *,
    columns: Mapping[str, str] | Path | None = None,
    crs: str | None = None,
    origin: tuple[float, float] | None = None,
    utm: tuple[str, float, float] | None = None,
) -> LayerRead:
    """Read a trajectory as one drive, or as one drive for each name in a column that says so or simultaneous track.

    Parameters
    ----------
    path
        The file, which may be packed: gzip, bzip2, or a zip of it alone.
    file_format
        A key of `FORMATS`, or `auto`.
    columns, crs, origin, utm
        For CSV, as in `drive_csv.read_epochs`.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or in no known format, or holds no epoch with a position.
    ConfigError
        An option is unknown or meant for CSV only.
    """
    with unpacked(path) as plain:
        return _read_drive(plain, file_format, columns=columns, crs=crs, origin=origin, utm=utm)


def _read_drive(path: Path, file_format: str, **given: Any) -> LayerRead:
    head = read_head(path)
    found_format = recognise(path) if file_format == "auto" else file_format
    options: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    if file_format == "auto" and options and not found_format:
        found_format = CSV
    is_known = found_format in {CSV, GIS} or (found_format in DETECTORS and DETECTORS[found_format](head))
    if not (is_known or (found_format in FORMATS and (file_format == "auto" or options))):
        raise InputError(
            f"not {FORMATS.get(file_format, 'a trajectory in a format that is read here')}.",
            where=str(path),
            todo=f"Supported are {'; '.join(f'{name}: {what}' for name, what in FORMATS.items())}.",
        )
    if found_format != CSV and options:
        raise ConfigError(f"{', '.join(options)} cannot be given for {found_format}.", where=str(path))
    crs = None
    if found_format == CSV:
        drives, skipped, found = drive_csv.read_epochs(path, **options)
        crs = drive_csv.stated_crs(path, **options)
    elif found_format == GPX:
        drives, skipped, found = gpx.read_epochs(path)
    elif found_format == GIS:
        drives, skipped, found, crs = drive_features.read_epochs(path)
    else:
        epochs, skipped, found = _READERS[found_format](path)
        drives = {"": epochs}
    layer = _layer(path, found_format, drives, Counter(skipped), Counter(found))
    place = lonlat(layer.table)
    check = PlaceCheck(str(path))
    check.add(*place, None)
    layer.found.update(check.doubts() | (area_doubt(crs, *place) if crs else {}))
    return replace(layer, datum=datum_of(crs, *place) if crs else _AS_RECEIVED)


def _layer(
    path: Path, file_format: str, drives: dict[str, Epochs], skipped: Counter[str], found: Counter[str]
) -> LayerRead:
    tables = []
    for name, epochs in drives.items():
        reject_null_island(epochs.lon, epochs.lat, where=str(path))
        judged = judge_epochs(epochs)
        if 2 * judged.skipped.get(JUMPS, 0) > len(epochs.lon):
            found[_MOSTLY_JUMPS] += judged.skipped[JUMPS]
        skipped.update(judged.skipped)
        found.update(judged.found)
        columns = _columns(judged, f"{path.stem}-{name}" if name else path.stem, path.name)
        tables.append(build_table(DRIVES, columns, (judged.epochs.lon, judged.epochs.lat)))
    left_out = {reason: n for reason, n in skipped.items() if n}
    return LayerRead(pa.concat_tables(tables), file_format, left_out, dict(found))


def _columns(judged: Judged, drive_id: str, source: str) -> dict[str, object]:
    epochs, motion = judged.epochs, judged.motion
    return {
        "drive_id": drive_id,
        "seq": np.arange(len(epochs.lon)),
        "t_utc": pa.array(epochs.t_utc, TIME),
        "height_m": epochs.height_m,
        "heading_deg": motion.heading_deg,
        "speed_mps": motion.speed_mps,
        "fix_quality": epochs.quality,
        "sigma_e_m": epochs.sigma_e_m,
        "sigma_n_m": epochs.sigma_n_m,
        "segment": motion.segment,
        "source": source,
    }
