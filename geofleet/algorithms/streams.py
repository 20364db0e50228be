"""Random numbers that depend on what they are for, never on the order in which work is done.

Every stream is a child of `numpy.random.SeedSequence(entropy=seed, spawn_key=(replicate, vehicle, pass))`, so a fleet
of ten is the first ten vehicles of a fleet of fifty, and any number of workers draws the same numbers. One stream a
purpose keeps studies comparable: another ghost rate leaves the GNSS errors of every pass as they were.
"""

from __future__ import annotations

from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.random import Generator
from numpy.random.bit_generator import ISeedSequence

from geofleet.algorithms.compiled import kernel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import DTypeLike, NDArray

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
    words = _Seed(_entropy(seed, (*whose, purpose)))
    return Generator(np.random.PCG64(words))  # type: ignore[arg-type]  # numpy takes any ISeedSequence


class _Seed(ISeedSequence):
    """What `numpy.random.SeedSequence` makes of its words, compiled: a pass has many streams, and most are short."""

    def __init__(self, words: NDArray[np.int64]) -> None:
        self._words = words

    def generate_state(self, n_words: int, dtype: DTypeLike = np.uint32) -> NDArray[np.uint32 | np.uint64]:
        """Return the state that a bit generator begins with."""
        width = np.dtype(dtype).itemsize // np.dtype(np.uint32).itemsize
        state: NDArray[np.uint32] = _state(self._words, n_words * width)
        return state.view(dtype)  # the least word first, as on every machine that numba is made for


def _entropy(seed: int, spawn_key: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the words of 32 bits that numpy makes of `entropy=seed, spawn_key=spawn_key`.

    The seed, least word first, fills the pool of four words, and each number of the key is a word more (below 2³²).
    """
    words = np.zeros(_POOL + len(spawn_key), dtype=np.int64)
    words[0], words[1] = seed & _WORD, seed >> 32  # a seed is below 2⁶⁴
    words[_POOL:] = spawn_key
    return words


@kernel
def _state(words: NDArray[np.int64], n: int) -> NDArray[np.uint32]:
    """Mix words into a pool of four and return n words of state (M. E. O'Neill's `seed_seq_fe`, as numpy runs it)."""
    pool, constant = np.empty(_POOL, np.int64), 0x43B0D7E5
    for k in range(_POOL):
        pool[k], constant = _hashed(words[k], constant, 0x931E8875)
    for k in range(len(words)):
        for to in range(_POOL):
            if k != to:  # each word of the pool into the others, then each further word into all
                hashed, constant = _hashed(pool[k] if k < _POOL else words[k], constant, 0x931E8875)
                mixed = (0xCA01F9DD * pool[to] - 0x4973F715 * hashed) & _WORD
                pool[to] = mixed ^ (mixed >> 16)
    state, constant = np.empty(n, np.uint32), 0x8B51F9DD
    for k in range(n):
        hashed, constant = _hashed(pool[k % _POOL], constant, 0x58F38DED)
        state[k] = hashed
    return state


@kernel
def _hashed(word: int, constant: int, factor: int) -> tuple[int, int]:
    """Hash a word of 32 bits; return it with the next constant. Products wrap, and their low 32 bits are right."""
    after = (constant * factor) & _WORD
    hashed = ((word ^ constant) * after) & _WORD
    return hashed ^ (hashed >> 16), after
