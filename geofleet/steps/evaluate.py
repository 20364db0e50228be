"""Evaluate: match a map to its reference, one to one, and score it.

Reads two layers of signs; writes `matches` and `scores`, tables of them as CSV, and layers for GIS tools.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.algorithms.extent import is_within_reach
from geofleet.algorithms.metrics import MapScore
from geofleet.errors import ConfigError
from geofleet.formats.layers import read_drives, read_layer
from geofleet.formats.results import write_csv, write_result_layers
from geofleet.tables.certainty import comparison_rows, interval_rows
from geofleet.tables.manifest import write_manifest
from geofleet.tables.matching import class_confusion, match_layers, match_signs
from geofleet.tables.scenes import load_drive
from geofleet.tables.schemas import BBOX, GEOMETRY, MATCHES, REFERENCE, SCORES
from geofleet.tables.scoring import (
    missed_requirements,
    parse_requirements,
    score_matches,
    score_row,
    summarise_scores,
)
from geofleet.tables.store import atomic_path, lonlat, read_table, write_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from geofleet.algorithms.metrics import MatchOn
    from geofleet.config import Config, EvaluateConfig
    from geofleet.tables.scenes import Drive

    Ints = NDArray[np.int64]

__all__ = [
    "EvaluateResult",
    "evaluate",
    "missed_requirements",
    "parse_requirements",
    "score_layers",
    "score_matches",
]

CLIP_M = 100.0  # signs of a town stand 7 to 30 m apart: 100 m without one is a place that the map does not cover
_LABELS = ("run_id", "method", "n_vehicles")


@dataclass(frozen=True, slots=True)
class EvaluateResult:
    """What an evaluation found, and the files that hold it.

    Parameters
    ----------
    out
        The folder written.
    totals
        Rows of `scores` over all tiles and concepts, one a run, method and fleet size.
    files
        Everything in the folder but the manifest.
    tiles, concepts
        Rows of `scores` a tile and a concept.
    confusion
        How often a reference class stands in the map as which class, of signs that match by position.
    sources
        Scores of every source of the map alone, when it has several.
    summary
        Mean, standard deviation and number of nulls of every score over the runs.
    intervals
        Interval of every score, with its estimand in words: over runs when there are several, else along the road.
    comparisons
        Of the map with another one: difference of every score, interval, p-value and verdict.
    counts
        Signs left out by `--clip` and `--in-view`, signs that `--clip` would leave out, and signs without an error
        ellipse.
    """

    out: Path
    totals: tuple[dict[str, Any], ...]
    files: tuple[Path, ...]
    tiles: tuple[dict[str, Any], ...] = ()
    concepts: tuple[dict[str, Any], ...] = ()
    confusion: tuple[dict[str, Any], ...] = ()
    sources: tuple[dict[str, Any], ...] = ()
    summary: tuple[dict[str, Any], ...] = ()
    intervals: tuple[dict[str, Any], ...] = ()
    comparisons: tuple[dict[str, Any], ...] = ()
    counts: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """One map and its reference: labels, the rows of either layer that are scored, and their signs."""

    labels: dict[str, Any]
    rows: Ints
    ref_rows: Ints
    fused: pa.Table
    reference: pa.Table


def evaluate(
    map_path: Path,
    reference_path: Path,
    out: Path,
    *,
    config: Config,
    clip_m: float | None = None,
    in_view: bool = False,
    drive_path: Path | None = None,
    versus_path: Path | None = None,
) -> EvaluateResult:
    """Score the main signs of a map against those of a reference and write tables and GIS layers.

    Every run in the map is matched to the reference signs of the same run; a reference without runs serves every run.

    Parameters
    ----------
    map_path, reference_path
        Layers of signs, in any format that `read_layer` knows.
    out
        Folder to write.
    config
        Its section `evaluate`, and `tile_zoom`.
    clip_m
        Score only signs with a sign of the other layer within this distance, metres; all signs by default.
    in_view
        Score only reference signs that some pass had in view; the reference must be a `reference` table.
    drive_path
        A drive in any format that `read_drives` knows: intervals take stretches of road along it.
    versus_path
        Another map: test whether the first is better, on the same reference.

    Raises
    ------
    InputError
        A layer cannot be read.
    ConfigError
        The map and the reference have no run in common.
    """
    gate_m, match_on = config.evaluate.gate_m, config.evaluate.match_on
    map_ = _main_signs(read_layer(map_path).table)
    whole = _main_signs(read_table(REFERENCE, reference_path) if in_view else read_layer(reference_path).table)
    reference = whole.filter(pc.field("n_passes_in_view") > 0) if in_view else whole
    pairs = list(_pairs(map_, reference, clip_m=clip_m))
    matches = _match_pairs(pairs, config)
    scores = score_matches(matches, gate_m=gate_m, match_on=match_on)
    drive = load_drive(read_drives(drive_path).table, drive_path) if drive_path else None
    used, ref_used = _used_rows(pairs, map_.num_rows, reference.num_rows)
    layers = {
        "fused": map_.filter(used),
        "labels": _labels(map_).filter(used),
        "reference": reference.filter(ref_used),
        "matches": matches,
        "scores": scores,
    }
    more = {
        **_rows_of_parts(scores),
        "confusion": _confusion(pairs, gate_m=gate_m),
        "sources": _score_sources(pairs, gate_m=gate_m, match_on=match_on),
        "summary": summarise_scores(_totals(scores)),
        "intervals": interval_rows(matches, _totals(scores), drive=drive, **_along(config)),
        "comparisons": _compare(matches, scores, versus_path, reference, drive, clip_m=clip_m, config=config),
    }
    files, n_without = _write(out, layers, more)
    counts = {
        "map_signs_clipped": map_.num_rows - layers["fused"].num_rows,
        "reference_signs_clipped": reference.num_rows - layers["reference"].num_rows,
        **_far(map_, reference, clip_m),
        "reference_signs_never_in_view": whole.num_rows - reference.num_rows,
        "map_signs_without_ellipse": n_without,
    }
    write_manifest(
        out,
        step="evaluate",
        inputs=[path for path in (map_path, reference_path, drive_path, versus_path) if path],
        config_digest=config.digest("evaluate"),
        settings=config.evaluate.model_dump() | {"clip_m": clip_m, "in_view": in_view},
        counts={"matches": matches.num_rows, "scores": scores.num_rows, **counts},
    )
    rows = {name: tuple(part) for name, part in more.items()}
    return EvaluateResult(out=out, totals=_totals(scores), files=files, counts=counts, **rows)


def _along(config: Config) -> dict[str, float]:
    return config.evaluate.model_dump(include={"gate_m", "correlation_m"})


def _far(map_: pa.Table, reference: pa.Table, clip_m: float | None) -> dict[str, int]:
    """Count the signs that `--clip` would leave out: many are a map and a reference of different places."""
    if clip_m is not None:
        return {}
    near, ref_near = _used_rows(list(_pairs(map_, reference, clip_m=CLIP_M)), map_.num_rows, reference.num_rows)
    return {
        "map_signs_far_from_reference": near.false_count,
        "reference_signs_far_from_map": ref_near.false_count,
    }


def _compare(
    matches: pa.Table,
    scores: pa.Table,
    versus_path: Path | None,
    reference: pa.Table,
    drive: Drive | None,
    *,
    clip_m: float | None,
    config: Config,
) -> list[dict[str, Any]]:
    """Compare the map with another one; nothing without one."""
    if versus_path is None:
        return []
    gate_m, match_on = config.evaluate.gate_m, config.evaluate.match_on
    other = _main_signs(read_layer(versus_path).table)
    other_matches = _match_pairs(list(_pairs(other, reference, clip_m=clip_m)), config)
    other_scores = score_matches(other_matches, gate_m=gate_m, match_on=match_on)
    totals = (_totals(scores), _totals(other_scores))
    return comparison_rows((matches, other_matches), totals, drive=drive, **_along(config))


def score_layers(map_: pa.Table, reference: pa.Table, *, config: EvaluateConfig) -> MapScore:
    """Score the main signs of one map against those of one reference, both `signs` tables.

    Raises
    ------
    ConfigError
        A layer holds more than one run, method or fleet size.
    """
    for name, layer in (("map", map_), ("reference", reference)):
        n_groups = _labels(layer).group_by(["run_id", "method", "n_vehicles"]).aggregate([]).num_rows
        if n_groups > 1:
            raise ConfigError(f"the {name} holds {n_groups} runs, methods or fleet sizes.", todo="Score one at a time.")
    fused, ref = _main_signs(map_), _main_signs(reference)
    return _score(fused, ref, gate_m=config.gate_m, match_on=config.match_on)


def _score(fused: pa.Table, ref: pa.Table, *, gate_m: float, match_on: MatchOn) -> MapScore:
    matching = match_signs(fused, ref, gate_m=gate_m, match_on=match_on)
    return MapScore(
        tp=len(matching),
        fp=fused.num_rows - len(matching),
        fn=ref.num_rows - len(matching),
        sum_sq_error_m2=matching.sum_sq_error_m2,
        gate_m=gate_m,
        match_on=match_on,
        matches=matching,
    )


def _main_signs(layer: pa.Table) -> pa.Table:
    return layer.filter(pc.field("kind") == "main")


def _labels(layer: pa.Table) -> pa.Table:
    """Return run, method and fleet size of every row; a layer from elsewhere is one group."""
    n = layer.num_rows
    names = layer.column_names
    run_id = layer["run_id"] if "run_id" in names else pa.nulls(n, pa.string())
    method = layer["method"] if "method" in names else pa.nulls(n, pa.string())
    size = layer["n_vehicles"] if "n_vehicles" in names else pa.nulls(n, pa.int64())
    return pa.table({"run_id": run_id, "method": pc.fill_null(method, "given"), "n_vehicles": pc.fill_null(size, 0)})


def _pairs(map_: pa.Table, reference: pa.Table, *, clip_m: float | None) -> Iterator[_Pair]:
    """Yield every run, method and fleet size of the map with the reference signs of its run, in sorted order.

    A run of the reference that the map has nothing of is scored against an empty map.
    """
    labels, ref_runs = _labels(map_), _labels(reference)["run_id"]
    for group in _groups(labels, set(ref_runs.to_pylist())):
        same = pc.and_(
            pc.and_(pc.equal(labels["method"], group["method"]), pc.equal(labels["n_vehicles"], group["n_vehicles"])),
            _equal_or_null(labels["run_id"], group["run_id"]),
        )
        own = pc.or_(pc.is_null(ref_runs), _equal_or_null(ref_runs, group["run_id"]))
        every = group["run_id"] is None or ref_runs.null_count > 0
        rows = np.flatnonzero(same.to_numpy())
        ref_rows = np.arange(reference.num_rows) if every else np.flatnonzero(own.to_numpy())
        if clip_m is not None:
            rows, ref_rows = _clip(map_, rows, reference, ref_rows, clip_m)
        yield _Pair(group, rows, ref_rows, map_.take(pa.array(rows)), reference.take(pa.array(ref_rows)))


def _groups(labels: pa.Table, ref_runs: set[str | None]) -> list[dict[str, Any]]:
    """Return run, method and fleet size of every map to score."""
    groups: list[dict[str, Any]] = labels.group_by(list(_LABELS)).aggregate([]).to_pylist()
    if groups and None not in ref_runs and not ref_runs & {g["run_id"] for g in groups} and len(ref_runs) > 1:
        raise ConfigError(
            f"the map belongs to none of the {len(ref_runs)} runs of the reference.",
            todo="Give the reference that the map's detections were simulated with.",
        )
    scored = {g["run_id"] for g in groups}
    if None not in ref_runs and None not in scored:
        unseen = sorted(run for run in ref_runs - scored if run is not None)
        groups += [{"run_id": run, "method": "none", "n_vehicles": 0} for run in unseen]
    if not groups:
        groups = [{"run_id": None, "method": "none", "n_vehicles": 0}]
    return sorted(groups, key=lambda g: (g["run_id"] or "", g["method"], g["n_vehicles"]))


def _clip(map_: pa.Table, rows: Ints, reference: pa.Table, ref_rows: Ints, clip_m: float) -> tuple[Ints, Ints]:
    """Keep the rows in the common extent of a map and its reference."""
    lon, lat = (side[rows] for side in lonlat(map_))
    ref_lon, ref_lat = (side[ref_rows] for side in lonlat(reference))
    kept = is_within_reach(lon, lat, of_lon_deg=ref_lon, of_lat_deg=ref_lat, reach_m=clip_m)
    ref_kept = is_within_reach(ref_lon, ref_lat, of_lon_deg=lon, of_lat_deg=lat, reach_m=clip_m)
    return rows[kept], ref_rows[ref_kept]


def _match_pairs(pairs: Sequence[_Pair], config: Config) -> pa.Table:
    """Return the `matches` rows of all pairs."""
    options = config.evaluate.model_dump(include={"gate_m", "match_on"}) | {"tile_zoom": config.aggregate.tile_zoom}
    return pa.concat_tables(match_layers(pair.fused, pair.reference, pair.labels, **options) for pair in pairs)


def _used_rows(pairs: Sequence[_Pair], n_map: int, n_ref: int) -> tuple[pa.Array, pa.Array]:
    """Return which rows of the map and of the reference are scored in any pair."""
    used, ref_used = np.zeros(n_map, np.bool_), np.zeros(n_ref, np.bool_)
    for pair in pairs:
        used[pair.rows] = True
        ref_used[pair.ref_rows] = True
    return pa.array(used), pa.array(ref_used)


def _equal_or_null(column: pa.ChunkedArray, value: str | None) -> pa.ChunkedArray:
    return pc.is_null(column) if value is None else pc.fill_null(pc.equal(column, value), fill_value=False)


def _totals(scores: pa.Table) -> tuple[dict[str, Any], ...]:
    return tuple(scores.filter((pc.field("tile") == "all") & (pc.field("concept") == "all")).to_pylist())


def _rows_of_parts(scores: pa.Table) -> dict[str, list[dict[str, Any]]]:
    """Return the rows a tile, over all concepts, and a concept, over all tiles."""
    plain = scores.drop_columns([GEOMETRY, BBOX])
    one_tile, one_concept = pc.field("tile") != "all", pc.field("concept") != "all"
    return {
        "tiles": plain.filter(one_tile & ~one_concept).to_pylist(),
        "concepts": plain.filter(one_concept & ~one_tile).to_pylist(),
    }


def _confusion(pairs: Sequence[_Pair], *, gate_m: float) -> list[dict[str, Any]]:
    """Count which class of the map stands where the reference has which, whatever the scores match on."""
    return [
        pair.labels | row
        for pair in pairs
        for row in class_confusion(pair.fused, pair.reference, gate_m=gate_m).to_pylist()
    ]


def _score_sources(pairs: Sequence[_Pair], *, gate_m: float, match_on: MatchOn) -> list[dict[str, Any]]:
    """Score every source of a map as a map of its own; nothing for maps of one source.

    A sign that two sources have counts for both, so the rows don't add up to the total.
    """
    rows: list[dict[str, Any]] = []
    for pair in pairs:
        sources = sorted(pc.unique(pair.fused["source"]).to_pylist())
        for source in sources if len(sources) > 1 else ():
            alone = pair.fused.filter(pc.field("source") == source)
            score = _score(alone, pair.reference, gate_m=gate_m, match_on=match_on)
            rows.append(pair.labels | {"source": source} | score_row(score))
    return rows


def _write(
    out: Path, layers: Mapping[str, pa.Table], more: Mapping[str, list[dict[str, Any]]]
) -> tuple[tuple[Path, ...], int]:
    """Write everything but the manifest; return the files and the number of signs without an ellipse."""
    with atomic_path(out) as draft:
        draft.mkdir()
        write_table(MATCHES, layers["matches"], draft / "matches.parquet")
        write_table(SCORES, layers["scores"], draft / "scores.parquet")
        n_features = write_result_layers(draft, **layers)
        for name, rows in more.items():
            if rows:
                write_csv(rows, draft / f"{name}.csv")
        names = sorted(path.name for path in draft.iterdir())
    return tuple(out / name for name in names), n_features["signs_without_ellipse"]
