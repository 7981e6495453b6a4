"""The surface of a map in patches of one block, with how much each is in need of class votes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.mapping.block_grid import BLOCK_VOXELS
from semantic_mapper.mapping.block_index import pack_keys
from semantic_mapper.mapping.grid_buffers import BLOCK_SIDE
from semantic_mapper.mapping.readout import decide
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import Float64

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
        max_votes: Voxels with so many need none.
    """
    config = voxel_map.config
    with voxel_map.locked() as grid:
        keys, blocks = grid.sorted_blocks()
        near = SURFACE_VOXELS / config.truncation_voxels
        total, need = np.zeros((len(blocks), 3)), np.zeros(len(blocks))
        count = np.zeros(len(blocks), np.int64)
        _sum_up(len(blocks), keys, blocks, grid.buffers(), near, config.vote_discount, max_votes, total, need, count)
    has = count > 0
    xyz = total[has] / count[has, None] * config.voxel_size_m
    return SurfacePatches(pack_keys(keys[has]), xyz, need[has])


@parallel_kernel()
def _sum_up(start, stop, keys, blocks, buffers, near, vote_discount, max_votes, total, need, count):
    """Sums over the surface voxels of blocks (B,): positions (B, 3) in voxels, need (B,), and their number (B,)."""
    for n in range(start, stop):
        block = blocks[n]
        for voxel in range(BLOCK_VOXELS):
            if buffers.weight[block, voxel] <= 0 or abs(buffers.tsdf[block, voxel]) > near:
                continue
            votes = np.float64(buffers.votes[block, voxel])
            if votes < max_votes:
                _, confidence = decide(buffers.evidence[block, voxel], votes, vote_discount)
                need[n] += (1.0 - confidence) / (1.0 + votes)
            total[n, 0] += keys[n, 0] * BLOCK_SIDE + (voxel & 7)
            total[n, 1] += keys[n, 1] * BLOCK_SIDE + ((voxel >> 3) & 7)
            total[n, 2] += keys[n, 2] * BLOCK_SIDE + (voxel >> 6)
            count[n] += 1
