"""`geofleet simulate, aggregate, evaluate, report, demo`: the steps after ingest."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from geofleet.cli.options import (
    N_CORES,
    AsJson,
    ConfigFile,
    Out,
    OutFolder,
    Scenario,
    Settings,
    Workers,
    parse_area,
    settle,
)
from geofleet.cli.output import (
    print_evaluation,
    print_files,
    print_json,
    print_result,
    print_scores,
    print_table,
    progress_bar,
)

app = typer.Typer(rich_markup_mode=None)


@app.command()
def simulate(
    signs: Annotated[Path, typer.Option("--signs", help="Signs of any source.")],
    drive: Annotated[Path, typer.Option("--drive", help="A drive of any format.")],
    out: OutFolder,
    scenario: Scenario = "paper",
    vehicles: Annotated[int, typer.Option("--vehicles", help="Size of the fleet.")] = 50,
    replicates: Annotated[int, typer.Option("--replicates", help="Independent repetitions.")] = 1,
    seed: Annotated[int, typer.Option("--seed", help="Of all random numbers.")] = 0,
    corridor_m: Annotated[
        float | None, typer.Option(help="Signs this near to the drive are the scene, metres.")
    ] = None,
    groups: Annotated[
        str | None, typer.Option(help="Groups of signs in the scene: warning,priority ...", metavar="NAME,...")
    ] = None,
    respect_facing: Annotated[
        bool | None, typer.Option("--respect-facing", help="A sign is seen from its front only.")
    ] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    workers: Workers = N_CORES,
    as_json: AsJson = False,
) -> None:
    """Simulate a fleet past real signs. Writes reference, passes, detections and truth.

    Example: geofleet simulate --signs city.osm.pbf --drive drive.pos --vehicles 50 --out simulation
    """
    from geofleet.steps import simulate as step

    names = None if groups is None else [name.strip() for name in groups.split(",")]
    settled = settle(config or scenario, settings, corridor_m=corridor_m, groups=names, respect_facing=respect_facing)
    with progress_bar("simulating") as progress:
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
    print_result(result, as_json=as_json)


@app.command()
def aggregate(
    detections: Annotated[Path, typer.Option("--detections", help="A detections table or folder.")],
    out: Out,
    vehicles: Annotated[int | None, typer.Option("--vehicles", help="Use the first V vehicles only.")] = None,
    method: Annotated[str | None, typer.Option(help="dbscan, hdbscan, kmeans, kmedoids or joint.")] = None,
    semantic: Annotated[str | None, typer.Option(help="first or after.")] = None,
    eps_m: Annotated[float | None, typer.Option(help="Radius of a neighbourhood, metres: dbscan.")] = None,
    min_samples: Annotated[
        int | None,
        typer.Option(help="Detections that make a core everywhere: dbscan. Left out, dense places ask for more."),
    ] = None,
    min_cluster_size: Annotated[int | None, typer.Option(help="Detections that make a cluster: hdbscan.")] = None,
    k: Annotated[int | None, typer.Option("--k", help="Signs of a run: kmeans, kmedoids; 0 = chosen.")] = None,
    k_from: Annotated[Path | None, typer.Option(help="Reference that tells K (an oracle): kmeans, kmedoids.")] = None,
    min_support: Annotated[int | None, typer.Option(help="Passes that a sign needs: all but joint.")] = None,
    passes: Annotated[Path | None, typer.Option(help="A passes table: who could have seen a place.")] = None,
    prior: Annotated[Path | None, typer.Option(help="An earlier map, any sign source: joint.")] = None,
    area: Annotated[str | None, typer.Option(help="Set detections outside aside, degrees.", metavar="W,S,E,N")] = None,
    explain: Annotated[
        str | None, typer.Option(help="Also list what is behind a sign: joint.", metavar="SIGN_ID")
    ] = None,
    correct_bias: Annotated[
        bool | None, typer.Option("--correct-bias", help="Take the bias of each pass out first (information form).")
    ] = None,
    tile_zoom: Annotated[
        int | None, typer.Option(help="Web Mercator zoom of the tiles, 12 to 20; not of the result.")
    ] = None,
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

    settled = settle(
        config or scenario,
        settings,
        method=method,
        semantic=semantic,
        eps_m=eps_m,
        min_samples=min_samples,
        min_cluster_size=min_cluster_size,
        k=k,
        min_support=min_support,
        correct_bias=correct_bias,
        tile_zoom=tile_zoom,
    )
    with progress_bar("aggregating") as progress:
        result = step.aggregate(
            detections,
            out,
            config=settled,
            n_vehicles=vehicles,
            passes=passes,
            k_from=k_from,
            prior=prior,
            area=parse_area(area),
            n_workers=workers,
            progress=progress,
        )
    rows = step.explain(out, explain).to_pylist() if explain else None
    if as_json:
        print_json({**asdict(result), **({} if rows is None else {"explained": rows})})
        return
    print_result(result, as_json=False)
    if rows is not None:
        print_table(tuple(rows[0]), [tuple(row.values()) for row in rows])


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
    drive: Annotated[Path | None, typer.Option("--drive", help="A drive of any format: intervals go along it.")] = None,
    versus: Annotated[Path | None, typer.Option("--versus", help="Another map: is the first one better?")] = None,
    require: Annotated[list[str] | None, typer.Option(help='Exit 1 when missed: "gospa_m<0.8".')] = None,
    config: ConfigFile = None,
    scenario: Scenario = "paper",
    settings: Settings = None,
    as_json: AsJson = False,
) -> None:
    """Score a map by GOSPA_M, precision, recall and F1.

    Example: geofleet evaluate --map fused.parquet --reference simulation/reference.parquet --out evaluation
    """
    from geofleet.steps import evaluate as step

    settled = settle(config or scenario, settings, gate_m=gate, match_on=match_on)
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
        print_json({**asdict(result), "missed": missed})
    else:
        print_evaluation(result)
    for sentence in missed:
        sys.stderr.write(f"geofleet: {sentence}\n")
    if missed:
        raise typer.Exit(1)


@app.command()
def report(
    run_dir: Annotated[Path, typer.Argument(help="Folder of a run: an evaluation, and lanes and drives beside it.")],
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", help="Folder to write; RUN_DIR/report by default. The QGIS project goes into qgis/ beside it."
        ),
    ] = None,
    run_id: Annotated[str | None, typer.Option("--run-id", help="Draw a map of this run.")] = None,
    method: Annotated[str | None, typer.Option(help="Draw a map of this method, e.g. dbscan-peaks.")] = None,
    vehicles: Annotated[int | None, typer.Option("--vehicles", help="Draw a map of this fleet size.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write a page, figures and a QGIS project of a run. The page, report.html, works offline.

    Example: geofleet report data/processed
    """
    from geofleet.steps import report as step

    result = step.report(run_dir, out or run_dir / "report", run_id=run_id, method=method, n_vehicles=vehicles)
    if as_json:
        print_json(asdict(result))
    else:
        print_files(result.files)


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", help="Folder to write.")] = Path("geofleet-demo"),
    workers: Workers = N_CORES,
    show: Annotated[bool, typer.Option("--show", help="Only print what a finished demo in --out has found.")] = False,
    as_json: AsJson = False,
) -> None:
    """Run the main job on the shipped data. 50 simulated cars pass real signs in Helsinki.

    Example: geofleet demo --out geofleet-demo
    """
    from geofleet.workflows import demo as workflow

    if not show:
        with progress_bar("demo") as progress:
            workflow.run_demo(out, n_workers=workers, progress=progress)
    result = workflow.demo_result(out)
    if as_json:
        print_json(asdict(result))
        return
    typer.echo(f"\n{result.caption}\n")
    print_scores(result.totals)
    typer.echo("\nOpen the page in a browser and the project in QGIS (every layer is styled):")
    print_files(result.files)
