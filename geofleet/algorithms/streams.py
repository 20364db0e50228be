"""Random numbers that depend on what they are for, never on the order in which work is done.

Every stream is a child of `numpy.random.SeedSequence(entropy=seed, spawn_key=(replicate, vehicle, pass))`, so a fleet
of ten is the first ten vehicles of a fleet of fifty, and any number of workers draws the same numbers. One stream a
purpose keeps studies comparable: another ghost rate leaves the GNSS errors of every pass as they were.
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.random import Generator, SeedSequence

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]

_CALIBRATION, _POSE, _FRAMES, _CLASSES, _GHOSTS, _CHOICE, _DRIFT, _OCCLUSION, _BILLBOARDS = range(9)
_POOL, _WORD = 4, 0xFFFFFFFF
_BIAS_DRIFT, _GHOST_TRACKS, _SPLITS = range(9, 12)


class PassStreams:
    """The generators of one pass, each made when it is first drawn from.

    Attributes
    ----------
    calibration
        Of the vehicle's sensor: the same for every pass of the vehicle.
    pose
        Way through the lane, speed, GNSS and heading error.
    frames
        Measurement noise and misses.
    classes
        Recognition.
    ghosts
        False positives.
    choice
        Which sensor, drive and direction.
    drift
        What the reported position does along the way.
    occlusion
        What hides signs for several frames.
    billboards
        Which billboards are taken for signs.
    bias_drift
        What the sensor-setting error does along the way.
    ghost_tracks
        False positives that last.
    splits
        Which tracks are sent in two.
    """

    def __init__(self, seed: int, replicate: int, vehicle: int, pass_number: int) -> None:
        self._of_vehicle = partial(_generator, seed, (replicate, vehicle, 0))
        self._of_pass = partial(_generator, seed, (replicate, vehicle, pass_number))

    @cached_property
    def calibration(self) -> Generator:  # noqa: D102 - described above, as all of these
        return self._of_vehicle(_CALIBRATION)

    @cached_property
    def pose(self) -> Generator:  # noqa: D102
        return self._of_pass(_POSE)

    @cached_property
    def frames(self) -> Generator:  # noqa: D102
        return self._of_pass(_FRAMES)

    @cached_property
    def classes(self) -> Generator:  # noqa: D102
        return self._of_pass(_CLASSES)

    @cached_property
    def ghosts(self) -> Generator:  # noqa: D102
        return self._of_pass(_GHOSTS)

    @cached_property
    def choice(self) -> Generator:  # noqa: D102
        return self._of_pass(_CHOICE)

    @cached_property
    def drift(self) -> Generator:  # noqa: D102
        return self._of_pass(_DRIFT)

    @cached_property
    def occlusion(self) -> Generator:  # noqa: D102
        return self._of_pass(_OCCLUSION)

    @cached_property
    def billboards(self) -> Generator:  # noqa: D102
        return self._of_pass(_BILLBOARDS)

    @cached_property
    def bias_drift(self) -> Generator:  # noqa: D102
        return self._of_pass(_BIAS_DRIFT)

    @cached_property
    def ghost_tracks(self) -> Generator:  # noqa: D102
        return self._of_pass(_GHOST_TRACKS)

    @cached_property
    def splits(self) -> Generator:  # noqa: D102
        return self._of_pass(_SPLITS)


def pass_streams(seed: int, *, replicate: int, vehicle: int, pass_number: int = 0) -> PassStreams:
    """Return fresh generators of one pass; equal arguments give equal draws."""
    return PassStreams(seed, replicate, vehicle, pass_number)


def world_stream(seed: int, *, replicate: int) -> Generator:
    """Return a fresh generator of what all vehicles of a run meet alike: where the billboards stand."""
    return _generator(seed, (replicate,), _BILLBOARDS)


class PassesRandom:
    """Generators of several passes, drawn from as if they were one: each fills the places that are its pass's.

    What is drawn for a pass does not depend on the passes that it is drawn with.

    Parameters
    ----------
    generators
        One a pass.
    start
        Where the places of each pass begin and, last, where they end, shape (n_passes + 1,).
    """

    def __init__(self, generators: Sequence[Generator], start: Ints) -> None:
        self._draws = list(zip(generators, start[:-1].tolist(), start[1:].tolist(), strict=True))

    def random(self, n: int) -> Floats:
        """Draw uniform numbers, 0 … below 1, as `Generator.random`."""
        out = np.empty(n)
        for generator, first, last in self._draws:
            generator.random(out=out[first:last])
        return out

    def standard_normal(self, n: int) -> Floats:
        """Draw standard normal numbers, as `Generator.standard_normal`."""
        out = np.empty(n)
        for generator, first, last in self._draws:
            generator.standard_normal(out=out[first:last])
        return out

    def integers(self, low: int, high: int, n: int) -> Ints:
        """Draw whole numbers, `low` … below `high`, as `Generator.integers`."""
        out = np.empty(n, dtype=np.int64)
        for generator, first, last in self._draws:
            out[first:last] = generator.integers(low, high, last - first)
        return out

    def poisson(self, mean: float, n: int) -> Ints:
        """Draw Poisson numbers, as `Generator.poisson`."""
        out = np.empty(n, dtype=np.int64)
        for generator, first, last in self._draws:
            out[first:last] = generator.poisson(mean, last - first)
        return out


def _generator(seed: int, whose: tuple[int, ...], purpose: int) -> Generator:
    return Generator(np.random.PCG64(SeedSequence(_entropy(seed, (*whose, purpose)))))


def _entropy(seed: int, spawn_key: tuple[int, ...]) -> NDArray[np.uint32]:
    """Return the words that numpy makes of `entropy=seed, spawn_key=spawn_key`, in a third of the time that it takes.

    The seed, least word first, fills the pool of four words, and each number of the key is a word more (below 2³²).
    """
    words = np.zeros(_POOL + len(spawn_key), dtype=np.uint32)
    words[0], words[1] = seed & _WORD, seed >> 32  # a seed is below 2⁶⁴
    words[_POOL:] = spawn_key
    return words
