"""Surface points at the zero crossings of the TSDF, and the triangle mesh."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.mapping.map_types import MapMesh
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.storage.block_grid import BLOCK_SIDE, BlockGrid, GridBuffers
from semantic_mapper.mapping.storage.block_index import BlockIndex, find_blocks, pack_keys, unpack_keys
from semantic_mapper.types import Float32, Float64, Int32, Int64

MESH_TILE_BLOCKS = 16_384  # Open3D fails past 262,100 blocks of 8^3 (int32), and needs 8 KiB a block to mesh


def surface_voxels(keys: NDArray[np.int32], blocks: NDArray[np.int32], grid: BlockGrid, min_weight: float) -> Float64:
    """Zero crossings along voxel edges, (N, 3) float64 in units of voxels, in the order of the blocks.

    Args:
        keys, blocks: (B, 3) coordinates and (B,) buffer indices of the blocks to look at.
        grid: The map's storage.
        min_weight: Both ends of an edge need this TSDF weight.
    """
    keys, blocks, buffers = np.ascontiguousarray(keys), np.ascontiguousarray(blocks), grid.buffers()
    starts = np.zeros(len(blocks) + 1, np.int64)
    _count_crossings(len(blocks), keys, blocks, grid.index, buffers, min_weight, starts[1:])
    np.cumsum(starts, out=starts)
    points = np.empty((int(starts[-1]), 3), np.float64)
    _write_crossings(len(blocks), keys, blocks, grid.index, buffers, min_weight, starts, points)
    return points


@parallel_kernel()
def _count_crossings(
    count: int,
    keys: Int32,
    blocks: Int32,
    index: BlockIndex,
    buffers: GridBuffers,
    min_weight: float,
    counts: Int64,
) -> None:
    """Crossings of each block (B,); keys (B, 3), buffer indices (B,)."""
    ...


@parallel_kernel()
def _write_crossings(
    count: int,
    keys: Int32,
    blocks: Int32,
    index: BlockIndex,
    buffers: GridBuffers,
    min_weight: float,
    starts: Int64,
    points: Float64,
) -> None:
    """The crossings of block n, in units of voxels, into ``points[starts[n] : starts[n + 1]]``; points (N, 3)."""
    ...


def triangle_mesh(
    keys: NDArray[np.int32], blocks: NDArray[np.int32], grid: BlockGrid, voxel_size_m: float, min_weight: float
) -> tuple[Float32, NDArray[np.int32]]:
    """Marching cubes over sorted blocks, tile by tile: vertices (V, 3) in metres, faces (F, 3), in a fixed order."""
    corners = []
    for start in range(0, len(blocks), MESH_TILE_BLOCKS):
        tile = keys[start : start + MESH_TILE_BLOCKS]
        corners.append(_tile_triangles(tile, grid.index, grid.buffers(), voxel_size_m, min_weight))
    triangles = np.concatenate(corners) if corners else np.empty((0, 3, 3), np.float32)
    return _weld(triangles)


def _tile_triangles(
    tile: NDArray[np.int32], index: BlockIndex, buffers: GridBuffers, voxel_size_m: float, min_weight: float
) -> Float32:
    """Triangles (T, 3, 3) of the cells of the tile's blocks; cells reach into the next blocks, so those are copied."""
    offsets = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.int32)
    wanted = np.unique(pack_keys((tile[:, None] + offsets).reshape(-1, 3)))
    found = find_blocks(index, wanted)
    keys, source = unpack_keys(wanted[found >= 0]), found[found >= 0]
    grid = open3d_grid(
        keys, voxel_size_m, tsdf=buffers.tsdf[source], weight=buffers.weight[source], color=buffers.color[source]
    )
    # Open3D keeps what is strictly above its threshold.
    mesh = grid.extract_triangle_mesh(float(np.nextafter(np.float32(min_weight), np.float32(0))))
    triangles = _triangles_of(mesh)
    cell = np.floor(triangles.mean(axis=1) / voxel_size_m)
    own = np.isin(pack_keys((cell // BLOCK_SIDE).astype(np.int32)), pack_keys(tile))
    return triangles[own]


def open3d_grid(keys: NDArray[np.int32], voxel_size_m: float, **attributes: NDArray[np.generic]) -> Any:
    """An ``open3d.t.geometry.VoxelBlockGrid`` on the CPU of blocks (B, 3), with attributes (B, 512) or (B, 512, C).

    Raises:
        DependencyError: Open3D cannot be loaded.
    """
    o3d = load_open3d()
    dtypes = tuple(o3d.core.Tensor.from_numpy(np.empty(0, values.dtype)).dtype for values in attributes.values())
    shapes = tuple(values.shape[2:] or (1,) for values in attributes.values())
    device = o3d.core.Device("CPU:0")
    grid = o3d.t.geometry.VoxelBlockGrid(tuple(attributes), dtypes, shapes, voxel_size_m, BLOCK_SIDE, len(keys), device)
    places, _ = grid.hashmap().activate(o3d.core.Tensor.from_numpy(np.ascontiguousarray(keys)))
    for name, values in attributes.items():
        memory = grid.attribute(name).numpy()
        memory.reshape(len(memory), *values.shape[1:])[places.numpy()] = values
    return grid


def _triangles_of(mesh: Any) -> Float32:
    if mesh.is_empty() or "indices" not in mesh.triangle:
        return np.empty((0, 3, 3), np.float32)
    return mesh.vertex.positions.numpy()[mesh.triangle.indices.numpy()]


def join_meshes(parts: Sequence[MapMesh]) -> MapMesh:
    """One mesh of several that share vertices at their borders, in the order that ``triangle_mesh`` gives."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    corners = np.concatenate([part.vertices for part in parts])
    vertices, first, inverse = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    faces = _in_order(inverse.reshape(-1)[faces])
    read = ("rgb", "label", "confidence", "measured")
    return MapMesh(vertices, faces, *(np.concatenate([getattr(part, name) for part in parts])[first] for name in read))


def _weld(triangles: Float32) -> tuple[Float32, NDArray[np.int32]]:
    """Join equal corners and put vertices and faces in an order that does not depend on threads."""
    vertices, inverse = np.unique(triangles.reshape(-1, 3), axis=0, return_inverse=True)
    return vertices.astype(np.float32), _in_order(inverse.reshape(-1, 3))


def _in_order(faces: NDArray[np.int64]) -> NDArray[np.int32]:
    """Faces (F, 3) in one spelling and order, those without area left out."""
    first = faces.argmin(axis=1)[:, None]  # start each face at its least vertex: same winding, one spelling
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    return faces[proper].astype(np.int32)
