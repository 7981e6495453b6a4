"""Boxes drawn over three frames of a log, and from above with its path and what its depth shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper import plots
from semantic_mapper.errors import LogError
from semantic_mapper.evaluation.upright import camera_up, ceiling_height, plan_rotation
from semantic_mapper.fields.scene.primitives import Primitive
from semantic_mapper.geometry import invert_pose, nearest_pixels, project, transform, unproject
from semantic_mapper.imaging import resize_depth, resize_rgb, working_intrinsics
from semantic_mapper.labels import LabelSet, make_label_set
from semantic_mapper.plain_text import counted
from semantic_mapper.replay.log.sequence import Log
from semantic_mapper.replay.overview import draw_points, fitted, from_above, put_scale_bar
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame, UInt8

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SHOWN = 3  # frames with boxes over them
DEPTH_FRAMES = 16  # that the view from above shows surface of
NEAR_M = 0.05  # edges are cut off nearer than this
MARGIN, GAP, HEADER, CAPTION = 24, 14, 84, 26
TILE_WIDTH, PLAN_HEIGHT, LEGEND_WIDTH = 512, 760, 200
SIDE_M = 25.0  # the view from above ends this far from the camera's path
POINTS_WIDTH = 160  # of the depth images that the view from above is made of
_EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]  # of ``Primitive.corners``


class _Place(NamedTuple):
    """Of a frame: its number in the log, time, camera and pose."""

    number: int
    stamp_ns: int
    intrinsics: CameraIntrinsics
    T_world_camera: Float64


def draw_boxes(log: Log, boxes: Sequence[Primitive], title: str) -> tuple[UInt8, int]:
    """Draw boxes, which are in the world of a log, over the frames that show the most of them, and from above. Returns
    the picture (H, W, 3) RGB, and how many boxes have their middle in view of any frame. Raises LogError: the log has
    no frames."""
    places = [
        _Place(number, e.stamp_ns, log.info.cameras[e.source], np.array(e.T_world_camera, np.float64).reshape(4, 4))
        for number, (e, _) in enumerate(log.frame_parts())
        if e.source in log.info.cameras
    ]
    if not places:
        raise LogError(f"{log.path}: has no frames to draw boxes over")
    seen = np.array([_in_view(boxes, at) for at in places]).reshape(len(places), len(boxes))
    thirds = [part for part in np.array_split(np.arange(len(places)), SHOWN) if len(part)]
    chosen = [places[part[int(seen[part].sum(axis=1).argmax())]] for part in thirds]
    shown = [(at, log.frame(at.number)) for at in chosen]
    surface = [log.frame(at.number) for at in places[:: max(1, len(places) // DEPTH_FRAMES)]]
    colors = _class_colors([box.class_name for box in boxes], log.info.label_set)
    poses = np.stack([at.T_world_camera for at in places])
    return _draw(shown, surface, poses, boxes, colors, title), int(seen.any(axis=0).sum())


def _in_view(boxes: Sequence[Primitive], at: _Place) -> NDArray[np.bool_]:
    """Which of the boxes (B,) have their middle in an image."""
    poses = [box.pose_at(at.stamp_ns) for box in boxes]
    middle = np.array([np.zeros(3) if pose is None else pose[:3, 3] for pose in poses]).reshape(-1, 3)
    there = np.array([pose is not None for pose in poses], np.bool_)
    return there & nearest_pixels(transform(invert_pose(at.T_world_camera), middle), at.intrinsics)[0]


@plots.rendered
def _draw(
    shown: Sequence[tuple[_Place, PosedFrame]],
    surface: Sequence[PosedFrame],
    poses: Float64,
    boxes: Sequence[Primitive],
    colors: dict[str, plots.Color],
    title: str,
) -> Figure:
    heights = [round(TILE_WIDTH * at.intrinsics.height / at.intrinsics.width) for at, _ in shown]
    width = SHOWN * (TILE_WIDTH + GAP) - GAP
    top = HEADER + CAPTION + max(heights) + GAP + CAPTION
    figure = plots.new_figure(width + 2 * MARGIN, top + PLAN_HEIGHT + MARGIN)
    plots.put_title(figure, title, counted(len(boxes), "box", "boxes"))
    for column, ((at, frame), height) in enumerate(zip(shown, heights, strict=True)):
        box = (MARGIN + column * (TILE_WIDTH + GAP), HEADER + CAPTION, TILE_WIDTH, height)
        axes = plots.put_picture(figure, box, frame.rgb, f"frame {at.number}, {frame.stamp_ns} ns", smooth=True)
        for b in boxes:
            if (pose := b.pose_at(at.stamp_ns)) is not None:
                _put_edges(axes, replace(b, T_world_box=pose), at, colors[b.class_name])
    plan_width = width - LEGEND_WIDTH - GAP
    _put_plan(figure, (MARGIN, top, plan_width, PLAN_HEIGHT), surface, poses, boxes, colors)
    counts = {name: sum(box.class_name == name for box in boxes) for name in colors}
    rows: list[plots.LegendRow] = [(f"{name}, {counts[name]}", color, None) for name, color in colors.items()]
    plots.put_legend(figure, (MARGIN + plan_width + GAP, top, LEGEND_WIDTH, PLAN_HEIGHT), rows)
    return figure


def _put_edges(axes: Axes, box: Primitive, at: _Place, color: plots.Color) -> None:
    """The edges of a box in the tile of a frame, and its id where its middle is in view."""
    k = at.intrinsics
    scale = TILE_WIDTH / k.width
    for ends in edges_in_view(box, at.T_world_camera, k):
        axes.plot(*((ends + 0.5) * scale).T, color=plots.hex_color(color), linewidth=1.4, linestyle="-")
    middle = transform(invert_pose(at.T_world_camera), box.T_world_box[:3, 3][None])
    if nearest_pixels(middle, k)[0][0]:
        _put_id(axes, (project(middle, k)[0] + 0.5) * scale, box.id)


def edges_in_view(box: Primitive, T_world_camera: Float64, intrinsics: CameraIntrinsics) -> list[Float64]:
    """Ends (2, 2) in pixels of the edges of a box, as far as they are in front of a camera."""
    corners = transform(invert_pose(T_world_camera), box.corners())
    found: list[Float64] = []
    for edge in _EDGES:
        near, far = sorted(corners[list(edge)], key=lambda corner: corner[2])
        if far[2] >= NEAR_M:
            start = max(0.0, (NEAR_M - near[2]) / max(far[2] - near[2], 1e-12))
            found.append(project(np.stack((near + start * (far - near), far)), intrinsics))
    return found


def _put_plan(
    figure: Figure,
    where: tuple[int, int, int, int],
    surface: Sequence[PosedFrame],
    poses: Float64,
    boxes: Sequence[Primitive],
    colors: dict[str, plots.Color],
) -> None:
    """Surface, path and boxes from above, in metres of a level frame."""
    xyz, rgb = _surface(surface)
    R = plan_rotation(xyz, camera_up(poses))
    level = xyz @ R.T
    roof = ceiling_height(level)
    inside = np.ones(len(level), np.bool_) if roof is None else level[:, 2] < roof
    points, path = from_above(level[inside]), from_above(poses[:, :3, 3] @ R.T)
    moments = [(b, pose) for b in boxes for _, pose in b.stamps or b.frames or ((0, b.T_world_box),)]
    prints = [from_above(replace(box, T_world_box=pose).corners() @ R.T) for box, pose in moments]

    every = np.concatenate([points, path, *prints])
    every = np.clip(every, path.min(axis=0) - SIDE_M, path.max(axis=0) + SIDE_M)
    size = where[2:]
    centre, scale = fitted(np.stack((every.min(axis=0), every.max(axis=0))), size)
    picture, _ = draw_points(points, rgb[inside], size, plots.PANEL, camera=(centre, scale))
    axes = plots.put_picture(figure, where, picture, "from above: surface, the camera's path, and boxes")

    def pixels(at: Float64) -> Float64:
        return (at[:, :2] - centre) * scale + np.array(size) / 2

    axes.plot(*pixels(path).T, color="white", linewidth=1, linestyle=":")
    for (box, _), corners in zip(moments, prints, strict=True):
        outline = cv2.convexHull(pixels(corners).astype(np.float32)).reshape(-1, 2).astype(np.float64)
        color = plots.hex_color(colors[box.class_name])
        axes.fill(*outline.T, facecolor=f"{color}26", edgecolor=color, linestyle="-")
        if ((outline.mean(axis=0) > 0) & (outline.mean(axis=0) < size)).all():
            _put_id(axes, outline.mean(axis=0), box.id)
    put_scale_bar(axes, scale, "m")


def _surface(frames: Sequence[PosedFrame]) -> tuple[Float64, UInt8]:
    """Points (N, 3) in the world and colours (N, 3) that the depth of frames shows."""
    xyz, rgb = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)]
    for frame in frames:
        if frame.depth_m is not None:
            k = working_intrinsics(frame.intrinsics, POINTS_WIDTH)
            depth = resize_depth(frame, k)
            xyz.append(transform(frame.T_world_camera, unproject(depth, k)[depth > 0]))
            rgb.append(resize_rgb(frame, k)[depth > 0])
    return np.concatenate(xyz), np.concatenate(rgb)


def _put_id(axes: Axes, at: Float64, box_id: int) -> None:
    behind = {"facecolor": "black", "alpha": 0.5, "linewidth": 0, "pad": 1}
    plots.put_text(
        axes, (float(at[0]), float(at[1])), str(box_id), ha="center", fontsize=plots.SMALL_PT, bbox=behind, clip_on=True
    )


def _class_colors(names: Sequence[str], label_set: LabelSet | None) -> dict[str, plots.Color]:
    """Colours of the classes, in the order in which they come: those of the label set where it has them."""
    known = {} if label_set is None else dict(zip(label_set.names, label_set.colors, strict=True))
    different = list(dict.fromkeys(names))
    spare = make_label_set("boxes", different).colors if different else ()
    return {name: known.get(name, color) for name, color in zip(different, spare, strict=True)}
