"""What the figures of a report count: errors and confused classes."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from geofleet.steps.report.contents import Contents

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

MISSED, FALSE, OTHER = "missed", "not in the reference", "other classes"
_MOST_CLASSES = 24


@dataclass(frozen=True, slots=True, eq=False)
class Confusion:
    """How often a class of the reference (row) stands in the map as which class (column).

    The last column counts signs that were missed, the last row signs that the reference does not have.
    """

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    counts: Ints


def error_bins(distance_m: Floats, gate_m: float, n_bins: int = 20) -> tuple[Ints, Floats]:
    """Count errors in equal bins from 0 to the gate; return the counts and the n_bins + 1 edges."""
    counts, edges = np.histogram(distance_m, bins=n_bins, range=(0.0, gate_m))
    return counts, edges


def landmarks(distance_m: Floats) -> list[tuple[float, str, str]]:
    """Return value, name and line of what is marked in a histogram of errors."""
    if not len(distance_m):
        return []
    return [
        (float(np.median(distance_m)), "median", "solid"),
        (float(np.sqrt(np.mean(distance_m**2))), "RMSE_M", "dashed"),
        (float(np.quantile(distance_m, 0.95)), "95 % below", "dotted"),
    ]


def count_confusion(contents: Contents) -> Confusion:
    """Return the confusion of one map, with what has no partner; the rarest of many classes are put together."""
    pairs: Counter[tuple[str, str]] = Counter()
    for row in contents.confusion:
        pairs[row["ref_class"], row["fused_class"]] += int(row["n"])
    for name, total in Counter(contents.reference["sign_class"]).items():
        pairs[name, MISSED] += total - sum(n for (ref, _), n in pairs.items() if ref == name)
    for name, total in Counter(contents.fused["sign_class"]).items():
        pairs[FALSE, name] += total - sum(n for (_, fused), n in pairs.items() if fused == name)
    sizes: Counter[str] = Counter()
    for (ref, fused), n in pairs.items():
        sizes[fused if ref == FALSE else ref] += n
    order = sorted((name for name, n in sizes.items() if n), key=lambda name: (-sizes[name], name))
    names = order[:_MOST_CLASSES] + ([OTHER] if len(order) > _MOST_CLASSES else [])
    rows, columns = (*names, FALSE), (*names, MISSED)
    counts = np.zeros((len(rows), len(columns)), np.int64)
    for (ref, fused), n in pairs.items():
        if n:
            counts[_place(ref, rows), _place(fused, columns)] += n
    return Confusion(rows, columns, counts)


def _place(name: str, names: tuple[str, ...]) -> int:
    return names.index(name if name in names else OTHER)
