"""Paths seen from above, at one scale both ways, drawn with numpy and OpenCV alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from semantic_mapper.evaluation.canvas import DIM_TEXT, MARGIN, PANEL, TEXT, draw_text, new_canvas, text_width
from semantic_mapper.evaluation.plot import ticks
from semantic_mapper.types import Float64, UInt8

_WIDTH, _HEIGHT = 900, 760
_HEAD, _FOOT, _SIDE = 76, 36, 56
_GRID = (56, 61, 71)
_COLORS = ((130, 214, 130), (255, 164, 92), (94, 180, 255), (222, 130, 214))
_SUBPIXEL = 4  # bits


def draw_top_view(title: str, paths: Mapping[str, Float64], up: Float64) -> UInt8:
    """Paths from above as (H, W, 3) RGB; a dot marks where each begins. Axes in metres.

    Args:
        title: Above the picture.
        paths: Positions (N, 3) by name, all in one world; rows of NaN are gaps.
        up: (3,) in that world.
    """
    picture = new_canvas(_WIDTH, _HEIGHT)
    picture[_HEAD:-_FOOT, _SIDE:-MARGIN] = PANEL
    draw_text(picture, title, (MARGIN, 16), 18, TEXT)
    across, back = _ground_axes(np.concatenate(list(paths.values())), up)
    flat = {name: np.stack((xyz @ across, xyz @ back), axis=1) for name, xyz in paths.items()}
    axes = _fitted_axes(np.concatenate(list(flat.values())))
    _draw_grid(picture, axes)
    x = MARGIN
    for (name, points), color in zip(flat.items(), _COLORS, strict=False):
        _draw_path(picture, axes.at(points), color)
        draw_text(picture, name, (x, 46), 14, color)
        x += text_width(name, 14) + 24
    return picture


@dataclass(frozen=True, slots=True)
class _Axes:
    """Ground (x, y) in metres -> pixels; the same scale both ways, y up."""

    center: Float64
    scale: float  # pixels a metre
    middle: Float64  # pixel of the center

    def at(self, xy: Float64) -> Float64:
        return self.middle + (xy - self.center) * self.scale * np.array((1.0, -1.0))


def _fitted_axes(points: Float64) -> _Axes:
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    box = np.array((_WIDTH - _SIDE - MARGIN, _HEIGHT - _HEAD - _FOOT), np.float64)
    scale = float((0.9 * box / np.maximum(high - low, 1e-3)).min())
    return _Axes((low + high) / 2, scale, np.array((_SIDE, _HEAD)) + box / 2)


def _ground_axes(xyz: Float64, up: Float64) -> tuple[Float64, Float64]:
    """Two axes square to ``up``: the longest way of the points to the right, the other one up the picture."""
    up = up / np.linalg.norm(up)
    known = xyz[np.isfinite(xyz).all(axis=1)]
    level = known - known.mean(axis=0)
    level = level - np.outer(level @ up, up)
    across: Float64 = np.asarray(np.linalg.svd(level, full_matrices=False)[2][0], np.float64)
    across = across - (across @ up) * up
    across = across / np.linalg.norm(across)
    return across, np.cross(up, across)


def _draw_grid(picture: UInt8, axes: _Axes) -> None:
    """Lines at round metres, named at the left and below."""
    half = np.array((_WIDTH - _SIDE - MARGIN, _HEIGHT - _HEAD - _FOOT)) / axes.scale / 2
    low, high = axes.center - half, axes.center + half
    step = np.diff(ticks(0.0, float(high.max() - low.max()), 8)[:2])[0]
    for value in np.arange(np.ceil(low[0] / step), np.floor(high[0] / step) + 1) * step:
        x = round(float(axes.at(np.array((value, 0.0)))[0]))
        cv2.line(picture, (x, _HEAD), (x, _HEIGHT - _FOOT - 1), _GRID, 1)
        draw_text(picture, f"{value:g}", (x - text_width(f"{value:g}", 13) // 2, _HEIGHT - _FOOT + 10), 13, DIM_TEXT)
    for value in np.arange(np.ceil(low[1] / step), np.floor(high[1] / step) + 1) * step:
        y = round(float(axes.at(np.array((0.0, value)))[1]))
        cv2.line(picture, (_SIDE, y), (_WIDTH - MARGIN - 1, y), _GRID, 1)
        draw_text(picture, f"{value:g}", (_SIDE - 8 - text_width(f"{value:g}", 13), y - 6), 13, DIM_TEXT)


def _draw_path(picture: UInt8, pixels: Float64, color: tuple[int, int, int]) -> None:
    known: list[bool] = [bool(row.all()) for row in np.isfinite(pixels)]
    fixed = [(round(x), round(y)) for x, y in np.nan_to_num(pixels * (1 << _SUBPIXEL)).tolist()]
    for number in range(1, len(fixed)):
        if known[number - 1] and known[number]:
            cv2.line(picture, fixed[number - 1], fixed[number], color, 2, cv2.LINE_AA, _SUBPIXEL)
    if True in known:
        cv2.circle(picture, fixed[known.index(True)], 5 << _SUBPIXEL, color, -1, cv2.LINE_AA, _SUBPIXEL)
