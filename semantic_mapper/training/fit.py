"""The loop of every fit: steps until the budget is used, looks at what is held out, and the weights that were best."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch

from semantic_mapper.fields.learned import LearnedField

BACKBONE = "backbone"
ENCODER = "encoder"
REST = "rest"

State = dict[str, torch.Tensor]


@dataclass(frozen=True, slots=True)
class FitProgress:
    """State after a step: ``fraction`` of the budget, last training loss, held-out loss and accuracy (NaN at first)."""

    step: int
    fraction: float
    loss: float
    held_out_loss: float = math.nan
    held_out_accuracy: float = math.nan
    best: bool = False


OnProgress = Callable[[FitProgress], None]


@dataclass(slots=True)
class BestWeights:
    """Loss (infinite where nothing is held out) and accuracy of held-out rays, and the weights that gave them."""

    loss: float
    accuracy: float
    step: int
    state: State

    def beaten_by(self, loss: float) -> bool:
        """Whether weights with this loss go before these; where nothing is held out, later ones do."""
        return loss < self.loss or not math.isfinite(self.loss)


class Budget:
    """How much of a budget is used; from the time that is left, a last look at held-out rays is set aside.

    Args:
        seconds: From now on; 0 = only steps count.
        steps: 0 = only seconds count.
        looks: At held-out rays, over the whole budget.
    """

    def __init__(self, seconds: float, steps: int, looks: int = 1) -> None:
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
class HeldOut:
    """How a fit is judged while it runs.

    Args:
        look: Loss and accuracy of held-out rays.
        state: A copy of the weights.
        best: Those to beat.
        patience: Looks without a better loss before the fit stops early; 0 = it does not.
        patient_until: Fraction of the budget before which looks do not count for that.
    """

    look: Callable[[], tuple[float, float]]
    state: Callable[[], State]
    best: BestWeights
    patience: int = 0
    patient_until: float = 0.0


def fit(
    learn: Callable[[float], float | None],
    budget: Budget,
    on_progress: OnProgress | None = None,
    stopped: Callable[[], object] = bool,
    held_out: HeldOut | None = None,
) -> int:
    """Learn until the budget is used; ``held_out.best`` then has the weights that were best.

    Args:
        learn: One step, at a fraction of the budget; returns its loss, None = there was nothing to learn from.
        on_progress: Called after every step.
        stopped: Called before every step; once it returns something true, the fit ends after one more look.

    Returns:
        The number of steps.
    """
    step, stale = 0, 0
    latest = (math.nan, math.nan) if held_out is None else (held_out.best.loss, held_out.best.accuracy)
    while (fraction := budget.used(step)) < 1 and not stopped():
        if held_out is not None and 0 < held_out.patience <= stale:
            break
        loss = learn(fraction)
        step += 1
        if loss is None:
            continue
        fraction = budget.used(step)
        improved = False
        if held_out is not None and budget.look_due(fraction):
            with budget.looking():
                latest = held_out.look()
            improved = _keep_better(held_out, latest, step)
            stale = 0 if improved or fraction < held_out.patient_until else stale + 1
        if on_progress is not None:
            on_progress(FitProgress(step, min(fraction, 1.0), loss, *latest, improved))
    if held_out is not None and stopped() and step > 0:  # what was learned since the last look
        _keep_better(held_out, held_out.look(), step)
    return step


def _keep_better(held_out: HeldOut, seen: tuple[float, float], step: int) -> bool:
    if not held_out.best.beaten_by(seen[0]):
        return False
    held_out.best = BestWeights(*seen, step, held_out.state())
    return True


def part_of(on_progress: OnProgress | None, first: float, last: float) -> OnProgress | None:
    """Progress of a part of a fit, which takes it from the fraction ``first`` to ``last``."""
    if on_progress is None:
        return None
    return lambda p: on_progress(replace(p, fraction=first + (last - first) * p.fraction))


def budget_fraction(step: int, elapsed_s: float, *, steps: int, seconds: float) -> float:
    """Fraction of a budget that is used, by steps or by time, whichever is further; a budget of 0 does not count."""
    by_steps = step / steps if steps > 0 else 0.0
    by_time = elapsed_s / seconds if seconds > 0 else 0.0
    return max(by_steps, by_time)


def time_left(seconds: float, began: float) -> float:
    """Seconds left of a budget that began at a time of ``time.monotonic``: a twentieth of it at least."""
    return max(seconds - (time.monotonic() - began), 0.05 * seconds)


def cosine_rate(fraction: float, first: float, last: float) -> float:
    """Learning rate that falls from ``first`` to ``last`` along half a cosine."""
    return last + (first - last) * 0.5 * (1 + math.cos(math.pi * fraction))


def make_optimiser(field: LearnedField, learning_rate: float, weight_decay: float) -> torch.optim.AdamW:
    """AdamW over all parameters; scales, shifts and biases do not decay."""
    encoder = field.image_encoder
    part_of_id: dict[int, str] = {}
    if encoder is not None:
        part_of_id |= {id(p): ENCODER for p in encoder.parameters()}
        part_of_id |= {id(p): BACKBONE for backbone in encoder.backbones() for p in backbone.parameters()}
    groups = [
        {
            "params": [p for p in field.parameters() if part_of_id.get(id(p), REST) == part and (p.ndim > 1) == decays],
            "weight_decay": weight_decay if decays else 0.0,
            "part": part,
        }
        for part in (BACKBONE, ENCODER, REST)
        for decays in (True, False)
    ]
    return torch.optim.AdamW([group for group in groups if group["params"]], learning_rate)


def set_rates(
    optimiser: torch.optim.Optimizer, rate: float, encoder_fraction: float, backbone_fraction: float = 1.0
) -> None:
    """Learning rate of all parameters; the encoder takes ``encoder_fraction`` of it, its backbone
    ``backbone_fraction`` of that."""
    fractions = {BACKBONE: encoder_fraction * backbone_fraction, ENCODER: encoder_fraction, REST: 1.0}
    for group in optimiser.param_groups:
        group["lr"] = rate * fractions[group["part"]]
