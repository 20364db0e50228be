"""Statements as an analyst runs them: by `geofleet sql`, and as a script in a DuckDB that knows nothing of geofleet."""

from __future__ import annotations

import duckdb
import numpy as np
import pytest
import shapely

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.tiling import halo_m
from geofleet.config import load_config
from geofleet.errors import QueryError
from geofleet.formats import results
from geofleet.steps.aggregate import aggregate, tiles
from geofleet.tables import biases, staging
from geofleet.tables.database import load_sql, sql_folder
from geofleet.tables.hive import HiveWriter
from geofleet.tables.schemas import DETECTIONS, PASSES
from geofleet.tables.store import build_table, write_table
from geofleet.workflows.query import query, show_sql

FOLDERS = ("aggregate", "tiles", "checks")
NAMES = [f"{folder}/{path.stem}" for folder in FOLDERS for path in sorted((sql_folder() / folder).glob("*.sql"))]
RUN_ID, N = "o'hara", 200
FRAME = EnuFrame(24.9450453, 60.1677108)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A fleet with rows that cannot be used: two without a class, three that repeat a key."""
    folder, rng = tmp_path_factory.mktemp("data"), np.random.default_rng(0)
    vehicles = [f"{k % 8:03}" for k in range(N)]
    columns = {"run_id": RUN_ID, "vehicle_id": vehicles, "pass_id": vehicles, "n_frames": 5}
    track = np.arange(N)
    track[-3:] -= 8  # eight rows before is the same pass
    classes = np.where(np.arange(N) < 2, " ", np.array(["stop", "yield"])[rng.integers(0, 2, N)])
    lonlat = FRAME.to_lonlat(rng.uniform(-150, 150, (N, 2)))
    writer = HiveWriter(DETECTIONS, folder / "detections", bucketed=False)
    (folder / "detections").mkdir()
    writer.write(build_table(DETECTIONS, columns | {"track_id": track, "sign_class": classes}, geometry=lonlat))
    writer.close()
    fleet = sorted(set(vehicles))
    sensor = {"sensor_id": "s", "sensor_kind": "camera", "drive_id": "d", "range_m": 50.0, "fov_deg": 90.0}
    driven = {"run_id": RUN_ID, "pass_id": fleet, "vehicle_id": fleet, "frame_spacing_m": 2.0} | sensor
    lines = [shapely.LineString(np.column_stack(FRAME.to_lonlat(np.array([[0.0, 0], [50, 0]]))))] * len(fleet)
    write_table(PASSES, build_table(PASSES, driven, geometry=lines), folder / "passes.parquet")
    return folder


def test_bad_rows_and_members_are_those_of_the_step(data, tmp_path, monkeypatch):
    _, invalid = query("sql/checks/detections_invalid.sql", data)
    _, repeated = query("sql/checks/detections_duplicate.sql", data)
    monkeypatch.setattr(tiles, "BATCH_ROWS", 40)
    result = aggregate(data / "detections", tmp_path / "f.parquet", config=load_config())
    assert {row[0]: result.skipped[row[0]] for row in (*invalid, *repeated)} == result.skipped
    assert (len(invalid), len(repeated)) == (2, 3)
    names, members = query("sql/tiles/members.sql", data, {"batch_rows": "40"})
    assert sum(row[names.index("is_owned")] for row in members) == result.n_used == N - 5
    assert {row[names.index("tile_code")] for row in members} == set(range(result.n_tiles))
    assert result.n_tiles > 5


@pytest.mark.parametrize("name", NAMES)
def test_a_shown_script_says_the_same_in_a_bare_duckdb(data, name):
    params = {"run_id": RUN_ID} if "run_id" in load_sql(name).declared else {}
    wanted = {"batch_rows", "zoom", "west"} & set(load_sql(name).declared)
    params |= {key: {"batch_rows": "30", "zoom": "16", "west": "24"}[key] for key in wanted}
    names, rows = query(f"sql/{name}.sql", data, params)
    assert names == tuple(column for column, _ in load_sql(name).writes)
    connection = duckdb.connect()
    connection.execute("SET TimeZone = 'UTC'")
    found = connection.execute(show_sql(f"sql/{name}.sql", data, params)).fetchall()
    assert sorted(map(repr, found)) == sorted(map(repr, rows))
    assert rows or name == "aggregate/unlisted"


def test_limits_are_parameters_of_the_checks(data):
    lon, lat = FRAME.to_lonlat(np.array([[0.0, 0.0]]))
    box = {"west": "0", "south": "0", "east": str(lon[0]), "north": "80"}
    _, rows = query("sql/checks/detections_invalid.sql", data, box)
    reasons = {row[0] for row in rows}
    assert reasons == {"class missing", "outside the area"}
    assert all(row[6] > lon[0] for row in rows if row[0] == "outside the area")
    _, rows = query("sql/checks/detections_invalid.sql", data, {"concepts": "stop"})
    assert {(row[0], row[5]) for row in rows} == {("class missing", " "), ("class unknown", "yield")}
    assert lat[0] > 0


@pytest.mark.parametrize(
    ("name", "params", "message"),
    [
        ("tiles/assign", {"zoom": "x"}, "'x' is not integer"),
        ("tiles/assign", {"zoom": "1; DROP TABLE x"}, "is not integer"),
        ("tiles/readers", {"halo_m": "wide"}, "'wide' is not double"),
        ("aggregate/reporting", {"is_narrow": "1"}, "'1' is not boolean"),
        ("tiles/assign", {"tile": "x"}, "no parameter tile"),
        ("aggregate/tracks_of_run", {}, "run_id is missing"),
    ],
)
def test_a_parameter_that_cannot_be_meant_is_refused(data, name, params, message):
    with pytest.raises(QueryError, match=message):
        query(f"sql/{name}.sql", data, params)


def test_a_statement_takes_no_parameters(data):
    with pytest.raises(QueryError, match=r"only a \.sql file"):
        query("SELECT 1", data, {"zoom": "3"})


def test_defaults_are_those_of_the_command():
    config = load_config()
    defaults = {
        key: parameter.default
        for folder in (*FOLDERS, "evaluate")
        for path in (sql_folder() / folder).glob("*.sql")
        for key, parameter in load_sql(f"{folder}/{path.stem}").declared.items()
    }
    expected = {
        "zoom": max(tiles.COARSEST_ZOOM, config.aggregate.tile_zoom - tiles.COARSER_BY),
        "fine_zoom": staging.FINE_ZOOM,
        "batch_rows": tiles.BATCH_ROWS,
        "halo_m": halo_m(config.aggregate.eps_m),
        "gate_m": config.evaluate.gate_m,
        "min_length_m": results._SHORTEST_LINE_M,
        "range_bias_sigma_m": biases.RANGE_BIAS_SIGMA_M,
        "bearing_bias_sigma_deg": biases.BEARING_BIAS_SIGMA_DEG,
    }
    assert {key: float(defaults[key]) for key in expected} == pytest.approx(expected)
    assert [key for key, default in defaults.items() if default is None] == ["run_id"]
