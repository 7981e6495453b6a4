"""The picture of a comparison: both maps from above, where classes, surface and blocks differ, and the fields."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.evaluation.splat import draw_points, from_above
from semantic_mapper.evaluation.upright import ceiling_height, plan_rotation
from semantic_mapper.mapping.files.up_axis import find_up
from semantic_mapper.plots import (
    DIM_TEXT,
    PANEL,
    SMALL_PT,
    TEXT,
    TITLE_PT,
    class_colors,
    cut,
    new_figure,
    place,
    put_picture,
    put_text,
    rendered,
    text_width,
)
from semantic_mapper.replay.compare.runs import Comparison, Run
from semantic_mapper.replay.compare.surface_match import SurfaceMatch
from semantic_mapper.types import Float32, Float64, UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, MARGIN, GAP = 1600, 24, 14
COLUMN = (WIDTH - 2 * MARGIN - 2 * GAP) // 3
PANEL_HEIGHT = 420
HEADER, CAPTION = 74, 26
LINE = 20  # of the table
ONLY_A, ONLY_B = (240, 96, 72), (72, 150, 240)
MOVED, RELABELLED = (246, 204, 70), (236, 84, 204)
WITHIN = (110, 200, 120)


@rendered
def draw_comparison(comparison: Comparison) -> Figure:
    """Draw two rows of three: classes of A, of B, where they differ; surface, blocks, and the table of fields.

    Plans look from above through the whole height of the maps up to the ceiling: what differs under a table is seen.
    """
    plan = _make_plan(comparison)
    table_height = (len(comparison.fields) + len(comparison.label_changes) + 4) * LINE
    top = HEADER + CAPTION + PANEL_HEIGHT + GAP + CAPTION
    figure = new_figure(WIDTH, top + max(PANEL_HEIGHT, table_height) + MARGIN)
    head = place(figure, (MARGIN, 0, WIDTH - 2 * MARGIN, HEADER))
    for y, name, run, color in ((24, "A", comparison.a, ONLY_A), (52, "B", comparison.b, ONLY_B)):
        text = cut(f"{name}: {run.name}", WIDTH - 2 * MARGIN, TITLE_PT, "bold")
        put_text(head, (0, y), text, color=color, fontsize=TITLE_PT, weight="bold")
    mine, theirs = comparison.surfaces
    blocks = "blocks: red A alone, blue B alone" if comparison.blocks else "blocks: of other sizes"
    panels = [
        ("classes of A", _classes(mine, plan)),
        ("classes of B", _classes(theirs, plan)),
        ("common surface with another class: pink", _labels_plan(comparison, plan)),
        ("surface: red A alone, blue B alone, yellow moved", _surface_plan(comparison, plan)),
        (blocks, _blocks_plan(comparison, plan)),
    ]
    for number, (caption, picture) in enumerate(panels):
        x, y = MARGIN + number % 3 * (COLUMN + GAP), (HEADER + CAPTION, top)[number // 3]
        put_picture(figure, (x, y, COLUMN, PANEL_HEIGHT), picture, caption)
    _put_table(figure, comparison, (MARGIN + 2 * (COLUMN + GAP), top - CAPTION, COLUMN, table_height))
    return figure


@dataclass(frozen=True, slots=True, eq=False)
class _Plan:
    """How points come onto a plan: turned as an exported floor plan, without ceiling, moved and scaled to pixels."""

    R_plan_world: Float64
    ceiling_m: float
    centre: Float64
    scale: float

    def upright(self, xyz: Float32 | Float64) -> tuple[Float64, NDArray[np.bool_]]:
        """Points (N, 3) with z up, and which of them lie below the ceiling."""
        turned = xyz.astype(np.float64) @ self.R_plan_world.T
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
    R = plan_rotation(xyz, _find_up(comparison.surfaces[0]))
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
    if (blocks := comparison.blocks) is not None:
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
    fraction = np.clip(strength, 0, 1)[..., None]
    return (image * (1 - fraction) + np.array(color, np.float32) * fraction).astype(np.float32)


def _put_table(figure: Figure, comparison: Comparison, box: tuple[int, int, int, int]) -> None:
    """The fields, their values right-aligned, and below them which classes have become which."""
    axes = place(figure, box)
    rows = [(("", "A", "B", "difference", "allowed"), DIM_TEXT)]
    rows += [((f.title, *f.texts()), TEXT if f.within else ONLY_A) for f in comparison.fields]
    widths = [max(text_width(row[i], SMALL_PT) for row, _ in rows) + 14 for i in range(1, 5)]
    ends = [COLUMN - sum(widths[i:]) for i in range(1, 5)]
    verdict, color = ("equal", WITHIN) if comparison.equal else ("differs", ONLY_A)
    put_text(axes, (0, 15), verdict, color=color, weight="bold")
    for number, ((title, *texts), color) in enumerate(rows):
        y = 15 + number * LINE
        put_text(axes, (0, y), cut(title, ends[0] - widths[0], SMALL_PT), color=color, fontsize=SMALL_PT)
        for end, text in zip(ends, texts, strict=True):
            put_text(axes, (end, y), text, color=color, fontsize=SMALL_PT, ha="right")
    changes = [("classes of A", "of B", "points")] if comparison.label_changes else []
    changes += [(mine, theirs, f"{count:,}") for mine, theirs, count in comparison.label_changes]
    for number, texts in enumerate(changes, len(rows) + 1):
        color = TEXT if number > len(rows) + 1 else DIM_TEXT
        for x, text in zip((0, 170, 340), texts, strict=True):
            put_text(axes, (x, 15 + number * LINE), cut(text, 160, SMALL_PT), color=color, fontsize=SMALL_PT)
