"""The `geofleet` command: parses, calls one step or workflow, prints. Nothing else prints, exits or draws progress.

Exit codes: 0 done, 1 a check failed, 2 bad usage or bad input (one message, no traceback). Options shared by commands
stand in `options`, what is printed in `output`; each other module holds a group of commands.
"""

from __future__ import annotations

import sys

import typer

from geofleet.cli import ingest, pipeline, study, tables
from geofleet.errors import GeofleetError, InputError

app = typer.Typer(
    name="geofleet",
    help="Turn the traffic-sign detections of many cars into an updated sign map, and say how good it is.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    add_completion=False,
)
app.add_typer(ingest.app, name="ingest")
app.add_typer(pipeline.app)
app.add_typer(tables.app)
app.add_typer(study.app)


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
