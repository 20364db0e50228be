"""The manifest of a step: what it read, with which settings and versions, and what it wrote. Always written last.

It holds no clock and no path, so the same work gives the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import platform
from functools import cache
from importlib import metadata
from threading import Thread
from typing import TYPE_CHECKING, Any

from geofleet.tables.store import atomic_path

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

_PACKAGES = ("geofleet", "duckdb", "numpy", "numba", "scipy", "pyarrow", "pyproj", "shapely", "osmium")


def manifest_path(out: Path) -> Path:
    """Return where the manifest of an output that exists stands: in a folder, beside a file (`signs_manifest.json`)."""
    return out / "_manifest.json" if out.is_dir() else out.with_name(f"{out.stem}_manifest.json")


def write_manifest(
    out: Path,
    *,
    step: str,
    inputs: Iterable[Path] | Hashing,
    config_digest: str = "",
    settings: Mapping[str, Any] | None = None,
    counts: Mapping[str, Any] | None = None,
) -> Path:
    """Write the manifest of an output file or folder atomically and return its path.

    Inputs may have been hashed since before the step began.
    """
    path = manifest_path(out)
    hashing = inputs if isinstance(inputs, Hashing) else Hashing(inputs)
    content = {
        "step": step,
        "inputs": [{"name": p.name, "sha256": digest} for p, digest in hashing.digests()],
        "output_sha256": hash_path(out),
        "config_digest": config_digest,
        "settings": dict(settings or {}),
        "counts": dict(counts or {}),
        "versions": _versions(),
    }
    with atomic_path(path) as draft:
        draft.write_text(json.dumps(content, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    return path


@cache
def _versions() -> dict[str, str]:
    return {"python": platform.python_version(), **{name: metadata.version(name) for name in _PACKAGES}}


class Hashing:
    """Hashes of input files or folders, taken on a thread beside the work; the errors of a step do not wait for it."""

    def __init__(self, paths: Iterable[Path]) -> None:
        self._paths = sorted(paths)
        self._digests: list[str | OSError] = []
        self._thread = Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        for path in self._paths:
            try:
                self._digests.append(hash_path(path))
            except OSError as error:
                self._digests.append(error)

    def digests(self) -> list[tuple[Path, str]]:
        """Return every path with its hash, sorted, once all are there."""
        self._thread.join()
        for digest in self._digests:
            if isinstance(digest, OSError):
                raise digest
        return [(path, str(digest)) for path, digest in zip(self._paths, self._digests, strict=True)]


def hash_path(path: Path) -> str:
    """Return the SHA-256 of a file, or of the names and contents of all files below a folder but manifests."""
    if path.is_file():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file() and not p.name.endswith("_manifest.json")):
        digest.update(file.relative_to(path).as_posix().encode() + b"\0" + hash_path(file).encode())
    return digest.hexdigest()
