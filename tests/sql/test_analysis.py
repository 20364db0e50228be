"""Every statement in `sql/analysis/` on a few rows whose answer is plain, and the scores in SQL against Python's."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from geofleet.tables.database import connect, load_sql, run, sql_folder
from geofleet.tables.schemas import MATCHES
from geofleet.tables.scoring import score_matches
from geofleet.tables.store import build_table

NAMES = sorted(p.stem for p in (sql_folder() / "analysis").glob("*.sql"))
M = 1 / 111_412  # degrees of latitude a metre at 60° north, to 0.1 %
LAT = 60.0


@pytest.fixture
def ask():
    """Make tables from VALUES and return the rows of a statement as dictionaries, only the columns named."""
    connection = connect()

    def call(name, columns, **tables):
        for table, (head, values) in tables.items():
            connection.execute(f"CREATE TABLE {table} AS SELECT * FROM (VALUES {values}) AS t ({head})")  # noqa: S608 (fixed text)
        found = run(connection, f"analysis/{name}").to_arrow_table()
        return [tuple(row[c] for c in columns.split()) for row in found.to_pylist()]

    yield call
    connection.close()


def at(north_m):
    """Return a bbox in SQL, so many metres north of one place."""
    lat = LAT + north_m * M
    return f"{{xmin: 25.0::DOUBLE, ymin: {lat!r}::DOUBLE, xmax: 25.0::DOUBLE, ymax: {lat!r}::DOUBLE}}"


OUTCOME = "run_id, method, n_vehicles, fused_id, ref_id, outcome, tile, distance_m, fused_class, ref_class, bbox"


def outcomes(*rows):
    """Return `matches` of one map: outcome, fused id and class, reference id and class, distance, metres north."""

    def cell(text):
        return "NULL::VARCHAR" if text is None else f"'{text}'"

    values = []
    for outcome, fused_id, fused_class, ref_id, ref_class, distance_m, north_m in rows:
        distance = "NULL::DOUBLE" if distance_m is None else f"{distance_m}::DOUBLE"
        values.append(
            f"('r', 'm', 5, {cell(fused_id)}, {cell(ref_id)}, '{outcome}', '1', {distance}, {cell(fused_class)}, "
            f"{cell(ref_class)}, {at(north_m)})"
        )
    return OUTCOME, ", ".join(values)


def test_worst_tiles(ask):
    scores = (
        "run_id, method, n_vehicles, tile, concept, gospa_m, f1, tp, fp, fn, rmse_m, null_reason",
        """('r', 'm', 5, 'all', 'all', 1.2::DOUBLE, 0.6::DOUBLE, 3, 2, 2, 0.5::DOUBLE, NULL),
           ('r', 'm', 5, '10', 'all', 0.4::DOUBLE, 1.0::DOUBLE, 2, 0, 0, 0.4::DOUBLE, NULL),
           ('r', 'm', 5, '10', 'stop', 0.4::DOUBLE, 1.0::DOUBLE, 2, 0, 0, 0.4::DOUBLE, NULL),
           ('r', 'm', 5, '11', 'all', 2.9::DOUBLE, 0.3::DOUBLE, 1, 2, 1, 0.9::DOUBLE, NULL),
           ('r', 'm', 5, '12', 'all', NULL, 0::DOUBLE, 0, 0, 1, NULL, 'the map is empty')""",
    )
    assert ask("worst_tiles", "tile gospa_m fn", scores=scores) == [("12", None, 1), ("11", 2.9, 1), ("10", 0.4, 0)]


def test_worst_classes(ask):
    matches = outcomes(
        ("TP", "a", "stop", "A", "stop", 3.0, 0),
        ("TP", "b", "stop", "B", "stop", 4.0, 50),
        ("TP", "c", "yield", "C", "yield", 1.0, 90),
        ("FN", None, None, "D", "yield", None, 120),
        ("FP", "e", "no_entry", None, None, None, 150),
    )
    assert ask("worst_classes", "sign_class f1 tp fp fn rmse_m", matches=matches) == [
        ("no_entry", 0.0, 0, 1, 0, None),
        ("yield", pytest.approx(2 / 3), 1, 0, 1, 1.0),
        ("stop", 1.0, 2, 0, 0, pytest.approx(12.5**0.5)),
    ]


def test_signs_never_seen(ask):
    reference = (
        "run_id, sign_id, sign_class, facing_deg, n_passes_in_view, bbox",
        f"('r', 'A', 'stop', 90.0, 3, {at(0)}), ('r', 'B', 'stop', 180.0, 0, {at(9)})",
    )
    assert ask("signs_never_seen", "sign_id facing_deg", reference=reference) == [("B", 180.0)]


def test_missed_though_seen(ask):
    matches = outcomes(
        ("FN", None, None, "unseen", "stop", None, 0),
        ("FN", None, None, "blind", "stop", None, 100),
        ("FN", None, None, "shifted", "stop", None, 200),
        ("FP", "f", "stop", None, None, None, 203),
        ("FN", None, None, "retyped", "stop", None, 300),
        ("FP", "g", "yield", None, None, None, 301),
        ("FN", None, None, "lost", "stop", None, 400),
        ("FP", "h", "stop", None, None, None, 406),
        ("TP", "i", "stop", "found", "stop", 0.0, 500),
    )
    ids = ("unseen", "blind", "shifted", "retyped", "lost", "found")
    reference = (
        "run_id, sign_id, n_passes_in_view",
        ", ".join(f"('r', '{i}', {0 if i == 'unseen' else 7})" for i in ids),
    )
    truth = (
        "run_id, ref_sign_id, semantic_correct",
        """('r', 'shifted', true), ('r', 'shifted', false), ('r', 'retyped', false), ('r', 'lost', true),
           ('r', NULL, true)""",
    )
    found = ask(
        "missed_though_seen",
        "ref_id n_detections n_right_class cause",
        matches=matches,
        reference=reference,
        truth=truth,
    )
    assert found == [
        ("blind", 0, 0, "never detected"),
        ("lost", 1, 1, "lost in the aggregation"),
        ("retyped", 1, 0, "mapped with another class"),
        ("shifted", 2, 1, "mapped too far off"),
    ]


def test_false_signs(ask):
    matches = outcomes(
        ("FN", None, None, "A", "stop", None, 0),
        ("FP", "off", "stop", None, None, None, 3),
        ("FN", None, None, "B", "yield", None, 100),
        ("FP", "retyped", "stop", None, None, None, 101),
        ("TP", "c", "stop", "C", "stop", 0.0, 200),
        ("FP", "copy", "stop", None, None, None, 204),
        ("TP", "d", "yield", "D", "yield", 0.0, 300),
        ("FP", "beside", "stop", None, None, None, 305),
        ("FP", "ghost", "stop", None, None, None, 400),
    )
    found = ask("false_signs", "fused_id ref_id distance_m suggests", matches=matches)
    assert sorted(found, key=lambda row: row[0]) == [
        ("beside", "D", pytest.approx(5, rel=2e-3), "beside a sign that is found"),
        ("copy", "C", pytest.approx(4, rel=2e-3), "second copy of a found sign"),
        ("ghost", None, None, "no sign near by"),
        ("off", "A", pytest.approx(3, rel=2e-3), "the sign, too far off"),
        ("retyped", "B", pytest.approx(1, rel=2e-3), "the sign, with another class"),
    ]


def test_of_several_signs_on_a_pole_the_one_of_its_class_explains_a_false_sign(ask):
    matches = outcomes(
        ("TP", "a", "yield", "A", "yield", 0.0, 0),
        ("FN", None, None, "B", "stop", None, 0),
        ("FP", "f", "stop", None, None, None, 3),
    )
    assert ask("false_signs", "fused_id ref_id suggests", matches=matches) == [("f", "B", "the sign, too far off")]


def test_false_signs_at_poles(ask):
    matches = outcomes(
        ("TP", "a", "stop", "A", "stop", 0.0, 0),
        ("TP", "b", "yield", "B", "yield", 0.0, 0),
        ("FP", "c", "no_entry", None, None, None, 2),
        ("TP", "d", "stop", "D", "stop", 0.0, 100),
        ("FP", "e", "stop", None, None, None, 300),
    )
    assert ask("false_signs_at_poles", "n_signs_near n_mapped n_false share_false", matches=matches) == [
        (0, 1, 1, 1.0),
        (1, 1, 0, 0.0),
        (2, 3, 1, pytest.approx(1 / 3)),
    ]


def test_class_confusions(ask):
    matches = outcomes(
        ("FN", None, None, "A", "speed_limit:50", None, 0),
        ("FP", "a", "speed_limit:30", None, None, None, 1),
        ("FN", None, None, "B", "speed_limit:50", None, 100),
        ("FP", "b", "speed_limit:30", None, None, None, 101.5),
        ("FP", "c", "stop", None, None, None, 101.9),
        ("FN", None, None, "D", "stop", None, 200),
        ("FP", "d", "yield", None, None, None, 203),
    )
    assert ask("class_confusions", "ref_class fused_class n distance_mean_m", matches=matches) == [
        ("speed_limit:50", "speed_limit:30", 2, pytest.approx(1.25, rel=2e-3))
    ]


FUSED = "run_id, method, n_vehicles, sign_id, sign_class, n_passes, bbox"


def test_support(ask):
    matches = outcomes(
        ("TP", "a", "stop", "A", "stop", 3.0, 0),
        ("TP", "b", "stop", "B", "stop", 4.0, 50),
        ("FP", "c", "stop", None, None, None, 90),
        ("FN", None, None, "D", "stop", None, 99),
    )
    values = (f"('r', 'm', 5, '{i}', 'stop', {n}, {at(0)})" for i, n in (("a", 9), ("b", 9), ("c", 2)))
    found = ask(
        "support", "n_passes n_mapped n_true share_true rmse_m", matches=matches, fused=(FUSED, ", ".join(values))
    )
    assert found == [(2, 1, 0, 0.0, None), (9, 2, 2, 1.0, pytest.approx(12.5**0.5))]


def test_duplicates(ask):
    rows = (
        ("r", "a", "stop", 0),
        ("r", "b", "stop", 5),
        ("r", "c", "yield", 5),
        ("r", "d", "stop", 14),
        ("s", "e", "stop", 0),
    )
    values = (f"('{run_id}', 'm', 5, '{i}', '{c}', 4, {at(y)})" for run_id, i, c, y in rows)
    found = ask("duplicates", "run_id sign_id other_id distance_m", fused=(FUSED, ", ".join(values)))
    assert found == [("r", "a", "b", pytest.approx(5, rel=2e-3))]


def test_map_shift(ask):
    matches = outcomes(("TP", "a", "stop", "A", "stop", 1.0, 0), ("TP", "b", "stop", "B", "stop", 3.0, 50))
    values = f"('r', 'm', 5, 'a', 'stop', 4, {at(1)}), ('r', 'm', 5, 'b', 'stop', 4, {at(53)})"
    found = ask("map_shift", "n shift_e_m shift_n_m rmse_m rmse_unshifted_m", matches=matches, fused=(FUSED, values))
    near = [pytest.approx(v, rel=2e-3, abs=1e-6) for v in (0.0, 2.0, 5**0.5, 1.0)]
    assert found == [(2, *near)]


def test_worst_vehicles(ask):
    detections = (
        "run_id, vehicle_id, pass_id, track_id, bbox",
        ", ".join(
            f"('r', 'v{v}', 'p{v}', {track}, {at(y)})" for v, track, y in ((1, 0, 3), (1, 1, 90), (2, 0, 1), (2, 1, -1))
        ),
    )
    truth = (
        "run_id, pass_id, track_id, ref_sign_id, semantic_correct, is_ghost",
        """('r', 'p1', 0, 'A', true, false), ('r', 'p1', 1, NULL, false, true), ('r', 'p2', 0, 'A', true, false),
           ('r', 'p2', 1, 'A', false, false)""",
    )
    reference = ("run_id, sign_id, bbox", f"('r', 'A', {at(0)})")
    found = ask(
        "worst_vehicles",
        "vehicle_id n_detections share_ghosts share_wrong_class rmse_m",
        detections=detections,
        truth=truth,
        reference=reference,
    )
    assert found == [
        ("v1", 2, 0.5, 0.0, pytest.approx(3, rel=2e-3)),
        ("v2", 2, 0.0, 0.5, pytest.approx(1, rel=2e-3)),
    ]


def test_fleet_size(ask):
    scores = (
        "run_id, method, n_vehicles, tile, concept, gospa_m, f1, rmse_m",
        ", ".join(
            f"('{run_id}', 'm', {n}, '{tile}', '{concept}', {gospa_m}::DOUBLE, {f1}::DOUBLE, 0.5::DOUBLE)"
            for run_id, n, tile, concept, gospa_m, f1 in (
                ("r", 5, "all", "all", 1.0, 0.5),
                ("s", 5, "all", "all", 3.0, 0.7),
                ("t", 5, "all", "all", "NULL", 0.0),
                ("r", 9, "all", "all", 0.5, 1.0),
                ("r", 9, "10", "all", 9.5, 0.1),
                ("r", 9, "all", "stop", 9.5, 0.1),
            )
        ),
    )
    assert ask("fleet_size", "n_vehicles n_runs n_null f1_mean gospa_m_mean gospa_m_sd", scores=scores) == [
        (5, 3, 1, pytest.approx(0.4), 2.0, pytest.approx(2**0.5)),
        (9, 1, 0, 1.0, 0.5, None),
    ]


def test_every_statement_is_tested_here():
    assert {f"test_{name}" for name in NAMES} <= set(globals())


def test_every_statement_runs_on_the_tables_as_they_are():
    """`geofleet sql FILE.sql` binds no parameters."""
    assert [name for name in NAMES if load_sql(f"analysis/{name}").params] == []


@pytest.mark.parametrize("seed", range(5))
def test_scores_in_sql_are_those_of_python(seed):
    random = np.random.default_rng(seed)
    n, gate_m = 150, float(random.uniform(0.5, 5.0))
    outcome = random.choice(["TP", "FP", "FN"], n)
    # single outcomes a tile and concept are frequent enough for every way a score can be missing
    concept = random.choice(["stop", "yield", "no_entry"], n)
    tile = random.choice(["120120211013", "120120211031", *(f"12012021{k:04}" for k in (1, 2, 3, 10, 11, 12))], n)
    is_mapped, is_reference = outcome != "FN", outcome != "FP"
    ids = np.array([f"s{k:03}" for k in range(n)])
    columns = {
        "run_id": random.choice(["r0", "r1"], n),
        "method": "dbscan-first",
        "n_vehicles": random.choice([5, 10], n),
        "fused_id": pa.array(ids, mask=~is_mapped),
        "ref_id": pa.array(ids, mask=~is_reference),
        "outcome": outcome,
        "tile": tile,
        "distance_m": pa.array(random.uniform(0, gate_m, n), mask=outcome != "TP"),
        "fused_concept": pa.array(concept, mask=~is_mapped),
        "ref_concept": pa.array(concept, mask=~is_reference),
    }
    matches = build_table(MATCHES, columns, geometry=(np.full(n, 25.0), np.full(n, 60.0)))
    python = score_matches(matches, gate_m=gate_m, match_on="class")
    connection = connect()
    connection.register("matches", matches)
    connection.register("counts", run(connection, "evaluate/counts").to_arrow_table())
    scores = run(connection, "evaluate/scores", {"gate_m": gate_m}).to_arrow_table()
    connection.close()
    assert scores.num_rows == python.num_rows > 40
    assert {None, "no point of the map matches the reference"} < set(python["null_reason"].to_pylist())
    for name in scores.column_names:
        ours, theirs = scores[name], python[name]
        if pa.types.is_floating(theirs.type):
            assert ours.is_null().equals(theirs.is_null())
            np.testing.assert_allclose(ours.to_numpy(), theirs.to_numpy(), rtol=1e-12, err_msg=name)
        else:
            assert ours.to_pylist() == theirs.to_pylist(), name
