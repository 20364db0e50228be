"""Report: what a run found, to look at.

Reads an evaluation and, where the run has them, its lanes, drives, runs, study and manifests; writes one page that
works anywhere (`report.html`), figures for print and a QGIS project.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from geofleet.steps.report.contents import read_contents
from geofleet.steps.report.figures import write_figures
from geofleet.steps.report.page import render_page
from geofleet.steps.report.qgis import PROJECT, write_qgis
from geofleet.steps.report.scene import lay_out
from geofleet.steps.report.study import read_study
from geofleet.tables.manifest import write_manifest
from geofleet.tables.store import atomic_path

if TYPE_CHECKING:
    from pathlib import Path

__all__ = ["PAGE", "PROJECT", "ReportResult", "report"]

PAGE = "report.html"


@dataclass(frozen=True, slots=True)
class ReportResult:
    """The files of a report, what to open first."""

    out: Path
    files: tuple[Path, ...]


def report(
    run_dir: Path,
    out: Path,
    *,
    run_id: str | None = None,
    method: str | None = None,
    n_vehicles: int | None = None,
) -> ReportResult:
    """Write page and figures of a run, and a QGIS project of it.

    Parameters
    ----------
    run_dir
        Folder of a run: an `evaluation`, and beside it lanes, drives and a simulation where there are any.
    out
        Folder to write; the QGIS project goes into the folder `qgis` beside it, which leads to the run's own layers.
    run_id, method, n_vehicles
        The map to draw, when several were scored; by default the largest fleet, and of its maps the one with the
        median GOSPA_M.

    Raises
    ------
    InputError
        The run has no evaluation, or a table of it cannot be read.
    ConfigError
        No such map was scored.
    """
    contents = read_contents(run_dir, run_id=run_id, method=method, n_vehicles=n_vehicles)
    scene, study = lay_out(contents), read_study(run_dir, contents)
    with atomic_path(out) as draft:
        draft.mkdir()
        (draft / PAGE).write_text(render_page(contents, scene, study), encoding="utf-8")
        names = [PAGE, *write_figures(contents, scene, study, draft)]
    project = out.parent / "qgis"
    made = write_qgis(contents, project)
    write_manifest(project, step="report", inputs=contents.inputs)
    write_manifest(out, step="report", inputs=[*contents.inputs, *study.inputs])
    files = (out / PAGE, project / PROJECT)
    rest = (*(out / name for name in names[1:]), *(project / name for name in made[1:]))
    return ReportResult(out, (*files, *rest))
