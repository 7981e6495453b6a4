"""What a training run leaves to look at: its history as JSON lines, curves as a picture, TensorBoard's event files."""

from __future__ import annotations

# TensorBoard's writer is untyped, and not there where it is not installed.
# pyright: reportUnknownMemberType=false
import json
import os
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any, Self

from research.plots import Curve, Panel, cannot_draw, draw_panels
from semantic_mapper.files import open_unlinked, write_bytes
from semantic_mapper.log_events import get_logger
from semantic_mapper.plots import write_picture
from semantic_mapper.types import UInt8

HISTORY_FILE = "history.jsonl"
CURVES_FILE = "curves.png"
EVENTS_FOLDER = "tensorboard"

_NAMES = {
    "loss_total": "loss/total",
    "loss_semantic": "loss/semantic",
    "loss_colour": "loss/colour",
    "loss_depth": "loss/depth",
    "rate": "training/learning rate",
    "rooms": "training/rooms",
    "waited_s": "training/seconds waited for rooms",
    "miou": "validation/mIoU",
    "accuracy": "validation/accuracy",
    "blind_miou": "validation/mIoU without depth",
    "blind_accuracy": "validation/accuracy without depth",
}

_log = get_logger(__name__)


class TrainLog(AbstractContextManager["TrainLog"]):
    """Keeps the history and writes it to a folder as it grows.

    Two kinds of lines, both with ``step`` and ``seconds``: means of the losses over the last steps, with the learning
    rate, rooms rendered and time spent waiting for rooms; and the figures of a validation.

    Args:
        folder: None keeps the history in memory only.
        history: Lines from before; ``add`` appends to this very list.
    """

    def __init__(self, folder: Path | None, history: list[dict[str, Any]]) -> None:
        self._folder = folder
        self._history = history
        self._events = None if folder is None else _open_events(folder / EVENTS_FOLDER, history)
        if folder is not None and (reason := cannot_draw()):
            _log.info("no_curves_picture", reason=reason, mend=f"install it; {HISTORY_FILE} has all figures")
        if folder is not None:  # a run that goes on may have written further than its state reaches
            folder.mkdir(parents=True, exist_ok=True)
            lines = "".join(json.dumps(line, allow_nan=False) + "\n" for line in history)
            write_bytes(folder / HISTORY_FILE, lines.encode())

    def add(self, line: dict[str, Any]) -> None:
        """Append one line."""
        self._history.append(line)
        if self._folder is None:
            return
        with open(self._folder / HISTORY_FILE, "a", encoding="utf-8", opener=open_unlinked) as file:
            file.write(json.dumps(line, allow_nan=False) + "\n")
        if self._events is not None:
            for key, value in line.items():
                if key in _NAMES:
                    self._events.add_scalar(_NAMES[key], value, line["step"])

    def draw(self) -> None:
        """Draw the curves again."""
        if self._folder is not None and not cannot_draw():
            write_picture(self._folder / CURVES_FILE, draw_history(self._history))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.draw()
        if self._events is not None:
            self._events.close()


def draw_history(history: Sequence[dict[str, Any]]) -> UInt8:
    """Losses, validation mIoU and learning rate against steps, (H, W, 3) RGB."""
    losses = [_curve(history, f"loss_{name}", name) for name in ("total", "semantic", "colour", "depth")]
    scores = [_curve(history, "miou", "with depth", 100), _curve(history, "blind_miou", "without", 100)]
    panels = (
        ("loss", "loss", losses),
        ("validation", "mIoU, %", scores),
        ("learning rate", "learning rate", [_curve(history, "rate", "")]),
    )
    return draw_panels(
        "", [Panel(title, unit, "step", [c for c in curves if c.points]) for title, unit, curves in panels]
    )


def _curve(history: Sequence[dict[str, Any]], key: str, name: str, scale: float = 1.0) -> Curve:
    return Curve(name, [(line["step"], scale * line[key]) for line in history if key in line])


def _open_events(folder: Path, history: list[dict[str, Any]]) -> Any:
    """TensorBoard's writer."""
    from torch.utils.tensorboard import SummaryWriter  # 1 s

    purge = history[-1]["step"] + 1 if history else None
    return SummaryWriter(os.fspath(folder), purge_step=purge)
