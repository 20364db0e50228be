from __future__ import annotations

import json

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from scipy.spatial import cKDTree
from sklearn.cluster import DBSCAN

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.config import load_config
from geofleet.errors import InputError
from geofleet.steps.aggregate import aggregate
from geofleet.steps.ingest_detections import ingest_detections
from geofleet.tables.manifest import manifest_path
from geofleet.tables.schemas import DETECTIONS, SIGNS
from geofleet.tables.store import lonlat, read_table


def write_csv(path, n_vehicles, per_vehicle=3, bad=0):
    lines = ["lon,lat,sign_class,vehicle_id,pass_id"]
    lines += [f"{8 + p * 1e-3},53,stop,car {v},p{p}" for p in range(per_vehicle) for v in range(n_vehicles)]
    path.write_text("\n".join(lines + [",53,stop,car 0,p0"] * bad) + "\n", encoding="utf-8")
    return path


def test_a_fleet_is_partitioned_and_read_back(tmp_path):
    out = tmp_path / "detections"
    result = ingest_detections([write_csv(tmp_path / "fleet.csv", 5, bad=2)], out)
    table = read_table(DETECTIONS, out)
    assert table.num_rows == result.n_rows == 15
    assert set(table["vehicle_id"].to_pylist()) == {f"car {v}" for v in range(5)}
    assert len(list(out.rglob("*.parquet"))) == 5
    rejected = pq.read_table(result.rejected)
    assert result.rejected == tmp_path / "detections_rejected.parquet"
    assert (rejected.num_rows, result.n_rejected) == (2, 2)
    assert set(rejected["reason"].to_pylist()) == {"position missing or no number"}
    assert "row 16" in result.samples[0]
    assert json.loads(manifest_path(out).read_text())["counts"]["rejected"] == 2


def test_the_same_input_gives_the_same_bytes_and_old_rejects_go(tmp_path):
    bad, good = write_csv(tmp_path / "bad.csv", 3, bad=1), write_csv(tmp_path / "fleet.csv", 3)
    for out in (tmp_path / "a", tmp_path / "b"):
        ingest_detections([bad], out)
        result = ingest_detections([good], out)
        assert result.rejected is None
    files = [sorted(p for p in (tmp_path / out).rglob("*") if p.is_file()) for out in "ab"]
    assert [p.read_bytes() for p in files[0]] == [p.read_bytes() for p in files[1]]
    assert not list(tmp_path.glob("*_rejected.parquet"))


def test_over_a_thousand_vehicles_share_buckets_that_aggregate_reads(tmp_path):
    out = tmp_path / "detections"
    result = ingest_detections([write_csv(tmp_path / "fleet.csv", 1200)], out)
    folders = {p.parent.name.partition("=")[0] for p in out.rglob("*.parquet")}
    assert folders == {"bucket"}
    table = read_table(DETECTIONS, out)
    assert table.num_rows == result.n_rows == 3600
    assert len(pc.unique(table["vehicle_id"])) == 1200
    fused = aggregate(out, tmp_path / "fused.parquet", config=load_config("paper"))
    assert (fused.n_vehicles, fused.n_rejected, fused.n_signs) == (1200, 0, 3)


def test_rows_of_several_files_are_numbered_on(tmp_path):
    for name in ("a", "b"):
        (tmp_path / f"{name}.csv").write_text("lon,lat,sign_class\n8,53,stop\n", encoding="utf-8")
    ingest_detections([tmp_path / "a.csv", tmp_path / "b.csv"], tmp_path / "out")
    assert read_table(DETECTIONS, tmp_path / "out")["pass_id"].to_pylist() == ["row-0000000001", "row-0000000002"]


def test_what_cannot_be_used_leaves_nothing_behind(tmp_path):
    bad = tmp_path / "bad.csv"
    bad.write_text("lon,lat,sign_class\nx,y,stop\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"no row can be used: 1 position missing"):
        ingest_detections([bad], tmp_path / "out" / "detections")
    with pytest.raises(InputError, match="no input"):
        ingest_detections([], tmp_path / "out")
    assert not list((tmp_path / "out").glob("*"))


def test_many_batches_make_parts_of_one_partition(tmp_path):
    n = 900_000
    lon = np.linspace(8, 9, n)
    table = pa.table({"lon": lon, "lat": np.full(n, 53.0), "sign_class": pa.repeat("stop", n)})
    pq.write_table(table, tmp_path / "fleet.parquet")
    result = ingest_detections([tmp_path / "fleet.parquet"], tmp_path / "out")
    files = sorted((tmp_path / "out").rglob("*.parquet"))
    assert [pq.read_metadata(file).num_rows for file in files] == [400_000, 400_000, 100_000]
    assert result.n_rows == n


def test_bremen_from_mapillary_to_a_layer_of_signs(shared_data, tmp_path):
    path = shared_data / "mapillary" / "mapillary_traffic-signs_DE-HB.parquet"
    result = ingest_detections([path], tmp_path / "detections")
    assert (result.n_rows, result.n_rejected) == (22_836, 0)
    config = load_config("paper", ["min_samples=1", "min_support=1"])
    aggregate(tmp_path / "detections", tmp_path / "fused.parquet", config=config)
    detections = read_table(DETECTIONS, tmp_path / "detections")
    signs = read_table(SIGNS, tmp_path / "fused.parquet")

    def spots(table):
        return list(zip(*(np.round(side, 7).tolist() for side in lonlat(table)), table["sign_class"].to_pylist()))  # noqa: B905

    assert len(spots(detections)) - len(set(spots(detections))) == 109  # one sign reported twice at one spot
    assert len(spots(signs)) == len(set(spots(signs)))  # each once
    assert pc.sum(signs["n_detections"]).as_py() == 22_836
    # classes are never merged: every class keeps its number of detections
    given, fused = detections["sign_class"].to_pylist(), signs.select(["sign_class", "n_detections"])
    per_class = fused.group_by("sign_class").aggregate([("n_detections", "sum")])
    assert dict(zip(*per_class.to_pydict().values(), strict=True)) == {c: given.count(c) for c in set(given)}
    _demand_linked_groups(detections, signs, eps_m=config.aggregate.eps_m)


def _demand_linked_groups(detections, signs, *, eps_m):
    """Each sign stands where scikit-learn puts a group of as many, and no group is wider than its links allow."""
    frame = EnuFrame.around(*lonlat(detections))
    xy, classes = frame.to_enu(*lonlat(detections)), np.array(detections["sign_class"].to_pylist())
    places, named = frame.to_enu(*lonlat(signs)), np.array(signs["sign_class"].to_pylist())
    sizes = signs["n_detections"].to_numpy()
    for name in np.unique(classes):
        points, mine = xy[classes == name], named == name
        labels = DBSCAN(eps=eps_m, min_samples=1).fit_predict(points)
        counts = np.bincount(labels)
        centres = np.column_stack([np.bincount(labels, side) / counts for side in points.T])
        for label in np.flatnonzero(counts > 1):
            assert np.ptp(points[labels == label], axis=0).max() <= eps_m * (counts[label] - 1)
        distance_m, nearest = cKDTree(centres).query(places[mine])
        assert distance_m.max() < 1e-3
        assert sorted(nearest.tolist()) == list(range(len(counts)))
        assert (sizes[mine] == counts[nearest]).all()
