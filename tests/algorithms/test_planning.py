"""The search for the passes needed, against a plain scan, and its summary."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geofleet.algorithms.planning import class_groups, passes_needed, sum_up
from geofleet.errors import InputError


@given(st.integers(1, 300), st.integers(1, 300))
def test_the_search_finds_a_threshold_with_few_questions(threshold, largest):
    asked = []

    def meets(size):
        asked.append(size)
        return size >= threshold

    assert passes_needed(meets, largest) == (threshold if threshold <= largest else None)
    assert len(asked) == len(set(asked)) <= 2 * np.log2(largest) + 4
    assert max(asked) <= largest


def test_luck_does_not_count():
    assert passes_needed(lambda size: size == 4 or size >= 40, 200) == 40
    assert passes_needed(lambda size: size == 4, 200) is None


def test_the_summary_is_order_statistics():
    result = sum_up([5, None, 3, 8, 9, 4, 7, 6, 10, 12], level=0.9)
    assert (result.typical, result.safe, result.n_reached, result.n_fleets) == (8, 12, 9, 10)
    assert (result.low, result.high, result.has_interval) == (4, 12, True)  # 2nd and 9th: covers 97.9 %
    few = sum_up([5, 6, 7], level=0.95)
    assert (few.typical, few.has_interval, few.safe) == (6, False, 7)
    none = sum_up([None] * 8, level=0.95)
    assert (none.typical, none.low, none.high, none.safe, none.n_reached) == (None, None, None, None, 0)
    with pytest.raises(InputError, match="level"):
        sum_up([1], level=1.5)


def test_signs_of_a_class_hang_together_over_short_steps():
    xy = np.array([[0, 0], [3, 0], [6, 0], [3, 1], [20, 0], [24.1, 0]], float)
    group = class_groups(xy, np.array([0, 0, 0, 1, 0, 0]), 4.0)
    assert group[0] == group[1] == group[2]
    assert len(set(group.tolist())) == 4
