"""What keeps a map from its target: GOSPA_M² of a map taken apart, and what no number of passes can find."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.metrics import derive_scores
from geofleet.algorithms.planning import class_groups
from geofleet.tables.matching import match_layers
from geofleet.tables.store import lonlat
from geofleet.workflows.study.methods import CLUSTERING

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.config import Config

PARTS = {
    "common_offset": "an offset common to the whole map (mean GNSS and calibration error of the fleet)",
    "own_errors": "position errors of single signs",
    "never_in_view": "signs that no pass has in view",
    "merged": "missed signs with a neighbour of their class closer than eps_m",
    "rarely_in_view": "missed signs that fewer passes have in view than the support rule asks for",
    "other_missed": "other missed signs",
    "false": "signs of the map that are not there, or farther off than the gate",
}
"""What the error of a map is made of."""


@dataclass(frozen=True, slots=True)
class Floor:
    """What is out of reach, however many passes there are.

    Parameters
    ----------
    n_signs
        Signs of the scene that are scored.
    n_never_in_view
        Signs that no pass had in view.
    n_merged
        Signs that a clustering loses to neighbours of their class closer than eps_m; 0 for joint fusion.
    score
        The target's score of a map that lacks these signs alone, without any other error.
    """

    n_signs: int
    n_never_in_view: int
    n_merged: int
    score: float | None


def floor_of(reference: pa.Table, config: Config, score: str) -> Floor:
    """Return what is out of reach of a method in a scene, a `reference` table."""
    unseen, group = reference["n_passes_in_view"].to_numpy() == 0, _groups(reference, config)
    n, n_unseen = reference.num_rows, int(unseen.sum())
    n_merged = n - n_unseen - len(np.unique(group[~unseen]))
    lost = n_unseen + n_merged
    value = float(derive_scores(n - lost, 0, lost, 0.0, config.evaluate.gate_m)[score])
    return Floor(n, n_unseen, n_merged, None if np.isnan(value) else value)


def take_apart(fused: pa.Table, reference: pa.Table, labels: dict[str, Any], config: Config) -> list[dict[str, Any]]:
    """Return the parts of GOSPA_M² times TP, m², of every tile of a map and of all (`tile` is all).

    Positions give Σd², split into the offset that the whole map has in common and the rest; a missed or false sign
    gives c²/2.

    Returns
    -------
    Rows with `tile`, `tp`, `n_signs`, and a column a part.
    """
    matching: dict[str, Any] = config.evaluate.model_dump(include={"gate_m", "match_on"})
    matches = match_layers(fused, reference, labels, **matching, tile_zoom=config.aggregate.tile_zoom)
    outcome = np.array(matches["outcome"].to_pylist())
    tiles = np.array(matches["tile"].to_pylist())
    pieces = _pieces(matches, fused, reference, config)
    rows = []
    for tile in ("all", *np.unique(tiles).tolist()):
        here = np.ones(len(tiles), bool) if tile == "all" else tiles == tile
        row = {
            "tile": tile,
            "tp": int((here & (outcome == "TP")).sum()),
            "n_signs": int((here & (outcome != "FP")).sum()),
        }
        rows.append(row | {name: float(piece[here].sum()) for name, piece in pieces.items()})
    return rows


def _pieces(matches: pa.Table, fused: pa.Table, reference: pa.Table, config: Config) -> dict[str, NDArray[np.float64]]:
    """Return what every row of `matches` adds to each part, m²."""
    outcome = np.array(matches["outcome"].to_pylist())
    row_of = {name: row for row, name in enumerate(reference["sign_id"].to_pylist())}
    ref = np.array([row_of.get(name, 0) for name in matches["ref_id"].to_pylist()], np.int64)
    squared = np.nan_to_num(matches["distance_m"].to_numpy().astype(np.float64)) ** 2
    mean = _mean_offset(matches, fused, reference)
    common = np.where(outcome == "TP", mean @ mean, 0.0)
    n_in_view = reference["n_passes_in_view"].to_numpy()[ref]
    support = config.aggregate.min_support if config.aggregate.method in CLUSTERING else 0
    missed, left = outcome == "FN", config.evaluate.gate_m**2 / 2
    never = missed & (n_in_view == 0)
    rarely = missed & ~never & (n_in_view < support)
    group = _groups(reference, config)
    merged = missed & ~never & ~rarely & (np.bincount(group)[group][ref] > 1)
    return {
        "common_offset": common,
        # Σ|d|² = n |mean|² + the rest, over the whole map; in one tile the rest may come out a little below zero
        "own_errors": np.where(outcome == "TP", squared - common, 0.0),
        "never_in_view": left * never,
        "merged": left * merged,
        "rarely_in_view": left * rarely,
        "other_missed": left * (missed & ~never & ~merged & ~rarely),
        "false": left * (outcome == "FP"),
    }


def _mean_offset(matches: pa.Table, fused: pa.Table, reference: pa.Table) -> NDArray[np.float64]:
    """Return the mean offset, east and north, of the signs that match."""
    pairs = matches.filter(pa.array(np.array(matches["outcome"].to_pylist()) == "TP"))
    if not pairs.num_rows:
        return np.zeros(2)
    frame = EnuFrame.around(*lonlat(reference))
    ends = []
    for layer, column in ((fused, "fused_id"), (reference, "ref_id")):
        row_of = {name: row for row, name in enumerate(layer["sign_id"].to_pylist())}
        ends.append(frame.to_enu(*lonlat(layer))[[row_of[name] for name in pairs[column].to_pylist()]])
    offset: NDArray[np.float64] = (ends[0] - ends[1]).mean(axis=0)
    return offset


def _groups(reference: pa.Table, config: Config) -> NDArray[np.int64]:
    """Return the group that each sign may be merged with; joint fusion tells all signs apart."""
    if config.aggregate.method not in CLUSTERING:
        return np.arange(reference.num_rows)
    xy = EnuFrame.around(*lonlat(reference)).to_enu(*lonlat(reference))
    codes = reference["sign_class"].combine_chunks().dictionary_encode().indices.to_numpy()
    return class_groups(xy, codes, config.aggregate.eps_m)
