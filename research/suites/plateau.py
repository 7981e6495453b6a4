"""Training until more steps bring no more."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

PLATEAU = 0.005  # of mIoU in the last fifth of the steps: a curve that changes by more is not at its plateau

FittedT = TypeVar("FittedT")


def fit_to_plateau(
    fit: Callable[[int], tuple[FittedT, float]], steps: int, doublings: int, *, a_loss_ends_it: bool = False
) -> tuple[FittedT, float]:
    """Fit again with twice the steps until the last fifth of them changes the mIoU by less than ``PLATEAU``.

    Args:
        fit: From steps to what was fitted, and the mIoU that its last fifth brought.
        steps: To begin with.
        doublings: At most.
        a_loss_ends_it: Where few labels are learned by heart, more steps bring no more once the mIoU falls.
    """
    fitted, gain = fit(steps)
    for _ in range(doublings):
        if abs(gain) < PLATEAU or (a_loss_ends_it and gain < 0):
            break
        steps *= 2
        fitted, gain = fit(steps)
    return fitted, gain
