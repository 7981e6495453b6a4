import pytest

from semantic_mapper.training.schedule import budget_fraction, cosine_rate


def test_whichever_budget_is_used_up_first_counts_and_zero_means_none():
    assert budget_fraction(5, 1.0, steps=10, seconds=100) == 0.5
    assert budget_fraction(1, 80.0, steps=10, seconds=100) == 0.8
    assert budget_fraction(9, 80.0, steps=0, seconds=0) == 0.0


def test_rate_falls_along_half_a_cosine():
    assert [cosine_rate(f, 3.0, 1.0) for f in (0, 0.5, 1)] == pytest.approx([3.0, 2.0, 1.0])
