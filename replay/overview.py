"""Pictures of a run: views and their rendered semantics, the map from above and from an angle, legend.

Points are drawn on the CPU: parallel projection, z-buffer, shading from the depth buffer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper import plots
from semantic_mapper.evaluation.upright import ceiling_height, plan_rotation, upright_rotation
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.types import Float32, Float64, UInt8

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, MARGIN, GAP = 1600, 24, 14
HEADER, CAPTION = 74, 26
MAP_HEIGHT = 620
LEGEND_WIDTH = 250
MAX_POINTS = 2_000_000
ELEVATION = float(np.deg2rad(42))
SUPERSAMPLING = 2  # pixels drawn a side for each pixel of the picture
MAX_SPLAT = 13  # largest side of a splat, drawn pixels
BAND, MARGIN_ROWS = 256, 24  # rows drawn at a time, and those around that splats and shading reach
COLUMN_M = 0.12  # side of the upright columns in which walls are looked for
EDGE_STRENGTH = 1.1  # of the shading
AZIMUTHS = tuple(float(np.deg2rad(degrees)) for degrees in (35, 55, 125, 145, 215, 235, 305, 325))
STRIPES, STRIPE_LIGHT = 40, 0.45  # across computed surface: how many, and how bright


@dataclass(frozen=True, slots=True, eq=False)
class ViewStrip:
    """One frame of the run, a row of the picture. Images may differ in size; each is scaled to its tile."""

    name: str  # says which frame ("frame 120")
    rgb: UInt8  # (H, W, 3) uint8
    rendered: UInt8  # (h, w) uint8 class ids; the ignore id is drawn grey
    truth: UInt8 | None = None  # (H, W) uint8 class ids, None where they are missing
    depth_m: Float32 | None = None  # (H, W) float32, 0 = none; None for a stream without depth
    depth_rendered: bool = False  # the field rendered it; no sensor measured it


@plots.rendered
def draw_overview(
    strips: Sequence[ViewStrip],
    points: MapPoints,
    label_set: LabelSet,
    *,
    title: str,
    subtitle: str = "",
    up: Float64 | None = None,
    unit: str = "m",
    rooms: Sequence[tuple[str, Float64, Float64]] = (),
) -> Figure:
    """Draw a row of tiles for each strip, best one to three, under them the map and the legend, 1600 pixels wide.

    ``up`` (3,) is a rough up of the world, as of ``upright.camera_up``; None estimates it from the points alone.
    ``unit`` is that of lengths. ``rooms``, each a name, an outline (N, 3) and where the name stands (3,) in the world,
    are drawn from above.
    """
    top = HEADER + sum(_strip_height(strip) + GAP for strip in strips)
    figure = plots.new_figure(WIDTH, top + CAPTION + MAP_HEIGHT + MARGIN)
    plots.put_title(figure, title, subtitle)
    y = HEADER
    for strip in strips:
        _put_strip(figure, y, strip, label_set, unit)
        y += _strip_height(strip) + GAP
    _put_map(figure, top + CAPTION, points, label_set, up, unit, rooms)
    shown = [image for strip in strips for image in (strip.rendered, strip.truth) if image is not None]
    x, y = WIDTH - MARGIN - LEGEND_WIDTH, top + CAPTION
    legend = plots.place(figure, (x, y, LEGEND_WIDTH, MAP_HEIGHT))
    plots.put_text(legend, (0, -11), "class, fraction of the map", color=plots.DIM_TEXT)
    hints = ["paler in the map = less sure"]
    if points.measured is not None and not points.measured.all():
        share = f"{100 * (1 - points.measured.mean()):.0f} %"
        hints.append(f"striped = computed: {share}" if points.measured.any() else "all of it computed, no sensor")
    for row, hint in enumerate(reversed(hints)):
        plots.put_text(legend, (0, MAP_HEIGHT - 10 - 20 * row), hint, color=plots.DIM_TEXT)
    box = (x, y, LEGEND_WIDTH, MAP_HEIGHT - 10 - 20 * len(hints))
    plots.put_legend(figure, box, plots.class_rows(points.label, label_set, shown))
    return figure


@plots.rendered
def draw_strip(strip: ViewStrip, label_set: LabelSet, unit: str = "m") -> Figure:
    """One frame as a row of tiles with captions, 1600 pixels wide."""
    figure = plots.new_figure(WIDTH, _strip_height(strip))
    _put_strip(figure, 0, strip, label_set, unit)
    return figure


def _tile_size(strip: ViewStrip) -> tuple[int, int]:
    columns = 3 + (strip.truth is not None and strip.depth_m is not None)  # two alone would tower over the map
    width = (WIDTH - 2 * MARGIN - (columns - 1) * GAP) // columns
    return width, round(width * strip.rgb.shape[0] / strip.rgb.shape[1])


def _strip_height(strip: ViewStrip) -> int:
    return CAPTION + _tile_size(strip)[1]


def _put_strip(figure: Figure, y: int, strip: ViewStrip, label_set: LabelSet, unit: str) -> None:
    tiles = [
        (f"{strip.name}: camera", strip.rgb),
        ("rendered semantics", plots.class_colors(strip.rendered, label_set)),
    ]
    if strip.truth is not None:
        tiles.append(("truth", plots.class_colors(strip.truth, label_set)))
    if strip.depth_m is not None:
        caption, picture = _color_depth(strip.depth_m, unit)
        tiles.append((f"rendered {caption}" if strip.depth_rendered else caption, picture))
    width, height = _tile_size(strip)
    for column, (caption, picture) in enumerate(tiles):
        box = (MARGIN + column * (width + GAP), y + CAPTION, width, height)
        plots.put_picture(figure, box, picture, caption, smooth=column == 0)


def _color_depth(depth_m: Float32, unit: str) -> tuple[str, UInt8]:
    known = np.isfinite(depth_m) & (depth_m > 0)
    if not known.any():
        return "depth: none", np.full((*depth_m.shape, 3), plots.PANEL, np.uint8)
    near, far = np.percentile(depth_m[known], (1, 99))
    level = np.clip((depth_m - near) / max(far - near, 1e-3), 0, 1)
    gray = np.where(known, 255 * (1 - level), 0).astype(np.uint8)
    picture = cv2.cvtColor(cv2.applyColorMap(gray, cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB).astype(np.uint8)
    picture[~known] = plots.PANEL
    return f"depth: {near:.1f} {unit} (red) to {far:.1f} {unit} (blue)", picture


def _put_map(
    figure: Figure,
    y: int,
    points: MapPoints,
    label_set: LabelSet,
    up: Float64 | None,
    unit: str,
    rooms: Sequence[tuple[str, Float64, Float64]],
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
    above, scale = draw_points(plan, colors, size, plots.PANEL, camera=camera)
    azimuth = open_side(upright)
    seen = ~hides_the_room(upright, azimuth)
    angled, _ = draw_points(from_angle(upright[seen], azimuth, ELEVATION), colors[seen], size, plots.PANEL)
    cut = "" if inside.all() else ", ceiling cut away"
    outlined = "; outline: rooms, with what furniture covers" if rooms else ""
    axes = plots.put_picture(figure, (MARGIN, y, *size), above, f"map from above{cut}{outlined}")
    put_scale_bar(axes, scale, unit)
    for name, outline, middle in rooms:
        drawn = from_above(np.vstack((outline, middle)) @ R_plan_world.T)[:, :2]
        _put_room(axes, name, (drawn - camera[0]) * scale + np.array(size) / 2)
    plots.put_picture(figure, (MARGIN + width + GAP, y, *size), angled, f"map from an angle{cut}")


def _point_colors(points: MapPoints, label_set: LabelSet) -> UInt8:
    """Class colours; the camera's brightness shows through a little, and what is not sure is paler."""
    colors = plots.class_colors(points.label, label_set).astype(np.float32)
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
    cut = ceiling_height(upright)
    inside = upright[:, 2] < (np.inf if cut is None else cut)
    if "ceiling" in label_set.names:
        inside &= label != label_set.id_of("ceiling")
    return inside if inside.any() else ~inside


def _put_room(axes: Axes, name: str, drawn: Float64) -> None:
    """The outline of a room and where its name stands, (N + 1, 2) pixels."""
    x, y = np.concatenate((drawn[:-1], drawn[:1])).T
    axes.plot(x, y, color="black", linewidth=3, clip_on=True)
    axes.plot(x, y, color="white", linewidth=1.2, clip_on=True)
    behind = {"facecolor": "black", "alpha": 0.6, "linewidth": 0, "pad": 1.5}
    at = (float(drawn[-1, 0]), float(drawn[-1, 1]))
    plots.put_text(axes, at, name, bbox=behind, clip_on=True, ha="center", va="center")


def put_scale_bar(axes: Axes, scale: float, unit: str) -> None:
    """A bar of 1 m (or of the power of ten that fits) in the lower left corner; ``scale`` is in pixels a metre."""
    longest, shortest = axes.get_xlim()[1] / 3 / scale, 24 / scale
    metres = 10.0 ** max(min(0, np.floor(np.log10(longest))), np.ceil(np.log10(shortest)))
    y = axes.get_ylim()[0] - 18
    axes.plot((16, 16 + metres * scale), (y, y), color="white", linewidth=3, solid_capstyle="butt")
    behind = {"facecolor": "black", "alpha": 0.5, "linewidth": 0, "pad": 2}  # points may lie here
    plots.put_text(axes, (16, y - 15), f"{metres:g} {unit}", bbox=behind)


def draw_points(
    xyz_view: Float64,
    colors: UInt8,
    size: tuple[int, int],
    background: tuple[int, int, int],
    *,
    camera: tuple[Float64, float] | None = None,
) -> tuple[UInt8, float]:
    """Draw points (N, 3), metres to the right, down and away from the viewer, in parallel projection. Returns the
    picture (H, W, 3) of a ``size`` (width, height), and its scale in pixels a metre.

    It is fitted to the points unless a camera is given: x and y (2,) of the picture's centre, and pixels a metre.
    """
    width, height = size[0] * SUPERSAMPLING, size[1] * SUPERSAMPLING
    canvas = np.full((height, width, 3), background, np.uint8)
    if not len(xyz_view):
        return cv2.resize(canvas, size).astype(np.uint8), 1.0
    centre, scale = fitted(xyz_view, size) if camera is None else camera
    scale *= SUPERSAMPLING
    side = int(np.clip(np.ceil(point_spacing(xyz_view) * scale * 1.1), 1, MAX_SPLAT))
    pixel = np.floor((xyz_view[:, :2] - centre) * scale + (width / 2, height / 2)).astype(np.int64)
    z = xyz_view[:, 2].astype(np.float32)
    inside = ((pixel >= 0) & (pixel < (width, height))).all(axis=1)
    behind = z[inside].max(initial=0.0) + np.float32(0.05)
    for top in range(0, height, BAND):  # as a whole it would take some 80 MB
        first, last = max(0, top - MARGIN_ROWS), min(height, top + BAND + MARGIN_ROWS)
        nearest = _nearest_points(pixel - (0, first), xyz_view[:, 2], width, last - first, side)
        hit = nearest >= 0
        shade = _shading(np.where(hit, z[nearest], behind), scale)
        own = slice(top - first, top - first + BAND)
        hit, shade, nearest = hit[own], shade[own], nearest[own]
        drawn = np.clip(colors[nearest[hit]] * shade[hit][:, None], 0, 255)
        canvas[top : top + BAND][hit] = drawn.astype(np.uint8)
    return cv2.resize(canvas, size, interpolation=cv2.INTER_AREA).astype(np.uint8), scale / SUPERSAMPLING


def fitted(xyz_view: Float64, size: tuple[int, int]) -> tuple[Float64, float]:
    """The ``camera`` of ``draw_points`` that fits points (N, 3), N > 0, into a picture (width, height)."""
    low, high = np.percentile(xyz_view[:, :2], (0.1, 99.9), axis=0)
    extent = np.maximum(high - low, 0.1) * 1.04 + 0.05
    return (low + high) / 2, float(min(size[0] / extent[0], size[1] / extent[1]))


def from_above(xyz_upright: Float64) -> Float64:
    """View coordinates (N, 3) of a look straight down on upright points (z up)."""
    return xyz_upright * (1.0, -1.0, -1.0)


def from_angle(xyz_upright: Float64, azimuth: float, elevation: float) -> Float64:
    """View coordinates (N, 3) of a look at upright points (z up) from a direction, in radians."""
    ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(elevation), np.sin(elevation)
    right = np.array((-sa, ca, 0.0))
    towards_viewer = np.array((ca * ce, sa * ce, se))
    return xyz_upright @ np.stack((right, np.cross(right, towards_viewer), -towards_viewer)).T


def hides_the_room(xyz_upright: Float64, azimuth: float) -> NDArray[np.bool_]:
    """(N,) bool: which points of tall things stand in front and would hide the rest from a viewer at ``azimuth``.

    Leaving them out opens the map like a doll's house: walls, and what leans on them, on the viewer's side; never the
    floor. Points are upright, (N, 3) metres, z up; ``azimuth`` is a direction in the x-y plane, radians.
    """
    towards = np.array((np.cos(azimuth), np.sin(azimuth)))
    low, high = np.percentile(xyz_upright[:, 2], (2, 99)) if len(xyz_upright) else (0.0, 0.0)
    cells = np.floor(xyz_upright[:, :2] / COLUMN_M).astype(np.int64)
    columns, column = np.unique(cells, axis=0, return_inverse=True)
    column = column.ravel()
    top = np.full(len(columns), -np.inf)
    np.maximum.at(top, column, xyz_upright[:, 2])
    tall = top - low > 0.6 * (high - low)
    centre = (columns + 0.5) * COLUMN_M
    along = (centre - centre.sum(axis=0) / max(len(centre), 1)) @ towards
    # Of the tall columns in one line of sight, those of the front one's thickness hide what is behind them.
    line = np.floor(centre @ (-towards[1], towards[0]) / COLUMN_M).astype(np.int64)
    line -= line.min(initial=0)
    front = np.full(line.max(initial=0) + 1, -np.inf)
    np.maximum.at(front, line[tall], along[tall])
    hiding = tall & (along > front[line] - 2.5 * COLUMN_M) & (along > 0)
    return hiding[column] & (xyz_upright[:, 2] > low + 0.1)


def _nearest_points(pixel: NDArray[np.int64], z: Float64, width: int, height: int, side: int) -> NDArray[np.int64]:
    """Index (H, W) of the nearest point a pixel, each a square of ``side`` pixels; -1 without one."""
    inside = np.flatnonzero(((pixel >= 0) & (pixel < (width, height))).all(axis=1))
    near_to_far = inside[np.argsort(z[inside], kind="stable")]
    rank = np.full((height, width), len(inside), np.float32)  # exact below 2^24 points
    x, y = pixel[near_to_far[::-1]].T
    rank[y, x] = np.arange(len(inside), dtype=np.float32)[::-1]  # the last one written stays
    rank = cv2.erode(rank, np.ones((side, side), np.uint8))
    return np.append(near_to_far, -1)[rank.astype(np.int64)]


def _shading(depth: Float32, scale: float) -> Float32:
    """(H, W), 1 = unshaded: a pixel is darker the further it lies behind its surroundings (Luft et al., 2006)."""
    total = np.zeros_like(depth)
    for radius, weight in ((2, 1.0), (5, 0.6), (11, 0.4)):
        behind = depth - cv2.blur(depth, (2 * radius + 1, 2 * radius + 1))
        reach = 3 * radius / scale + 0.025  # metres on the picture
        total += np.float32(weight) * np.clip(behind / np.float32(reach), 0, 1)
    return np.exp(-EDGE_STRENGTH * total).astype(np.float32)


def point_spacing(xyz: Float64) -> float:
    """Typical distance of a point to its fourth neighbour, metres: the pitch of a surface sampled on a grid."""
    if len(xyz) < 5:
        return 0.05
    asking = xyz[:: max(1, len(xyz) // 500)]
    from scipy.spatial import KDTree  # here, since training machines may lack SciPy

    distances, _ = KDTree(xyz).query(asking, k=5)
    return float(np.percentile(distances[:, 4], 75))


def open_side(xyz_upright: Float64) -> float:
    """Azimuth, in radians, of the corner from which the least of upright points (N, 3) hides the rest."""
    few = xyz_upright[:: max(1, len(xyz_upright) // 60_000)]
    return min(AZIMUTHS, key=lambda azimuth: float(hides_the_room(few, azimuth).sum()))
