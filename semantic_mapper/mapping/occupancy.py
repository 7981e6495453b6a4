"""A floor plan for a robot that drives: which cells are free, which are occupied, and which nobody knows.

The map keeps voxels in a thin band round surfaces, so the air between a camera and what it saw is mostly not in it:
that nothing is stored at a place does not mean that nothing is there. A plan made of a map can therefore say "free"
only where the *floor* was seen and no surface stands above it:

- occupied: a surface between LOW and HIGH above the floor;
- free: no such surface, and a surface between -LOW and LOW, the floor itself (thresholds and carpets are floor);
- unknown: neither. A hole in the floor is unknown, not free, and so is a floor hidden under something.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.geometry import turn_onto
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.types import Float64

FREE, OCCUPIED, UNKNOWN = 0, 100, -1  # as in ROS's OccupancyGrid
LAYER_M = 0.04  # thickness of the layers among which the floor is looked for
FLOOR_SHARE = 0.25  # of the fullest layer: the lowest one with this many points is the floor
MAX_CELLS = 100_000_000


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyGrid:
    """A floor plan in the grid's frame: z up, the floor at z = 0, x and y those of the world where that has z up, too.

    Args:
        cells: (H, W) int8, ``FREE``, ``OCCUPIED`` or ``UNKNOWN``; row j, column i is the square from
            ``origin_m + (i, j) * resolution_m`` on: rows run along +y.
        resolution_m: Side of a cell.
        origin_m: (x, y) of the outer corner of cell (0, 0).
        T_grid_world: (4, 4).
        costs: (H, W) int8, 0 to 100 or ``UNKNOWN``, by class; None where no costs were given.
    """

    cells: NDArray[np.int8]
    resolution_m: float
    origin_m: tuple[float, float]
    T_grid_world: Float64
    costs: NDArray[np.int8] | None = None


def occupancy_grid(
    points: MapPoints,
    up: Float64,
    resolution_m: float,
    height_m: tuple[float, float],
    floor_m: float | None = None,
    cost_of: NDArray[np.int64] | None = None,
) -> OccupancyGrid:
    """Make the plan of a map's surface points; see the head of this file for what its values mean.

    Args:
        points: Of the map.
        up: (3,) unit vector, up in the world.
        resolution_m: Side of a cell; below the map's voxel size, walls would have holes.
        height_m: LOW and HIGH above the floor, 0 < LOW < HIGH.
        floor_m: Height of the floor, along ``up`` from the origin of the world; None = found by ``floor_height``.
        cost_of: (256,) cost of each class id, 0 to 100, -1 where a class has none of its own; None makes no ``costs``.
            A cell costs as much as the dearest surface in it between -LOW and HIGH. Surface without a cost of its own
            costs 100 where it is above LOW, and nothing where it is floor.

    Raises:
        MapError: impossible numbers, no points between -LOW and HIGH, or more than 100 million cells.
    """
    low, high = height_m
    if not (0 < low < high and np.isfinite(high)):
        raise MapError(f"height band {low:g} to {high:g} m: LOW must be above 0 and below HIGH")
    if not (resolution_m > 0 and np.isfinite(resolution_m)):
        raise MapError(f"resolution must be above 0, got {resolution_m} m")
    T_grid_world = np.eye(4)
    T_grid_world[:3, :3] = turn_onto(up, np.array((0.0, 0.0, 1.0)))
    xyz = points.xyz.astype(np.float64) @ T_grid_world[:3, :3].T
    floor = floor_height(xyz[:, 2]) if floor_m is None else floor_m
    T_grid_world[2, 3] = 0.0 - floor  # never -0
    height = xyz[:, 2] - floor
    within = (height >= -low) & (height <= high)
    if not within.any():
        raise MapError(
            f"no surface between {-low:g} m and {high:g} m of the floor (at height {floor:.2f} m); set the floor, the "
            "height band, or which way is up"
        )
    cell = np.floor(xyz[within, :2] / resolution_m).astype(np.int64)
    first = cell.min(axis=0)
    width, rows = (cell.max(axis=0) - first + 1).tolist()
    if width * rows > MAX_CELLS:
        raise MapError(f"a plan of {width} x {rows} cells of {resolution_m:g} m is too large; choose larger cells")
    column, row = (cell - first).T
    cells = np.full((rows, width), UNKNOWN, np.int8)
    cells[row, column] = FREE
    stands = height[within] >= low
    cells[row[stands], column[stands]] = OCCUPIED
    x, y = (first * resolution_m).tolist()
    costs = None
    if cost_of is not None:
        own = cost_of[points.label[within]]
        costs = np.full(cells.shape, UNKNOWN, np.int8)
        np.maximum.at(costs, (row, column), np.where(own >= 0, own, np.where(stands, OCCUPIED, FREE)).astype(np.int8))
    return OccupancyGrid(cells, resolution_m, (x, y), T_grid_world, costs)


def floor_height(height: Float64) -> float:
    """Height of the floor: the middle of the lowest layer that holds a quarter of what the fullest one holds.

    Args:
        height: (N,) of surface points, metres; N > 0.

    Raises:
        MapError: no points.
    """
    if not len(height):
        raise MapError("a map without surface has no floor")
    layer = np.floor((height - height.min()) / LAYER_M).astype(np.int64)
    counts = np.bincount(layer)
    lowest = int(np.flatnonzero(counts >= FLOOR_SHARE * counts.max())[0])
    while lowest + 1 < len(counts) and counts[lowest + 1] > counts[lowest]:
        lowest += 1
    return float(np.median(height[np.abs(layer - lowest) <= 1]))
