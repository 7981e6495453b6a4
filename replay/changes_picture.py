"""Two maps of one place from above, side by side: what was moved, with arrows, what is new, and what has gone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from semantic_mapper import plots
from semantic_mapper.evaluation.upright import ceiling_height, plan_rotation, upright_rotation
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.queries.instances import OrientedBox
from semantic_mapper.queries.objects import ObjectChange
from semantic_mapper.replay.overview import MARGIN, MAX_POINTS, draw_points, fitted, from_above, put_scale_bar
from semantic_mapper.types import Float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT, TOP = 1600, 860, 100


@plots.rendered
def draw_changes(
    before: MapPoints, now: MapPoints, changes: Sequence[ObjectChange], up: Float64, *, title: str
) -> Figure:
    """Both maps (in the world of ``now``) without ceilings, with the ids of what has changed, 1600 pixels wide; ``up``
    is (3,) in that world."""
    size = ((WIDTH - 3 * MARGIN) // 2, HEIGHT - TOP - MARGIN)
    R = plan_rotation(now.xyz, up)
    shown = [_without_ceiling(points, up) for points in (before, now)]
    views = [
        from_above(points.xyz[inside].astype(np.float64) @ R.T)
        for points, inside in zip((before, now), shown, strict=True)
    ]
    camera = fitted(np.concatenate(views), size)
    counts = {kind: sum(c.kind == kind for c in changes) for kind in plots.CHANGE_COLORS}
    figure = plots.new_figure(WIDTH, HEIGHT)
    plots.put_title(figure, title, ", ".join(f"{count} {kind}" for kind, count in counts.items()))

    def pixels(xyz: Float64) -> Float64:
        return (from_above(np.atleast_2d(xyz) @ R.T)[:, :2] - camera[0]) * camera[1] + np.array(size) / 2

    parts = zip(("before", "now"), (before, now), shown, views, strict=True)
    for column, (name, points, inside, view) in enumerate(parts):
        picture, scale = draw_points(view, points.rgb[inside], size, plots.PANEL, camera=camera)
        axes = plots.put_picture(figure, (MARGIN + column * (size[0] + MARGIN), TOP, *size), picture, name)
        put_scale_bar(axes, scale, "m")
        for change in changes:
            old, new = change.before, None if change.kind == "gone" else change.object.places[-1]
            place = (old, new)[column]
            if place is None:
                continue
            color = "#" + bytes(plots.CHANGE_COLORS[change.kind]).hex()
            _put_box(axes, pixels(_corners(place.box)), str(change.object.id), color)
            if column and change.kind == "moved" and old is not None:
                start, end = pixels(np.stack((old.box.center, place.box.center)))
                axes.annotate("", end, start, arrowprops={"arrowstyle": "->", "color": color, "linewidth": 2})
    return figure


def _without_ceiling(points: MapPoints, up: Float64) -> np.ndarray:
    """Which points (N,) are drawn."""
    upright = points.xyz.astype(np.float64) @ upright_rotation(points.xyz, up).T
    height = ceiling_height(upright)
    inside = upright[:, 2] < (np.inf if height is None else height)
    inside[np.arange(len(inside)) % max(1, -(-len(inside) // MAX_POINTS)) != 0] = False
    return inside


def _corners(box: OrientedBox) -> Float64:
    """The upper face (4, 3) of an upright box, world metres."""
    signs = np.array(((-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)))
    return box.center + (signs * box.size / 2) @ box.R_world_box.T


def _put_box(axes: Axes, drawn: Float64, name: str, color: str) -> None:
    x, y = np.concatenate((drawn, drawn[:1])).T
    axes.plot(x, y, color="black", linewidth=3.5, clip_on=True)
    axes.plot(x, y, color=color, linewidth=1.8, clip_on=True)
    behind = {"facecolor": "black", "alpha": 0.6, "linewidth": 0, "pad": 1}
    plots.put_text(axes, (float(x.mean()), float(y.min()) - 9), name, bbox=behind, clip_on=True, ha="center")
