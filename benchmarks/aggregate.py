"""How fast is the aggregate step? Beside scikit-learn, `dbscan`, PostGIS and DuckDB's bare scan, in one run.

    python benchmarks/aggregate.py                                  # 10^6, wide and dense: some minutes
    python benchmarks/aggregate.py --scenes wide --sizes 1e6 1e7    # with the growth from one to the other
    python benchmarks/aggregate.py --scenes wide --sizes 1e8 --only scan geofleet
    python benchmarks/aggregate.py --scenes dense --again --only geofleet scikit-learn

Parquet in, fused table out; eps 4 m, min_samples 3 within each class. *wide*: 20 passes over an area that grows;
*dense*: the same 5,446 signs, passes that grow (`aggregate_scenes.py`; simulated, seed 0). Every line is a process of
its own, timed from the call on, with its CPU time (imports too; of PostGIS only its client's) and its peak memory.
`--again` calls each task twice in its process and shows the second call too: what a service that maps tile after tile
pays, where the first call also pays for what is loaded once (compiled code here, libraries elsewhere). All clusterings
get the same east and north and must give the same groups and noise. Peers that are not installed are skipped by name:
`pip install dbscan`, and Debian's postgresql-15-postgis-3, which is started for the run below a
temporary folder, on 127.0.0.1, as an unprivileged user.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import socket
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from aggregate_scenes import write_dense, write_wide

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

EPS_M, MIN_SAMPLES = 4.0, 3
POSTGRES = Path("/usr/lib/postgresql/15/bin")
WRITERS = {"wide": write_wide, "dense": write_dense}
SCAN = """
SELECT run_id, vehicle_id, pass_id, sign_class, count(*), min(track_id), max(track_id), avg(bbox.xmin), avg(bbox.ymin),
    sum(n_frames), avg(sigma_e_m), avg(sigma_n_m), min(t_first), max(t_last), avg(class_confidence)
FROM read_parquet($path) GROUP BY ALL
"""


def load(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Read east and north (one plane) and the class of every detection."""
    import pyarrow.parquet as pq

    from geofleet.algorithms.geodesy import EnuFrame

    table = pq.read_table(path, columns=["bbox", "sign_class"])
    bbox = table["bbox"].combine_chunks()
    lon, lat = (bbox.field(side).to_numpy() for side in ("xmin", "ymin"))
    codes = table["sign_class"].combine_chunks().dictionary_encode().indices.to_numpy().astype(np.int64)
    return np.ascontiguousarray(EnuFrame.around(lon, lat).to_enu(lon, lat)), codes


def by_class(path: Path, cluster: Callable[[NDArray[np.float64]], NDArray[Any]]) -> tuple[float, NDArray[np.int64]]:
    """Cluster class by class and return the seconds of the clustering and the labels."""
    xy, codes = load(path)
    labels, seconds, n_found = np.full(len(xy), -1, np.int64), 0.0, 0
    for code in range(int(codes.max()) + 1):
        rows = np.flatnonzero(codes == code)
        points = xy[rows]
        begin = time.perf_counter()
        found = cluster(points)
        seconds += time.perf_counter() - begin
        labels[rows] = np.where(found < 0, -1, found + n_found)
        n_found += int(found.max(initial=-1)) + 1
    return seconds, labels


def fuse(path: Path, labels: NDArray[np.int64], out: Path) -> None:
    """Make a table of mean positions and counts of labels, as a user of a peer would: DuckDB over the labels."""
    import duckdb
    import pyarrow as pa

    connection = duckdb.connect(config={"threads": 2})
    connection.register("labels", pa.table({"label": labels}))
    connection.execute(
        "COPY (SELECT label, any_value(sign_class) AS sign_class, avg(bbox.xmin) AS lon, avg(bbox.ymin) AS lat, "
        "count(*) AS n_detections, count(DISTINCT pass_id) AS n_passes, avg(class_confidence) AS class_confidence, "
        "min(t_first) AS first_seen, max(t_last) AS last_seen "
        "FROM read_parquet($path) POSITIONAL JOIN labels WHERE label >= 0 GROUP BY label "
        "HAVING count(DISTINCT pass_id) >= 3 ORDER BY label) TO $out (FORMAT parquet)",
        {"path": str(path), "out": str(out)},
    )


def scan(path: Path, _: Path) -> dict[str, Any]:
    import duckdb

    connection = duckdb.connect(config={"threads": 2})
    begin = time.perf_counter()
    connection.execute(SCAN, {"path": str(path)}).to_arrow_table()
    return {"whole_s": time.perf_counter() - begin}


def geofleet(path: Path, work: Path) -> dict[str, Any]:
    from geofleet.config import load_config
    from geofleet.steps.aggregate import aggregate

    begin = time.perf_counter()
    plain = {"min_support_share": 0.0, "min_samples_share": 0.0}  # the same clusters and signs as the peers
    result = aggregate(path, work / "fused.parquet", config=load_config(overrides=plain), n_workers=2)
    return {"whole_s": time.perf_counter() - begin, "n_signs": result.n_signs}


def geofleet_kernel(path: Path, work: Path) -> dict[str, Any]:
    from geofleet.algorithms.clustering import dbscan_groups

    xy, codes = load(path)
    dbscan_groups(xy[:1000], codes[:1000], eps_m=EPS_M, min_samples=MIN_SAMPLES)  # compiled code from its cache
    begin = time.perf_counter()
    labels = dbscan_groups(xy, codes, eps_m=EPS_M, min_samples=MIN_SAMPLES).labels
    seconds = time.perf_counter() - begin
    np.save(work / "labels.npy", labels)
    return {"cluster_s": seconds}


def scikit_learn(path: Path, work: Path) -> dict[str, Any]:
    from sklearn.cluster import DBSCAN

    return _peer(path, work, lambda xy: DBSCAN(eps=EPS_M, min_samples=MIN_SAMPLES).fit_predict(xy))


def pypi_dbscan(path: Path, work: Path) -> dict[str, Any]:
    from dbscan import DBSCAN

    return _peer(path, work, lambda xy: DBSCAN(np.ascontiguousarray(xy), EPS_M, MIN_SAMPLES)[0])


def _peer(path: Path, work: Path, cluster: Callable[[NDArray[np.float64]], NDArray[Any]]) -> dict[str, Any]:
    begin = time.perf_counter()
    seconds, labels = by_class(path, cluster)
    fuse(path, labels, work / "fused.parquet")
    whole = time.perf_counter() - begin
    np.save(work / "labels.npy", labels)
    return {"cluster_s": seconds, "whole_s": whole}


def postgis(path: Path, work: Path) -> dict[str, Any]:
    import duckdb
    import pyarrow as pa

    with Server(work) as server:
        server.sql(
            "CREATE EXTENSION postgis; CREATE UNLOGGED TABLE points (id bigint, class int, x float8, y float8, "
            "lon float8, lat float8, pass_id text, confidence float8, t_first timestamptz, t_last timestamptz)"
        )
        begin = time.perf_counter()
        xy, codes = load(path)
        connection = duckdb.connect(config={"threads": 2})
        connection.register("plane", pa.table({"class": codes, "x": xy[:, 0], "y": xy[:, 1]}))
        connection.execute(
            "COPY (SELECT row_number() OVER () AS id, class, x, y, bbox.xmin, bbox.ymin, pass_id, class_confidence, "
            "t_first, t_last FROM read_parquet($path) POSITIONAL JOIN plane) TO $out (FORMAT csv, HEADER false)",
            {"path": str(path), "out": str(work / "points.csv")},
        )
        server.sql(rf"\copy points FROM '{work / 'points.csv'}' (FORMAT csv)")
        loaded = time.perf_counter()
        server.sql(
            "SET work_mem = '2GB'; CREATE UNLOGGED TABLE labels AS SELECT *, "
            f"ST_ClusterDBSCAN(ST_MakePoint(x, y), {EPS_M}, {MIN_SAMPLES}) OVER (PARTITION BY class) AS label "
            "FROM points"
        )
        done = time.perf_counter()
        server.sql(
            "SET work_mem = '2GB'; CREATE UNLOGGED TABLE fused AS SELECT class, label, avg(lon) AS lon, "
            "avg(lat) AS lat, count(*) AS n_detections, count(DISTINCT pass_id) AS n_passes, "
            "avg(confidence) AS class_confidence, min(t_first) AS first_seen, max(t_last) AS last_seen FROM labels "
            "WHERE label IS NOT NULL GROUP BY class, label HAVING count(DISTINCT pass_id) >= 3"
        )
        whole = time.perf_counter() - begin
        server.sql(
            rf"\copy (SELECT coalesce(label * 1000 + class, -1) FROM labels ORDER BY id) TO '{work / 'labels.csv'}'"
        )
    np.save(work / "labels.npy", np.loadtxt(work / "labels.csv", np.int64))
    return {"cluster_s": done - loaded, "whole_s": whole}


class Server:
    """A PostgreSQL below a folder, on a free port of 127.0.0.1, for as long as the context lasts."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder / "postgres"
        self._prefix = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]

    def __enter__(self) -> Self:
        self._folder.mkdir()
        for folder in (self._folder, *list(self._folder.parents)[:3]):
            if folder != Path("/tmp"):  # noqa: S108  (the user postgres must reach it)
                folder.chmod(0o755)
        if self._prefix:
            shutil.chown(self._folder, "postgres")
        self._run("initdb", "-D", self._folder / "data", "-A", "trust", "-U", "bench", "--no-sync")
        options = f"-p {self._port} -c listen_addresses=127.0.0.1 -c unix_socket_directories= -c fsync=off"
        self._run("pg_ctl", "-D", self._folder / "data", "-w", "-l", self._folder / "log", "-o", options, "start")
        return self

    def __exit__(self, *_: object) -> None:
        self._run("pg_ctl", "-D", self._folder / "data", "-m", "immediate", "stop")

    def sql(self, text: str) -> None:
        """Run a statement of SQL or of psql."""
        where = ["-h", "127.0.0.1", "-p", str(self._port), "-U", "bench", "-d", "postgres"]
        subprocess.run([POSTGRES / "psql", *where, "-q", "-v", "ON_ERROR_STOP=1", "-c", text], check=True)

    def _run(self, program: str, *arguments: str | Path) -> None:
        subprocess.run(
            [*self._prefix, POSTGRES / program, *arguments], check=True, stdout=subprocess.DEVNULL, cwd=self._folder
        )


TASKS: dict[str, Callable[[Path, Path], dict[str, Any]]] = {
    "scan": scan,
    "geofleet": geofleet,
    "geofleet-kernel": geofleet_kernel,
    "scikit-learn": scikit_learn,
    "dbscan": pypi_dbscan,
    "postgis": postgis,
}
NEEDS = {"dbscan": find_spec("dbscan") is not None, "postgis": (POSTGRES / "initdb").exists()}


def measure(name: str, path: Path, work: Path, *, again: bool) -> dict[str, Any]:
    """Run a task in a process of its own."""
    (work / name / "again").mkdir(parents=True)
    command = [sys.executable, __file__, "--task", name, str(path), str(work / name), *(["--again"] if again else [])]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def demand_equal(labels: dict[str, NDArray[np.int64]]) -> None:
    """Stop unless all labels say the same: equal noise, and groups that map one to one."""
    (first, ours), *others = ((name, first_rows(found)) for name, found in labels.items())
    for name, theirs in others:
        assert np.array_equal(ours, theirs), f"{first} and {name} do not give the same groups"
    print(f"    equal groups and noise: {', '.join(labels)}")


def first_rows(labels: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the first row of every row's group, -1 for noise: the same for any numbering of the same groups."""
    if labels.max(initial=0) > 4 * labels.size:  # numbered with large gaps
        labels = np.where(labels < 0, -1, np.unique(labels, return_inverse=True)[1])
    first = np.full(int(labels.max(initial=-1)) + 2, -1, np.int64)
    first[labels[::-1]] = np.arange(labels.size)[::-1]  # of equal places the last one written stays
    first[-1] = -1
    return first[labels]


def run_task(name: str, path: Path, work: Path, *, again: bool) -> dict[str, Any]:
    """Run a task here, and perhaps once more; CPU time and peak memory are those of the first call and the imports."""
    result = TASKS[name](path, work)
    usage = resource.getrusage(resource.RUSAGE_SELF)
    result |= {"cpu_s": usage.ru_utime + usage.ru_stime, "peak_mb": peak_mb()}
    if again:
        begin = time.process_time()
        second = TASKS[name](path, work / "again")
        result |= {"again_s": second.get("whole_s", float("nan")), "again_cpu_s": time.process_time() - begin}
    return result


def compile_first(folder: Path) -> None:
    """Have geofleet compiled, as it is once on every machine, and say how long that took; no peer's build is timed."""
    path, work = folder / "small.parquet", folder / "small"
    write_wide(10_000, path)
    work.mkdir()
    seconds = sum(measure(name, path, work, again=False)["cpu_s"] for name in ("geofleet", "geofleet-kernel"))
    print(f"compiled before anything is timed, once per installation: {seconds:.0f} s of CPU with imports")


def peak_mb() -> float:
    """Return the most memory that this process has held; `ru_maxrss` also knows what its parent held before it."""
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.partition("VmHWM:")[2].split()[0]) / 1024


def compare(scene: str, size: int, only: list[str], folder: Path, *, again: bool) -> dict[str, dict[str, Any]]:
    """Write a scene, run every task on it and print what each took."""
    path, work = folder / f"{scene}-{size}.parquet", folder / f"{scene}-{size}"
    work.mkdir()
    WRITERS[scene](size, path)
    print(f"{scene}, {size:.0e} detections, {path.stat().st_size / 1e6:.0f} MB of Parquet")
    found = {}
    for name in only:
        if not NEEDS.get(name, True):
            print(f"    {name:16s} skipped: not installed")
            continue
        found[name] = measure(name, path, work, again=again)
        shown = ("whole_s", "cluster_s", "cpu_s", *(["again_s", "again_cpu_s"] if again else []))
        times = "".join(f"{found[name][key]:12.2f} s" if key in found[name] else f"{'-':>14s}" for key in shown)
        print(f"    {name:16s}{times}{found[name]['peak_mb']:10.0f} MB", flush=True)
    labels = {name: np.load(work / name / "labels.npy") for name in found if (work / name / "labels.npy").exists()}
    if len(labels) > 1:
        demand_equal(labels)
    for name in ("scikit-learn", "postgis", "dbscan", "scan"):
        if name in found and "geofleet" in found:
            ratio = found[name]["whole_s"] / found["geofleet"]["whole_s"]
            alone = found[name].get("cluster_s", 0) / found.get("geofleet-kernel", {}).get("cluster_s", float("inf"))
            print(
                f"    {name} takes {ratio:.2f} times as long as geofleet end to end"
                + (f", {alone:.1f} clustering alone" if alone else "")
                + (f", {found[name]['again_s'] / found['geofleet']['again_s']:.2f} called again" if again else "")
            )
    path.unlink()
    shutil.rmtree(work)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", nargs="+", default=["wide", "dense"], choices=list(WRITERS))
    parser.add_argument("--sizes", nargs="+", type=float, default=[1e6])
    parser.add_argument("--only", nargs="+", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--folder", type=Path, help="where the scenes go: about 100 bytes a detection, twice")
    parser.add_argument("--again", action="store_true", help="call every task twice, and show the second call too")
    parser.add_argument("--task", nargs=3, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.task:
        name, path, work = args.task
        print(json.dumps(run_task(name, Path(path), Path(work), again=args.again)))
        return
    print(f"Parquet in, fused table out, {os.cpu_count()} cores; geofleet-kernel is the clustering of geofleet alone.")
    with TemporaryDirectory(dir=args.folder) as name:
        if "geofleet" in args.only:
            compile_first(Path(name))
        second = f"{'again':>14s}{'CPU, again':>14s}" if args.again else ""
        print(f"{'':20s}{'end to end':>14s}{'clustering':>14s}{'CPU, all':>14s}{second}{'peak':>13s}")
        for scene in args.scenes:
            wholes = []
            for size in args.sizes:
                found = compare(scene, int(size), args.only, Path(name), again=args.again)
                wholes.append(found.get("geofleet"))
            for (small, a), (large, b) in zip(
                zip(args.sizes, wholes, strict=True), list(zip(args.sizes, wholes, strict=True))[1:], strict=False
            ):
                if a and b:
                    exponent = np.log(b["whole_s"] / a["whole_s"]) / np.log(large / small)
                    memory = b["peak_mb"] / a["peak_mb"]
                    print(
                        f"    {small:.0e} to {large:.0e}: time grows as n^{exponent:.2f}, peak memory by {memory:.2f}"
                    )


if __name__ == "__main__":
    main()
