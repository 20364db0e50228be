"""How `evaluate` says how sure its scores are: intervals along a road and over runs, and a test of two maps."""

from __future__ import annotations

import numpy as np
import pytest

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.config import load_config
from geofleet.errors import ConfigError
from geofleet.steps.evaluate import evaluate
from geofleet.tables.schemas import DRIVES, SIGNS
from geofleet.tables.store import build_table, write_table

HELSINKI = EnuFrame(24.9450453, 60.1677108)  # as in conftest
N = 120
EAST_M = np.arange(N) * 20.0


@pytest.fixture
def score(tmp_path):
    """Write layers, evaluate the first against the second, and return the result."""

    def call(map_, reference, versus=None, drive=None):
        paths = {}
        for name, table in (("map", map_), ("reference", reference), ("versus", versus)):
            if table is not None:
                paths[name] = tmp_path / f"{name}.parquet"
                write_table(SIGNS, table, paths[name])
        return evaluate(
            paths["map"],
            paths["reference"],
            tmp_path / "out",
            config=load_config(),
            versus_path=paths.get("versus"),
            drive_path=drive,
        )

    return call


@pytest.fixture
def reference(make_signs):
    return make_signs(np.column_stack((EAST_M, np.zeros(N))), ["stop"] * N)


def noisy(make_signs, sigma_m, seed=0, **columns):
    """Signs of the reference with errors; every tenth is missing."""
    kept = np.arange(N) % 10 > 0
    errors = np.random.default_rng(seed).normal(0, sigma_m, (N, 2))
    return make_signs((np.column_stack((EAST_M, np.zeros(N))) + errors)[kept], ["stop"] * kept.sum(), **columns)


def row_of(rows, name):
    (row,) = [row for row in rows if row["score"] == name]
    return row


def test_a_single_map_has_intervals_for_a_longer_road(score, make_signs, reference):
    result = score(noisy(make_signs, 0.3), reference)
    (total,) = result.totals
    for name in ("f1", "gospa_m", "recall", "rmse_m"):
        row = row_of(result.intervals, name)
        assert row["low"] < row["estimate"] < row["high"]
        assert row["estimate"] == pytest.approx(total[name])
        assert "longer road" in row["estimand"]
        assert "common to the whole map" in row["note"]
    assert (result.out / "intervals.csv").is_file()


def test_along_a_drive_the_road_is_as_long_as_the_drive(score, make_signs, reference, tmp_path):
    lon, lat = HELSINKI.to_lonlat(np.column_stack((np.arange(0, 2400, 10.0), np.zeros(240))))
    columns = {"drive_id": "d", "seq": np.arange(240), "segment": 0, "source": "test"}
    write_table(DRIVES, build_table(DRIVES, columns, geometry=(lon, lat)), tmp_path / "drives.parquet")
    row = row_of(score(noisy(make_signs, 0.3), reference, drive=tmp_path / "drives.parquet").intervals, "gospa_m")
    assert row["low"] < row["estimate"] < row["high"]


def test_a_short_road_gives_no_interval_and_says_why(score, make_signs):
    few = make_signs([(0, 0), (10, 0)], ["stop"] * 2)
    row = row_of(score(few, few).intervals, "f1")
    assert (row["low"], row["high"]) == (None, None)
    assert row["note"]


def test_an_empty_map_against_nothing_has_no_rows(score, make_signs):
    assert score(make_signs([], []), make_signs([], [])).intervals == ()


def test_several_runs_have_intervals_for_the_procedure(score, make_signs):
    labels = {"method": "dbscan-first", "n_vehicles": 5}
    runs = [f"r{i}" for i in range(10)]
    rng = np.random.default_rng(3)
    xy = np.concatenate([np.column_stack((EAST_M, np.zeros(N))) + rng.normal(0, 0.4, (N, 2)) for _ in runs])
    run_id = np.repeat(runs, N)
    map_ = make_signs(xy, ["stop"] * len(xy), run_id=run_id, **labels)
    reference = make_signs(np.tile(np.column_stack((EAST_M, np.zeros(N))), (10, 1)), ["stop"] * len(xy), run_id=run_id)
    rows = [row for row in score(map_, reference).intervals if row["score"] == "rmse_m"]
    assert len(rows) == 2  # of the mean and of the median
    assert all(row["low"] < 0.4 * 2**0.5 < row["high"] for row in rows)
    assert all("run" in row["interval_method"] or "run" in row["estimand"] for row in rows)


def test_the_better_map_is_told_from_the_worse(score, make_signs, reference):
    good, bad = noisy(make_signs, 0.1, seed=1), noisy(make_signs, 0.8, seed=2)
    result = score(good, reference, versus=bad)
    row = row_of(result.comparisons, "gospa_m")
    assert row["verdict"] == "A is better"
    assert row["p_value"] < 0.05
    assert row["high"] < 0
    assert (result.out / "comparisons.csv").is_file()
    assert row_of(score(bad, reference, versus=good).comparisons, "gospa_m")["verdict"] == "B is better"


def test_a_map_is_not_better_than_itself(score, make_signs, reference):
    map_ = noisy(make_signs, 0.3)
    for row in score(map_, reference, versus=map_).comparisons:
        assert row["difference"] == 0
        assert row["verdict"] == "no difference shown"


def test_maps_of_several_fleets_are_not_compared(score, make_signs, reference):
    two = noisy(make_signs, 0.3, n_vehicles=[5, 10] * 54, method="m")
    with pytest.raises(ConfigError, match="map A holds 2 methods or fleet sizes"):
        score(two, reference, versus=two)
