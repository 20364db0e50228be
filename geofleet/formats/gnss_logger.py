"""Fixes in the text files of Android's GnssLogger; of several providers at a time, the best one's are the drive.

Measurements (`Raw`) and statuses are no positions; they are counted.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pandas as pd

from geofleet.errors import InputError
from geofleet.formats.drive_epochs import NO_POSITION, Epochs
from geofleet.formats.drive_times import numbers_of, times_of
from geofleet.formats.reading import refuse_long_lines

if TYPE_CHECKING:
    from pathlib import Path

_NAMES = re.compile(rb"^#\s*(Fix,[^\r\n]+)", re.MULTILINE)
_PROVIDERS = ("GT", "GPS", "FLP", "FUSED", "NLP", "NETWORK")  # best first
_TIMES = ("unixtimemillis", "utctimeinms")
_COLUMNS = {"latitude": "lat", "latitudedegrees": "lat", "longitude": "lon", "longitudedegrees": "lon"}


def detect(head: bytes) -> bool:
    """Tell whether a file's first bytes are those of a log with fixes."""
    return head.startswith(b"#") and bool(_NAMES.search(head))


def read_epochs(path: Path) -> tuple[Epochs, dict[str, int], dict[str, int]]:
    """Read every fix of the best provider of a log, in the order of the file.

    Raises
    ------
    InputError
        A line is too long, or the log holds no fix.
    """
    refuse_long_lines(path)
    frame, n_other = _fixes(path)
    provider = frame["provider"].str.strip().str.upper()
    best = next((name for name in _PROVIDERS if (provider == name).any()), None)
    chosen = frame[provider == best] if best else frame
    lon, lat = (numbers_of(chosen[name]) for name in ("lon", "lat"))
    t_utc, _ = times_of(chosen["time"], "unix_ms")
    epochs = Epochs.of(lon, lat, t_utc=t_utc)
    placed = epochs.is_placed()
    if not placed.any():
        raise InputError(
            f"holds no fix ({len(frame)} lines of fixes, {n_other} others).",
            where=str(path),
            todo="Log fixes beside the measurements, or solve the measurements with RTKLIB and give the .pos.",
        )
    skipped = {NO_POSITION: int((~placed).sum()), f"fixes of others than {best}": len(frame) - len(chosen)}
    return epochs.take(placed), skipped, {"lines of measurements or statuses": n_other}


def _fixes(path: Path) -> tuple[pd.DataFrame, int]:
    """Return provider, time, longitude and latitude of each fix as text, and how many lines are others."""
    fixes, names, n_other = [], "", 0
    with path.open("rb") as file:
        for line in file:
            if line.startswith(b"Fix,"):
                fixes.append(line)
            elif match := _NAMES.match(line):
                names = names or match[1].decode("utf-8", "replace")
            elif line.strip() and not line.startswith(b"#"):
                n_other += 1
    plain = [re.sub(r"[\W_]+", "", name.lower()) for name in names.split(",")]
    known = [_COLUMNS.get(name, "time" if name in _TIMES else name) for name in plain]
    if not {"provider", "lat", "lon", "time"} <= set(known):
        raise InputError(f"the fixes have columns {', '.join(plain)[:200]}.", where=str(path), todo="Log them again.")
    rows = [(line.decode("utf-8", "replace").split(",") + [""] * len(known))[: len(known)] for line in fixes]
    return pd.DataFrame(rows, columns=known, dtype="string"), n_other
