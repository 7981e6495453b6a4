"""How Rerun lays out what ``RerunLog`` writes, and what its colours mean. Its SDK is an extra: import it from here.

Raises:
    DependencyError: on import, where the extra is not installed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

from semantic_mapper.evaluation.splat import seen_from
from semantic_mapper.evaluation.upright import upright_rotation
from semantic_mapper.labels import LabelSet
from semantic_mapper.plots import DIM_TEXT, class_rows, new_figure, place, put_legend, put_picture, put_text, rendered
from semantic_mapper.types import Float32, Float64, UInt8

if TYPE_CHECKING:
    from matplotlib.figure import Figure
from semantic_mapper.errors import DependencyError

try:
    import rerun as rr
    import rerun.blueprint as rrb
except ModuleNotFoundError as error:
    raise DependencyError(
        "the viewer and Rerun files need the package rerun-sdk: pip install 'semantic-mapper[viewer]'"
    ) from error


COLOURINGS = ("class", "colour", "confidence", "measured", "age")
MEASURED_COLOR, COMPUTED_COLOR = (86, 180, 233), (230, 159, 0)  # blue and orange, which the colour-blind can tell apart
AGED_S = 60.0  # what has not changed for so long has the last colour of the scale
CONFIDENCE_SCALE, AGE_SCALE = cv2.COLORMAP_VIRIDIS, cv2.COLORMAP_INFERNO
LEGEND_WIDTH = 260
ELEVATION = np.deg2rad(50)  # from which one looks into the map
DISTANCE = 0.8  # of the eye, times the map's diagonal
AZIMUTHS_DEG = (35, 55, 125, 145, 215, 235, 305, 325)  # first looks are compared from these sides
JUDGED_POINTS = 30_000  # of the map, for that
LOW_PART = 0.6  # of its height: floor and furniture are in it
_MARGIN, _CAPTION, _BAR, _PITCH = 12, 26, 16, 27


@dataclass(frozen=True, slots=True, eq=False)
class Eye:
    """From where the map is looked at first: position, target and up (3,), world metres."""

    position: Float64
    target: Float64
    up: Float64


def eye_on(xyz: Float32, up: Float64 | None) -> Eye:
    """An eye that sees most of the floor and of what stands on it, past walls and ceiling, and which way is up.

    Over a map without a ceiling that is a look from above; a closed room is looked at from inside, out of a corner.

    Args:
        xyz: (N, 3) points of the map, N > 0.
        up: (3,) first guess of which way is up; None = unknown.
    """
    R_upright_world = upright_rotation(xyz, up)
    step = -(-len(xyz) // JUDGED_POINTS)
    turned = xyz[::step].astype(np.float64) @ R_upright_world.T
    low, high = np.percentile(turned, (1, 99), axis=0)
    counts = turned[turned[:, 2] <= low[2] + LOW_PART * (high[2] - low[2])]
    others = turned[turned[:, 2] > low[2] + LOW_PART * (high[2] - low[2])]
    judged = np.concatenate((counts, others))
    best, most = None, -1
    for position, target in _first_looks(low, high):
        seen = int(seen_from(judged, position, target, np.array((0.0, 0.0, 1.0)))[: len(counts)].sum())
        if seen > most:
            best, most = (position, target), seen
    assert best is not None
    return Eye(best[0] @ R_upright_world, best[1] @ R_upright_world, R_upright_world[2])


def _first_looks(low: Float64, high: Float64) -> Iterator[tuple[Float64, Float64]]:
    """Positions to look at a map from, with z up, and where to look: round it from above, then within its bounds."""
    centre, size = (low + high) / 2, np.maximum(high - low, 0.3)
    for azimuth in np.deg2rad(AZIMUTHS_DEG):
        ca, sa, ce, se = np.cos(azimuth), np.sin(azimuth), np.cos(ELEVATION), np.sin(ELEVATION)
        yield centre + DISTANCE * float(np.linalg.norm(size)) * np.array((ca * ce, sa * ce, se)), centre
    for azimuth in np.deg2rad(AZIMUTHS_DEG):
        towards = np.array((np.cos(azimuth), np.sin(azimuth)))
        reach = 1 / np.abs(towards / size[:2]).max()  # twice the way to the side of the bounds
        for part in (0.25, 0.4):
            at = centre[:2] + part * reach * towards
            target = np.append(centre[:2] - 0.15 * reach * towards, low[2] + 0.2 * size[2])
            yield np.append(at, low[2] + 0.8 * size[2]), target


def scale_colors(level: Float32, scale: int) -> UInt8:
    """Colours (N, 3) of a colour map of OpenCV for levels (N,) in 0..1."""
    steps = np.clip(level * 255 + 0.5, 0, 255).astype(np.uint8)
    table = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], scale), np.uint8)
    return table[:, 0, ::-1][steps]


@rendered
def draw_map_legend(labels: UInt8, label_set: LabelSet, *, aged: bool, computed: float = 0.0) -> Figure:
    """Picture of the classes of a map's points (N,), of the scales of confidence and (``aged``) age, and of what was
    measured, where a fraction ``computed`` was not."""
    rows = class_rows(labels, label_set)
    if computed:
        rows += [
            ("measured", MEASURED_COLOR, 1 - computed),
            ("computed", COMPUTED_COLOR, computed),
        ]
    scales = [("confidence: 0 to 1", CONFIDENCE_SCALE)]
    scales += [(f"age: {AGED_S:g} s or more, to 0 s", AGE_SCALE)] if aged else []
    width, height = LEGEND_WIDTH - 2 * _MARGIN, len(rows) * _PITCH
    top = _MARGIN + _CAPTION
    figure = new_figure(LEGEND_WIDTH, top + height + _MARGIN + len(scales) * (_CAPTION + _BAR + _MARGIN))
    put_text(place(figure, (_MARGIN, _MARGIN, width, _CAPTION)), (0, 8), "class, fraction of the map", color=DIM_TEXT)
    put_legend(figure, (_MARGIN, top, width, height), rows)
    y = top + height + _MARGIN + _CAPTION
    for caption, scale in scales:
        bar = scale_colors(np.linspace(0, 1, width, dtype=np.float32), scale)
        put_picture(figure, (_MARGIN, y, width, _BAR), bar[None], caption)
        y += _CAPTION + _BAR + _MARGIN
    return figure


def camera_path(camera: str) -> str:
    """Entity of a camera; its image plane is below it."""
    return rr.new_entity_path(["world", "cameras", camera])


def layout(
    cameras: Sequence[str], *, mapped: bool, aged: bool, computed: bool = False, eye: Eye | None
) -> rrb.Blueprint:
    """The map in one tab a colouring, the legend next to it, the images of each camera, and the times of all stages.

    Args:
        cameras: Their names; none for a map alone.
        mapped: There is a map.
        aged: Its ages are known.
        computed: No sensor measured some of it.
        eye: From where to look first; None leaves it to the viewer.
    """
    seen = [f"+ {camera_path(c)}/{part}" for c in cameras for part in ("", "image", "image/rgb", "moving")]
    seen = [line.rstrip("/") for line in seen] + ["+ /world/path/**"]
    eyes = None
    if eye is not None:
        eyes = rrb.EyeControls3D(position=eye.position, look_target=eye.target, eye_up=eye.up)
    maps = [
        rrb.Spatial3DView(
            origin="/world",
            contents=[*seen, f"+ /world/map/{name}", *(["+ /world/graph/**"] if name == "class" else [])],
            name=f"map: {name}",
            eye_controls=eyes,
            line_grid=False,
        )
        for name in COLOURINGS
        if (aged or name != "age") and (computed or name != "measured")
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
