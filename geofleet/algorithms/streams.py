"""Random numbers that depend on what they are for, never on the order in which work is done.

Every stream is a child of `numpy.random.SeedSequence(entropy=seed, spawn_key=(replicate, vehicle, pass))`, so a fleet
of ten is the first ten vehicles of a fleet of fifty, and any number of workers draws the same numbers. One stream a
purpose keeps studies comparable: another ghost rate leaves the GNSS errors of every pass as they were.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.random import Generator, SeedSequence

_CALIBRATION, _POSE, _FRAMES, _CLASSES, _GHOSTS, _CHOICE, _DRIFT, _OCCLUSION, _BILLBOARDS = range(9)


@dataclass(frozen=True, slots=True)
class PassStreams:
    """The generators of one pass.

    Parameters
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
    """

    calibration: Generator
    pose: Generator
    frames: Generator
    classes: Generator
    ghosts: Generator
    choice: Generator
    drift: Generator
    occlusion: Generator
    billboards: Generator


def pass_streams(seed: int, *, replicate: int, vehicle: int, pass_number: int = 0) -> PassStreams:
    """Return fresh generators of one pass; equal arguments give equal draws."""
    of_pass = (replicate, vehicle, pass_number)
    return PassStreams(
        calibration=_generator(seed, (replicate, vehicle, 0, _CALIBRATION)),
        pose=_generator(seed, (*of_pass, _POSE)),
        frames=_generator(seed, (*of_pass, _FRAMES)),
        classes=_generator(seed, (*of_pass, _CLASSES)),
        ghosts=_generator(seed, (*of_pass, _GHOSTS)),
        choice=_generator(seed, (*of_pass, _CHOICE)),
        drift=_generator(seed, (*of_pass, _DRIFT)),
        occlusion=_generator(seed, (*of_pass, _OCCLUSION)),
        billboards=_generator(seed, (*of_pass, _BILLBOARDS)),
    )


def world_stream(seed: int, *, replicate: int) -> Generator:
    """Return a fresh generator of what all vehicles of a run meet alike: where the billboards stand."""
    return _generator(seed, (replicate, _BILLBOARDS))


def _generator(seed: int, spawn_key: tuple[int, ...]) -> Generator:
    return Generator(np.random.PCG64(SeedSequence(entropy=seed, spawn_key=spawn_key)))
