"""Between Arrow and NumPy, and from Python's texts, without pandas.

`pa.array` and `to_numpy` do the same, and import pandas for it, like every way from Python's values: 60 MB and half a
second.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

FIRST_TIME, LAST_TIME = np.datetime64("1900-01-01", "us"), np.datetime64("2200-01-01", "us")


def arrow_texts(values: Sequence[str | None]) -> pa.Array:
    """Return texts as an Arrow array."""
    packed = [b"" if value is None else value.encode() for value in values]
    ends = np.cumsum([0, *map(len, packed)], dtype=np.int32)
    is_there = np.array([value is not None for value in values], bool)
    buffers = [np.packbits(is_there, bitorder="little"), ends, b"".join(packed)]
    return pa.Array.from_buffers(pa.string(), len(packed), [pa.py_buffer(b) for b in buffers], int((~is_there).sum()))


def arrow_numbers(values: NDArray[Any]) -> pa.Array:
    """Return 64-bit numbers as an Arrow array over the same memory; NaN is null."""
    values = np.ascontiguousarray(values)
    missing = np.isnan(values) if values.dtype == np.float64 else np.zeros(0, bool)
    return _over(values, pa.from_numpy_dtype(values.dtype), missing)


def arrow_times(microseconds: NDArray[np.int64], missing: int) -> pa.Array:
    """Return times since 1970 as an Arrow array in UTC over the same memory; the number `missing` is null."""
    return _over(np.ascontiguousarray(microseconds), pa.timestamp("us", tz="UTC"), microseconds == missing)


def sound_times(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return timestamps or dates in microseconds; those that no clock shows, as in the year 33658, are null."""
    times = column.cast(pa.timestamp("us", getattr(column.type, "tz", None)), safe=False)
    count = times.cast(pa.int64())
    is_sound = pc.and_(pc.greater_equal(count, FIRST_TIME.astype(int)), pc.less(count, LAST_TIME.astype(int)))
    return pc.if_else(is_sound, times, pa.scalar(None, times.type))


def _over(values: NDArray[Any], kind: pa.DataType, missing: NDArray[np.bool_]) -> pa.Array:
    valid = pa.py_buffer(np.packbits(~missing, bitorder="little")) if missing.any() else None
    return pa.Array.from_buffers(kind, len(values), [valid, pa.py_buffer(values)], int(missing.sum()))


def numpy_numbers(array: pa.Array) -> NDArray[Any]:
    """Return Arrow numbers or times without nulls as an array over the same memory; times as int64 of their unit."""
    kind = np.int64 if pa.types.is_timestamp(array.type) else array.type.to_pandas_dtype()
    values: NDArray[Any] = np.frombuffer(array.buffers()[1] or b"", kind)
    return values[array.offset : array.offset + len(array)]
