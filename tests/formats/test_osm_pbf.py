from __future__ import annotations

import bz2
import lzma
import random
import zlib
from itertools import pairwise

import numpy as np
import osmium
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st
from osmium.osm import NODE, WAY
from osmium.osm.mutable import Node, Way

from geofleet.errors import InputError
from geofleet.formats import osm_pbf
from geofleet.formats.osm import read_lanes, read_signs
from geofleet.formats.osm_pbf import UnusualPbfError, read_blocks
from geofleet.formats.osm_road_scan import read_roads
from geofleet.formats.osm_scan import sign_nodes
from geofleet.formats.osm_strings import Strings
from geofleet.formats.osm_tags import POINT_HIGHWAYS, is_drivable, is_sign_key
from geofleet.formats.protobuf import DamagedPbfError, deltas_of, varints

INT64 = st.integers(-(2**63), 2**63 - 1)


def packed(number: int) -> bytes:
    out = bytearray()
    number &= 2**64 - 1
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*out, number])


def zigzag(number: int) -> bytes:
    return packed((number << 1) ^ (number >> 63))


def field(number: int, content: bytes) -> bytes:
    return packed(number << 3 | 2) + packed(len(content)) + content


def block(strings: list[bytes], *groups: bytes, **numbers: int) -> bytes:
    table = b"".join(field(1, text) for text in strings)
    names = {"granularity": 17, "lat_offset": 19, "lon_offset": 20}
    extra = b"".join(packed(names[name] << 3) + packed(value) for name, value in numbers.items())
    return field(1, table) + b"".join(field(2, group) for group in groups) + extra


def dense(nodes: list[tuple[int, int, int, list[int]]]) -> bytes:
    """Return a group of nodes: id, lon, lat in units of the granularity, numbers of strings."""
    columns = []
    for index in (0, 2, 1):
        values = [node[index] for node in nodes]
        columns.append(b"".join(zigzag(b - a) for a, b in zip([0, *values], values, strict=False)))
    tags = b"".join(packed(n) for node in nodes for n in [*node[3], 0])
    return field(2, field(1, columns[0]) + field(8, columns[1]) + field(9, columns[2]) + field(10, tags))


PACKINGS = {
    "zlib": (3, zlib.compress),
    "lzma": (4, lambda content: lzma.compress(content, lzma.FORMAT_ALONE)),
    "bzip2": (5, bz2.compress),
    "lz4": (6, lambda content: pa.Codec("lz4_raw").compress(content, asbytes=True)),
    "zstd": (7, lambda content: pa.Codec("zstd").compress(content, asbytes=True)),
}


def blob(kind: bytes, content: bytes, how: str = "zlib") -> bytes:
    if how == "raw":
        body = field(1, content)
    else:
        number, pack = PACKINGS[how]
        body = packed(2 << 3) + packed(len(content)) + field(number, pack(content))
    header = field(1, kind) + packed(3 << 3) + packed(len(body))
    return len(header).to_bytes(4, "big") + header + body


def pbf(path, *blocks, how="zlib", features=(b"OsmSchema-V0.6", b"DenseNodes")):
    head = b"".join(field(4, feature) for feature in features)
    path.write_bytes(blob(b"OSMHeader", head) + b"".join(blob(b"OSMData", content, how) for content in blocks))
    return path


STRINGS = [b"", b"traffic_sign", b"DE:206", b"highway", b"stop", b"primary", b"x" * 200]
SIGN = dense([(5, 100_000_000, 500_000_000, [1, 2]), (9, 100_000_001, -500_000_000, []), (-3, 0, 0, [3, 4])])


@given(st.lists(st.integers(0, 2**64 - 1)))
def test_numbers_are_decoded(numbers):
    assert varints(b"".join(map(packed, numbers))).view(np.uint64).tolist() == numbers


@given(st.lists(st.lists(st.integers(-(2**40), 2**40)), max_size=4))
def test_differences_of_several_sequences_are_summed_each_for_itself(sequences):
    parts = [b"".join(zigzag(b - a) for a, b in zip([0, *numbers], numbers, strict=False)) for numbers in sequences]
    numbers, start = deltas_of(parts)
    assert [numbers[a:b].tolist() for a, b in pairwise(start)] == sequences
    for wrong in ([*parts, b"\x80", b"\x00"], [*parts, b"\x80"]):
        with pytest.raises(DamagedPbfError, match="does not end"):
            deltas_of(wrong)


@given(st.lists(st.lists(st.binary(max_size=300), max_size=20), max_size=4))
def test_strings_are_found_wherever_their_bytes_repeat(texts):
    tables = [b"".join(field(1, text) for text in some) for some in texts]
    strings = Strings.of(tables)
    assert strings.first.tolist() == np.cumsum([0, *map(len, texts)]).tolist()
    flat = [text for some in texts for text in some]
    assert [strings[n] for n in range(len(strings))] == flat
    for text in flat:
        if len(text) >= 3:
            assert [n for n, other in enumerate(flat) if other == text] == strings.numbers([text])


@pytest.mark.parametrize(
    "tables", [[b"\n\x05ab", b"\n\x01c"], [b"\n\x01a", b"x"], [b"\n\x01a\n\x03b"], [b"ab", b"\n\x00"]]
)
def test_a_string_that_ends_beyond_its_table_is_refused(tables):
    with pytest.raises(DamagedPbfError, match="string table"):
        Strings.of(tables)


def all_of(nodes):
    """Return all nodes of a spool, in the order of the file."""
    return np.concatenate(list(nodes.spool.chunks()))


@pytest.mark.parametrize("how", ["zlib", "raw", "lzma", "lz4", "zstd"])
def test_a_block_by_hand(tmp_path, how):
    nodes = sign_nodes(pbf(tmp_path / "a.pbf", block(STRINGS, SIGN), how=how))
    found = [(n, x, y, nodes.tagsets[s]) for n, x, y, s in all_of(nodes).tolist()]
    assert found == [(5, 100_000_000, 500_000_000, {"traffic_sign": "DE:206"}), (-3, 0, 0, {"highway": "stop"})]


@pytest.mark.parametrize(
    "numbers", [{"granularity": 1000}, {"lat_offset": 123_456_789}, {"granularity": 7, "lon_offset": 99}]
)
def test_granularity_and_offsets_are_libosmium_s(tmp_path, numbers):
    group = dense([(n, 1234567 * n, -7654321 * n, [1, 2]) for n in range(1, 12)])
    path = pbf(tmp_path / "a.osm.pbf", block(STRINGS, group, **numbers))
    expected = [(node.id, node.location.x, node.location.y) for node in osmium.FileProcessor(path, NODE)]
    assert [row[:3] for row in all_of(sign_nodes(path)).tolist()] == expected


def way_group(*ways):
    return b"".join(
        field(
            3,
            packed(1 << 3)
            + packed(number)
            + field(2, b"".join(map(packed, tags[::2])))
            + field(3, b"".join(map(packed, tags[1::2])))
            + field(8, b"".join(zigzag(b - a) for a, b in zip([0, *refs], refs, strict=False))),
        )
        for number, refs, tags in ways
    )


def test_ways_may_come_before_their_nodes_and_in_one_block_with_them(tmp_path):
    ways = way_group((7, [5, 9], [3, 5]), (8, [5, 9], [6, 6]))
    for blocks in ([block(STRINGS, ways, SIGN)], [block(STRINGS, ways), block(STRINGS, SIGN)]):
        path = pbf(tmp_path / "a.pbf", *blocks)
        roads = read_roads(path)
        assert roads.way_id.tolist() == [7]
        assert roads.lat.tolist() == [50.0, -50.0]
        assert len(all_of(sign_nodes(path))) == 2


def test_ways_are_passed_over_once_some_have_come_and_nodes_after_them_are_not(tmp_path, monkeypatch):
    monkeypatch.setattr(osm_pbf, "_BYTES_AT_ONCE", 1)
    ways = block(STRINGS, way_group(*((n, [5, 9], [3, 5]) for n in range(1, 9))))
    signs = block(STRINGS, SIGN)
    path = pbf(tmp_path / "a.pbf", signs, *[ways] * 8, signs, *[ways] * 8, signs)
    sizes = [len(one.data) for some in read_blocks(path, lambda blocks: blocks, nodes_only=True) for one in some]
    assert [sizes[0], sizes[9], sizes[18]] == [len(signs)] * 3
    assert sizes[1:9] == [len(ways)] * 4 + [0] * 4
    assert sorted(set(sizes[10:18])) == [0, len(ways)]
    assert all_of(sign_nodes(path))["node_id"].tolist() == [5, -3] * 3


def test_blocks_decoded_together_give_what_each_gives_alone(tmp_path, monkeypatch):
    other = [b"", b"highway", b"give_way", b"x", b"traffic_sign", b"DE:101", b""]
    path = pbf(
        tmp_path / "a.pbf",
        block(STRINGS, SIGN, dense([(1, 7, 8, [])]), dense([(2, -7, -8, [1, 6, 3, 5])]), granularity=1000),
        block([b""], dense([(3, 1, 1, [])])),
        block(other, dense([(11, 123, 456, [1, 2]), (12, 1, 2, [3, 3]), (13, 3, 4, [4, 5, 1, 3])]), lat_offset=12345),
        block(STRINGS, way_group((7, [5, 9], [3, 5]))),
        block(other, dense([(14, 9, 9, [4, 6])]), granularity=7),
    )
    together = sign_nodes(path)
    monkeypatch.setattr(osm_pbf, "_BYTES_AT_ONCE", 1)
    alone = sign_nodes(path)
    assert all_of(together).tolist() == all_of(alone).tolist()
    assert all_of(together)["node_id"].tolist() == [5, -3, 2, 11, 13, 14]
    assert together.tagsets == alone.tagsets
    assert together.tagsets[-1] == {"traffic_sign": ""}


def test_a_key_that_stands_twice_in_its_table_is_read_by_either_number(tmp_path):
    strings = [b"", b"highway", b"stop", b"highway"]
    path = pbf(tmp_path / "a.pbf", block(strings, dense([(1, 0, 0, [1, 2]), (2, 0, 0, [3, 2]), (3, 0, 0, [2, 3])])))
    assert all_of(sign_nodes(path))["node_id"].tolist() == [1, 2]


def plain_nodes(*nodes):
    return b"".join(
        field(
            1,
            packed(1 << 3) + zigzag(n) + field(2, packed(1)) + field(3, packed(2))
            + packed(8 << 3) + zigzag(lat) + packed(9 << 3) + zigzag(lon),
        )
        for n, lon, lat in nodes
    )  # fmt: skip


def test_nodes_that_are_not_dense_and_history_go_through_libosmium(tmp_path):
    path = pbf(tmp_path / "a.osm.pbf", block(STRINGS, plain_nodes((5, 100_000_000, 500_000_000))))
    with pytest.raises(UnusualPbfError):
        sign_nodes(path)
    assert read_signs(path).table["sign_id"].to_pylist() == ["n5-0"]
    later = pbf(
        tmp_path / "b.osm.pbf", block(STRINGS, SIGN), block(STRINGS, plain_nodes((6, 100_000_000, 500_000_000)))
    )
    assert read_signs(later).table["sign_id"].to_pylist() == ["n-3-0", "n5-0", "n6-0"]
    history = (b"OsmSchema-V0.6", b"DenseNodes", b"HistoricalInformation")
    old = pbf(tmp_path / "c.osm.pbf", block(STRINGS, SIGN), features=history)
    assert read_signs(old).table.num_rows == 2


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (blob(b"OSMData", b"\x0a\x05ab"), "beyond its end"),
        (blob(b"OSMData", block(STRINGS, field(2, field(1, b"\x80")))), "does not end|no nodes"),
        (blob(b"OSMData", block(STRINGS, dense([(1, 1, 1, [1, 99])]))), "index|out of"),
        (blob(b"OSMData", block(STRINGS, SIGN))[:-3], "truncated"),
        (b"\x7f\xff\xff\xff" + b"\x00" * 20, "no block begins"),
        (blob(b"OSMData", b"")[:4], "truncated"),
    ],
)
def test_damage_is_named_with_its_place(tmp_path, content, message):
    path = pbf(tmp_path / "a.osm.pbf")
    path.write_bytes(path.read_bytes() + content)
    with pytest.raises(InputError, match=message) as caught:
        read_signs(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("how", ["lzma", "lz4", "zstd"])
def test_a_packed_block_that_lies_or_is_damaged_is_refused(tmp_path, how):
    number, pack = PACKINGS[how]
    whole = pack(block(STRINGS, SIGN))
    for content, size in ((whole, 3), (whole, 1 << 20), (whole[: len(whole) // 2], 300), (b"nonsense" * 4, 300)):
        body = packed(2 << 3) + packed(size) + field(number, content)
        header = field(1, b"OSMData") + packed(3 << 3) + packed(len(body))
        path = pbf(tmp_path / "a.osm.pbf")
        path.write_bytes(path.read_bytes() + len(header).to_bytes(4, "big") + header + body)
        with pytest.raises(InputError, match="damaged, or not an OpenStreetMap file"):
            read_signs(path)


def test_an_obsolete_packing_is_refused(tmp_path):
    with pytest.raises(InputError, match="unknown compression"):
        read_signs(pbf(tmp_path / "a.osm.pbf", block(STRINGS, SIGN), how="bzip2"))


def test_a_block_that_would_fill_the_memory_is_refused(tmp_path):
    bomb = packed(2 << 3) + packed(1 << 40) + field(3, zlib.compress(b"\0" * 1_000_000))
    lie = packed(2 << 3) + packed(100) + field(3, zlib.compress(b"\0" * 1_000_000))
    for body, message in ((bomb, "would unpack to 1099511627776 bytes"), (lie, "not the one it states")):
        header = field(1, b"OSMData") + packed(3 << 3) + packed(len(body))
        path = pbf(tmp_path / "a.osm.pbf")
        path.write_bytes(path.read_bytes() + len(header).to_bytes(4, "big") + header + body)
        with pytest.raises(InputError, match=message):
            read_signs(path)


@pytest.mark.parametrize("seed", range(25))
def test_any_damage_inside_a_block_is_told_or_survived(tmp_path, seed):
    draw = random.Random(seed)  # noqa: S311 - not a secret
    content = bytearray(block(STRINGS, SIGN, way_group((7, [5, 9], [3, 5]))))
    for _ in range(draw.randint(1, 4)):
        content[draw.randrange(len(content))] = draw.randrange(256)
    path = pbf(tmp_path / "a.osm.pbf", bytes(content))
    try:
        assert read_signs(path).table.num_rows >= 0
        assert read_lanes(path).table.num_rows >= 0
    except InputError as error:
        assert str(path) in str(error)  # noqa: PT017 - either outcome is right


@pytest.fixture(scope="module")
def real(shared_data, tmp_path_factory):
    """Real files as PBF: as they come, and rewritten by libosmium."""
    folder = tmp_path_factory.mktemp("real")
    paths = [shared_data / "osm" / "Helsinki.osm.pbf"]
    for name in ("north-bayreuth.osm.gz", "osm2streets_neukolln_input.osm", "bautzen.osm"):
        paths.append(folder / f"{name}.osm.pbf")
        with osmium.SimpleWriter(paths[-1]) as writer:
            osmium.apply(shared_data / "osm" / name, writer)
    return paths


def test_sign_nodes_are_those_that_osmium_finds(real):
    for path in real:
        expected = {}
        for node in osmium.FileProcessor(path, NODE):
            tags = dict(node.tags)
            if tags.get("highway") in POINT_HIGHWAYS or any(map(is_sign_key, tags)):
                expected[node.id] = (
                    node.location.x,
                    node.location.y,
                    {k: v for k, v in tags.items() if is_sign_key(k)},
                )
        nodes = sign_nodes(path)
        assert {
            n: (x, y, {k: v for k, v in nodes.tagsets[s].items() if is_sign_key(k)})
            for n, x, y, s in all_of(nodes).tolist()
        } == expected


def test_roads_are_those_that_osmium_finds(real):
    for path in real:
        place = {n.id: (n.location.lon, n.location.lat) for n in osmium.FileProcessor(path, NODE)}
        n_missing, expected = 0, []
        for way in osmium.FileProcessor(path, WAY):
            if not is_drivable(dict(way.tags)):
                continue
            run: list[int] = []
            for ref in [*(node.ref for node in way.nodes), None]:
                if ref in place:
                    run.append(ref)
                    continue
                n_missing += ref is not None
                expected += [(way.id, [place[r] for r in run])] if len(run) > 1 else []
                run = []
        roads = read_roads(path)
        found = [
            (int(way), list(zip(roads.lon[a:b].tolist(), roads.lat[a:b].tolist(), strict=True)))
            for way, a, b in zip(roads.way_id, roads.start, roads.start[1:], strict=False)
        ]
        assert found == expected
        assert roads.n_missing_nodes == n_missing


def test_many_blocks_stay_in_order_and_share_their_tags(tmp_path):
    path = tmp_path / "many.osm.pbf"
    with osmium.SimpleWriter(path) as writer:
        for n in range(1, 40_001):
            writer.add_node(Node(id=n, location=(n * 1e-4, 1.0), tags={"traffic_sign": "DE:206"} if n % 3 else {}))
        writer.add_way(Way(id=1, nodes=[1, 40_000], tags={"highway": "primary"}))
    nodes = sign_nodes(path)
    assert all_of(nodes)["node_id"].tolist() == [n for n in range(1, 40_001) if n % 3]
    assert nodes.tagsets == [{"traffic_sign": "DE:206"}]
    layer = read_signs(path, roads=False)
    ids = [row for piece in layer.pieces() for row in piece["sign_id"].to_pylist()]
    assert len(list(layer.pieces())) > 1
    assert ids == sorted(ids)
    assert len(ids) == 26_667
    assert sum(map(len, read_blocks(path, lambda blocks: blocks))) > 5
    assert read_roads(path).lon.tolist() == [1e-4, 4.0]
