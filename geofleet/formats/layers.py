"""Any layer named on a command line, as a `signs` table."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geofleet.tables.schemas import SIGNS
from geofleet.tables.store import read_table

if TYPE_CHECKING:
    from pathlib import Path

    import pyarrow as pa


def read_layer(path: Path) -> pa.Table:
    """Return the signs of a layer.

    Raises
    ------
    InputError
        The file is missing or no layer of signs.
    """
    return read_table(SIGNS, path)
