"""Evaluate: match a map to its reference, one to one, and score it.

Reads two layers of signs; writes `matches` and `scores` and the same as GeoJSON for GIS tools.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.algorithms.geodesy import to_ecef
from geofleet.algorithms.matching import Matching, match_points
from geofleet.algorithms.metrics import MapScore, derive_scores, null_reason
from geofleet.algorithms.tiling import quadkey_bounds, quadkeys
from geofleet.errors import ConfigError
from geofleet.formats.geojson import write_geojson
from geofleet.formats.layers import read_layer
from geofleet.tables.database import connect, run
from geofleet.tables.manifest import write_manifest
from geofleet.tables.schemas import BBOX, MATCHES, SCORES
from geofleet.tables.store import atomic_path, build_table, lonlat, to_geodataframe, write_table

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from geopandas import GeoDataFrame

    from geofleet.config import Config, EvaluateConfig

_REQUIREMENT = re.compile(r"^\s*([a-z_0-9]+)\s*(<=|>=|<|>|==)\s*([-+]?\d*\.?\d+(?:[eE][-+]?\d+)?)\s*$")
_SHORTEST_LINE_M = 0.002  # GeoJSON is written to a millimetre: anything shorter could come out without length
_COMPARE = {"<": np.less, "<=": np.less_equal, ">": np.greater, ">=": np.greater_equal, "==": np.equal}


_SCORE_NAMES = tuple(c.name for c in SCORES.columns if c.name in ("tp", "fp", "fn") or pa.types.is_floating(c.type))


@dataclass(frozen=True, slots=True)
class Requirement:
    """A bound on a score, e.g. `gospa_m < 0.8`."""

    text: str
    score: str
    operator: str
    bound: float


@dataclass(frozen=True, slots=True)
class EvaluateResult:
    """What an evaluation found: the rows over all tiles and concepts, one a run, method and fleet size."""

    out: Path
    totals: tuple[dict[str, Any], ...]
    files: tuple[Path, ...]


def evaluate(map_path: Path, reference_path: Path, out: Path, *, config: Config) -> EvaluateResult:
    """Score the main signs of a map against those of a reference and write tables and GIS layers.

    Every run in the map is matched to the reference signs of the same run; a reference without runs serves every run.

    Raises
    ------
    InputError
        A layer cannot be read.
    ConfigError
        The map and the reference have no run in common.
    """
    gate_m, match_on = config.evaluate.gate_m, config.evaluate.match_on
    map_, reference = _main_signs(read_layer(map_path)), _main_signs(read_layer(reference_path))
    parts = [
        _match_layer(fused, ref, labels, gate_m=gate_m, match_on=match_on, tile_zoom=config.aggregate.tile_zoom)
        for labels, fused, ref in _pairs(map_, reference)
    ]
    matches = pa.concat_tables(parts)
    scores = score_matches(matches, gate_m=gate_m, match_on=match_on)
    with atomic_path(out) as draft:
        draft.mkdir()
        write_table(MATCHES, matches, draft / "matches.parquet")
        write_table(SCORES, scores, draft / "scores.parquet")
        _write_layers(draft, map_, reference, matches, scores)
        names = sorted(path.name for path in draft.iterdir())
    totals = tuple(scores.filter((pc.field("tile") == "all") & (pc.field("concept") == "all")).to_pylist())
    write_manifest(
        out,
        step="evaluate",
        inputs=(map_path, reference_path),
        config_digest=config.digest("evaluate"),
        settings=config.evaluate.model_dump(),
        counts={"matches": matches.num_rows, "scores": scores.num_rows},
    )
    return EvaluateResult(out, totals, tuple(out / name for name in names))


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
    matching = _match_signs(fused, ref, gate_m=config.gate_m, match_on=config.match_on)
    return MapScore(
        tp=len(matching),
        fp=fused.num_rows - len(matching),
        fn=ref.num_rows - len(matching),
        sum_sq_error_m2=matching.sum_sq_error_m2,
        gate_m=config.gate_m,
        match_on=config.match_on,
        matches=matching,
    )


def score_matches(matches: pa.Table, *, gate_m: float, match_on: str) -> pa.Table:
    """Return the `scores` table of a `matches` table: per tile, per concept, both, and in total."""
    connection = connect()
    connection.register("matches", matches)
    counts = run(connection, "evaluate/counts").to_arrow_table()
    connection.close()
    numbers = [counts[name].to_numpy() for name in ("tp", "fp", "fn", "sum_sq_error_m2")]
    columns = {name: counts[name] for name in counts.column_names}
    columns |= derive_scores(*numbers, gate_m=gate_m)
    reasons = [null_reason(tp, fp, fn) for tp, fp, fn in zip(*(n.tolist() for n in numbers[:3]), strict=True)]
    tiles = counts["tile"].to_pylist()
    return build_table(
        SCORES,
        columns | {"gate_m": gate_m, "match_on": match_on, "null_reason": pa.array(reasons, pa.string())},
        geometry=_tile_polygons(tiles),
    )


def parse_requirements(texts: Sequence[str]) -> list[Requirement]:
    """Read requirements like `gospa_m<0.8`.

    Raises
    ------
    ConfigError
        A text is not `score operator number`, or names no score.
    """
    parsed = []
    for text in texts:
        match = _REQUIREMENT.match(text)
        if not match or match[1] not in _SCORE_NAMES:
            raise ConfigError(
                f"{text!r} is not a requirement.",
                where="--require",
                todo=f'Example: "gospa_m<0.8"; scores are {", ".join(_SCORE_NAMES)}.',
            )
        parsed.append(Requirement(text.strip(), match[1], match[2], float(match[3])))
    return parsed


def missed_requirements(totals: Sequence[dict[str, Any]], requirements: Sequence[Requirement]) -> list[str]:
    """Return a sentence for every requirement that a total misses; a score that is null misses it."""
    missed = []
    for need in requirements:
        for total in totals:
            value = total[need.score]
            if value is None or not _COMPARE[need.operator](value, need.bound):
                shown = f"null ({total['null_reason']})" if value is None else f"{value:.6g}"
                missed.append(f"{need.text} is missed by {total['method']}, {total['n_vehicles']} vehicles: {shown}.")
    return missed


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


def _pairs(map_: pa.Table, reference: pa.Table) -> Iterator[tuple[dict[str, Any], pa.Table, pa.Table]]:
    """Yield labels, map signs and reference signs of every run, method and fleet size, in sorted order.

    A run of the reference that the map has nothing of is scored against an empty map.
    """
    labels, ref_runs = _labels(map_), _labels(reference)["run_id"]
    runs = set(ref_runs.to_pylist())
    groups = labels.group_by(["run_id", "method", "n_vehicles"]).aggregate([]).to_pylist()
    if groups and None not in runs and not runs & {g["run_id"] for g in groups} and len(runs) > 1:
        raise ConfigError(
            f"the map belongs to none of the {len(runs)} runs of the reference.",
            todo="Give the reference that the map's detections were simulated with.",
        )
    scored = {g["run_id"] for g in groups}
    if None not in runs and None not in scored:
        groups += [{"run_id": r, "method": "none", "n_vehicles": 0} for r in sorted(runs - scored)]
    if not groups:
        groups = [{"run_id": None, "method": "none", "n_vehicles": 0}]
    for group in sorted(groups, key=lambda g: (g["run_id"] or "", g["method"], g["n_vehicles"])):
        same = pc.and_(
            pc.and_(pc.equal(labels["method"], group["method"]), pc.equal(labels["n_vehicles"], group["n_vehicles"])),
            _equal_or_null(labels["run_id"], group["run_id"]),
        )
        own = (
            reference
            if group["run_id"] is None or None in runs
            else reference.filter(pc.equal(ref_runs, group["run_id"]))
        )
        yield group, map_.filter(same), own


def _equal_or_null(column: pa.ChunkedArray, value: str | None) -> pa.ChunkedArray:
    return pc.is_null(column) if value is None else pc.fill_null(pc.equal(column, value), fill_value=False)


def _match_signs(fused: pa.Table, ref: pa.Table, *, gate_m: float, match_on: str) -> Matching:
    """Match two layers of signs.

    In Earth-centred coordinates a chord of metres is the distance on the ground to 1e-13, whatever the extent.
    """
    codes, ref_codes = _codes(fused, ref, match_on)
    return match_points(to_ecef(*lonlat(fused)), to_ecef(*lonlat(ref)), gate_m=gate_m, codes=codes, ref_codes=ref_codes)


def _match_layer(
    fused: pa.Table, ref: pa.Table, labels: dict[str, Any], *, gate_m: float, match_on: str, tile_zoom: int
) -> pa.Table:
    """Return the `matches` rows of one map and its reference."""
    (lon, lat), (ref_lon, ref_lat) = lonlat(fused), lonlat(ref)
    matching = _match_signs(fused, ref, gate_m=gate_m, match_on=match_on)
    i, j, outcome, distance = _outcomes(matching, fused.num_rows, ref.num_rows)
    here_lon = np.where(j >= 0, _take(ref_lon, j), _take(lon, i))
    here_lat = np.where(j >= 0, _take(ref_lat, j), _take(lat, i))
    columns: dict[str, Any] = {"fused_id": _pick(fused["sign_id"], i), "ref_id": _pick(ref["sign_id"], j)}
    for column, name in (("sign_class", "class"), ("concept", "concept")):
        columns[f"fused_{name}"] = _pick(fused[column], i)
        columns[f"ref_{name}"] = _pick(ref[column], j)
    columns |= {
        "outcome": outcome,
        "tile": quadkeys(here_lon, here_lat, tile_zoom),
        "distance_m": pa.array(distance, from_pandas=True),
        "class_agrees": pc.equal(columns["fused_class"], columns["ref_class"]),
    }
    return build_table(MATCHES, columns | labels, geometry=(here_lon, here_lat))


def _codes(fused: pa.Table, ref: pa.Table, match_on: str) -> tuple[Any, Any]:
    """Return integer codes of what must be equal in a match, or None twice."""
    if match_on == "none":
        return None, None
    column = {"class": "sign_class", "concept": "concept"}[match_on]
    both = pa.chunked_array([*fused[column].chunks, *ref[column].chunks], pa.string()).combine_chunks()
    codes = both.dictionary_encode().indices.to_numpy(zero_copy_only=False)
    return codes[: fused.num_rows], codes[fused.num_rows :]


def _outcomes(matching: Matching, n_map: int, n_ref: int) -> tuple[Any, Any, Any, Any]:
    """Return row of the map, row of the reference (-1: none), outcome and distance: TP, then FP, then FN."""
    false = np.setdiff1d(np.arange(n_map), matching.index)
    missed = np.setdiff1d(np.arange(n_ref), matching.ref_index)
    i = np.concatenate((matching.index, false, np.full(len(missed), -1)))
    j = np.concatenate((matching.ref_index, np.full(len(false), -1), missed))
    outcome = np.repeat(["TP", "FP", "FN"], (len(matching.index), len(false), len(missed)))
    distance = np.concatenate((matching.distance_m, np.full(len(false) + len(missed), np.nan)))
    return i, j, outcome, distance


def _take(values: Any, index: Any) -> Any:
    return values[np.maximum(index, 0)] if len(values) else np.zeros(len(index))


def _pick(column: pa.ChunkedArray, index: Any) -> pa.Array:
    return pc.take(column, pa.array(index, mask=index < 0)).combine_chunks()


def _tile_polygons(tiles: Sequence[str]) -> Any:
    """Return the polygon of every tile; None for `all`."""
    import shapely  # noqa: PLC0415

    polygons = np.full(len(tiles), None, dtype=object)
    real = np.flatnonzero(np.asarray(tiles) != "all")
    if len(real):
        bounds = quadkey_bounds([tiles[k] for k in real])
        polygons[real] = shapely.box(*bounds.T)
    return polygons


def _write_layers(folder: Path, map_: pa.Table, reference: pa.Table, matches: pa.Table, scores: pa.Table) -> None:
    """Write one GeoJSON file a layer: tiles with their scores, matches, match lines, both maps."""
    tiles = scores.filter((pc.field("tile") != "all") & (pc.field("concept") == "all"))
    write_geojson(to_geodataframe(tiles), folder / "scores.geojson")
    write_geojson(to_geodataframe(matches), folder / "matches.geojson")
    write_geojson(_match_lines(matches, map_), folder / "match_lines.geojson")
    write_geojson(to_geodataframe(map_), folder / "fused.geojson")
    write_geojson(to_geodataframe(reference), folder / "reference.geojson")


def _match_lines(matches: pa.Table, map_: pa.Table) -> GeoDataFrame:
    """Return a line from every matched sign of the map to its reference; lines without length are left out."""
    import geopandas  # noqa: PLC0415
    import shapely  # noqa: PLC0415

    labelled = map_.select(["sign_id", BBOX])
    for name, column in zip(("run_id", "method", "n_vehicles"), _labels(map_).columns, strict=True):
        labelled = labelled.append_column(name, column)
    connection = connect()
    connection.register("matches", matches)
    connection.register("signs", labelled)
    lines = run(connection, "evaluate/match_lines", {"min_length_m": _SHORTEST_LINE_M}).to_arrow_table()
    connection.close()
    ends = np.stack([lines[name].to_numpy() for name in ("lon", "lat", "ref_lon", "ref_lat")], axis=-1)
    frame = lines.drop_columns(["lon", "lat", "ref_lon", "ref_lat"]).to_pandas()
    return geopandas.GeoDataFrame(frame, geometry=shapely.linestrings(ends.reshape(-1, 2, 2)), crs="OGC:CRS84")
