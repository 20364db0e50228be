"""Turn the traffic-sign detections of many cars into an updated sign map, and say how good it is.

```
import geofleet as gf

signs = gf.read_signs("city.osm.pbf")
drive = gf.read_drive("drive.pos")
run = gf.simulate(signs, drive, scenario="paper", n_vehicles=50)
fused = gf.aggregate(run.detections)
print(gf.score_map(fused, run.reference).gospa_m)
```
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from geofleet.workflows.api import Simulation, aggregate, read_drive, read_signs, score_map, simulate

__all__ = ["Simulation", "aggregate", "read_drive", "read_signs", "score_map", "simulate"]


def __getattr__(name: str) -> Any:
    """Import the API when it is first used: `geofleet --help` need not wait for geopandas."""
    if name not in __all__:
        raise AttributeError(f"module 'geofleet' has no attribute {name!r}")
    from geofleet.workflows import api  # noqa: PLC0415

    return getattr(api, name)
