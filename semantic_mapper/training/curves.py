"""The curves of a training run as one picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from semantic_mapper.evaluation.plot import Curve, Panel, draw_panels
from semantic_mapper.evaluation.sheet import write_picture


def write_curves(history: Sequence[dict[str, Any]], path: Path) -> None:
    """Draw losses, validation mIoU and learning rate against steps into a PNG, whole or not at all."""
    losses = ("loss_total", "loss_semantic", "loss_colour", "loss_depth")
    panels = (
        ("loss", [_curve(history, key, key.removeprefix("loss_")) for key in losses]),
        (
            "validation mIoU, %",
            [_curve(history, "miou", "with depth", 100), _curve(history, "blind_miou", "without", 100)],
        ),
        ("learning rate", [_curve(history, "rate", "")]),
    )
    drawn = [Panel(title, tuple(c for c in curves if c.points), "step") for title, curves in panels]
    write_picture(path, draw_panels("", drawn))


def _curve(history: Sequence[dict[str, Any]], key: str, name: str, scale: float = 1.0) -> Curve:
    return Curve(name, tuple((float(line["step"]), scale * float(line[key])) for line in history if key in line))
