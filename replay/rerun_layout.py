"""How Rerun lays out what ``RerunLog`` writes, and what its colours mean."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from semantic_mapper.evaluation.canvas import DIM_TEXT, draw_text, new_canvas, paste
from semantic_mapper.evaluation.legend import WIDEST, draw_legend, legend_rows
from semantic_mapper.evaluation.splat import open_side
from semantic_mapper.evaluation.upright import upright_rotation
from semantic_mapper.labels import LabelSet
from semantic_mapper.types import Float32, Float64, UInt8

COLOURINGS = ("class", "colour", "confidence", "age")
AGED_S = 60.0  # what has not changed for so long has the last colour of the scale
CONFIDENCE_SCALE, AGE_SCALE = cv2.COLORMAP_VIRIDIS, cv2.COLORMAP_INFERNO
LEGEND_WIDTH = 260
ELEVATION = np.deg2rad(50)  # from which one looks into the map
DISTANCE = 0.8  # of the eye, times the map's diagonal
_MARGIN, _CAPTION, _BAR = 12, 26, 16


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """From where the map is looked at first: position, target and up (3,), world metres."""

    position: Float64
    target: Float64
    up: Float64


def eye_on(xyz: Float32, up: Float64 | None) -> Eye:
    """An eye that sees all points (N, 3), N > 0, and which way is up in them; ``up`` is a first guess."""
    R_upright_world = upright_rotation(xyz, up)
    turned = xyz.astype(np.float64) @ R_upright_world.T
    low, high = np.percentile(turned, (1, 99), axis=0)
    azimuth, ce = open_side(turned, ELEVATION), np.cos(ELEVATION)
    direction = np.array((np.cos(azimuth) * ce, np.sin(azimuth) * ce, np.sin(ELEVATION)))
    position = (low + high) / 2 + DISTANCE * max(float(np.linalg.norm(high - low)), 0.5) * direction
    return Eye(position @ R_upright_world, (low + high) / 2 @ R_upright_world, R_upright_world[2])


def scale_colors(level: Float32, scale: int) -> UInt8:
    """Colours (N, 3) of a colour map of OpenCV for levels (N,) in 0..1."""
    steps = np.clip(level * 255 + 0.5, 0, 255).astype(np.uint8)
    table = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], scale), np.uint8)
    return table[:, 0, ::-1][steps]


def draw_map_legend(labels: UInt8, label_set: LabelSet, *, aged: bool) -> UInt8:
    """Picture of the classes of a map's points (N,) and of the scales of confidence and (``aged``) age."""
    rows = legend_rows(labels, label_set)
    scales = [("confidence: 0 to 1", CONFIDENCE_SCALE)]
    scales += [(f"age: {AGED_S:g} s and more, to 0 s", AGE_SCALE)] if aged else []
    height = len(rows) * WIDEST
    canvas = new_canvas(LEGEND_WIDTH, 2 * _MARGIN + _CAPTION + height + len(scales) * (_CAPTION + _BAR + _MARGIN))
    wide = LEGEND_WIDTH - 2 * _MARGIN
    draw_text(canvas, "class, share of the map", (_MARGIN, _MARGIN), 15, DIM_TEXT)
    draw_legend(canvas, rows, (_MARGIN, _MARGIN + _CAPTION), (wide, height))
    y = _MARGIN + _CAPTION + height + _MARGIN
    for caption, scale in scales:
        draw_text(canvas, caption, (_MARGIN, y), 15, DIM_TEXT)
        bar = scale_colors(np.linspace(0, 1, wide, dtype=np.float32), scale)
        paste(canvas, np.repeat(bar[None], _BAR, axis=0), (_MARGIN, y + _CAPTION))
        y += _CAPTION + _BAR + _MARGIN
    return canvas


def camera_path(camera: str) -> str:
    """Entity of a camera; its image plane is below it."""
    return rr.new_entity_path(["world", "cameras", camera])


def layout(cameras: Sequence[str], *, mapped: bool, aged: bool, eye: Eye | None) -> rrb.Blueprint:
    """The map in one tab a colouring, the legend beside it, the images of each camera, and the times of all stages.

    Args:
        cameras: Their names; none for a map alone.
        mapped: There is a map.
        aged: Its ages are known.
        eye: From where to look first; None leaves it to the viewer.
    """
    seen = [f"+ {camera_path(c)}/{part}" for c in cameras for part in ("", "image", "image/rgb")]
    seen = [line.rstrip("/") for line in seen] + ["+ /world/path/**"]
    eyes = None
    if eye is not None:
        eyes = rrb.EyeControls3D(position=eye.position, look_target=eye.target, eye_up=eye.up)
    maps = [
        rrb.Spatial3DView(
            origin="/world",
            contents=[*seen, f"+ /world/map/{name}"],
            name=f"map: {name}",
            eye_controls=eyes,
            line_grid=False,
        )
        for name in COLOURINGS
        if aged or name != "age"
    ]
    space = rrb.Tabs(*maps, active_tab=0, name="map")
    legend = rrb.Spatial2DView(origin="/legend", name="legend")
    above = rrb.Horizontal(space, legend, column_shares=[4, 1]) if mapped else space
    panels = rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed")
    if not cameras:
        return rrb.Blueprint(above, rrb.TimePanel(state="hidden"), *panels)
    rows = [
        rrb.Horizontal(
            *(
                rrb.Spatial2DView(origin=f"{camera_path(c)}/image", contents=f"$origin/{part}", name=f"{c}: {part}")
                for part in ("rgb", "semantics", "depth")
            )
        )
        for c in cameras
    ]
    images = rows[0] if len(rows) == 1 else rrb.Tabs(*rows)
    times = rrb.TimeSeriesView(origin="/stage_ms", name="stage times, ms")
    below = rrb.Horizontal(images, times, column_shares=[3, 2])
    return rrb.Blueprint(
        rrb.Vertical(above, below, row_shares=[2, 1]),
        rrb.TimePanel(state="collapsed", timeline="capture", play_state="following"),
        *panels,
    )
