"""The overview picture of a run: views and their rendered semantics, the map from above and from an angle, legend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ShapeError
from semantic_mapper.evaluation.splat import draw_points, fitted, from_above, from_angle, hides_the_room, open_side
from semantic_mapper.evaluation.upright import ceiling_height, plan_rotation, upright_rotation
from semantic_mapper.labels import LabelSet
from semantic_mapper.plots import (
    DIM_TEXT,
    PANEL,
    class_colors,
    class_rows,
    new_figure,
    place,
    put_legend,
    put_picture,
    put_text,
    put_title,
    rendered,
)
from semantic_mapper.types import Bool, Float32, Float64, UInt8

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, MARGIN, GAP = 1600, 24, 14
HEADER, CAPTION = 74, 26
MAP_HEIGHT = 620
LEGEND_WIDTH = 250
MAX_POINTS = 2_000_000
ELEVATION = float(np.deg2rad(42))
STRIPES, STRIPE_LIGHT = 40, 0.45  # across computed surface: how many, and how bright


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

    @property
    def measured(self) -> Bool | None:
        """(N,), False where no sensor measured the surface; None = unknown."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class ViewStrip:
    """One frame of the run, a row of the picture. Images may differ in size; each is scaled to its tile.

    Args:
        name: Says which frame ("frame 120").
        rgb: (H, W, 3) uint8.
        rendered: (h, w) uint8 class ids; the ignore id is drawn grey.
        truth: (H, W) uint8 class ids, None where they are missing.
        depth_m: (H, W) float32, 0 = none; None for a stream without depth.
        depth_rendered: The field rendered it; no sensor measured it.
    """

    name: str
    rgb: UInt8
    rendered: UInt8
    truth: UInt8 | None = None
    depth_m: Float32 | None = None
    depth_rendered: bool = False


@rendered
def draw_overview(
    strips: Sequence[ViewStrip],
    points: LabelledPoints,
    label_set: LabelSet,
    *,
    title: str,
    subtitle: str = "",
    up: Float64 | None = None,
    unit: str = "m",
    rooms: Sequence[tuple[str, Float64]] = (),
) -> Figure:
    """Draw a row of tiles for each strip, under them the map and the legend, 1600 pixels wide.

    Args:
        strips: Frames to show, best one to three.
        points: The map; N may be 0.
        label_set: Names and colours of all labels.
        title, subtitle: Head of the picture.
        up: (3,) rough up direction of the world frame (``upright.camera_up`` of the poses gives one); ``None``
            estimates it from the points alone.
        unit: Of lengths.
        rooms: Name and outline (N, 3) in the world of each room, drawn into the map from above.

    Raises:
        ShapeError: the arrays of ``points`` do not fit together.
    """
    _check(points)
    top = HEADER + sum(_strip_height(strip) + GAP for strip in strips)
    figure = new_figure(WIDTH, top + CAPTION + MAP_HEIGHT + MARGIN)
    put_title(figure, title, subtitle)
    y = HEADER
    for strip in strips:
        _put_strip(figure, y, strip, label_set, unit)
        y += _strip_height(strip) + GAP
    _put_map(figure, top + CAPTION, points, label_set, up, unit, rooms)
    shown = [image for strip in strips for image in (strip.rendered, strip.truth) if image is not None]
    legend = place(figure, (WIDTH - MARGIN - LEGEND_WIDTH, top + CAPTION, LEGEND_WIDTH, MAP_HEIGHT))
    put_text(legend, (0, -11), "class, fraction of the map", color=DIM_TEXT)
    hints = ["paler in the map = less sure"]
    if points.measured is not None and not points.measured.all():
        share = f"{100 * (1 - points.measured.mean()):.0f} %"
        hints.append(f"striped = computed: {share}" if points.measured.any() else "all of it computed, no sensor")
    for row, hint in enumerate(reversed(hints)):
        put_text(legend, (0, MAP_HEIGHT - 10 - 20 * row), hint, color=DIM_TEXT)
    box = (WIDTH - MARGIN - LEGEND_WIDTH, top + CAPTION, LEGEND_WIDTH, MAP_HEIGHT - 10 - 20 * len(hints))
    put_legend(figure, box, class_rows(points.label, label_set, shown))
    return figure


@rendered
def draw_strip(strip: ViewStrip, label_set: LabelSet, unit: str = "m") -> Figure:
    """One frame as a row of tiles with captions, 1600 pixels wide."""
    figure = new_figure(WIDTH, _strip_height(strip))
    _put_strip(figure, 0, strip, label_set, unit)
    return figure


def _tile_size(strip: ViewStrip) -> tuple[int, int]:
    tiles = 2 + (strip.truth is not None) + (strip.depth_m is not None)
    columns = max(tiles, 3)  # two tiles side by side would tower over the map
    width = (WIDTH - 2 * MARGIN - (columns - 1) * GAP) // columns
    return width, round(width * strip.rgb.shape[0] / strip.rgb.shape[1])


def _strip_height(strip: ViewStrip) -> int:
    return CAPTION + _tile_size(strip)[1]


def _put_strip(figure: Figure, y: int, strip: ViewStrip, label_set: LabelSet, unit: str) -> None:
    tiles = [(f"{strip.name}: camera", strip.rgb), ("rendered semantics", class_colors(strip.rendered, label_set))]
    if strip.truth is not None:
        tiles.append(("truth", class_colors(strip.truth, label_set)))
    if strip.depth_m is not None:
        caption, picture = _color_depth(strip.depth_m, unit)
        tiles.append((f"rendered {caption}" if strip.depth_rendered else caption, picture))
    width, height = _tile_size(strip)
    for column, (caption, picture) in enumerate(tiles):
        box = (MARGIN + column * (width + GAP), y + CAPTION, width, height)
        put_picture(figure, box, picture, caption, smooth=column == 0)


def _check(points: LabelledPoints) -> None:
    count = len(points.xyz)
    shapes = (points.xyz.shape, points.rgb.shape, points.label.shape, points.confidence.shape)
    if shapes != ((count, 3), (count, 3), (count,), (count,)):
        raise ShapeError(f"map points: expected xyz (N, 3), rgb (N, 3), label (N,), confidence (N,), got {shapes}")


def _color_depth(depth_m: Float32, unit: str) -> tuple[str, UInt8]:
    known = np.isfinite(depth_m) & (depth_m > 0)
    if not known.any():
        return "depth: none", np.full((*depth_m.shape, 3), PANEL, np.uint8)
    near, far = np.percentile(depth_m[known], (1, 99))
    level = np.clip((depth_m - near) / max(far - near, 1e-3), 0, 1)
    gray = np.where(known, 255 * (1 - level), 0).astype(np.uint8)
    picture = cv2.cvtColor(cv2.applyColorMap(gray, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB).astype(np.uint8)
    picture[~known] = PANEL
    return f"depth: {near:.1f} {unit} (red) to {far:.1f} {unit} (blue)", picture


def _put_map(
    figure: Figure,
    y: int,
    points: LabelledPoints,
    label_set: LabelSet,
    up: Float64 | None,
    unit: str,
    rooms: Sequence[tuple[str, Float64]],
) -> None:
    width = (WIDTH - 2 * MARGIN - 2 * GAP - LEGEND_WIDTH) // 2
    size = (width, MAP_HEIGHT)
    step = max(1, -(-len(points.xyz) // MAX_POINTS))
    xyz, colors = points.xyz[::step], _point_colors(points, label_set)[::step]
    upright = xyz.astype(np.float64) @ upright_rotation(xyz, up).T
    if points.measured is not None:
        colors = _striped(colors, upright, ~points.measured[::step])
    inside = _without_ceiling(upright, points.label[::step], label_set)
    upright, colors = upright[inside], colors[inside]

    R_plan_world = plan_rotation(xyz, up)
    plan = from_above(xyz[inside].astype(np.float64) @ R_plan_world.T)
    camera = fitted(plan, size) if len(plan) else (np.zeros(2), 1.0)
    above, scale = draw_points(plan, colors, size, PANEL, camera=camera)
    azimuth = open_side(upright, ELEVATION)
    seen = ~hides_the_room(upright, azimuth)
    angled, _ = draw_points(from_angle(upright[seen], azimuth, ELEVATION), colors[seen], size, PANEL)
    cut = "" if inside.all() else ", ceiling cut away"
    axes = put_picture(figure, (MARGIN, y, *size), above, f"map from above{cut}")
    _put_scale_bar(axes, scale, unit)
    for name, outline in rooms:
        corners = (from_above(outline @ R_plan_world.T)[:, :2] - camera[0]) * scale + np.array(size) / 2
        _put_room(axes, name, corners)
    put_picture(figure, (MARGIN + width + GAP, y, *size), angled, f"map from an angle{cut}")


def _point_colors(points: LabelledPoints, label_set: LabelSet) -> UInt8:
    """Class colours; the camera's brightness shows through a little, and what is not sure is paler."""
    colors = class_colors(points.label, label_set).astype(np.float32)
    if not len(colors):
        return colors.astype(np.uint8)
    luma = points.rgb.astype(np.float32).mean(axis=1)
    colors *= np.clip(0.75 + 0.5 * luma / 255, 0.7, 1.15)[:, None]
    unsure = np.clip(1 - np.nan_to_num(points.confidence), 0, 1)[:, None] * 0.45
    return np.clip(colors * (1 - unsure) + 205 * unsure, 0, 255).astype(np.uint8)


def _striped(colors: UInt8, upright: Float64, computed: NDArray[np.bool_]) -> UInt8:
    """Dark stripes across what no sensor measured: N points, z up; some forty of them over a map that mixes both."""
    if not computed.any() or computed.all():
        return colors
    across = upright @ np.ones(3)  # slanting on floors and on walls
    low, high = np.percentile(across, (1, 99))
    dark = computed & (np.floor((across - low) / max(high - low, 1e-6) * 2 * STRIPES).astype(np.int64) % 2 == 0)
    return np.where(dark[:, None], colors * STRIPE_LIGHT, colors).astype(np.uint8)


def _without_ceiling(upright: Float64, label: UInt8, label_set: LabelSet) -> NDArray[np.bool_]:
    inside = np.ones(len(upright), np.bool_)
    cut = ceiling_height(upright)
    if cut is not None:
        inside &= upright[:, 2] < cut
    if "ceiling" in label_set.names:
        inside &= label != label_set.ids[label_set.names.index("ceiling")]
    return inside if inside.any() else ~inside


def _put_room(axes: Axes, name: str, corners: Float64) -> None:
    """The outline (N, 2) of a room, in pixels, and its name in the corner that is uppermost."""
    x, y = np.concatenate((corners, corners[:1])).T
    axes.plot(x, y, color="black", linewidth=3, clip_on=True)
    axes.plot(x, y, color="white", linewidth=1.2, clip_on=True)
    at = corners[int((corners @ (0.3, 1.0)).argmin())] + (6, 12)
    behind = {"facecolor": "black", "alpha": 0.6, "linewidth": 0, "pad": 1.5}
    put_text(axes, (float(at[0]), float(at[1])), name, bbox=behind, clip_on=True)


def _put_scale_bar(axes: Axes, scale: float, unit: str) -> None:
    """A bar of 1 m (or of the power of ten that fits) in the lower left corner; ``scale`` is in pixels a metre."""
    metres = 1.0
    while metres * scale > axes.get_xlim()[1] / 3:
        metres /= 10
    while metres * scale < 24:
        metres *= 10
    y = MAP_HEIGHT - 18
    axes.plot((16, 16 + metres * scale), (y, y), color="white", linewidth=3, solid_capstyle="butt")
    behind = {"facecolor": "black", "alpha": 0.5, "linewidth": 0, "pad": 2}  # points may lie here
    put_text(axes, (16, y - 15), f"{metres:g} {unit}", bbox=behind)
