"""How much of a budget is used, and the learning rate that goes with it."""

from __future__ import annotations

import math


def budget_fraction(step: int, elapsed_s: float, *, steps: int, seconds: float) -> float:
    """Fraction of the budget that is used, by steps or by time, whichever is further; a budget of 0 does not count."""
    by_steps = step / steps if steps > 0 else 0.0
    by_time = elapsed_s / seconds if seconds > 0 else 0.0
    return max(by_steps, by_time)


def cosine_rate(fraction: float, first: float, last: float) -> float:
    """Learning rate that falls from ``first`` to ``last`` along half a cosine."""
    return last + (first - last) * 0.5 * (1 + math.cos(math.pi * fraction))
