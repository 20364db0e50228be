from __future__ import annotations

import geopandas
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import shapely

from geofleet.errors import InputError, TableError
from geofleet.tables.manifest import hash_path, manifest_path, write_manifest
from geofleet.tables.schemas import DETECTIONS, DRIVES, GEOMETRY, SCHEMAS, SCORES
from geofleet.tables.store import (
    atomic_path,
    build_table,
    from_geodataframe,
    lonlat,
    read_table,
    to_geodataframe,
    write_table,
)

LON, LAT = np.array([24.94, 24.95, 24.96]), np.array([60.16, 60.17, 60.18])


def drive(**changes):
    columns = {"drive_id": "d", "seq": [2, 0, 1], "heading_deg": [1.0, None, 3.0], "segment": 0, "source": "x"}
    return build_table(DRIVES, columns | changes, geometry=(LON, LAT))


def test_rows_come_sorted_by_key_and_scalars_are_repeated():
    table = drive()
    assert table["seq"].to_pylist() == [0, 1, 2]
    assert table["heading_deg"].to_pylist() == [None, 3.0, 1.0]
    assert table["drive_id"].to_pylist() == ["d"] * 3
    assert lonlat(table)[0].tolist() == [24.95, 24.96, 24.94]


def test_geopandas_reads_the_file_with_crs_and_bbox_filter(tmp_path):
    write_table(DRIVES, drive(), tmp_path / "drives.parquet")
    frame = geopandas.read_parquet(tmp_path / "drives.parquet")
    assert frame.crs == "OGC:CRS84"
    assert shapely.get_coordinates(frame.geometry).tolist() == [[24.95, 60.17], [24.96, 60.18], [24.94, 60.16]]
    assert len(geopandas.read_parquet(tmp_path / "drives.parquet", bbox=(24.955, 60, 25, 61))) == 1


def test_the_same_table_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        write_table(DRIVES, drive(), tmp_path / f"{name}.parquet")
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()


def test_round_trip_through_a_geodataframe():
    table = drive()
    frame = to_geodataframe(table).to_crs("EPSG:3857")
    again = from_geodataframe(DRIVES, frame)
    assert again.drop_columns([GEOMETRY, "bbox"]).equals(table.drop_columns([GEOMETRY, "bbox"]))
    np.testing.assert_allclose(lonlat(again), lonlat(table), atol=1e-12)


def test_a_geodataframe_without_crs_is_refused():
    with pytest.raises(InputError, match="has no CRS"):
        from_geodataframe(DRIVES, geopandas.GeoDataFrame({"seq": [1]}, geometry=shapely.points([[0, 0]])))


@pytest.mark.parametrize("schema", SCHEMAS.values(), ids=lambda s: s.name)
def test_an_empty_table_of_every_schema_is_written_and_read(schema, tmp_path):
    empty = schema.arrow(()).empty_table()
    write_table(schema, empty, tmp_path / "t.parquet")
    assert read_table(schema, tmp_path / "t.parquet").schema.equals(empty.schema)
    if schema.geometry:
        assert geopandas.read_parquet(tmp_path / "t.parquet").empty


@pytest.mark.parametrize("schema", SCHEMAS.values(), ids=lambda s: s.name)
def test_every_column_is_described_and_the_key_exists(schema):
    assert all(column.description for column in schema.all_columns)
    assert set(schema.key) <= {column.name for column in schema.columns}


def test_missing_geometries_only_where_the_schema_allows_them(tmp_path):
    columns = {"method": "m", "n_vehicles": 1, "concept": "all", "gate_m": 2.0, "match_on": "class", "tp": 1}
    columns |= {"fp": 0, "fn": 0, "sum_sq_error_m2": 0.0, "gospa": 0.0, "tile": ["all", "12"]}
    table = build_table(SCORES, columns, geometry=[None, shapely.box(0, 0, 1, 1)])
    write_table(SCORES, table, tmp_path / "scores.parquet")
    assert to_geodataframe(read_table(SCORES, tmp_path / "scores.parquet")).geometry.isna().tolist() == [False, True]
    with pytest.raises(TableError, match="3 of 3 geometries are missing"):
        build_table(DRIVES, {"drive_id": "d", "seq": [0, 1, 2], "segment": 0, "source": "x"})


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seq": ["a", "b", "c"]}, "column seq is not int64"),
        ({"seq": [1, 2]}, "column seq has 2 rows, not 3"),
        ({"seq": [1, None, 2]}, "column seq has 1 nulls of 3"),
        ({"colour": 1}, "unknown columns colour"),
        ({"segment": None}, "missing column segment"),
    ],
)
def test_a_wrong_column_is_named(changes, message):
    with pytest.raises(TableError, match=message):
        drive(**changes)


def test_reading_names_missing_and_mistyped_columns(tmp_path):
    table = drive()
    pq.write_table(table.drop_columns(["seq"]), tmp_path / "missing.parquet")
    pq.write_table(table.set_column(1, "seq", pa.array(["0", "1", "2"])), tmp_path / "mistyped.parquet")
    pq.write_table(table.set_column(0, "drive_id", pa.array(["d", None, "d"])), tmp_path / "null.parquet")
    with pytest.raises(TableError, match=r"missing\.parquet: table drives: missing column seq\. `geofleet schema"):
        read_table(DRIVES, tmp_path / "missing.parquet")
    with pytest.raises(TableError, match=r"mistyped\.parquet: table drives: column seq is string, not int64"):
        read_table(DRIVES, tmp_path / "mistyped.parquet")
    with pytest.raises(TableError, match=r"null\.parquet: table drives: column drive_id has 1 nulls of 3"):
        read_table(DRIVES, tmp_path / "null.parquet")


def test_reading_what_is_not_parquet(tmp_path):
    (tmp_path / "empty.parquet").touch()
    (tmp_path / "text.parquet").write_text("lon,lat\n1,2\n")
    (tmp_path / "folder").mkdir()
    for name, message in (
        ("absent.parquet", "no such file"),
        ("empty.parquet", "not a Parquet file"),
        ("text.parquet", r"not a Parquet file\. A drives table is expected"),
        ("folder", "holds no Parquet file"),
    ):
        with pytest.raises(InputError, match=message):
            read_table(DRIVES, tmp_path / name)


def test_a_truncated_file_is_refused(tmp_path):
    path = tmp_path / "drives.parquet"
    write_table(DRIVES, drive(), path)
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError):
        read_table(DRIVES, path)


def test_partitions_come_back_as_columns(tmp_path):
    detections = build_table(
        DETECTIONS,
        {"run_id": "r", "vehicle_id": "v1", "pass_id": "v1-p0", "track_id": [0, 1, 2], "sign_class": "stop"},
        geometry=(LON, LAT),
    )
    folder = tmp_path / "detections" / "run_id=r" / "vehicle_id=v1"
    write_table(DETECTIONS, detections.drop_columns(["run_id", "vehicle_id"]), folder / "part-0.parquet")
    assert read_table(DETECTIONS, tmp_path / "detections").equals(detections)


def test_a_failure_leaves_what_was_there(tmp_path):
    target = tmp_path / "out"
    target.mkdir()
    (target / "old").write_text("old")
    with pytest.raises(FileNotFoundError), atomic_path(target) as draft:
        (draft / "no such folder" / "new").write_text("new")
    assert [p.name for p in tmp_path.rglob("*")] == ["out", "old"]
    with atomic_path(target) as draft:
        draft.mkdir()
        (draft / "new").write_text("new")
    assert sorted(p.name for p in tmp_path.rglob("*")) == ["new", "out"]


def test_a_manifest_hashes_what_was_read_and_written(tmp_path):
    source, out = tmp_path / "in.txt", tmp_path / "out"
    source.write_text("a")
    out.mkdir()
    (out / "x").write_text("b")
    first = write_manifest(out, step="test", inputs=[source]).read_bytes()
    assert write_manifest(out, step="test", inputs=[source]).read_bytes() == first  # a manifest is no output
    assert hash_path(source).encode() in first
    (out / "x").write_text("c")
    assert write_manifest(out, step="test", inputs=[source]).read_bytes() != first
    assert manifest_path(tmp_path / "signs.parquet").name == "signs_manifest.json"


def test_a_table_keeps_its_values_when_the_arrays_it_was_made_of_change():
    seq, lon = np.arange(3), LON.copy()
    table = build_table(DRIVES, {"drive_id": "d", "seq": seq, "segment": 0, "source": "x"}, geometry=(lon, LAT))
    seq[:] = 9
    lon[:] = 0.0
    assert table["seq"].to_pylist() == [0, 1, 2]
    assert lonlat(table)[0].tolist() == LON.tolist()
