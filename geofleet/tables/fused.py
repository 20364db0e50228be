"""Clusters to a layer: the `signs` table of those that enough passes support."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from geofleet.algorithms.fusion import ID_SHIFT, name_hashes
from geofleet.tables.arrays import arrow_numbers, arrow_texts, arrow_times
from geofleet.tables.dealt import NEVER_BEGUN, NEVER_ENDED
from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import build_table
from geofleet.taxonomy.reader import load_taxonomy

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    Columns = dict[str, NDArray[Any]]
    Ints = NDArray[np.int64]

PIECE_ROWS = 30_000  # signs built and written at a time: tens of megabytes
_NUMBERED_CLASS = re.compile(r"(?P<concept>[^:]+):(?P<value>-?\d+(\.\d+)?)(?P<unit>\D*)")
_MEASURED = ("var_e_m2", "var_n_m2", "cov_en_m2", "class_confidence", "existence")
_FUSED = (
    *("var_e_m2", "var_n_m2", "cov_en_m2", "class_confidence", "n_passes", "n_detections"),
    *("run_id", "method", "n_vehicles"),
)  # the optional columns of the layer


@dataclass(frozen=True, slots=True)
class Labels:
    """What the codes of clusters mean, and what is the same for all signs of a run.

    Parameters
    ----------
    run_ids, classes
        The meaning of `run_code` and `class_code`.
    n_vehicles
        (n_runs,) vehicles of every run.
    method
        The label of the layer.
    """

    run_ids: tuple[str, ...]
    classes: tuple[str, ...]
    n_vehicles: Ints
    method: str


def layer_pieces(clusters: Columns, support: NDArray[np.float64], labels: Labels) -> Iterator[pa.Table]:
    """Yield the `signs` table of the clusters whose `n_passes` reach their support, some signs at a time.

    There is at least one piece. Rows are in the order of their ids, over all pieces; how many share a piece depends on
    nothing.

    Parameters
    ----------
    clusters
        As `engines.batches` makes them; with `n_opportunities` or `existence`, the layer has that column too.
    support
        (n,) passes that each cluster needs.
    labels
        What codes mean.
    """
    if not clusters:
        yield SIGNS.arrow(_FUSED).empty_table()
        return
    order = _by_name(clusters, np.flatnonzero(clusters["n_passes"] >= support))
    hashes = clusters["hash"][order]
    numbers = hashes >> ID_SHIFT
    # Only ids that collide, one pair in 2⁴⁸, must be known all together.
    names = name_hashes(hashes) if (numbers[1:] == numbers[:-1]).any() else None
    for begin in range(0, max(len(order), 1), PIECE_ROWS):
        piece = slice(begin, begin + PIECE_ROWS)
        kept = {name: values[order[piece]] for name, values in clusters.items()}
        yield _piece(kept, name_hashes(hashes[piece]) if names is None else names[piece], labels)


def _by_name(clusters: Columns, rows: Ints) -> Ints:
    """Return rows in the order of their ids; those of equal ids in one that comes from the clusters alone."""
    number = clusters["hash"][rows] >> ID_SHIFT
    order = np.argsort(number, kind="stable")
    number, rows = number[order], rows[order]
    for begin in np.flatnonzero((np.diff(number) == 0) & (np.diff(number, prepend=number[:1] + 1)[:-1] != 0)).tolist():
        tied = rows[begin : begin + int(np.searchsorted(number[begin:], number[begin], side="right"))]
        keys = [clusters[name][tied] for name in ("lat", "lon", "class_code", "run_code")]
        rows[begin : begin + tied.size] = tied[np.lexsort(keys)]
    return rows


def _piece(kept: Columns, names: NDArray[np.bytes_], labels: Labels) -> pa.Table:
    runs = arrow_texts(labels.run_ids).take(arrow_numbers(kept["run_code"]))
    columns: dict[str, Any] = {
        "sign_id": _texts(names),
        "kind": "main",
        **_class_columns(labels.classes, kept["class_code"]),
        "source": "geofleet",
        "source_ref": runs,
        "first_seen": arrow_times(kept["t_first_us"], NEVER_BEGUN),
        "last_seen": arrow_times(kept["t_last_us"], NEVER_ENDED),
        **{name: arrow_numbers(kept[name].astype(np.float64)) for name in _MEASURED if name in kept},
        **{name: arrow_numbers(kept[name]) for name in ("n_passes", "n_detections", "n_opportunities") if name in kept},
        "run_id": runs,
        "method": labels.method,
        "n_vehicles": labels.n_vehicles[kept["run_code"]],
    }
    return build_table(SIGNS, columns, geometry=(kept["lon"].astype(np.float64), kept["lat"].astype(np.float64)))


def _texts(names: NDArray[np.bytes_]) -> pa.Array:
    """Return fixed-width names, padded by zero bytes, as Arrow texts."""
    width = names.dtype.itemsize
    letters = names.view(np.uint8).reshape(len(names), width)
    ends = np.append(0, np.cumsum((letters > 0).sum(axis=1))).astype(np.int32)
    return pa.Array.from_buffers(
        pa.string(), len(names), [None, pa.py_buffer(ends), pa.py_buffer(letters[letters > 0])]
    )


def _class_columns(classes: Sequence[str], class_code: Ints) -> dict[str, pa.Array]:
    """Return concept, value, unit and class; a fleet reports classes, so the raw code is the class."""
    codes = arrow_numbers(class_code)
    meanings = [_meaning(name) for name in classes]
    names = arrow_texts(classes).take(codes)
    return {
        "concept": arrow_texts([concept for concept, _, _ in meanings]).take(codes),
        "value": arrow_numbers(np.array([value for _, value, _ in meanings], np.float64)).take(codes),
        "unit": arrow_texts([unit for _, _, unit in meanings]).take(codes),
        "sign_class": names,
        "raw_code": names,
    }


def _meaning(sign_class: str) -> tuple[str, float, str | None]:
    """Return concept, value and unit of a class: `concept`, `concept:number`, or with a unit other than the concept's.

    Any other text, such as `raw:<code>`, is its own concept; what has no value has NaN.
    """
    concepts = load_taxonomy().concepts
    found = _NUMBERED_CLASS.fullmatch(sign_class)
    if not found or found["concept"] == "raw":
        return sign_class, float("nan"), None
    own = concepts[found["concept"]].unit if found["concept"] in concepts else ""
    return found["concept"], float(found["value"]), found["unit"] or own or None
