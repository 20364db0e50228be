"""A plain table read by its dictionaries says what the statements say, and any other table is left to them."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from geofleet.config import load_config
from geofleet.steps.aggregate import aggregate
from geofleet.tables import plain, staging
from geofleet.tables.binding import sql_kind
from geofleet.tables.database import connect, materialise, run
from geofleet.tables.schemas import DETECTIONS, SCHEMAS
from geofleet.tables.store import build_table, geo_metadata

FINE_ZOOM = 18


def detections(n=4000, *, seed=0, **given):
    """Return detections of two runs that share the names of vehicles; what may be missing is, at times."""
    rng = np.random.default_rng(seed)
    number = np.sort(rng.integers(0, 40, n))
    missing = lambda values: pa.array(values, mask=rng.random(n) < 0.1)  # noqa: E731
    t_first = rng.integers(0, 10**15, n)
    columns = {
        "run_id": np.array(["ä", "b"])[number % 2],
        "vehicle_id": np.array([f"v{k}" for k in range(10)])[number % 10],
        "pass_id": np.array([f"p{k}" for k in range(20)])[number // 2],
        "track_id": np.arange(n) + 1_000_000,
        "sign_class": np.array(["stop", "yield", "speed_limit:50"])[rng.integers(0, 3, n)],
        "n_frames": missing(rng.integers(0, 9, n)),
        "sigma_e_m": missing(np.where(rng.random(n) < 0.1, np.inf, rng.uniform(0, 2, n))),
        "sigma_n_m": missing(rng.uniform(0, 2, n)),
        "class_confidence": missing(rng.uniform(0, 1, n)),
        "t_first": missing(t_first).cast(pa.timestamp("us", tz="UTC")),
        "t_last": missing(t_first + 10**6).cast(pa.timestamp("us", tz="UTC")),
    } | given
    lon, lat = 179.999 + rng.uniform(0, 0.001, n), 60 + rng.uniform(0, 0.01, n)
    lon[:4] = 180.0
    return build_table(DETECTIONS, columns, geometry=(lon, lat))


def save(table, path, **options):
    pq.write_table(table.replace_schema_metadata(geo_metadata(DETECTIONS, table)), path, **options)
    return path


def rows(table):
    """Return rows as texts, in which NaN equals NaN, sorted."""
    return sorted(map(repr, zip(*(table[name].to_pylist() for name in sorted(table.column_names)), strict=True)))


@pytest.mark.parametrize("options", [{}, {"row_group_size": 700}, {"use_dictionary": False, "row_group_size": 999}])
def test_it_says_what_the_statements_say(tmp_path, options):
    path = save(detections(), tmp_path / "d.parquet", **options)
    found = plain.survey(path, FINE_ZOOM)
    connection = connect(spatial=False)
    assert staging.judge_detections(connection, path, n_vehicles=3) is None  # the statements alone
    assert rows(found.reporting) == rows(connection.table("reporting").to_arrow_table())
    connection.table("usable").create_view("chosen")
    counts = run(connection, "tiles/counts", {"fine_zoom": FINE_ZOOM}).to_arrow_table()
    assert rows(found.counts) == rows(counts)
    materialise(connection, "aggregate/classes")
    assert list(found.classes) == connection.table("classes").to_arrow_table()["sign_class"].to_pylist()
    coded = run(connection, "aggregate/coded").to_arrow_table()
    assert 0 < coded.num_rows < 4000
    numbered = connection.sql("SELECT run_id, vehicle_id, pass_id, pass_code FROM passes").fetchall()
    passes = {tuple(key): code for *key, code in numbered}
    blocks = list(map(plain.Coder(found, passes), plain.coded_columns(found)))
    whole = pa.table({name: np.concatenate([block[name] for block in blocks]) for name in blocks[0]})
    assert set(whole.column_names) == set(coded.column_names)
    assert rows(whole) == rows(coded)


@pytest.mark.parametrize("n_vehicles", [None, 4])
def test_it_gives_the_same_layer(tmp_path, monkeypatch, n_vehicles):
    path = save(detections(seed=1), tmp_path / "d.parquet", row_group_size=1000)
    config = load_config(overrides={"min_support_share": 0.0})
    layers = []
    for survey in (plain.survey, lambda *_: None):
        monkeypatch.setattr(staging, "survey", survey)
        result = aggregate(path, tmp_path / "fused.parquet", config=config, n_vehicles=n_vehicles)
        layers.append((result.out.read_bytes(), result))
    assert layers[0] == layers[1]
    assert layers[0][1].n_signs > 80


def replaced(table, name, values):
    return table.set_column(table.schema.get_field_index(name), name, values)


@pytest.mark.parametrize(
    "spoil",
    [
        lambda t: pa.concat_tables([t, t.slice(5, 1)]),  # a key repeated
        lambda t: replaced(t, "vehicle_id", pa.array(["v0", "v1"] * (t.num_rows // 2))),  # a pass of two vehicles
        lambda t: replaced(t, "sign_class", pa.array(["  "] + ["stop"] * (t.num_rows - 1))),
        lambda t: replaced(t, "sign_class", pa.array([None] + ["stop"] * (t.num_rows - 1))),
        lambda t: replaced(t, "run_id", pa.array([None] + ["b"] * (t.num_rows - 1))),
        lambda t: replaced(t, "track_id", pa.array(np.arange(t.num_rows) * 10**12)),  # ids far apart
        lambda t: replaced(t, "track_id", t["track_id"].cast(pa.int32())),
        lambda t: replaced(t, "sigma_e_m", t["sigma_e_m"].cast(pa.float32())),
        lambda t: t.slice(0, 0),
    ],
)
def test_any_other_table_is_left_to_the_statements(tmp_path, spoil):
    assert plain.survey(save(spoil(detections()), tmp_path / "d.parquet"), FINE_ZOOM) is None


@pytest.mark.parametrize(("lon", "lat"), [(np.nan, 60.0), (np.inf, 60.0), (181.0, 60.0), (10.0, -85.06), (None, 60.0)])
def test_a_place_that_cannot_be_used_is_left_to_the_statements(tmp_path, lon, lat):
    table = detections()
    box = table["bbox"].to_pylist()
    box[7] = {"xmin": lon, "ymin": lat, "xmax": lon, "ymax": lat}
    kind = pa.struct([pa.field(side, pa.float64()) for side in ("xmin", "ymin", "xmax", "ymax")])
    path = save(replaced(table, "bbox", pa.array(box, kind)), tmp_path / "d.parquet")
    assert plain.survey(path, FINE_ZOOM) is None


def test_a_file_without_statistics_is_left_to_the_statements(tmp_path):
    assert plain.survey(save(detections(), tmp_path / "d.parquet", write_statistics=False), FINE_ZOOM) is None


def test_types_of_arrow_are_those_that_duckdb_gives_them():
    connection = connect(spatial=False)
    for schema in SCHEMAS.values():
        arrow = schema.arrow()
        kinds = connection.from_arrow(arrow.empty_table()).types
        assert [sql_kind(field.type) for field in arrow] == [str(kind) for kind in kinds], schema.name
