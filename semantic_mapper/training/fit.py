"""The loop of every fit: steps until the budget is used, looks at what is held out, and the weights that were best."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.config import FinetuneConfig
from semantic_mapper.types import PosedFrame

BACKBONE, ENCODER, REST = "backbone", "encoder", "rest"  # groups of parameters
HELD_OUT_BLOCK = 16  # pixels a side: single held-out pixels would be known from their neighbours

State = dict[str, torch.Tensor]


@dataclass(frozen=True, slots=True)
class FitProgress:
    """State after a step."""

    step: int
    fraction: float  # of the budget
    loss: float  # of the step
    held_out_loss: float = math.nan  # of the last look
    held_out_accuracy: float = math.nan
    best: bool = False  # whether this step's look was the best so far


OnProgress = Callable[[FitProgress], None]


class FitTask(NamedTuple):
    """What to fit to which frames, within which budget."""

    frames: Sequence[PosedFrame]  # with rigid poses; those with label images say the classes
    label_set: LabelSet  # of their labels, and of the result
    start: LearnedField | None  # a field of one scene takes its config and its box, if it is fitted; None = nothing
    config: FinetuneConfig
    budget: "Budget"

    @property
    def labelled(self) -> list[PosedFrame]:
        """The frames with label images."""
        return [f for f in self.frames if f.label is not None]


class Fitted(NamedTuple):
    """What a fit has made: a field, figures for its recipe, and the frames whose labels were used."""

    model: LearnedField
    figures: dict[str, Any]
    labelled: Sequence[PosedFrame] = ()


class Budget:
    """How long a fit may take, who follows it, and who may end it; it begins now.

    Wall-clock ``seconds`` include the last look at held-out rays; 0 = only ``steps`` count, and the other way round.
    ``looks``: over the whole budget. ``stopped``: called before every step; once it returns something true, the fit
    ends. Raises ConfigError: neither seconds nor steps.
    """

    def __init__(
        self,
        seconds: float,
        steps: int,
        looks: int = 1,
        on_progress: OnProgress | None = None,
        stopped: Callable[[], object] = bool,
    ) -> None:
        if seconds <= 0 and steps <= 0:
            raise ConfigError("a fit needs a budget: set seconds, steps, or both")
        self.seconds, self.steps, self.looks = seconds, steps, looks
        self.on_progress, self.stopped = on_progress, stopped
        self._began = time.monotonic()
        self._last_look_s = 0.0
        self._looked = 0
        self._given = 0.0

    @property
    def elapsed_s(self) -> float:
        """Since it began."""
        return time.monotonic() - self._began

    def used(self, step: int) -> float:
        """Fraction of the budget that is used after ``step`` steps; time for one more look is set aside."""
        left_for_steps = max(self.seconds - self._last_look_s, 1e-9) if self.seconds > 0 else 0.0
        return budget_fraction(step, self.elapsed_s, steps=self.steps, seconds=left_for_steps)

    def look_due(self, fraction: float) -> bool:
        """Whether it is time for the next look, which is then counted; at the end of the budget it always is."""
        if fraction * self.looks < self._looked + 1 and fraction < 1:
            return False
        self._looked = int(fraction * self.looks)
        return True

    @contextmanager
    def looking(self) -> Iterator[None]:
        """Round each look: the next one is expected to take as long."""
        began = time.monotonic()
        yield
        self._last_look_s = time.monotonic() - began

    def part(self, until: float, *, steps: int | None = None) -> "Budget":
        """The budget of the next part of a fit, which ends at a fraction of this one: its time, and its progress.
        A late part has a twentieth of the time until there at least. ``steps``: None = those of the whole."""
        first, self._given = self._given, until
        seconds = max(until * self.seconds - self.elapsed_s, 0.05 * until * self.seconds)

        def on_progress(progress: FitProgress) -> None:
            if self.on_progress is not None:
                self.on_progress(replace(progress, fraction=first + (until - first) * progress.fraction))

        return Budget(seconds, self.steps if steps is None else steps, self.looks, on_progress, self.stopped)


@dataclass(slots=True)
class HeldOut:
    """How a fit is judged while it runs, and the weights that were best."""

    look: Callable[[], tuple[float, float]]  # loss (infinite where nothing is held out) and accuracy of held-out rays
    state: Callable[[], State]  # a copy of the weights
    patience: int = 0  # looks without a better loss before the fit stops early; 0 = it does not
    patient_until: float = 0.0  # fraction of the budget before which looks do not count for that
    # Of the best weights so far
    loss: float = math.inf
    accuracy: float = math.nan
    step: int = 0
    best: State = field(default_factory=dict[str, torch.Tensor])

    def figures(self, steps: int) -> dict[str, Any]:
        """What a recipe says of a fit of so many steps."""
        best = {"best_step": self.step, "held_out_loss": self.loss, "held_out_accuracy": self.accuracy}
        return {"steps": steps} | best

    def judge(self, step: int) -> tuple[float, float, bool]:
        """Look, and keep the weights where they are better or nothing is held out: loss, accuracy, and whether."""
        loss, accuracy = self.look()
        better = loss < self.loss or not math.isfinite(self.loss)
        if better:
            self.loss, self.accuracy, self.step, self.best = loss, accuracy, step, self.state()
        return loss, accuracy, better


def fit(learn: Callable[[float], float | None], budget: Budget, held_out: HeldOut | None = None) -> int:
    """Learn until the budget is used; ``held_out`` then has the weights that were best. Returns the number of steps.

    A fit that is stopped ends after one more look. ``learn``: one step, at a fraction of the budget; returns its loss,
    None = there was nothing to learn from.
    """
    step, stale = 0, 0
    loss_there, accuracy = (math.nan, math.nan) if held_out is None else (held_out.loss, held_out.accuracy)
    while (fraction := budget.used(step)) < 1 and not budget.stopped():
        if held_out is not None and 0 < held_out.patience <= stale:
            break
        loss = learn(fraction)
        step += 1
        if loss is None:
            continue
        fraction = budget.used(step)
        better = False
        if held_out is not None and budget.look_due(fraction):
            with budget.looking():
                loss_there, accuracy, better = held_out.judge(step)
            stale = 0 if better or fraction < held_out.patient_until else stale + 1
        if budget.on_progress is not None:
            budget.on_progress(FitProgress(step, min(fraction, 1.0), loss, loss_there, accuracy, better))
    if held_out is not None and budget.stopped() and step > 0:  # what was learned since the last look
        held_out.judge(step)
    return step


def descend(optimiser: torch.optim.Optimizer, loss: torch.Tensor, clip: float = math.inf) -> float:
    """One step down a loss, with gradients of at most this norm; returns the loss."""
    optimiser.zero_grad()
    loss.backward()  # pyright: ignore[reportUnknownMemberType]
    if math.isfinite(clip):
        torch.nn.utils.clip_grad_norm_([p for group in optimiser.param_groups for p in group["params"]], clip)
    optimiser.step()
    return float(loss.detach())


def budget_fraction(step: int, elapsed_s: float, *, steps: int, seconds: float) -> float:
    """Fraction of a budget that is used, by steps or by time, whichever is further; a budget of 0 does not count."""
    by_steps = step / steps if steps > 0 else 0.0
    by_time = elapsed_s / seconds if seconds > 0 else 0.0
    return max(by_steps, by_time)


def held_out_blocks(height: int, width: int, fraction: float, generator: torch.Generator) -> torch.Tensor:
    """Mask (H, W) of blocks of an image that are held out."""
    rows, columns = -(-height // HELD_OUT_BLOCK), -(-width // HELD_OUT_BLOCK)
    blocks = torch.rand(rows, columns, generator=generator) < fraction
    return blocks.repeat_interleave(HELD_OUT_BLOCK, 0).repeat_interleave(HELD_OUT_BLOCK, 1)[:height, :width]


def cosine_rate(fraction: float, first: float, last: float) -> float:
    """Learning rate that falls from ``first`` to ``last`` along half a cosine."""
    return last + (first - last) * 0.5 * (1 + math.cos(math.pi * fraction))


def make_optimiser(model: LearnedField, learning_rate: float, weight_decay: float) -> torch.optim.AdamW:
    """AdamW over all parameters; scales, shifts and biases do not decay."""
    encoder = model.image_encoder
    part_of_id: dict[int, str] = {}
    if encoder is not None:
        part_of_id |= {id(p): ENCODER for p in encoder.parameters()}
        part_of_id |= {id(p): BACKBONE for backbone in encoder.backbones() for p in backbone.parameters()}
    groups = [
        {
            "params": [p for p in model.parameters() if part_of_id.get(id(p), REST) == part and (p.ndim > 1) == decays],
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
