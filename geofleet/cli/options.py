"""Options that several commands share, and how their texts are read."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from geofleet.errors import ConfigError

if TYPE_CHECKING:
    from geofleet.config import Config

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
LayerOption = Annotated[str | None, typer.Option("--layer", help="Layer of a GeoPackage, or Shapefile of a zip.")]
OutFolder = Annotated[Path, typer.Option("--out", help="Folder to write.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="A TOML file of settings.")]
Scenario = Annotated[
    str, typer.Option("--scenario", help="Packaged scenario or TOML file: it sets every option that is left out.")
]
Settings = Annotated[
    list[str] | None, typer.Option("--set", help="Override any key: --set eps_m=4.0", metavar="KEY=VALUE")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Workers = Annotated[int, typer.Option("--workers", min=1, help="Worker threads; the result does not depend on it.")]
N_CORES = os.cpu_count() or 1


def parse_origin(text: str | None) -> tuple[float, float] | None:
    """Read `LAT,LON`."""
    if text is None:
        return None
    try:
        lat, lon = map(float, text.split(","))
    except ValueError:
        raise ConfigError(f"{text!r} is not LAT,LON.", where="--origin", todo="Example: --origin 49.0,8.4") from None
    return lat, lon


def parse_utm(text: str | None) -> tuple[str, float, float] | None:
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


def parse_area(text: str | None) -> tuple[float, float, float, float] | None:
    """Read `W,S,E,N`, degrees."""
    if text is None:
        return None
    try:
        west, south, east, north = map(float, text.split(","))
    except ValueError:
        raise ConfigError(
            f"{text!r} is not W,S,E,N.", where="--area", todo="Example: --area 24.93,60.16,24.96,60.18"
        ) from None
    return west, south, east, north


def parse_params(given: list[str] | None) -> dict[str, str]:
    """Read `key=value` of every --param."""
    pairs = [one.partition("=") for one in given or []]
    for key, equals, value in pairs:
        if not (key and equals):
            raise ConfigError(f"{key + value!r} is not key=value.", where="--param", todo="Example: --param zoom=16")
    return {key.strip(): value.strip() for key, _, value in pairs}


def parse_shift(text: str) -> tuple[float, float]:
    """Read `E,N`, metres."""
    try:
        east, north = map(float, text.split(","))
    except ValueError:
        raise ConfigError(f"{text!r} is not E,N.", where="--shift-m", todo="Example: --shift-m 1.0,0.5") from None
    return east, north


def parse_columns(text: str | None) -> dict[str, str] | Path | None:
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


def settle(scenario: str | Path, settings: list[str] | None, **options: Any) -> Config:
    """Read the settings; options win over `--set`, which wins over the file."""
    from geofleet.config import load_config

    given = [f"{key}={json.dumps(value)}" for key, value in options.items() if value is not None]
    return load_config(scenario, [*(settings or []), *given])


def spare_memory() -> None:
    """Have Arrow give back what it is done with: a table that is written in pieces then needs 40 MB less.

    And have numpy start no threads for linear algebra, which maps do without; they spin while the rest is imported.
    """
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
