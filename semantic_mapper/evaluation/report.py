"""The overview picture of a run: views and their rendered semantics, the map from above and from an angle, legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import SemanticMapperError, ShapeError
from semantic_mapper.evaluation.canvas import (
    DIM_TEXT,
    GAP,
    MARGIN,
    PANEL,
    TEXT,
    UNKNOWN,
    draw_text,
    new_canvas,
    paste,
    shorten,
)
from semantic_mapper.evaluation.legend import draw_legend, legend_rows
from semantic_mapper.evaluation.splat import draw_points, from_above, from_angle, hides_the_room, open_side
from semantic_mapper.evaluation.upright import ceiling_height, upright_rotation
from semantic_mapper.files import write_bytes
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32, Float64, UInt8

WIDTH = 1600
MAP_HEIGHT = 620
LEGEND_WIDTH = 250
HEADER = 74
CAPTION = 26
MAX_POINTS = 2_000_000
ELEVATION = np.deg2rad(42)


class LabelledPoints(Protocol):
    """What is drawn of a map; ``MapPoints`` of the voxel map is one."""

    @property
    def xyz(self) -> Float32:
        """(N, 3) metres."""
        ...

    @property
    def rgb(self) -> UInt8:
        """(N, 3)."""
        ...

    @property
    def label(self) -> UInt8:
        """(N,) class ids."""
        ...

    @property
    def confidence(self) -> Float32:
        """(N,) of ``label``, in [0, 1]."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ViewStrip:
    """One frame of the run, a row of the picture. Images may differ in size; each is scaled to its tile.

    Args:
        name: Says which frame ("frame 120").
        rgb: (H, W, 3) uint8.
        rendered: (h, w) uint8 class ids; the ignore id is drawn grey.
        truth: (H, W) uint8 class ids, None where there are none.
        depth_m: (H, W) float32, 0 = none; None for a stream without depth.
        depth_rendered: The field rendered it; no sensor measured it.
    """

    name: str
    rgb: UInt8
    rendered: UInt8
    truth: UInt8 | None = None
    depth_m: Float32 | None = None
    depth_rendered: bool = False


def write_overview(
    path: Path,
    strips: Sequence[ViewStrip],
    points: LabelledPoints,
    label_set: LabelSet,
    *,
    title: str,
    subtitle: str = "",
    up: Float64 | None = None,
) -> None:
    """Write the picture of ``draw_overview`` as PNG.

    Raises:
        SemanticMapperError: the file cannot be written.
        ShapeError: see ``draw_overview``.
    """
    picture = draw_overview(strips, points, label_set, title=title, subtitle=subtitle, up=up)
    encoded, data = cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    if not encoded:
        raise SemanticMapperError(f"{path}: the picture could not be encoded as PNG")
    try:
        write_bytes(path, data.tobytes())
    except OSError as error:
        raise SemanticMapperError(f"{path}: cannot be written: {error.strerror or error}") from error


def draw_overview(
    strips: Sequence[ViewStrip],
    points: LabelledPoints,
    label_set: LabelSet,
    *,
    title: str,
    subtitle: str = "",
    up: Float64 | None = None,
) -> UInt8:
    """Draw a row of tiles for each strip, under them the map and the legend.

    Args:
        strips: Frames to show, best one to three.
        points: The map; N may be 0.
        label_set: Names and colours of all labels.
        title, subtitle: Head of the picture.
        up: (3,) rough up direction of the world frame (``upright.camera_up`` of the poses gives one); ``None``
            estimates it from the points alone.

    Returns:
        (H, 1600, 3) uint8 RGB.

    Raises:
        ShapeError: the arrays of ``points`` do not fit together.
    """
    _check(points)
    rows = [draw_strip(strip, label_set) for strip in strips]
    height = HEADER + sum(len(row) + GAP for row in rows) + CAPTION + MAP_HEIGHT + MARGIN
    canvas = new_canvas(WIDTH, height)
    draw_text(canvas, shorten(title, WIDTH - 2 * MARGIN, 24), (MARGIN, 16), 24, TEXT)
    draw_text(canvas, shorten(subtitle, WIDTH - 2 * MARGIN, 15), (MARGIN, 46), 15, DIM_TEXT)
    y = HEADER
    for row in rows:
        paste(canvas, row, (0, y))
        y += len(row) + GAP
    _draw_map(canvas, y, points, label_set, up)
    shown = [strip.rendered for strip in strips] + [strip.truth for strip in strips if strip.truth is not None]
    _draw_legend(canvas, y, points.label, shown, label_set)
    return canvas


def class_colors(label: UInt8, label_set: LabelSet) -> UInt8:
    """Colours (..., 3) of class ids (...), grey for the ignore id."""
    colors = label_set.colorize(label)
    colors[label == label_set.ignore_id] = UNKNOWN
    return colors


def _check(points: LabelledPoints) -> None:
    count = len(points.xyz)
    shapes = (points.xyz.shape, points.rgb.shape, points.label.shape, points.confidence.shape)
    if shapes != ((count, 3), (count, 3), (count,), (count,)):
        raise ShapeError(f"map points: expected xyz (N, 3), rgb (N, 3), label (N,), confidence (N,), got {shapes}")


def draw_strip(strip: ViewStrip, label_set: LabelSet) -> UInt8:
    """One frame as a row of tiles with captions, (h, 1600, 3)."""
    tiles = [(f"{strip.name}: camera", strip.rgb, cv2.INTER_AREA)]
    tiles.append(("rendered semantics", class_colors(strip.rendered, label_set), cv2.INTER_NEAREST))
    if strip.truth is not None:
        tiles.append(("truth", class_colors(strip.truth, label_set), cv2.INTER_NEAREST))
    if strip.depth_m is not None:
        caption, picture = _color_depth(strip.depth_m)
        tiles.append((f"rendered {caption}" if strip.depth_rendered else caption, picture, cv2.INTER_NEAREST))
    columns = max(len(tiles), 3)  # two tiles side by side would tower over the map
    tile_width = (WIDTH - 2 * MARGIN - (columns - 1) * GAP) // columns
    tile_height = round(tile_width * strip.rgb.shape[0] / strip.rgb.shape[1])
    row = new_canvas(WIDTH, CAPTION + tile_height)
    for column, (caption, picture, interpolation) in enumerate(tiles):
        x = MARGIN + column * (tile_width + GAP)
        draw_text(row, shorten(caption, tile_width, 15), (x, 4), 15, DIM_TEXT)
        scaled = cv2.resize(picture, (tile_width, tile_height), interpolation=interpolation)
        paste(row, np.asarray(scaled, np.uint8), (x, CAPTION))
    return row


def _color_depth(depth_m: Float32) -> tuple[str, UInt8]:
    known = np.isfinite(depth_m) & (depth_m > 0)
    if not known.any():
        return "depth: none", np.full((*depth_m.shape, 3), PANEL, np.uint8)
    near, far = np.percentile(depth_m[known], (1, 99))
    level = np.clip((depth_m - near) / max(far - near, 1e-3), 0, 1)
    gray = np.where(known, 255 * (1 - level), 0).astype(np.uint8)
    picture = cv2.cvtColor(cv2.applyColorMap(gray, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB).astype(np.uint8)
    picture[~known] = PANEL
    return f"depth: {near:.1f} m (red) to {far:.1f} m (blue)", picture


def _draw_map(canvas: UInt8, y: int, points: LabelledPoints, label_set: LabelSet, up: Float64 | None) -> None:
    width = (WIDTH - 2 * MARGIN - 2 * GAP - LEGEND_WIDTH) // 2
    size = (width, MAP_HEIGHT)
    step = max(1, -(-len(points.xyz) // MAX_POINTS))
    xyz, colors = points.xyz[::step], _point_colors(points, label_set)[::step]
    upright = xyz.astype(np.float64) @ upright_rotation(xyz, up).T
    inside = _without_ceiling(upright, points.label[::step], label_set)
    upright, colors = upright[inside], colors[inside]

    above, scale = draw_points(from_above(upright), colors, size, PANEL)
    _draw_scale_bar(above, scale)
    azimuth = open_side(upright, ELEVATION)
    seen = ~hides_the_room(upright, azimuth)
    angled, _ = draw_points(from_angle(upright[seen], azimuth, ELEVATION), colors[seen], size, PANEL)
    cut = "" if inside.all() else ", ceiling cut away"
    x = MARGIN
    for caption, picture in ((f"map from above{cut}", above), (f"map from an angle{cut}", angled)):
        draw_text(canvas, caption, (x, y + 4), 15, DIM_TEXT)
        paste(canvas, picture, (x, y + CAPTION))
        x += width + GAP


def _point_colors(points: LabelledPoints, label_set: LabelSet) -> UInt8:
    """Class colours; the camera's brightness shows through a little, and what is not sure is paler."""
    colors = class_colors(points.label, label_set).astype(np.float32)
    if not len(colors):
        return colors.astype(np.uint8)
    luma = points.rgb.astype(np.float32).mean(axis=1)
    colors *= np.clip(0.75 + 0.5 * luma / 255, 0.7, 1.15)[:, None]
    unsure = np.clip(1 - np.nan_to_num(points.confidence), 0, 1)[:, None] * 0.45
    return np.clip(colors * (1 - unsure) + 205 * unsure, 0, 255).astype(np.uint8)


def _without_ceiling(upright: Float64, label: UInt8, label_set: LabelSet) -> NDArray[np.bool_]:
    inside = np.ones(len(upright), np.bool_)
    cut = ceiling_height(upright)
    if cut is not None:
        inside &= upright[:, 2] < cut
    if "ceiling" in label_set.names:
        inside &= label != label_set.ids[label_set.names.index("ceiling")]
    return inside if inside.any() else ~inside


def _draw_scale_bar(picture: UInt8, scale: float) -> None:
    """A bar of 1 m (or of the power of ten that fits) in the lower left corner."""
    metres = 1.0
    while metres * scale > picture.shape[1] / 3:
        metres /= 10
    while metres * scale < 24:
        metres *= 10
    length, y = round(metres * scale), picture.shape[0] - 18
    corner = picture[y - 28 : y + 11, 8 : max(length, 40) + 26]  # points may lie here
    corner[:] = (corner * 0.25 + np.array(PANEL) * 0.75).astype(np.uint8)
    cv2.rectangle(picture, (16, y), (16 + length, y + 3), TEXT, -1)
    draw_text(picture, f"{metres:g} m", (16, y - 20), 14, TEXT)


def _draw_legend(canvas: UInt8, y: int, map_label: UInt8, shown: list[UInt8], label_set: LabelSet) -> None:
    """Classes of the map and of the pictures, with the share of the map's points."""
    x = WIDTH - MARGIN - LEGEND_WIDTH
    rows = legend_rows(map_label, label_set, tuple(shown))
    draw_text(canvas, "class, share of the map", (x, y + 4), 15, DIM_TEXT)
    top = y + CAPTION
    draw_legend(canvas, rows, (x, top), (LEGEND_WIDTH, MAP_HEIGHT - 30))
    draw_text(canvas, "paler in the map = less sure", (x, top + MAP_HEIGHT - 20), 13, DIM_TEXT)
