"""`geofleet stale`: what studies start from."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from geofleet.cli.options import (
    AsJson,
    Columns,
    CountryOption,
    Crs,
    LayerOption,
    Origin,
    SchemeOption,
    Utm,
    parse_columns,
    parse_origin,
    parse_shift,
    parse_utm,
)
from geofleet.cli.output import print_result

app = typer.Typer()


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
    """Write an outdated copy of a layer of signs, and beside it what is outdated in it.

    Example: geofleet stale simulation/reference.parquet prior.parquet --removed 0.2 --shift-m 1,0
    """
    from geofleet.algorithms.staleness import Staleness
    from geofleet.workflows.stale import stale as workflow

    how = Staleness(removed, retyped, moved, obsolete, moved_m=moved_m, sigma_m=sigma_m, shift_m=parse_shift(shift_m))
    options: dict[str, Any] = {"crs": crs, "origin": parse_origin(origin), "utm": parse_utm(utm)}
    options |= {"columns": parse_columns(columns), "scheme": scheme, "country": country, "layer": layer}
    print_result(workflow(source, out, how, seed=seed, **options), as_json=as_json)
