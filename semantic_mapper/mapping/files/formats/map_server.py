"""Occupancy grids as ROS's ``map_server`` and nav2 read them: a grey picture (PGM) and its description (YAML)."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from semantic_mapper.errors import MapError
from semantic_mapper.files import atomic_write
from semantic_mapper.mapping.occupancy import FREE, OCCUPIED, OccupancyGrid
from semantic_mapper.types import UInt8

_FREE_GREY, _OCCUPIED_GREY, _UNKNOWN_GREY = 254, 0, 205
_OCCUPIED_ABOVE, _FREE_BELOW = 0.65, 0.196  # of (255 - grey) / 255; nav2's own 0.25 would read unknown as free
_UNKNOWN_RAW = 255  # mode raw: grey levels 0 to 100 are the costs themselves, and what is above is unknown


def write_map_server(path: Path, grid: OccupancyGrid) -> tuple[Path, ...]:
    """Write the YAML and, beside it, the PGM of the same stem; of a grid with costs, these as ``STEM_costs``, too.

    The picture's first row is the grid's last one: y runs upwards. ``origin`` is the outer corner of the lower left
    pixel. ``T_grid_world`` (4 rows), which map servers pass over, takes points of the world to the frame of the plan.

    Args:
        path: One of the two files.
        grid: The plan.

    Returns:
        The YAML and the PGM; then those of the costs.

    Raises:
        MapError: a file cannot be written.
    """
    grey = np.full(grid.cells.shape, _UNKNOWN_GREY, np.uint8)
    grey[grid.cells == FREE] = _FREE_GREY
    grey[grid.cells == OCCUPIED] = _OCCUPIED_GREY
    files = _write(path, grid, grey, "trinary")
    if grid.costs is None:
        return files
    grey = np.where(grid.costs < 0, _UNKNOWN_RAW, grid.costs).astype(np.uint8)
    return files + _write(path.with_stem(f"{path.stem}_costs"), grid, grey, "raw")


def _write(path: Path, grid: OccupancyGrid, grey: UInt8, mode: str) -> tuple[Path, Path]:
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
