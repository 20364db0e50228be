from __future__ import annotations

import gzip
import tracemalloc

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geofleet.errors import InputError
from geofleet.formats.xml import MAX_DEPTH, iter_elements, number, place, root_tag, text_of

SMALL = b'<map>\n <way id="1">\n  <nd ref="7"/> <tag k="a"/>\n </way>\n <node id="2"/>\n</map>'
BOMB = b'<?xml version="1.0"?>\n<!DOCTYPE a [<!ENTITY b "bb"><!ENTITY c "&b;&b;&b;">]>\n<map><way id="&c;"/></map>'
OUTSIDE = b'<!DOCTYPE map [<!ENTITY x SYSTEM "file:///etc/passwd">]>\n<map><way>&x;</way></map>'


@pytest.fixture
def read(tmp_path):
    def read(content: bytes, tags=("way", "node"), **options):
        path = tmp_path / "file.xml"
        path.write_bytes(content)
        return list(iter_elements(path, tags, **options))

    return read


def test_elements_come_whole_in_order_with_their_lines(read):
    way, node = read(SMALL)
    assert (way.tag, way.get("id"), way.line, len(way)) == ("way", "1", 2, 2)
    assert [(child.tag, child.line) for child in way] == [("nd", 3), ("tag", 3)]
    assert (node.tag, node.line, place(node)) == ("node", 5, 'line 5: <node id="2">')


def test_what_is_left_out_is_gone_with_everything_in_it(read):
    (way,) = read(b"<m><way>a<data>b<nd/>c<data/>d</data>e<nd/>f</way></m>", ["way"], without=["data"])
    assert [child.tag for child in way.iter()] == ["way", "nd"]
    assert way.text == "aef"


def test_a_wanted_element_within_another_is_its_descendant(read):
    (outer,) = read(b"<m><way><way id='2'/></way></m>")
    assert [child.get("id") for child in outer] == ["2"]


@pytest.mark.parametrize(
    "start",
    [
        b"",
        b"\xef\xbb\xbf",
        b"\xef\xbb\xbf<?xml version='1.0' encoding='utf-8'?>",
        b"\n \n<?xml version='1.0'?>",
        b"<!-- made by --><?xml version='1.0'?>",
        b"\xef\xbb\xbf<!-- a --> <!--\n?xml --><?xml version='1.0'?><!-- c -->",
    ],
)
def test_byte_order_marks_and_comments_before_the_declaration(read, start):
    way, _ = read(start + SMALL)
    assert way.line == 2 + start.count(b"\n")
    assert root_tag(start + SMALL) == "map"


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1", "cp1252"])
def test_encodings(read, encoding):
    text = f'<?xml version="1.0" encoding="{encoding}"?><map><way name="Straße"/></map>'
    assert read(text.encode(encoding))[0].get("name") == "Straße"
    assert root_tag(text.encode(encoding)) == "map"


def test_namespaces_are_dropped(read):
    content = b'<o:map xmlns:o="http://o"><o:way id="1"><o:nd/></o:way></o:map>'
    (way,) = read(content, root="map")
    assert [child.tag for child in way.iter()] == ["way", "nd"]
    assert root_tag(content) == "map"


def test_packed_with_gzip(read):
    assert len(read(gzip.compress(SMALL))) == 2
    assert root_tag(gzip.compress(SMALL)) == "map"
    for packed in (gzip.compress(SMALL)[:-9], gzip.compress(SMALL)[:30] + b"?" * 30):
        with pytest.raises(InputError, match=r"file\.xml: "):
            read(packed)


@pytest.mark.parametrize("content", [BOMB, OUTSIDE, b"<!DOCTYPE map SYSTEM 'http://example.com/x.dtd'><map/>"])
def test_document_types_are_refused(read, content):
    with pytest.raises(InputError, match=r"file\.xml: line \d: the file declares a document type"):
        read(content)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "empty"),
        (b"\0\1\2 not xml", "not well-formed"),
        (SMALL[:40], "line 3: not well-formed XML .* truncated"),
        (SMALL.replace(b"/> <tag", b"> <tag"), "line 4: not well-formed"),
        (b"<map><way id='&x;'/></map>", "undefined entity"),
        (b"<?xml version='1.0' encoding='klingon'?><map/>", "encoding"),
        (b"<map>" * (MAX_DEPTH + 1), f"nested deeper than {MAX_DEPTH}"),
        (b"<osm/>", "root element is <osm>, not <map>"),
        (b"<map><way a='" + b"x" * (17 << 20), "longer than 16 MiB"),
        (b"<map><way>" + b"x\n" * (9 << 20), "longer than 16 MiB"),
    ],
)
def test_a_file_that_is_not_whole_names_its_line(read, content, message):
    with pytest.raises(InputError, match=message):
        read(content, root="map")


def test_missing_file(tmp_path):
    with pytest.raises(InputError, match="no such file"):
        list(iter_elements(tmp_path / "none.xml", ["a"]))


def test_numbers_and_texts(read):
    (way,) = read(b'<m>\n<way id="3" s=" 1e-1 " t="" u="nan" v="1,5" w="1_0" x="1e999"/></m>')
    assert number(way, "s") == 0.1
    assert number(way, "t", 2.0) == number(way, "none", 2.0) == 2.0
    assert text_of(way, "id") == "3"
    for name in "uvwx":
        with pytest.raises(InputError, match=rf'line 2: <way id="3">: {name}="\S+" is no number'):
            number(way, name)
    for ask in (number, text_of):
        with pytest.raises(InputError, match="t is missing"):
            ask(way, "t")


def test_memory_does_not_grow_with_the_file(tmp_path):
    path = tmp_path / "long.xml"
    path.write_bytes(b"<map>" + b'<way id="1"><nd ref="12345"/></way>\n' * 30_000 + b"</map>")
    tracemalloc.start()
    assert sum(1 for _ in iter_elements(path, ["way"])) == 30_000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 6 << 20


def test_a_head_full_of_blanks_and_comments_takes_no_time():
    assert root_tag(b" " * 4096) == root_tag(b"<!-- -->" * 512) == root_tag(b"<!DOCTYPE [") == ""


@settings(max_examples=200, deadline=None)
@given(st.data())
def test_damaged_files_only_raise_input_errors(tmp_path_factory, data):
    base = bytearray(b"\xef\xbb\xbf<!-- c --><?xml version='1.0'?>\n" + SMALL + b"\n<!-- &amp; <![CDATA[x]]> -->")
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(base)))
        base[at : at + data.draw(st.integers(0, 9))] = data.draw(st.binary(max_size=4))
    path = tmp_path_factory.getbasetemp() / "damaged.xml"
    path.write_bytes(bytes(base) or b" ")
    elements, message = [], str(path)
    try:
        elements = list(iter_elements(path, ["way", "node"]))
    except InputError as error:
        message = str(error)
    assert str(path) in message
    assert all(element.line >= 1 for element in elements)
