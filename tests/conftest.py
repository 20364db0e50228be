from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import build_table

# No clock: a busy machine is no failure. No luck: the same examples every time.
settings.register_profile("geofleet", deadline=None, derandomize=True)
settings.load_profile("geofleet")

HELSINKI = EnuFrame(24.9450453, 60.1677108)
REPO = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def repo() -> Path:
    return REPO


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Real files whose licences keep them out of the repository."""
    folder = REPO.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"the real files in {folder} are not on this machine")
    return folder


@pytest.fixture(scope="session")
def make_signs():
    """Make a `signs` table of main signs from metres east and north of a point in Helsinki."""

    def make(xy_m, classes, **columns):
        xy = np.asarray(xy_m, float).reshape(-1, 2)
        concepts = [c.partition(":")[0] for c in classes]
        given = {"sign_id": [f"s{i}" for i in range(len(xy))], "kind": "main", "concept": concepts}
        given |= {"sign_class": list(classes), "raw_code": list(classes), "source": "test", "source_ref": "none"}
        return build_table(SIGNS, given | columns, geometry=HELSINKI.to_lonlat(xy))

    return make
