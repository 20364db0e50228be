"""The wheel carries what the checkout has beside the package: SQL, shipped data, scenarios, taxonomy."""

from __future__ import annotations

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

REPO = Path(__file__).parent.parent


def run(*command, cwd, **environment):
    result = subprocess.run(  # noqa: S603 (our own commands)
        [str(part) for part in command],
        cwd=cwd,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.mark.slow
def test_the_demo_runs_from_the_wheel_alone(tmp_path):
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", tmp_path, cwd=REPO)
    (wheel,) = tmp_path.glob("geofleet-*.whl")
    site = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    where = run(sys.executable, "-c", "import geofleet; print(geofleet.__file__)", cwd=tmp_path, PYTHONPATH=str(site))
    assert Path(where.strip()).is_relative_to(site)
    shown = run(sys.executable, "-m", "geofleet", "demo", "--out", "demo", cwd=tmp_path, PYTHONPATH=str(site))
    assert "0.6576" in shown  # GOSPA_M of tests/workflows/test_demo.py
    assert (tmp_path / "demo" / "report" / "report.html").stat().st_size > 1_000_000  # with BokehJS inside
