"""Derive the shipped drives from the OpenStreetMap road graph, as RTKLIB `.pos` files at 10 Hz.

Nobody recorded them: a drive follows the centre lines of real roads, legal at every turn, from one OpenStreetMap node
to another over one between, each leg the shortest by length in osmnx's directed graph. Corners are smoothed by a
moving average of 9 m, and a drive ends after 1200 m at the latest; the speed is 10 m/s, less in corners. Times are
nominal, heights are zero, and the quality column says 0, RTKLIB's "no solution", because no receiver was there.

    python scripts/derive_drive.py [FOLDER]        # reads data/raw/helsinki.osm.pbf, writes data/raw/*_derived*.pos
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np
import osmium
import osmnx as ox

from geofleet.algorithms.geodesy import EnuFrame

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

RAW = Path(__file__).resolve().parents[1] / "data" / "raw"
ROADS = RAW / "helsinki.osm.pbf"
DRIVES = {
    "helsinki_derived.pos": (1156114392, 664317429, 1984341845),
    "helsinki_derived_b.pos": (390441645, 255083700, 404759606),
}
RATE_HZ = 10
SMOOTHING_M = 9
LONGEST_M = 1200
SPEED_MPS = 10.0
LATERAL_ACCELERATION_MPS2 = 2.0
ACCELERATION_MPS2 = 1.5
START = datetime(2020, 1, 1, 0, 0, 18, tzinfo=UTC)  # GPST, 18 s ahead of UTC: midnight UTC, nominal
HEADER = """\
% program   : geofleet scripts/derive_drive.py (derived from OpenStreetMap roads, not recorded)
% inp file  : data/raw/helsinki.osm.pbf (c) OpenStreetMap contributors, ODbL 1.0
% sol start : {start} GPST
% sol end   : {end} GPST
% pos mode  : derived (no receiver: Q=0, ns=0, no standard deviations, height 0, nominal times)
%
% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix,2:float,3:sbas,4:dgps,5:single,6:ppp,ns=# of satellites)
%  GPST                  latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)  sdne(m)  \
sdeu(m)  sdun(m) age(s)  ratio
"""
ROW = "{time}  {lat:14.9f} {lon:14.9f}     0.0000   0   0" + "   0.0000" * 6 + "   0.00    0.0\n"


def read_graph(pbf: Path) -> nx.MultiDiGraph[Any]:
    """Read a PBF as osmnx's directed graph, every OpenStreetMap node kept.

    Ways that lost nodes at the edge of the extract are split there, which osmnx asks for.
    """
    present = {node.id for node in osmium.FileProcessor(pbf, osmium.osm.NODE)}
    with tempfile.TemporaryDirectory() as folder:
        xml = Path(folder) / "roads.osm"
        number = itertools.count(1)
        with osmium.SimpleWriter(xml) as writer:
            items: Any = osmium.FileProcessor(pbf, osmium.osm.NODE | osmium.osm.WAY)
            for item in items:
                if item.is_node():
                    writer.add(item)
                    continue
                refs = [node.ref for node in item.nodes]
                for there, run in itertools.groupby(refs, present.__contains__):
                    nodes = list(run)
                    if there and len(nodes) > 1:
                        writer.add(item.replace(id=next(number), nodes=nodes))
        return ox.graph_from_xml(xml, simplify=False, retain_all=True)


def route(graph: nx.MultiDiGraph[Any], via: tuple[int, ...]) -> list[int]:
    """Return the nodes of the shortest legs between `via`, one after the other."""
    nodes = [via[0]]
    for start, end in itertools.pairwise(via):
        nodes += nx.shortest_path(graph, start, end, weight="length")[1:]
    return nodes


def smoothed(corners_m: Floats) -> Floats:
    """Resample a polyline every metre and average `SMOOTHING_M` points around each; the ends stay."""
    s_m = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(corners_m, axis=0).T))))
    every_m = np.append(np.arange(0.0, s_m[-1]), s_m[-1])
    line = np.column_stack([np.interp(every_m, s_m, axis) for axis in corners_m.T])
    half = SMOOTHING_M // 2
    padded = np.vstack((np.repeat(line[:1], half, axis=0), line, np.repeat(line[-1:], half, axis=0)))
    windows = np.lib.stride_tricks.sliding_window_view(padded, SMOOTHING_M, axis=0)
    return np.asarray(windows.mean(axis=-1), np.float64)


def epochs(line_m: Floats) -> Floats:
    """Return positions every 1 / `RATE_HZ` s along a line, slower where it bends, never harder braked than allowed."""
    step_m = np.hypot(*np.diff(line_m, axis=0).T)
    line_m = line_m[np.concatenate(([True], step_m > 1e-6))]  # noqa: PLR2004 - the padded ends repeat a point
    step_m = np.hypot(*np.diff(line_m, axis=0).T)
    bearing = np.unwrap(np.arctan2(*np.diff(line_m, axis=0).T))
    bend = np.convolve(np.abs(np.gradient(bearing) / step_m), np.full(5, 0.2), mode="same")
    limit = np.minimum(SPEED_MPS, np.sqrt(LATERAL_ACCELERATION_MPS2 / np.maximum(bend, 1e-9)))
    for order in (range(1, len(limit)), range(len(limit) - 2, -1, -1)):
        forward = order.step > 0
        for i in order:
            before = limit[i - 1 if forward else i + 1]
            limit[i] = min(limit[i], np.sqrt(before**2 + 2 * ACCELERATION_MPS2 * step_m[i]))
    time_s = np.concatenate(([0.0], np.cumsum(step_m / limit)))
    at_s = np.arange(0.0, time_s[-1], 1 / RATE_HZ)
    return np.column_stack([np.interp(at_s, time_s, axis) for axis in line_m.T])


def write_pos(path: Path, lon_deg: Floats, lat_deg: Floats) -> None:
    """Write positions as an RTKLIB solution that says in its header that it is derived."""
    times = [f"{START + timedelta(seconds=i / RATE_HZ):%Y/%m/%d %H:%M:%S.%f}"[:-3] for i in range(len(lon_deg))]
    rows = (ROW.format(time=t, lat=lat, lon=lon) for t, lat, lon in zip(times, lat_deg, lon_deg, strict=True))
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(HEADER.format(start=times[0][:-2], end=times[-1][:-2]))
        file.writelines(rows)


def derive(folder: Path) -> None:
    """Write every drive into `folder` and print its length."""
    graph = read_graph(ROADS)
    for name, via in DRIVES.items():
        nodes = route(graph, via)
        lon, lat = (np.array([graph.nodes[node][axis] for node in nodes]) for axis in "xy")
        frame = EnuFrame.around(lon, lat)
        line_m = smoothed(frame.to_enu(lon, lat))[: LONGEST_M + 1]
        write_pos(folder / name, *frame.to_lonlat(epochs(line_m)))
        length_m = np.hypot(*np.diff(line_m, axis=0).T).sum()
        print(f"{folder / name}: {len(nodes)} nodes, {length_m:.0f} m")


if __name__ == "__main__":
    derive(Path(sys.argv[1]) if len(sys.argv) > 1 else RAW)
