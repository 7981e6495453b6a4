"""Limits that count while nothing gets on, however long all of it takes; by a clock of the test."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from semantic_mapper.nodes.supervisor.progress import ProgressLimit

LIMIT_S = 300.0


@dataclass
class Process:
    """Its time on the clock and on the processor."""

    now_s: float = 1000.0
    cpu_s: float = 7.0

    def limit(self) -> ProgressLimit:
        return ProgressLimit(LIMIT_S, lambda: self.cpu_s, lambda: self.now_s)

    def runs_until(self, limit: ProgressLimit, *, within_s: float, cpu: float, mark_every_s: float = 0.0) -> float:
        """Seconds until it is given up; ``within_s`` where it is not. It has the fraction ``cpu`` of a core."""
        for second in range(round(within_s)):
            self.now_s += 1
            self.cpu_s += cpu
            if limit.exceeded(second // mark_every_s if mark_every_s else None):
                return second
        return within_s


def test_what_says_that_it_gets_on_may_take_as_long_as_it_likes() -> None:
    process = Process()
    assert process.runs_until(process.limit(), within_s=9000, cpu=0.0, mark_every_s=280) == 9000


def test_what_gets_a_fiftieth_of_a_core_may_compute_on() -> None:
    process = Process()
    assert process.runs_until(process.limit(), within_s=9000, cpu=0.02) == 9000


@pytest.mark.parametrize("heartbeats", [0.0, 0.0005])
def test_what_does_nothing_is_given_up_at_the_limit(heartbeats: float) -> None:
    process = Process()
    assert LIMIT_S <= process.runs_until(process.limit(), within_s=9000, cpu=heartbeats) <= 1.1 * LIMIT_S


def test_what_computes_for_ever_and_says_nothing_is_given_up_after_as_much_processor_time() -> None:
    process = Process()
    assert LIMIT_S <= process.runs_until(process.limit(), within_s=9000, cpu=1.0) <= 1.1 * LIMIT_S


def test_what_got_on_before_is_given_up_the_limit_after_its_last_step() -> None:
    process = Process()
    limit = process.limit()
    assert process.runs_until(limit, within_s=1000, cpu=0.5, mark_every_s=100) == 1000
    assert LIMIT_S <= process.runs_until(limit, within_s=9000, cpu=0.0) <= 1.1 * LIMIT_S
