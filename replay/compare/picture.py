"""The picture of a comparison: both maps from above, where classes, surface and blocks differ, and the fields."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.evaluation.canvas import (
    DIM_TEXT,
    GAP,
    MARGIN,
    PANEL,
    TEXT,
    draw_text,
    new_canvas,
    paste,
    shorten,
    text_width,
)
from semantic_mapper.evaluation.report import class_colors
from semantic_mapper.evaluation.splat import draw_points, from_above
from semantic_mapper.evaluation.upright import ceiling_height, upright_rotation
from semantic_mapper.mapping.files.up_axis import find_up
from semantic_mapper.replay.compare.runs import Comparison
from semantic_mapper.replay.compare.surface_match import SurfaceMatch
from semantic_mapper.replay.run_folder import Run
from semantic_mapper.types import Float32, Float64, UInt8

WIDTH = 1600
COLUMN = (WIDTH - 2 * MARGIN - 2 * GAP) // 3
PANEL_HEIGHT = 420
HEADER = 74
CAPTION = 26
LINE = 18  # of the table
HEAD_TEXT, ROW_TEXT = 14, 13
COLUMN_GAP = 12
ONLY_A = (240, 96, 72)
ONLY_B = (72, 150, 240)
MOVED = (246, 204, 70)
RELABELLED = (236, 84, 204)
WITHIN = (110, 200, 120)


def draw_comparison(comparison: Comparison) -> UInt8:
    """Draw two rows of three: classes of A, of B, where they differ; surface, blocks, and the table of fields.

    Plans look from above through the whole height of the maps up to the ceiling: what differs under a table is seen.

    Returns:
        (H, 1600, 3) uint8 RGB.
    """
    plan = _make_plan(comparison)
    table_height = (len(comparison.fields) + 1) * LINE + len(comparison.label_changes) * LINE + 2 * LINE
    lower = max(PANEL_HEIGHT, table_height)
    canvas = new_canvas(WIDTH, HEADER + 2 * CAPTION + PANEL_HEIGHT + GAP + lower + MARGIN)
    wide = WIDTH - 2 * MARGIN
    draw_text(canvas, shorten(f"A: {comparison.a.name}", wide, 20), (MARGIN, 14), 20, ONLY_A)
    draw_text(canvas, shorten(f"B: {comparison.b.name}", wide, 20), (MARGIN, 42), 20, ONLY_B)
    mine, theirs = comparison.surfaces
    panels = [
        ("classes of A", _classes(mine, plan)),
        ("classes of B", _classes(theirs, plan)),
        ("common surface with another class: pink", _labels_plan(comparison, plan)),
        ("surface: red A alone, blue B alone, yellow moved", _surface_plan(comparison, plan)),
        ("blocks: red A alone, blue B alone", _blocks_plan(comparison, plan)),
    ]
    for number, (caption, picture) in enumerate(panels):
        x = MARGIN + number % 3 * (COLUMN + GAP)
        y = HEADER + number // 3 * (CAPTION + PANEL_HEIGHT + GAP)
        draw_text(canvas, shorten(caption, COLUMN, 15), (x, y + 4), 15, DIM_TEXT)
        paste(canvas, picture, (x, y + CAPTION))
    _draw_table(canvas, comparison, MARGIN + 2 * (COLUMN + GAP), HEADER + CAPTION + PANEL_HEIGHT + GAP)
    return canvas


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """How world points come onto a plan: turned upright, cut below the ceiling, moved and scaled to its pixels."""

    R_upright_world: Float64
    ceiling_m: float
    centre: Float64
    scale: float

    def upright(self, xyz: Float32 | Float64) -> tuple[Float64, NDArray[np.bool_]]:
        """Points (N, 3) with z up, and which of them lie below the ceiling."""
        turned = xyz.astype(np.float64) @ self.R_upright_world.T
        return turned, turned[:, 2] < self.ceiling_m

    def raster(self, xyz: Float32 | Float64, values: Float32, side_m: float) -> Float32:
        """The largest value (N,) at each pixel, 0 without any; points are squares of ``side_m``."""
        image = np.zeros((PANEL_HEIGHT, COLUMN), np.float32)
        turned, below = self.upright(xyz)
        pixel = np.floor((turned[below, :2] - self.centre) * (self.scale, -self.scale) + (COLUMN / 2, PANEL_HEIGHT / 2))
        column, row = pixel.astype(np.int64).T
        inside = (column >= 0) & (column < COLUMN) & (row >= 0) & (row < PANEL_HEIGHT)
        np.maximum.at(image, (row[inside], column[inside]), values[below][inside])
        side = max(1, round(side_m * self.scale))
        return np.asarray(cv2.dilate(image, np.ones((side, side), np.uint8)), np.float32)


def _make_plan(comparison: Comparison) -> _Plan:
    xyz = np.concatenate([surface.points.xyz for surface in comparison.surfaces])
    R = upright_rotation(xyz, _find_up(comparison.surfaces[0]))
    upright = xyz.astype(np.float64) @ R.T
    ceiling = ceiling_height(upright)
    if not len(upright):
        return _Plan(R, np.inf, np.zeros(2), 1.0)
    low, high = upright[:, :2].min(axis=0), upright[:, :2].max(axis=0)
    extent = np.maximum(high - low, 0.1) * 1.06
    scale = float(min(COLUMN / extent[0], PANEL_HEIGHT / extent[1]))
    return _Plan(R, np.inf if ceiling is None else ceiling, (low + high) / 2, scale)


def _find_up(surface: SurfaceMatch) -> Float64 | None:
    try:
        return find_up(surface.points, surface.label_set)
    except MapError:  # no floor: the picture stands as the points alone make likely
        return None


def _classes(surface: SurfaceMatch, plan: _Plan) -> UInt8:
    upright, below = plan.upright(surface.points.xyz)
    colors = class_colors(surface.points.label, surface.label_set)
    camera = plan.centre * (1.0, -1.0), plan.scale  # of both maps, as in all plans
    picture, _ = draw_points(from_above(upright[below]), colors[below], (COLUMN, PANEL_HEIGHT), PANEL, camera=camera)
    return picture


def _ground(comparison: Comparison, plan: _Plan) -> Float32:
    """What both maps show, dim: the more points above a place, the brighter, so that walls stand out."""
    image = np.zeros((PANEL_HEIGHT, COLUMN, 3), np.float32) + np.array(PANEL, np.float32)
    for surface, run in zip(comparison.surfaces, (comparison.a, comparison.b), strict=True):
        upright, _ = plan.upright(surface.points.xyz)
        low, high = (upright[:, 2].min(), upright[:, 2].max()) if len(upright) else (0.0, 1.0)
        height = 0.5 + 0.5 * (upright[:, 2] - low) / max(high - low, 0.1)
        level = plan.raster(surface.points.xyz, height.astype(np.float32), run.voxel_map.config.voxel_size_m)
        image = np.maximum(image, 120 * level[..., None])
    return image


def _labels_plan(comparison: Comparison, plan: _Plan) -> UInt8:
    image = _ground(comparison, plan)
    for surface, run in zip(comparison.surfaces, (comparison.a, comparison.b), strict=True):
        image = _paint(image, plan, surface, surface.relabelled.astype(np.float32), RELABELLED, _voxel(run))
    return image.astype(np.uint8)


def _surface_plan(comparison: Comparison, plan: _Plan) -> UInt8:
    image = _ground(comparison, plan)
    both = (comparison.a, comparison.b)
    common_m = max(_voxel(run) for run in both)
    for surface, run in zip(comparison.surfaces, both, strict=True):
        moved = np.where(surface.common, surface.distance_m / common_m, 0).astype(np.float32)
        image = _paint(image, plan, surface, moved, MOVED, _voxel(run))
    for surface, run, color in zip(comparison.surfaces, both, (ONLY_A, ONLY_B), strict=True):
        image = _paint(image, plan, surface, (~surface.common).astype(np.float32), color, _voxel(run))
    return image.astype(np.uint8)


def _blocks_plan(comparison: Comparison, plan: _Plan) -> UInt8:
    image = _ground(comparison, plan)
    blocks = comparison.blocks
    if blocks is None:
        picture = image.astype(np.uint8)
        draw_text(picture, "voxels of other sizes", (16, 16), 16, TEXT)
        return picture
    for keys, color in ((blocks.only_a, ONLY_A), (blocks.only_b, ONLY_B)):
        xyz = (keys + 0.5) * blocks.side_m
        image = _blend(image, plan.raster(xyz, np.ones(len(xyz), np.float32), blocks.side_m), color)
    return image.astype(np.uint8)


def _voxel(run: Run) -> float:
    return run.voxel_map.config.voxel_size_m


def _paint(
    image: Float32, plan: _Plan, surface: SurfaceMatch, strength: Float32, color: tuple[int, int, int], side_m: float
) -> Float32:
    """Blend a colour over the picture where points (N,) have a strength of 0..1."""
    chosen = strength > 0
    return _blend(image, plan.raster(surface.points.xyz[chosen], strength[chosen], side_m), color)


def _blend(image: Float32, strength: Float32, color: tuple[int, int, int]) -> Float32:
    share = np.clip(strength, 0, 1)[..., None]
    return (image * (1 - share) + np.array(color, np.float32) * share).astype(np.float32)


def _draw_table(canvas: UInt8, comparison: Comparison, x: int, y: int) -> None:
    verdict, color = ("equal", WITHIN) if comparison.equal else ("differs", ONLY_A)
    head = (verdict, "A", "B", "difference", "allowed")
    rows = [(field.title, *field.texts()) for field in comparison.fields]
    starts = table_columns([head, *rows])
    for text, start in zip(head, starts, strict=True):
        draw_text(canvas, text, (x + start, y + 4), HEAD_TEXT, color if text == verdict else DIM_TEXT)
    y += CAPTION
    for field, (title, *texts) in zip(comparison.fields, rows, strict=True):
        shown = (shorten(title, starts[1] - COLUMN_GAP, ROW_TEXT), *texts)
        for text, start in zip(shown, starts, strict=True):
            draw_text(canvas, text, (x + start, y), ROW_TEXT, TEXT if field.within else ONLY_A)
        y += LINE
    if comparison.label_changes:
        draw_text(canvas, "classes: A, B, points of A", (x, y + LINE // 2), 13, DIM_TEXT)
        y += LINE + LINE // 2
    for mine, theirs, count in comparison.label_changes:
        for text, at in zip((mine, theirs, f"{count:,}"), (x, x + 150, x + 300), strict=True):
            draw_text(canvas, shorten(text, 140, 13), (at, y), 13, TEXT)
        y += LINE


def table_columns(rows: Sequence[Sequence[str]]) -> list[int]:
    """Where the columns of a table begin, pixels from its left: each as wide as its widest text, the first the rest."""
    widths = [max(text_width(text, HEAD_TEXT) for text in column) for column in list(zip(*rows, strict=True))[1:]]
    ends = accumulate(reversed(widths), lambda total, width: total + COLUMN_GAP + width)
    return [0, *reversed([COLUMN - end for end in ends])]
