"""The `geofleet` command: parses, calls one step or workflow, prints. Nothing else prints, exits or draws progress.

Exit codes: 0 done, 1 a check failed, 2 bad usage or bad input (one message, no traceback).
"""

from __future__ import annotations

import json
import os
import sys
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geofleet.errors import ConfigError, GeofleetError, InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from geofleet.config import Config
    from geofleet.steps.evaluate import EvaluateResult

app = typer.Typer(
    name="geofleet",
    help="Turn the traffic-sign detections of many cars into an updated sign map, and say how good it is.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
ingest_app = typer.Typer(no_args_is_help=True, help="Load sign maps, roads and drives into GeoParquet tables.")
app.add_typer(ingest_app, name="ingest")

Inputs = Annotated[list[Path], typer.Argument(help="Files to read.", show_default=False)]
MapInputs = Annotated[list[Path] | None, typer.Argument(help="Files to read.", show_default=False)]
Place = Annotated[str | None, typer.Option("--place", help='Fetch OpenStreetMap of a place: "Compiègne, France".')]
Bbox = Annotated[str | None, typer.Option("--bbox", help="Fetch OpenStreetMap of a box.", metavar="W,S,E,N")]
Cache = Annotated[Path | None, typer.Option("--cache", help="Folder to keep what was fetched in.")]
Out = Annotated[Path, typer.Option("--out", help="Table to write.")]
FileFormat = Annotated[str, typer.Option("--format", help="auto, or the name of the format of all inputs.")]
Crs = Annotated[str | None, typer.Option("--crs", help="CRS of the coordinates, e.g. EPSG:25832.")]
Origin = Annotated[str | None, typer.Option("--origin", help="Where local coordinates are zero.", metavar="LAT,LON")]
Utm = Annotated[
    str | None,
    typer.Option("--utm", help="Projected CRS of local coordinates, and where they are zero.", metavar="CRS,E0,N0"),
]
Columns = Annotated[
    str | None,
    typer.Option(
        "--columns", help="What columns mean: code=bord,facing=azimuth, or a TOML file.", metavar="NAME=COLUMN,..."
    ),
]
SchemeOption = Annotated[
    str | None, typer.Option("--scheme", help="Scheme of the codes: mapillary, osm, vienna, us ...")
]
CountryOption = Annotated[
    str | None, typer.Option("--country", help="ISO 3166-1 alpha-2 of codes that do not name it.")
]
LayerOption = Annotated[str | None, typer.Option("--layer", help="Layer of a GeoPackage.")]
OutFolder = Annotated[Path, typer.Option("--out", help="Folder to write.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="A TOML file of settings.")]
Scenario = Annotated[str, typer.Option("--scenario", help="Name of a packaged scenario, or a TOML file.")]
Settings = Annotated[
    list[str] | None, typer.Option("--set", help="Override any key: --set eps_m=4.0", metavar="KEY=VALUE")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Workers = Annotated[int, typer.Option("--workers", min=1, help="Worker threads; the result does not depend on it.")]
N_CORES = os.cpu_count() or 1


def main() -> None:
    """Run the command line; every expected fault ends in one message and exit code 2."""
    try:
        app()
    except GeofleetError as error:
        _fail(str(error))
    except OSError as error:
        _fail(str(InputError(f"{error.strerror or error}.", where=str(error.filename or ""))))


def _fail(message: str) -> None:
    sys.stderr.write(f"geofleet: {message}\n")
    raise SystemExit(2)


@ingest_app.command("signs")
def ingest_signs(
    out: Out,
    inputs: MapInputs = None,
    place: Place = None,
    bbox: Bbox = None,
    cache: Cache = None,
    file_format: FileFormat = "auto",
    crs: Crs = None,
    origin: Origin = None,
    utm: Utm = None,
    columns: Columns = None,
    scheme: SchemeOption = None,
    country: CountryOption = None,
    roads: Annotated[bool, typer.Option("--roads/--no-roads", help="Infer facing and road from the ways.")] = True,
    as_json: AsJson = False,
) -> None:
    """Read signs from maps and inventories into a `signs` table.

    Example: geofleet ingest signs data/raw/helsinki.osm.pbf --out signs.parquet
    """
    _spare_memory()
    from geofleet.steps import ingest

    paths = _with_fetched(inputs, place, bbox, cache)
    options = {"crs": crs, "origin": _origin(origin), "utm": _utm(utm), "scheme": scheme, "country": country}
    with _progress("reading signs") as progress:
        result = ingest.ingest_signs(
            paths,
            out,
            file_format=file_format,
            roads=roads,
            progress=progress,
            columns=_columns(columns),
            **options,
        )
    _report(result, as_json=as_json)


@ingest_app.command("lanes")
def ingest_lanes(
    out: Out,
    inputs: MapInputs = None,
    place: Place = None,
    bbox: Bbox = None,
    cache: Cache = None,
    file_format: FileFormat = "auto",
    crs: Crs = None,
    origin: Origin = None,
    utm: Utm = None,
    as_json: AsJson = False,
) -> None:
    """Read drivable roads or lanes into a `lanes` table.

    Example: geofleet ingest lanes data/raw/helsinki.osm.pbf --out lanes.parquet
    """
    _spare_memory()
    from geofleet.steps import ingest

    paths = _with_fetched(inputs, place, bbox, cache)
    options = {"crs": crs, "origin": _origin(origin), "utm": _utm(utm)}
    with _progress("reading roads") as progress:
        result = ingest.ingest_lanes(paths, out, file_format=file_format, progress=progress, **options)
    _report(result, as_json=as_json)


@ingest_app.command("drive")
def ingest_drive(
    inputs: Inputs,
    out: Out,
    file_format: Annotated[str, typer.Option("--format", help="auto, rtklib, nmea, gpx or csv.")] = "auto",
    columns: Columns = None,
    crs: Crs = None,
    origin: Origin = None,
    utm: Utm = None,
    as_json: AsJson = False,
) -> None:
    """Read trajectories into a `drives` table.

    Example: geofleet ingest drive data/raw/helsinki_derived.pos --out drives.parquet
    """
    from geofleet.steps import ingest

    with _progress("reading drives") as progress:
        result = ingest.ingest_drive(
            inputs,
            out,
            file_format=file_format,
            columns=_columns(columns),
            crs=crs,
            origin=_origin(origin),
            utm=_utm(utm),
            progress=progress,
        )
    _report(result, as_json=as_json)


@ingest_app.command("detections")
def ingest_detections(
    inputs: Inputs,
    out: OutFolder,
    columns: Columns = None,
    crs: Crs = None,
    scheme: SchemeOption = None,
    country: CountryOption = None,
    run_id: Annotated[str | None, typer.Option(help="Of rows that do not name one; fleet by default.")] = None,
    as_json: AsJson = False,
) -> None:
    """Read the detections of a real fleet into a `detections` table; bad rows go to <out>_rejected.parquet.

    Example: geofleet ingest detections fleet.csv --columns x=lon,y=lat,code=sign --scheme mapillary --out detections
    """
    from geofleet.steps import ingest_detections as step

    with _progress("reading detections") as progress:
        result = step.ingest_detections(
            inputs,
            out,
            columns=_columns(columns),
            crs=crs,
            scheme=scheme,
            country=country,
            run_id=run_id,
            progress=progress,
        )
    _report(result, as_json=as_json)


@app.command()
def simulate(
    signs: Annotated[Path, typer.Option("--signs", help="A signs table.")],
    drive: Annotated[Path, typer.Option("--drive", help="A drives table.")],
    out: OutFolder,
    scenario: Scenario = "paper",
    vehicles: Annotated[int, typer.Option("--vehicles", help="Size of the fleet.")] = 50,
    replicates: Annotated[int, typer.Option("--replicates", help="Independent repetitions.")] = 1,
    seed: Annotated[int, typer.Option("--seed", help="Of all random numbers.")] = 0,
    corridor_m: Annotated[float | None, typer.Option(help="Signs this near to the drive are the scene.")] = None,
    respect_facing: Annotated[
        bool | None, typer.Option("--respect-facing", help="A sign is seen from its front only.")
    ] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    workers: Workers = N_CORES,
    as_json: AsJson = False,
) -> None:
    """Simulate a fleet that drives past real signs: reference, passes, detections, truth.

    Example: geofleet simulate --signs signs.parquet --drive drives.parquet --vehicles 50 --out simulation
    """
    from geofleet.steps import simulate as step

    settled = _settle(config or scenario, settings, corridor_m=corridor_m, respect_facing=respect_facing)
    with _progress("simulating") as progress:
        result = step.simulate(
            signs,
            drive,
            out,
            config=settled,
            n_vehicles=vehicles,
            n_replicates=replicates,
            seed=seed,
            n_workers=workers,
            progress=progress,
        )
    _report(result, as_json=as_json)


@app.command()
def aggregate(
    detections: Annotated[Path, typer.Option("--detections", help="A detections table or folder.")],
    out: Out,
    vehicles: Annotated[int | None, typer.Option("--vehicles", help="Use the first V vehicles only.")] = None,
    method: Annotated[str | None, typer.Option(help="dbscan, hdbscan, kmeans or kmedoids.")] = None,
    semantic: Annotated[str | None, typer.Option(help="first or after.")] = None,
    eps_m: Annotated[float | None, typer.Option(help="Radius of a neighbourhood.")] = None,
    min_samples: Annotated[int | None, typer.Option(help="Detections that make a core.")] = None,
    min_cluster_size: Annotated[int | None, typer.Option(help="Detections that make a cluster: hdbscan.")] = None,
    k: Annotated[int | None, typer.Option("--k", help="Signs of a run: kmeans, kmedoids; 0 = chosen.")] = None,
    k_from: Annotated[Path | None, typer.Option(help="Reference that tells K (an oracle): kmeans, kmedoids.")] = None,
    min_support: Annotated[int | None, typer.Option(help="Passes that a sign needs.")] = None,
    passes: Annotated[Path | None, typer.Option(help="A passes table: support relative to who saw the place.")] = None,
    tile_zoom: Annotated[int | None, typer.Option(help="Size of the tiles; the result does not depend on it.")] = None,
    config: ConfigFile = None,
    scenario: Scenario = "paper",
    settings: Settings = None,
    workers: Workers = N_CORES,
    as_json: AsJson = False,
) -> None:
    """Cluster detections per tile and fuse them into a sign map.

    Example: geofleet aggregate --detections simulation/detections --out fused.parquet
    """
    from geofleet.steps import aggregate as step

    settled = _settle(
        config or scenario,
        settings,
        method=method,
        semantic=semantic,
        eps_m=eps_m,
        min_samples=min_samples,
        min_cluster_size=min_cluster_size,
        k=k,
        min_support=min_support,
        tile_zoom=tile_zoom,
    )
    with _progress("aggregating") as progress:
        result = step.aggregate(
            detections,
            out,
            config=settled,
            n_vehicles=vehicles,
            passes=passes,
            k_from=k_from,
            n_workers=workers,
            progress=progress,
        )
    _report(result, as_json=as_json)


@app.command()
def evaluate(
    map_: Annotated[Path, typer.Option("--map", help="The map to score.")],
    reference: Annotated[Path, typer.Option("--reference", help="The map to trust.")],
    out: OutFolder,
    gate: Annotated[float | None, typer.Option("--gate", help="c: a match is nearer than this, metres.")] = None,
    match_on: Annotated[str | None, typer.Option(help="class, concept or none.")] = None,
    clip: Annotated[bool, typer.Option("--clip", help="Score only where both maps have signs.")] = False,
    clip_m: Annotated[float | None, typer.Option(help="With --clip: as near as this, 100 m if not given.")] = None,
    in_view: Annotated[bool, typer.Option("--in-view", help="Score only signs that a pass had in view.")] = False,
    drive: Annotated[Path | None, typer.Option("--drive", help="Drives table: intervals go along it.")] = None,
    versus: Annotated[Path | None, typer.Option("--versus", help="Another map: is the first one better?")] = None,
    require: Annotated[list[str] | None, typer.Option(help='Exit 1 when missed: "gospa_m<0.8".')] = None,
    config: ConfigFile = None,
    scenario: Scenario = "paper",
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Score a sign map against a reference: GOSPA_M, precision, recall, F1.

    Example: geofleet evaluate --map fused.parquet --reference simulation/reference.parquet --out evaluation
    """
    from geofleet.steps import evaluate as step

    settled = _settle(config or scenario, settings, gate_m=gate, match_on=match_on)
    requirements = step.parse_requirements(require or [])
    reach_m = step.CLIP_M if clip and clip_m is None else clip_m
    result = step.evaluate(
        map_,
        reference,
        out,
        config=settled,
        clip_m=reach_m,
        in_view=in_view,
        drive_path=drive,
        versus_path=versus,
    )
    missed = step.missed_requirements(result.totals, requirements)
    if as_json:
        _print_json({**asdict(result), "missed": missed})
    else:
        _print_evaluation(result)
    for sentence in missed:
        sys.stderr.write(f"geofleet: {sentence}\n")
    if missed:
        raise typer.Exit(1)


@app.command()
def report(
    run_dir: Annotated[Path, typer.Argument(help="Folder with signs, lanes, drives, simulation and evaluation.")],
    out: Annotated[Path | None, typer.Option("--out", help="Folder to write; RUN_DIR/report by default.")] = None,
    as_json: AsJson = False,
) -> None:
    """Draw the map of a run with its matches, as PNG and SVG.

    Example: geofleet report data/processed
    """
    from geofleet.steps import report as step

    result = step.report(run_dir, out or run_dir / "report")
    if as_json:
        _print_json(asdict(result))
    else:
        _print_files(result.files)


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder to write.")] = Path("geofleet-demo"),
    workers: Workers = N_CORES,
    show: Annotated[bool, typer.Option("--show", help="Only print what a finished demo in --out has found.")] = False,
    as_json: AsJson = False,
) -> None:
    """Run the main job on the shipped data: 50 simulated cars past real signs in Helsinki.

    Example: geofleet demo --out geofleet-demo
    """
    from geofleet.workflows import demo as workflow

    if not show:
        with _progress("demo") as progress:
            workflow.run_demo(out, n_workers=workers, progress=progress)
    result = workflow.demo_result(out)
    if as_json:
        _print_json(asdict(result))
        return
    typer.echo(f"\n{result.caption}\n")
    _print_scores(result.totals)
    typer.echo("\nLook at the picture, and drag the GeoPackage into QGIS (every layer opens styled):")
    _print_files(result.files)


@app.command()
def sql(
    query: Annotated[str, typer.Argument(help="A statement, or the path of a .sql file.")],
    data: Annotated[Path, typer.Option("--data", help="Folder with tables.")] = Path("data/processed"),
    as_json: AsJson = False,
) -> None:
    """Query the tables below a folder with DuckDB's spatial SQL; each table is a view of its name.

    Example: geofleet sql "SELECT concept, count(*) AS n FROM signs GROUP BY concept ORDER BY n DESC"
    """
    from geofleet.workflows.query import query as workflow

    names, rows = workflow(query, data)
    if as_json:
        _print_json([dict(zip(names, row, strict=True)) for row in rows])
    else:
        _print_table(names, rows)


@app.command()
def info(
    files: Inputs,
    table: Annotated[str, typer.Option("--table", help="auto, signs, lanes, drives or detections.")] = "auto",
    crs: Crs = None,
    origin: Origin = None,
    utm: Utm = None,
    columns: Columns = None,
    scheme: SchemeOption = None,
    country: CountryOption = None,
    layer: LayerOption = None,
    as_json: AsJson = False,
) -> None:
    """Tell what is in files: format, CRS and datum operation, extent, counts, what was skipped and why.

    Example: geofleet info city.xodr drive.pos
    """
    from geofleet.workflows.info import info as workflow

    options = {"crs": crs, "origin": _origin(origin), "utm": _utm(utm), "columns": _columns(columns)}
    options |= {"scheme": scheme, "country": country, "layer": layer}
    found = [workflow(path, table=table, **options) for path in files]
    if as_json:
        _print_json(found[0] if len(found) == 1 else {"files": found})
        return
    for one in found:
        typer.echo("\n".join(one.lines()))


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A map, inventory or table.", show_default=False)],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write.", show_default=False)],
    table: Annotated[str, typer.Option("--table", help="signs or lanes.")] = "signs",
    file_format: FileFormat = "auto",
    crs: Crs = None,
    origin: Origin = None,
    utm: Utm = None,
    columns: Columns = None,
    scheme: SchemeOption = None,
    country: CountryOption = None,
    layer: LayerOption = None,
    roads: Annotated[bool, typer.Option("--roads/--no-roads", help="Infer facing and road from the ways.")] = True,
    as_json: AsJson = False,
) -> None:
    """Write signs or lanes as .parquet, .geojson, .gpkg, .fgb, .osm or .osc, whatever they come from.

    Example: geofleet convert city.xodr city.geojson
    """
    from geofleet.workflows.convert import convert as workflow

    options: dict[str, Any] = {"crs": crs, "origin": _origin(origin), "utm": _utm(utm), "columns": _columns(columns)}
    options |= {"scheme": scheme, "country": country, "layer": layer, "roads": roads}
    _report(workflow(source, out, table=table, file_format=file_format, **options), as_json=as_json)


@app.command()
def schema(
    table: Annotated[str | None, typer.Argument(help="Name of a table; all names when left out.")] = None,
    as_json: AsJson = False,
) -> None:
    """Print the schema of a table: columns with type, unit and meaning.

    Example: geofleet schema detections
    """
    from geofleet.tables.schemas import SCHEMAS
    from geofleet.tables.store import schema_named

    names: tuple[str, ...]
    rows: list[tuple[str, ...]]
    if table is None:
        rows = [(s.name, ", ".join(s.key), s.description) for s in SCHEMAS.values()]
        names = ("table", "key", "description")
    else:
        found = schema_named(table)
        names = ("column", "type", "null", "description")
        rows = [(c.name, str(c.type), "null" if c.nullable else "", c.description) for c in found.all_columns]
        if found.geometry:
            rows.append(("geometry", f"{found.geometry}, WKB", "", "OGC:CRS84, longitude and latitude"))
    if as_json:
        _print_json([dict(zip(names, row, strict=True)) for row in rows])
    else:
        _print_table(names, rows)


def _with_fetched(inputs: list[Path] | None, place: str | None, bbox: str | None, cache: Path | None) -> list[Path]:
    """Return the files named and, of a place or box named, the file fetched."""
    if place is None and bbox is None:
        return inputs or []
    from geofleet.formats import osm_online

    box = None if bbox is None else osm_online.parse_bbox(bbox)
    with _progress("asking OpenStreetMap"):
        return [*(inputs or []), osm_online.fetch(place=place, bbox=box, cache=cache)]


def _spare_memory() -> None:
    """Have Arrow give back what it is done with: a table that is written in pieces then needs 40 MB less."""
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")


def _origin(text: str | None) -> tuple[float, float] | None:
    """Read `LAT,LON`."""
    if text is None:
        return None
    try:
        lat, lon = map(float, text.split(","))
    except ValueError:
        raise ConfigError(f"{text!r} is not LAT,LON.", where="--origin", todo="Example: --origin 49.0,8.4") from None
    return lat, lon


def _utm(text: str | None) -> tuple[str, float, float] | None:
    """Read `CRS,E0,N0`."""
    if text is None:
        return None
    crs, *zero = text.split(",")
    try:
        east, north = map(float, zero)
    except ValueError:
        raise ConfigError(
            f"{text!r} is not CRS,E0,N0.", where="--utm", todo="Example: --utm EPSG:32633,450000,5400000"
        ) from None
    return crs, east, north


def _columns(text: str | None) -> dict[str, str] | Path | None:
    """Read `name=column,name=column`, or the path of a TOML file."""
    if text is None:
        return None
    if text.endswith(".toml"):
        return Path(text)
    pairs = [pair.partition("=") for pair in text.split(",")]
    if not all(name and column for name, _, column in pairs):
        raise ConfigError(
            f"{text!r} is not name=column,...", where="--columns", todo="Example: --columns code=bord,facing=azimuth"
        )
    return {name.strip(): column.strip() for name, _, column in pairs}


def _settle(scenario: str | Path, settings: list[str] | None, **options: Any) -> Config:
    """Read the settings; options win over `--set`, which wins over the file."""
    from geofleet.config import load_config

    given = [f"{key}={json.dumps(value)}" for key, value in options.items() if value is not None]
    return load_config(scenario, [*(settings or []), *given])


@contextmanager
def _progress(label: str) -> Iterator[Callable[[int, int], None]]:
    """Draw a progress bar on a terminal; elsewhere (CI, a pipe) say on standard error what is being done."""
    if not sys.stderr.isatty():
        sys.stderr.write(f"{label} ...\n")
        yield lambda _done, _total: None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


def _report(result: Any, *, as_json: bool) -> None:
    """Print the result of a step: one JSON object, or a line a field; fields that are empty are left out."""
    fields = asdict(result)
    if as_json:
        _print_json(fields)
        return
    width = max(map(len, fields))
    for name, value in fields.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key}: {number}" for key, number in value.items() if number != 0)  # noqa: PLW2901 (text)
        elif isinstance(value, list | tuple):
            value = ", ".join(map(str, value))  # noqa: PLW2901 (text)
        if value not in ("", None):
            typer.echo(f"  {name.ljust(width)}  {value}")


def _print_json(value: Any) -> None:
    typer.echo(json.dumps(value, indent=2, default=_plain))


def _plain(value: Any) -> Any:
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)


def _print_scores(totals: tuple[dict[str, Any], ...]) -> None:
    names = (
        "run_id",
        "method",
        "n_vehicles",
        "tp",
        "fp",
        "fn",
        "precision",
        "recall",
        "f1",
        "rmse_m",
        "gospa",
        "gospa_m",
    )
    _print_table(names, [tuple(total[name] for name in names) for total in totals])
    for total in totals:
        if total["null_reason"]:
            typer.echo(f"{total['run_id'] or total['method']}: {total['null_reason']}")


def _print_evaluation(result: EvaluateResult) -> None:
    """Print totals, their means when there are several runs, sources when there are several, and what was left out."""
    _print_scores(result.totals)
    for rows, is_told in ((result.summary, len(result.totals) > 1), (result.sources, bool(result.sources))):
        if is_told:
            names = tuple(name for name in rows[0] if name not in ("run_id", "match_on", "gate_m", "null_reason"))
            typer.echo()
            _print_table(names, [tuple(row[name] for name in names) for row in rows])
    _print_intervals(result.intervals)
    _print_comparisons(result.comparisons)
    for name, number in result.counts.items():
        if number:
            typer.echo(f"{name}: {number}")
    _print_files(result.files)


def _print_intervals(rows: tuple[dict[str, Any], ...]) -> None:
    """Say how sure F1 and GOSPA_M are, and of what; all scores stand in intervals.csv."""
    for row in rows:
        if row["score"] in ("f1", "gospa_m") and row["low"] is not None:
            typer.echo(
                f"{row['score']} {row['estimate']:.4f}, {row['level']:.0%} interval "
                f"{row['low']:.4f} to {row['high']:.4f}: {row['estimand']}"
            )
        elif row["score"] in ("f1", "gospa_m"):
            typer.echo(f"{row['score']}: no interval: {row['note']}")
    for note in sorted({row["note"] for row in rows if row["note"] and row["low"] is not None}):
        typer.echo(f"  beware: {note}")


def _print_comparisons(rows: tuple[dict[str, Any], ...]) -> None:
    """Print the verdict on map A (--map) against map B (--versus), score by score."""
    names = ("score", "difference", "low", "high", "p_value", "verdict")
    if rows:
        typer.echo("\nmap A (--map) minus map B (--versus):")
        _print_table(names, [tuple(row[name] for name in names) for row in rows])


def _print_files(files: tuple[Path, ...]) -> None:
    for path in files:
        typer.echo(f"  {path}")


def _print_table(names: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
    """Print left-aligned text and right-aligned numbers, never cut to the width of the terminal."""
    cells = [[f"{v:.4f}" if isinstance(v, float) else "" if v is None else str(v) for v in row] for row in rows]
    widths = [max(len(name), *(len(row[i]) for row in cells)) if cells else len(name) for i, name in enumerate(names)]
    right = [any(isinstance(row[i], int | float) for row in rows) for i in range(len(names))]
    for row in [list(names), *cells]:
        aligned = (c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, right, strict=True))
        typer.echo("  ".join(aligned).rstrip())
