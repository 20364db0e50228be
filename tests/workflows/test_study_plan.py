"""How many passes? Found, not found with the reason, and told by tile."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pyogrio
import pytest

from geofleet.errors import ConfigError
from geofleet.workflows.study.answers import parse_target
from geofleet.workflows.study.limits import PARTS
from geofleet.workflows.study.methods import parse_methods
from geofleet.workflows.study.plan import plan
from geofleet.workflows.study.results import totals
from geofleet.workflows.study.units import run_study
from geofleet.workflows.study.worlds import Study, prepare_worlds

RAW = Path(__file__).parents[2] / "data" / "raw"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("plan")


def study(folder, *settings, sizes=(16,), n_replicates=2, methods="dbscan", **options):
    worlds = prepare_worlds(
        RAW / "helsinki.osm.pbf", [RAW / "helsinki_derived.pos"], ["paper"], folder, settings=settings
    )
    return Study(worlds, parse_methods(methods), sizes, n_replicates, **options)


@pytest.mark.slow
def test_the_answer_is_what_a_study_of_that_size_scores(folder, tmp_path):
    target = parse_target("gospa_m=1.2")
    result = plan(study(folder), target, tmp_path / "plan")
    numbers = [json.loads(path.read_text())["needed"] for path in (tmp_path / "plan" / "units").glob("plan-*.json")]
    assert result.needed.n_reached == 2
    assert result.needed.typical == result.needed.safe == max(numbers)
    sizes = sorted({size for n in numbers for size in (n - 1, n) if size})
    rows = totals(run_study(study(folder, sizes=(*sizes, 16)), tmp_path / "study"))
    met = {(row["replicate"], row["n_vehicles"]): target.is_met(row["gospa_m"]) for row in rows}
    assert sorted(min(v for (r, v), is_met in met.items() if r == fleet and is_met) for fleet in (0, 1)) == sorted(
        numbers
    )
    assert result.answer[0].startswith(f"{result.needed.typical} passes reach gospa_m <= 1.2")


def test_parts_add_up_to_the_score_and_tiles_to_the_scene(folder, tmp_path):
    result = plan(study(folder, sizes=(8,)), parse_target("gospa_m=0.01"), tmp_path)
    assert result.needed.n_reached == 0
    assert "No fleet of up to 8 passes" in result.answer[0]
    assert sum(part["share"] for part in result.parts) == pytest.approx(1.0)
    for path in (tmp_path / "units").glob("plan-*.json"):
        found = json.loads(path.read_text())
        (last,) = [one for one in found["seen"] if one["n_vehicles"] == 8]
        (whole,) = [row for row in last["rows"] if row["tile"] == "all"]
        (parts,) = [row for row in found["parts"] if row["tile"] == "all"]
        assert sum(parts[name] for name in PARTS) / parts["tp"] == pytest.approx(whole["gospa_m"] ** 2)
        assert sum(row["n_signs"] for row in found["parts"]) == 2 * 33
    assert sum(row["n_signs"] for row in result.tiles) == 33
    assert {path.name for path in result.files} == {
        *("parts.csv", "plan.json", "scores.csv", "tiles.csv", "tiles.geojson"),
    }
    assert pyogrio.read_info(tmp_path / "plan" / "tiles.geojson")["features"] == len(result.tiles)


def test_signs_never_in_view_put_a_target_out_of_reach(folder, tmp_path):
    near = study(folder, "range_m=15", sizes=(4,))
    result = plan(near, parse_target("recall=0.95"), tmp_path)
    assert result.needed.typical is None
    assert result.floor.n_never_in_view > 5
    assert result.floor.score < 0.95
    assert any("out of reach whatever the number of passes" in line for line in result.answer)
    assert f"Of 33 signs, no pass has {result.floor.n_never_in_view} in view" in "\n".join(result.answer)
    assert "--method" not in result.answer[-1], "no method finds what nobody saw"
    seen = plan(study(folder, "range_m=15", sizes=(4,), in_view=True), parse_target("recall=0.95"), tmp_path / "seen")
    assert seen.floor.n_never_in_view == 0


def test_neighbours_that_clustering_merges_are_counted(folder, tmp_path):
    result = plan(study(folder, "eps_m=12", sizes=(4,), n_replicates=1), parse_target("gospa_m=0.1"), tmp_path)
    assert result.floor.n_merged > 1
    assert "--method joint" in result.answer[-1]
    assert np.isclose(result.floor.score, np.sqrt(2 * result.floor.n_merged / (33 - result.floor.n_merged)))


@pytest.mark.parametrize("wrong", ["gospa_m", "gospa=1", "gospa_m=0", "f1=1.2", "f1=-1", "speed=3"])
def test_a_target_is_a_score_and_a_number(wrong):
    with pytest.raises(ConfigError, match="--target"):
        parse_target(wrong)


def test_a_plan_is_for_one_method(folder, tmp_path):
    with pytest.raises(ConfigError, match="one drive, one scenario and one method"):
        plan(study(folder, methods="dbscan,kmeans"), parse_target("f1=0.9"), tmp_path)
