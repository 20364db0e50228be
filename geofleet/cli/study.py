"""`geofleet study …` and `geofleet stale`: many simulated fleets, and the outdated maps that some start from."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geofleet.cli.options import (
    N_CORES,
    AsJson,
    Columns,
    ConfigFile,
    CountryOption,
    Crs,
    LayerOption,
    Origin,
    SchemeOption,
    Settings,
    Utm,
    parse_columns,
    parse_origin,
    parse_shift,
    parse_utm,
)
from geofleet.cli.output import print_files, print_json, print_result, print_table, progress_bar
from geofleet.errors import ConfigError

if TYPE_CHECKING:
    from geofleet.workflows.study.compare import CompareResult
    from geofleet.workflows.study.fleet_size import FleetSizeResult
    from geofleet.workflows.study.plan import PlanResult
    from geofleet.workflows.study.worlds import Study

app = typer.Typer(rich_markup_mode=None)
study_app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Many simulated fleets: which method, how many vehicles?"
)
app.add_typer(study_app, name="study")

SignsOption = Annotated[Path | None, typer.Option("--signs", help="Signs of any source; shipped Helsinki by default.")]
DrivesOption = Annotated[
    list[Path] | None, typer.Option("--drive", help="A drive of any format, or several; shipped by default.")
]
Scenarios = Annotated[str, typer.Option("--scenario", help="Packaged scenarios or TOML files.", metavar="NAME,...")]
Methods = Annotated[
    str | None,
    typer.Option(
        "--methods",
        help="dbscan, hdbscan, kmeans, kmedoids (-first, -after), dbscan-peaks, dbscan-corrected, joint, joint-prior; "
        "the paper's, dbscan-peaks, dbscan-corrected and joint by default.",
    ),
]
Sizes = Annotated[
    str | None, typer.Option("--vehicles", help="Fleet sizes; those of the paper by default.", metavar="V,V,...")
]
Replicates = Annotated[int, typer.Option("--replicates", help="Independent fleets.")]
Seed = Annotated[int, typer.Option("--seed", help="Of all random numbers.")]
InView = Annotated[bool, typer.Option("--in-view", help="Score only signs that a pass had in view.")]
Tracker = Annotated[
    str | None, typer.Option("--tracker", help="paper, kalman or ideal; that of the scenario by default.")
]
Prior = Annotated[
    Path | None,
    typer.Option("--prior", help="Map that joint-prior starts from; an outdated copy of the scene by default."),
]
Processes = Annotated[int, typer.Option("--workers", min=1, help="Processes; the result does not depend on it.")]
StudyOut = Annotated[Path, typer.Option("--out", help="Folder of studies; what is done there is not done again.")]


@study_app.command("compare")
def study_compare(
    out: StudyOut = Path("study"),
    signs: SignsOption = None,
    drive: DrivesOption = None,
    scenario: Scenarios = "paper",
    methods: Methods = None,
    vehicles: Sizes = None,
    replicates: Replicates = 10,
    seed: Seed = 0,
    in_view: InView = False,
    tracker: Tracker = None,
    prior: Prior = None,
    sweep: Annotated[str, typer.Option("--sweep", help="Try values of a key.", metavar="KEY=VALUE,...")] = "",
    config: ConfigFile = None,
    settings: Settings = None,
    workers: Processes = N_CORES,
    as_json: AsJson = False,
) -> None:
    """Compare methods on the same fleets. By default the paper's Table 2, with its rows beside.

    Example: geofleet study compare --methods dbscan,joint --vehicles 1,2,3,5,10,20,50 --scenario paper-ideal
    """
    from geofleet.workflows.study import compare as workflow

    study = _study(
        *(out, signs, drive, str(config or scenario)),
        methods=methods or workflow.DEFAULT_METHODS,
        sizes=_numbers(vehicles) or workflow.DEFAULT_SIZES,
        settings=_with_tracker(settings, tracker),
        sweep=sweep,
        n_replicates=replicates,
        seed=seed,
        in_view=in_view,
        prior=prior,
    )
    with progress_bar("comparing") as progress:
        result = workflow.compare(study, out, n_workers=workers, progress=progress)
    if as_json:
        print_json(asdict(result))
        return
    _print_comparison(result)


@study_app.command("fleet-size")
def study_fleet_size(
    out: StudyOut = Path("study"),
    signs: SignsOption = None,
    drive: DrivesOption = None,
    scenario: Scenarios = "paper",
    methods: Methods = None,
    vehicles: Sizes = None,
    replicates: Replicates = 10,
    seed: Seed = 0,
    in_view: InView = False,
    tracker: Tracker = None,
    prior: Prior = None,
    config: ConfigFile = None,
    settings: Settings = None,
    workers: Processes = N_CORES,
    as_json: AsJson = False,
) -> None:
    """Draw scores over the size of the fleet. The paper's Figures 3 to 5, with its points beside.

    Example: geofleet study fleet-size --methods dbscan,dbscan-corrected,joint --replicates 10
    """
    from geofleet.workflows.study import fleet_size as workflow

    study = _study(
        *(out, signs, drive, str(config or scenario)),
        methods=methods or workflow.DEFAULT_METHODS,
        sizes=_numbers(vehicles) or workflow.DEFAULT_SIZES,
        settings=_with_tracker(settings, tracker),
        n_replicates=replicates,
        seed=seed,
        in_view=in_view,
        prior=prior,
    )
    with progress_bar("fleets of every size") as progress:
        result = workflow.fleet_size(study, out, n_workers=workers, progress=progress)
    if as_json:
        print_json(asdict(result))
        return
    _print_fleet_sizes(result)


@study_app.command("plan")
def study_plan(
    target: Annotated[str, typer.Option("--target", help="What is to be reached.", metavar="SCORE=VALUE")],
    out: StudyOut = Path("study"),
    signs: SignsOption = None,
    drive: Annotated[Path | None, typer.Option("--drive", help="A drive of any format; shipped by default.")] = None,
    scenario: Annotated[str, typer.Option("--scenario", help="A packaged scenario, or a TOML file.")] = "paper",
    method: Annotated[str, typer.Option("--method", help="As --methods of study compare; one.")] = "dbscan",
    confidence: Annotated[float, typer.Option(help="Of the interval, and the share of fleets to be safe for.")] = 0.95,
    max_passes: Annotated[int, typer.Option(min=1, help="Most passes that are tried.")] = 200,
    replicates: Annotated[int, typer.Option("--replicates", min=1, help="Independent fleets.")] = 20,
    seed: Seed = 0,
    in_view: InView = False,
    tracker: Tracker = None,
    prior: Prior = None,
    config: ConfigFile = None,
    settings: Settings = None,
    workers: Processes = N_CORES,
    as_json: AsJson = False,
) -> None:
    """Say how many passes a given quality needs. On a drive, past a map's signs, with sensors and a method.

    Example: geofleet study plan --target gospa_m=0.5 --signs city.osm.pbf --drive drive.pos --method dbscan-corrected
    """
    from geofleet.algorithms.uncertainty import check_level
    from geofleet.workflows.study import plan as workflow
    from geofleet.workflows.study.answers import parse_target

    goal = parse_target(target)
    check_level(confidence, "--confidence")
    study = _study(
        *(out, signs, [drive] if drive else None, str(config or scenario)),
        methods=method,
        methods_option="--method",
        sizes=(max_passes,),
        settings=_with_tracker(settings, tracker),
        n_replicates=replicates,
        seed=seed,
        in_view=in_view,
        prior=prior,
    )
    with progress_bar("planning") as progress:
        result = workflow.plan(study, goal, out, level=confidence, n_workers=workers, progress=progress)
    if as_json:
        print_json(asdict(result))
    else:
        _print_plan(result)


def _print_plan(result: PlanResult) -> None:
    """Print the answer first, then how the score follows the passes, and the tiles."""
    typer.echo(f"\n{result.caption}\n")
    typer.echo("\n".join(result.answer))
    names: tuple[str, ...] = ("n_vehicles", "n_met", "n_fleets", "median", "least", "greatest")
    typer.echo(f"\n{result.target}, at the fleet sizes that every fleet was tried at:\n")
    tried = [row for row in result.scores if row["n_fleets"] == result.needed.n_fleets]
    print_table(names, [tuple(row[name] for name in names) for row in tried])
    names = ("tile", "n_signs", "passes_at_most", "safe_at_most", "n_reached", "n_fleets", "limit_share", "main_limit")
    typer.echo("\nBy tile (passes at most, of the sizes tried; empty: not reached):\n")
    print_table(names, [tuple(row[name] for name in names) for row in result.tiles])
    typer.echo("")
    print_files(result.files)


def _study(out: Path, signs: Path | None, drives: list[Path] | None, scenarios: str, **options: Any) -> Study:
    """Read what a study is of; without files it is of the shipped data."""
    from geofleet.workflows.demo import raw_data
    from geofleet.workflows.study.methods import parse_methods
    from geofleet.workflows.study.worlds import Study, prepare_worlds

    methods, settings, sweep = options.pop("methods"), options.pop("settings"), options.pop("sweep", "")
    chosen = parse_methods(methods, option=options.pop("methods_option", "--methods"))
    worlds = prepare_worlds(
        signs or raw_data() / "helsinki.osm.pbf",
        drives or [raw_data() / "helsinki_derived.pos"],
        [name.strip() for name in scenarios.split(",")],
        out / "inputs",
        settings=settings,
        sweep=sweep,
    )
    return Study(worlds, chosen, **options)


def _with_tracker(settings: list[str] | None, tracker: str | None) -> list[str]:
    return [*(settings or []), *([f"tracker={tracker}"] if tracker else [])]


def _numbers(text: str | None) -> tuple[int, ...]:
    """Read `V,V,…`, in order, each once."""
    try:
        return tuple(sorted({int(number) for number in text.split(",")})) if text else ()
    except ValueError:
        raise ConfigError(f"{text!r} is not V,V,…", where="--vehicles", todo="Example: --vehicles 5,10,50") from None


def _print_comparison(result: CompareResult) -> None:
    """Print a row a method, the paper's beside."""
    varying = [name for name in ("scenario", "place", "setting") if len({row[name] for row in result.table}) > 1]
    is_paper = any(row["paper_gospa_m"] is not None for row in result.table)
    names = [*varying, "method", "n_vehicles", "tracker", "upload", "tp", "fp", "fn", "precision", "recall", "f1"]
    names += ["gospa_m", "gospa_m_sd", "gospa_m_median"]
    names += ["paper_precision", "paper_recall", "paper_f1", "paper_gospa_m"] if is_paper else []
    typer.echo(f"\n{result.caption}\nMeans over fleets:\n")
    print_table(tuple(names), [tuple(row[name] for name in names) for row in result.table])
    _print_nulls(result.table)
    typer.echo("")
    print_files(result.files)


def _print_fleet_sizes(result: FleetSizeResult) -> None:
    names = ["method", "n_vehicles", "tracker", "upload", "tp", "fp", "fn", "f1", "paper_f1", "gospa_m_mean"]
    names += ["gospa_m_sd", "gospa_m_mean_low", "gospa_m_mean_high", "gospa_m_median", "paper_gospa_m", "paper_sd", "z"]
    typer.echo(f"\n{result.caption}\nMeans over fleets, with the 95 % interval of the mean:\n")
    print_table(tuple(names), [tuple(row[name] for name in names) for row in result.table])
    _print_nulls(result.table)
    if result.n_compared:
        typer.echo(
            f"\nGOSPA_M of dbscan-first lies within the paper's mean ± 1 sd at {result.n_within} of "
            f"{result.n_compared} fleet sizes (z: distance in the paper's sd)."
        )
    typer.echo("")
    print_files(result.files)


def _print_nulls(table: tuple[dict[str, Any], ...]) -> None:
    """Say which means leave fleets out."""
    varying = [name for name in ("scenario", "place", "setting") if len({row.get(name) for row in table}) > 1]
    for row in table:
        if row["n_null"]:
            where = ", ".join([*(row[name] for name in varying), row["method"], f"{row['n_vehicles']} vehicles"])
            typer.echo(f"{where}: {row['n_null']} fleets without a match left out")


@app.command()
def stale(
    source: Annotated[Path, typer.Argument(metavar="LAYER", help="Signs of any source.", show_default=False)],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="File to write.", show_default=False)],
    removed: Annotated[float, typer.Option(help="Share of the signs that the copy lacks.")] = 0.15,
    retyped: Annotated[float, typer.Option(help="Share that has another class of the layer.")] = 0.10,
    moved: Annotated[float, typer.Option(help="Share that stands --moved-m away.")] = 0.10,
    moved_m: Annotated[float, typer.Option(help="How far moved signs stand from their place, metres.")] = 5.0,
    obsolete: Annotated[float, typer.Option(help="Signs that no longer exist, as a share of those that do.")] = 0.10,
    sigma_m: Annotated[
        float, typer.Option(help="Position error of every sign an axis, also stated as variance.")
    ] = 0.15,
    shift_m: Annotated[
        str, typer.Option(help="How far the whole copy is off, metres; stated nowhere.", metavar="E,N")
    ] = "0,0",
    seed: Annotated[int, typer.Option("--seed", help="Of all random numbers.")] = 0,
    crs: Crs = None,
    origin: Origin = None,
    utm: Utm = None,
    columns: Columns = None,
    scheme: SchemeOption = None,
    country: CountryOption = None,
    layer: LayerOption = None,
    as_json: AsJson = False,
) -> None:
    """Write an outdated copy of a layer of signs. Beside it goes what is outdated in it.

    Example: geofleet stale simulation/reference.parquet prior.parquet --removed 0.2 --shift-m 1,0
    """
    from geofleet.algorithms.staleness import Staleness
    from geofleet.workflows.stale import stale as workflow

    how = Staleness(removed, retyped, moved, obsolete, moved_m=moved_m, sigma_m=sigma_m, shift_m=parse_shift(shift_m))
    options: dict[str, Any] = {"crs": crs, "origin": parse_origin(origin), "utm": parse_utm(utm)}
    options |= {"columns": parse_columns(columns), "scheme": scheme, "country": country, "layer": layer}
    print_result(workflow(source, out, how, seed=seed, **options), as_json=as_json)
