"""The curves of a training run as one picture."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2

from semantic_mapper.evaluation.canvas import GAP, MARGIN, new_canvas
from semantic_mapper.evaluation.plot import Curve, draw_panel

PANEL_WIDTH, PANEL_HEIGHT = 460, 320


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
    picture = new_canvas(2 * MARGIN + 3 * PANEL_WIDTH + 2 * GAP, 2 * MARGIN + PANEL_HEIGHT)
    for number, (title, curves) in enumerate(panels):
        x = MARGIN + number * (PANEL_WIDTH + GAP)
        draw_panel(picture[MARGIN : MARGIN + PANEL_HEIGHT, x : x + PANEL_WIDTH], title, [c for c in curves if c.points])
    part = path.with_name("part." + path.name)
    cv2.imwrite(os.fspath(part), picture[..., ::-1])
    os.replace(part, path)


def _curve(history: Sequence[dict[str, Any]], key: str, name: str, scale: float = 1.0) -> Curve:
    return Curve(name, tuple((float(line["step"]), scale * float(line[key])) for line in history if key in line))
