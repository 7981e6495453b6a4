"""Curves in a panel with axes, drawn with numpy and OpenCV alone: no display, no plotting library."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from semantic_mapper.evaluation.canvas import DIM_TEXT, PANEL, TEXT, draw_text, text_width
from semantic_mapper.types import UInt8

_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 16, 66, 40  # from a panel's edges to its axes
_GRID = (56, 61, 71)
_LETTERS = 13
_SUBPIXEL = 4  # bits
_COLORS = ((94, 180, 255), (255, 164, 92), (130, 214, 130), (222, 130, 214))


@dataclass(frozen=True, slots=True)
class Curve:
    """One line: name and points (x, y), x ascending; ``marked`` shows where each of them is."""

    name: str
    points: tuple[tuple[float, float], ...]
    marked: bool = False


def draw_panel(panel: UInt8, title: str, curves: Sequence[Curve]) -> None:
    """Draw curves with axes, ticks and their names into ``panel`` (h, w, 3), in place."""
    panel[:] = PANEL
    draw_text(panel, title, (_LEFT, 14), 16, TEXT)
    if not curves:
        draw_text(panel, "nothing yet", (_LEFT, 100), _LETTERS, DIM_TEXT)
        return
    xs = np.array([x for c in curves for x, _ in c.points])
    ys = np.array([y for c in curves for _, y in c.points])
    x_ticks, y_ticks = ticks(0.0, float(xs.max())), ticks(min(0.0, float(ys.min())), float(ys.max()))
    height, width = panel.shape[:2]
    box = (_LEFT, _TOP, width - _RIGHT, height - _BOTTOM)
    place = _Axes(box, (x_ticks[0], x_ticks[-1]), (y_ticks[0], y_ticks[-1]))
    _draw_grid(panel, place, x_ticks, y_ticks)
    x = _LEFT
    for number, curve in enumerate(curves):
        color = _COLORS[number % len(_COLORS)]
        points = np.array([place.at(*p) for p in curve.points])
        fixed = (points * (1 << _SUBPIXEL)).round().astype(np.int32)[:, None]
        cv2.polylines(panel, [fixed], False, color, 2, cv2.LINE_AA, _SUBPIXEL)
        for point in fixed[:, 0] if curve.marked else fixed[-1:, 0]:
            cv2.circle(panel, tuple(int(v) for v in point), 3 << _SUBPIXEL, color, -1, cv2.LINE_AA, _SUBPIXEL)
        if curve.name:
            draw_text(panel, curve.name, (x, 38), _LETTERS, color)
            x += text_width(curve.name, _LETTERS) + 18


def ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """About ``wanted`` round numbers, evenly spaced, from at most ``low`` to at least ``high``."""
    span = max(high - low, 1e-12)
    rough = span / wanted
    base = 10.0 ** math.floor(math.log10(rough))
    step = next(m * base for m in (1, 2, 2.5, 5, 10) if m * base >= rough * 0.999)
    first = math.floor(low / step + 1e-9)
    last = max(math.ceil(high / step - 1e-9), first + 1)
    return [k * step for k in range(first, last + 1)]


@dataclass(frozen=True, slots=True)
class _Axes:
    box: tuple[int, int, int, int]  # left, top, right, bottom
    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Pixel of a point."""
        left, top, right, bottom = self.box
        across = (x - self.x[0]) / (self.x[1] - self.x[0])
        up = (y - self.y[0]) / (self.y[1] - self.y[0])
        return left + across * (right - left), bottom - up * (bottom - top)


def _draw_grid(panel: UInt8, axes: _Axes, x_ticks: Sequence[float], y_ticks: Sequence[float]) -> None:
    left, top, right, bottom = axes.box
    for value in y_ticks:
        y = round(axes.at(axes.x[0], value)[1])
        cv2.line(panel, (left, y), (right, y), _GRID, 1)
        name = f"{value:g}"
        draw_text(panel, name, (left - 8 - text_width(name, _LETTERS), y - _LETTERS // 2), _LETTERS, DIM_TEXT)
    for value in x_ticks:
        x = round(axes.at(value, axes.y[0])[0])
        cv2.line(panel, (x, top), (x, bottom), _GRID, 1)
        name = f"{value / 1000:g}k" if value >= 10_000 else f"{value:g}"
        draw_text(panel, name, (x - text_width(name, _LETTERS) // 2, bottom + 10), _LETTERS, DIM_TEXT)
