"""How sure scores are: intervals and comparisons from the `matches` of maps, as rows for people and pipelines."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from geofleet.algorithms.geodesy import EnuFrame
from geofleet.algorithms.road import RoadOutcomes, Stations, road_outcomes, stations_along_curve, stations_along_drive
from geofleet.algorithms.uncertainty import compare_replicates, replicate_interval
from geofleet.algorithms.uncertainty_paired import compare_on_road
from geofleet.algorithms.uncertainty_road import ROAD_SCORES, road_intervals
from geofleet.errors import ConfigError
from geofleet.tables.store import lonlat

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from geofleet.algorithms.uncertainty import Comparison, Interval
    from geofleet.tables.scenes import Drive

    Totals = Sequence[Mapping[str, Any]]

_LABELS = ("method", "n_vehicles")
_SHORTEST_ROAD_M = 1.0  # signs at one point stand along no road: too few blocks, as the interval then says


def interval_rows(
    matches: pa.Table, totals: Totals, *, gate_m: float, correlation_m: float = 100.0, drive: Drive | None = None
) -> list[dict[str, Any]]:
    """Return the interval of every score of every method and fleet size.

    One run is a single map: its intervals are for a longer road like this one. Several runs are repetitions: their
    intervals are for the procedure, of the mean (Student's t) and of the median (order statistics).

    Parameters
    ----------
    matches, totals
        Of an evaluation.
    gate_m
        c, metres.
    correlation_m
        Along the road, of one map (`uncertainty_road.road_intervals`).
    drive
        Stations are taken along it; along a space-filling curve when it is None.
    """
    rows = []
    for labels, runs in _grouped(totals).items():
        if len(runs) > 1:
            found = {
                (name, method): replicate_interval([run[name] for run in runs], score=name, method=method)
                for name in ROAD_SCORES
                for method in ("t", "median")
            }
        else:
            (outcomes,) = _along_road([_matches_of(matches, runs[0])], drive)
            intervals = (
                road_intervals(outcomes, gate_m=gate_m, correlation_m=correlation_m) if outcomes is not None else {}
            )
            found = {(name, "road"): interval for name, interval in intervals.items()}
        rows += [_row(labels, name, interval) for (name, _), interval in found.items()]
    return rows


def comparison_rows(
    matches: tuple[pa.Table, pa.Table],
    totals: tuple[Totals, Totals],
    *,
    gate_m: float,
    correlation_m: float = 100.0,
    drive: Drive | None = None,
) -> list[dict[str, Any]]:
    """Test for every score whether map A (first) is better than map B (second) against the same reference.

    Single maps are paired by blocks of the road, repeated runs by their run.

    Raises
    ------
    ConfigError
        A map holds several methods or fleet sizes, or the maps are not of the same runs.
    """
    for name, rows in zip("AB", totals, strict=True):
        if len(_grouped(rows)) != 1:
            raise ConfigError(f"map {name} holds {len(_grouped(rows))} methods or fleet sizes.", todo="Give one each.")
    runs = [[row["run_id"] for row in rows] for rows in totals]
    if len(totals[0]) == len(totals[1]) == 1:
        outcomes = _along_road([_matches_of(m, rows[0]) for m, rows in zip(matches, totals, strict=True)], drive)
        a, b = outcomes
        if a is None or b is None:
            return []
        options = {"gate_m": gate_m, "correlation_m": correlation_m}
        found = {name: compare_on_road(a, b, score=name, **options) for name in ROAD_SCORES}
    elif runs[0] == runs[1]:
        found = {
            name: compare_replicates(*([row[name] for row in rows] for rows in totals), score=name)
            for name in ROAD_SCORES
        }
    else:
        raise ConfigError("the two maps are not of the same runs.", todo="Compare maps of the same simulation.")
    return [_comparison_row(name, comparison) for name, comparison in found.items()]


def _grouped(totals: Totals) -> dict[tuple[Any, ...], list[Mapping[str, Any]]]:
    groups: dict[tuple[Any, ...], list[Mapping[str, Any]]] = {}
    for total in totals:
        groups.setdefault(tuple(total[name] for name in _LABELS), []).append(total)
    return groups


def _matches_of(matches: pa.Table, total: Mapping[str, Any]) -> pa.Table:
    run = pc.field("run_id").is_null() if total["run_id"] is None else pc.field("run_id") == total["run_id"]
    return matches.filter(
        run & (pc.field("method") == total["method"]) & (pc.field("n_vehicles") == total["n_vehicles"])
    )


def _along_road(maps: Sequence[pa.Table], drive: Drive | None) -> list[RoadOutcomes | None]:
    """Return the outcomes of maps along one road; None for a map without any sign or reference."""
    both = pa.concat_tables(maps)
    if not all(m.num_rows for m in maps):
        return [None] * len(maps)
    lon, lat = lonlat(both)
    frame = drive.frame if drive else EnuFrame.around(lon, lat)
    xy_m = frame.to_enu(lon, lat)
    stations = stations_along_drive(xy_m, drive.line) if drive else stations_along_curve(xy_m)
    road = Stations(stations.station_m, max(stations.length_m, _SHORTEST_ROAD_M))
    ends = np.cumsum([m.num_rows for m in maps])[:-1]
    return [
        road_outcomes(
            station_m,
            np.asarray(m["outcome"].to_pylist()),
            m["distance_m"].to_numpy() ** 2,
            length_m=road.length_m,
        )
        for m, station_m in zip(maps, np.split(road.station_m, ends), strict=True)
    ]


def _row(labels: tuple[Any, ...], score: str, interval: Interval) -> dict[str, Any]:
    return dict(zip(_LABELS, labels, strict=True)) | {
        "score": score,
        "estimate": interval.estimate,
        "low": interval.low,
        "high": interval.high,
        "level": interval.level,
        "n_null": interval.n_null,
        "estimand": interval.estimand,
        "interval_method": interval.method,
        "note": interval.note,
    }


def _comparison_row(score: str, comparison: Comparison) -> dict[str, Any]:
    interval = comparison.interval
    return {
        "score": score,
        "difference": interval.estimate,
        "low": interval.low,
        "high": interval.high,
        "level": interval.level,
        "p_value": comparison.p_value,
        "verdict": comparison.verdict,
        "estimand": interval.estimand,
        "interval_method": interval.method,
        "note": interval.note,
    }
