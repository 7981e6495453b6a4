"""Part of a map: surface points and mesh in a box."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.mapping.files.extract import triangle_mesh
from semantic_mapper.mapping.map_types import MapMesh, MapPoints
from semantic_mapper.mapping.storage.block_grid import BlockGrid
from semantic_mapper.mapping.storage.block_index import find_blocks
from semantic_mapper.mapping.storage.block_store import BlockValues
from semantic_mapper.mapping.storage.changes import TSDF_STEPS
from semantic_mapper.queries.checks import check_box, rows_in_box
from semantic_mapper.queries.rays import nearest_corners
from semantic_mapper.queries.snapshot import MapSnapshot
from semantic_mapper.queries.surface import SurfaceVoxels, surface_points, surface_voxels


def points_in_box(snapshot: MapSnapshot, lower: ArrayLike, upper: ArrayLike) -> MapPoints:
    """Surface points in a box, one a surface voxel, in a fixed order.

    Args:
        snapshot: The map.
        lower, upper: (3,) corners, world metres.

    Raises:
        MapError: see ``checks.check_box``.
    """
    low, high = check_box(lower, upper, snapshot)
    surface = surface_voxels(snapshot, rows_in_box(snapshot, low, high))
    inside = ((surface.point >= low) & (surface.point <= high)).all(axis=1)
    return surface_points(snapshot, SurfaceVoxels(surface.row[inside], surface.voxel[inside], surface.point[inside]))


def mesh_in_box(snapshot: MapSnapshot, lower: ArrayLike, upper: ArrayLike) -> MapMesh:
    """Triangles with their centre in a box, by the map's own marching cubes (needs Open3D), in a fixed order.

    Args:
        snapshot: The map.
        lower, upper: (3,) corners, world metres.

    Raises:
        MapError: see ``checks.check_box``.
        DependencyError: Open3D cannot be loaded.
    """
    low, high = check_box(lower, upper, snapshot)
    cells = rows_in_box(snapshot, low - 1, high)  # a triangle lies at most a voxel above its cell's first corner
    around = rows_in_box(snapshot, low - 1, high + 8)  # cells reach into the next blocks
    grid = BlockGrid(snapshot.voxel_size_m, 1, max(1, len(around)), max(1, len(around)))
    grid.fill(snapshot.packed[around], _values(snapshot, around))
    blocks = find_blocks(grid.index, snapshot.packed[cells])
    corners, faces = triangle_mesh(snapshot.keys[cells], blocks, grid, snapshot.voxel_size_m, 1.0)
    center = corners[faces].mean(axis=1, dtype=np.float64) / snapshot.voxel_size_m
    faces = faces[((center >= low) & (center <= high)).all(axis=1)]
    kept, renumbered = np.unique(faces, return_inverse=True)
    vertices = corners[kept]
    places = vertices.astype(np.float64) / snapshot.voxel_size_m  # between observed voxels: each has one
    corner = nearest_corners(places, snapshot)
    label, confidence, rgb = snapshot.read(*corner)
    faces = renumbered.reshape(-1, 3).astype(np.int32)
    return MapMesh(vertices, faces, rgb, label, confidence, snapshot.measured(*corner))


def _values(snapshot: MapSnapshot, rows: NDArray[np.int64]) -> BlockValues:
    """Geometry of blocks (B,) as the map's storage has it; no classes and no colours."""
    slots = snapshot.slots[rows]
    tsdf = (snapshot.voxels.tsdf[slots] / TSDF_STEPS).astype(np.float32)
    weight = snapshot.voxels.weight[slots].astype(np.float32)
    none = np.zeros((), np.float32)
    return BlockValues(
        tsdf,
        weight,
        np.broadcast_to(none, (*tsdf.shape, 3)),
        np.broadcast_to(none, (*tsdf.shape, 1)),
        np.broadcast_to(none, tsdf.shape),
    )
