"""The simulate step: what it writes, that it writes the same again, and what it refuses."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.config import Config, load_config
from geofleet.errors import ConfigError, GeofleetError, InputError
from geofleet.steps.ingest import ingest_drive
from geofleet.steps.simulate import SimulateResult, simulate
from geofleet.tables.manifest import hash_path
from geofleet.tables.schemas import DETECTIONS, DRIVES, PASSES, REFERENCE, RUNS, SIGNS, TRUTH
from geofleet.tables.store import build_table, lonlat, read_table, write_table

if TYPE_CHECKING:
    from pathlib import Path

FRAME = EnuFrame(24.945, 60.168)
CONCEPTS = ("yield", "no_entry", "straight_only", "pedestrian_crossing")
EXACT = {
    "gnss_sigma_m": 0.0,
    "range_bias_sigma_m": 0.0,
    "bearing_bias_sigma_deg": 0.0,
    "range_noise_sigma_m": 0.0,
    "bearing_noise_sigma_deg": 0.0,
    "false_negative_rate": 0.0,
    "semantic_rate": 1.0,
    "ghost_rate_per_ha": 0.0,
}


def write_signs(path: Path, xy_m: np.ndarray, **columns: object) -> Path:
    n = len(xy_m)
    concepts = columns.pop("concept", [CONCEPTS[i % 4] for i in range(n)])
    given = {
        "sign_id": [f"s{i:03d}" for i in range(n)],
        "kind": "main",
        "concept": concepts,
        "sign_class": concepts,
        "raw_code": concepts,
        "source": "test",
        "source_ref": [f"node/{i}" for i in range(n)],
    }
    write_table(SIGNS, build_table(SIGNS, given | columns, geometry=FRAME.to_lonlat(np.asarray(xy_m, float))), path)
    return path


def write_drive(path: Path, xy_m: np.ndarray, *, is_timed: bool = True, drive_id: object = "street") -> Path:
    n = len(xy_m)
    columns = {"drive_id": drive_id, "seq": np.arange(n), "segment": np.zeros(n, int), "source": "test"}
    if is_timed:
        start = np.datetime64("2024-05-01T08:00:00", "us")
        columns["t_utc"] = pa.array(start + np.arange(n) * np.timedelta64(100, "ms"), pa.timestamp("us", tz="UTC"))
    write_table(DRIVES, build_table(DRIVES, columns, geometry=FRAME.to_lonlat(np.asarray(xy_m, float))), path)
    return path


def street() -> np.ndarray:
    return np.column_stack((np.arange(0, 400.0), 8 * np.sin(np.arange(0, 400.0) / 60)))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("inputs")
    beside = np.column_stack((np.arange(20, 380, 30.0), np.tile([5.0, -5.0], 6)))
    beside[:, 1] += 8 * np.sin(beside[:, 0] / 60)
    far = np.array([[100.0, 80.0], [-30.0, 0.0]])  # beside the corridor, and before the drive begins
    return write_signs(folder / "signs.parquet", np.concatenate((beside, far))), write_drive(
        folder / "drive.parquet", street()
    )


def run(inputs: tuple[Path, Path], out: Path, n_vehicles: int = 4, **options: object) -> SimulateResult:
    config = options.pop("config", None) or load_config("paper")
    assert isinstance(config, Config)
    return simulate(*inputs, out, config=config, n_vehicles=n_vehicles, **options)


def test_every_table_is_written_with_its_schema(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "simulation"
    calls: list[tuple[int, int]] = []
    result = run(inputs, out, n_replicates=2, seed=7, progress=lambda done, total: calls.append((done, total)))
    assert calls == [(k, 8) for k in range(9)]
    runs, reference = read_table(RUNS, out / "runs.parquet"), read_table(REFERENCE, out / "reference.parquet")
    passes, detections = read_table(PASSES, out / "passes.parquet"), read_table(DETECTIONS, out / "detections")
    truth = read_table(TRUTH, out / "truth")
    assert runs["run_id"].to_pylist() == list(result.run_ids)
    assert [name[: len("paper-s7-r0")] for name in result.run_ids] == ["paper-s7-r0", "paper-s7-r1"]
    assert reference.num_rows == 2 * result.n_signs == 2 * 12
    assert passes.num_rows == result.n_passes == 8
    assert passes["vehicle_id"].to_pylist()[:2] == ["v00000", "v00001"]
    assert detections.num_rows == truth.num_rows == result.n_detections
    keys = ["run_id", "pass_id", "track_id"]
    joined = detections.select([*keys, "sign_class", "n_frames"]).join(truth, keys)
    agrees = pc.equal(joined["sign_class"], joined["ref_sign_class"])
    assert pc.equal(pc.fill_null(agrees, False), joined["semantic_correct"]).to_pylist() == [True] * len(joined)  # noqa: FBT003 - Arrow's signature
    assert pc.min(joined["n_frames"]).as_py() >= 3
    part = out / "detections" / f"run_id={result.run_ids[0]}" / "vehicle_id=v00002" / "part-0.parquet"
    assert not {"run_id", "vehicle_id"} & set(pq.read_schema(part).names)


def test_a_noise_free_fleet_reports_every_visible_sign_at_its_place_and_time(
    inputs: tuple[Path, Path], tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run(inputs, out, n_vehicles=3, config=load_config("paper", EXACT))
    reference = read_table(REFERENCE, out / "reference.parquet")
    detections, truth = read_table(DETECTIONS, out / "detections"), read_table(TRUTH, out / "truth")
    place = dict(zip(reference["sign_id"].to_pylist(), FRAME.to_enu(*lonlat(reference)), strict=True))
    detections, truth = (t.sort_by([("pass_id", "ascending"), ("track_id", "ascending")]) for t in (detections, truth))
    error = FRAME.to_enu(*lonlat(detections)) - np.array([place[s] for s in truth["ref_sign_id"].to_pylist()])
    assert np.abs(error).max() < 1e-3
    often_seen = reference.filter(pc.greater_equal(reference["n_frames_in_view"], 9))["sign_id"].to_pylist()
    assert len(often_seen) >= 10
    assert set(often_seen) <= set(truth["ref_sign_id"].to_pylist())
    assert pc.max(reference["n_passes_in_view"]).as_py() == 3
    assert pc.all(truth["semantic_correct"]).as_py()
    # the second car starts 60 s after the first; 10 m/s, a frame every 2 m
    first = detections.filter(pc.equal(detections["vehicle_id"], "v00001")).slice(0, 1).to_pylist()[0]
    seconds = (first["t_first"] - passes_start(out)).total_seconds()
    assert seconds == pytest.approx(60 + 0.2 * first["frame_first"])
    assert first["sigma_e_m"] < 1e-6


def passes_start(out: Path) -> object:
    return read_table(PASSES, out / "passes.parquet")["t_start"][0].as_py()


def test_the_same_bytes_from_any_number_of_workers(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    hashes = []
    for n_workers in (1, 3, 1):
        run(inputs, out, n_vehicles=6, n_workers=n_workers)
        hashes.append((hash_path(out), (out / "_manifest.json").read_bytes()))
    assert hashes[0] == hashes[1] == hashes[2]


def test_batches_do_not_show(inputs: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run(inputs, tmp_path / "one", n_vehicles=5)
    monkeypatch.setattr("geofleet.steps.simulate.VEHICLES_A_PART", 2)
    run(inputs, tmp_path / "three", n_vehicles=5)
    assert hash_path(tmp_path / "one" / "detections") == hash_path(tmp_path / "three" / "detections")
    assert len(list((tmp_path / "three" / "truth").rglob("*.parquet"))) == 3
    one, three = (read_table(TRUTH, tmp_path / name / "truth") for name in ("one", "three"))
    assert one.equals(three)


def test_a_small_fleet_is_the_first_cars_of_a_large_one(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    small = run(inputs, tmp_path / "small", n_vehicles=3)
    large = run(inputs, tmp_path / "large", n_vehicles=7)
    assert small.run_ids == large.run_ids
    for vehicle in range(3):
        name = f"detections/run_id={small.run_ids[0]}/vehicle_id=v{vehicle:05d}/part-0.parquet"
        assert (tmp_path / "small" / name).read_bytes() == (tmp_path / "large" / name).read_bytes()


def test_seed_replicate_and_vehicle_each_change_the_draws(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    run(inputs, tmp_path / "a", n_vehicles=2, n_replicates=2)
    run(inputs, tmp_path / "b", n_vehicles=2, seed=1)
    parts = [p for name in "ab" for p in sorted((tmp_path / name / "detections").rglob("*.parquet"))]
    assert len(parts) == 6
    assert len({p.read_bytes() for p in parts}) == 6


def test_the_run_is_named_after_what_shapes_it(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    config = load_config("paper")
    same = run(inputs, tmp_path / "a", 1, config=load_config("paper", {"eps_m": 3.0})).run_ids
    other = run(inputs, tmp_path / "b", 1, config=load_config("paper", {"gnss_sigma_m": 1.0})).run_ids
    assert run(inputs, tmp_path / "c", 1, config=config).run_ids == same != other
    odd = config.model_copy(update={"scenario": "my town/50 %"})
    assert run(inputs, tmp_path / "d", 1, config=odd).run_ids[0].startswith("my-town-50---s0-r0-")


def test_a_drive_of_any_format_is_driven_as_its_table_is(repo: Path, tmp_path: Path) -> None:
    raw = repo / "data" / "raw"
    ingest_drive([raw / "helsinki_derived.pos"], tmp_path / "drives.parquet")
    for name, drive in (("pos", raw / "helsinki_derived.pos"), ("table", tmp_path / "drives.parquet")):
        simulate(raw / "helsinki.osm.pbf", drive, tmp_path / name, config=load_config(), n_vehicles=2)
    of_file, of_table = (
        read_table(DETECTIONS, tmp_path / name / "detections").drop_columns(["run_id"]) for name in ("pos", "table")
    )
    assert of_file.num_rows > 20
    assert of_file.equals(of_table)
    with pytest.raises(InputError, match=r"NOTICE\.md: not a trajectory .* Supported are rtklib"):
        simulate(raw / "helsinki.osm.pbf", raw / "NOTICE.md", tmp_path / "out", config=load_config(), n_vehicles=2)


def test_equal_classes_at_one_point_or_on_one_support_count_once(tmp_path: Path) -> None:
    xy_m = np.array([[50, 5], [50.005, 5], [50, 5], [80, 5], [81, 5], [110, 5], [110, 5.5], [150, 20.0]])
    concept = ["yield", "yield", "no_entry", "no_entry", "no_entry", "yield", "yield", "yield"]
    support = [None, None, None, "p1", "p1", "p2", "p3", None]
    kind = ["main"] * 7 + ["main"]
    signs = write_signs(tmp_path / "signs.parquet", xy_m, concept=concept, support_id=support, kind=kind)
    straight = np.column_stack((np.arange(0, 200.0), np.zeros(200)))
    run((signs, write_drive(tmp_path / "drive.parquet", straight)), tmp_path / "out", 1)
    kept = read_table(REFERENCE, tmp_path / "out" / "reference.parquet")["sign_id"].to_pylist()
    assert kept == ["s000", "s002", "s003", "s005", "s006"]


def test_plates_and_other_groups_are_not_in_the_scene(tmp_path: Path) -> None:
    xy_m = np.array([[50, 5], [60, 5], [70, 5], [80, 5.0]])
    signs = write_signs(
        tmp_path / "signs.parquet",
        xy_m,
        concept=["yield", "no_entry", "raw:XX:9", "straight_only"],
        kind=["main", "plate", "main", "main"],
    )
    inputs = signs, write_drive(tmp_path / "drive.parquet", street())
    run(inputs, tmp_path / "out", 1)
    assert read_table(REFERENCE, tmp_path / "out" / "reference.parquet")["sign_id"].to_pylist() == ["s000", "s003"]


def test_a_drive_without_times_gives_detections_without_times(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive.parquet", street(), is_timed=False)
    run((inputs[0], drive), tmp_path / "out", 2)
    assert read_table(DETECTIONS, tmp_path / "out" / "detections")["t_first"].null_count > 0
    assert read_table(PASSES, tmp_path / "out" / "passes.parquet")["t_end"].null_count == 2


@pytest.mark.parametrize(
    ("number", "message"),
    [
        ({"n_vehicles": 0}, r"n_vehicles is 0\. Set n_vehicles between 1"),
        ({"n_replicates": 0}, "n_replicates is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"n_workers": 0}, "n_workers is 0"),
    ],
)
def test_numbers_out_of_range_are_refused(
    inputs: tuple[Path, Path], tmp_path: Path, number: dict[str, int], message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        run(inputs, tmp_path / "out", **number)
    assert not list(tmp_path.iterdir())


def test_signs_elsewhere_are_refused_with_their_distance(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    offset = write_drive(tmp_path / "drive.parquet", street() + np.array([0.0, 1200.0]))
    with pytest.raises(
        InputError, match=r"no sign is within 15 m of the drive 'street'; the nearest of 14 is 1,1\d\d m"
    ):
        run((inputs[0], offset), tmp_path / "out")
    antipode = write_drive(tmp_path / "other_side.parquet", street())
    table = read_table(DRIVES, antipode)
    lon, lat = lonlat(table)
    columns = {name: table[name].combine_chunks() for name in ("drive_id", "seq", "segment", "source")}
    write_table(DRIVES, build_table(DRIVES, columns, geometry=(lon - 180.0, -lat)), antipode)
    with pytest.raises(InputError, match=r"the nearest of 14 is (19,9|20,0)\d\d,\d\d\d m"):
        run((inputs[0], antipode), tmp_path / "out")


@pytest.mark.parametrize(
    ("way", "message"),
    [
        (np.zeros((1, 2)), "no motion"),
        (np.zeros((50, 2)), "no motion"),
        (np.array([[0.0, 0.0], [1.5, 0.0]]), "less than one frame spacing"),
    ],
)
def test_a_drive_that_goes_nowhere_is_refused(
    inputs: tuple[Path, Path], tmp_path: Path, way: np.ndarray, message: str
) -> None:
    drive = write_drive(tmp_path / "drive.parquet", way + np.array([20.0, 0.0]))
    with pytest.raises(InputError, match=message) as caught:
        run((inputs[0], drive), tmp_path / "out")
    assert caught.value.where == str(drive)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["drive.parquet"]


def test_several_drives_are_refused(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    drive = write_drive(tmp_path / "drive.parquet", street(), drive_id=["a"] * 200 + ["b"] * 200)
    with pytest.raises(InputError, match="one drive is needed, found 2: a, b"):
        run((inputs[0], drive), tmp_path / "out")


def test_an_unknown_group_is_refused(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"unknown group waring.*Groups are .*warning"):
        run(inputs, tmp_path / "out", config=load_config("paper", {"groups": ["waring"]}))
    with pytest.raises(InputError, match="none of the 14 signs"):
        run(inputs, tmp_path / "out", config=load_config("paper", {"groups": ["warning"]}))


def test_a_scene_of_one_class_cannot_confuse_classes(tmp_path: Path) -> None:
    signs = write_signs(tmp_path / "signs.parquet", np.array([[50.0, 5.0], [90.0, 5.0]]), concept=["yield"] * 2)
    inputs = signs, write_drive(tmp_path / "drive.parquet", street())
    with pytest.raises(ConfigError, match=r"the scene has only one: yield.*semantic_rate to 1"):
        run(inputs, tmp_path / "out")
    assert run(inputs, tmp_path / "out", config=load_config("paper", {"semantic_rate": 1.0})).n_classes == 1


def test_a_folder_of_something_else_is_not_replaced(inputs: tuple[Path, Path], tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(inputs, out, 1)
    run(inputs, out, 2)  # an earlier simulation is
    assert len(list((out / "detections").rglob("*.parquet"))) == 2
    (out / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match=r"holds thesis\.tex"):
        run(inputs, out, 1)
    assert (out / "thesis.tex").exists()
    with pytest.raises(InputError, match="this is a file"):
        run(inputs, out / "thesis.tex", 1)


def test_a_folder_with_a_dot_in_its_name_holds_its_manifest_and_can_be_replaced(
    inputs: tuple[Path, Path], tmp_path: Path
) -> None:
    out = tmp_path / "gnss-0.5"
    run(inputs, out, 1)
    run(inputs, out, 2)
    assert (out / "_manifest.json").exists()
    assert [p.name for p in tmp_path.iterdir()] == ["gnss-0.5"]


def test_a_failure_leaves_what_was_there(
    inputs: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "out"
    run(inputs, out, 1)
    before = hash_path(out)

    def fail(*_: object, **__: object) -> None:
        raise GeofleetError("disk full")

    monkeypatch.setattr("geofleet.steps.simulate.track_passes", fail)
    with pytest.raises(GeofleetError, match="disk full"):
        run(inputs, out, 3)
    assert hash_path(out) == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize(
    ("scenario", "range_m", "tracker"),
    [("paper", 100.0, "paper"), ("paper-50m", 50.0, "paper"), ("paper-ideal", 100.0, "ideal")],
)
def test_packaged_scenarios(
    inputs: tuple[Path, Path], tmp_path: Path, scenario: str, range_m: float, tracker: str
) -> None:
    run(inputs, tmp_path / "out", 2, config=load_config(scenario))
    assert read_table(RUNS, tmp_path / "out" / "runs.parquet")["tracker"].to_pylist() == [tracker]
    assert set(read_table(PASSES, tmp_path / "out" / "passes.parquet")["range_m"].to_pylist()) == {range_m}


def test_the_ideal_tracker_sends_one_track_a_sign_where_the_papers_sends_fragments(
    inputs: tuple[Path, Path], tmp_path: Path
) -> None:
    shaken = {"bearing_noise_sigma_deg": 2.0}  # 1.7 m at 50 m: the gate of 2 m loses tracks
    most = {}
    for tracker in ("ideal", "paper"):
        run(inputs, tmp_path / tracker, 2, config=load_config("paper", shaken | {"tracker": tracker}))
        truth = read_table(TRUTH, tmp_path / tracker / "truth").filter(pc.field("is_ghost") == pc.scalar(value=False))
        tracks = truth.group_by(["pass_id", "ref_sign_id"]).aggregate([("track_id", "count")])
        most[tracker] = pc.max(tracks["track_id_count"]).as_py()
    assert most["ideal"] == 1 < most["paper"]
