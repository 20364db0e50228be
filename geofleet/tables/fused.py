"""Clusters to a layer: the `signs` table of those that enough passes support."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from geofleet.algorithms.fusion import name_hashes
from geofleet.tables.schemas import SIGNS
from geofleet.tables.staging import NEVER_BEGUN, NEVER_ENDED
from geofleet.tables.store import build_table
from geofleet.taxonomy.reader import load_taxonomy

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Columns = dict[str, NDArray[Any]]
    Ints = NDArray[np.int64]

_NUMBERED_CLASS = re.compile(r"(?P<concept>[^:]+):(?P<value>-?\d+(\.\d+)?)(?P<unit>\D*)")
_FUSED = (
    *("var_e_m2", "var_n_m2", "cov_en_m2", "class_confidence", "n_passes", "n_detections"),
    *("run_id", "method", "n_vehicles"),
)  # the optional columns of the layer


def build_layer(
    clusters: Columns,
    *,
    run_ids: Sequence[str],
    classes: Sequence[str],
    n_vehicles: Ints,
    support: NDArray[np.float64],
    method: str,
) -> pa.Table:
    """Return the `signs` table of the clusters whose `n_passes` reach their support.

    Parameters
    ----------
    clusters
        As `engines.batches` makes them; with `n_opportunities`, the layer has that column too.
    run_ids, classes
        The meaning of `run_code` and `class_code`.
    n_vehicles
        (n_runs,) vehicles of every run.
    support
        (n,) passes that each cluster needs.
    method
        The label of the layer.
    """
    if not clusters:
        return SIGNS.arrow(_FUSED).empty_table()
    # in an order that comes from the clusters alone: it tells ids that collide apart
    order = np.lexsort((clusters["lat"], clusters["lon"], clusters["class_code"], clusters["run_code"]))
    order = order[(clusters["n_passes"] >= support)[order]]
    kept = {name: values[order] for name, values in clusters.items()}
    runs = pa.array(run_ids, pa.string()).take(pa.array(kept["run_code"]))
    columns: dict[str, Any] = {
        "sign_id": name_hashes(kept["hash"].astype(np.uint64)),
        "kind": "main",
        **_class_columns(classes, kept["class_code"]),
        "source": "geofleet",
        "source_ref": runs,
        "first_seen": _times(kept["t_first_us"], NEVER_BEGUN),
        "last_seen": _times(kept["t_last_us"], NEVER_ENDED),
        **_or_null(kept, ("var_e_m2", "var_n_m2", "cov_en_m2", "class_confidence")),
        **{name: pa.array(kept[name]) for name in ("n_passes", "n_detections", "n_opportunities") if name in kept},
        "run_id": runs,
        "method": method,
        "n_vehicles": n_vehicles[kept["run_code"]],
    }
    return build_table(SIGNS, columns, geometry=(kept["lon"].astype(np.float64), kept["lat"].astype(np.float64)))


def _class_columns(classes: Sequence[str], class_code: Ints) -> dict[str, pa.Array]:
    """Return concept, value, unit and class; a fleet reports classes, so the raw code is the class."""
    codes = pa.array(class_code)
    meanings = [_meaning(name) for name in classes]
    names = pa.array(classes, pa.string()).take(codes)
    return {
        **{
            name: pa.array([meaning[name] for meaning in meanings], kind).take(codes)
            for name, kind in (("concept", pa.string()), ("value", pa.float64()), ("unit", pa.string()))
        },
        "sign_class": names,
        "raw_code": names,
    }


def _or_null(columns: Columns, names: Sequence[str]) -> dict[str, pa.Array]:
    return {name: pa.array(columns[name].astype(np.float64), from_pandas=True) for name in names}


def _times(microseconds: Ints, missing: int) -> pa.Array:
    return pa.array(microseconds, mask=microseconds == missing).cast(pa.timestamp("us", tz="UTC"))


def _meaning(sign_class: str) -> dict[str, Any]:
    """Return concept, value and unit of a class: `concept`, `concept:number`, or with a unit other than the concept's.

    Any other text, such as `raw:<code>`, is its own concept.
    """
    concepts = load_taxonomy().concepts
    found = _NUMBERED_CLASS.fullmatch(sign_class)
    if not found or found["concept"] == "raw":
        return {"concept": sign_class, "value": None, "unit": None}
    own = concepts[found["concept"]].unit if found["concept"] in concepts else ""
    return {"concept": found["concept"], "value": float(found["value"]), "unit": found["unit"] or own or None}
