"""Curves in panels with axes, and bars, drawn with numpy and OpenCV alone: no display, no plotting library."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from semantic_mapper.evaluation.canvas import (
    BACKGROUND,
    DIM_TEXT,
    GAP,
    MARGIN,
    PANEL,
    TEXT,
    draw_text,
    new_canvas,
    text_width,
)
from semantic_mapper.types import UInt8

_LEFT, _RIGHT, _TOP, _BOTTOM = 62, 16, 66, 40  # from a panel's edges to its axes
_X_TITLE = 20  # more at the bottom where the axis has a title
_WIDTH, _HEIGHT = 460, 320  # of each of several panels
_TITLE = 40  # of a picture of several panels
_GRID = (56, 61, 71)
_LETTERS = 13
_SUBPIXEL = 4  # bits
_COLORS = (
    (94, 180, 255),
    (255, 164, 92),
    (130, 214, 130),
    (222, 130, 214),
    (240, 214, 96),
    (96, 214, 206),
    (236, 112, 112),
)
_BAR, _BAR_GAP = 34, 18  # height of a bar, and what is between two
_BARS_WIDTH = 920


@dataclass(frozen=True, slots=True)
class Curve:
    """One line: name and points (x, y), x ascending; ``marked`` shows where each of them is."""

    name: str
    points: tuple[tuple[float, float], ...]
    marked: bool = False


@dataclass(frozen=True, slots=True)
class Panel:
    """Curves that share axes; ``title`` says what goes up, ``x_title`` what goes to the right."""

    title: str
    curves: tuple[Curve, ...]
    x_title: str = ""


def draw_panels(
    title: str, panels: Sequence[Panel], across: int = 3, size: tuple[int, int] = (_WIDTH, _HEIGHT)
) -> UInt8:
    """Panels of one size (width, height) beside and below each other, under a title if there is one, (h, w, 3) RGB."""
    wide, high = size
    down, top = -(-len(panels) // across), MARGIN + (_TITLE if title else 0)
    width = 2 * MARGIN + across * wide + (across - 1) * GAP
    picture = new_canvas(width, top + down * high + (down - 1) * GAP + MARGIN)
    draw_text(picture, title, (MARGIN, MARGIN), 18, TEXT)
    for number, panel in enumerate(panels):
        x = MARGIN + number % across * (wide + GAP)
        y = top + number // across * (high + GAP)
        draw_panel(picture[y : y + high, x : x + wide], panel.title, panel.curves, panel.x_title)
    return picture


@dataclass(frozen=True, slots=True)
class Bar:
    """A whole and its parts, from the left to the right; none below 0."""

    name: str
    parts: Mapping[str, float]


def draw_bars(title: str, bars: Sequence[Bar], x_title: str) -> UInt8:
    """Bars below each other, as (h, w, 3) RGB; equal names of parts have one colour, and wide ones their size in it."""
    plot_height = len(bars) * (_BAR + _BAR_GAP) + _BAR_GAP
    picture = new_canvas(2 * MARGIN + _BARS_WIDTH, 2 * MARGIN + _TOP + plot_height + _BOTTOM + _X_TITLE)
    panel = picture[MARGIN:-MARGIN, MARGIN:-MARGIN]
    panel[:] = PANEL
    left = 32 + max(text_width(bar.name, _LETTERS) for bar in bars)
    draw_text(panel, title, (left, 14), 16, TEXT)
    x_ticks = ticks(0.0, max(sum(bar.parts.values()) for bar in bars))
    box = (left, _TOP, _BARS_WIDTH - 4 * _RIGHT, _TOP + plot_height)
    axes = _Axes(box, (x_ticks[0], x_ticks[-1]), (0.0, 1.0))
    _draw_grid(panel, axes, x_ticks, ())
    _draw_x_title(panel, box, x_title)
    names = list(dict.fromkeys(name for bar in bars for name in bar.parts))
    colors = {name: _COLORS[number % len(_COLORS)] for number, name in enumerate(names)}
    _draw_names(panel, left, colors.items())
    for number, bar in enumerate(bars):
        _draw_bar(panel, axes, bar, _TOP + _BAR_GAP + number * (_BAR + _BAR_GAP), colors)
    return picture


def _draw_bar(panel: UInt8, axes: _Axes, bar: Bar, top: int, colors: Mapping[str, tuple[int, int, int]]) -> None:
    middle, total = top + (_BAR - _LETTERS) // 2, 0.0
    draw_text(panel, bar.name, (16, middle), _LETTERS, TEXT)
    for name, value in bar.parts.items():
        start, end = (round(axes.at(x, 0.0)[0]) for x in (total, total + value))
        panel[top : top + _BAR, start:end] = colors[name]
        size = f"{value:.0f}"
        if text_width(size, _LETTERS) + 8 <= end - start:
            draw_text(panel, size, ((start + end - text_width(size, _LETTERS)) // 2, middle), _LETTERS, BACKGROUND)
        total += value
    draw_text(panel, f"{total:.0f}", (round(axes.at(total, 0.0)[0]) + 8, middle), _LETTERS, TEXT)


def draw_panel(panel: UInt8, title: str, curves: Sequence[Curve], x_title: str = "") -> None:
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
    box = (_LEFT, _TOP, width - _RIGHT, height - _BOTTOM - (_X_TITLE if x_title else 0))
    place = _Axes(box, (x_ticks[0], x_ticks[-1]), (y_ticks[0], y_ticks[-1]))
    _draw_grid(panel, place, x_ticks, y_ticks)
    _draw_x_title(panel, box, x_title)
    colors = [_COLORS[number % len(_COLORS)] for number in range(len(curves))]
    _draw_names(panel, _LEFT, [(curve.name, color) for curve, color in zip(curves, colors, strict=True)])
    for curve, color in zip(curves, colors, strict=True):
        points = np.array([place.at(*p) for p in curve.points])
        fixed = (points * (1 << _SUBPIXEL)).round().astype(np.int32)[:, None]
        cv2.polylines(panel, [fixed], False, color, 2, cv2.LINE_AA, _SUBPIXEL)
        for point in fixed[:, 0] if curve.marked else fixed[-1:, 0]:
            cv2.circle(panel, tuple(int(v) for v in point), 3 << _SUBPIXEL, color, -1, cv2.LINE_AA, _SUBPIXEL)


def ticks(low: float, high: float, wanted: int = 5) -> list[float]:
    """About ``wanted`` round numbers, evenly spaced, from ``low`` or below to ``high`` or above (1 more, if equal)."""
    high = high if high > low else low + 1
    span = high - low
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


def _draw_names(panel: UInt8, x: int, names: Iterable[tuple[str, tuple[int, int, int]]]) -> None:
    """The legend; what has no name is not in it."""
    for name, color in names:
        if name:
            draw_text(panel, name, (x, 38), _LETTERS, color)
            x += text_width(name, _LETTERS) + 18


def _draw_x_title(panel: UInt8, box: tuple[int, int, int, int], title: str) -> None:
    if title:
        x = (box[0] + box[2] - text_width(title, _LETTERS)) // 2
        draw_text(panel, title, (x, panel.shape[0] - _X_TITLE - _LETTERS // 2), _LETTERS, TEXT)


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
