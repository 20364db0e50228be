"""Signs and drivable roads of an OpenStreetMap file: PBF, XML or Overpass JSON, the latter two packed or not."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geofleet.formats.osm_rows import EDGE, SignRows
from geofleet.formats.osm_scan import detect, refuse_lanelet2, scan, sign_nodes
from geofleet.formats.reading import LayerRead, LayerStream
from geofleet.tables.schemas import LANES
from geofleet.tables.store import build_table

if TYPE_CHECKING:
    from pathlib import Path

    from geofleet.formats.osm_roads import Roads

__all__ = ["FORMAT", "detect", "read_lanes", "read_signs"]

FORMAT = "osm"


def read_signs(path: Path, *, roads: bool = True) -> LayerStream:
    """Read the signs of an OpenStreetMap file a piece at a time.

    Nodes with signs wait on disk; held are the different tags of such nodes and, with `roads`, the drivable ways.

    Parameters
    ----------
    path
        PBF, XML, Overpass JSON, or one of the latter packed; told apart by content.
    roads
        Read the drivable ways too, and give each sign the nearest one's id and, where its tags do not say, the facing
        that it implies.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or not OpenStreetMap's.
    """
    nodes, ways = scan(path, lambda pbf: (sign_nodes(pbf), _roads(pbf) if roads else None))
    if not nodes.spool.n_nodes:
        refuse_lanelet2(path)
    rows = SignRows(nodes, path=path, roads=ways)
    return LayerStream(rows.pieces, FORMAT, rows.skipped, rows.found)


def read_lanes(path: Path) -> LayerRead:
    """Read the drivable ways of an OpenStreetMap file as `lanes`; a way cut by the edge of the file gives its pieces.

    Raises
    ------
    InputError
        The file is missing, empty, damaged or not OpenStreetMap's.
    """
    ways = scan(path, _roads)
    if not len(ways.way_id):
        refuse_lanelet2(path)
    columns = {
        "lane_id": [f"w{way}" + (f"-{n}" if n else "") for way, n in zip(ways.way_id, ways.part, strict=True)],
        "road_id": [f"w{way}" for way in ways.way_id],
        "kind": ways.kind,
        "speed_limit_kmh": ways.speed_limit_kmh,
        "source": path.name,
    }
    return LayerRead(build_table(LANES, columns, ways.lines()), FORMAT, {}, {EDGE: ways.n_missing_nodes})


def _roads(pbf: Path) -> Roads:
    from geofleet.formats.osm_road_scan import read_roads  # noqa: PLC0415  (not needed without roads)

    return read_roads(pbf)
