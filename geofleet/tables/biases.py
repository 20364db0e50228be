"""Range and bearing bias of every pass, solved from its own tracks before anything is clustered.

`sql/aggregate/solved`, `biases` and `corrected` hold the mathematics: a pass is one row of sums, so that memory follows
the passes and not the detections.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from geofleet.errors import InputError
from geofleet.tables.binding import bind_table
from geofleet.tables.database import create_view, keep_table, materialise
from geofleet.tables.schemas import PASSES

if TYPE_CHECKING:
    from pathlib import Path

    import duckdb

RANGE_BIAS_SIGMA_M, BEARING_BIAS_SIGMA_DEG = 5.0, 5.0
"""Prior of a car that declares none: weak, a few times what a calibrated camera shows."""


@dataclass(frozen=True, slots=True)
class BiasSummary:
    """What was taken out: passes, and those without a say in it; detections without the information form."""

    n_passes: int
    n_unsolved: int
    n_uncorrected: int
    range_rms_m: float
    bearing_rms_deg: float

    def notes(self) -> tuple[str, ...]:
        """Return it in sentences."""
        size = f"{self.range_rms_m:.2f} m of range and {self.bearing_rms_deg:.2f} degrees of bearing"
        notes = [f"The bias of {self.n_passes} passes is taken out: {size} (root mean square)."]
        if self.n_unsolved:
            notes.append(f"{self.n_unsolved} of them have no track of three frames or more: their bias is taken as 0.")
        if self.n_uncorrected:
            notes.append(
                f"{self.n_uncorrected} detections carry no usable information form and stay where they were uploaded."
            )
        return tuple(notes)


def correct_passes(connection: duckdb.DuckDBPyConnection, detections: Path, passes: Path | None) -> BiasSummary:
    """Make the view `placed` of corrected positions, from the view `usable`.

    Parameters
    ----------
    connection
        It has the view `usable`.
    detections
        Where they come from, for messages.
    passes
        A `passes` table; its `range_bias_sigma_m` and `bearing_bias_sigma_deg`, where given, are the priors.

    Raises
    ------
    InputError
        No detection carries the information form.
    """
    if passes:
        bind_table(connection, PASSES, passes, name="driven", is_filled=True)
    else:
        keep_table(connection, PASSES.arrow().empty_table(), "driven")
    create_view(connection, "aggregate/solved")
    n_usable, n_solved = connection.table("solved").aggregate("count(*), count(q_e)").fetchall()[0]
    if n_usable and not n_solved:
        raise InputError(
            f"none of {n_usable} detections carries a usable information form (info_matrix, info_vector), from which "
            "the bias of a pass is solved.",
            where=str(detections),
            todo="Leave --correct-bias out, or have vehicles send it: simulate with --set send_information=true.",
        )
    sigmas = {"range_bias_sigma_m": RANGE_BIAS_SIGMA_M, "bearing_bias_sigma_deg": BEARING_BIAS_SIGMA_DEG}
    materialise(connection, "aggregate/biases", sigmas)
    create_view(connection, "aggregate/corrected", alias="placed")
    totals = (
        connection.table("biases")
        .aggregate(
            "count(*), count(*) FILTER (WHERE n_tracks = 0), coalesce(sqrt(avg(range_bias_m ** 2)), 0), "
            "coalesce(degrees(sqrt(avg(bearing_bias_rad ** 2))), 0)"
        )
        .fetchall()[0]
    )
    return BiasSummary(totals[0], totals[1], n_usable - n_solved, totals[2], totals[3])
