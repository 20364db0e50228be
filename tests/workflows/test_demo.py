"""The main job on the shipped data, from files to scores: golden figures, and the same bytes every time."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np
import pyarrow.compute as pc
import pytest
from matplotlib.image import imread

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.cli.output import print_scores
from geofleet.config import load_config
from geofleet.steps.aggregate import aggregate
from geofleet.tables.manifest import hash_path
from geofleet.tables.schemas import DETECTIONS, DRIVES, MATCHES, PASSES, REFERENCE, RUNS, SCHEMAS, SCORES, SIGNS, TRUTH
from geofleet.tables.store import lonlat, read_table
from geofleet.workflows.demo import N_VEHICLES, demo_result, run_demo

if TYPE_CHECKING:
    from pathlib import Path

# 30 found, 1 false, 3 missed of 33 signs; seed 0, 50 vehicles
GOLDEN_F1 = 15 / 16
GOLDEN_GOSPA_M = 0.657624
TABLES = {
    "signs/signs.parquet": "signs",
    "lanes/lanes.parquet": "lanes",
    "drives/drives.parquet": "drives",
    "simulation/runs.parquet": "runs",
    "simulation/reference.parquet": "reference",
    "simulation/passes.parquet": "passes",
    "simulation/detections": "detections",
    "simulation/truth": "truth",
    "fused/fused.parquet": "signs",
    "evaluation/matches.parquet": "matches",
    "evaluation/scores.parquet": "scores",
}


@pytest.fixture(scope="module")
def demo(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("demo")
    run_demo(out, n_workers=2)
    return out


def test_golden_scores(demo):
    (total,) = demo_result(demo).totals
    assert total["n_vehicles"] == N_VEHICLES
    assert total["f1"] == pytest.approx(GOLDEN_F1, abs=1e-6)
    assert total["gospa_m"] == pytest.approx(GOLDEN_GOSPA_M, abs=1e-6)


def test_the_readme_shows_what_the_demo_prints(demo, repo, capsys):
    """All but the digits of the run's id, which name its settings and inputs: any new setting changes them."""
    print_scores(demo_result(demo).totals)
    shown, printed = (
        re.sub(r"(?m)^(paper-s0-r0-)[0-9a-f]{8}", r"\1xxxxxxxx", text)
        for text in ((repo / "README.md").read_text(encoding="utf-8"), capsys.readouterr().out)
    )
    assert printed.count("\n") == 2
    assert printed in shown


@pytest.mark.parametrize(("path", "name"), TABLES.items())
def test_every_table_has_its_schema(demo, path, name):
    assert read_table(SCHEMAS[name], demo / path).num_rows > 0


def test_the_scene_is_the_one_described(demo):
    reference = read_table(REFERENCE, demo / "simulation" / "reference.parquet")
    assert reference.num_rows == 33
    assert pc.count_distinct(reference["sign_class"]).as_py() == 14
    assert pc.min(reference["n_passes_in_view"]).as_py() > 0
    drive = read_table(DRIVES, demo / "drives" / "drives.parquet")
    xy = EnuFrame.around(*lonlat(drive)).to_enu(*lonlat(drive))
    length_m = ((xy[1:] - xy[:-1]) ** 2).sum(axis=1) ** 0.5
    assert 1100 < length_m.sum() < 1300
    assert set(drive["fix_quality"].to_pylist()) == {"derived"}


def test_tables_agree_with_each_other(demo):
    runs = read_table(RUNS, demo / "simulation" / "runs.parquet")
    detections = read_table(DETECTIONS, demo / "simulation" / "detections")
    truth = read_table(TRUTH, demo / "simulation" / "truth")
    passes = read_table(PASSES, demo / "simulation" / "passes.parquet")
    keys = ["run_id", "pass_id", "track_id"]
    assert detections.select(keys).equals(truth.select(keys))
    assert set(detections["pass_id"].to_pylist()) <= set(passes["pass_id"].to_pylist())
    assert passes.num_rows == runs["n_vehicles"][0].as_py() == N_VEHICLES
    fused = read_table(SIGNS, demo / "fused" / "fused.parquet")
    matches = read_table(MATCHES, demo / "evaluation" / "matches.parquet")
    assert set(filter(None, matches["fused_id"].to_pylist())) == set(fused["sign_id"].to_pylist())
    (total,) = (
        read_table(SCORES, demo / "evaluation" / "scores.parquet")
        .filter((pc.field("tile") == "all") & (pc.field("concept") == "all"))
        .to_pylist()
    )
    assert total["tp"] + total["fp"] == fused.num_rows
    assert total["tp"] + total["fn"] == 33


def test_one_worker_gives_the_same_bytes(demo, tmp_path):
    run_demo(tmp_path, n_workers=1)
    assert hash_path(tmp_path) == hash_path(demo)


def test_results_do_not_need_the_truth(demo, tmp_path):
    truth = demo / "simulation" / "truth"
    hidden = tmp_path / "truth"
    truth.rename(hidden)
    try:
        aggregate(demo / "simulation" / "detections", tmp_path / "fused.parquet", config=load_config())
    finally:
        hidden.rename(truth)
    assert hash_path(tmp_path / "fused.parquet") == hash_path(demo / "fused" / "fused.parquet")


def test_the_picture_of_the_readme_is_the_demos_map(demo, repo):
    """A font may be drawn a little differently elsewhere; another map would differ in far more than a hundredth."""
    shown, made = (imread(path)[..., :3] for path in (repo / "docs" / "demo.png", demo / "report" / "map.png"))
    assert shown.shape == made.shape, "cp data/processed/report/map.png docs/demo.png"
    assert np.abs(shown - made).mean() < 0.01, "cp data/processed/report/map.png docs/demo.png"
