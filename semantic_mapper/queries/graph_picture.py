"""The graph of a map as a picture: each floor from above, as a floor plan is exported: x to the right, y upwards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from semantic_mapper.geometry import turn_onto
from semantic_mapper.plots import CYCLE, SMALL_PT, TITLE_PT, cut, new_figure, rendered
from semantic_mapper.queries.graph import Floor, SceneGraph
from semantic_mapper.types import Float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FLOOR_WIDTH, FLOOR_HEIGHT = 900, 760
NAMED_M = 0.7  # smaller things have no names
LETTER_PX, PLAN_FRACTION = 7, 0.8  # width of a letter; how much of a picture its plan takes


@rendered
def draw_graph(title: str, graph: SceneGraph) -> Figure:
    """Rooms in colours with id and area, doors as white dots with their width, things as dots, the large with class.

    A name that would cover another is left out.
    """
    count = max(len(graph.floors), 1)
    figure = new_figure(FLOOR_WIDTH * count, FLOOR_HEIGHT, layout="constrained")
    figure.suptitle(cut(title, FLOOR_WIDTH * count - 30, TITLE_PT, "bold"), x=0.012, ha="left")
    R_grid_world = turn_onto(graph.up, np.array((0.0, 0.0, 1.0)))
    for number, floor in enumerate(graph.floors, start=1):
        axes = figure.add_subplot(
            1, count, number, aspect="equal", adjustable="datalim", xlabel="metres", ylabel="metres"
        )
        axes.set_title(f"floor {floor.id} at {round(floor.height_m, 2) + 0.0:.2f} m")  # + 0: no minus before zero
        axes.grid(visible=False)
        _draw_floor(axes, graph, floor, R_grid_world)
    return figure


def _draw_floor(axes: Axes, graph: SceneGraph, floor: Floor, R_grid_world: Float64) -> None:
    def plan(xyz: Float64) -> Float64:
        return (xyz @ R_grid_world.T)[..., :2]

    names = _Names(np.concatenate([plan(room.outline) for room in graph.rooms if room.floor == floor.id] or [[(0, 0)]]))
    for room in graph.rooms:
        if room.floor != floor.id:
            continue
        x, y = plan(room.outline).T
        axes.fill(x, y, color=CYCLE[room.id % len(CYCLE)], alpha=0.45, linewidth=0)
        x, y = plan(room.center)
        names.take((x, y), "0000 m²", 2.4, centred=True)
        axes.text(x, y, f"{room.id}\n{room.area_m2:.1f} m²", ha="center", va="center", weight="bold")
    for door in graph.doors:
        if door.rooms[0] in floor.rooms:
            x, y = plan(door.center)
            axes.plot(x, y, "o", color="white", markersize=6)
            if names.take((x, y), "0.00 m  ", 1.2):
                axes.annotate(f"{door.width_m:.2f} m", (x, y), (5, 5), textcoords="offset points", fontsize=SMALL_PT)
    for thing in sorted(graph.things, key=lambda thing: -thing.box.size.max()):
        if graph.room_of[thing.id] in floor.rooms:
            x, y = plan(thing.centroid)
            axes.plot(x, y, ".", color="black", markersize=4)
            if thing.box.size.max() >= NAMED_M and names.take((x, y), thing.class_name, 0.9):
                axes.annotate(thing.class_name, (x, y), (2, 2), textcoords="offset points", fontsize=SMALL_PT * 0.7)


class _Names:
    """Where names stand on the plan of a floor, so that none covers another; sizes are estimates.

    Args:
        xy: (N, 2) of what the plan shows, metres.
    """

    def __init__(self, xy: Float64) -> None:
        width, height = np.ptp(xy, axis=0)
        self._letter_m = LETTER_PX * max(width / FLOOR_WIDTH, height / FLOOR_HEIGHT, 1e-3) / PLAN_FRACTION
        self._taken: list[tuple[float, float, float, float]] = []

    def take(self, at: tuple[float, float], text: str, lines: float, *, centred: bool = False) -> bool:
        """Take room for a name next to a point, or around it; False where another name stands there."""
        width, height = self._letter_m * len(text), 2 * self._letter_m * lines
        left, low = (at[0] - width / 2, at[1] - height / 2) if centred else at
        free = all(left >= b[2] or left + width <= b[0] or low >= b[3] or low + height <= b[1] for b in self._taken)
        if free or centred:
            self._taken.append((left, low, left + width, low + height))
        return free
