"""What every reader gives back, and how a file of a supported kind is recognised."""

from __future__ import annotations

import bz2
import gzip
import tempfile
import zipfile
import zlib
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, cast

from geofleet.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import pyarrow as pa

GZIP, BZIP2, ZIP = b"\x1f\x8b", b"BZh", b"PK\x03\x04"
_HEAD_BYTES = 4096
_MAX_UNPACKED_BYTES = 4 << 30
MAX_LINE_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Datum:
    """What coordinates were in, and how they came to WGS 84.

    Parameters
    ----------
    crs
        Coordinate reference system of the file.
    to_wgs84
        The operation used.
    accuracy_m
        Of that operation as its registry states it, m; None when nobody does.
    doubt
        What may be wrong by up to a metre or two, in words; "" when nothing is.
    """

    crs: str = "OGC:CRS84"
    to_wgs84: str = "none needed"
    accuracy_m: float | None = 0.0
    doubt: str = ""


WGS84 = Datum()


@dataclass(frozen=True, slots=True)
class LayerRead:
    """A table read from one file.

    Parameters
    ----------
    table
        Rows in the schema asked for.
    file_format
        Short name of the format found.
    skipped
        Reason to number of items left out.
    found
        Other counts worth telling, e.g. unknown codes or gaps.
    datum
        CRS of the file, and how its coordinates came to WGS 84.
    """

    table: pa.Table
    file_format: str
    skipped: dict[str, int] = field(default_factory=dict)
    found: dict[str, int] = field(default_factory=dict)
    datum: Datum = WGS84


@dataclass(frozen=True, slots=True)
class LayerStream:
    """A table read from one file that need not be held as a whole.

    Parameters
    ----------
    pieces
        Gives tables in the schema asked for, each sorted by key and all of it before the next; at least one.
    file_format, skipped, found, datum
        As `LayerRead`; the counts are whole once all pieces have been taken.
    """

    pieces: Callable[[], Iterator[pa.Table]]
    file_format: str
    skipped: dict[str, int] = field(default_factory=dict)
    found: dict[str, int] = field(default_factory=dict)
    datum: Datum = WGS84

    @property
    def table(self) -> pa.Table:
        """All rows."""
        import pyarrow as pa  # noqa: PLC0415  (this module is also read where no table is)

        return pa.concat_tables(self.pieces())


def read_head(path: Path) -> bytes:
    """Return the first bytes of a file.

    Raises
    ------
    InputError
        There is no such file, it cannot be read, or it is empty.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except FileNotFoundError:
        raise InputError("there is no such file.", where=str(path), todo="Check the path.") from None
    except IsADirectoryError:
        raise InputError("a folder, not a file.", where=str(path), todo=f"Name the files in it: {path}/*") from None
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"cannot be read: {reason}.", where=str(path), todo="Give a readable file.") from None
    if not head:
        raise InputError("the file is empty.", where=str(path), todo="Fetch or export it again.")
    return head


def open_unpacked(path: Path) -> BinaryIO:
    """Open a file for reading; one packed with gzip or bzip2 gives what is in it."""
    with path.open("rb") as file:
        mark = file.read(len(BZIP2))
    if mark.startswith(GZIP):
        return cast("BinaryIO", gzip.open(path))
    return cast("BinaryIO", bz2.open(path)) if mark == BZIP2 else path.open("rb")


@contextmanager
def unpacked(path: Path) -> Iterator[Path]:
    """Yield a file itself or, when it is packed, a copy of what is in it, in a temporary folder.

    Packed are gzip, bzip2, and a zip of one file.

    Raises
    ------
    InputError
        What is packed is damaged or larger than any file of its kind; errors raised within name the file asked for.
    """
    head = read_head(path)
    member = _only_member(path) if head.startswith(ZIP) else ""
    if not (member or head.startswith((GZIP, BZIP2))):
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="geofleet-") as folder:
        copy = Path(folder) / (Path(member).name or path.stem)
        try:
            with _open_packed(path, member) as file, copy.open("wb") as out:
                while (chunk := file.read(MAX_LINE_BYTES)) and out.tell() <= _MAX_UNPACKED_BYTES:
                    out.write(chunk)
        except (OSError, EOFError, zlib.error, zipfile.BadZipFile, RuntimeError) as error:
            raise InputError(f"damaged: {error}.", where=str(path), todo="Fetch or pack it again.") from None
        if chunk:
            raise InputError("unpacks to more than 4 GiB.", where=str(path), todo="Unpack it, and check what it is.")
        try:
            yield copy
        except InputError as error:
            raise InputError(error.what, where=error.where.replace(str(copy), str(path)), todo=error.todo) from None


def is_packed(path: Path) -> bool:
    """Tell whether a file is packed with gzip or bzip2, or is a zip of one file; errors as `read_head`."""
    head = read_head(path)
    return head.startswith((GZIP, BZIP2)) or (head.startswith(ZIP) and bool(_only_member(path)))


def _only_member(path: Path) -> str:
    """Return the name of the one file in a zip, "" when it holds others or is damaged."""
    try:
        with zipfile.ZipFile(path) as archive:
            names = [entry.filename for entry in archive.infolist() if not entry.is_dir()]
    except (zipfile.BadZipFile, NotImplementedError, OSError):
        return ""
    names = [name for name in names if "__MACOSX" not in name]
    return names[0] if len(names) == 1 else ""


@contextmanager
def _open_packed(path: Path, member: str) -> Iterator[BinaryIO]:
    if not member:
        with open_unpacked(path) as file:
            yield file
        return
    with zipfile.ZipFile(path) as archive, archive.open(member) as inside:
        yield cast("BinaryIO", inside)


def unpacked_head(path: Path) -> bytes:
    """Return the first bytes of what a packed file holds, b"" when it is damaged."""
    try:
        with open_unpacked(path) as file:
            return file.read(_HEAD_BYTES)
    except (OSError, EOFError, zlib.error):
        return b""


def content_head(path: Path) -> bytes:
    """Return the first bytes of what a file holds, packed or not, b"" when it is damaged; errors as `read_head`."""
    head = read_head(path)
    member = _only_member(path) if head.startswith(ZIP) else ""
    if not (member or head.startswith((GZIP, BZIP2))):
        return head
    try:
        with _open_packed(path, member) as file:
            return file.read(_HEAD_BYTES)
    except (OSError, EOFError, zlib.error, zipfile.BadZipFile, RuntimeError, NotImplementedError):
        return b""


def refuse_long_lines(path: Path, *, max_bytes: int = MAX_LINE_BYTES) -> None:
    """Look through a text file, a piece at a time, for a line that no such file has.

    Raises
    ------
    InputError
        A line is longer than `max_bytes`. The message names it.
    """
    n_open = n_lines = 0
    with path.open("rb") as file:
        while chunk := file.read(max_bytes):
            cut = chunk.find(b"\n")
            n_open += len(chunk) if cut < 0 else cut
            if n_open > max_bytes:
                raise InputError(
                    f"the line is longer than {max_bytes >> 10} KiB.",
                    where=f"{path}: line {n_lines + 1}",
                    todo="This is no text file of epochs or rows: fetch or export it again.",
                )
            if cut >= 0:
                n_lines += chunk.count(b"\n")
                n_open = len(chunk) - chunk.rfind(b"\n") - 1
