"""Two layers of signs matched one to one, as tables."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.algorithms.geodesy import to_ecef
from geofleet.algorithms.matching import Matching, match_points
from geofleet.algorithms.tiling import quadkeys
from geofleet.tables.schemas import MATCHES
from geofleet.tables.store import build_table, lonlat

if TYPE_CHECKING:
    from collections.abc import Mapping

    from geofleet.algorithms.metrics import MatchOn


def match_signs(fused: pa.Table, ref: pa.Table, *, gate_m: float, match_on: MatchOn) -> Matching:
    """Return the optimal matching of two `signs` tables as rows of both.

    In Earth-centred coordinates a chord of metres is the distance on the ground to 1e-13, whatever the extent.
    """
    codes, ref_codes = _codes(fused, ref, match_on)
    return match_points(to_ecef(*lonlat(fused)), to_ecef(*lonlat(ref)), gate_m=gate_m, codes=codes, ref_codes=ref_codes)


def match_layers(
    fused: pa.Table, ref: pa.Table, labels: Mapping[str, Any], *, gate_m: float, match_on: MatchOn, tile_zoom: int
) -> pa.Table:
    """Match one map with its reference.

    Parameters
    ----------
    fused, ref
        `signs` tables.
    labels
        `run_id`, `method` and `n_vehicles` of the map.
    gate_m, match_on
        A match is nearer than c, metres, and equal in `class`, `concept` or nothing (`none`).
    tile_zoom
        Of the tiles that outcomes are counted in.

    Returns
    -------
    A `matches` table: every sign of either layer once.
    """
    (lon, lat), (ref_lon, ref_lat) = lonlat(fused), lonlat(ref)
    matching = match_signs(fused, ref, gate_m=gate_m, match_on=match_on)
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
    return build_table(MATCHES, columns | dict(labels), geometry=(here_lon, here_lat))


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


def class_confusion(fused: pa.Table, ref: pa.Table, *, gate_m: float) -> pa.Table:
    """Count which class of a map stands where its reference has which.

    Signs are matched on class first, and what is left by position alone. Matched by position alone from the start, two
    signs on one pole would be free to cross over, and both be called confused.

    Returns
    -------
    `ref_class`, `fused_class` and `n`, the number of pairs nearer than the gate; ordered by class.
    """
    found = match_signs(fused, ref, gate_m=gate_m, match_on="class")
    rest = np.setdiff1d(np.arange(fused.num_rows), found.index)
    ref_rest = np.setdiff1d(np.arange(ref.num_rows), found.ref_index)
    left = match_signs(fused.take(rest), ref.take(ref_rest), gate_m=gate_m, match_on="none")
    pairs = pa.table(
        {
            "ref_class": ref["sign_class"].take(np.append(found.ref_index, ref_rest[left.ref_index])),
            "fused_class": fused["sign_class"].take(np.append(found.index, rest[left.index])),
        }
    )
    counted = pairs.group_by(["ref_class", "fused_class"]).aggregate([([], "count_all")])
    ordered = counted.sort_by([("ref_class", "ascending"), ("fused_class", "ascending")])
    return ordered.select(["ref_class", "fused_class", "count_all"]).rename_columns(["ref_class", "fused_class", "n"])
