"""Simulated fleets for the benchmark of joint fusion, in memory: detections, truth, and what they are scored against.

What a method is scored against are the signs that at least one pass of the fleet reported: a sign that nobody saw, or
that no tracker kept, is beyond every method that makes a map of tracks. `truth`, which no method may open, says which.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zlib import crc32

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.metrics import score_points
from geofleet.config import load_config
from geofleet.steps.ingest import ingest_drive, ingest_signs
from geofleet.steps.simulate import simulate
from geofleet.tables.schemas import BBOX, DETECTIONS, DRIVES, GEOMETRY, PASSES, REFERENCE, SIGNS, TRUTH
from geofleet.tables.store import build_table, lonlat, read_table, write_table
from geofleet.tables.tracks import Assumed, fleet_arrays

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from geofleet.algorithms.metrics import MapScore
    from geofleet.tables.tracks import Fleet

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

RAW = Path(__file__).parent.parent / "data/raw"
DRIVE_FILES = {"A": "helsinki_derived", "B": "helsinki_derived_b"}
"""A is the demo's; B was not used to develop anything."""
SEED = 20_261_128
GATE_M = 2.0
ASSUMED = Assumed(1.5, 3.0, 3.0)
"""Stands for what passes do not declare; those of a simulation declare everything."""
EVERY_M, EVERY_TH = 9.0, 7
"""`regular` signs stand so far apart, all of one class but every so many-th: a map can lock on shifted by one."""


@dataclass(frozen=True)
class Case:
    """A world: scenario, drive, what is set beside, and the layer of signs (`real`, or `regular`: made up)."""

    scenario: str = "paper-ideal"
    drive: str = "A"
    settings: dict[str, Any] = field(default_factory=dict)
    n_vehicles: int = 50
    signs: str = "real"
    batch: int = 20
    """Replicates that are simulated at once."""
    seed: int = SEED

    @property
    def name(self) -> str:
        """A name for its folder."""
        settings = crc32(repr(sorted(self.settings.items())).encode())
        seed = "" if self.seed == SEED else f"-seed{self.seed}"
        return f"{self.scenario}-{self.drive}-{self.signs}-{self.n_vehicles}-{settings:08x}{seed}"


@dataclass(frozen=True, eq=False)
class Run:
    """One replicate of a case: its tables, sorted, and the scene in a local frame."""

    run_id: str
    reference: pa.Table
    passes: pa.Table
    detections: pa.Table
    truth: pa.Table

    @cached_property
    def frame(self) -> EnuFrame:
        """The frame in which maps are scored."""
        return EnuFrame.around(*lonlat(self.reference))

    @cached_property
    def classes(self) -> tuple[str, ...]:
        """All classes, in the order of their codes."""
        return tuple(sorted({*self.detections["sign_class"].to_pylist(), *self.reference["sign_class"].to_pylist()}))

    def codes(self, table: pa.Table) -> Ints:
        """Return the class codes of a table."""
        code = {name: at for at, name in enumerate(self.classes)}
        return np.array([code[name] for name in table["sign_class"].to_pylist()], np.int64)

    @cached_property
    def reference_xy(self) -> Floats:
        """(n, 2) where the signs of the scene stand."""
        return self.frame.to_enu(*lonlat(self.reference))

    @cached_property
    def reference_code(self) -> Ints:
        """(n,) their classes."""
        return self.codes(self.reference)

    def first_vehicles(self, n: int) -> Run:
        """Return the run of its first vehicles."""
        kept = pa.array(sorted(set(self.passes["vehicle_id"].to_pylist()))[:n])
        passes = self.passes.filter(pc.is_in(self.passes["vehicle_id"], kept))
        mask = pc.is_in(self.detections["vehicle_id"], kept)
        return replace(self, passes=passes, detections=self.detections.filter(mask), truth=self.truth.filter(mask))

    @cached_property
    def fleet(self) -> Fleet:
        """What joint fusion takes."""
        lon, lat = lonlat(self.detections)
        placed = self.detections.append_column("lon", pa.array(lon)).append_column("lat", pa.array(lat))
        code = self.codes(self.detections)
        return fleet_arrays(placed, self.passes, class_code=code, frame=self.frame, assumed=ASSUMED)

    @cached_property
    def true_sign(self) -> Ints:
        """(n_tracks,) row of the reference that each track is of, -1 for a ghost."""
        row = {name: at for at, name in enumerate(self.reference["sign_id"].to_pylist())}
        return np.array([row.get(name, -1) for name in self.truth["ref_sign_id"].to_pylist()], np.int64)

    @cached_property
    def reported(self) -> Ints:
        """Rows of the reference that a pass of this fleet reported: what maps are scored against."""
        told: Ints = np.unique(self.true_sign[self.true_sign >= 0])
        return told

    @cached_property
    def in_view(self) -> Ints:
        """Rows of the reference that at least half of the passes report: what the drive has in view, not in passing."""
        pairs = np.unique(np.column_stack((self.true_sign, self.fleet.tracks.pass_code))[self.true_sign >= 0], axis=0)
        n_passes = np.bincount(pairs[:, 0], minlength=len(self.reference_xy))
        rows: Ints = np.flatnonzero(2 * n_passes >= self.passes.num_rows)
        return rows

    def score(self, xy_m: Floats, class_code: Ints) -> MapScore:
        """Score a map against the signs that were reported."""
        return score_points(
            xy_m, class_code, self.reference_xy[self.reported], self.reference_code[self.reported], gate_m=GATE_M
        )


def inputs(folder: Path, case: Case) -> tuple[Path, Path]:
    """Return the layer of signs and the drive of a case, read once."""
    folder.mkdir(parents=True, exist_ok=True)
    real, drive = folder / "signs.parquet", folder / f"{DRIVE_FILES[case.drive]}.parquet"
    if not real.exists():
        ingest_signs([RAW / "helsinki.osm.pbf"], real)
    if not drive.exists():
        ingest_drive([RAW / f"{DRIVE_FILES[case.drive]}.pos"], drive)
    if case.signs == "real":
        return real, drive
    regular = folder / f"regular-{case.drive}.parquet"
    if not regular.exists():
        write_table(SIGNS, _regular(read_table(SIGNS, real), read_table(DRIVES, drive)), regular)
    return regular, drive


def _regular(signs: pa.Table, drive: pa.Table) -> pa.Table:
    """Return signs at regular spacing beside the drive: made up."""
    lon, lat = lonlat(drive)
    frame = EnuFrame.around(lon, lat)
    path = frame.to_enu(lon, lat)
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(path, axis=0).T))))
    at = np.arange(EVERY_M, along[-1], EVERY_M)
    east, north = np.interp(at, along, path[:, 0]), np.interp(at, along, path[:, 1])
    ahead_e, ahead_n = np.interp(at + 1, along, path[:, 0]) - east, np.interp(at + 1, along, path[:, 1]) - north
    length = np.maximum(np.hypot(ahead_e, ahead_n), 1e-9)
    place = np.column_stack((east + 4 * ahead_n / length, north - 4 * ahead_e / length))
    classes = signs["sign_class"].to_pylist()
    few, many = classes.index("no_entry"), classes.index("yield")
    rows = signs.take(pa.array([few if number % EVERY_TH == 0 else many for number in range(len(at))]))
    columns = {name: rows[name] for name in rows.column_names if name not in (GEOMETRY, BBOX)}
    names = [f"made{number:04}" for number in range(len(at))]
    # a support each: equal classes on one support count once
    made = {"sign_id": names, "support_id": names, "source": "made up: signs at regular spacing"}
    return build_table(SIGNS, columns | made, geometry=frame.to_lonlat(place))


def runs(folder: Path, case: Case, n_replicates: int, *, first: int = 0) -> Iterator[tuple[int, Run]]:
    """Yield the replicates of a case with their numbers, from a batch on, simulated where they are not there yet."""
    for begin in range(first, n_replicates, case.batch):
        yield from enumerate(islice(_batch(folder, case, begin), n_replicates - begin), begin)


def simulated(folder: Path, case: Case, first: int) -> Path:
    """Return the folder of the batch of replicates that begins with `first`."""
    out = folder / f"{case.name}-{first}-{case.batch}"
    if not (out / "_manifest.json").exists():
        signs, drive = inputs(folder, case)
        config = load_config(case.scenario, case.settings)
        simulate(
            signs,
            drive,
            out,
            config=config,
            n_vehicles=case.n_vehicles,
            n_replicates=case.batch,
            first_replicate=first,
            seed=case.seed,
        )
    return out


def _batch(folder: Path, case: Case, first: int) -> Iterator[Run]:
    out = simulated(folder, case, first)
    names = {"reference": REFERENCE, "passes": PASSES, "detections": DETECTIONS, "truth": TRUTH}
    paths = {"reference": "reference.parquet", "passes": "passes.parquet", "detections": "detections", "truth": "truth"}
    whole = {name: read_table(schema, out / paths[name]) for name, schema in names.items()}
    for run_id in sorted(set(whole["reference"]["run_id"].to_pylist())):
        of_run = {name: table.filter(pc.equal(table["run_id"], run_id)) for name, table in whole.items()}
        keys = [("pass_id", "ascending"), ("track_id", "ascending")]
        yield Run(
            run_id,
            of_run["reference"].sort_by("sign_id"),
            of_run["passes"].sort_by("pass_id"),
            of_run["detections"].sort_by(keys),
            of_run["truth"].sort_by(keys),
        )
