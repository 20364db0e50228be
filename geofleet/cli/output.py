"""What the commands print: results, tables, scores, JSON; and progress on standard error."""

from __future__ import annotations

import json
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import asdict, is_dataclass
from typing import TYPE_CHECKING, Any

import typer

from geofleet.errors import SUSPICIOUS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from geofleet.steps.evaluate import EvaluateResult

_SECONDS_A_LINE = 15
_FAR = " (over 100 m: --clip leaves them out)"
_HINTS = {"map_signs_far_from_reference": _FAR, "reference_signs_far_from_map": _FAR}
_PATIENCE_S = 2.0
_SCORES = "f1", "gospa_m"  # whose intervals are printed


@contextmanager
def progress_bar(label: str) -> Iterator[Callable[[int, int], None]]:
    """Draw a progress bar with the time left on a terminal; elsewhere (CI, a pipe) tell it line by line, seldom.

    Nothing is told before the work has gone on for a moment: what is wrong with the input comes first, and alone.
    """
    if not sys.stderr.isatty():
        lines = _Lines(label)
        try:
            yield lines.tell
        finally:
            lines.stop()
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(label, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


class _Lines:
    """Progress as lines, one in a quarter of a minute."""

    def __init__(self, label: str) -> None:
        self._label, self._begin = label, time.monotonic()
        self._last = self._begin
        self._first: int | None = None
        self._announcement = threading.Timer(_PATIENCE_S, self._announce)
        self._announcement.daemon = True
        self._is_announced = threading.Lock()
        self._fresh: tuple[float, int] | None = None  # when something was done first, and how much there was then

    def tell(self, done: int, total: int) -> None:
        """Say how much is done, and how long the rest will take at the pace since the first of it was done.

        What was there before tells no pace, nor does the first: loops are compiled on the way to it.
        """
        now = time.monotonic()
        if self._first is None:
            self._first = done
            self._announcement.start()
        if 0 < done < total:
            self._announce()
        if self._fresh is None and done > self._first:
            self._fresh = now, done
        if now - self._last >= _SECONDS_A_LINE:
            self._last, left = now, ""
            if self._fresh and self._fresh[1] < done < total:
                since, before = self._fresh
                left = f", about {(now - since) / (done - before) * (total - done):.0f} s left"
            sys.stderr.write(f"{self._label}: {done} of {total} after {now - self._begin:.0f} s{left}\n")

    def stop(self) -> None:
        """Say nothing more."""
        self._announcement.cancel()

    def _announce(self) -> None:
        """Say what is being done, once: when something is done, or after a while, which no fault of an input takes."""
        if self._is_announced.acquire(blocking=False):
            self._announcement.cancel()
            sys.stderr.write(f"{self._label} ...\n")


def print_result(result: Any, *, as_json: bool) -> None:
    """Print the result of a step: one JSON object, or a line a field; fields that are empty are left out.

    What can hardly be true of the input is a warning, on standard error as well.
    """
    fields = asdict(result)
    warn(fields.get("found"))
    if as_json:
        print_json(fields)
        return
    width = max(map(len, fields))
    for name, value in fields.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key}: {number}" for key, number in value.items() if number != 0)  # noqa: PLW2901 (text)
        elif isinstance(value, list | tuple):
            value = ", ".join(map(str, value))  # noqa: PLW2901 (text)
        elif isinstance(value, float):
            value = f"{value:.2f}"  # noqa: PLW2901 (text)
        if value not in ("", None):
            typer.echo(f"  {name.ljust(width)}  {value}")


def warn(found: Any) -> None:
    """Say aloud which counts of a reader tell of what can hardly be true."""
    for name, number in (found or {}).items():
        if name.startswith(SUSPICIOUS):
            typer.echo(f"geofleet: warning: {number} positions {name.removeprefix(SUSPICIOUS)}", err=True)


def print_json(value: Any) -> None:
    """Print one JSON object."""
    typer.echo(json.dumps(value, indent=2, default=_plain))


def _plain(value: Any) -> Any:
    return asdict(value) if is_dataclass(value) and not isinstance(value, type) else str(value)


def print_scores(totals: tuple[dict[str, Any], ...]) -> None:
    """Print the scores of every run and map, and why one is missing."""
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
    print_table(names, [tuple(total[name] for name in names) for total in totals])
    for total in totals:
        if total["null_reason"]:
            typer.echo(f"{total['run_id'] or total['method']}: {total['null_reason']}")


def print_evaluation(result: EvaluateResult) -> None:
    """Print totals, their means when there are several runs, sources when there are several, and what was left out."""
    print_scores(result.totals)
    for rows, is_told in ((result.summary, len(result.totals) > 1), (result.sources, bool(result.sources))):
        if is_told:
            names = tuple(name for name in rows[0] if name not in ("run_id", "match_on", "gate_m", "null_reason"))
            typer.echo()
            print_table(names, [tuple(row[name] for name in names) for row in rows])
    _print_intervals(result.intervals)
    _print_comparisons(result.comparisons)
    for name, number in result.counts.items():
        if number:
            typer.echo(f"{name}: {number}{_HINTS.get(name, '')}")
    print_files(result.files)


def _print_intervals(rows: tuple[dict[str, Any], ...]) -> None:
    """Say how sure F1 and GOSPA_M are, and of what; all scores stand in intervals.csv."""
    for row in rows:
        if row["score"] in _SCORES and row["low"] is not None:
            typer.echo(
                f"{row['score']} {row['estimate']:.4f}, {row['level']:.0%} interval "
                f"{row['low']:.4f} to {row['high']:.4f}: {row['estimand']}"
            )
        elif row["score"] in _SCORES:
            typer.echo(f"{row['score']}: no interval: {row['note']}")
    told = (row["note"] for row in rows if row["score"] in _SCORES and row["note"] and row["low"] is not None)
    notes = (note for one in told for note in one.split("; "))
    for note in dict.fromkeys(notes):
        typer.echo(f"  beware: {note}")


def _print_comparisons(rows: tuple[dict[str, Any], ...]) -> None:
    """Print the verdict on map A (--map) against map B (--versus), score by score."""
    names = ("score", "difference", "low", "high", "p_value", "verdict")
    if rows:
        typer.echo("\nmap A (--map) minus map B (--versus):")
        print_table(names, [tuple(row[name] for name in names) for row in rows])


def print_files(files: tuple[Path, ...]) -> None:
    """Print a path a line."""
    for path in files:
        typer.echo(f"  {path}")


def print_table(names: tuple[str, ...], rows: list[tuple[Any, ...]]) -> None:
    """Print left-aligned text and right-aligned numbers, never cut to the width of the terminal."""
    cells = [[f"{v:.4f}" if isinstance(v, float) else "" if v is None else str(v) for v in row] for row in rows]
    widths = [max(len(name), *(len(row[i]) for row in cells)) if cells else len(name) for i, name in enumerate(names)]
    right = [any(isinstance(row[i], int | float) for row in rows) for i in range(len(names))]
    for row in [list(names), *cells]:
        aligned = (c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, right, strict=True))
        typer.echo("  ".join(aligned).rstrip())
