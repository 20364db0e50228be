"""The page of a report, its figures, and what it says of runs that lack something."""

from __future__ import annotations

import json
import re
import shutil

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest

from geofleet.config import load_config
from geofleet.errors import ConfigError, InputError
from geofleet.steps.aggregate import aggregate
from geofleet.steps.evaluate import evaluate
from geofleet.steps.report import report
from geofleet.steps.report.contents import read_contents
from geofleet.steps.report.scene import lay_out
from geofleet.steps.report.statistics import FALSE, MISSED, count_confusion, error_bins
from geofleet.steps.report.study import read_study
from geofleet.tables.manifest import hash_path
from geofleet.tables.schemas import NUISANCE, SIGNS
from geofleet.tables.store import read_table, write_table
from geofleet.workflows.demo import run_demo

LARGEST_PAGE = 3_000_000  # bytes, of the demo


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    out = tmp_path_factory.mktemp("demo")
    run_demo(out, n_vehicles=10)
    return out


@pytest.fixture(scope="module")
def page(demo):
    return (demo / "report" / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def small(tmp_path_factory, make_signs):
    """Evaluate a map from elsewhere: no run, no road, no drive; s1 has no covariance."""
    folder = tmp_path_factory.mktemp("small")
    map_ = make_signs(
        [(1, 0), (40.5, 20), (80, 5)],
        ["stop", "stop", "yield"],
        var_e_m2=[0.25, None, 1.0],
        var_n_m2=[0.25, None, 1.0],
        cov_en_m2=[0.0, None, 0.0],
    )
    reference = make_signs([(0, 0), (40, 20), (40, 21), (80, 60)], ["stop", "stop", "yield", "stop"])
    write_table(SIGNS, map_, folder / "map.parquet")
    write_table(SIGNS, reference, folder / "reference.parquet")
    evaluate(folder / "map.parquet", folder / "reference.parquet", folder / "evaluation", config=load_config())
    return folder


def document(page):
    return json.loads(re.search(r'id="gf-document">(.*?)</script>', page, re.DOTALL)[1])


def test_the_page_asks_nothing_of_the_net(page):
    markup = re.sub(r"<script[ >].*?</script>", "", page, flags=re.DOTALL)
    assert not re.search(r"https?:|//[a-z]", markup)
    assert not re.search(r"<(script|link|img|iframe)[^>]+(src|href)=(?!\"data:,)", page)
    assert len(page.encode()) < LARGEST_PAGE


def test_the_page_says_what_is_simulated(page):
    for words in ("simulated detections", "derived drive", "© OpenStreetMap contributors", "10 simulated vehicles"):
        assert words in page


def test_the_page_shows_the_scores(page, demo):
    shown = read_contents(demo).shown
    assert f"<b>{shown['gospa_m']:.3f}" in page
    assert f"{shown['tp']} / {shown['fp']} / {shown['fn']}" in page


def test_passes_of_a_joint_map_are_listed_those_far_from_what_they_declare_first(demo, tmp_path, page):
    assert "Passes</h2>" not in page, "the demo's map is not by joint fusion"
    config = load_config("paper", {"method": "joint"})
    simulated = demo / "simulation"
    aggregate(
        simulated / "detections",
        tmp_path / "map.parquet",
        config=config,
        passes=simulated / "passes.parquet",
        n_vehicles=4,
    )
    found = tmp_path / "map_nuisance.parquet"
    rows = read_table(NUISANCE, found)
    suspect = pa.array([name == rows["pass_id"][2].as_py() for name in rows["pass_id"].to_pylist()])
    write_table(NUISANCE, rows.set_column(rows.column_names.index("is_suspect"), "is_suspect", suspect), found)
    evaluate(tmp_path / "map.parquet", simulated / "reference.parquet", tmp_path / "evaluation", config=config)
    report(tmp_path, tmp_path / "report")
    written = (tmp_path / "report" / "report.html").read_text(encoding="utf-8")
    listed = re.findall(r'<tr><td><code class="whole">(v[^<]+)</code>', written)
    assert listed[0] == f"{rows['pass_id'][2].as_py()} *"
    assert {name.removesuffix(" *") for name in listed} == set(rows["pass_id"].to_pylist())
    assert "1 of 4 are far from what they declare" in written
    shutil.copy(found, tmp_path / "another_nuisance.parquet")  # of two maps: nobody says which is the one drawn
    assert not read_contents(tmp_path).nuisance


def test_provenance_names_inputs_hashes_seeds_and_versions(page, demo):
    for name in ("helsinki.osm.pbf", "fused.parquet"):
        assert name in page
    digest = json.loads((demo / "signs" / "signs_manifest.json").read_text())["inputs"][0]["sha256"]
    assert digest in page
    for step in ("ingest signs", "ingest lanes", "ingest drives", "simulate", "aggregate", "evaluate"):
        assert f"<td>{step}</td>" in page, step
    assert re.search(r"Versions: .*duckdb 1\.5\.5", page)
    assert "seed = 0" in page


def test_every_layer_of_the_map_is_drawn(page):
    text = json.dumps(document(page))
    names = ("tiles", "roads", "drive", "ellipses", "match_lines", "reference", "fused", "TP", "FP", "FN")
    for name in names:
        assert f'"name": "{name}"' in text, name


def test_the_same_run_gives_the_same_bytes(demo, tmp_path):
    report(demo, tmp_path / "again")
    assert hash_path(tmp_path / "again") == hash_path(demo / "report")


def test_figures_for_print_are_there_and_not_blank(demo):
    from matplotlib.image import imread  # noqa: PLC0415

    for name in ("map", "figures/errors", "figures/confusion"):
        pixels = imread(demo / "report" / f"{name}.png")
        assert len(np.unique(pixels.reshape(-1, pixels.shape[-1]), axis=0)) > 20
        assert (demo / "report" / f"{name}.svg").read_text(encoding="utf-8").startswith("<?xml")


def test_a_map_from_elsewhere_needs_only_an_evaluation(small, tmp_path):
    page = report(small, tmp_path / "report").files[0].read_text(encoding="utf-8")
    assert "no lanes table" in page
    assert "no drives table" in page
    assert "No table here says that anything was simulated" in page
    assert "simulated detections" not in page
    assert "OpenStreetMap" not in page


def test_the_scene_holds_every_outcome_at_its_place(small):
    scene = lay_out(read_contents(small))
    outcomes = scene.outcomes["outcome"].value_counts().to_dict()
    assert outcomes == {"TP": 2, "FP": 1, "FN": 2}
    assert sorted(scene.distance_m) == pytest.approx([0.5, 1.0], abs=1e-3)
    assert scene.shift_m == pytest.approx((0.75, 0.0), abs=1e-3)
    # 1 m off at a sigma of 0.5 m is within the ellipse (4 < 5.99); the other has no covariance
    assert (scene.n_inside, scene.n_with_ellipse) == (1, 1)
    for start, end in scene.lines:
        assert np.hypot(*(start - end)) in (pytest.approx(0.5, abs=1e-3), pytest.approx(1.0, abs=1e-3))


def test_confusion_counts_every_sign_once(small):
    contents = read_contents(small)
    found = count_confusion(contents)
    cells = {
        (row, column): found.counts[i, j]
        for i, row in enumerate(found.rows)
        for j, column in enumerate(found.columns)
        if found.counts[i, j]
    }
    assert cells == {("stop", "stop"): 2, ("stop", MISSED): 1, ("yield", MISSED): 1, (FALSE, "yield"): 1}
    missed = found.counts[:-1].sum()
    assert missed == len(contents.reference)
    assert found.counts[:, :-1].sum() == len(contents.fused)


def test_bins_hold_every_error_up_to_the_gate():
    counts, edges = error_bins(np.array([0.0, 0.05, 0.1, 1.999]), 2.0)
    assert counts.sum() == 4
    assert (edges[0], edges[-1]) == (0.0, 2.0)


def test_an_empty_map_still_has_a_report(small, tmp_path, make_signs):
    write_table(SIGNS, make_signs([], []), tmp_path / "map.parquet")
    evaluate(tmp_path / "map.parquet", small / "reference.parquet", tmp_path / "evaluation", config=load_config())
    page = report(tmp_path, tmp_path / "report").files[0].read_text(encoding="utf-8")
    assert "no error to show" in page
    assert "<h1>Empty sign map</h1>" in page
    assert "method none" not in page
    assert "GOSPA_M has no interval" in page
    assert read_contents(tmp_path).shown["null_reason"] in page.replace("&#39;", "'")


def test_an_empty_reference_still_has_a_report(small, tmp_path, make_signs):
    write_table(SIGNS, make_signs([], []), tmp_path / "reference.parquet")
    evaluate(small / "map.parquet", tmp_path / "reference.parquet", tmp_path / "evaluation", config=load_config())
    page = report(tmp_path, tmp_path / "report").files[0].read_text(encoding="utf-8")
    assert "0 / 3 / 0" in page


def test_of_several_maps_the_median_of_the_largest_fleet_is_drawn(tmp_path, make_signs):
    reference = make_signs([(0, 0), (50, 0), (100, 0)], ["stop"] * 3)
    maps = {
        ("a", 5): [(0, 1)],
        ("a", 10): [(0, 0)],
        ("b", 10): [(0, 0), (50, 0)],
        ("c", 10): [(0, 0), (50, 0), (100, 0)],
    }
    xy = [place for places in maps.values() for place in places]
    owners = [key for key, places in maps.items() for _ in places]
    columns = {"run_id": ["r"] * len(xy), "method": [m for m, _ in owners], "n_vehicles": [n for _, n in owners]}
    write_table(SIGNS, make_signs(xy, ["stop"] * len(xy), **columns), tmp_path / "map.parquet")
    write_table(SIGNS, reference, tmp_path / "reference.parquet")
    evaluate(tmp_path / "map.parquet", tmp_path / "reference.parquet", tmp_path / "evaluation", config=load_config())
    shown = read_contents(tmp_path)
    assert (shown.shown["method"], shown.shown["n_vehicles"]) == ("b", 10)
    assert len(shown.fused) == 2
    assert pc.unique(shown.matches["method"]).to_pylist() == ["b"]
    assert read_contents(tmp_path, method="a").shown["n_vehicles"] == 10
    assert read_contents(tmp_path, n_vehicles=5).shown["method"] == "a"
    with pytest.raises(ConfigError, match=r"no map of \{'method': 'd'\}.*'a', 'b', 'c'"):
        read_contents(tmp_path, method="d")
    page = report(tmp_path, tmp_path / "report").files[0].read_text(encoding="utf-8")
    assert "curve_gospa_m" in page  # method a was scored with two fleet sizes
    assert (tmp_path / "report" / "figures" / "fleet_size_gospa_m.svg").is_file()


def test_intervals_of_several_runs_are_not_passed_off_as_those_of_the_run_drawn(tmp_path, make_signs):
    """One, two and three of four signs are found: the median run has F1 2/3, their mean is (0.4 + 2/3 + 6/7) / 3."""
    places = [(0, 0), (50, 0), (100, 0), (150, 0)]
    found, runs = [places[k] for n in (1, 2, 3) for k in range(n)], [f"r{n}" for n in (1, 2, 3) for _ in range(n)]
    columns = {"run_id": runs, "method": ["m"] * 6, "n_vehicles": [5] * 6}
    write_table(SIGNS, make_signs(found, ["stop"] * 6, **columns), tmp_path / "map.parquet")
    write_table(SIGNS, make_signs(places, ["stop"] * 4), tmp_path / "reference.parquet")
    evaluate(tmp_path / "map.parquet", tmp_path / "reference.parquet", tmp_path / "evaluation", config=load_config())
    page = report(tmp_path, tmp_path / "report").files[0].read_text(encoding="utf-8")
    assert "<b>0.667</b><span>mean of 3 runs 0.641, 95 %:" in page
    assert "of 3 runs the one with the median GOSPA_M" in page


def test_curves_of_a_study_stand_beside_the_papers_points(small, tmp_path):
    shutil.copytree(small / "evaluation", tmp_path / "evaluation")
    names = "scenario,place,setting,method,n_vehicles,score,n,mean,sd,mean_low,mean_high"
    rows = [
        f"paper,a,,dbscan-first,{v},{s},10,{m},.1,.5,1.5" for v, m in ((5, 1.5), (10, 1.2)) for s in ("gospa_m", "f1")
    ]
    rows.append("paper,a,,dbscan-first,15,gospa_m,0,,,,")  # no run has a score
    (tmp_path / "study" / "fleet-size").mkdir(parents=True)
    (tmp_path / "study" / "fleet-size" / "summary.csv").write_text("\n".join([names, *rows]))
    study = read_study(tmp_path, read_contents(tmp_path))
    assert study.scores == ("gospa_m", "f1")
    (curve,) = (curve for curve in study.curves if curve.score == "gospa_m")
    assert curve.n_vehicles.tolist() == [5, 10]
    assert curve.mean.tolist() == [1.5, 1.2]
    assert study.paper["gospa_m"][0].tolist() == [5, 1.54, 0.461]  # its Figure 5
    page = report(tmp_path, tmp_path / "report").files[0].read_text(encoding="utf-8")
    assert "the study in study/fleet-size" in page
    assert "the paper, DBSCAN" in page


def test_a_run_without_an_evaluation_is_told_what_to_do(tmp_path):
    with pytest.raises(InputError, match="an evaluation is needed; found: none"):
        report(tmp_path, tmp_path / "report")
    with pytest.raises(InputError, match="no such folder"):
        report(tmp_path / "nowhere", tmp_path / "report")
    assert not (tmp_path / "report").exists()


def test_several_evaluations_are_not_guessed_between(small, tmp_path):
    for name in ("one", "two"):
        shutil.copytree(small / "evaluation", tmp_path / name)
    with pytest.raises(InputError, match="found: one, two"):
        read_contents(tmp_path)
    assert read_contents(tmp_path / "one").evaluation == tmp_path / "one"


def test_large_maps_are_cut_to_their_worst_tiles(demo, monkeypatch):
    monkeypatch.setattr("geofleet.steps.report.scene.MOST_SIGNS", 20)
    contents = read_contents(demo)
    scene = lay_out(contents)
    assert len(scene.outcomes) < scene.n_outcomes
    assert set(scene.outcomes["tile"]) == {contents.tiles[0]["tile"]}
    assert len(scene.distance_m) == contents.shown["tp"]  # errors count them all
