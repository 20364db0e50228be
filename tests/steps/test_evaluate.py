from __future__ import annotations

import csv
import json
from math import sqrt

import geopandas
import pyarrow.compute as pc
import pytest

from geofleet.config import load_config
from geofleet.errors import ConfigError, TableError
from geofleet.steps.evaluate import CLIP_M, evaluate, missed_requirements, parse_requirements
from geofleet.tables.schemas import MATCHES, REFERENCE, SCORES, SIGNS
from geofleet.tables.store import build_table, lonlat, read_table, write_table

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


def test_every_layer_has_a_style_and_stands_in_the_geopackage(score, make_signs):
    out = score(make_signs([(1, 0)], ["stop"]), make_signs([(0, 0)], ["stop"])).out
    layers = {path.stem for path in out.glob("*.geojson")}
    assert layers == {"scores", "ellipses", "match_lines", "reference", "fused", "matches"}
    assert {path.stem for path in out.glob("*.qml")} == layers
    assert set(geopandas.list_layers(out / "results.gpkg")["name"]) == layers | {"layer_styles"}


def test_signs_without_covariance_have_no_ellipse_and_are_counted(score, make_signs):
    # of the five: one whole, one unknown, one half known, one impossible (correlation above 1), one without extent
    map_ = make_signs(
        [(x, 0) for x in range(0, 500, 100)],
        ["stop"] * 5,
        var_e_m2=[1.0, None, 1.0, 1.0, 0.0],
        var_n_m2=[1.0, None, None, 1.0, 0.0],
        cov_en_m2=[0.0, None, 0.0, 1.5, 0.0],
    )
    result = score(map_, make_signs([(0, 0)], ["stop"]))
    assert geopandas.read_file(result.out / "ellipses.geojson")["sign_id"].tolist() == ["s0"]
    assert result.counts["map_signs_without_ellipse"] == 4


def evaluate_with(tmp_path, map_, reference, *overrides, schema=SIGNS, **options):
    write_table(SIGNS, map_, tmp_path / "map.parquet")
    write_table(schema, reference, tmp_path / "reference.parquet")
    config = load_config("paper", overrides)
    paths = [tmp_path / name for name in ("map.parquet", "reference.parquet", "out")]
    return evaluate(*paths, config=config, **options)


def test_clip_scores_what_both_maps_cover(tmp_path, make_signs):
    # the map is one road to the east, the reference a road to the north; they share the corner
    map_ = make_signs([(x, 0) for x in range(0, 1000, 50)], ["stop"] * 20)
    reference = make_signs([(1, y) for y in range(0, 1000, 50)], ["stop"] * 20)
    result = evaluate_with(tmp_path, map_, reference, clip_m=60.0)
    (total,) = result.totals
    # of the map 0 and 50 m, of the reference 0 and 50 m, are within 60 m of a sign of the other
    assert (total["tp"], total["fp"], total["fn"]) == (1, 1, 1)
    assert result.counts["map_signs_clipped"] == result.counts["reference_signs_clipped"] == 18
    assert len(geopandas.read_file(result.out / "reference.geojson")) == 2
    assert len(geopandas.read_file(result.out / "fused.geojson")) == 2


def test_clip_of_maps_far_apart_leaves_nothing_and_says_so(tmp_path, make_signs):
    result = evaluate_with(tmp_path, make_signs([(0, 0)], ["stop"]), make_signs([(900, 0)], ["stop"]), clip_m=100.0)
    assert result.totals == ()
    assert missed_requirements(result.totals, parse_requirements(["fp<1"])) == [
        "fp<1 is missed: there was no sign to score."
    ]
    assert result.counts["map_signs_clipped"] == 1


def test_the_correlation_length_is_a_setting_of_intervals_along_the_road(tmp_path, make_signs):
    reference = make_signs([(25.0 * i, 0) for i in range(200)], ["stop"] * 200)
    map_ = make_signs([(25.0 * i + (i // 20) * 0.15, 0) for i in range(200) if i // 7 % 2], ["stop"] * 98)
    lengths = {}
    for correlation_m in (100.0, 300.0):
        (tmp_path / str(correlation_m)).mkdir()
        found = evaluate_with(tmp_path / str(correlation_m), map_, reference, f"correlation_m={correlation_m}")
        by_score = {row["score"]: row for row in found.intervals}
        assert by_score["f1"]["low"] < by_score["f1"]["estimate"] < by_score["f1"]["high"]
        lengths[correlation_m] = by_score["gospa_m"]["high"] - by_score["gospa_m"]["low"]
    assert lengths[100.0] != lengths[300.0]


def test_signs_far_from_the_other_map_are_counted_where_nothing_is_clipped(tmp_path, make_signs):
    map_, reference = (
        make_signs([(0, 0), (500, 0)], ["stop"] * 2),
        make_signs([(1, 0), (0, 101), (0, 900)], ["stop"] * 3),
    )
    counts = evaluate_with(tmp_path, map_, reference).counts
    assert counts["map_signs_far_from_reference"] == 1
    assert counts["reference_signs_far_from_map"] == 2
    (tmp_path / "empty").mkdir()
    counts = evaluate_with(tmp_path / "empty", map_.slice(0, 0), reference).counts
    assert counts["map_signs_far_from_reference"] == 0
    assert counts["reference_signs_far_from_map"] == 3


def test_in_view_leaves_out_what_no_pass_saw(tmp_path, make_signs):
    signs = make_signs([(0, 0), (100, 0)], ["stop"] * 2)
    columns = {name: signs[name] for name in signs.column_names if name not in ("geometry", "bbox")}
    seen = {"run_id": "r0", "n_passes_in_view": [3, 0], "n_frames_in_view": [30, 0]}
    reference = build_table(REFERENCE, columns | seen, geometry=lonlat(signs))
    map_ = make_signs([(0, 0)], ["stop"], run_id="r0", method="dbscan-first", n_vehicles=3)
    result = evaluate_with(tmp_path, map_, reference, schema=REFERENCE, in_view=True)
    assert (result.totals[0]["tp"], result.totals[0]["fn"]) == (1, 0)
    assert result.counts["reference_signs_never_in_view"] == 1
    assert evaluate_with(tmp_path, map_, reference, schema=REFERENCE).totals[0]["fn"] == 1


def test_in_view_needs_a_reference_table(tmp_path, make_signs):
    map_ = make_signs([(0, 0)], ["stop"])
    with pytest.raises(TableError, match="n_passes_in_view"):
        evaluate_with(tmp_path, map_, map_, in_view=True)


def test_confusion_is_of_position_and_does_not_cross_signs_of_one_pole(score, make_signs):
    # two signs on one pole, both right; a speed limit misread; a ghost
    map_ = make_signs([(0.3, 0), (0, 0.3), (100.5, 0), (300, 0)], ["stop", "yield", "speed_limit:30", "no_entry"])
    reference = make_signs([(0, 0), (0, 0), (100, 0), (200, 0)], ["stop", "yield", "speed_limit:50", "stop"])
    expected = [("speed_limit:50", "speed_limit:30", 1), ("stop", "stop", 1), ("yield", "yield", 1)]
    for match_on in ("class", "concept", "none"):
        result = score(map_, reference, f"match_on={match_on}")
        assert [(row["ref_class"], row["fused_class"], row["n"]) for row in result.confusion] == expected
    assert (result.out / "confusion.csv").read_text().splitlines()[1] == ",given,0,speed_limit:50,speed_limit:30,1"


def test_sources_are_scored_as_maps_of_their_own(score, make_signs):
    map_ = make_signs([(0, 0), (0.5, 0), (100, 0)], ["stop"] * 3, source=["a", "b", "b"])
    reference = make_signs([(0, 0), (100, 0)], ["stop"] * 2)
    result = score(map_, reference)
    assert [(r["source"], r["tp"], r["fp"], r["fn"], r["f1"]) for r in result.sources] == [
        ("a", 1, 0, 1, pytest.approx(2 / 3)),
        ("b", 2, 0, 0, 1.0),
    ]
    assert result.totals[0]["fp"] == 1
    assert (result.out / "sources.csv").is_file()


def test_one_source_is_the_total_and_has_no_table(score, make_signs):
    result = score(make_signs([(0, 0)], ["stop"]), make_signs([(0, 0)], ["stop"]))
    assert result.sources == ()
    assert not (result.out / "sources.csv").exists()


def test_the_summary_tells_mean_sd_and_nulls(score, make_signs):
    # r0 finds both signs at 1 m, r1 one of two at 0 m, r2 none: GOSPA_M is 1, √2 and null
    map_ = make_signs(
        [(1, 0), (101, 0), (0, 0), (50, 0)],
        ["stop"] * 4,
        run_id=["r0", "r0", "r1", "r2"],
        method="m",
        n_vehicles=5,
    )
    reference = make_signs([(0, 0), (100, 0)] * 3, ["stop"] * 6, run_id=["r0", "r0", "r1", "r1", "r2", "r2"])
    result = score(map_, reference)
    rows = {row["score"]: row for row in result.summary}
    values = (1.0, sqrt(2))
    assert rows["gospa_m"] == {
        "method": "m",
        "n_vehicles": 5,
        "score": "gospa_m",
        "mean": pytest.approx(sum(values) / 2, abs=1e-6),
        "sd": pytest.approx((values[1] - values[0]) / sqrt(2), abs=1e-6),
        "n": 2,
        "n_null": 1,
    }
    assert (rows["f1"]["n"], rows["f1"]["n_null"], rows["tp"]["mean"]) == (3, 0, 1.0)
    assert rows["recall"]["mean"] == pytest.approx((1 + 0.5 + 0) / 3)
    missed = missed_requirements(result.totals, parse_requirements(["gospa_m<5"]))
    assert len(missed) == 1
    assert "run r2" in missed[0]
    assert "null" in missed[0]


def test_gospa_m_is_its_two_parts(score, make_signs):
    map_ = make_signs([(1, 0), (200, 0)], ["stop"] * 2)
    (total,) = score(map_, make_signs([(0, 0), (300, 0)], ["stop"] * 2)).totals
    assert total["cardinality_m2"] == pytest.approx(4.0)
    assert total["gospa_m"] ** 2 == pytest.approx(total["mse_m2"] + total["cardinality_m2"])


def test_csv_tables_are_the_rows_of_scores(score, make_signs):
    map_ = make_signs([(x, 0) for x in range(0, 2000, 100)], ["stop", "yield"] * 10)
    result = score(map_, make_signs([(x + 0.5, 0) for x in range(0, 2000, 200)], ["stop"] * 10))
    scores = read_table(SCORES, result.out / "scores.parquet")
    for name, kept in (
        ("tiles", (pc.field("tile") != "all") & (pc.field("concept") == "all")),
        ("concepts", (pc.field("tile") == "all") & (pc.field("concept") != "all")),
    ):
        rows = scores.filter(kept).drop_columns(["geometry", "bbox"]).to_pylist()
        with (result.out / f"{name}.csv").open(encoding="utf-8", newline="") as stream:
            written = list(csv.DictReader(stream))
        assert written == [{key: "" if v is None else str(v) for key, v in row.items()} for row in rows]
        assert len(written) > 1
        assert any(row["gospa_m"] == "" for row in written) == (name == "concepts")


def test_two_encodings_of_one_map_score_perfectly(shared_data, tmp_path):
    paths = [shared_data / "osm" / f"helsinki_signs_roads.osm{suffix}" for suffix in (".pbf", ".gz")]
    (total,) = evaluate(*paths, tmp_path / "out", config=load_config("paper", ["match_on=concept"])).totals
    assert total["tp"] > 2000
    assert (total["gospa_m"], total["f1"]) == (0.0, 1.0)


def test_an_extract_against_an_inventory(shared_data, tmp_path):
    """The figures and their reasons stand in docs/evaluation.md."""
    extract = shared_data / "osm" / "osm2streets_neukolln_input.osm"
    inventory = shared_data / "inventory" / "neukoelln_man_made.geojson"
    config = load_config("paper", ["match_on=concept"])
    (whole,) = evaluate(extract, inventory, tmp_path / "whole", config=config).totals
    clipped = evaluate(extract, inventory, tmp_path / "clipped", config=config, clip_m=CLIP_M)
    (common,) = clipped.totals
    assert (whole["tp"], common["tp"]) == (4, 4)
    assert whole["rmse_m"] == 0.0
    assert whole["fn"] - common["fn"] == clipped.counts["reference_signs_clipped"] > 100
    assert (common["fp"], common["fn"]) == (1, 1)  # three signs of the extract are painted on the road: markings
