"""NMEA 0183 logs: position from GGA (else GNS, else RMC), date from RMC or ZDA, standard deviations from GST.

Sentences are found wherever they stand in a line, so logs of Android (`NMEA,$GPGGA,…*63,1699400577561`) and logs mixed
with binary messages are read. Sentences without a checksum are taken, those with a wrong one are left out; both are
counted.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from geofleet.errors import SUSPICIOUS, InputError
from geofleet.formats.drive_epochs import NO_POSITION, Epochs
from geofleet.formats.gnss_time import microseconds
from geofleet.formats.reading import refuse_long_lines

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Times = NDArray[np.datetime64]

GGA_QUALITY = {1: "single", 2: "dgps", 3: "single", 4: "fixed", 5: "float", 9: "sbas"}
_GNS_NUMBERS = {"R": "4", "F": "5", "D": "2", "P": "1", "A": "1"}  # quality of GGA
RMC_QUALITY = {"A": "single", "D": "dgps", "R": "fixed", "F": "float", "P": "ppp"}
_SENTENCE = re.compile(rb"\$([A-Z]{2})([A-Z]{3}),([^$*\r\n\x80-\xff]{0,400})(\*[^\r\n,]{0,2})?")
_DETECT = re.compile(rb"\$[A-Z]{2}(?:GGA|RMC|GST|GSA|GSV|GLL|VTG|TXT|GNS|ZDA|DTM),")
_UBX = b"\xb5\x62"  # begins a binary message of a u-blox receiver
_HALF_DAY_S = 43_200.0
_DAY_S = 86_400.0
_KNOWN = ("GGA", "GNS", "RMC", "GST", "ZDA")
_N_FIELDS = 15
# GPS counts weeks in ten bits: a receiver that does not know of the rollovers says a date 19.6 years too early
_LONG_AGO = np.datetime64("2007-04-07")
_OLD = f"{SUSPICIOUS}dated before 2007-04; does the receiver count its weeks 1024 too low?"
_CENTURY_PIVOT = 80  # GPS began in 1980


def detect(head: bytes) -> bool:
    """Tell whether a file's first bytes hold a sentence of a satellite receiver."""
    return head.startswith(_UBX) or bool(_DETECT.search(head))


def read_epochs(path: Path) -> tuple[Epochs, dict[str, int], dict[str, int]]:
    """Read every epoch of a log, in the order of the file.

    Returns
    -------
    tuple
        The epochs with a position, the numbers left out by reason, and other counts.

    Raises
    ------
    InputError
        A line is too long, or the log holds no epoch with a position.
    """
    refuse_long_lines(path)
    content = path.read_bytes()
    frame, counts = _sentences(content)
    frame, n_bad_times = _timed(frame)
    epoch = _numbered(frame["second"].to_numpy(np.float64))
    n = int(epoch[-1]) + 1 if len(epoch) else 0
    rmc, gst = (_fields(frame, kind, epoch, n) for kind in ("RMC", "GST"))
    gga = _fields(frame, "GGA", epoch, n).combine_first(_as_gga(_fields(frame, "GNS", epoch, n)))
    second = pd.Series(frame["second"].to_numpy(np.float64)).groupby(epoch).first().to_numpy(np.float64)
    t_utc, elapsed_s = _times(second, _dates(frame, epoch, n))
    from_rmc = gga[6].isna().to_numpy() & rmc[2].eq("A").to_numpy()
    lat = np.where(from_rmc, _degrees(rmc[3], rmc[4], "NS"), _degrees(gga[2], gga[3], "NS"))
    lon = np.where(from_rmc, _degrees(rmc[5], rmc[6], "EW"), _degrees(gga[4], gga[5], "EW"))
    fix = _numbers(gga[6])
    is_fix = from_rmc | (fix > 0)
    epochs = Epochs.of(
        np.where(is_fix, lon, np.nan),
        np.where(is_fix, lat, np.nan),
        t_utc=t_utc,
        height_m=_numbers(gga[9]) + _numbers(gga[11]),
        quality=np.where(from_rmc, rmc[12].map(RMC_QUALITY), gga[6].map(lambda q: GGA_QUALITY.get(_integer(q)))),
        n_satellites=_numbers(gga[7]),
        sigma_n_m=_positive(_numbers(gst[6])),
        sigma_e_m=_positive(_numbers(gst[7])),
        elapsed_s=elapsed_s,
    )
    placed = epochs.is_placed()
    if not placed.any():
        raise _no_position(path, content, counts, n)
    skipped = {"sentences with a wrong checksum": counts["wrong"], "sentences without a readable time": n_bad_times}
    skipped[NO_POSITION] = int((~placed).sum())
    found = {"sentences without a checksum": counts["missing"], "sentences of other kinds": counts["other"]}
    found[_OLD] = int((t_utc[placed] < _LONG_AGO).sum())
    if elapsed_s is not None:
        found["no date in the log: times are not known"] = n
    return epochs.take(placed), skipped, {name: count for name, count in found.items() if count}


def _no_position(path: Path, content: bytes, counts: dict[str, int], n_epochs: int) -> InputError:
    """Return why a log holds no position."""
    if not counts["sentences"]:
        what = "a log of binary messages (UBX), which are not read" if content.startswith(_UBX) else "no sentence"
        return InputError(f"holds {what}.", where=str(path), todo="Log or convert it to NMEA: GGA or RMC.")
    kinds = sorted({match[2].decode() for match in _SENTENCE.finditer(content)})
    return InputError(
        f"holds no epoch with a position ({counts['sentences']} sentences read, {', '.join(kinds)[:100]}, "
        f"{counts['wrong']} of them with a wrong checksum; {n_epochs} epochs, none with a fix).",
        where=str(path),
        todo="Give a log with GGA, GNS or RMC sentences of a receiver that has a fix.",
    )


def _as_gga(gns: pd.DataFrame) -> pd.DataFrame:
    """Return GNS sentences as GGA ones: a quality for each system becomes that of the best one."""
    best = gns[6].map(
        lambda modes: next((_GNS_NUMBERS[m] for m in "RFDPA" if isinstance(modes, str) and m in modes), None)
    )
    return pd.DataFrame(
        {1: gns[1], 2: gns[2], 3: gns[3], 4: gns[4], 5: gns[5], 6: best, 7: gns[7], 9: gns[9], 11: gns[10]}
    )


def checksums(content: bytes, first: NDArray[np.int64], stop: NDArray[np.int64]) -> NDArray[np.uint8]:
    """Return the exclusive or of the bytes from `first` to before `stop`, each."""
    running = np.concatenate(
        (np.zeros(1, np.uint8), np.bitwise_xor.accumulate(np.frombuffer(content, np.uint8)))
        if content
        else (np.zeros(1, np.uint8),)
    )
    return np.asarray(running[stop] ^ running[first])


def _sentences(content: bytes) -> tuple[pd.DataFrame, dict[str, int]]:
    """Return kind and fields of the sentences that are used, and the counts of all."""
    matches = list(_SENTENCE.finditer(content))
    first = np.array([m.start() + 1 for m in matches], np.int64)
    stop = np.array([m.end(3) for m in matches], np.int64)
    stated = [m[4] for m in matches]
    missing = np.array([s is None for s in stated], bool)
    value = np.array([_hex(s) for s in stated], np.int64)
    wrong = ~missing & (value != checksums(content, first, stop).astype(np.int64))
    kinds = np.array([m[2].decode() for m in matches], object)
    known = np.isin(kinds, _KNOWN)
    kept = np.flatnonzero(known & ~wrong)
    rows = [[kinds[i], *(matches[i][3].decode("ascii").split(",", _N_FIELDS))] for i in kept]
    padded = [(row + [None] * _N_FIELDS)[: _N_FIELDS + 1] for row in rows]
    frame = pd.DataFrame(padded, columns=range(_N_FIELDS + 1), dtype=object)
    counts = {"sentences": len(matches), "wrong": int(wrong.sum()), "missing": int((missing & known).sum())}
    return frame, counts | {"other": int((~known & ~wrong).sum())}


def _hex(stated: bytes | None) -> int:
    """Return the number of `*5F`, -1 where there is none."""
    try:
        return int(stated[1:], 16) if stated and len(stated) == len(b"*5F") else -1
    except ValueError:
        return -1


def _timed(frame: pd.DataFrame) -> tuple[pd.DataFrame, int]:
    """Add the second of the day to every sentence; those without one are left out and counted."""
    clock = frame[1].astype("string").str.extract(r"^(\d{2})(\d{2})(\d{2}(?:\.\d*)?)$")
    hours, minutes, seconds = (_numbers(clock[i]) for i in range(3))
    second = hours * 3600.0 + minutes * 60.0 + seconds
    known = (hours < 24) & (minutes < 60) & (seconds < 61)  # noqa: PLR2004  (the clock; 60 is a leap second)
    return frame.assign(second=second)[known].reset_index(drop=True), int((~known).sum())


def _numbered(second: Floats) -> NDArray[np.int64]:
    """Return the number of each sentence's epoch: neighbours of one time belong together."""
    return np.cumsum(np.diff(second, prepend=second[:1]) != 0) if len(second) else np.zeros(0, np.int64)


def _fields(frame: pd.DataFrame, kind: str, epoch: NDArray[np.int64], n: int) -> pd.DataFrame:
    """Return the fields of the first sentence of a kind of each epoch, missing where it has none."""
    mine = (frame[0] == kind).to_numpy(bool)
    rows = frame[mine].set_axis(epoch[mine])
    return rows[~rows.index.duplicated()].reindex(range(n))


def _dates(frame: pd.DataFrame, epoch: NDArray[np.int64], n: int) -> Times:
    """Return the date of each epoch, NaT where no sentence says it."""
    rmc, zda = _fields(frame, "RMC", epoch, n), _fields(frame, "ZDA", epoch, n)
    parts = rmc[9].astype("string").str.extract(r"^(\d{2})(\d{2})(\d{2})$")
    year = _numbers(parts[2])
    year = np.where(year >= _CENTURY_PIVOT, year + 1900, year + 2000)
    columns = {"year": year, "month": _numbers(parts[1]), "day": _numbers(parts[0])}
    by_rmc = pd.to_datetime(pd.DataFrame(columns), errors="coerce")
    columns = {"year": _numbers(zda[4]), "month": _numbers(zda[3]), "day": _numbers(zda[2])}
    by_zda = pd.to_datetime(pd.DataFrame(columns), errors="coerce")
    return by_rmc.fillna(by_zda).to_numpy("datetime64[us]")


def _times(second: Floats, date: Times) -> tuple[Times, Floats | None]:
    """Return UTC; where no epoch has a date, seconds since the first midnight beside it.

    An epoch without a date has that of the last one before it (else of the first one), a day on for each midnight
    between them.
    """
    step = np.diff(second, prepend=second[:1])
    midnights = np.cumsum((step < -_HALF_DAY_S).astype(np.int64) - (step > _HALF_DAY_S))
    known = np.flatnonzero(~np.isnat(date))
    if not len(known):
        return np.full(len(second), "NaT", "datetime64[us]"), second + midnights * _DAY_S
    anchor = known[np.maximum(np.searchsorted(known, np.arange(len(second)), side="right") - 1, 0)]
    days = (midnights - midnights[anchor]).astype("timedelta64[D]")
    return np.asarray(date[anchor] + days + microseconds(second)), None


def _degrees(text: pd.Series[str], side: pd.Series[str], sides: str) -> Floats:
    """Return `ddmm.mm` with its hemisphere as degrees, NaN where it is none."""
    number = np.where(
        text.astype("string").str.fullmatch(r"\d{3,5}(\.\d*)?").fillna(value=False), _numbers(text), np.nan
    )
    whole = np.floor(number / 100.0)
    minutes = number - 100.0 * whole
    sign = np.select([side.eq(sides[0]), side.eq(sides[1])], [1.0, -1.0], np.nan)
    return np.where(minutes < 60.0, sign * (whole + minutes / 60.0), np.nan)  # noqa: PLR2004  (minutes)


def _numbers(text: pd.Series[str]) -> Floats:
    values = pd.to_numeric(text, errors="coerce").to_numpy(np.float64, na_value=np.nan)
    return np.where(np.isfinite(values), values, np.nan)


def _integer(text: object) -> int:
    return int(text) if isinstance(text, str) and text.isdigit() else -1


def _positive(sigma_m: Floats) -> Floats:
    return np.where(sigma_m > 0, sigma_m, np.nan)
