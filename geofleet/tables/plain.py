"""Plain detections: one Parquet file with the schema's own types, all of whose rows can be used.

A text column of Parquet is a dictionary and numbers. Read as such, passes and classes cost a text a row group instead
of one a row; DuckDB spells every text out before it groups or joins by several. What is found here is what
`sql/aggregate/reporting`, `tiles/counts` and `aggregate/coded` say, and tests hold them equal. Every other table, and
one with a row that cannot be used or that repeats a key, goes the way of the statements.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from geofleet.algorithms.surveying import CellCounts, are_placed, mark_ids, mean_variances, number_combinations
from geofleet.tables.arrays import arrow_numbers, arrow_texts, numpy_numbers
from geofleet.tables.dealt import NEVER_BEGUN, NEVER_ENDED
from geofleet.tables.overlap import work_behind
from geofleet.tables.schemas import BBOX, DETECTIONS, TEXT

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from numpy.typing import NDArray

    Columns = dict[str, NDArray[Any]]
    Codes = NDArray[np.int32]
    Pass = tuple[str, str, str]  # run, vehicle, pass

MAX_ID_BITS = 1 << 29  # 64 MB of track ids
BLOCK_ROWS = 125_000  # rows that are read at a time
_LEAST_BLOCKS = 16  # of a table: what is done with a block waits for the first, and goes on after the last is read
_PASS = ("run_id", "vehicle_id", "pass_id")
_PLACE = (f"{BBOX}.xmin", f"{BBOX}.ymin")
_NUMBERS = ("n_frames", "sigma_e_m", "sigma_n_m", "class_confidence", "t_first", "t_last")
_MAX_COMBINATIONS = 1 << 20


@dataclass(frozen=True, slots=True)
class Survey:
    """What a plain table holds.

    Parameters
    ----------
    path
        The file.
    reporting
        The table `sql/aggregate/reporting`.
    counts
        The table `sql/tiles/counts` of all detections.
    classes
        Sorted.
    """

    path: Path
    reporting: pa.Table
    counts: pa.Table
    classes: tuple[str, ...]


class _NotPlainError(Exception):
    """A row cannot be used, or costs what a statement does."""


def survey(path: Path, fine_zoom: int) -> Survey | None:
    """Return what a plain table holds, None where it is not plain.

    Parameters
    ----------
    path
        A `detections` table; its columns have been checked.
    fine_zoom
        Zoom of the cells that detections are counted in.
    """
    if not path.is_file():
        return None
    with pq.ParquetFile(path) as file:
        ids = _range_of_ids(file.metadata) if _has_own_types(file.schema_arrow) else None
    if ids is None:
        return None
    surveyor = _Surveyor(*ids, fine_zoom)
    try:
        work_behind(surveyor.add, _blocks(path, ("track_id", *_PLACE)))
    except _NotPlainError:
        return None
    return surveyor.found(path)


def coded_columns(found: Survey) -> Iterator[pa.RecordBatch]:
    """Read what a `Coder` needs, some rows at a time."""
    return _blocks(found.path, ("track_id", *_PLACE, *_NUMBERS))


class Coder:
    """Makes the columns of `sql/aggregate/coded` of one block of `coded_columns` after the other.

    Parameters
    ----------
    found
        Of the table.
    passes
        The number of every pass that is used; detections of others are left out.
    """

    def __init__(self, found: Survey, passes: Mapping[Pass, int]) -> None:
        self._passes = passes
        self._numbers: dict[Pass, int] = {}
        self._class_codes = {name: code for code, name in enumerate(found.classes)}

    def __call__(self, block: pa.RecordBatch) -> Columns:
        """Return the columns of a block."""
        of_row = _number_passes(block, self._numbers)
        code = np.array([self._passes.get(key, -1) for key in self._numbers], np.int32)[of_row]
        class_code = _coded(block.column("sign_class"), self._class_codes)
        columns = {"pass_code": code, "class_code": class_code} | _numbers(block)
        return columns if (code >= 0).all() else {name: values[code >= 0] for name, values in columns.items()}


def _has_own_types(schema: pa.Schema) -> bool:
    """Return whether the columns have the types of the schema, texts perhaps as dictionaries."""
    wanted = {column.name: column.type for column in DETECTIONS.columns}
    for name in (*_PASS, "track_id", "sign_class", *_NUMBERS):
        kind = schema.field(name).type if name in schema.names else None
        if kind != wanted[name] and not (wanted[name] == TEXT and kind == pa.dictionary(pa.int32(), TEXT)):
            return False
    bbox = schema.field(BBOX).type
    return all(bbox.field(side).type == pa.float64() for side in ("xmin", "ymin"))


def _range_of_ids(metadata: pq.FileMetaData) -> tuple[int, int] | None:
    """Return the smallest and the largest track id by the file's own statistics, None where it has none."""
    if metadata.num_row_groups == 0:
        return None
    group = metadata.row_group(0)
    at = next(i for i in range(group.num_columns) if group.column(i).path_in_schema == "track_id")
    parts = [metadata.row_group(g).column(at).statistics for g in range(metadata.num_row_groups)]
    if not all(part is not None and part.has_min_max and part.null_count == 0 for part in parts):
        return None
    return min(part.min for part in parts), max(part.max for part in parts)


def _blocks(path: Path, columns: tuple[str, ...]) -> Iterator[pa.RecordBatch]:
    """Yield the named columns and the texts; each block lies in one row group, so that it has one dictionary a text."""
    texts = [*_PASS, "sign_class"]
    with pq.ParquetFile(path, read_dictionary=texts) as file:
        n_rows = min(BLOCK_ROWS, file.metadata.num_rows // _LEAST_BLOCKS + 1)
        for group in range(file.num_row_groups):
            yield from file.iter_batches(n_rows, [group], [*texts, *columns], use_threads=False)


def _coded(column: pa.DictionaryArray, codes: dict[str, int]) -> Codes:
    """Return the code of every text; new ones are given the next number."""
    if column.null_count or column.dictionary.null_count:
        raise _NotPlainError
    names = column.dictionary.to_pylist()
    of_entry = np.array([codes.setdefault(name, len(codes)) for name in names], np.int32)
    of_row: Codes = of_entry[numpy_numbers(column.indices)]
    return of_row


def _number_passes(block: pa.RecordBatch, numbers: dict[Pass, int]) -> Codes:
    """Return the number of the pass of every row; new ones are given the next number."""
    texts = [block.column(name) for name in _PASS]
    if any(text.null_count for text in texts):
        raise _NotPlainError
    names = [text.dictionary.to_pylist() for text in texts]
    size = tuple(len(name) for name in names)
    if np.prod(size, dtype=float) > _MAX_COMBINATIONS:
        raise _NotPlainError
    run, vehicle, passed = (numpy_numbers(text.indices) for text in texts)
    of_row, first = number_combinations(run, vehicle, passed, np.full(size, -1, np.int32))
    run_ids, vehicle_ids, pass_ids = names
    keys = [
        (run_ids[r], vehicle_ids[v], pass_ids[p])
        for r, v, p in zip(run[first].tolist(), vehicle[first].tolist(), passed[first].tolist(), strict=True)
    ]
    number: Codes = np.array([numbers.setdefault(key, len(numbers)) for key in keys], np.int32)[of_row]
    return number


def _numbers(block: pa.RecordBatch) -> Columns:
    """Return what `coded` says of numbers."""
    lon, lat = _places(block)
    sigma_e_m, sigma_n_m, confidence = (
        _filled(block, name, np.nan) for name in ("sigma_e_m", "sigma_n_m", "class_confidence")
    )
    return {
        "track_id": numpy_numbers(block.column("track_id")),
        "lon": lon,
        "lat": lat,
        "var_m2": mean_variances(sigma_e_m, sigma_n_m, _filled(block, "n_frames", 1)),
        "class_confidence": confidence,
        "t_first_us": _filled(block, "t_first", NEVER_BEGUN),
        "t_last_us": _filled(block, "t_last", NEVER_ENDED),
    }


def _places(block: pa.RecordBatch) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    bbox = block.column(BBOX)
    lon, lat = bbox.field("xmin"), bbox.field("ymin")
    if bbox.null_count or lon.null_count or lat.null_count:
        raise _NotPlainError
    return numpy_numbers(lon), numpy_numbers(lat)


def _filled(block: pa.RecordBatch, name: str, missing: float) -> NDArray[Any]:
    """Return numbers or times, with another number where one is missing."""
    column = block.column(name)
    values = numpy_numbers(column)
    if column.null_count == 0:
        return values
    return np.where(numpy_numbers(column.is_valid().cast(pa.int8())) != 0, values, np.asarray(missing, values.dtype))


class _Surveyor:
    """Counts block by block what `Survey` holds."""

    def __init__(self, low_id: int, high_id: int, fine_zoom: int) -> None:
        self._low, self._n_words = low_id, (high_id - low_id) // 64 + 1
        self._bits = np.zeros((0, self._n_words), np.uint64)
        self._cells = CellCounts(fine_zoom)
        self._passes: dict[Pass, int] = {}
        self._runs: dict[str, int] = {}
        self._run_of_pass = np.empty(0, np.int32)
        self._classes: dict[str, int] = {}
        self._n_rows = np.empty(0, np.int64)

    def add(self, block: pa.RecordBatch) -> None:
        lon, lat = _places(block)
        _coded(block.column("sign_class"), self._classes)
        if not are_placed(lon, lat) or not all(name.strip(" ") for name in self._classes):
            raise _NotPlainError
        of_row = _number_passes(block, self._passes)
        self._make_room()
        self._n_rows += np.bincount(of_row, minlength=len(self._passes))
        if not mark_ids(self._bits, of_row, numpy_numbers(block.column("track_id")), self._low):
            raise _NotPlainError
        self._cells.add(self._run_of_pass[of_row], lon, lat)

    def _make_room(self) -> None:
        """Have a row of bits for every pass."""
        n, n_old = len(self._passes), len(self._n_rows)
        if n * self._n_words * 64 > MAX_ID_BITS or len({key[::2] for key in self._passes}) < n:
            raise _NotPlainError  # too many, or a pass of two vehicles, whose keys may be the same
        if n > n_old:
            new = list(self._passes)[n_old:]
            codes = [self._runs.setdefault(run_id, len(self._runs)) for run_id, _, _ in new]
            self._run_of_pass = np.append(self._run_of_pass, np.array(codes, np.int32))
            self._n_rows = np.append(self._n_rows, np.zeros(len(new), np.int64))
            if n > len(self._bits):
                self._bits = np.pad(self._bits, ((0, max(n, 2 * len(self._bits)) - len(self._bits)), (0, 0)))

    def found(self, path: Path) -> Survey:
        run_ids, vehicle_ids, pass_ids = zip(*self._passes, strict=True)
        n_rows = arrow_numbers(self._n_rows)
        reporting = {
            "run_id": arrow_texts(run_ids),
            "vehicle_id": arrow_texts(vehicle_ids),
            "pass_id": arrow_texts(pass_ids),
            **dict.fromkeys(("n_rows", "n_usable", "n_track_ids"), n_rows),
        }
        run, cell_x, cell_y, n_points = self._cells.cells()
        counts = {
            "run_id": arrow_texts(list(self._runs)).take(arrow_numbers(run)),
            "cell_x": arrow_numbers(cell_x).cast(pa.int32()),
            "cell_y": arrow_numbers(cell_y).cast(pa.int32()),
            "n_points": arrow_numbers(n_points),
        }
        return Survey(path, _table(reporting), _table(counts), tuple(sorted(self._classes)))


def _table(columns: dict[str, pa.Array]) -> pa.Table:
    return pa.Table.from_arrays(list(columns.values()), names=list(columns))
