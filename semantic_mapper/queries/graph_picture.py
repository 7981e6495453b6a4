"""The graph of a map as a picture: each floor from above, as a floor plan is exported: x to the right, y upwards."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from semantic_mapper.mapping.files.up_axis import turn_onto
from semantic_mapper.plots import CYCLE, SMALL_PT, TITLE_PT, cut, new_figure, rendered
from semantic_mapper.queries.graph import Floor, SceneGraph
from semantic_mapper.types import Float64

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

FLOOR_WIDTH, FLOOR_HEIGHT = 900, 760
NAMED_M = 0.7  # smaller things would cover each other's names


@rendered
def draw_graph(title: str, graph: SceneGraph) -> Figure:
    """Rooms in colours with id and area, doors as white dots with their width, things as dots, the large with class."""
    count = max(len(graph.floors), 1)
    figure = new_figure(FLOOR_WIDTH * count, FLOOR_HEIGHT, layout="constrained")
    figure.suptitle(cut(title, FLOOR_WIDTH * count - 30, TITLE_PT, "bold"), x=0.012, ha="left")
    R_grid_world = turn_onto(graph.up, np.array((0.0, 0.0, 1.0)))
    for number, floor in enumerate(graph.floors, start=1):
        axes = figure.add_subplot(
            1, count, number, aspect="equal", adjustable="datalim", xlabel="metres", ylabel="metres"
        )
        axes.set_title(f"floor {floor.id} at {floor.height_m:.2f} m")
        axes.grid(visible=False)
        _draw_floor(axes, graph, floor, R_grid_world)
    return figure


def _draw_floor(axes: Axes, graph: SceneGraph, floor: Floor, R_grid_world: Float64) -> None:
    def plan(xyz: Float64) -> Float64:
        return (xyz @ R_grid_world.T)[..., :2]

    for room in graph.rooms:
        if room.floor != floor.id:
            continue
        x, y = plan(room.outline).T
        axes.fill(x, y, color=CYCLE[room.id % len(CYCLE)], alpha=0.45, linewidth=0)
        x, y = plan(room.center)
        axes.text(x, y, f"{room.id}\n{room.area_m2:.1f} m²", ha="center", va="center", weight="bold")
    for door in graph.doors:
        if door.rooms[0] in floor.rooms:
            x, y = plan(door.center)
            axes.plot(x, y, "o", color="white", markersize=6)
            axes.annotate(f"{door.width_m:.2f} m", (x, y), (5, 5), textcoords="offset points", fontsize=SMALL_PT)
    for thing in graph.things:
        if graph.room_of[thing.id] in floor.rooms:
            x, y = plan(thing.centroid)
            axes.plot(x, y, ".", color="black", markersize=4)
            if thing.box.size.max() >= NAMED_M:
                axes.annotate(thing.class_name, (x, y), (2, 2), textcoords="offset points", fontsize=SMALL_PT * 0.7)
