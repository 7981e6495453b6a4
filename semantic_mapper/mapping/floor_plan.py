"""Which way is up in a finished map, where its floor is, and a floor plan for a robot that drives.

The map keeps voxels in a thin band round surfaces, so the air between a camera and what it saw is mostly not in it:
that nothing is stored at a place does not mean that nothing is there. A plan made of a map can therefore say "free"
only where the *floor* was seen and no surface stands above it:

- occupied: a surface between LOW and HIGH above the floor;
- free: no such surface, and a surface between -LOW and LOW, the floor itself (thresholds and carpets are floor);
- unknown: neither. A hole in the floor is unknown, not free, and so is a floor hidden under something.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import MapError
from semantic_mapper.evaluation.upright import find_upright
from semantic_mapper.files import atomic_write
from semantic_mapper.geometry import invert_pose, transform, turn_onto
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.map_types import MapPoints
from semantic_mapper.types import Float64, Int64, UInt8

FLOOR = "floor"  # the class whose points say where down is
LEAST_SHARE = 0.01  # of a map's points that have to be floor
FLAT_M = 0.1  # the middle half of the floor's points lies within so much of height
LEVEL_SHARE = 0.8  # of the floor's points on several storeys, each within so much of height
STOREY_M = 1.8  # storeys are at least so far apart

FREE, OCCUPIED, UNKNOWN = 0, 100, -1  # as in ROS's OccupancyGrid
INFLATED = 99  # nearer to something occupied than the robot's radius, as nav2 publishes its costmaps
Band = tuple[float, float]
HEIGHT_M: Band = (0.1, 1.8)  # what a robot of a person's height can hit; what is lower, it rolls over
RESOLUTION_M = 0.05
LAYER_M = 0.04  # thickness of the layers among which the floor is looked for
FLOOR_SHARE = 0.25  # of the fullest layer: the lowest one with this many points is the floor
MAX_CELLS = 100_000_000
_FREE_GREY, _OCCUPIED_GREY, _UNKNOWN_GREY = 254, 0, 205
_OCCUPIED_ABOVE, _FREE_BELOW = 0.65, 0.196  # of (255 - grey) / 255; nav2's own 0.25 would read unknown as free
_UNKNOWN_RAW = 255  # mode raw: grey levels 0 to 100 are the costs themselves, and what is above is unknown


def find_up(points: MapPoints, label_set: LabelSet) -> Float64:
    """Up (3,) in the world: square to what is labelled floor, away from it, made exact as the overview picture does.

    ``MapError``: too little of the map is labelled floor, or what is lies in no plane."""
    named = [i for i, name in zip(label_set.ids, label_set.names, strict=True) if name == FLOOR]
    floor = points.xyz[np.isin(points.label, named)].astype(np.float64)
    if len(floor) < max(LEAST_SHARE * len(points.xyz), 10):
        raise MapError(
            "which way is up is not known: too little of the map is labelled floor; map more of it, or give `up`"
        )
    rise = points.xyz.mean(axis=0, dtype=np.float64) - floor.mean(axis=0)
    guess = _normal(floor)
    up = find_upright(points.xyz, guess if rise @ guess > 0 else -guess)
    low, high = np.percentile(floor @ up, (25, 75))
    if high - low <= FLAT_M:
        return up
    axis = max(np.eye(3), key=lambda axis: _level_share(floor @ axis))  # floors of storeys lie in no one plane
    up = find_upright(points.xyz, axis if rise @ axis > 0 else -axis)
    if _level_share(floor @ up) < LEVEL_SHARE:
        raise MapError(
            f"which way is up is not known: what is labelled floor lies in no plane ({high - low:.2f} m of height); "
            "give `up`"
        )
    return up


def _level_share(height: Float64) -> float:
    """Fraction of heights (N,), metres, that lie in layers of ``FLAT_M`` which are as far apart as storeys."""
    layer = np.floor((height - height.min()) / (FLAT_M / 2)).astype(np.int64)
    counts = np.convolve(np.bincount(layer), (1, 1))
    apart, found = round(2 * STOREY_M / FLAT_M), 0
    while counts.any():
        best = int(counts.argmax())
        found += int(counts[best])
        counts[max(0, best - apart) : best + apart] = 0
    return found / len(height)


def _normal(xyz: Float64) -> Float64:
    """Normal (3,) of the plane that most points (N, 3) lie near: fitted, and fitted again without the farthest."""
    near = xyz
    normal = np.zeros(3)
    for _ in range(4):
        center = near.mean(axis=0)
        normal = np.linalg.eigh((near - center).T @ (near - center))[1][:, 0]
        distance = np.abs((xyz - np.median(near, axis=0)) @ normal)
        near = xyz[distance <= np.percentile(distance, 70)]
    return normal


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyGrid:
    """A floor plan in the grid's frame: z up, the floor at z = 0, x and y those of a world that has z up."""

    # (H, W) int8: 0 free, 100 occupied, -1 unknown; in a costmap also 99, inflated: so near to a cell of 100 that the
    # robot hits it. Row j, column i is the square from ``origin_m + (i, j) * resolution_m`` on: rows run along +y
    cells: NDArray[np.int8]
    resolution_m: float  # side of a cell
    origin_m: tuple[float, float]  # (x, y) of the outer corner of cell (0, 0)
    T_grid_world: Float64  # (4, 4)
    # (H, W) int8, 0 to 100 or ``UNKNOWN``, by class; None where no costs were given
    costs: NDArray[np.int8] | None = None

    def at(self, points: ArrayLike) -> NDArray[np.int8]:
        """Values (N,) of the cells above or below points (N, 3) or (3,), world metres; -1 beyond the grid."""
        row, column = np.clip(self.cells_of(points) + 1, 0, np.array(self.cells.shape) + 1).T
        return np.pad(self.cells, 1, constant_values=UNKNOWN)[row, column]

    def cells_of(self, points: ArrayLike) -> Int64:
        """Row and column (N, 2) of the cells above or below points (N, 3) or (3,), world metres, wherever they are."""
        xy = transform(self.T_grid_world, np.atleast_2d(np.asarray(points, np.float64)))[:, :2]
        return np.floor((xy - self.origin_m) / self.resolution_m).astype(np.int64)[:, ::-1]

    def centres_of(self, cells: ArrayLike) -> Float64:
        """Centres (N, 3) of cells, row and column (N, 2), on the floor, world metres."""
        xy = (np.asarray(cells, np.float64)[:, ::-1] + 0.5) * self.resolution_m + self.origin_m
        return transform(invert_pose(self.T_grid_world), np.column_stack((xy, np.zeros(len(xy)))))

    def inflated(self, radius_m: float) -> OccupancyGrid:
        """With 99 where an occupied cell is at most ``radius_m`` away, centre to centre. ``MapError``: a bad radius."""
        if not 0 <= radius_m < np.inf:
            raise MapError(f"radius_m must be 0 or more, got {radius_m}")
        occupied = self.cells == OCCUPIED
        distance = cv2.distanceTransform((~occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)  # in cells
        near = ~occupied & (distance * self.resolution_m <= radius_m + 1e-6)
        return replace(self, cells=np.where(near, np.int8(INFLATED), self.cells))


def occupancy_grid(
    points: MapPoints,
    up: Float64,
    voxel_size_m: float,
    height_m: Band | None = None,
    floor_m: float | None = None,
    cost_of: NDArray[np.int64] | None = None,
    resolution_m: float | None = None,
) -> OccupancyGrid:
    """Make the plan of a map's surface points; see the head of this file for what its values mean. ``MapError``:
    impossible numbers, no points between -LOW and HIGH, or more than 100 million cells.

    Args:
        up: (3,) unit vector, up in the world.
        voxel_size_m: Of the map.
        height_m: LOW and HIGH above the floor, 0 < LOW < HIGH; None = ``HEIGHT_M``.
        floor_m: Height of the floor, along ``up`` from the origin of the world; None = found by ``floor_height``.
        cost_of: (256,) cost of each class id, 0 to 100, -1 = none of its own; None makes no ``costs``. A cell costs as
            much as the dearest surface in it; surface without a cost of its own 100 above LOW, and nothing as floor.
        resolution_m: Side of a cell; None = 5 cm, or a larger voxel."""
    low, high = height_m or HEIGHT_M
    if not (0 < low < high and np.isfinite(high)):
        raise MapError(f"height band {low:g} to {high:g} m: LOW must be above 0 and below HIGH")
    resolution_m = max(RESOLUTION_M, voxel_size_m) if resolution_m is None else resolution_m
    if not voxel_size_m <= resolution_m < np.inf:
        raise MapError(f"resolution {resolution_m} m: cells smaller than voxels ({voxel_size_m:g} m) leave holes")
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
    """Height of the floor: the middle of the lowest layer that holds a quarter of what the fullest one holds."""
    if not len(height):
        raise MapError("a map without surface has no floor")
    layer = np.floor((height - height.min()) / LAYER_M).astype(np.int64)
    counts = np.bincount(layer)
    lowest = int(np.flatnonzero(counts >= FLOOR_SHARE * counts.max())[0])
    while lowest + 1 < len(counts) and counts[lowest + 1] > counts[lowest]:
        lowest += 1
    return float(np.median(height[np.abs(layer - lowest) <= 1]))


def write_map_server(path: Path, grid: OccupancyGrid) -> tuple[Path, ...]:
    """Write the YAML and, next to it, the PGM of the same stem; of a grid with costs, these as ``STEM_costs``, too.

    The picture's first row is the grid's last one; ``origin`` is the outer corner of the lower left pixel.
    ``T_grid_world``, which map servers pass over, takes points of the world to the plan. Returns the files;
    ``MapError``: one cannot be written."""
    grey = np.full(grid.cells.shape, _UNKNOWN_GREY, np.uint8)
    grey[grid.cells == FREE] = _FREE_GREY
    grey[grid.cells == OCCUPIED] = _OCCUPIED_GREY
    files = _write_grid(path, grid, grey, "trinary")
    if grid.costs is None:
        return files
    grey = np.where(grid.costs < 0, _UNKNOWN_RAW, grid.costs.astype(np.uint8))
    return files + _write_grid(path.with_stem(f"{path.stem}_costs"), grid, grey, "raw")


def _write_grid(path: Path, grid: OccupancyGrid, grey: UInt8, mode: str) -> tuple[Path, Path]:
    picture, description = path.with_suffix(".pgm"), path.with_suffix(".yaml")
    rows, columns = grey.shape
    with atomic_write(picture, raises=MapError) as file:
        file.write(f"P5\n{columns} {rows}\n255\n".encode())
        file.write(np.ascontiguousarray(grey[::-1]).tobytes())
    x, y = grid.origin_m
    lines = (
        f"image: {json.dumps(picture.name)}",
        f"mode: {mode}",
        f"resolution: {grid.resolution_m!r}",
        f"origin: [{x:.6f}, {y:.6f}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {_OCCUPIED_ABOVE}",
        f"free_thresh: {_FREE_BELOW}",
        f"T_grid_world: {np.round(grid.T_grid_world, 9).tolist()}",
    )
    with atomic_write(description, raises=MapError) as file:
        file.write(("\n".join(lines) + "\n").encode())
    return description, picture
