"""Which blocks a depth image needs: those that its rays cross within the truncation band.

Every pixel counts, for Open3D's own selection takes every fourth and misses thin things; where the depth is smooth, one
ray stands for a small tile. The loop is in ``allocation.c``."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from semantic_mapper.errors import FrameError
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.mapping.block_grid import BLOCK_SIDE
from semantic_mapper.mapping.blocks import KEY_LIMIT, pack_keys
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, Int32, Int64

_BANDS = 8  # image bands with a key set of their own: enough to share among cores, few enough to merge at no cost
_FIRST_CAPACITY = 1 << 13
# Real frames touch up to 3,200 blocks of 2 cm voxels and 13,200 of 1 cm, up to 10 m away: what needs several times
# that is noise or a wrong camera, and would fill memory and map at once.
FRAME_SHARE, LEAST_FRAME_BUDGET = 8, 1 << 14
MAX_CROSSINGS = 1024  # blocks that one ray may cross within the truncation band


class Camera(NamedTuple):
    """A pinhole camera in the world, as compiled code takes it: intrinsics, R_world_camera (3, 3), centre (3,)."""

    fx: float
    fy: float
    cx: float
    cy: float
    R: Float64
    t: Float64


def make_camera(intrinsics: CameraIntrinsics, T_world_camera: Float64) -> Camera:
    """Camera of a checked pose."""
    R, t = (np.ascontiguousarray(part, np.float64) for part in (T_world_camera[:3, :3], T_world_camera[:3, 3]))
    return Camera(float(intrinsics.fx), float(intrinsics.fy), float(intrinsics.cx), float(intrinsics.cy), R, t)


def frame_budget(max_blocks: int) -> int:
    """How many blocks one frame may touch in a map of at most ``max_blocks``."""
    return max(LEAST_FRAME_BUDGET, max_blocks // FRAME_SHARE)


def blocks_in_band(
    depth_m: Float32,
    camera: Camera,
    voxel_size_m: float,
    truncation_m: float,
    depth_max_m: float,
    budget: int = LEAST_FRAME_BUDGET,
) -> Int64:
    """Packed keys (B,) of the blocks that rays cross within ``truncation_m`` of their depth, sorted, each once.

    ``FrameError``: the camera stands so far from the origin that block coordinates overflow, a ray would cross more
    than ``MAX_CROSSINGS`` blocks, or all rays together more than ``budget``."""
    block_m = voxel_size_m * BLOCK_SIDE
    slope = _steepest(camera, depth_m.shape)
    reach = float(np.abs(camera.t).max()) + slope * (depth_max_m + truncation_m)
    if not reach / block_m < KEY_LIMIT:  # NaN, too
        raise FrameError(
            f"the camera is at {camera.t} m and sees beyond the {KEY_LIMIT * block_m / 1000:.0f} km that a map of "
            f"{voxel_size_m} m voxels can address; give poses relative to a nearer origin, and check the intrinsics"
        )
    crossings = slope * 2 * (truncation_m + voxel_size_m) / block_m * 3**0.5
    if crossings > MAX_CROSSINGS:
        raise FrameError(
            f"a ray at the edge of the image crosses {crossings:.3g} blocks near the surface, {MAX_CROSSINGS} may be; "
            "check the intrinsics, or lower voxel_map.truncation_voxels"
        )
    depth, capacity = np.ascontiguousarray(depth_m), _FIRST_CAPACITY
    while True:
        slots = np.full((_BANDS, 2 * capacity), -1, np.int64)
        keys = np.empty((_BANDS, capacity), np.int64)
        counts = np.zeros(_BANDS, np.int64)
        _collect_block_keys(_BANDS, depth, camera, voxel_size_m, truncation_m, depth_max_m, slots, keys, counts)
        if counts.max() <= capacity:
            found = np.unique(np.concatenate([row[:count] for row, count in zip(keys, counts, strict=True)]))
            if len(found) <= budget:
                return found
        if counts.max() <= capacity or capacity >= budget:
            raise FrameError(
                f"the frame touches more than {budget} blocks of {voxel_size_m} m voxels; check the depth and the "
                "intrinsics, use larger voxels, lower voxel_map.depth_max_m, or raise voxel_map.max_blocks"
            )
        capacity *= 4  # a band of the image crosses unusually many blocks (fine voxels): again with more room


def _steepest(camera: Camera, shape: tuple[int, ...]) -> float:
    """Length of the longest ray of an image (H, W) per metre of z: that of a corner."""
    y, x = (
        max(abs(-0.5 - center), abs(size - 0.5 - center)) / focal
        for size, center, focal in zip(shape, (camera.cy, camera.cx), (camera.fy, camera.fx), strict=True)
    )
    return math.hypot(1.0, x, y)


def blocks_in_view(camera: Camera, size: tuple[int, int], keys: Int32, voxel_size_m: float, reach_m: float) -> Int64:
    """Packed keys of those blocks of ``keys`` (B, 3) that a camera may see up to ``reach_m`` of z, the nearest first;
    ``size`` is (height, width) of the image. A block counts whose bounding sphere, a voxel wider on each side for
    interpolation, touches the frustum."""
    side, radius = voxel_size_m * BLOCK_SIDE, _block_radius_m(voxel_size_m)
    p = ((keys + 0.5) * side - camera.t) @ camera.R
    z = p[:, 2]
    seen = (z > -radius) & (z < reach_m + radius)
    for at, focal, center, side_px in (
        (p[:, 0], camera.fx, camera.cx, size[1]),
        (p[:, 1], camera.fy, camera.cy, size[0]),
    ):
        for edge, sign in ((-0.5, 1.0), (side_px - 0.5, -1.0)):
            slope = (edge - center) / focal  # of the plane through the camera and this edge of the image
            seen &= sign * (at - slope * z) / np.hypot(1.0, slope) > -radius
    order = np.argsort(z[seen], kind="stable")
    return pack_keys(keys[seen][order])


def blocks_within_reach(
    camera: Camera, size: tuple[int, int], voxel_size_m: float, reach_m: float
) -> tuple[Int64, Int64]:
    """Least and greatest block coordinates (3,) that ``blocks_in_view`` may take."""
    side, radius = voxel_size_m * BLOCK_SIDE, _block_radius_m(voxel_size_m)
    reach = _steepest(camera, size) * (reach_m + radius) + radius
    low, high = np.floor((camera.t - reach) / side), np.floor((camera.t + reach) / side)
    return low.astype(np.int64), high.astype(np.int64)


def _block_radius_m(voxel_size_m: float) -> float:
    return float(np.sqrt(3.0)) * (0.5 * BLOCK_SIDE + 1) * voxel_size_m


@parallel_kernel()
def _collect_block_keys(
    bands: int,
    depth: Float32,
    camera: Camera,
    voxel_size_m: float,
    truncation_m: float,
    depth_max_m: float,
    slots: Int64,
    keys: Int64,
    counts: Int64,
) -> None:
    """Packed keys of the blocks of each of the ``bands`` of an image, each once, in no order: ``keys`` (bands,
    capacity), ``counts`` (bands,), which are more than the capacity, a power of two, where there is no room for all.
    ``slots`` (bands, 2 * capacity) of -1 is scratch, a hash set."""
