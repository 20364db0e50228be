"""What a page says: every number with its unit, every gap with its reason."""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from geofleet.steps.report.contents import Contents
    from geofleet.steps.report.scene import Scene
    from geofleet.steps.report.study import Study

OSM_NOTICE = "Map data © OpenStreetMap contributors, Open Database License (ODbL)."
NOTHING = "\N{EN DASH}"
_MOST_TILES, _MOST_PASSES, _MOST_ROWS = 12, 12, 40
_SECTIONS = (
    ("map", "Map"),
    ("tiles", "Worst tiles"),
    ("errors", "Errors"),
    ("classes", "Classes"),
    ("passes", "Passes"),
    ("fleet", "How many vehicles?"),
    ("scores", "Scores"),
    ("provenance", "Where it comes from"),
)
_CARDS = (
    ("gospa_m", "GOSPA_M", "m"),
    ("f1", "F1", ""),
    ("precision", "Precision", ""),
    ("recall", "Recall", ""),
    ("rmse_m", "RMSE_M", "m"),
)
_COLUMNS = (
    ("run_id", "run"),
    ("method", "method"),
    ("n_vehicles", "vehicles"),
    ("tp", "TP"),
    ("fp", "FP"),
    ("fn", "FN"),
    ("precision", "precision"),
    ("recall", "recall"),
    ("f1", "F1"),
    ("rmse_m", "RMSE_M (m)"),
    ("gospa", "GOSPA (m)"),
    ("gospa_m", "GOSPA_M (m)"),
)


def describe(contents: Contents, scene: Scene, study: Study) -> dict[str, Any]:
    """Return every text and table of the page, by its name in the template."""
    shown = contents.shown
    return {
        "version": metadata.version("geofleet"),
        "title": title(contents),
        "badges": _badges(contents),
        "subtitle": subtitle(contents),
        "sections": [section for section in _SECTIONS if section[0] != "passes" or contents.nuisance],
        "cards": _cards(contents),
        "score_note": _score_note(contents),
        "map_note": _map_note(contents, scene),
        "half_gate": _plain(shown["gate_m"] ** 2 / 2),
        "gate": _plain(shown["gate_m"]),
        "tiles": [_tile(tile, shown) for tile in scene.tiles[:_MOST_TILES]],
        "n_more_tiles": max(0, scene.n_tiles - _MOST_TILES),
        "errors_note": _errors_note(scene),
        "classes_note": "what has no partner is in the last column (missed) and the last row (not in the reference).",
        "passes_note": _passes_note(contents),
        "passes": [_pass(row) for row in contents.nuisance[:_MOST_PASSES]],
        "n_more_passes": max(0, len(contents.nuisance) - _MOST_PASSES),
        "curves_note": _curves_note(study),
        "no_curves": _NO_CURVES,
        **_scores(contents),
        "provenance": _provenance(contents),
        "runs": contents.runs[:_MOST_ROWS],
        "steps": [_step(path, manifest) for path, manifest in contents.manifests],
        "versions": _versions(manifest for _, manifest in contents.manifests),
        "footer": " ".join(
            [f"geofleet {metadata.version('geofleet')}.", *([OSM_NOTICE] if contents.is_from_osm else [])]
        ),
    }


_NO_CURVES = (
    "No study is here and the evaluation has one fleet size, so there is no curve. geofleet study fleet-size "
    "--out RUN_DIR/study simulates fleets of 5 to 50 vehicles; then report RUN_DIR again."
)


def title(contents: Contents) -> str:
    """Name the map and its fleet."""
    shown, run = contents.shown, contents.run
    size = shown["n_vehicles"]
    if _is_empty(contents):
        return "Empty sign map"
    if run is not None:
        return f"Sign map of {size} simulated vehicles"
    return f"Sign map of {size} vehicles" if size else "Sign map"


def subtitle(contents: Contents) -> str:
    """Say how the map was made and what it was scored against."""
    shown, run = contents.shown, contents.run
    parts = [] if _is_empty(contents) else [f"method {shown['method']}"]
    if run is not None:
        parts.append(f"scenario {run['scenario']}, tracker {run['tracker']}, upload {run['upload']}")
    n = shown["tp"] + shown["fn"]
    sources = sorted(set(contents.reference.get("source", ())))
    parts.append(f"scored against {n} signs" + (f" of {', '.join(sources[:3])}" if sources else ""))
    return " · ".join(parts)


def _is_empty(contents: Contents) -> bool:
    """Tell whether the map has no sign: it then knows neither its method nor its fleet."""
    return not (contents.shown["tp"] or contents.shown["fp"])


def _badges(contents: Contents) -> list[dict[str, Any]]:
    """Label what is not recorded."""
    badges = []
    if contents.run is not None:
        badges.append({"text": "simulated detections", "warns": True})
    if contents.is_drive_derived:
        badges.append({"text": "derived drive", "warns": True})
    return badges


def _cards(contents: Contents) -> list[dict[str, str]]:
    """Return a card a score, with its interval, and one of the counts."""
    shown = contents.shown
    cards = []
    for name, label, unit in _CARDS:
        interval = _interval(contents, name)
        note = f"95 %: {float(interval['low']):.2f} to {float(interval['high']):.2f}" if interval else "no interval"
        if interval and _n_runs(contents) > 1:  # the score is that of the run drawn, the interval that of all runs
            note = f"mean of {_n_runs(contents)} runs {float(interval['estimate']):.3f}, {note}"
        if shown[name] is None:
            note = shown["null_reason"] or ""
        cards.append({"name": label, "value": _number(shown[name], 3), "unit": unit, "note": note})
    counts = f"{shown['tp']} / {shown['fp']} / {shown['fn']}"
    return [*cards, {"name": "TP / FP / FN", "value": counts, "unit": "", "note": "found / false / missed signs"}]


def _n_runs(contents: Contents) -> int:
    """Return how many runs of the map's method and fleet size were scored."""
    labels = [(total["method"], total["n_vehicles"]) for total in contents.totals]
    return labels.count((contents.shown["method"], contents.shown["n_vehicles"]))


def _interval(contents: Contents, score: str) -> Mapping[str, Any] | None:
    """Return the first interval that a score has."""
    return next((row for row in contents.intervals if row["score"] == score and row["low"]), None)


def _score_note(contents: Contents) -> str:
    """Say what a score means, and what its interval is for."""
    shown = contents.shown
    first = (
        f"GOSPA_M = √(MSE_M + c²/2 · (FN + FP) / TP) with c = {_plain(shown['gate_m'])} m: 0 for a perfect map, "
        f"smaller is better. A match is nearer than c and agrees in {_MATCH_ON[shown['match_on']]}. "
    )
    if _n_runs(contents) > 1:
        first += f"The scores are those of the map drawn, of {_n_runs(contents)} runs the one with the median GOSPA_M. "
    interval = _interval(contents, "gospa_m")
    if interval is None:
        return first + "GOSPA_M has no interval: intervals.csv says why."
    estimand = interval["estimand"].replace("gospa_m", "score")
    note = f" Beware: {interval['note']}." if interval["note"] else ""
    return f"{first}Intervals are for {estimand} ({interval['interval_method']}).{note}"


_MATCH_ON = {"class": "class", "concept": "concept", "none": "nothing else"}


def _map_note(contents: Contents, scene: Scene) -> str:
    """Explain the map's marks and say what is left out of it."""
    sentences = ["East and north in metres."]
    if scene.n_outcomes > len(scene.outcomes):
        sentences.append(f"Of {scene.n_outcomes:,} signs the {len(scene.outcomes):,} of the worst tiles are drawn.")
    if contents.lanes is None:
        sentences.append("The run has no lanes table, so no roads are drawn.")
    if contents.drives is None:
        sentences.append("The run has no drives table, so no drive is drawn.")
    if not scene.ellipses:
        sentences.append("The map says nothing about its errors, so there are no ellipses.")
    tiles = "Tiles are shaded by GOSPA_M, light (good) to dark, and hatched where nothing matched."
    return " ".join([*sentences, tiles, *([OSM_NOTICE] if contents.is_from_osm else [])])


def _tile(tile: Mapping[str, Any], shown: Mapping[str, Any]) -> dict[str, Any]:
    low, high = tile["ring"].min(axis=0), tile["ring"].max(axis=0)
    total = shown["gospa"] ** 2
    return {
        **{name: tile[name] for name in ("tile", "tp", "fp", "fn")},
        **{name: _number(tile[name], 3) for name in ("gospa_m", "f1", "rmse_m")},
        "share": f"{tile['gospa'] ** 2 / total:.0%}" if total else NOTHING,
        "box": f"{low[0]:.1f} {low[1]:.1f} {high[0]:.1f} {high[1]:.1f}",
    }


def _errors_note(scene: Scene) -> str:
    if scene.shift_m is None:
        return ""
    east, north = scene.shift_m
    text = f"On average the map lies {abs(east):.2f} m {'east' if east >= 0 else 'west'} and {abs(north):.2f} m "
    text += f"{'north' if north >= 0 else 'south'} of its reference. "
    if scene.n_with_ellipse:
        share = scene.n_inside / scene.n_with_ellipse
        text += f"{scene.n_inside} of {scene.n_with_ellipse} found signs ({share:.0%}) have their reference inside "
        text += "their 95 % error ellipse."
    return text


def _passes_note(contents: Contents) -> str:
    """Say how many passes are not what they declare."""
    passes = [row for row in contents.nuisance if row["n_detections"]]  # the prior map has a row as well
    n, n_suspect = len(passes), sum(row["is_suspect"] for row in passes)
    text = (
        "What joint fusion found that all detections of a pass have in common, and took out of them. "
        "Alone: detections of signs that no other pass reports although three or more had them in view. "
    )
    if not n_suspect:
        return f"{text}All {n} are as they declare."
    return f"{text}{n_suspect} of {n} are far from what they declare (*): have the car looked at."


def _pass(row: Mapping[str, Any]) -> dict[str, Any]:
    numbers = ("offset_e_m", "offset_n_m", "range_bias_m", "bearing_bias_deg", "noise_factor", "jitter_m")
    name = f"{row['pass_id']} *" if row["is_suspect"] else row["pass_id"]
    return {"name": name, **{k: row[k] for k in ("sensor_kind", "n_detections", "n_alone")}} | {
        k: _number(row[k], 2) for k in numbers
    }


def _curves_note(study: Study) -> str:
    runs = max((curve.n_runs for curve in study.curves), default=0)
    text = f"Mean over up to {runs} runs, from {study.source}; bands are 95 % intervals of the mean, bars one sd."
    return text + (" Diamonds are the paper's own points, with its sd." if study.paper else "")


def _scores(contents: Contents) -> dict[str, Any]:
    """Return the table of scores, the map drawn first."""
    totals = sorted(contents.totals, key=lambda total: total is not contents.shown)
    rows = [
        {"shown": total is contents.shown, "cells": [_cell(total[name]) for name, _ in _COLUMNS]}
        for total in totals[:_MOST_ROWS]
    ]
    several = "One row a run, method and fleet size; the map drawn above is marked."
    return {
        "scores_note": several if len(totals) > 1 else "Over all tiles and concepts.",
        "score_columns": [{"name": label, "text": name in ("run_id", "method")} for name, label in _COLUMNS],
        "score_rows": rows,
        "n_more_scores": max(0, len(totals) - _MOST_ROWS),
    }


def _provenance(contents: Contents) -> list[str]:
    """Say what is real and what is not."""
    sentences = []
    if contents.run is not None:
        sentences.append("The detections are simulated, of the signs of the reference.")
    else:
        sentences.append("No table here says that anything was simulated.")
    if contents.is_drive_derived:
        sentences.append("The drive is derived from the road graph; nobody recorded it.")
    if not contents.manifests:
        sentences.append("There are no manifests, so inputs and versions are not known.")
    return [" ".join(sentences)]


def _step(path: str, manifest: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "name": manifest["step"],
        "path": path,
        "inputs": manifest["inputs"],
        "digest": manifest["config_digest"],
        "settings": sorted(_flat(manifest["settings"])),
    }


def _flat(settings: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, str]]:
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", str(value)


def _versions(manifests: Iterable[Mapping[str, Any]]) -> str:
    """Return the versions that the steps ran with; of a package that changed in between, all of them."""
    found: dict[str, set[str]] = {}
    for manifest in manifests:
        for name, version in manifest["versions"].items():
            found.setdefault(name, set()).add(version)
    if not found:
        return ""
    return "Versions: " + ", ".join(f"{name} {' and '.join(sorted(found[name]))}" for name in sorted(found)) + "."


def _cell(value: Any) -> str:
    return _number(value, 4) if isinstance(value, float) else NOTHING if value is None else str(value)


def _number(value: float | None, digits: int) -> str:
    return NOTHING if value is None else f"{value:.{digits}f}"


def _plain(value: float) -> str:
    """Return a setting without needless zeros: 2, 0.5."""
    return f"{value:g}"
