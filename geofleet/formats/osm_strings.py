"""The string tables of PBF blocks: https://wiki.openstreetmap.org/wiki/PBF_Format."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geofleet.formats.protobuf import DamagedPbfError

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    Ints = NDArray[np.int64]

__all__ = ["Strings"]

_NEWLINE = 0x0A  # field 1, bytes
_HEAD = 3  # bytes by which strings are looked up


@dataclass(frozen=True, slots=True)
class Strings:
    """String tables, one after the other: where each string begins and ends; strings are cut when asked for.

    `first` holds the number of the first string of each table, with the number of all strings last.
    """

    data: bytes
    begin: Ints
    end: Ints
    first: Ints

    @classmethod
    def of(cls, tables: Sequence[bytes]) -> Strings:
        """Find the strings of some tables.

        Each begins with a newline, as the format happens to have it, and says how long it is. So all newlines are
        taken for beginnings, and where one is not, since it stands inside of a string, those up to the string's end go.
        """
        data = b"".join(tables)
        raw = np.frombuffer(data, np.uint8)
        at = np.append(np.flatnonzero(raw == _NEWLINE), len(data))
        begin = at[:-1] + 2
        size = raw.take(at[:-1] + 1, mode="clip").astype(np.int64)
        long = np.flatnonzero(size >= 0x80)  # noqa: PLR2004 - the top bit says that more bytes follow
        if len(long):
            second = raw.take(begin[long], mode="clip").astype(np.int64)
            size[long] += (second << 7) - 0x80
            begin[long] += 1
            size[long[second >= 0x80]] = -len(data) - 4  # noqa: PLR2004 - as above; ends nowhere
        end = begin + size
        if (end != at[1:]).any():
            kept = _without_inner(at, end)
            at, begin, end = np.append(at[:-1][kept], at[-1]), begin[kept], end[kept]
        edges = np.cumsum([0, *map(len, tables)])
        first = np.searchsorted(at, edges)
        if (at[first] != edges).any():
            raise DamagedPbfError("a string table with something else in it")
        return cls(data, begin, end, first)

    def __len__(self) -> int:
        return len(self.begin)

    def __getitem__(self, index: int) -> bytes:
        return self.data[self.begin[index] : self.end[index]]

    def take(self, numbers: Ints) -> list[bytes]:
        """Return the strings of some numbers."""
        places = zip(self.begin[numbers].tolist(), self.end[numbers].tolist(), strict=True)
        return [self.data[at:end] for at, end in places]

    def numbers(self, texts: Iterable[bytes]) -> list[int]:
        """Return the numbers of the strings that are one of some texts, of three bytes or more."""
        wanted = set(texts)
        return [n for n in self.starting(wanted) if self[n] in wanted]

    def starting(self, heads: Iterable[bytes]) -> list[int]:
        """Return the numbers of the strings whose first three bytes are those of one of some texts."""
        raw = np.frombuffer(self.data, np.uint8)
        at = np.minimum(self.begin, len(raw) - _HEAD)
        first, second, third = (raw[at + n].astype(np.uint32) for n in range(_HEAD))
        wanted = {int.from_bytes(head[:_HEAD], "big") for head in heads}
        return np.flatnonzero(np.isin(first << 16 | second << 8 | third, list(wanted))).tolist()


def _without_inner(at: Ints, ends: Ints) -> NDArray[np.bool_]:
    """Tell which newlines begin a string and do not stand inside of one, by where those ends that begin there."""
    odd = np.flatnonzero(ends != at[1:])
    after = np.searchsorted(at, np.minimum(ends[odd], at[-1]))
    is_wrong = at[after] != ends[odd]
    kept = np.ones(len(ends), bool)
    beyond = 0
    for place, follows, wrong in zip(odd.tolist(), after.tolist(), is_wrong.tolist(), strict=True):
        if place >= beyond:
            if wrong:
                raise DamagedPbfError("a string table with something else in it")
            kept[place + 1 : follows] = False
            beyond = follows
    return kept
