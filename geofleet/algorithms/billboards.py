"""Persistent ghosts: things beside the road that many passes take for the same wrong sign."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from geofleet.algorithms.trajectory import DriveLine

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Billboards:
    """Where they stand (n, 2), the class that each is taken for, and the share of passes that report it, (n,)."""

    xy_m: Floats
    class_code: Ints
    share: Floats

    def reported(self, rng: Generator) -> Ints:
        """Draw which of them a pass reports, by number."""
        return np.flatnonzero(rng.random(len(self.share)) < self.share)


def place_billboards(
    lines: tuple[DriveLine, ...],
    *,
    per_km: float,
    share: tuple[float, float],
    corridor_m: float,
    n_classes: int,
    rng: Generator,
) -> Billboards:
    """Draw billboards: Poisson along the drives, uniform over the corridor to both sides, a class and a share each."""
    places = [_beside(line, per_km, corridor_m, rng) for line in lines]
    xy_m = np.concatenate(places)
    return Billboards(xy_m, rng.integers(0, n_classes, len(xy_m)), rng.uniform(*share, len(xy_m)))


def _beside(line: DriveLine, per_km: float, corridor_m: float, rng: Generator) -> Floats:
    n = rng.poisson(per_km * line.along_m[-1] / 1000.0)
    along = rng.uniform(0.0, line.along_m[-1], n)
    step = np.clip(np.searchsorted(line.along_m, along, side="right") - 1, 0, len(line.along_m) - 2)
    chord = line.xy_m[step + 1] - line.xy_m[step]
    length = np.hypot(*chord.T)
    foot = line.xy_m[step] + chord * ((along - line.along_m[step]) / length)[:, None]
    left = np.column_stack((-chord[:, 1], chord[:, 0])) / length[:, None]
    place: Floats = foot + left * rng.uniform(-corridor_m, corridor_m, n)[:, None]
    return place
