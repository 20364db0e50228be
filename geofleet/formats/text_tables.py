"""Where the columns of a text file begin, what stands between them, and in which encoding: the same for every CSV."""

from __future__ import annotations

import codecs
import csv
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING

from geofleet.errors import ConfigError, InputError
from geofleet.formats.reading import read_head

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

DELIMITERS = ";\t|,"
ANSI = "cp1252"
NOT_UTF8 = "read as Windows-1252, since it is not UTF-8"
_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
_SEPARATOR = re.compile(r'"?sep=.')
_MAX_HEADER_LETTERS = 1 << 20
_MAX_NAME_LETTERS, _MAX_NAME_WORDS = 80, 8
_CHUNK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class Header:
    """The names of the columns, what stands between them, and how many lines come before."""

    names: list[str]
    delimiter: str
    n_before: int


def encoding_of(path: Path) -> str:
    """Return the encoding of a text: by its byte order mark, else UTF-8 when all of it is, else Windows-1252."""
    if read_head(path).startswith(_UTF16_MARKS):
        return "utf-16"
    decoder = codecs.getincrementaldecoder("utf-8")()
    try:
        for chunk in _chunks(path):
            decoder.decode(chunk)
        decoder.decode(b"", final=True)
    except UnicodeDecodeError:
        return ANSI
    return "utf-8"


def text_of_head(head: bytes) -> str:
    """Return the first bytes of a file as text: UTF-16 by its mark, else UTF-8 when they are, else Windows-1252."""
    if head.startswith(_UTF16_MARKS):
        return head.decode("utf-16", errors="replace")
    try:
        return codecs.getincrementaldecoder("utf-8-sig")().decode(head)
    except UnicodeDecodeError:
        return head.decode(ANSI, errors="replace")


def header_line(lines: Iterator[str]) -> tuple[str, int]:
    """Return the line that names the columns, "" without one, and how many lines come before it.

    Those are comments (`#`), empty lines, and the line by which a spreadsheet names the separator (`sep=;`).
    """
    for n_before, line in enumerate(lines):
        if line.strip() and not line.startswith("#") and not (_SEPARATOR.match(line) and not n_before):
            return line, n_before
    return "", 0


def delimiter_of(line: str) -> str:
    """Return what stands between the columns of a line, quoted text aside."""
    return max(DELIMITERS, key=re.sub(r'"[^"]*"', "", line).count)


def read_header(path: Path, encoding: str, delimiter: str | None = None) -> Header:
    """Return the header of a CSV file.

    Raises
    ------
    InputError
        The first line names fewer than two columns, or one of them twice.
    ConfigError
        The encoding is unknown.
    """
    try:
        with path.open(encoding="utf-8-sig" if encoding.lower() in {"utf-8", "utf8"} else encoding) as file:
            line, n_before = header_line(iter(lambda: file.readline(_MAX_HEADER_LETTERS), ""))
    except LookupError:
        raise ConfigError(f"unknown encoding {encoding!r}.", todo="Give one such as utf-8 or cp1252.") from None
    delimiter = delimiter or delimiter_of(line)
    names = next(csv.reader([line], delimiter=delimiter), [])
    if not is_header(names):
        raise InputError(
            "the first line names no columns.", where=str(path), todo="Give a CSV file with a header, or the delimiter."
        )
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        what = ", ".join(name or "without a name" for name in twice)[:200]
        raise InputError(
            f"columns {what} are there twice.",
            where=str(path),
            todo="Rename them, or take out what stands before the header; a file without one needs a header.",
        )
    return Header(names, delimiter, n_before)


def is_header(names: list[str]) -> bool:
    """Tell whether a line can name columns: a code or a time needs a position, and prose is none."""
    return len(names) > 1 and all(len(n) <= _MAX_NAME_LETTERS and len(n.split()) <= _MAX_NAME_WORDS for n in names)


def _chunks(path: Path) -> Iterator[bytes]:
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            yield chunk
