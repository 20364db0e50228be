from __future__ import annotations

import json
from math import sqrt

import geopandas
import pyarrow.compute as pc
import pytest

from geofleet.config import load_config
from geofleet.errors import ConfigError
from geofleet.steps.evaluate import evaluate, missed_requirements, parse_requirements
from geofleet.tables.schemas import MATCHES, SCORES, SIGNS
from geofleet.tables.store import read_table, write_table

PAPER = load_config()


@pytest.fixture
def score(tmp_path):
    """Write two layers, evaluate them, and return the result."""

    def call(map_, reference, *overrides):
        write_table(SIGNS, map_, tmp_path / "map.parquet")
        write_table(SIGNS, reference, tmp_path / "reference.parquet")
        config = load_config("paper", overrides)
        return evaluate(tmp_path / "map.parquet", tmp_path / "reference.parquet", tmp_path / "out", config=config)

    return call


def test_counts_and_scores_worked_out_by_hand(score, make_signs):
    # s0 finds s0 at 1 m; s1 stands 0.5 m off but with another class; s2 is 2 m off, not nearer than the gate;
    # s3 finds s3 at exactly 0 m. Two TP, two FP, three FN (s4 has nothing near).
    map_ = make_signs([(1, 0), (100.5, 0), (202, 0), (300, 0)], ["stop", "yield", "stop", "stop"])
    reference = make_signs([(0, 0), (100, 0), (200, 0), (300, 0), (400, 0)], ["stop"] * 5)
    (total,) = score(map_, reference).totals
    assert (total["tp"], total["fp"], total["fn"]) == (2, 2, 3)
    assert total["sum_sq_error_m2"] == pytest.approx(1.0, abs=1e-6)
    assert total["precision"] == 2 / 4
    assert total["recall"] == 2 / 5
    assert total["f1"] == pytest.approx(4 / 9)
    assert total["mse_m2"] == pytest.approx(0.5, abs=1e-6)
    assert total["gospa"] == pytest.approx(sqrt(1 + 2 * 5), abs=1e-6)
    assert total["gospa_m"] == pytest.approx(sqrt(11 / 2), abs=1e-6)


def test_match_on_none_takes_the_sign_of_another_class(score, make_signs):
    map_, reference = make_signs([(0.5, 0)], ["yield"]), make_signs([(0, 0)], ["stop"])
    (total,) = score(map_, reference, "match_on=none").totals
    assert total["tp"] == 1
    (total,) = score(map_, reference).totals
    assert (total["tp"], total["fp"], total["fn"]) == (0, 1, 1)


def test_match_on_concept_ignores_the_value(score, make_signs):
    map_, reference = make_signs([(0.5, 0)], ["speed_limit:30"]), make_signs([(0, 0)], ["speed_limit:50"])
    assert score(map_, reference, "match_on=concept").totals[0]["tp"] == 1


def test_a_map_against_itself_is_perfect(score, make_signs):
    map_ = make_signs([(0, 0), (0, 0), (50, 3)], ["stop", "yield", "stop"])
    (total,) = score(map_, map_).totals
    assert (total["gospa_m"], total["f1"]) == (0.0, 1.0)


def test_an_empty_map_has_no_gospa_m_and_says_why(score, make_signs):
    result = score(make_signs([], []), make_signs([(0, 0), (9, 9)], ["stop", "stop"]))
    (total,) = result.totals
    assert (total["tp"], total["fp"], total["fn"], total["gospa_m"]) == (0, 0, 2, None)
    assert total["gospa"] == 2.0
    assert total["null_reason"]
    for layer in ("scores", "matches", "match_lines", "fused", "reference"):
        assert json.loads((result.out / f"{layer}.geojson").read_text())["type"] == "FeatureCollection"


def test_tiles_and_concepts_add_up_to_the_total(score, make_signs):
    map_ = make_signs([(x, 0) for x in range(-1500, 1500, 100)], ["stop", "yield", "speed_limit:30"] * 10)
    reference = make_signs([(x + 0.3, 0.4) for x in range(-1500, 1500, 100)], ["stop", "yield", "yield"] * 10)
    result = score(map_, reference)
    scores = read_table(SCORES, result.out / "scores.parquet")
    total = result.totals[0]
    for tile, concept in (("all", "each"), ("each", "all"), ("each", "each")):
        part = scores.filter(
            ((pc.field("tile") == "all") == (tile == "all")) & ((pc.field("concept") == "all") == (concept == "all"))
        )
        assert part.num_rows > 1
        for count in ("tp", "fp", "fn"):
            assert pc.sum(part[count]).as_py() == total[count]
        assert pc.sum(part["sum_sq_error_m2"]).as_py() == pytest.approx(total["sum_sq_error_m2"])
    assert total["tp"] == 20


def test_every_sign_stands_in_matches_once(score, make_signs):
    map_ = make_signs([(1, 0), (100.5, 0), (202, 0)], ["stop", "yield", "stop"])
    reference = make_signs([(0, 0), (100, 0), (200, 0), (300, 0)], ["stop"] * 4)
    matches = read_table(MATCHES, score(map_, reference).out / "matches.parquet")
    assert sorted(filter(None, matches["fused_id"].to_pylist())) == ["s0", "s1", "s2"]
    assert sorted(filter(None, matches["ref_id"].to_pylist())) == ["s0", "s1", "s2", "s3"]
    assert matches.filter(pc.field("outcome") == "TP")["distance_m"].to_pylist() == pytest.approx([1.0], abs=1e-6)
    assert matches["class_agrees"].null_count == matches.num_rows - 1


def test_layers_have_one_geometry_type_and_no_line_without_length(score, make_signs):
    map_ = make_signs([(1, 0), (100, 0), (202, 0)], ["stop"] * 3)
    out = score(map_, make_signs([(0, 0), (100, 0), (200, 0)], ["stop"] * 3)).out
    types = {"scores": "Polygon", "matches": "Point", "match_lines": "LineString", "fused": "Point"}
    for layer, geometry_type in types.items():
        assert set(geopandas.read_file(out / f"{layer}.geojson").geom_type) == {geometry_type}
    lines = geopandas.read_file(out / "match_lines.geojson")
    assert lines["ref_id"].tolist() == ["s0"]  # s1 stands on its reference
    assert lines.to_crs(3879).length.tolist() == pytest.approx([1.0], rel=1e-3)


def test_runs_fleets_and_methods_are_scored_apart(score, make_signs):
    map_ = make_signs(
        [(0, 0), (0, 0), (500, 0)],
        ["stop"] * 3,
        run_id=["r0", "r0", "r1"],
        method="dbscan-first",
        n_vehicles=[5, 10, 5],
    )
    reference = make_signs([(0, 0), (0, 0)], ["stop"] * 2, run_id=["r0", "r1"])
    totals = score(map_, reference).totals
    assert [(t["run_id"], t["n_vehicles"], t["tp"], t["fp"]) for t in totals] == [
        ("r0", 5, 1, 0),
        ("r0", 10, 1, 0),
        ("r1", 5, 0, 1),
    ]


def test_a_run_without_any_sign_counts_as_an_empty_map(score, make_signs):
    map_ = make_signs([(0, 0)], ["stop"], run_id="r0", method="dbscan-first", n_vehicles=5)
    reference = make_signs([(0, 0), (0, 0)], ["stop"] * 2, run_id=["r0", "r1"])
    assert [(t["run_id"], t["tp"], t["fn"]) for t in score(map_, reference).totals] == [("r0", 1, 0), ("r1", 0, 1)]


def test_plates_are_not_scored(score, make_signs):
    map_ = make_signs([(0, 0), (9, 0)], ["stop", "plate"], kind=["main", "plate"])
    assert score(map_, make_signs([(0, 0)], ["stop"])).totals[0]["fp"] == 0


def test_runs_that_have_nothing_in_common_are_refused(score, make_signs):
    map_ = make_signs([(0, 0)], ["stop"], run_id="other", method="dbscan-first", n_vehicles=5)
    with pytest.raises(ConfigError, match="none of the 2 runs of the reference"):
        score(map_, make_signs([(0, 0), (0, 0)], ["stop"] * 2, run_id=["r0", "r1"]))


def test_the_same_layers_give_the_same_bytes(score, make_signs):
    map_, reference = make_signs([(1, 0), (9, 9)], ["stop"] * 2), make_signs([(0, 0)], ["stop"])
    first = {p.name: p.read_bytes() for p in score(map_, reference).out.iterdir()}
    assert {p.name: p.read_bytes() for p in score(map_, reference).out.iterdir()} == first


def test_requirements(score, make_signs):
    perfect = score(make_signs([(0, 0)], ["stop"]), make_signs([(0, 0)], ["stop"])).totals
    empty = score(make_signs([], []), make_signs([(0, 0)], ["stop"])).totals
    needs = parse_requirements(["gospa_m<0.8", "f1 >= 0.9"])
    assert missed_requirements(perfect, needs) == []
    missed = missed_requirements(empty, needs)
    assert len(missed) == 2
    assert "null" in missed[0]


@pytest.mark.parametrize("text", ["gospa_m", "gospa_m<", "gospa<x", "colour<1", "gospa_m=0.8", ""])
def test_what_is_no_requirement_is_refused(text):
    with pytest.raises(ConfigError, match="is not a requirement"):
        parse_requirements([text])
