"""The surface of a map in patches of one block, with how much each is in need of class votes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.mapping.storage.block_index import pack_keys
from semantic_mapper.mapping.storage.grid_buffers import GridBuffers
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import Float64, Int32, Int64

SURFACE_VOXELS = 0.75  # voxels at most this many of their edges from the surface are of it


class SurfacePatches(NamedTuple):
    """N patches of the surface, in the order of their keys.

    Args:
        packed: (N,) int64 keys of their blocks.
        xyz: (N, 3) float64 metres in the world, mean of their voxels.
        need: (N,) float64, sum over their voxels of ``(1 - confidence) / (1 + votes)``: 1 without votes, little where
            the class is clear, and 0 where there are votes enough.
    """

    packed: NDArray[np.int64]
    xyz: Float64
    need: Float64


def surface_patches(voxel_map: VoxelMap, max_votes: float) -> SurfacePatches:
    """Patches of the blocks in memory; those on disk are left out.

    Args:
        voxel_map: Whose surface it is.
        max_votes: Voxels with this many need none.
    """
    config = voxel_map.config
    with voxel_map.locked() as grid:
        keys, blocks = grid.sorted_blocks()
        near = SURFACE_VOXELS / config.truncation_voxels
        total, need = np.zeros((len(blocks), 3)), np.zeros(len(blocks))
        count = np.zeros(len(blocks), np.int64)
        _sum_surface_patches(
            len(blocks), keys, blocks, grid.buffers(), near, config.vote_discount, max_votes, total, need, count
        )
    has = count > 0
    xyz = total[has] / count[has, None] * config.voxel_size_m
    return SurfacePatches(pack_keys(keys[has]), xyz, need[has])


@parallel_kernel()
def _sum_surface_patches(
    blocks_count: int,
    keys: Int32,
    blocks: Int32,
    buffers: GridBuffers,
    near: float,
    vote_discount: float,
    max_votes: float,
    total: Float64,
    need: Float64,
    count: Int64,
) -> None:
    """Sums over the surface voxels of blocks: keys (B, 3), buffer indices (B,).

    Args:
        blocks_count: B.
        keys, blocks, buffers: Of the grid.
        near: TSDF of voxels of the surface, at most.
        vote_discount: rho.
        max_votes: See ``surface_patches``.
        total: (B, 3) zeros: sum of positions, in voxels.
        need: (B,) zeros: see ``SurfacePatches``.
        count: (B,) zeros: number of surface voxels.
    """
    ...
