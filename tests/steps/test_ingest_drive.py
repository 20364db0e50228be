from __future__ import annotations

import json

import pytest

from geofleet.errors import InputError
from geofleet.steps.ingest import ingest_drive
from geofleet.tables.manifest import manifest_path
from geofleet.tables.schemas import DRIVES
from geofleet.tables.store import read_table


def test_drives_of_several_formats_in_one_table(shared_data, repo, tmp_path):
    folder = shared_data / "trajectory"
    inputs = [
        repo / "data" / "raw" / "helsinki_derived.pos",
        folder / "nmea" / "pixel6.nmea",
        folder / "gsdc" / "gsdc_2021_Pixel4_ground_truth.csv",
    ]
    out = tmp_path / "drives.parquet"
    result = ingest_drive(inputs, out)
    assert list(result.inputs.values()) == ["rtklib", "nmea", "csv"]
    assert len(set(read_table(DRIVES, out)["drive_id"].to_pylist())) == 3
    counts = json.loads(manifest_path(out).read_text())["counts"]
    assert counts["skipped"]["epochs inside of a stop"] == result.skipped["epochs inside of a stop"] > 0


def test_options_reach_the_reader_and_the_manifest(tmp_path):
    path = tmp_path / "local.csv"
    path.write_text("t,e,n\n0,0,0\n1,10,0\n2,20,0\n", encoding="utf-8")
    out = tmp_path / "drives.parquet"
    result = ingest_drive([path], out, columns={"time": "t", "x": "e", "y": "n"}, origin=(49.0, 8.4))
    assert result.n_rows == 3
    assert "49.0" in json.loads(manifest_path(out).read_text())["settings"]["origin"]


def test_a_wrong_format_writes_nothing(repo, tmp_path):
    with pytest.raises(InputError, match="not NMEA"):
        ingest_drive([repo / "data" / "raw" / "helsinki_derived.pos"], tmp_path / "a.parquet", file_format="nmea")
    with pytest.raises(InputError, match="unknown format 'kml'"):
        ingest_drive([repo / "data" / "raw" / "helsinki_derived.pos"], tmp_path / "a.parquet", file_format="kml")
    assert not list(tmp_path.iterdir())
