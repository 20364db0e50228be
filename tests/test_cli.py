"""The command line as a user meets it: exit codes, one message, nothing half-written."""

from __future__ import annotations

import io
import json
import subprocess
import sys
import time
from contextlib import chdir, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from geofleet.cli import app, main, output
from geofleet.config import SECTIONS

RAW = Path(__file__).parent.parent / "data" / "raw"
PBF, POS = RAW / "helsinki.osm.pbf", RAW / "helsinki_derived.pos"


@dataclass
class Finished:
    returncode: int
    stdout: str
    stderr: str


def geofleet(*args, cwd):
    """Run the command in this process; a traceback would escape as an exception."""
    out, err = io.StringIO(), io.StringIO()
    with chdir(cwd), redirect_stdout(out), redirect_stderr(err), pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["geofleet", *map(str, args)])
        patch.setenv("COLUMNS", "200")
        with pytest.raises(SystemExit) as stop:
            main()
    return Finished(stop.value.code or 0, out.getvalue(), err.getvalue())


def assert_refused(result, *parts, cwd):
    """Exit code 2, one message with these parts, no traceback, and no file left that was not there."""
    assert result.returncode == 2, result.stderr
    assert "Traceback" not in result.stderr
    for part in parts:
        assert part in result.stderr
    assert not list(cwd.glob("out*")), "something was half-written"
    assert not list(cwd.glob(".*")), "a draft was left behind"


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Signs and drive of the shipped data, ingested by the command line."""
    folder = tmp_path_factory.mktemp("tables")
    for kind, source, name in (("signs", PBF, "signs"), ("drive", POS, "drives")):
        result = geofleet("ingest", kind, source, "--out", f"{name}.parquet", cwd=folder)
        assert result.returncode == 0, result.stderr
    return folder


def test_the_installed_command_refuses_without_a_traceback(tmp_path):
    command = [Path(sys.executable).with_name("geofleet"), "ingest", "signs", "absent.osm", "--out", "out.parquet"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)  # noqa: S603 (our own command)
    assert_refused(result, "geofleet: absent.osm", cwd=tmp_path)


def test_help_lists_the_steps(tmp_path):
    result = geofleet("--help", cwd=tmp_path)
    assert result.returncode == 0
    for command in ("ingest", "simulate", "aggregate", "evaluate", "report", "demo", "sql", "schema"):
        assert command in result.stdout


@pytest.mark.parametrize("command", [[], ["ingest"], ["study"]])
def test_lists_of_commands_say_whole_sentences(command):
    listing = CliRunner().invoke(app, [*command, "--help"], env={"COLUMNS": "80"}).output.partition("Commands:\n")[2]
    assert listing.strip()
    assert all(line.endswith((".", "?")) and not line.endswith("...") for line in listing.rstrip().splitlines())


def test_help_imports_nothing_heavy():
    """`geofleet --help` answers in under 0.3 s: what is imported decides."""
    code = """
import sys
from geofleet.cli import app
app(["--help"], standalone_mode=False)
print(*{name.partition('.')[0] for name in sys.modules})
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)  # noqa: S603
    heavy = {"numpy", "pyarrow", "duckdb", "rich", "pygments", "markdown_it", "pydantic", "scipy", "numba", "pyproj"}
    assert not heavy & set(result.stdout.splitlines()[-1].split())


@pytest.mark.parametrize("kind", ["signs", "lanes", "drive"])
def test_a_missing_file_is_named(kind, tmp_path):
    result = geofleet("ingest", kind, "absent.osm.pbf", "--out", "out.parquet", cwd=tmp_path)
    assert_refused(result, "absent.osm.pbf", "no such file", cwd=tmp_path)


@pytest.mark.parametrize("kind", ["signs", "lanes", "drive"])
@pytest.mark.parametrize("suffix", ["osm.pbf", "osm", "pos"])
def test_an_empty_file_is_named(kind, suffix, tmp_path):
    (tmp_path / f"empty.{suffix}").touch()
    result = geofleet("ingest", kind, f"empty.{suffix}", "--out", "out.parquet", cwd=tmp_path)
    assert_refused(result, f"empty.{suffix}", "empty", cwd=tmp_path)


@pytest.mark.parametrize(("kind", "source"), [("signs", POS), ("lanes", POS), ("drive", PBF)])
def test_the_wrong_format_is_named(kind, source, tmp_path):
    result = geofleet("ingest", kind, source, "--out", "out.parquet", cwd=tmp_path)
    assert_refused(result, source.name, cwd=tmp_path)


def test_no_signs_near_the_drive(tables, tmp_path):
    drive = tmp_path / "far.pos"
    lines = POS.read_text().splitlines(keepends=True)
    drive.write_text("".join(line if line.startswith("%") else line.replace(" 60.", " 59.", 1) for line in lines))
    assert geofleet("ingest", "drive", drive, "--out", "far.parquet", cwd=tmp_path).returncode == 0
    result = geofleet(
        "simulate", "--signs", tables / "signs.parquet", "--drive", "far.parquet", "--out", "out", cwd=tmp_path
    )
    assert_refused(result, "no sign is within 15 m of the drive 'far'", "m away", "corridor_m", cwd=tmp_path)


@pytest.mark.parametrize("key", ["rang_m=3", "sensor.colour=1", "fov_deg=400", "gnss_sigma_m=-1", "nothing"])
def test_an_unknown_or_impossible_scenario_key(key, tables, tmp_path):
    result = geofleet(
        *("simulate", "--signs", tables / "signs.parquet", "--drive", tables / "drives.parquet"),
        *("--set", key, "--out", "out"),
        cwd=tmp_path,
    )
    assert_refused(result, key.partition("=")[0].rpartition(".")[2], cwd=tmp_path)


def test_an_unknown_scenario(tables, tmp_path):
    result = geofleet(
        *("simulate", "--signs", tables / "signs.parquet", "--drive", tables / "drives.parquet"),
        *("--scenario", "nowhere", "--out", "out"),
        cwd=tmp_path,
    )
    assert_refused(result, "unknown scenario 'nowhere'", "paper", cwd=tmp_path)


@pytest.mark.parametrize("fault", ["missing", "mistyped"])
@pytest.mark.parametrize("command", ["simulate", "aggregate", "evaluate"])
def test_a_table_with_a_missing_or_mistyped_column(command, fault, tables, tmp_path):
    signs = pq.read_table(tables / "signs.parquet")
    column = signs.column_names.index("sign_class")
    broken = signs.remove_column(column)
    if fault == "mistyped":
        broken = broken.add_column(column, "sign_class", pa.array(range(signs.num_rows)))
    pq.write_table(broken, tmp_path / "broken.parquet")
    arguments = {
        "simulate": ("--signs", "broken.parquet", "--drive", tables / "drives.parquet", "--out", "out"),
        "aggregate": ("--detections", "broken.parquet", "--out", "out.parquet"),
        "evaluate": ("--map", "broken.parquet", "--reference", tables / "signs.parquet", "--out", "out"),
    }[command]
    result = geofleet(command, *arguments, cwd=tmp_path)
    wanted = "sign_class" if command != "aggregate" else "column"
    assert_refused(result, "broken.parquet", wanted, cwd=tmp_path)


def test_evaluate_as_a_gate(tables, tmp_path):
    signs = tables / "signs.parquet"
    arguments = ("evaluate", "--map", signs, "--reference", signs, "--out", "scores", "--json")
    result = geofleet(*arguments, "--require", "gospa_m<0.8", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    total = json.loads(result.stdout)["totals"][0]
    assert (total["gospa_m"], total["f1"]) == (0.0, 1.0)
    result = geofleet(*arguments, "--require", "f1>1", cwd=tmp_path)
    assert result.returncode == 1
    assert "f1>1 is missed" in result.stderr


def test_sql_sees_every_table_by_its_name(tables):
    result = geofleet("sql", "SELECT count(*) AS n FROM signs", "--data", tables, "--json", cwd=tables)
    assert json.loads(result.stdout)[0]["n"] > 1000


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("SELECT * FROM nowhere",), "Tables here: drives, signs"),
        (("absent.sql",), "absent.sql"),
        (("SELECT 1", "--data", "nowhere"), "no tables below"),
    ],
)
def test_sql_that_fails(arguments, part, tables, tmp_path):
    if "--data" not in arguments:
        arguments = (*arguments, "--data", tables)
    assert_refused(geofleet("sql", *arguments, cwd=tmp_path), part, cwd=tmp_path)


def test_schema_of_a_table(tmp_path):
    result = geofleet("schema", "detections", "--json", cwd=tmp_path)
    assert {"column": "track_id"}.items() <= json.loads(result.stdout)[3].items()
    assert_refused(geofleet("schema", "nothing", cwd=tmp_path), "signs, runs", cwd=tmp_path)


def test_schema_of_the_settings_lists_every_key(tmp_path):
    settings = json.loads(geofleet("schema", "config", "--json", cwd=tmp_path).stdout)
    assert {name: set(keys) for name, keys in settings.items()} == {
        name: set(section.model_fields) for name, section in SECTIONS.items()
    }
    assert "eps_m = 4.0" in geofleet("schema", "config", cwd=tmp_path).stdout


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("compare", "--methods", "dbscn"), "Did you mean dbscan"),
        (("compare", "--vehicles", "five"), "--vehicles"),
        (("fleet-size", "--scenario", "nowhere"), "unknown scenario"),
        (("plan", "--target", "gospa_m"), "Example: gospa_m=0.5"),
        (("plan", "--target", "f1=0.9", "--method", "dbscan,kmeans"), "one drive, one scenario and one method"),
        (("plan", "--target", "f1=0.9", "--confidence", "1.5"), "--confidence: the level is 1.5"),
        (("plan", "--target", "f1=0.9", "--method", "joint-prior", "--prior", "no.gpkg"), "no.gpkg: there is no such"),
    ],
)
def test_a_study_that_cannot_be(arguments, says, tables, tmp_path):
    inputs = ("--signs", tables / "signs.parquet", "--drive", tables / "drives.parquet")
    result = geofleet("study", *arguments, *inputs, "--out", "out", cwd=tmp_path)
    assert_refused(result, says, cwd=tmp_path)
    assert "..." not in result.stderr, "work was announced before the fault was found"


def test_a_fault_of_an_input_stands_alone(tmp_path):
    (tmp_path / "signs.geojson").write_text('{"type": "FeatureCollection", "features": [{"type": "Feat')
    (tmp_path / "drive.csv").write_text("time,lat,lon\nx,y,z\n")
    for what, name in (("signs", "signs.geojson"), ("drive", "drive.csv"), ("detections", "drive.csv")):
        result = geofleet("ingest", what, name, "--out", "out.parquet", cwd=tmp_path)
        assert_refused(result, name, cwd=tmp_path)
        assert len(result.stderr.splitlines()) == 1, result.stderr


def test_work_that_lasts_is_announced_before_anything_is_done(monkeypatch, capsys):
    monkeypatch.setattr(output, "_PATIENCE_S", 0.05)
    with output.progress_bar("reading signs") as tell:
        tell(0, 1)
        assert not capsys.readouterr().err
        time.sleep(0.5)
        tell(1, 1)
    assert capsys.readouterr().err == "reading signs ...\n"


def test_progress_tells_the_time_left_but_not_at_the_end(monkeypatch, capsys):
    monkeypatch.setattr(output, "_SECONDS_A_LINE", -1)
    with output.progress_bar("planning") as tell:
        assert not capsys.readouterr().err
        for done in (2, 3, 4, 6):
            tell(done, 6)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "planning ..."
    assert [line.partition(" after")[0] for line in lines[1:]] == [f"planning: {done} of 6" for done in (2, 3, 4, 6)]
    assert ["left" in line for line in lines[1:]] == [False, False, True, False]


def test_an_outdated_copy_from_the_command_line(tables, tmp_path):
    result = geofleet("stale", tables / "signs.parquet", "prior.gpkg", "--shift-m", "1,0", "--json", cwd=tmp_path)
    assert json.loads(result.stdout)["fates"]["removed"] > 100
    assert_refused(geofleet("stale", tables / "signs.parquet", "out.kml", cwd=tmp_path), "no format to", cwd=tmp_path)
