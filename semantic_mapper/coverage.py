"""Which few of many views show most of a surface."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.types import Float64

REPEAT_VALUE = 0.5  # a second view of the same point is worth half of the first, a third a quarter


def cover(seen: NDArray[np.bool_], value: Float64, bonus: Float64, count: int) -> list[int]:
    """Choose views greedily: each adds most of what is not yet covered.

    Args:
        seen: (K, P) whether view k sees point p.
        value: (K,) what a point that view k sees counts.
        bonus: (K,) added to the gain of views that see anything; breaks ties.
        count: Views wanted.

    Returns:
        At most ``count`` view numbers, the most useful first; none that sees nothing.
    """
    worth = np.ones(seen.shape[1])
    chosen: list[int] = []
    extra = bonus * seen.any(axis=1)
    while len(chosen) < min(count, len(seen)):
        gain = value * (seen @ worth) / max(seen.shape[1], 1) + extra
        gain[chosen] = 0
        best = int(gain.argmax())
        if gain[best] <= 0:
            break
        chosen.append(best)
        worth = np.where(seen[best], worth * REPEAT_VALUE, worth)
    return chosen
