"""Reading the surface of a map: as seen from a pose, at points, as points and as a triangle mesh.

Open3D's own ``ray_cast`` is off by half a voxel and can crash; this one walks from block to block, steps by the TSDF
and finds the zero crossing on the interpolated field. Points are read by interpolation over the eight voxels around.

With n votes that say ``log p`` on average, ``p = softmax(n_eff log p)``, where ``n_eff = n / (1 + rho (n - 1))``
for n > 1: views of one place repeat each other's errors, so a hundred of them are worth at most 1 / rho independent
ones; else n_eff = 1. The label is the argmax, its confidence p[label]. Below ``unknown_below`` the label is unknown,
the confidence stays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.mapping.allocation import Camera, blocks_in_view, blocks_within_reach
from semantic_mapper.mapping.block_grid import BLOCK_SIDE, NEIGHBOURS, BlockGrid, GridBuffers
from semantic_mapper.mapping.blocks import BlockIndex, find_blocks, pack_keys, unpack_keys
from semantic_mapper.mapping.map_types import MapMesh
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, Int32, Int64, UInt8


class Window(NamedTuple):
    """Part of an image: first row and column, rows and columns."""

    top: int
    left: int
    height: int
    width: int

    def halves(self) -> tuple[Window, Window]:
        """Both halves of its longer side."""
        if self.height > self.width:
            half = self.height // 2
            return self._replace(height=half), self._replace(top=self.top + half, height=self.height - half)
        half = self.width // 2
        return self._replace(width=half), self._replace(left=self.left + half, width=self.width - half)


class Readout(NamedTuple):
    """What a map says at points or pixels (...)."""

    rgb: UInt8  # (..., 3)
    channel: Int64  # of the class; -1 = unknown
    confidence: Float32  # 0 = no votes
    measured: Bool  # False where depth of a voxel around was computed, or none lies around


def _empty_readout(shape: tuple[int, ...]) -> Readout:
    channel, confidence = np.full(shape, -1, np.int64), np.zeros(shape, np.float32)
    return Readout(np.zeros((*shape, 3), np.uint8), channel, confidence, np.zeros(shape, np.bool_))


def cast_view(
    grid: BlockGrid, camera: Camera, intrinsics: CameraIntrinsics, config: VoxelMapConfig, wanted: Bool | None = None
) -> tuple[Float32, Readout]:
    """See the map through a camera, up to ``depth_max_m`` away: depth (H, W), 0 = miss, and the rest; where ``wanted``
    (H, W), or everywhere.

    What it may see and is on disk comes back, for a part of the image after the other where memory has no room for all.
    (Where even what one pixel may see does not fit, its ray meets the nearest of that.)"""
    size = (intrinsics.height, intrinsics.width)
    depth, seen = np.zeros(size, np.float32), _empty_readout(size)
    wanted = np.ones(size, np.bool_) if wanted is None else np.ascontiguousarray(wanted)
    lengths = config.voxel_size_m, config.truncation_voxels, config.depth_max_m
    for window, needed in _windows(grid, camera, intrinsics, config):
        if len(needed):
            grid.page_in(needed)
        memory = config.vote_discount, config.unknown_below, grid.index, grid.buffers()
        _cast_view_rows(window.height, camera, window, *lengths, *memory, wanted, depth, seen)
    return depth, seen


def _windows(
    grid: BlockGrid, camera: Camera, intrinsics: CameraIntrinsics, config: VoxelMapConfig
) -> Iterator[tuple[Window, Int64]]:
    """Parts of an image that together are all of it, each with packed keys (B,) of what it may see, nearest first; one
    part, and no keys, where nothing is on disk."""
    whole = Window(0, 0, intrinsics.height, intrinsics.width)
    if not grid.stored_count:
        yield whole, np.empty(0, np.int64)
        return
    voxel, reach = config.voxel_size_m, config.depth_max_m + config.truncation_voxels * config.voxel_size_m
    waiting = [(whole, grid.keys_between(*blocks_within_reach(camera, (whole.height, whole.width), voxel, reach)))]
    while waiting:
        window, keys = waiting.pop()
        moved = camera._replace(cx=camera.cx - window.left, cy=camera.cy - window.top)
        seen = blocks_in_view(moved, (window.height, window.width), keys, voxel, reach)
        if len(seen) <= grid.room or window.height * window.width == 1:
            yield window, seen
        else:
            waiting += [(half, unpack_keys(seen)) for half in reversed(window.halves())]


def read_points(
    voxels: Float64, index: BlockIndex, buffers: GridBuffers, vote_discount: float, unknown_below: float
) -> Readout:
    """What a map says at points (N, 3), float64, in units of voxels."""
    points, read = np.ascontiguousarray(voxels), _empty_readout((len(voxels),))
    _read_map_points(len(points), points, index, buffers, vote_discount, unknown_below, read)
    return read


def surface_voxels(keys: Int32, blocks: Int32, grid: BlockGrid, min_weight: float) -> Float64:
    """Zero crossings along voxel edges, (N, 3) float64 in units of voxels, of blocks with coordinates ``keys`` (B, 3)
    and buffer indices (B,), in their order; both ends of an edge need ``min_weight``."""
    keys, blocks, buffers = np.ascontiguousarray(keys), np.ascontiguousarray(blocks), grid.buffers()
    starts = np.zeros(len(blocks) + 1, np.int64)
    _count_crossings(len(blocks), keys, blocks, grid.index, buffers, min_weight, starts[1:])
    np.cumsum(starts, out=starts)
    points = np.empty((int(starts[-1]), 3), np.float64)
    _write_crossings(len(blocks), keys, blocks, grid.index, buffers, min_weight, starts, points)
    return points


def triangle_mesh(tile: Int32, grid: BlockGrid, voxel_size_m: float, min_weight: float) -> tuple[Float32, Int32]:
    """Marching cubes over the cells of sorted blocks (B, 3): vertices (V, 3) in metres, faces (F, 3), in a fixed order.

    Cells reach into the next blocks, so those are copied, too."""
    wanted = np.unique(pack_keys((tile[:, None] + NEIGHBOURS).reshape(-1, 3)))
    found, buffers = find_blocks(grid.index, wanted), grid.buffers()
    keys, source = unpack_keys(wanted[found >= 0]), found[found >= 0]
    attributes = {name: getattr(buffers, name)[source] for name in ("tsdf", "weight", "color")}
    triangles = np.empty((0, 3, 3), np.float32)
    if len(keys):
        # Open3D keeps what is strictly above its threshold.
        least = float(np.nextafter(np.float32(min_weight), np.float32(0)))
        mesh = open3d_grid(keys, voxel_size_m, **attributes).extract_triangle_mesh(least)
        if not mesh.is_empty() and "indices" in mesh.triangle:
            triangles = mesh.vertex.positions.numpy()[mesh.triangle.indices.numpy()]
    cell = np.floor(triangles.mean(axis=1) / voxel_size_m)
    own = np.isin(pack_keys((cell // BLOCK_SIDE).astype(np.int32)), pack_keys(tile))
    vertices, inverse = np.unique(triangles[own].reshape(-1, 3), axis=0, return_inverse=True)
    return vertices.astype(np.float32), _in_order(inverse.reshape(-1, 3))


def open3d_grid(keys: Int32, voxel_size_m: float, **attributes: NDArray[np.generic]) -> Any:
    """An ``open3d.t.geometry.VoxelBlockGrid`` on the CPU of blocks (B, 3), with attributes (B, 512) or (B, 512, C)."""
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


def join_meshes(parts: Sequence[MapMesh]) -> MapMesh:
    """One mesh of several that share vertices at their borders, in the order that ``triangle_mesh`` gives."""
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    corners = np.concatenate([part.vertices for part in parts])
    vertices, first, inverse = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    faces = _in_order(inverse.reshape(-1)[faces])
    read = ("rgb", "label", "confidence", "measured")
    return MapMesh(vertices, faces, *(np.concatenate([getattr(part, name) for part in parts])[first] for name in read))


def _in_order(faces: Int64) -> Int32:
    """Faces (F, 3) in an order that does not depend on threads, those without area left out."""
    first = faces.argmin(axis=1)[:, None]  # start each face at its least vertex: same winding, one spelling
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort(faces.T[::-1])]
    proper = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 0] != faces[:, 2])
    return faces[proper].astype(np.int32)


@parallel_kernel()
def _cast_view_rows(
    rows: int,
    camera: Camera,
    window: Window,
    voxel_size_m: float,
    truncation_voxels: float,
    depth_max_m: float,
    vote_discount: float,
    unknown_below: float,
    index: BlockIndex,
    buffers: GridBuffers,
    wanted: Bool,
    depth: Float32,
    seen: Readout,
) -> None:
    """Fill the rows of a window of what ``cast_view`` returns."""


@parallel_kernel()
def _read_map_points(
    count: int,
    voxels: Float64,
    index: BlockIndex,
    buffers: GridBuffers,
    vote_discount: float,
    unknown_below: float,
    read: Readout,
) -> None:
    """Fill what ``read_points`` returns."""


@parallel_kernel()
def _count_crossings(
    count: int, keys: Int32, blocks: Int32, index: BlockIndex, buffers: GridBuffers, min_weight: float, counts: Int64
) -> None:
    """Crossings of each block (B,); keys (B, 3), buffer indices (B,)."""


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
