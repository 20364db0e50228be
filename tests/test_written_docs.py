"""What the documentation repeats from the code is what the code says."""

from __future__ import annotations

import importlib.util
import re
import sys

import pytest

from geofleet.algorithms.metrics import MapScore
from geofleet.formats.results import GEOMETRY_TYPES


@pytest.fixture(scope="module")
def write_docs(repo):
    spec = importlib.util.spec_from_file_location("write_docs", repo / "scripts" / "write_docs.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["write_docs"] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules["write_docs"]


@pytest.mark.parametrize("page", ["evaluation.md", "sql.md"])
def test_pages_are_up_to_date(write_docs, repo, page):
    text = (repo / "docs" / page).read_text(encoding="utf-8")
    assert text == write_docs.fill(page, text), "run: python scripts/write_docs.py"


def test_every_metric_is_documented_in_full(write_docs):
    properties = {name for name, value in vars(MapScore).items() if isinstance(value, property)}
    assert set(write_docs.METRICS) == properties
    for section in write_docs.metrics().split("### ")[1:]:
        if not section.startswith("`null_reason`"):
            for part in ("Range ", "perfect ", "empty", "Paper: "):
                assert part in section


def test_every_file_of_an_evaluation_is_documented(repo):
    page = (repo / "docs" / "evaluation.md").read_text(encoding="utf-8")
    names = set(re.findall(r"`([a-z_]+\.(?:parquet|csv|geojson|gpkg))`", page))
    assert {f"{layer}.geojson" for layer in GEOMETRY_TYPES} <= names
    tables = {"matches.parquet", "scores.parquet", "results.gpkg"}
    assert tables | {f"{name}.csv" for name in ("tiles", "concepts", "confusion", "sources", "summary")} <= names
