from __future__ import annotations

import numpy as np
import pytest

from geofleet.formats.osm_spool import NODE, NodeSpool


def spool_of(node_id, at_once):
    spool = NodeSpool()
    for first in range(0, len(node_id), at_once):
        nodes = np.zeros(len(node_id[first : first + at_once]), NODE)
        nodes["node_id"] = node_id[first : first + at_once]
        nodes["tagset"] = np.arange(first, first + len(nodes))
        spool.append(nodes)
    return spool


@pytest.mark.parametrize("n_nodes", [0, 1, 20_000, 120_000])
@pytest.mark.parametrize("at_once", [7_001, 50_000])
def test_nodes_leave_in_the_order_of_their_ids_as_text(n_nodes, at_once):
    rng = np.random.default_rng(n_nodes)
    # Of every length up to 19 digits, negative too, and some twice
    node_id = (rng.choice([-1, 1], n_nodes) * 10 ** rng.uniform(0, 18.9, n_nodes)).astype(np.int64)
    node_id[n_nodes // 2 :] = node_id[: n_nodes - n_nodes // 2][::-1]
    spool = spool_of(node_id, at_once)
    pieces = list(spool.in_text_order())
    assert max([0, *map(len, pieces)]) < 40_000
    found = np.concatenate([np.zeros(0, NODE), *pieces])
    expected = sorted(zip(node_id.tolist(), range(n_nodes), strict=True), key=lambda node: f"n{node[0]}-0")
    assert list(zip(found["node_id"].tolist(), found["tagset"].tolist(), strict=True)) == expected
    # Nothing is used up
    assert sum(len(piece) for piece in spool.in_text_order()) == n_nodes
    assert sum(len(chunk) for chunk in spool.chunks()) == n_nodes
