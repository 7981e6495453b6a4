"""Counts in bounded memory say what lists of everything would."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from semantic_mapper.replay.stats import LONGEST_MS, SHORTEST_MS, BoundedLog, LatencyHistogram


@given(st.lists(st.floats(SHORTEST_MS, LONGEST_MS), max_size=60), st.sampled_from([0.0, 50.0, 95.0, 99.5, 100.0]))
def test_percentiles_are_those_of_all_steps_but_the_first(values: list[float], percent: float) -> None:
    times = LatencyHistogram()
    for value in values:
        times.add(value)
    if not values:
        assert times.first is None and times.percentile(percent) is None
        return
    assert times.first == values[0]
    expected = np.percentile(values[1:] or values, percent)
    assert times.percentile(percent) == pytest.approx(expected, rel=0.0026)


def test_times_beyond_the_histogram_count_as_its_ends() -> None:
    times = LatencyHistogram()
    for value in (1.0, 0.0, 0.0, 3 * LONGEST_MS):
        times.add(value)
    assert times.percentile(0) == times.percentile(50) == pytest.approx(SHORTEST_MS, rel=0.01)
    assert times.percentile(100) == pytest.approx(LONGEST_MS, rel=0.01)


def test_the_first_ones_and_the_last_are_kept() -> None:
    kept = BoundedLog[int](3)
    assert not kept and kept.first == []
    with pytest.raises(IndexError):
        _ = kept.last
    for n in range(1000):
        kept.append(n)
    assert (len(kept), kept.first, kept.last) == (1000, [0, 1, 2], 999)
