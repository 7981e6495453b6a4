"""How much of a fit's budget is used, when to look at what was held out, and the weights that were best there."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from semantic_mapper.training.schedule import budget_fraction


class BudgetClock:
    """How much of a budget is used; from the time that is left, a last look at held-out rays is set aside.

    Args:
        seconds: From now on; 0 = only steps count.
        steps: 0 = only seconds count.
        looks: At held-out rays, over the whole budget.
    """

    def __init__(self, seconds: float, steps: int, looks: int) -> None:
        self._seconds, self._steps, self._looks = seconds, steps, looks
        self._began = time.monotonic()
        self._look_s = 0.0
        self._looked = 0

    @property
    def elapsed_s(self) -> float:
        """Since it was made."""
        return time.monotonic() - self._began

    def used(self, step: int) -> float:
        """Fraction of the budget that is used after ``step`` steps."""
        left_for_steps = max(self._seconds - self._look_s, 1e-9) if self._seconds > 0 else 0.0
        return budget_fraction(step, self.elapsed_s, steps=self._steps, seconds=left_for_steps)

    def look_due(self, fraction: float) -> bool:
        """Whether it is time for the next look, which is then counted; at the end of the budget it always is."""
        if fraction * self._looks < self._looked + 1 and fraction < 1:
            return False
        self._looked = int(fraction * self._looks)
        return True

    @contextmanager
    def looking(self) -> Iterator[None]:
        """Round each look: the next one is expected to take as long."""
        began = time.monotonic()
        yield
        self._look_s = time.monotonic() - began


@dataclass(slots=True)
class BestWeights:
    """Loss (infinite where nothing is held out) and accuracy of held-out rays, and the weights that gave them."""

    loss: float
    accuracy: float
    step: int
    state: dict[str, torch.Tensor]

    def beaten_by(self, loss: float) -> bool:
        """Whether weights with this loss go before these; where nothing is held out, later ones do."""
        return loss < self.loss or not math.isfinite(self.loss)
