"""The kernel that deals detections to tiles gives the rows of the statement that says the same: sql/tiles/members."""

from __future__ import annotations

import numpy as np
import pyarrow as pa
import pytest

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.tables.database import connect, create_view, materialise, run
from geofleet.tables.dealt import batch_path, read_rows
from geofleet.tables.schemas import DETECTIONS
from geofleet.tables.staging import stage_detections
from geofleet.tables.store import build_table, write_table


def detections(place_deg, *, n=3000, runs=("a", "b")):
    rng = np.random.default_rng(0)
    lon, lat = EnuFrame(*place_deg).to_lonlat(rng.uniform(-700, 700, (n, 2)))
    lon[:5] = np.where(abs(place_deg[0]) > 179, 180.0, lon[:5])  # the same meridian as -180
    names = [f"p{k}" for k in rng.integers(0, 7, n)]
    columns = {
        "run_id": np.array(runs)[rng.integers(0, len(runs), n)],
        "vehicle_id": names,
        "pass_id": names,
        "track_id": np.arange(n),
        "sign_class": np.array(["stop", "yield", "no_entry"])[rng.integers(0, 3, n)],
    }
    columns["run_id"] = pa.array(columns["run_id"].tolist())
    columns["sign_class"] = pa.array(columns["sign_class"].tolist())
    return build_table(DETECTIONS, columns, geometry=(lon, lat))


@pytest.mark.parametrize("place_deg", [(24.945, 60.168), (180.0, 61.0), (25.7, 70.0), (-70.0, -53.0)])
@pytest.mark.parametrize(("zoom", "batch_rows"), [(12, 500), (16, 900), (20, 100)])
def test_the_kernel_deals_as_the_statement_says(tmp_path, place_deg, zoom, batch_rows):
    write_table(DETECTIONS, detections(place_deg), tmp_path / "d.parquet")
    connection = connect()
    # All seven vehicles asked for by number: without one, nobody would ask for the views of a plain table.
    options = {"zoom": zoom, "halo_m": 9.0, "batch_rows": batch_rows, "n_vehicles": 7}
    staged = stage_detections(connection, tmp_path / "d.parquet", tmp_path, **options)
    fine_zoom = max(zoom, 18)
    materialise(connection, "aggregate/classes")
    create_view(connection, "aggregate/coded")
    located = run(connection, "tiles/located", {"fine_zoom": fine_zoom}).to_arrow_table()
    connection.from_arrow(located).create("located")
    wanted = run(connection, "tiles/members").to_arrow_table()
    connection.close()
    names = [name for name in wanted.column_names if name != "batch"]
    found = [
        tuple(row)
        for number in np.unique(staged.tiles["batch"]).tolist()
        for row in zip(*(read_rows(batch_path(tmp_path, number))[name].tolist() for name in names), strict=True)
    ]
    expected = list(zip(*(wanted[name].to_pylist() for name in names), strict=True))
    where = [names.index(name) for name in ("tile_code", "pass_code", "track_id", "is_owned", "lon", "lat")]
    pick = lambda rows: sorted(tuple(row[k] for k in where) for row in rows)  # noqa: E731
    assert pick(found) == pick(expected)
    assert sum(row[names.index("is_owned")] for row in found) == 3000
    assert len(found) > 3000
