"""Derive drives that cover a city, from its OpenStreetMap road graph. Nobody drove them.

Each is a walk over real roads, legal at every turn, of a given length: at every junction it takes the way that the
drives so far have taken least often, and of equals the straightest; the next drive begins on the longest road that none
has taken. Corners are smoothed as those of the shipped drives are (`derive_drive.py`). They are written as one `drives`
table of quality `derived`, without times, for `geofleet simulate --set drives=all`.

    python scripts/derive_city_drives.py ../shared/data/osm/Helsinki.osm.pbf drives.parquet --drives 8 --length-m 5000
"""

from __future__ import annotations

import argparse
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

import networkx as nx
import numpy as np
import pyarrow as pa
from derive_drive import read_graph, smoothed

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.formats.osm_tags import CAR_ROADS
from geofleet.tables.schemas import DRIVES
from geofleet.tables.store import build_table, write_table

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Edge = tuple[int, int]


def connected(graph: nx.MultiDiGraph[Any]) -> nx.DiGraph[Any]:
    """Return the largest part of a road graph in which every place can be reached from every other, with lengths."""
    roads = nx.DiGraph()
    for start, end, road in graph.edges(data=True):
        if start != end and road.get("highway") in CAR_ROADS:
            roads.add_edge(start, end, length=road["length"])
    return roads.subgraph(max(nx.strongly_connected_components(roads), key=len)).copy()


def walk(roads: nx.DiGraph[Any], xy_m: dict[int, Floats], driven: Counter[Edge], length_m: float) -> list[int]:
    """Return the nodes of a walk of at least a length, and count the roads that it takes in `driven`."""
    fresh = max(roads.edges, key=lambda edge: (-driven[edge], roads.edges[edge]["length"], edge))
    nodes, left_m = list(fresh), length_m - roads.edges[fresh]["length"]
    driven[fresh] += 1
    while left_m > 0:
        before, here = nodes[-2:]
        onward = [node for node in roads.successors(here) if node != before] or [before]  # turn where the road ends

        def price(node: int, before: int = before, here: int = here) -> tuple[int, float, int]:
            return driven[here, node] + driven[node, here], -_ahead(xy_m[before], xy_m[here], xy_m[node]), node

        following = min(onward, key=price)
        driven[here, following] += 1
        left_m -= roads.edges[here, following]["length"]
        nodes.append(following)
    return nodes


def _ahead(before: Floats, here: Floats, after: Floats) -> float:
    """Return the cosine of a turn: 1 straight on."""
    one, two = here - before, after - here
    return float(one @ two / max(np.hypot(*one) * np.hypot(*two), 1e-9))


def derive(pbf: Path, out: Path, *, n_drives: int, length_m: float) -> None:
    """Write the drives and print how much of the road graph they cover."""
    graph = read_graph(pbf)
    roads = connected(graph)
    nodes = sorted(roads.nodes)
    lon, lat = (np.array([graph.nodes[node][axis] for node in nodes]) for axis in "xy")
    frame = EnuFrame.around(lon, lat)
    xy_m = dict(zip(nodes, frame.to_enu(lon, lat), strict=True))
    driven: Counter[Edge] = Counter()
    tables = []
    for number in range(n_drives):
        corners = np.array([xy_m[node] for node in walk(roads, xy_m, driven, length_m)])
        line = smoothed(corners)[: int(length_m) + 1]
        columns = {"drive_id": f"{pbf.stem}-{number:03d}", "seq": np.arange(len(line)), "fix_quality": "derived"}
        columns |= {"segment": np.zeros(len(line), dtype=np.int64), "source": f"derived from the roads of {pbf.name}"}
        tables.append(build_table(DRIVES, columns, geometry=frame.to_lonlat(line)))
    write_table(DRIVES, pa.concat_tables(tables), out)
    streets = {frozenset(edge) for edge in roads.edges}
    taken = {frozenset(edge) for edge in driven if driven[edge]}
    total_m, taken_m = (
        sum(
            max(roads.edges.get((a, b), _NO_ROAD)["length"], roads.edges.get((b, a), _NO_ROAD)["length"])
            for a, b in kept
        )
        for kept in (map(tuple, streets), map(tuple, taken))
    )
    print(f"{out}: {n_drives} drives of {length_m:.0f} m over {taken_m / 1000:.1f} of {total_m / 1000:.1f} km of roads")


_NO_ROAD = {"length": 0.0}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("pbf", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--drives", type=int, default=8)
    parser.add_argument("--length-m", type=float, default=5000.0)
    arguments = parser.parse_args()
    derive(arguments.pbf, arguments.out, n_drives=arguments.drives, length_m=arguments.length_m)
