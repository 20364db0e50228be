"""Rows that come in any order, dealt into a hive-partitioned folder with a bounded amount of them in memory."""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.parse import quote
from zlib import crc32

import pyarrow as pa
import pyarrow.compute as pc

from geofleet.tables.store import sort_by_key, write_table

if TYPE_CHECKING:
    from pathlib import Path

    from geofleet.tables.schemas import Schema

MAX_FOLDERS = 1000
N_BUCKETS = 256
_BUFFERED_ROWS = 400_000


class TooManyFoldersError(Exception):
    """There are more partitions than folders should be: begin again with buckets."""


class HiveWriter:
    """Writes tables below a folder, one a value of the partition columns: `run_id=a/vehicle_id=7/part-0.parquet`.

    Parameters
    ----------
    schema
        Of the tables; it names two partition columns.
    folder
        Where to write.
    bucketed
        Share folders by a hash of the second column, which then stays in the files: `run_id=a/bucket=3f/…`.

    Notes
    -----
    A part is sorted by key. Which rows share a part depends on their order alone, never on time or memory.
    """

    def __init__(self, schema: Schema, folder: Path, *, bucketed: bool = False) -> None:
        self._schema, self._folder, self._bucketed = schema, folder, bucketed
        self._waiting: dict[str, list[pa.Table]] = {}
        self._n_waiting = 0
        self._n_parts: dict[str, int] = {}
        self.n_rows = 0

    def write(self, table: pa.Table) -> None:
        """Take rows; they are on disk when enough of them wait, or at `close`.

        Raises
        ------
        TooManyFoldersError
            There would be more than `MAX_FOLDERS` folders, and buckets are not used.
        """
        names = self._folders(table)
        order = pc.sort_indices(pa.table({"n": names}), sort_keys=[("n", "ascending")])
        table, names = table.take(order), names.take(order)
        runs = pc.run_end_encode(names)
        start = 0
        for name, stop in zip(runs.values.to_pylist(), runs.run_ends.to_pylist(), strict=True):
            self._waiting.setdefault(name, []).append(table.slice(start, stop - start))
            start = stop
        self._n_waiting += table.num_rows
        if not self._bucketed and len(self._waiting.keys() | self._n_parts.keys()) > MAX_FOLDERS:
            raise TooManyFoldersError
        if self._n_waiting >= _BUFFERED_ROWS:
            self._flush()

    def close(self) -> None:
        """Write what still waits."""
        self._flush()

    def _folders(self, table: pa.Table) -> pa.Array:
        """Return the folder of each row, of which few are distinct."""
        first, second = (table[name].combine_chunks().dictionary_encode() for name in self._schema.partitions)
        outer = [f"{self._schema.partitions[0]}={quote(value, safe='')}" for value in first.dictionary.to_pylist()]
        inner = [self._inner(value) for value in second.dictionary.to_pylist()]
        return pc.binary_join_element_wise(
            pa.array(outer, pa.string()).take(first.indices), pa.array(inner, pa.string()).take(second.indices), "/"
        )

    def _inner(self, value: str) -> str:
        if self._bucketed:
            return f"bucket={crc32(value.encode()) % N_BUCKETS:02x}"
        return f"{self._schema.partitions[1]}={quote(value, safe='')}"

    def _flush(self) -> None:
        inside = self._schema.partitions[: 1 if self._bucketed else 2]
        for name, tables in sorted(self._waiting.items()):
            number = self._n_parts.get(name, 0)
            self._n_parts[name] = number + 1
            table = sort_by_key(self._schema, pa.concat_tables(tables)).drop_columns(list(inside))
            write_table(self._schema, table, self._folder / name / f"part-{number}.parquet")
            self.n_rows += table.num_rows
        self._waiting.clear()
        self._n_waiting = 0
