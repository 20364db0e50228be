"""Streaming XML of unknown origin: elements one at a time, bounded memory, no document type, no entities.

Everything a file can do to a parser ends in an `InputError` with the line: bombs and external entities need a document
type, which is refused as soon as it starts; nesting and the length of one tag are limited.
"""

from __future__ import annotations

import bz2
import math
import re
import zlib
from contextlib import contextmanager
from typing import TYPE_CHECKING
from xml.etree.ElementTree import Element as _PlainElement
from xml.parsers import expat

from geofleet.errors import InputError
from geofleet.formats.reading import BZIP2, GZIP, open_unpacked, read_head

if TYPE_CHECKING:
    from collections.abc import Collection, Generator, Iterator
    from pathlib import Path
    from typing import BinaryIO

MAX_DEPTH = 200
MAX_TOKEN_BYTES = 16 << 20
_CHUNK_BYTES = 1 << 16
_HEAD_BYTES = 1 << 16
# Comments and blanks before the declaration are not XML, yet exporters write them. Both patterns are possessive: they
# take time in proportion to the head, whatever is in it.
_BEFORE_DECLARATION = re.compile(rb"(?:\xef\xbb\xbf)?+(\s*+(?:<!--(?>.*?-->)\s*+)*+)(?=<\?xml\s)", re.DOTALL)
_BEFORE_ROOT = re.compile(
    rb"(?:\s++|<\?(?>.*?\?>)|<!--(?>.*?-->)|<!DOCTYPE[^>\[]*+(?:\[(?>.*?\])\s*+)?+>)*+<([^\s/>?!]+)", re.DOTALL
)


class Element(_PlainElement):
    """An element of `xml.etree`, its tag without namespace, that knows the line where it starts."""

    __slots__ = ("line",)
    line: int

    if TYPE_CHECKING:  # what is in an element is of its kind; the methods are those of the base class

        def find(  # noqa: D102 - typing only
            self, path: str, namespaces: dict[str, str] | None = None
        ) -> Element | None: ...
        def findall(  # type: ignore[override]  # noqa: D102 - typing only; a list of these is what it returns
            self, path: str, namespaces: dict[str, str] | None = None
        ) -> list[Element]: ...
        def iter(self, tag: str | None = None) -> Generator[Element, None, None]: ...  # noqa: D102 - typing only
        def __iter__(self) -> Iterator[Element]: ...


def root_tag(head: bytes) -> str:
    """Return the name of the root element that a file's first bytes show, without namespace, or ""."""
    match = _BEFORE_ROOT.match(_as_ascii(head))
    return match[1].decode("ascii", "replace").rpartition(":")[2] if match else ""


def iter_elements(
    path: Path, tags: Collection[str], *, root: str = "", without: Collection[str] = ()
) -> Iterator[Element]:
    """Yield the elements with one of some tags, each complete with what is in it, in the order of the file.

    An element inside another one that is yielded comes as its descendant and not by itself. Whatever is not inside of
    such an element takes no memory, and an element is freed when the caller lets it go. Files may be packed (gzip,
    bzip2).

    Parameters
    ----------
    path
        The file.
    tags
        Tags wanted, without namespace.
    root
        The tag that the root must have; any by default.
    without
        Tags of descendants to leave out, with everything in them.

    Raises
    ------
    InputError
        The file is missing, empty, truncated or not XML, has another root or a document type, nests deeper than
        `MAX_DEPTH` or has a tag or a text longer than `MAX_TOKEN_BYTES`. The message names the line.
    """
    read_head(path)  # says what is wrong with the file as such
    collector = _Collector(frozenset(tags), root, frozenset(without))
    with explained(path), open_unpacked(path) as file:
        for chunk in _chunks(file, collector):
            collector.feed(chunk)
            yield from collector.take()
        collector.close()
        yield from collector.take()


def number(element: Element, name: str, default: float | None = None) -> float:
    """Return an attribute as a finite number; an absent or empty one is the default, if there is one.

    Raises
    ------
    InputError
        It is no finite number, or absent without a default. The message names attribute, tag and line.
    """
    text = element.get(name, "").strip()
    if not text and default is not None:
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value) or "_" in text:
        raise InputError(f'{name}="{text[:40]}" is no number.' if text else f"{name} is missing.", where=place(element))
    return value


def text_of(element: Element, name: str) -> str:
    """Return an attribute that must be there and not be empty.

    Raises
    ------
    InputError
        It is absent or empty. The message names attribute, tag and line.
    """
    text = element.get(name, "").strip()
    if not text:
        raise InputError(f"{name} is missing.", where=place(element))
    return text


def place(element: Element) -> str:
    """Return where an element stands, for an error message."""
    identity = element.get("id")
    return f"line {element.line}: <{element.tag}" + (f' id="{identity[:40]}">' if identity else ">")


@contextmanager
def explained(path: Path) -> Iterator[None]:
    """Put the path in front of where an InputError happened, and turn what a packed file raises into one."""
    try:
        yield
    except InputError as error:
        where = error.where if error.where.startswith(str(path)) else f"{path}: {error.where}".removesuffix(": ")
        raise InputError(error.what, where=where, todo=error.todo) from None
    except (EOFError, OSError, zlib.error) as error:
        raise InputError(
            f"cannot be read to its end ({error}).", where=str(path), todo="Fetch or export it again."
        ) from None


class _Collector:
    """Builds the wanted elements from expat's events."""

    def __init__(self, tags: frozenset[str], root: str, without: frozenset[str]) -> None:
        self._tags, self._root, self._without = tags, root, without
        self._open: list[Element] = []
        self._done: list[Element] = []
        self._text: list[str] = []
        self._text_size = self._depth = self._skip_depth = self._n_fed = 0
        self.lines_before = 0
        self._parser = expat.ParserCreate()
        self._parser.buffer_text = True
        self._parser.StartElementHandler = self._start
        self._parser.EndElementHandler = self._end
        self._parser.StartDoctypeDeclHandler = self._refuse_doctype

    def feed(self, chunk: bytes) -> None:
        """Parse some bytes."""
        self._parse(chunk, is_final=False)
        self._n_fed += len(chunk)
        if self._n_fed - self._parser.CurrentByteIndex > MAX_TOKEN_BYTES:
            raise InputError(f"a tag or text is longer than {MAX_TOKEN_BYTES >> 20} MiB.", where=self._where())

    def close(self) -> None:
        """Tell that the file ends here."""
        self._parse(b"", is_final=True)

    def take(self) -> Iterator[Element]:
        """Yield what is complete, and forget it."""
        while self._done:
            done, self._done = self._done, []
            done.reverse()
            while done:
                yield done.pop()

    def _parse(self, chunk: bytes, *, is_final: bool) -> None:
        try:
            self._parser.Parse(chunk, is_final)
        except expat.ExpatError as error:
            raise InputError(
                f"not well-formed XML ({expat.ErrorString(error.code)}).",
                where=f"line {error.lineno + self.lines_before}",
                todo="The file may be truncated: fetch or export it again.",
            ) from None
        except (ValueError, LookupError) as error:  # what an encoding that Python does not know raises
            raise InputError(f"cannot be decoded ({error}).", where=self._where(), todo="Save it as UTF-8.") from None

    def _where(self) -> str:
        return f"line {self._parser.CurrentLineNumber + self.lines_before}"

    def _refuse_doctype(self, *_: object) -> None:
        raise InputError(
            "the file declares a document type (<!DOCTYPE …>), which could make it expand without end or read other "
            "files.",
            where=self._where(),
            todo="Remove the declaration.",
        )

    def _start(self, name: str, attributes: dict[str, str]) -> None:
        tag = name.rpartition(":")[2]
        self._depth += 1
        if self._depth == 1 and self._root and tag != self._root:
            raise InputError(f"the root element is <{tag[:40]}>, not <{self._root}>.", where=self._where())
        if self._depth > MAX_DEPTH:
            raise InputError(f"elements are nested deeper than {MAX_DEPTH}.", where=self._where())
        if self._skip_depth or (not self._open and tag not in self._tags):
            return
        if self._open and tag in self._without:
            self._skip_depth = self._depth
            self._parser.CharacterDataHandler = None
            return
        self._flush_text()
        element = Element(tag, attributes)
        element.line = self._parser.CurrentLineNumber + self.lines_before
        if self._open:
            self._open[-1].append(element)
        self._open.append(element)
        self._parser.CharacterDataHandler = self._characters

    def _end(self, _: str) -> None:
        self._depth -= 1
        if self._skip_depth:
            if self._depth < self._skip_depth:
                self._skip_depth = 0
                self._parser.CharacterDataHandler = self._characters
            return
        if not self._open:
            return
        self._flush_text()
        element = self._open.pop()
        if not self._open:
            self._done.append(element)
            self._parser.CharacterDataHandler = None

    def _characters(self, data: str) -> None:
        self._text_size += len(data)
        if self._text_size > MAX_TOKEN_BYTES:
            raise InputError(f"a tag or text is longer than {MAX_TOKEN_BYTES >> 20} MiB.", where=self._where())
        self._text.append(data)

    def _flush_text(self) -> None:
        """Add the text read so far to the open element, which holds no text behind its children."""
        text = "".join(self._text).strip()
        self._text.clear()
        self._text_size = 0
        if text and self._open:
            self._open[-1].text = (self._open[-1].text or "") + text


def _chunks(file: BinaryIO, collector: _Collector) -> Iterator[bytes]:
    """Yield the bytes of a file, from its declaration on."""
    head = file.read(_HEAD_BYTES)
    match = _BEFORE_DECLARATION.match(head)
    if match and match[1]:
        collector.lines_before = match[1].count(b"\n")
        head = head[match.end() :]
    yield head
    while chunk := file.read(_CHUNK_BYTES):
        yield chunk


def _as_ascii(head: bytes) -> bytes:
    """Return the first bytes of a file unpacked, without byte order mark, UTF-16 reduced to its ASCII characters."""
    if head.startswith(GZIP):
        try:
            head = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(head, _HEAD_BYTES)
        except zlib.error:
            return b""
    if head.startswith(BZIP2):
        try:
            head = bz2.BZ2Decompressor().decompress(head, _HEAD_BYTES)
        except (OSError, EOFError):
            return b""
    if head.startswith((b"\xff\xfe", b"\xfe\xff")):
        return head[2:].replace(b"\0", b"")
    return head.removeprefix(b"\xef\xbb\xbf")
