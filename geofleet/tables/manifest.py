"""The manifest of a step: what it read, with which settings and versions, and what it wrote. Always written last.

It holds no clock and no path, so the same work gives the same bytes.
"""

from __future__ import annotations

import hashlib
import json
import platform
from importlib import metadata
from typing import TYPE_CHECKING, Any

from geofleet.tables.store import atomic_path

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

_PACKAGES = ("geofleet", "duckdb", "numpy", "numba", "scipy", "pyarrow", "pyproj", "shapely", "osmium")


def manifest_path(out: Path) -> Path:
    """Return where the manifest of an output stands: inside a folder, beside a file (`signs_manifest.json`)."""
    return out.with_name(f"{out.stem}_manifest.json") if out.suffix else out / "_manifest.json"


def write_manifest(
    out: Path,
    *,
    step: str,
    inputs: Iterable[Path],
    config_digest: str = "",
    settings: Mapping[str, Any] | None = None,
    counts: Mapping[str, Any] | None = None,
) -> Path:
    """Write the manifest of an output file or folder atomically and return its path."""
    path = manifest_path(out)
    content = {
        "step": step,
        "inputs": [{"name": p.name, "sha256": hash_path(p)} for p in sorted(inputs)],
        "output_sha256": hash_path(out),
        "config_digest": config_digest,
        "settings": dict(settings or {}),
        "counts": dict(counts or {}),
        "versions": {"python": platform.python_version(), **{name: metadata.version(name) for name in _PACKAGES}},
    }
    with atomic_path(path) as draft:
        draft.write_text(json.dumps(content, indent=2, sort_keys=True) + "\n", encoding="utf-8")
    return path


def hash_path(path: Path) -> str:
    """Return the SHA-256 of a file, or of the names and contents of all files below a folder but manifests."""
    if path.is_file():
        with path.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    digest = hashlib.sha256()
    for file in sorted(p for p in path.rglob("*") if p.is_file() and not p.name.endswith("_manifest.json")):
        digest.update(file.relative_to(path).as_posix().encode() + b"\0" + hash_path(file).encode())
    return digest.hexdigest()
