"""Batches of detections on disk: rows as they come, dealt to the batches whose tiles read them, and read back."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from geofleet.algorithms.dealing import deal, index_readers, take_rows, unpack_rows
from geofleet.tables.overlap import work_behind

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from numpy.typing import NDArray

    Columns = dict[str, NDArray[Any]]
    Ints = NDArray[np.int64]

Block = TypeVar("Block")

NEVER_BEGUN, NEVER_ENDED = np.iinfo(np.int64).max, np.iinfo(np.int64).min  # times that are missing, µs
_HASHES_OF_PASSES = "pass_hash.npy"
_FLOATS = ("lon", "lat", "var_m2", "class_confidence")
_WHOLE = ("track_id", "t_first_us", "t_last_us")
_CODES = ("pass_code", "class_code")
_ROW = np.dtype(
    [
        *((name, np.float64) for name in _FLOATS),
        *((name, np.int64) for name in _WHOLE),
        *((name, np.int32) for name in (*_CODES, "tile_code")),
        ("is_owned", np.bool_),
    ],
    align=True,
)


class Dealer:
    """Deals blocks of rows (the columns of `sql/aggregate/coded`) to one file a batch below a folder.

    Parameters
    ----------
    folder
        Where the batches go, `batch_path(folder, number)`.
    readers
        The columns of `sql/tiles/readers`.
    fine_zoom
        Zoom of the cells.
    run_of_tile, run_of_pass
        Number of the run of every tile and of every pass.
    """

    def __init__(self, folder: Path, readers: Columns, *, fine_zoom: int, run_of_tile: Ints, run_of_pass: Ints) -> None:
        self._readers = index_readers(run_of_tile[readers["tile_code"]], readers, fine_zoom)
        self._n_batches = int(readers["batch"].max(initial=-1)) + 1
        self._run_of_pass, self._folder = run_of_pass, folder
        self._dealt = np.empty(0, _ROW)

    def deal_all(self, blocks: Iterable[Block], coded: Callable[[Block], Columns]) -> None:
        """Deal what a function makes of each block; the next block is read while one is made into rows and dealt."""
        work_behind(lambda block: self._deal(coded(block)), blocks)

    def _deal(self, column: Columns) -> None:
        run = self._run_of_pass[column["pass_code"]]
        row, reader, start = deal(run, column["lon"], column["lat"], self._readers, self._n_batches)
        if (
            row.size > self._dealt.size
        ):  # memory that is used again and again: a fresh page costs more than what it holds
            self._dealt = np.empty(row.size + row.size // 4, _ROW)
        kinds = (tuple(column[name] for name in names) for names in (_FLOATS, _WHOLE, _CODES))
        take_rows(self._dealt, row, reader, start, self._readers, *kinds)
        for number in np.flatnonzero(np.diff(start)).tolist():
            with batch_path(self._folder, number).open("ab") as file:
                file.write(self._dealt[start[number] : start[number + 1]].view(np.uint8).data)


def batch_path(folder: Path, number: int) -> Path:
    """Return the file of a batch."""
    return folder / f"{number}.rows"


def write_pass_hashes(folder: Path, hashes: NDArray[np.uint64]) -> None:
    """Keep the hash of every pass beside the batches."""
    np.save(folder / _HASHES_OF_PASSES, hashes)


def read_rows(path: Path) -> Columns:
    """Read a batch: one array a column of `sql/tiles/members`, and the hash of each row's pass."""
    columns: Columns = dict(zip(_ROW.names or (), unpack_rows(np.memmap(path, _ROW, "r")), strict=True))
    hashes = np.load(path.with_name(_HASHES_OF_PASSES), mmap_mode="r")
    return columns | {"pass_hash": hashes.take(columns["pass_code"])}
