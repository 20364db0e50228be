"""What every reader gives back, and how a file of a supported kind is recognised."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from geofleet.errors import InputError

if TYPE_CHECKING:
    from pathlib import Path

    import pyarrow as pa

GZIP, BZIP2 = b"\x1f\x8b", b"BZh"
_HEAD_BYTES = 4096


@dataclass(frozen=True, slots=True)
class LayerRead:
    """A table read from one file.

    Parameters
    ----------
    table
        Rows in the schema asked for.
    file_format
        Short name of the format found.
    skipped
        Reason to number of items left out.
    found
        Other counts worth telling, e.g. unknown codes or gaps.
    """

    table: pa.Table
    file_format: str
    skipped: dict[str, int] = field(default_factory=dict)
    found: dict[str, int] = field(default_factory=dict)


def read_head(path: Path) -> bytes:
    """Return the first bytes of a file.

    Raises
    ------
    InputError
        There is no such file, it cannot be read, or it is empty.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES)
    except FileNotFoundError:
        raise InputError("there is no such file.", where=str(path), todo="Check the path.") from None
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise InputError(f"cannot be read: {reason}.", where=str(path), todo="Give a readable file.") from None
    if not head:
        raise InputError("the file is empty.", where=str(path), todo="Fetch or export it again.")
    return head
