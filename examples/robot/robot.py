"""A robot that drives to the nearest thing of a class, by the map of a running mapper."""

from __future__ import annotations

import argparse
import heapq
import math
import sys
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import ArrayLike, NDArray

from semantic_mapper import MapClient, MapSnapshot, OccupancyGrid, SemanticMapperError
from semantic_mapper.errors import MapError, TransportError
from semantic_mapper.queries.surface import surface_points, surface_voxels

Places = NDArray[np.float64]  # (N, 3) on the floor, world metres
Cell = tuple[int, int]

RADIUS_M = 0.2  # of the robot, seen from above
REACH_M = 0.5  # so near to the thing, along the floor, it has arrived
STEP_M = 0.25  # it drives so far, then looks at the map again
SPEED_M_S = 0.5
LIMIT_S = 120.0  # then it gives up
FREE, INFLATED, OCCUPIED, UNKNOWN = 0, 99, 100, -1
COLORS = {FREE: (255, 255, 255), INFLATED: (255, 214, 214), UNKNOWN: (190, 190, 190), OCCUPIED: (0, 0, 0)}
NAMES = {
    FREE: "free",
    INFLATED: f"within {RADIUS_M:g} m of something",
    UNKNOWN: "unknown",
    OCCUPIED: "of no sure class",
}


def plan(costs: OccupancyGrid, start: ArrayLike, goal: ArrayLike, reach_m: float = REACH_M) -> Places:
    """The shortest path (A*, 8 neighbours) over free cells from ``start`` (3,) to within ``reach_m`` of ``goal`` (3,),
    world metres; empty where there is none. An inflated start is left by the shortest path."""
    first, end = ((int(row), int(column)) for row, column in costs.cells_of(np.array((start, goal), np.float64)))
    rows, columns = costs.cells.shape
    reach = reach_m / costs.resolution_m

    def code(row: int, column: int) -> int:
        return int(costs.cells[row, column]) if 0 <= row < rows and 0 <= column < columns else UNKNOWN

    def left(cell: Cell) -> float:
        return max(0.0, math.dist(cell, end) - reach)

    length: dict[Cell, float] = {first: 0.0}
    came_from: dict[Cell, Cell] = {first: first}
    closed: set[Cell] = set()
    queue = [(left(first), first)] if code(*first) in (FREE, INFLATED) else []
    while queue:
        _, cell = heapq.heappop(queue)
        if left(cell) == 0 and (code(*cell) == FREE or cell == first):
            way = [cell]
            while way[-1] != first:
                way.append(came_from[way[-1]])
            return costs.centres_of(way[::-1])
        if cell in closed:
            continue
        closed.add(cell)
        open_to = (FREE, INFLATED) if code(*cell) == INFLATED else (FREE,)
        for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            to = (cell[0] + dr, cell[1] + dc)
            if any(code(*near) not in open_to for near in (to, (cell[0] + dr, cell[1]), (cell[0], cell[1] + dc))):
                continue  # the other two: never diagonally past a corner
            total = length[cell] + math.hypot(dr, dc) * (10 if code(*to) == INFLATED else 1)
            if total < length.get(to, math.inf):
                length[to], came_from[to] = total, cell
                heapq.heappush(queue, (total + left(to), to))
    return np.empty((0, 3))


def drive(client: MapClient, class_name: str, start: ArrayLike, picture: Path) -> str:
    """Drive from ``start`` (3,), world metres, a step at a time, with the map as it is then. Returns why it gave up, or
    an empty text; draws the way either way. Raises LabelError: no such class."""
    driven, why, said = np.array([start], np.float64), "", ""
    thing = costs = None
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        try:
            thing, costs = client.nearest(class_name, driven[-1]), client.costmap(RADIUS_M)
        except (MapError, TransportError) as error:  # no floor was seen yet, or the mapper is away: stand still
            why = str(error)
        else:
            way = plan(costs, driven[-1], thing.xyz) if thing else np.empty((0, 3))
            why = "" if len(way) else f"no {class_name} is known yet" if thing is None else "no free path is known yet"
            steps = way[1 : round(STEP_M / costs.resolution_m) + 1]
            driven = np.concatenate((driven, steps))
            if thing and len(way):
                x, y, _ = driven[-1]
                print(f"at {x:.2f} {y:.2f}, {class_name} {thing.distance_m:.2f} m away", flush=True)
                if len(way) == len(steps) + 1:
                    break
        if why and why != said:
            print(f"waiting: {why}", file=sys.stderr, flush=True)
        said = why
        time.sleep(STEP_M / SPEED_M_S)  # a real robot drives meanwhile, and takes its place from `client.pose()`
    else:
        why = f"gave up after {LIMIT_S:.0f} s: {why or 'still on the way'}"
    if costs is not None:
        draw(client.mirror().snapshot(), costs, driven, thing and thing.xyz, class_name, picture)
    return why


def draw(
    snapshot: MapSnapshot, costs: OccupancyGrid, driven: Places, goal: ArrayLike | None, name: str, file: Path
) -> None:
    """A picture from above: the costmap, what stands on it in the colours of its class, the way driven, the goal."""
    image = np.zeros((*costs.cells.shape, 3), np.uint8)
    for code, color in COLORS.items():
        image[costs.cells == code] = color
    points, labels = surface_points(snapshot, surface_voxels(snapshot)), snapshot.label_set
    top = np.flatnonzero(costs.at(points.xyz) == OCCUPIED)
    top = top[np.argsort(points.xyz[top, 2])]
    image[tuple(costs.cells_of(points.xyz[top]).T)] = labels.colorize(points.label[top])
    x, y = costs.origin_m
    height, width = np.array(costs.cells.shape) * costs.resolution_m
    figure = Figure((4 + 8 * width / max(width, height), 1 + 8 * height / max(width, height)), layout="constrained")
    axes = figure.add_subplot(xlabel="x, m", ylabel="y, m", title=f"path to the nearest {name}")
    axes.imshow(image, origin="lower", extent=(x, x + width, y, y + height))
    places = (costs.cells_of(driven)[:, ::-1] + 0.5) * costs.resolution_m + costs.origin_m
    axes.plot(*places.T, "-", color="#0050c8", linewidth=3, label="path driven")
    axes.plot(*places[0], "o", color="#0050c8", markersize=10, label="start")
    if goal is not None:
        at = (costs.cells_of(np.atleast_2d(goal))[0, ::-1] + 0.5) * costs.resolution_m + costs.origin_m
        axes.plot(*at, "*", color="#d00000", markersize=18, markeredgecolor="white", label=f"nearest {name}")
    ids, counts = np.unique(points.label[top], return_counts=True)
    seen = [labels.ids.index(i) for i in ids[np.argsort(-counts)] if i in labels.ids]
    keys = [(COLORS[code], NAMES[code]) for code in COLORS] + [(labels.colors[i], labels.names[i]) for i in seen[:12]]
    handles = [Patch(facecolor=(r / 255, g / 255, b / 255), edgecolor="grey", label=text) for (r, g, b), text in keys]
    axes.legend(handles=axes.get_legend_handles_labels()[0] + handles, loc="upper left", bbox_to_anchor=(1.01, 1))
    figure.savefig(file, dpi=100)


def main() -> int | str:
    """The command: 0 arrived; 1 with why not; 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(description="Drive to the nearest thing of a class.")
    parser.add_argument("class_name", metavar="CLASS")
    for axis in ("X", "Y", "Z"):
        parser.add_argument(axis, type=float, help="of the robot, world metres")
    parser.add_argument("--at", default="live", metavar="PLACE", help="of the mapper, as of MapClient")
    parser.add_argument("--picture", type=Path, default=Path("path.png"), metavar="FILE", help="to write")
    given = parser.parse_args()
    try:
        with MapClient(given.at) as client:
            why = drive(client, given.class_name, (given.X, given.Y, given.Z), given.picture)
    except (SemanticMapperError, OSError) as error:
        return f"sample-robot: {error}"
    except KeyboardInterrupt:
        return 130
    print(f"{why or 'arrived'}; {given.picture}")
    return int(bool(why))


if __name__ == "__main__":
    sys.exit(main())
