"""`geofleet sql, info, convert, schema`: look at files and tables, and write them elsewhere."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Annotated, Any

import typer

from geofleet.cli.options import (
    AsJson,
    Columns,
    CountryOption,
    Crs,
    FileFormat,
    Inputs,
    LayerOption,
    Origin,
    SchemeOption,
    Utm,
    parse_columns,
    parse_origin,
    parse_params,
    parse_utm,
)
from geofleet.cli.output import print_json, print_result, print_table

app = typer.Typer(rich_markup_mode=None)


@app.command()
def sql(
    query: Annotated[str, typer.Argument(help="A statement, or the path of a .sql file.")],
    data: Annotated[Path, typer.Option("--data", help="Folder with tables.")] = Path("data/processed"),
    param: Annotated[
        list[str] | None, typer.Option("--param", help="A parameter of a .sql file; repeatable.", metavar="KEY=VALUE")
    ] = None,
    show_sql: Annotated[
        bool, typer.Option("--show-sql", help="Print it as a script for DuckDB's own shell, run nothing.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Query tables with DuckDB's spatial SQL. Each table below a folder is a view of its name.

    Example: geofleet sql "SELECT concept, count(*) AS n FROM signs GROUP BY concept ORDER BY n DESC"
    """
    from geofleet.workflows import query as workflow

    params = parse_params(param)
    if show_sql:
        typer.echo(workflow.show_sql(query, data, params), nl=False)
        return
    names, rows = workflow.query(query, data, params)
    if as_json:
        print_json([dict(zip(names, row, strict=True)) for row in rows])
    else:
        print_table(names, rows)


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
    """Tell what is in files and what is skipped. Format, CRS and datum operation, extent, counts, reasons.

    Example: geofleet info city.xodr drive.pos
    """
    from geofleet.workflows.info import info as workflow

    options = {"crs": crs, "origin": parse_origin(origin), "utm": parse_utm(utm), "columns": parse_columns(columns)}
    options |= {"scheme": scheme, "country": country, "layer": layer}
    found = [workflow(path, table=table, **options) for path in files]
    if as_json:
        print_json(found[0] if len(found) == 1 else {"files": found})
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
    """Write signs or lanes in another format. By suffix: .parquet, .geojson, .gpkg, .fgb, .osm or .osc.

    Example: geofleet convert city.xodr city.geojson
    """
    from geofleet.workflows.convert import convert as workflow

    options: dict[str, Any] = {
        "crs": crs,
        "origin": parse_origin(origin),
        "utm": parse_utm(utm),
        "columns": parse_columns(columns),
    }
    options |= {"scheme": scheme, "country": country, "layer": layer, "roads": roads}
    print_result(workflow(source, out, table=table, file_format=file_format, **options), as_json=as_json)


@app.command()
def schema(
    table: Annotated[
        str | None, typer.Argument(help="Name of a table; config: every setting; all tables when left out.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Print the columns of a table: type, unit, meaning. Or every key of a scenario with its default.

    Example: geofleet schema detections
    """
    from geofleet.tables.schemas import SCHEMAS
    from geofleet.tables.store import schema_named

    names: tuple[str, ...]
    rows: list[tuple[str, ...]]
    if table == "config":
        _print_settings(as_json=as_json)
        return
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
        print_json([dict(zip(names, row, strict=True)) for row in rows])
    else:
        print_table(names, rows)


def _print_settings(*, as_json: bool) -> None:
    """Print the scenario that all others start from: its comments tell units and meanings."""
    from geofleet.config import ROOT_SCENARIO, packaged_scenarios

    text = packaged_scenarios()[ROOT_SCENARIO].read_text(encoding="utf-8")
    if as_json:
        print_json(tomllib.loads(text))
    else:
        typer.echo(text.rstrip())
