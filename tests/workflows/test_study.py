"""Studies: what is computed once is not computed again, workers do not show, the paper's numbers are its own."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pyarrow.compute as pc
import pytest

from geofleet.algorithms.staleness import Staleness
from geofleet.config import load_config
from geofleet.errors import ConfigError
from geofleet.steps.aggregate import aggregate
from geofleet.steps.evaluate import evaluate
from geofleet.steps.simulate import simulate
from geofleet.tables.schemas import SIGNS, STUDY_SCORES
from geofleet.tables.store import read_table
from geofleet.workflows.study import units
from geofleet.workflows.study.compare import compare
from geofleet.workflows.study.fleet_size import fleet_size
from geofleet.workflows.study.methods import METHODS, parse_methods, with_settings
from geofleet.workflows.study.paper import paper_curve, paper_points, paper_table
from geofleet.workflows.study.results import totals
from geofleet.workflows.study.units import Unit, map_fleets, run_study, simulate_fleets, world_batch
from geofleet.workflows.study.worlds import USUAL_PRIOR, Study, prepare_worlds

RAW = Path(__file__).parents[2] / "data" / "raw"
PBF, POS = RAW / "helsinki.osm.pbf", RAW / "helsinki_derived.pos"


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """The shipped signs and drive as tables."""
    folder = tmp_path_factory.mktemp("inputs")
    (world,) = prepare_worlds(PBF, [POS], ["paper"], folder, settings=())
    return world.signs, world.drive


def worlds(inputs, scenario="paper", sweep="", settings=()):
    signs, drive = inputs
    return prepare_worlds(signs, [drive], [scenario], Path("unused"), settings=settings, sweep=sweep)


def small(inputs, methods="dbscan,dbscan-after", **options):
    given = {"n_replicates": 2, "sizes": (3, 6)} | options
    return Study(worlds(inputs), parse_methods(methods), **given)


def test_the_numbers_of_the_paper():
    """Golden: Table 2 and Figures 3 to 5, each number as printed."""
    assert paper_table()["dbscan-first"] == {"precision": 0.935, "recall": 0.879, "f1": 0.906, "gospa_m": 0.756331172}
    assert paper_table()["kmedoids-after"]["gospa_m"] == 3.588900265
    assert [row["gospa_m"] for row in paper_table().values()] == sorted(r["gospa_m"] for r in paper_table().values())
    assert [p.n_vehicles for p in paper_curve("gospa_m")] == list(range(5, 51, 5))
    first, last = paper_curve("gospa_m")[0], paper_curve("gospa_m")[-1]
    assert (first.mean, first.sd, last.mean, last.sd) == (1.54, 0.461, 0.7802, 0.1274)
    assert (paper_curve("f1")[3].mean, paper_curve("tp")[1].mean, paper_curve("fp")[9].mean) == (0.8935, 26.8, 1.5)
    assert len(paper_points()) == 8 * 4 + 10 * 5
    for v in range(10):  # the counts of Figure 4 are those of 33 signs
        assert paper_curve("tp")[v].mean + paper_curve("fn")[v].mean == pytest.approx(33.0, abs=0.01)


def test_a_study_gives_what_the_steps_give(inputs, tmp_path):
    rows = totals(run_study(small(inputs, "dbscan"), tmp_path / "study"))
    config = load_config("paper")
    sim = tmp_path / "sim"
    simulate(*inputs, sim, config=config, n_vehicles=6, n_replicates=2)
    for size in (3, 6):
        aggregate(sim / "detections", tmp_path / "f.parquet", config=config, n_vehicles=size)
        scores = evaluate(tmp_path / "f.parquet", sim / "reference.parquet", tmp_path / "e", config=config).totals
        for total in scores:
            (row,) = [r for r in rows if r["run_id"] == total["run_id"] and r["n_vehicles"] == size]
            assert {name: row[name] for name in ("tp", "fp", "fn", "gospa_m", "f1")} == {
                name: total[name] for name in ("tp", "fp", "fn", "gospa_m", "f1")
            }


def test_a_larger_fleet_does_not_show(inputs, tmp_path):
    one = run_study(small(inputs, "dbscan", sizes=(3,)), tmp_path / "one")
    larger = run_study(small(inputs, "dbscan", sizes=(3, 5)), tmp_path / "larger")
    assert [r for r in larger if r["n_vehicles"] == 3] == one


def test_what_is_there_is_not_done_again(inputs, tmp_path, monkeypatch):
    study = small(inputs, "dbscan")
    rows = run_study(study, tmp_path)
    done = []
    monkeypatch.setattr(units, "run_batch", done.append)
    assert run_study(study, tmp_path) == rows
    assert not done
    monkeypatch.undo()
    lost = min((tmp_path / "units").glob("*.json"))
    lost.unlink()
    assert run_study(study, tmp_path) == rows
    assert lost.is_file()
    assert not list((tmp_path / "units").glob(".*"))


def test_studies_in_one_folder_share_what_they_have_in_common(inputs, tmp_path, monkeypatch):
    """Table 2 does not map again the fleets of Figure 5 of that size."""
    curve = run_study(small(inputs, "dbscan"), tmp_path)
    done, run_batch = [], units.run_batch

    def noted(batch):
        done.extend((unit.method, unit.n_vehicles, unit.replicate) for unit in batch.units)
        return run_batch(batch)

    monkeypatch.setattr(units, "run_batch", noted)
    table = run_study(small(inputs, "dbscan,dbscan-after", sizes=(6,)), tmp_path)
    assert sorted(done) == [("dbscan-after", 6, 0), ("dbscan-after", 6, 1)]
    shared = [row for row in curve if row["n_vehicles"] == 6]
    assert [row for row in table if row["method"] == "dbscan-first"] == shared


@pytest.mark.slow
def test_a_study_goes_on_where_it_was_killed(inputs, tmp_path):
    out = tmp_path / "study"
    command = [sys.executable, "-c", "from geofleet.cli import main; main()", "study", "compare", "--json"]
    command += ["--signs", inputs[0], "--drive", inputs[1], "--out", out, "--workers", "1"]
    command += ["--methods", "dbscan,dbscan-after", "--vehicles", "2,4,8", "--replicates", "2"]
    first = subprocess.Popen(list(map(str, command)), stderr=subprocess.PIPE, start_new_session=True)  # noqa: S603
    until = time.monotonic() + 120
    while len(list(out.glob("units/*.json"))) < 4 and time.monotonic() < until:
        time.sleep(0.02)
    os.killpg(first.pid, signal.SIGKILL)
    first.communicate()
    before = {path: path.stat().st_mtime_ns for path in out.glob("units/*.json")}
    assert 4 <= len(before) < 12
    second = subprocess.run(list(map(str, command)), capture_output=True, check=True)  # noqa: S603
    assert len(json.loads(second.stdout)["table"]) == 6
    after = {path: path.stat().st_mtime_ns for path in out.glob("units/*.json")}
    assert len(after) == 12
    assert before.items() <= after.items(), "what was there was not written again"


def test_what_another_study_has_begun_in_the_same_folder_stays_for_a_day(tmp_path):
    begun, old, draft = (tmp_path / name for name in (".of_now", ".of_yesterday", ".of_yesterday.json.tmp"))
    for folder in (begun, old):
        folder.mkdir()
        (folder / "fleet-0.parquet").touch()
    draft.touch()
    for path in (old, draft):
        os.utime(path, (time.time() - 90_000,) * 2)
    units.remove_leftovers(tmp_path)
    assert [path.name for path in tmp_path.rglob("*")] == [".of_now", "fleet-0.parquet"]


def test_comparison_tables_and_figures(inputs, tmp_path):
    result = compare(small(inputs, "dbscan,kmeans,dbscan-corrected", sizes=(4,)), tmp_path)
    assert [row["method"] for row in result.table] == ["dbscan-first", "kmeans-first", "dbscan-corrected"]
    assert [row["upload"] for row in result.table] == ["mean", "mean", "information"]
    assert "tracker paper" in result.caption
    names = {path.name for path in result.files}
    assert names == {"methods.png", "methods.svg", "study_scores.csv", "study_scores.parquet", "summary.csv"}
    table = read_table(STUDY_SCORES, tmp_path / "compare" / "study_scores.parquet")
    assert table.num_rows == 6
    assert pc.sum(table["tp"]).as_py() > 0


@pytest.mark.slow
def test_the_same_study_gives_the_same_files_with_more_workers(inputs, tmp_path):
    for name, workers in (("a", 1), ("b", 2)):
        compare(small(inputs, sizes=(3,)), tmp_path / name, n_workers=workers)
    for path in (tmp_path / "a" / "compare").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / "compare" / path.name).read_bytes(), path.name


def test_fleet_sizes_stand_beside_the_paper(inputs, tmp_path):
    result = fleet_size(small(inputs, "dbscan", sizes=(5, 10), n_replicates=3), tmp_path)
    assert result.n_compared == 2
    assert [row["paper_gospa_m"] for row in result.table] == [1.54, 1.2694]
    for row in result.table:
        assert row["z"] == pytest.approx((row["gospa_m_mean"] - row["paper_gospa_m"]) / row["paper_sd"])
        assert row["gospa_m_mean_low"] < row["gospa_m_mean"] < row["gospa_m_mean_high"]
    assert {p.stem for p in result.files if p.suffix == ".svg"} == {
        "figure-3-f1",
        "figure-4-counts",
        "figure-5-gospa_m",
    }


def test_a_sweep_is_a_world_a_value(inputs, tmp_path):
    swept = worlds(inputs, sweep="semantic_rate=0.9,1")
    assert [world.setting for world in swept] == ["semantic_rate=0.9", "semantic_rate=1"]
    result = compare(Study(swept, parse_methods("dbscan"), (5,), n_replicates=2), tmp_path)
    assert [row["setting"] for row in result.table] == ["semantic_rate=0.9", "semantic_rate=1"]
    assert "sweep.svg" in {path.name for path in result.files}


def test_in_view_leaves_out_what_no_pass_could_see(inputs, tmp_path):
    near = worlds(inputs, settings=["range_m=15"])
    every = totals(run_study(Study(near, parse_methods("dbscan"), (2,), 1), tmp_path / "a"))
    seen = totals(run_study(Study(near, parse_methods("dbscan"), (2,), 1, in_view=True), tmp_path / "b"))
    assert seen[0]["tp"] == every[0]["tp"]
    assert seen[0]["tp"] + seen[0]["fn"] < every[0]["tp"] + every[0]["fn"] == 33


def test_methods_are_names_of_settings():
    labels = [method.label for method in parse_methods("dbscan, kmeans-after,dbscan-corrected,dbscan-first")]
    assert labels == ["dbscan-first", "kmeans-after", "dbscan-corrected"]
    assert METHODS["kmedoids-first"].has_oracle_k
    assert Staleness(0.15, 0.10, 0.10, 0.10, moved_m=5.0, sigma_m=0.15) == USUAL_PRIOR
    with pytest.raises(ConfigError, match="Did you mean kmedoids"):
        parse_methods("kmedoid")
    with pytest.raises(ConfigError, match="no method"):
        parse_methods(",")


def test_impossible_studies_are_refused(inputs):
    with pytest.raises(ConfigError, match="fleet sizes"):
        small(inputs, sizes=(0, 5))
    with pytest.raises(ConfigError, match="replicates"):
        small(inputs, n_replicates=0)
    with pytest.raises(ConfigError, match="--sweep"):
        worlds(inputs, sweep="semantic_rate")
    with pytest.raises(ConfigError, match="--prior: no method here starts from a prior map"):
        small(inputs, prior=PBF)
    with pytest.raises(ConfigError, match="--method: unknown method"):
        parse_methods("dbscn", option="--method")
    with pytest.raises(ConfigError, match="workers"):
        run_study(small(inputs), Path("unused-study"), n_workers=0)


@pytest.fixture
def write_results(repo):
    spec = importlib.util.spec_from_file_location("write_results", repo / "scripts" / "write_results.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_of_results_is_written_from_the_output(inputs, tmp_path, write_results, monkeypatch):
    module = write_results
    monkeypatch.setattr(module, "DOCS", tmp_path)
    monkeypatch.setattr(module, "FIGURES", tmp_path / "figures")
    monkeypatch.setattr(module, "README", tmp_path / "README.md")
    monkeypatch.setattr(sys, "argv", ["write_results.py", str(tmp_path / "study")])
    result = compare(small(inputs, "dbscan,dbscan-corrected", sizes=(5,), n_replicates=3), tmp_path / "study")
    module.main()
    page = (tmp_path / "results.md").read_text(encoding="utf-8")
    row = result.table[0]
    assert f"| {row['f1']:.3f} ± " in page
    assert f"| {row['gospa_m']:.3f} ± {row['gospa_m_sd']:.3f} |" in page
    assert "tracker paper" in page
    assert (tmp_path / "figures" / "methods.svg").is_file()
    shutil.rmtree(tmp_path / "study")
    module.main()
    assert (tmp_path / "results.md").read_text(encoding="utf-8") == page, "what has not been run stays as it was"


def test_the_table_of_the_readme_is_that_of_the_study(write_results):
    """No number there is written by hand."""
    module = write_results
    text = module.README.read_text(encoding="utf-8")
    found = re.search(r"<!-- fewer cars, by make results -->\n(.*?)\n<!-- end of fewer cars -->", text, flags=re.DOTALL)
    page = (module.DOCS / "results.md").read_text(encoding="utf-8")
    lines = found[1].splitlines()
    assert len(lines) == 3 + len(module.README_METHODS)
    for line in lines[2:]:
        for f1, gospa_m in re.findall(r"(\d\.\d{3}), (\d\.\d{3})", line):
            assert re.search(rf"\| {f1} \| {gospa_m} ±", page), line


def test_a_fleet_alone_has_the_detections_it_has_among_others(inputs, tmp_path):
    """Methods with a prior map each fleet by itself, from a folder of its own."""
    study = small(inputs, "dbscan")
    units = tuple(Unit(number, "dbscan-first", 3, tmp_path / "unit.json") for number in (1, 2))
    batch = replace(world_batch(study, study.worlds[0]), units=units)
    fleets = simulate_fleets(batch, tmp_path)
    together = map_fleets(batch, fleets, study.methods[0], 3)
    config = with_settings(study.worlds[0].config, study.methods[0])
    for number in (1, 2):
        aggregate(fleets.of(number), tmp_path / "alone.parquet", config=config, n_vehicles=3)
        assert read_table(SIGNS, tmp_path / "alone.parquet").equals(together[number])
