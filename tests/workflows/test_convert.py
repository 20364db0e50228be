"""Layers in every format that is written: read again, they are what they were."""

from __future__ import annotations

import json
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pyarrow as pa
import pyogrio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from geofleet.config import load_config
from geofleet.errors import ConfigError, InputError
from geofleet.formats.layers import read_layer
from geofleet.steps.evaluate import evaluate
from geofleet.tables.schemas import LANES, SIGNS
from geofleet.tables.store import build_table, lonlat, read_table, write_table
from geofleet.taxonomy import load_taxonomy
from geofleet.workflows.anyfile import read_any
from geofleet.workflows.convert import convert

SUFFIXES = (".parquet", ".geojson", ".gpkg", ".fgb", ".osm", ".osc")
PBF = Path(__file__).parents[2] / "data" / "raw" / "helsinki.osm.pbf"

letters = st.characters(codec="utf-8", exclude_categories=["C", "Z"]) | st.just(" ")
text = st.text(letters, min_size=1, max_size=20) | st.sampled_from(["[50]", "{}", '"', "1e5", "null", "-0"])
degrees = st.floats(0, 360, exclude_max=True)
times = st.datetimes(datetime(1990, 1, 1), datetime(2100, 1, 1), timezones=st.just(UTC))  # noqa: DTZ001 (UTC is put on)
known = st.sampled_from([(c.name, c.kind, c.unit) for c in load_taxonomy().concepts.values()])
in_other_units = st.sampled_from([("speed_limit", "main", "mph"), ("height_limit", "main", "ft")])
classes = known | in_other_units | st.builds(lambda code: (f"raw:{code}", "main", ""), text)


@st.composite
def sign_tables(draw):
    n = draw(st.integers(1, 4))
    rows = [draw(st.tuples(classes, st.none() | st.integers(1, 200), text)) for _ in range(n)]
    values = [None if value is None or not c[2] else float(value) for c, value, _ in rows]
    named = [
        c[0] if v is None else f"{c[0]}:{v:g}{c[2] if c[2] in {'mph', 'ft'} else ''}"
        for (c, _, _), v in zip(rows, values, strict=True)
    ]
    each = {
        "parent_id": st.none() | text,
        "country": st.sampled_from([None, "DE", "FI"]),
        "facing_deg": st.none() | degrees,
        "height_m": st.none() | st.floats(-10, 10),
        "first_seen": st.none() | times,
        "n_passes": st.none() | st.integers(0, 2**40),
        "source_ref": st.sampled_from(["node/7", "node/8", "node/-3", "signal/7"]),
    }
    columns = {name: [draw(one) for _ in range(n)] for name, one in each.items()}
    types = {column.name: column.type for column in SIGNS.all_columns}
    columns = {name: pa.array(column, types[name]) for name, column in columns.items()} | {
        "sign_id": draw(st.lists(text, min_size=n, max_size=n, unique=True)),
        "kind": [c[1] for c, _, _ in rows],
        "concept": [c[0] for c, _, _ in rows],
        "value": pa.array(values, pa.float64()),
        "unit": [None if v is None else c[2] for (c, _, _), v in zip(rows, values, strict=True)],
        "sign_class": named,
        "raw_code": [code for _, _, code in rows],
        "source": "made.up",
    }
    lon = draw(st.lists(st.sampled_from([24.9, 1 / 3 + 20]) | st.floats(-179, 179), min_size=n, max_size=n))
    lat = draw(st.lists(st.sampled_from([60.1, 1 / 3 + 50]) | st.floats(-85, 85), min_size=n, max_size=n))
    return build_table(SIGNS, columns, (np.array(lon), np.array(lat)))


@pytest.mark.parametrize("suffix", SUFFIXES)
@settings(max_examples=15)
@given(table=sign_tables())
def test_signs_come_back_as_they_were(suffix, table):
    with TemporaryDirectory() as folder:
        source, out = Path(folder) / "in.parquet", Path(folder) / f"out{suffix}"
        write_table(SIGNS, table, source)
        assert convert(source, out).n_rows == table.num_rows
        assert sorted(path.name for path in Path(folder).iterdir()) == sorted([source.name, out.name])
        again = read_layer(out).table
    assert np.abs(np.array(lonlat(again)) - np.array(lonlat(table))).max() < 1e-12
    for name in table.column_names:
        if name in {"geometry", "bbox"}:
            continue
        if name == "n_passes" and suffix in {".osm", ".osc"} and table[name].null_count == table.num_rows:
            continue  # a column of nulls leaves nothing there to be known by
        assert again[name].to_pylist() == table[name].to_pylist(), name


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_surveyed_city_scores_perfectly_against_its_own_conversion(suffix, shared_data, tmp_path):
    reference = shared_data / "opendrive" / "ingolstadt_cityhall.xodr"
    out = tmp_path / f"city{suffix}"
    assert convert(reference, out).n_rows == 417
    (total,) = evaluate(out, reference, tmp_path / "scores", config=load_config("paper")).totals
    assert (total["tp"], total["fp"], total["fn"]) == (200, 0, 0)
    assert total["f1"] == 1.0
    assert total["gospa_m"] == 0.0


@pytest.mark.parametrize("suffix", [".osm", ".osc"])
def test_openstreetmap_keeps_its_nodes_and_plain_tags_say_every_class(suffix, tmp_path):
    out = tmp_path / f"out{suffix}"
    convert(PBF, out, roads=False)
    theirs = read_layer(PBF, roads=False).table
    plain = read_layer(out, file_format="osm", roads=False).table
    assert read_layer(out).table.equals(theirs)
    for name in ("sign_id", "kind", "sign_class", "raw_code", "source_ref", "facing_deg", "parent_id"):
        assert plain[name].to_pylist() == theirs[name].to_pylist(), name


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_lanes_are_written_in_every_format(suffix, shared_data, tmp_path):
    out = tmp_path / f"lanes{suffix}"
    source = shared_data / "osm" / "helsinki_signs_roads.osm.pbf"
    n_rows = convert(source, out, table="lanes").n_rows
    assert n_rows > 100
    if suffix in {".osm", ".osc", ".parquet"}:
        theirs, again = read_layer(source, LANES).table, read_layer(out, LANES).table
        for name in ("road_id", "kind", "speed_limit_kmh"):
            assert sorted(map(str, again[name].to_pylist())) == sorted(map(str, theirs[name].to_pylist()))
    else:
        assert pyogrio.read_info(out, layer="lanes")["features"] == n_rows


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_layer_without_signs_can_be_written(suffix, make_signs, tmp_path):
    write_table(SIGNS, make_signs([], []), tmp_path / "in.parquet")
    out = tmp_path / f"out{suffix}"
    assert convert(tmp_path / "in.parquet", out).n_rows == 0
    if suffix != ".geojson":  # which has no columns where it has no features
        assert read_layer(out).table.num_rows == 0
    else:
        assert json.loads(out.read_text())["features"] == []


@pytest.mark.parametrize("name", ["out.shp", "out", "out.kml"])
def test_an_unknown_suffix_lists_those_that_can_be_written(name, tmp_path):
    with pytest.raises(ConfigError, match=r"\.parquet, \.geojson, \.gpkg, \.fgb, \.osm, \.osc"):
        convert(PBF, tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_an_unknown_table_lists_those_that_can_be_converted(tmp_path):
    with pytest.raises(ConfigError, match="signs, lanes"):
        convert(PBF, tmp_path / "out.gpkg", table="drives")


@pytest.mark.parametrize("code", ["x" * 300, "bell \x07"])
def test_what_openstreetmap_cannot_hold_is_told_and_nothing_is_written(code, make_signs, tmp_path):
    write_table(SIGNS, make_signs([(0, 0)], ["stop"], raw_code=[code]), tmp_path / "in.parquet")
    with pytest.raises(InputError, match="geofleet:raw_code"):
        convert(tmp_path / "in.parquet", tmp_path / "out.osm")
    assert [path.name for path in tmp_path.iterdir()] == ["in.parquet"]


@pytest.mark.parametrize(
    "code", ["とまれ <&>\"'", "[50]", "{}", '{"a": 1}', "null", "1e5", "2024-05-01", "a;b|c,d", "-0"]
)
def test_a_layer_keeps_a_code_in_any_script_and_form(code, make_signs, tmp_path):
    write_table(SIGNS, make_signs([(0, 0)], ["stop"], raw_code=[code]), tmp_path / "in.parquet")
    for suffix in SUFFIXES:
        convert(tmp_path / "in.parquet", tmp_path / f"out{suffix}")
        assert read_layer(tmp_path / f"out{suffix}").table["raw_code"].to_pylist() == [code], suffix


@pytest.mark.parametrize("suffix", [".geojson", ".gpkg", ".fgb"])
def test_lanes_come_back_from_a_gis_format(repo, suffix, tmp_path):
    source = repo / "data" / "raw" / "helsinki.osm.pbf"
    before, after = (tmp_path / name for name in (f"lanes{suffix}", "lanes.parquet"))
    convert(source, before, table="lanes")
    assert convert(before, after, table="lanes").n_rows > 100
    assert read_table(LANES, after).equals(read_layer(source, LANES).table)
    assert read_any(before)[0] is LANES


def test_signs_are_no_lanes(repo, tmp_path):
    signs = tmp_path / "signs.geojson"
    convert(repo / "data" / "raw" / "helsinki.osm.pbf", signs)
    with pytest.raises(InputError, match="holds no lanes"):
        convert(signs, tmp_path / "lanes.parquet", table="lanes")
