"""The steps as functions of GeoDataFrames, under the names of the command line.

Every frame is in OGC:CRS84 when it comes out and in any CRS when it goes in. A call runs the same step on the same
tables as the command does, in a temporary folder, so both give the same numbers.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from geofleet.config import load_config
from geofleet.steps import aggregate as aggregate_step
from geofleet.steps import evaluate as evaluate_step
from geofleet.steps import ingest as ingest_step
from geofleet.steps import simulate as simulate_step
from geofleet.tables.schemas import DETECTIONS, DRIVES, PASSES, REFERENCE, SIGNS, TRUTH, Schema
from geofleet.tables.store import from_geodataframe, read_table, to_geodataframe, write_table

if TYPE_CHECKING:
    import pandas as pd
    from geopandas import GeoDataFrame

    from geofleet.algorithms.metrics import MapScore


@dataclass(frozen=True, slots=True)
class Simulation:
    """What a simulated run leaves: the scene, where vehicles drove, what they sent, and where that came from."""

    reference: GeoDataFrame
    passes: GeoDataFrame
    detections: GeoDataFrame
    truth: pd.DataFrame


def read_signs(path: str | Path, **options: Any) -> GeoDataFrame:
    """Read the signs of any map that geofleet knows; options are those of `geofleet ingest signs`.

    Raises
    ------
    InputError
        The file is missing, empty or of an unknown format.
    """
    with TemporaryDirectory() as folder:
        ingest_step.ingest_signs([Path(path)], Path(folder) / "signs.parquet", **options)
        return _read(SIGNS, Path(folder) / "signs.parquet")


def read_drive(path: str | Path) -> GeoDataFrame:
    """Read a trajectory; options are those of `geofleet ingest drive`.

    Raises
    ------
    InputError
        The file is missing, empty or of an unknown format.
    """
    with TemporaryDirectory() as folder:
        ingest_step.ingest_drive([Path(path)], Path(folder) / "drives.parquet")
        return _read(DRIVES, Path(folder) / "drives.parquet")


def simulate(
    signs: GeoDataFrame,
    drive: GeoDataFrame,
    scenario: str = "paper",
    n_vehicles: int = 50,
    seed: int = 0,
    **overrides: Any,
) -> Simulation:
    """Simulate a fleet past signs; any key of a scenario may be overridden, e.g. `range_m=50`.

    Raises
    ------
    ConfigError
        The scenario or a key is unknown, or a value is out of range.
    InputError
        No signs stand near the drive, or the drive does not move.
    """
    config = load_config(scenario, overrides)
    with TemporaryDirectory() as folder:
        here = Path(folder)
        write_table(SIGNS, from_geodataframe(SIGNS, signs), here / "signs.parquet")
        write_table(DRIVES, from_geodataframe(DRIVES, drive), here / "drives.parquet")
        out = here / "simulation"
        simulate_step.simulate(
            here / "signs.parquet", here / "drives.parquet", out, config=config, n_vehicles=n_vehicles, seed=seed
        )
        return Simulation(
            _read(REFERENCE, out / "reference.parquet"),
            _read(PASSES, out / "passes.parquet"),
            _read(DETECTIONS, out / "detections"),
            read_table(TRUTH, out / "truth").to_pandas(),
        )


def aggregate(
    detections: GeoDataFrame,
    method: str = "dbscan",
    semantic: str = "first",
    prior: GeoDataFrame | None = None,
    passes: GeoDataFrame | None = None,
    *,
    n_vehicles: int | None = None,
    area: tuple[float, float, float, float] | None = None,
    **overrides: Any,
) -> GeoDataFrame:
    """Cluster detections and fuse them into a sign map; any key of a scenario may be overridden, e.g. `eps_m=3`.

    With `passes`, support is relative to the passes that had a place in view; with `correct_bias=True`, the bias of
    each pass is taken out first; with `min_samples=3`, clusters are scikit-learn's. `method="joint"` takes `passes` as
    evidence of what was not seen, and a `prior` map. Detections outside an `area` (west, south, east, north in degrees)
    are left out.

    Detections that cannot be used are left out with a warning; `.attrs` of what is returned counts them by reason
    (`skipped`), and those of classes that the vocabulary does not know (`unknown_classes`).

    Raises
    ------
    ConfigError
        A key is unknown, a value is out of range, or a prior map is given to another method than joint.
    TableError
        A column is missing or mistyped.
    """
    config = load_config(overrides={"method": method, "semantic": semantic, **overrides})
    with TemporaryDirectory() as folder:
        source, out = Path(folder) / "detections.parquet", Path(folder) / "fused.parquet"
        write_table(DETECTIONS, from_geodataframe(DETECTIONS, detections), source)
        driven = Path(folder) / "passes.parquet" if passes is not None else None
        if driven:
            write_table(PASSES, from_geodataframe(PASSES, passes), driven)
        before = Path(folder) / "prior.parquet" if prior is not None else None
        if before:
            write_table(SIGNS, from_geodataframe(SIGNS, prior), before)
        result = aggregate_step.aggregate(
            source, out, config=config, n_vehicles=n_vehicles, passes=driven, prior=before, area=area
        )
        fused = _read(SIGNS, out)
    if result.n_rejected:
        reasons = ", ".join(f"{n} {reason}" for reason, n in result.skipped.items())
        warnings.warn(f"{result.n_rejected} of {result.n_detections} detections are left out: {reasons}.", stacklevel=2)
    fused.attrs = {"skipped": result.skipped, "unknown_classes": result.unknown_classes}
    return fused


def score_map(map_: GeoDataFrame, reference: GeoDataFrame, gate_m: float = 2.0, match_on: str = "class") -> MapScore:
    """Score the main signs of a map against a reference (paper, eq. GOSPA_M; DOI 10.23919/ICIF.2017.8009645).

    Parameters
    ----------
    map_, reference
        One map and its reference; frames that hold several runs are refused.
    gate_m
        c: a match is nearer than this.
    match_on
        What must be equal in a match: `class`, `concept` or `none`.

    Raises
    ------
    ConfigError
        A frame holds more than one run, or an option is out of range.
    """
    config = load_config(overrides={"gate_m": gate_m, "match_on": match_on})
    return evaluate_step.score_layers(
        from_geodataframe(SIGNS, map_), from_geodataframe(SIGNS, reference), config=config.evaluate
    )


def _read(schema: Schema, path: Path) -> GeoDataFrame:
    return to_geodataframe(read_table(schema, path))
