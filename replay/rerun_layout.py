"""The page that Rerun shows: its layout, from where the map is looked at first, colour scales and legend."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from semantic_mapper.evaluation.upright import ceiling_height, upright_rotation
from semantic_mapper.geometry import turn_onto
from semantic_mapper.labels import LabelSet
from semantic_mapper.plots import DIM_TEXT, class_rows, new_figure, place, put_legend, put_picture, put_text, rendered
from semantic_mapper.replay.overview import from_angle, open_side
from semantic_mapper.types import Bool, Float32, Float64, UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEASURED_COLOR, COMPUTED_COLOR = (86, 180, 233), (230, 159, 0)  # blue and orange, which the colour-blind can tell apart
LEGEND_WIDTH = 260
CEILING = "ceiling"  # below each colouring of the map: there, but hidden, so that one can look into a room
ELEVATION = np.deg2rad(50)  # from which one looks into the map
FOCAL = 1.16 / np.tan(np.deg2rad(55) / 2)  # Rerun's, with a margin for outlines; in halves of a view's height
_MARGIN, _CAPTION, _BAR, _PITCH = 12, 26, 16, 27


class Eye(NamedTuple):
    """From where the map is looked at first: position, target and up (3,), world metres."""

    position: Float64
    target: Float64
    up: Float64


def eye_on(xyz: Float32, up: Float64 | None) -> Eye:
    """An eye on a map, points (N, 3), N > 0, from above, on its most open side. ``up`` (3,) is a first guess of which
    way is up; None = unknown."""
    R_upright_world = upright_rotation(xyz, up)
    upright = xyz.astype(np.float64) @ R_upright_world.T
    azimuth = open_side(upright)
    R_view_world = from_angle(np.eye(3), azimuth, ELEVATION).T @ R_upright_world  # right, down, away from the viewer
    x, y, z = from_angle(upright, azimuth, ELEVATION).T
    # The edges of the view are planes through the eye: of each, the point that is farthest out, but for stray ones.
    a, b, c, d = (float(np.percentile(side - z / FOCAL, 99.95)) for side in (x, -x, y, -y))
    across, away = np.array(((a - b) / 2, (c - d) / 2)), FOCAL * max(a + b, c + d) / 2
    middle = float(np.median(z))
    position, target = (np.append(across, depth) for depth in (min(-away, middle - 0.3), middle))
    return Eye(position @ R_view_world, target @ R_view_world, R_upright_world[2])


def in_ceiling(xyz: Float32, up: Float64) -> Bool:
    """Which points (N, 3) of a map are its ceiling, or above it, (N,): without them one can look in from above."""
    level = turn_onto(up, np.array((0.0, 0.0, 1.0)))
    upright = xyz.astype(np.float64) @ level.T
    cut_m = ceiling_height(upright)
    return np.zeros(len(xyz), np.bool_) if cut_m is None else upright[:, 2] >= cut_m


def scale_colors(level: Float32) -> UInt8:
    """Colours (N, 3) for levels (N,) in 0..1."""
    steps = np.clip(level * 255 + 0.5, 0, 255).astype(np.uint8)
    table = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS), np.uint8)
    return table[:, 0, ::-1][steps]


@rendered
def draw_map_legend(labels: UInt8, label_set: LabelSet, computed: float = 0.0) -> Figure:
    """Picture of the classes of a map's points (N,), of the scale of confidence, and of what was measured, where a
    fraction ``computed`` was not."""
    rows = class_rows(labels, label_set)
    if computed:
        rows += [("measured", MEASURED_COLOR, 1 - computed), ("computed", COMPUTED_COLOR, computed)]
    width, height = LEGEND_WIDTH - 2 * _MARGIN, len(rows) * _PITCH
    top = _MARGIN + _CAPTION
    figure = new_figure(LEGEND_WIDTH, top + height + _MARGIN + _CAPTION + _BAR + _MARGIN)
    put_text(place(figure, (_MARGIN, _MARGIN, width, _CAPTION)), (0, 8), "class, fraction of the map", color=DIM_TEXT)
    put_legend(figure, (_MARGIN, top, width, height), rows)
    bar = scale_colors(np.linspace(0, 1, width, dtype=np.float32))
    put_picture(figure, (_MARGIN, top + height + _MARGIN + _CAPTION, width, _BAR), bar[None], "confidence: 0 to 1")
    return figure


def camera_path(camera: str) -> str:
    """Entity of a camera; its image plane is below it."""
    return rr.new_entity_path(["world", "cameras", camera])


def layout(cameras: Sequence[str], colourings: Sequence[str], eye: Eye | None) -> rrb.Blueprint:
    """The map in one tab a colouring, the legend next to it, the images of each camera, and the times of all stages.

    Without ``cameras`` it is a map alone; without an ``eye``, from where to look at it first, there is no map yet.
    """
    seen = [f"+ {camera_path(c)}/{part}" for c in cameras for part in ("", "image", "image/rgb", "moving")]
    seen = [line.rstrip("/") for line in seen] + ["+ /world/path/**"]
    eyes = eye and rrb.EyeControls3D(position=eye.position, look_target=eye.target, eye_up=eye.up)
    maps = [
        rrb.Spatial3DView(
            origin="/world",
            contents=[*seen, f"+ /world/map/{name}/**", *(["+ /world/graph/**"] if name == "class" else [])],
            name=name,
            eye_controls=eyes,
            overrides={f"/world/map/{name}/{CEILING}": rrb.EntityBehavior(visible=False)},
            line_grid=False,
        )
        for name in colourings
    ]
    space = rrb.Tabs(*maps, active_tab=0, name="map")
    legend = rrb.Spatial2DView(origin="/legend", name="legend")
    above = rrb.Grid(space, legend, column_shares=[4, 1]) if eye is not None else space
    panels = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
    if not cameras:
        return rrb.Blueprint(above, rrb.TimePanel(state="hidden"), *panels)
    kinds = ("rgb", "semantics", "depth")
    rows = [
        [rrb.Spatial2DView(origin=f"{camera_path(c)}/image", contents=f"$origin/{k}", name=f"{c}: {k}") for k in kinds]
        for c in cameras
    ]
    images = rrb.Horizontal(*rows[0]) if len(rows) == 1 else rrb.Tabs(*(rrb.Horizontal(*row) for row in rows))
    times = rrb.TimeSeriesView(origin="/stage_ms", name="stage times, ms")
    below = rrb.Horizontal(images, times, column_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Vertical(above, below, row_shares=[2, 1]),
        rrb.TimePanel(state="collapsed", timeline="capture", play_state="following"),
        *panels,
    )
