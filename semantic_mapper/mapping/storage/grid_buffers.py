"""The memory of Open3D's block hash map: made, measured, and as numpy arrays without a copy."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.mapping.storage.block_store import BLOCK_VOXELS
from semantic_mapper.types import Float32

BLOCK_SIDE = 8
SPARE_SHARE = 1.5  # of what one frame touches, where memory is to have room for it without pushing the last one out
ATTRIBUTES = ("tsdf", "weight", "color", "evidence", "votes")
_COPIED_AT_ONCE = 64  # blocks: a copy of them is to stay in the cache of the processor


class GridBuffers(NamedTuple):
    """Zero-copy views of the grid's memory, valid until the next ``BlockGrid.activate``.

    Args:
        keys: (capacity, 3) int32 block coordinates.
        tsdf: (capacity, 512) float32, signed distance over truncation in [-1, 1].
        weight: (capacity, 512) float32, number of depth measurements (capped).
        color: (capacity, 512, 3) float32 in 0..255.
        evidence: (capacity, 512, L), sum (float32) or mean (int16) of log probabilities by weight; see ``evidence``.
        votes: (capacity, 512) float32, sum of vote weights.
    """

    keys: NDArray[np.int32]
    tsdf: Float32
    weight: Float32
    color: Float32
    evidence: NDArray[Any]
    votes: Float32


def view_buffers(hash_map: Any) -> GridBuffers:
    """Views of an ``open3d.core.HashMap`` whose values are ``ATTRIBUTES``, valid until its memory moves."""
    tsdf, weight, color, evidence, votes = (hash_map.value_tensor(i).numpy() for i in range(len(ATTRIBUTES)))
    n = len(tsdf)
    return GridBuffers(
        keys=hash_map.key_tensor().numpy(),
        tsdf=tsdf.reshape(n, BLOCK_VOXELS),
        weight=weight.reshape(n, BLOCK_VOXELS),
        color=color.reshape(n, BLOCK_VOXELS, 3),
        evidence=evidence.reshape(n, BLOCK_VOXELS, -1),
        votes=votes.reshape(n, BLOCK_VOXELS),
    )


def advised_mb(blocks: int, block_bytes: int) -> int:
    """The ``voxel_map.memory_mb`` that so many blocks of one frame, and some of the frames before, fit in."""
    return math.ceil(SPARE_SHARE * blocks * block_bytes / 1e6)


def make_open3d_grid(voxel_size_m: float, channels: tuple[int, ...], capacity: int, evidence: str = "float32") -> Any:
    """An empty VoxelBlockGrid on the CPU with attributes named as in ``ATTRIBUTES``, float32 but for the evidence."""
    o3d = load_open3d()
    names = ATTRIBUTES[: len(channels)]
    dtypes = tuple(getattr(o3d.core, evidence) if name == "evidence" else o3d.core.float32 for name in names)
    shapes = tuple((c,) for c in channels)
    device = o3d.core.Device("CPU:0")
    return o3d.t.geometry.VoxelBlockGrid(names, dtypes, shapes, voxel_size_m, BLOCK_SIDE, capacity, device)


def copy_blocks(
    source: GridBuffers, keys: NDArray[np.int32], rows: NDArray[np.int32], target: Any
) -> NDArray[np.int32]:
    """Copy blocks into another hash map, which has room for them and none of them yet.

    Open3D's own ``reserve`` copies value by value, and holds up a frame eight times as long.

    Args:
        source: Where they are.
        keys: (B, 3) of them.
        rows: (B,) buffer indices in ``source``.
        target: Hash map of the other grid.

    Returns:
        Buffer indices there (B,).
    """
    if not len(keys):
        return rows
    o3d = load_open3d()
    activated, _ = target.activate(o3d.core.Tensor.from_numpy(np.ascontiguousarray(keys)))
    indices = activated.numpy().astype(np.int32)
    for values, copied in zip(source[1:], view_buffers(target)[1:], strict=True):
        for start in range(0, len(keys), _COPIED_AT_ONCE):
            part = slice(start, start + _COPIED_AT_ONCE)
            copied[indices[part]] = values[rows[part]]
    return indices
