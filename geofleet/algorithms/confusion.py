"""Which class is read for which: confusion by a matrix, where signs that look alike are confused more often."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.random import Generator
    from numpy.typing import NDArray

    from geofleet.algorithms.streams import PassesRandom

    Floats = NDArray[np.float64]
    Ints = NDArray[np.int64]


def confusion_matrix(group: Sequence[str], *, semantic_rate: float, in_group: float) -> Floats:
    """Return P(read class c | true class k), shape (n, n); rows add up to 1.

    The true class is read with probability `semantic_rate`. What is left goes to the classes of the same group by a
    share of `in_group`, alike, and to all others by the rest, alike; where a class has no other of its group, or the
    scene no other group, everything goes to the classes that there are.

    Parameters
    ----------
    group
        Group of each class: signs of a group look alike.

    Raises
    ------
    ValueError
        There is one class only, and it is not always recognised.
    """
    names = np.asarray(group, dtype=object)
    n = len(names)
    if n == 1 and semantic_rate < 1:
        raise ValueError("one class alone cannot be confused: semantic_rate must be 1")
    near = (names[:, None] == names) & ~np.eye(n, dtype=np.bool_)
    far = names[:, None] != names
    n_near, n_far = near.sum(axis=1, keepdims=True), far.sum(axis=1, keepdims=True)
    to_near = np.where(n_far == 0, 1.0, np.where(n_near == 0, 0.0, in_group))
    wrong = near * to_near / np.maximum(n_near, 1) + far * (1 - to_near) / np.maximum(n_far, 1)
    matrix: Floats = semantic_rate * np.eye(n) + (1 - semantic_rate) * wrong
    return matrix


def read_classes(true_class: Ints, matrix: Floats, rng: Generator | PassesRandom) -> Ints:
    """Draw a read class for each true one, by a row of the matrix each."""
    upto = np.cumsum(matrix, axis=1)
    upto[:, -1] = 1.0  # rounding must not leave a gap
    read: Ints = (rng.random(len(true_class))[:, None] >= upto[true_class]).sum(axis=1)
    return read
