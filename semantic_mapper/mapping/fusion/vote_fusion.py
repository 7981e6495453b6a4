"""Class votes without a measurement: what a rendered view says of the surface that the map already has.

A rendered view measures nothing, so TSDF, colour and weight stay as they are, to the bit, and no block is added.
"""

from __future__ import annotations

import numpy as np

from semantic_mapper.config import VirtualViewConfig
from semantic_mapper.geometry import check_pose
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.mapping.fusion.allocation import Camera, blocks_in_band, make_camera
from semantic_mapper.mapping.fusion.evidence import DITHER
from semantic_mapper.mapping.fusion.frame_votes import ProbabilityTable, check_depth, frame_votes, probability_table
from semantic_mapper.mapping.fusion.fuse import FusionLimits, Votes, make_limits
from semantic_mapper.mapping.storage.block_index import pack_keys
from semantic_mapper.mapping.storage.grid_buffers import GridBuffers
from semantic_mapper.mapping.voxel_map import VoxelMap
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, Int32


def add_votes(
    voxel_map: VoxelMap,
    T_world_camera: Float64,
    intrinsics: CameraIntrinsics,
    depth_m: Float32,
    table: ProbabilityTable,
    config: VirtualViewConfig,
) -> int:
    """Give the map's surface the class votes of one view, one a voxel; nothing else of the map changes.

    A vote weighs ``config.weight`` times what that of a frame would (``fusion.make_votes``), and goes to voxels alone
    that have fewer than ``config.max_votes``. ``frames`` does not count the view, ``version`` does.

    Args:
        voxel_map: Whose surface it is.
        T_world_camera: (4, 4) of the view.
        intrinsics: Of ``depth_m``.
        depth_m: (H, W) float32, z of the map's surface in the view; 0 = none.
        table: Probabilities (K, L) float32, and the row (H, W) int32 that each pixel takes, -1 = unknown.
        config: Of virtual views.

    Returns:
        Blocks that were given votes to, or would have been had they had voxels near the surface.

    Raises:
        PoseError, ShapeError, FrameError: the view cannot be used; the map is as it was.
        MapError: the disk fails.
    """
    where = "votes without a frame"
    check_pose(T_world_camera, where)
    depth = check_depth(depth_m, intrinsics, where)
    limits, classes = make_limits(voxel_map.config), len(voxel_map.label_set)
    checked = probability_table(depth, table[0], None, table[1], classes, where)
    camera = make_camera(intrinsics, T_world_camera)
    with voxel_map.locked() as grid:
        votes = frame_votes(depth, checked, camera, limits.depth_max, classes, where)
        votes = votes._replace(weights=votes.weights * np.float32(config.weight))
        budget = voxel_map.config.max_blocks  # no block is added
        packed = blocks_in_band(depth, camera, limits.voxel_size, limits.truncation, limits.depth_max, budget)
        packed = packed[np.isin(packed, pack_keys(grid.all_keys()))]  # existing ones alone
        most, moment = config.max_votes, voxel_map.version
        for blocks in voxel_map.changing(packed) if len(packed) else ():
            args = (blocks, grid.buffers(), camera, limits, depth, votes, most, DITHER, moment)
            _vote_into_blocks(len(blocks), *args)
    return len(packed)


@parallel_kernel()
def _vote_into_blocks(
    count: int,
    indices: Int32,
    buffers: GridBuffers,
    camera: Camera,
    limits: FusionLimits,
    depth: Float32,
    votes: Votes,
    max_votes: float,
    dither: Float32,
    moment: int,
) -> None:
    """Vote as ``fusion.fuse_blocks`` does, at measured voxels with fewer than ``max_votes``, and change nothing else.

    Args:
        count: B.
        indices: (B,) buffer indices, each once.
        buffers, camera, limits, depth, votes, dither, moment: As of ``fusion.fuse_blocks``.
        max_votes: Voxels with this many take none.
    """
    ...
