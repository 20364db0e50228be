"""`geofleet ingest …`: maps, roads, drives and detections into tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from geofleet.cli.options import (
    AsJson,
    Bbox,
    Cache,
    Columns,
    CountryOption,
    Crs,
    FileFormat,
    Inputs,
    LayerOption,
    MapInputs,
    Origin,
    Out,
    OutFolder,
    Place,
    SchemeOption,
    Utm,
    parse_columns,
    parse_origin,
    parse_utm,
    spare_memory,
)
from geofleet.cli.output import print_result, progress_bar

app = typer.Typer(
    no_args_is_help=True, rich_markup_mode=None, help="Load sign maps, roads and drives into GeoParquet tables."
)


@app.command("signs")
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
    layer: LayerOption = None,
    roads: Annotated[bool, typer.Option("--roads/--no-roads", help="Infer facing and road from the ways.")] = True,
    as_json: AsJson = False,
) -> None:
    """Read signs from maps and inventories into a `signs` table.

    Example: geofleet ingest signs data/raw/helsinki.osm.pbf --out signs.parquet
    """
    spare_memory()
    from geofleet.steps import ingest

    paths = _with_fetched(inputs, place, bbox, cache)
    options = {"crs": crs, "origin": parse_origin(origin), "utm": parse_utm(utm), "scheme": scheme, "country": country}
    options["layer"] = layer
    with progress_bar("reading signs") as progress:
        result = ingest.ingest_signs(
            paths,
            out,
            file_format=file_format,
            roads=roads,
            progress=progress,
            columns=parse_columns(columns),
            **options,
        )
    print_result(result, as_json=as_json)


@app.command("lanes")
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
    spare_memory()
    from geofleet.steps import ingest

    paths = _with_fetched(inputs, place, bbox, cache)
    options = {"crs": crs, "origin": parse_origin(origin), "utm": parse_utm(utm)}
    with progress_bar("reading roads") as progress:
        result = ingest.ingest_lanes(paths, out, file_format=file_format, progress=progress, **options)
    print_result(result, as_json=as_json)


@app.command("drive")
def ingest_drive(
    inputs: Inputs,
    out: Out,
    file_format: Annotated[
        str, typer.Option("--format", help="auto, rtklib, nmea, gpx, gnsslogger, gis or csv.")
    ] = "auto",
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

    with progress_bar("reading drives") as progress:
        result = ingest.ingest_drive(
            inputs,
            out,
            file_format=file_format,
            columns=parse_columns(columns),
            crs=crs,
            origin=parse_origin(origin),
            utm=parse_utm(utm),
            progress=progress,
        )
    print_result(result, as_json=as_json)


@app.command("detections")
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
    """Read the detections of a real fleet. Bad rows go to <out>_rejected.parquet.

    Example: geofleet ingest detections fleet.csv --columns x=lon,y=lat,code=sign --scheme mapillary --out detections
    """
    from geofleet.steps import ingest_detections as step

    with progress_bar("reading detections") as progress:
        result = step.ingest_detections(
            inputs,
            out,
            columns=parse_columns(columns),
            crs=crs,
            scheme=scheme,
            country=country,
            run_id=run_id,
            progress=progress,
        )
    print_result(result, as_json=as_json)


def _with_fetched(inputs: list[Path] | None, place: str | None, bbox: str | None, cache: Path | None) -> list[Path]:
    """Return the files named and, of a place or box named, the file fetched."""
    if place is None and bbox is None:
        return inputs or []
    from geofleet.formats import osm_online

    box = None if bbox is None else osm_online.parse_bbox(bbox)
    with progress_bar("asking OpenStreetMap"):
        return [*(inputs or []), osm_online.fetch(place=place, bbox=box, cache=cache)]
