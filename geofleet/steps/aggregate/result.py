"""What became of the detections, and what is written beside a layer."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pyarrow.compute as pc
import pyarrow.parquet as pq

from geofleet.errors import InputError
from geofleet.tables.manifest import write_manifest
from geofleet.tables.schemas import EVIDENCE
from geofleet.tables.store import atomic_path, read_table
from geofleet.taxonomy.reader import load_taxonomy

if TYPE_CHECKING:
    from pathlib import Path

    import pyarrow as pa

    from geofleet.config import Config
    from geofleet.tables.manifest import Hashing
    from geofleet.tables.staging import Limits


_MAX_CLASSES = 20  # that are told one by one


@dataclass(frozen=True, slots=True)
class AggregateResult:
    """What became of the detections.

    `label` is what the layer calls its method. `skipped` counts the rejected detections by reason,
    `unknown_classes` those that are used by class where the vocabulary does not have it, the most frequent ones.
    `n_detections` and `n_rejected` count the whole table, `n_used` the vehicles asked for; signs are clusters with
    enough passes. `n_tiles` is None where runs are estimated whole. `n_suspect_passes`, of joint fusion only, are
    those far from what they declare.
    """

    out: Path
    label: str
    rejected: Path | None
    run_ids: tuple[str, ...]
    n_vehicles: int
    n_detections: int
    n_rejected: int
    n_used: int
    n_tiles: int | None
    n_clusters: int
    n_signs: int
    skipped: dict[str, int] = field(default_factory=dict)
    unknown_classes: dict[str, int] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    n_suspect_passes: int | None = None

    def summary(self) -> list[str]:
        """Return the result in sentences."""
        where = "each run as a whole" if self.n_tiles is None else f"in {self.n_tiles or 'no'} tiles"
        lines = [
            (
                f"{self.n_signs} signs from {self.n_used} of {self.n_detections} detections of {self.n_vehicles} "
                f"vehicles in {len(self.run_ids)} run(s): {self.n_clusters} clusters {where}, "
                f"{self.n_clusters - self.n_signs} with too little support."
            ),
            *self.notes,
        ]
        if self.rejected:
            reasons = ", ".join(f"{n} {reason}" for reason, n in self.skipped.items())
            lines.append(f"{self.n_rejected} detections could not be used ({reasons}): {self.rejected}")
        return [*lines, f"Written: {self.out}"]


def beside(out: Path, name: str) -> Path:
    """Return where the side table of a layer is."""
    return out.with_name(f"{out.stem}_{name}.parquet")


def explain(out: Path, sign_id: str) -> pa.Table:
    """Return the evidence of a sign of a jointly fused layer: detections, passes, residuals and classes read.

    Raises
    ------
    InputError
        The layer has no evidence beside it, or no such sign.
    """
    evidence = read_table(EVIDENCE, beside(out, "evidence"))
    rows = evidence.filter(pc.equal(evidence["sign_id"], sign_id))
    if rows.num_rows == 0:
        raise InputError(
            f"no detection belongs to a sign {sign_id!r}.",
            where=str(beside(out, "evidence")),
            todo="Take a sign_id of the layer; one that only the prior map knows has no detections.",
        )
    return rows


def write_rejected(rejected: pa.Table, out: Path) -> Path | None:
    """Write the rejected rows beside the output; without any, remove what an earlier run left there."""
    path = out.with_name(f"{out.stem}_rejected.parquet")
    if rejected.num_rows == 0:
        path.unlink(missing_ok=True)
        return None
    with atomic_path(path) as draft:
        pq.write_table(rejected, draft, compression="zstd")
    return path


def count_reasons(rejected: pa.Table) -> dict[str, int]:
    """Return how many rows each reason kept out, by reason."""
    counts = pc.value_counts(rejected["reason"]).to_pylist()
    return dict(sorted((row["values"], row["counts"]) for row in counts))


def unknown_classes(n_of_class: dict[str, int]) -> dict[str, int]:
    """Return the counts of the classes whose concept the vocabulary does not have, the most frequent first."""
    known = load_taxonomy().concepts
    counts = {name: n for name, n in n_of_class.items() if n and name.partition(":")[0] not in known}
    order = sorted(counts, key=lambda name: (-counts[name], name))
    few_of = {name: counts[name] for name in order[:_MAX_CLASSES]}
    left = len(order) - len(few_of)
    return few_of | ({f"{left} more": sum(counts[name] for name in order[_MAX_CLASSES:])} if left else {})


def few(fleet: dict[str, int], n_vehicles: int | None) -> tuple[str, ...]:
    """Return where fewer vehicles report than were asked for."""
    if not fleet:
        return ("There are no detections: the layer is empty.",)
    return tuple(
        f"Run {run_id}: {reporting} of the {n_vehicles} vehicles asked for have detections."
        for run_id, reporting in fleet.items()
        if n_vehicles and reporting < n_vehicles
    )


def write_result_manifest(result: AggregateResult, inputs: Hashing, config: Config, limits: Limits) -> None:
    """Write the manifest of a layer, last of all."""
    names = [
        "n_vehicles",
        "n_detections",
        "n_rejected",
        "n_used",
        "n_clusters",
        "n_signs",
        "skipped",
        "unknown_classes",
    ]
    if result.n_suspect_passes is not None:  # only joint fusion looks
        names.append("n_suspect_passes")
    write_manifest(
        result.out,
        step="aggregate",
        inputs=inputs,
        config_digest=config.digest("aggregate"),
        settings={**config.aggregate.model_dump(), "label": result.label, "area": limits.area},
        counts={name: getattr(result, name) for name in names},
    )
