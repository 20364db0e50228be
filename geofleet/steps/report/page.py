"""The page of a report: one HTML file with its figures, their data and BokehJS inside, so that it works anywhere."""

from __future__ import annotations

import html
import json
import re
from importlib.resources import files
from itertools import count
from typing import TYPE_CHECKING, Any

from geofleet.steps.report import interactive, wording
from geofleet.steps.report.statistics import count_confusion

if TYPE_CHECKING:
    from collections.abc import Mapping

    from bokeh.model import Model

    from geofleet.steps.report.contents import Contents
    from geofleet.steps.report.scene import Scene
    from geofleet.steps.report.study import Study

_MODEL_ID = re.compile(r"p\d+")


def render_page(contents: Contents, scene: Scene, study: Study) -> str:
    """Return the page as HTML; the same run gives the same text."""
    from jinja2 import Environment  # noqa: PLC0415  (loaded when a report is written only)
    from markupsafe import Markup  # noqa: PLC0415

    figures = _draw(contents, scene, study)
    document, roots = _serialise(figures)
    places = {name: Markup(f'<div id="gf-{html.escape(name)}"></div>') for name in figures}  # noqa: S704 (our own text)
    curves = [place for name, place in places.items() if name.startswith("curve_")]
    template = files("geofleet.steps.report").joinpath("page.html").read_text(encoding="utf-8")
    page = Environment(autoescape=True, trim_blocks=False).from_string(template)
    return page.render(
        wording.describe(contents, scene, study),
        plots=places | {"curves": curves},
        bokeh_js=Markup(_bokeh_js()),  # noqa: S704 (BokehJS as its wheel ships it)
        document_json=Markup(_script_text({"document": document, "roots": roots})),  # noqa: S704 (escaped there)
    )


def _draw(contents: Contents, scene: Scene, study: Study) -> dict[str, Model]:
    """Return the figures of the page by name; those that would be empty are left out."""
    gate_m = contents.shown["gate_m"]
    confusion = count_confusion(contents)
    figures = {"map": interactive.draw_map(scene)}
    if len(scene.distance_m):
        figures["errors"] = interactive.draw_errors(scene, gate_m)
        figures["offsets"] = interactive.draw_offsets(scene, gate_m)
    if confusion.counts.any():
        figures["confusion"] = interactive.draw_confusion(confusion)
    for score in study.scores:
        figures[f"curve_{score}"] = interactive.draw_curves(study, score)
    return figures


def _serialise(figures: Mapping[str, Model]) -> tuple[Any, dict[str, str]]:
    """Return the figures as one document, and the element that each of its roots goes into.

    Bokeh numbers its models through the life of a process; here they are numbered anew.
    """
    from bokeh.document import Document  # noqa: PLC0415

    document = Document()
    for figure in figures.values():
        document.add_root(figure)
    numbers, new_ids = count(), {}

    def renumber(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: rename(part) if key == "id" else renumber(part) for key, part in value.items()}
        return [renumber(part) for part in value] if isinstance(value, list | tuple) else value

    def rename(value: Any) -> Any:
        if not isinstance(value, str) or not _MODEL_ID.fullmatch(value):
            return renumber(value)
        if value not in new_ids:
            new_ids[value] = f"p{next(numbers)}"
        return new_ids[value]

    content = renumber(document.to_json(deferred=False))
    return content, {new_ids[figure.id]: f"gf-{name}" for name, figure in figures.items()}


def _script_text(value: Any) -> str:
    """Return JSON that may stand in a script element."""
    return json.dumps(value, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")


def _bokeh_js() -> str:
    """Return BokehJS from the wheel; no address of a map service is ever asked."""
    from bokeh.resources import INLINE  # noqa: PLC0415

    text: str = INLINE.js_raw[0]
    return text
