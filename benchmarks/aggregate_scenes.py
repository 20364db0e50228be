"""Detections of a fleet for the benchmark of the aggregate step, written some passes at a time: no table is ever whole.

*wide*: 20 passes over an area that grows. *dense*: the same 5,446 signs, passes that grow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow.parquet as pq

from geofleet.tables.schemas import DETECTIONS
from geofleet.tables.store import build_table, geo_metadata

if TYPE_CHECKING:
    from pathlib import Path

    import pyarrow as pa

WIDE_PASSES, DENSE_SIGNS = 20, 5446
SIGN_SPACING_M = 30.0  # one sign a square of this side, on average
N_CLASSES = 40
SIGMA_M = 1.5
CONFUSED_SHARE = 0.02
ROWS_A_GROUP = 250_000
WEST_DEG, SOUTH_DEG, M_PER_DEG = 10.0, 50.0, 111_320.0


def write_wide(n_detections: int, path: Path) -> None:
    """Write 20 passes past n / 20 signs."""
    _write(n_detections // WIDE_PASSES, WIDE_PASSES, path)


def write_dense(n_detections: int, path: Path) -> None:
    """Write n / 5,446 passes past 5,446 signs."""
    _write(DENSE_SIGNS, n_detections // DENSE_SIGNS, path)


def _write(n_signs: int, n_passes: int, path: Path) -> None:
    rng = np.random.default_rng(0)
    side_m = SIGN_SPACING_M * np.sqrt(n_signs)
    signs = rng.uniform(0, side_m, (n_signs, 2))
    classes = np.minimum(rng.zipf(1.5, n_signs), N_CLASSES) - 1
    writer = None
    a_time = max(1, ROWS_A_GROUP // n_signs)
    for begin in range(0, n_passes, a_time):
        numbers = np.arange(begin, min(begin + a_time, n_passes))
        table = _table(numbers, signs, classes, rng)
        writer = writer or pq.ParquetWriter(path, table.schema, compression="zstd")
        writer.write_table(table, row_group_size=ROWS_A_GROUP)
    assert writer is not None
    writer.close()


def _table(numbers: np.ndarray, signs: np.ndarray, classes: np.ndarray, rng: np.random.Generator) -> pa.Table:
    n, n_signs = len(numbers) * len(signs), len(signs)
    xy = np.tile(signs, (len(numbers), 1)) + rng.normal(0, SIGMA_M, (n, 2))
    seen = np.tile(classes, len(numbers))
    confused = rng.random(n) < CONFUSED_SHARE
    seen[confused] = rng.integers(0, N_CLASSES, confused.sum())
    lat = SOUTH_DEG + xy[:, 1] / M_PER_DEG
    lon = WEST_DEG + xy[:, 0] / (M_PER_DEG * np.cos(np.radians(SOUTH_DEG)))
    names = np.array([f"v{number:06}" for number in range(numbers[-1] + 1)])
    which = names[np.repeat(numbers, n_signs)]
    t_first = 1_700_000_000_000_000 + np.tile(np.arange(n_signs), len(numbers)) * 1_000_000  # µs
    columns = {
        "run_id": "bench",
        "vehicle_id": which,
        "pass_id": which,
        "track_id": np.tile(np.arange(n_signs), len(numbers)),
        "t_first": t_first.astype("datetime64[us]"),
        "t_last": (t_first + rng.integers(1, 10_000_000, n)).astype("datetime64[us]"),
        "n_frames": rng.integers(3, 60, n),
        "sigma_e_m": np.abs(rng.normal(0.5, 0.2, n)),
        "sigma_n_m": np.abs(rng.normal(0.5, 0.2, n)),
        "cov_en_m2": np.zeros(n),
        "range_mean_m": rng.uniform(10, 80, n),
        "view_deg": rng.uniform(0, 360, n),
        "sign_class": np.array([f"class_{code:02}" for code in range(N_CLASSES)])[seen],
        "class_confidence": rng.uniform(0.6, 1.0, n),
    }
    table = build_table(DETECTIONS, columns, geometry=(lon, lat))
    return table.replace_schema_metadata(geo_metadata(DETECTIONS, table))
