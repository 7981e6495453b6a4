from __future__ import annotations

from semantic_mapper.backoff import backoff_s


def test_pauses_double_up_to_the_longest_however_often_it_fails() -> None:
    assert [backoff_s(n, 0.1, 1.0) for n in (1, 2, 3, 4, 5, 10_000)] == [0.1, 0.2, 0.4, 0.8, 1.0, 1.0]
