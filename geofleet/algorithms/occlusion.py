"""Signs hidden for several frames in a row: by a lorry ahead, by leaves, by a parked van."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from geofleet.algorithms.compiled import kernel

if TYPE_CHECKING:
    from numpy.random import Generator
    from numpy.typing import NDArray

    from geofleet.algorithms.streams import PassesRandom

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]
    Flags = NDArray[np.bool_]


def occluded(frame: Ints, sign: Ints, *, share: float, mean_frames: float, rng: Generator | PassesRandom) -> Flags:
    """Draw which sightings of a pass are hidden.

    Each sign has a Markov chain of its own over the frames, stationary from its first frame: hidden for a share of the
    frames, and for `mean_frames` in a row on average (geometric). Frames in which the sign is not in view count as
    well, so a sign that comes back into view long after is hidden or not as if anew.

    Parameters
    ----------
    frame, sign
        Frame and sign of each sighting, by frame, shape (n,).
    share
        Of frames, 0 … below 1.
    mean_frames
        Mean number of frames in a row, at least 1 and at least share / (1 - share), so that a visible sign becomes
        hidden with a probability of at most 1.

    Raises
    ------
    ValueError
        The two numbers ask for a probability above 1.
    """
    leave = 1.0 / mean_frames
    enter = share / (1.0 - share) * leave
    if enter > 1:
        raise ValueError(f"a share of {share:g} needs at least {share / (1 - share):g} frames in a row")
    n_signs = int(sign.max()) + 1 if len(sign) else 0
    hidden: Flags = _chain(frame, sign, n_signs, share, 1.0 - leave - enter, rng.random(len(frame)))
    return hidden


@kernel
def _chain(  # noqa: PLR0917 - numba takes no keyword-only arguments
    frame: Ints, sign: Ints, n_signs: int, share: float, memory: float, uniform: Floats
) -> Flags:
    """Run all chains; the state after k frames is hidden with probability share + (before - share) memory^k."""
    hidden = np.empty(len(frame), np.bool_)
    last_frame, state = np.full(n_signs, -1), np.zeros(n_signs)
    for i in range(len(frame)):
        s = sign[i]
        likely = share
        if last_frame[s] >= 0:
            likely += (state[s] - share) * memory ** (frame[i] - last_frame[s])
        hidden[i] = uniform[i] < likely
        state[s], last_frame[s] = (1.0 if hidden[i] else 0.0), frame[i]
    return hidden
