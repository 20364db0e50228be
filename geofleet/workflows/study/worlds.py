"""What a study simulates: a place, a drive and a scenario, and which fleets of it are mapped by which methods."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from geofleet.algorithms.staleness import Staleness
from geofleet.config import load_config
from geofleet.errors import ConfigError, InputError
from geofleet.formats.layers import read_layer
from geofleet.steps.ingest import ingest_drive
from geofleet.tables.manifest import hash_path
from geofleet.tables.schemas import DRIVES, SIGNS
from geofleet.tables.store import read_table, write_table

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from geofleet.config import Config
    from geofleet.workflows.study.methods import Method

USUAL_PRIOR = Staleness(0.15, 0.10, 0.10, 0.10, moved_m=5.0, sigma_m=0.15)
"""How outdated the prior map of `joint-prior` is, unless a study says otherwise."""


@dataclass(frozen=True, slots=True)
class World:
    """A place, a drive and a scenario.

    Parameters
    ----------
    place
        What tables and figures call the place: the name of the drive, unless a study names it.
    setting
        What the scenario is changed in, e.g. `semantic_rate=0.98`; empty when in nothing.
    signs, drive
        A `signs` and a `drives` table.
    config
        The settings.
    """

    place: str
    setting: str
    signs: Path
    drive: Path
    config: Config


@dataclass(frozen=True, slots=True)
class Study:
    """What is simulated, mapped and scored.

    Parameters
    ----------
    worlds, methods, sizes
        Every method maps the first V vehicles of every world, for every V of `sizes`.
    n_replicates, seed
        Independent fleets of a world, and the seed of all.
    in_view
        Score only signs that some pass of the largest fleet had in view.
    prior
        The map that `joint-prior` starts from; by default an outdated copy of the scene, drawn anew a replicate.
    """

    worlds: tuple[World, ...]
    methods: tuple[Method, ...]
    sizes: tuple[int, ...]
    n_replicates: int = 10
    seed: int = 0
    in_view: bool = False
    prior: Path | None = None

    def __post_init__(self) -> None:
        if not self.sizes or min(self.sizes) < 1:
            raise ConfigError("fleet sizes are numbers from 1.", where="--vehicles", todo="Example: --vehicles 5,10,50")
        if self.n_replicates < 1:
            raise ConfigError(f"{self.n_replicates} replicates.", where="--replicates", todo="Give 1 or more.")
        if self.prior is not None and not any(method.has_prior for method in self.methods):
            raise ConfigError("no method here starts from a prior map.", where="--prior", todo="Name joint-prior.")
        if self.prior is not None and not self.prior.exists():
            raise InputError("there is no such file.", where=str(self.prior), todo="Check the path.")


def prepare_worlds(
    signs: Path,
    drives: Sequence[Path],
    scenarios: Sequence[str | Path],
    folder: Path,
    *,
    settings: Iterable[str],
    sweep: str = "",
) -> tuple[World, ...]:
    """Read a map and drives once and combine them with scenarios.

    Parameters
    ----------
    signs, drives
        Files of any format that geofleet reads.
    scenarios
        Names of packaged scenarios, or paths.
    folder
        Where the tables are written, unless the inputs are tables already.
    settings
        `key=value` texts that hold in every world.
    sweep
        `key=value,value,…`: every scenario with each of these values.

    Raises
    ------
    InputError
        A file cannot be read.
    ConfigError
        A scenario or a key is unknown, or a value is out of range.
    """
    key, _, values = sweep.partition("=")
    if sweep and not (key and values):
        raise ConfigError(f"{sweep!r} is not KEY=VALUE,VALUE,…", where="--sweep", todo="Example: semantic_rate=0.9,1")
    changes = [f"{key.strip()}={value.strip()}" for value in values.split(",")] if sweep else [""]
    configs = [
        (change, load_config(scenario, [*settings, *([change] if change else [])]))
        for scenario in scenarios
        for change in changes
    ]
    table = as_signs_table(signs, folder)
    worlds = []
    for number, drive in enumerate(drives):
        path = as_drives_table(drive, folder / f"{drive.name.partition('.')[0]}-drive-{number}.parquet")
        place = ", ".join(pc.unique(read_table(DRIVES, path, columns=["drive_id"])["drive_id"]).to_pylist())
        worlds += [World(place, change, table, path, config) for change, config in configs]
    return tuple(worlds)


def as_signs_table(path: Path, folder: Path) -> Path:
    """Return a `signs` table of a map: itself when it is one, else a new one in a folder."""
    if _is_table(path, SIGNS.name):
        return path
    out = folder / f"{path.name.partition('.')[0]}-signs.parquet"  # messages name it
    write_table(SIGNS, read_layer(path).table.combine_chunks(), out)
    return out


def as_drives_table(path: Path, out: Path) -> Path:
    """Return a `drives` table of a drive: itself when it is one, else a new one."""
    if not _is_table(path, DRIVES.name):
        ingest_drive([path], out)
        return out
    return path


def _is_table(path: Path, name: str) -> bool:
    try:
        return (pq.read_metadata(path).metadata or {}).get(b"geofleet:table") == name.encode()
    except (pa.ArrowInvalid, OSError):
        return False


@cache
def hash_input(path: Path) -> str:
    """Return the SHA-256 of a file, read once."""
    return hash_path(path)


@cache
def code_digest() -> str:
    """Return a digest of the program: scores of two versions of it are never mixed."""
    package = Path(__file__).resolve().parents[2]
    folders = [package, *(path for path in (package / "_sql", package.parent / "sql") if path.is_dir())]
    files = sorted(
        {path for folder in folders for suffix in ("py", "sql", "csv") for path in folder.rglob(f"*.{suffix}")}
    )
    digest = hashlib.sha256()
    for path in files:
        digest.update(path.relative_to(package.parent).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:16]
