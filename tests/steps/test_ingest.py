from __future__ import annotations

import json

import pytest

from geofleet.errors import ConfigError, InputError
from geofleet.formats import layers
from geofleet.steps.ingest import ingest_drive, ingest_lanes, ingest_signs, recognise
from geofleet.tables.manifest import manifest_path
from geofleet.tables.schemas import DRIVES, LANES, SIGNS
from geofleet.tables.store import read_table


@pytest.fixture(scope="module")
def raw(repo):
    return repo / "data" / "raw"


def test_signs_are_written_with_counts_and_a_manifest(raw, tmp_path):
    calls = []
    out = tmp_path / "signs" / "signs.parquet"
    result = ingest_signs([raw / "helsinki.osm.pbf"], out, progress=lambda done, total: calls.append((done, total)))
    assert read_table(SIGNS, out).num_rows == result.n_rows == 3489
    assert result.by_kind == {"main": 2163, "plate": 1169, "light": 135, "other": 22}
    assert sum(result.skipped.values()) == 19
    assert calls == [(0, 1), (1, 1)]
    assert json.loads(manifest_path(out).read_text())["counts"]["rows"] == 3489
    assert "2163 main" in "\n".join(result.summary())


def test_the_same_input_gives_the_same_bytes(raw, tmp_path):
    for name in ("a", "b"):
        ingest_signs([raw / "helsinki.osm.pbf"], tmp_path / name / "signs.parquet")
    for file in ("signs.parquet", "signs_manifest.json"):
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()


def test_the_same_map_twice_counts_once(raw, tmp_path):
    copy = tmp_path / "copy.osm.pbf"
    copy.write_bytes((raw / "helsinki.osm.pbf").read_bytes())
    result = ingest_signs([raw / "helsinki.osm.pbf", copy], tmp_path / "signs.parquet", roads=False)
    assert result.n_rows == 3489
    assert result.skipped["rows whose sign_id came before"] == 3489


def test_lanes_and_drives(raw, tmp_path):
    lanes = ingest_lanes([raw / "helsinki.osm.pbf"], tmp_path / "lanes.parquet")
    assert read_table(LANES, tmp_path / "lanes.parquet").num_rows == lanes.n_rows > 700
    assert lanes.by_kind["residential"] == 231
    both = [raw / "helsinki_derived.pos", raw / "helsinki_derived_b.pos"]
    drives = ingest_drive(both, tmp_path / "drives.parquet")
    table = read_table(DRIVES, tmp_path / "drives.parquet")
    assert set(table["drive_id"].to_pylist()) == {"helsinki_derived", "helsinki_derived_b"}
    assert drives.by_kind == {"derived": table.num_rows}


def test_formats_are_told_by_content(raw, tmp_path):
    odd = tmp_path / "drive.osm"
    odd.write_bytes((raw / "helsinki_derived.pos").read_bytes())
    assert recognise(odd) == "rtklib"
    assert layers.recognise(raw / "helsinki.osm.pbf") == "osm"
    assert recognise(raw / "NOTICE.md") == ""


def test_what_cannot_be_read_leaves_nothing_behind(raw, tmp_path):
    good, odd = raw / "helsinki.osm.pbf", raw / "NOTICE.md"
    out = tmp_path / "out" / "table.parquet"
    with pytest.raises(InputError, match=r"NOTICE.md: the first line names no columns"):
        ingest_signs([good, odd], out)
    with pytest.raises(InputError, match=r"not in a format that is read here.*RTKLIB"):
        ingest_drive([good], out)
    with pytest.raises(ConfigError, match="unknown format 'shape'"):
        ingest_signs([good], out, file_format="shape")
    with pytest.raises(InputError, match="no input"):
        ingest_lanes([], out)
    with pytest.raises(InputError, match="no such file"):
        ingest_lanes([tmp_path / "none"], out)
    cut = tmp_path / "cut.osm.pbf"
    cut.write_bytes(good.read_bytes()[:20_000])
    with pytest.raises(InputError, match=r"cut.osm.pbf: damaged"):
        ingest_signs([good, cut], out)
    assert not out.parent.exists()


def test_files_that_use_the_same_ids_lose_nothing(shared_data, tmp_path):
    drawn = shared_data / "opendrive"
    both = [
        drawn / "a9_nord_excerpt_bssd.xodr",
        drawn / "ingolstadt_cityhall.xodr",
        drawn / "ingolstadt_cityhall_offset.xodr",
    ]
    result = ingest_signs(both, tmp_path / "signs.parquet")
    assert result.n_rows == 38 + 417 + 417
    table = read_table(SIGNS, tmp_path / "signs.parquet")
    parents = set(filter(None, table["parent_id"].to_pylist()))
    assert parents <= set(table["sign_id"].to_pylist())


def test_one_object_in_two_extracts_is_one_row(raw, tmp_path):
    once = ingest_signs([raw / "helsinki.osm.pbf"], tmp_path / "once.parquet")
    copy = tmp_path / "copy.osm.pbf"
    copy.write_bytes((raw / "helsinki.osm.pbf").read_bytes())
    assert ingest_signs([raw / "helsinki.osm.pbf", copy], tmp_path / "twice.parquet").n_rows == once.n_rows


def test_formats_with_columns_of_their_own_go_together(raw, shared_data, tmp_path):
    drawn = shared_data / "opendrive" / "a9_nord_excerpt_bssd.xodr"
    result = ingest_signs([raw / "helsinki.osm.pbf", drawn], tmp_path / "signs.parquet")
    assert result.n_rows == 3489 + 38
