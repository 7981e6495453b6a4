"""How much of a budget is used, and the learning rate that goes with it."""

from __future__ import annotations

import math

from semantic_mapper.training.train_config import TrainConfig

WARM_UP = 0.01  # fraction of each part of a training


def budget_fraction(step: int, elapsed_s: float, *, steps: int, seconds: float) -> float:
    """Fraction of the budget that is used, by steps or by time, whichever is further; a budget of 0 does not count."""
    by_steps = step / steps if steps > 0 else 0.0
    by_time = elapsed_s / seconds if seconds > 0 else 0.0
    return max(by_steps, by_time)


def cosine_rate(fraction: float, first: float, last: float) -> float:
    """Learning rate that falls from ``first`` to ``last`` along half a cosine."""
    return last + (first - last) * 0.5 * (1 + math.cos(math.pi * fraction))


def learning_rate(fraction: float, share: float, config: TrainConfig) -> float:
    """For steps on images, then for steps on rays: half a cosine each, after a short linear warm-up.

    Args:
        fraction: Of the budget that is used.
        share: Of the budget that belongs to images.
    """
    if fraction < share:
        fraction, first = fraction / share, config.images.learning_rate
    else:
        fraction, first = (fraction - share) / max(1 - share, 1e-9), config.learning_rate
    return cosine_rate(fraction, first, config.final_learning_rate) * min(1.0, fraction / WARM_UP + 0.1)
