"""Who could have seen a place: by hand, and against a plain loop."""

from __future__ import annotations

import math

import numpy as np
import pytest

from geofleet.algorithms.opportunities import count_opportunities
from geofleet.errors import InputError

EASTWARD = np.column_stack((np.arange(0.0, 101, 2), np.zeros(51)))


def count(xy, paths, range_m=30.0, fov_deg=60.0):
    first = np.cumsum([0, *map(len, paths)])
    n = len(paths)
    return count_opportunities(
        np.asarray(xy, float).reshape(-1, 2),
        np.concatenate(paths),
        first,
        range_m=np.full(n, range_m),
        fov_deg=np.full(n, fov_deg),
    ).tolist()


def test_ahead_counts_and_behind_beside_and_beyond_do_not():
    places = [[120, 0], [-5, 0], [50, 5], [50, 200], [131, 0], [129.9, 0], [0, 3]]
    assert count(places, [EASTWARD]) == [1, 0, 1, 0, 0, 1, 0]
    assert count(places, [EASTWARD, EASTWARD, EASTWARD[::-1]]) == [2, 1, 3, 0, 0, 2, 1]
    assert count([[-5, 1]], [EASTWARD], fov_deg=360.0) == [1]


def test_equal_to_a_plain_loop():
    rng = np.random.default_rng(3)
    paths = [np.cumsum(rng.normal(0, 3, (40, 2)), axis=0) + rng.uniform(-50, 50, 2) for _ in range(12)]
    xy = rng.uniform(-80, 80, (60, 2))
    expected = []
    for place in xy:
        n = 0
        for path in paths:
            for i, vertex in enumerate(path):
                ahead = path[min(i + 1, 39)] - path[max(i - 1, 0)]
                to = place - vertex
                angle = math.degrees(math.atan2(ahead[0] * to[1] - ahead[1] * to[0], ahead @ to))
                if math.hypot(*to) < 25 and abs(angle) < 35:
                    n += 1
                    break
        expected.append(n)
    assert count(xy, paths, 25.0, 70.0) == expected
    assert 0 < sum(expected) < 12 * 60


def test_nothing_to_see_and_nobody_to_see_it():
    assert count([], [EASTWARD]) == []
    assert count([[0, 0]], [np.zeros((3, 2))]) == [0]  # a parked car has no direction
    none = count_opportunities(
        np.zeros((2, 2)), np.empty((0, 2)), np.array([0]), range_m=np.empty(0), fov_deg=np.empty(0)
    )
    assert none.tolist() == [0, 0]


@pytest.mark.parametrize(("range_m", "fov_deg"), [(np.nan, 60.0), (30.0, np.nan), (0.0, 60.0)])
def test_sensors_without_values_are_refused(range_m, fov_deg):
    with pytest.raises(InputError, match="not finite"):
        count([[0, 0]], [EASTWARD], range_m, fov_deg)
