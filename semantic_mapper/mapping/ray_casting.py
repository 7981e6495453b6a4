"""The map seen from a pose: a compiled ray caster over the sparse blocks.

Open3D's own ``ray_cast`` is off by half a voxel and can crash when its range buffer overflows; this one walks from
block to block, steps by the TSDF and finds the zero crossing on the interpolated field.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.allocation import Camera, blocks_in_view, view_bounds
from semantic_mapper.mapping.block_grid import BlockGrid
from semantic_mapper.mapping.block_index import find_block, pack_key, unpack_keys
from semantic_mapper.mapping.readout import read_point, sample_tsdf
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import CameraIntrinsics, Float32, UInt8

_STEP_SHARE = 0.7  # of the TSDF's distance: it is measured along other rays, so it may be too long for this one
_REFINEMENTS = 5
_WIDENINGS = 3
_CLOSE_ENOUGH = 2e-3  # of the truncation: 0.16 mm at 2 cm voxels


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


@kernel(inline=True)
def _block_exit(p, d, x, y, z):
    """How far along ``d`` the point ``p`` leaves block (x, y, z); voxels end half a voxel beyond their centres."""
    nearest = np.inf
    for axis in range(3):
        base = (x if axis == 0 else y if axis == 1 else z) * 8.0 - 0.5
        if d[axis] > 0:
            nearest = min(nearest, (base + 8.0 - p[axis]) / d[axis])
        elif d[axis] < 0:
            nearest = min(nearest, (base - p[axis]) / d[axis])
    return max(nearest, 0.0)


@kernel(inline=True)
def _value_at(z, origin, d, index, buffers, p):
    for axis in range(3):
        p[axis] = origin[axis] + z * d[axis]
    return sample_tsdf(p, index, buffers)


@kernel()
def _refine(origin, d, near, far, step, index, buffers, p):
    """Zero of the interpolated TSDF round an interval whose nearest voxels change sign, by regula falsi (Illinois).

    The interpolated field may change sign a little outside of the interval: it is widened by ``step`` until it does.
    Returns 0 where the interpolated field has no zero there.
    """
    value_near = _value_at(near, origin, d, index, buffers, p)
    value_far = _value_at(far, origin, d, index, buffers, p)
    for _ in range(_WIDENINGS):
        if value_near <= 0:
            near, far, value_far = near - step, near, value_near
            value_near = _value_at(near, origin, d, index, buffers, p)
        elif value_far > 0:
            near, far, value_near = far, far + step, value_far
            value_far = _value_at(far, origin, d, index, buffers, p)
    if value_near <= 0 or value_far > 0:
        return 0.0
    side = 0
    z = near
    for _ in range(_REFINEMENTS):
        z = near + (far - near) * value_near / (value_near - value_far)
        value = _value_at(z, origin, d, index, buffers, p)
        if abs(value) < _CLOSE_ENOUGH:
            break
        if value > 0:
            near, value_near = z, value
            value_far *= 0.5 if side == 1 else 1.0
            side = 1
        else:
            far, value_far = z, value
            value_near *= 0.5 if side == -1 else 1.0
            side = -1
    return z


@kernel()
def march(origin, d, truncation_voxels, z_max, index, buffers, p):
    """z of the first surface that the ray meets from its front, 0 where there is none.

    ``buffers`` is anything with ``tsdf`` and ``weight`` of blocks (B, 512); where its TSDF is in other units,
    ``truncation_voxels`` is the length of one.
    """
    per_voxel = 1.0 / np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])  # z a voxel of ray length
    z, z_before, before = 0.0, 0.0, -1.0  # ``before`` > 0: TSDF at ``z_before``, in front of a surface
    last_key, block = np.int64(-1), np.int64(-1)
    while z <= z_max:
        for axis in range(3):
            p[axis] = origin[axis] + z * d[axis]
        x, y, k = int(np.floor(p[0] + 0.5)), int(np.floor(p[1] + 0.5)), int(np.floor(p[2] + 0.5))
        key = pack_key(x >> 3, y >> 3, k >> 3)
        if key != last_key:
            last_key, block = key, find_block(index, key)
        if block < 0:
            z += _block_exit(p, d, x >> 3, y >> 3, k >> 3) + 1e-3 * per_voxel
            before = -1.0
            continue
        voxel = ((k & 7) << 6) | ((y & 7) << 3) | (x & 7)
        if buffers.weight[block, voxel] <= 0:
            z += per_voxel
            before = -1.0
            continue
        value = np.float64(buffers.tsdf[block, voxel])
        if value <= 0 and before > 0:
            surface = _refine(origin, d, z_before, z, 0.5 * per_voxel, index, buffers, p)
            if surface > 0:
                return surface
        z_before, before = z, value
        z += per_voxel * max(_STEP_SHARE * truncation_voxels * value, 0.5)
    return 0.0


def cast_view(
    grid: BlockGrid, camera: Camera, intrinsics: CameraIntrinsics, config: VoxelMapConfig
) -> tuple[Float32, UInt8, NDArray[np.int64], Float32]:
    """See the map through a camera, up to ``depth_max_m`` away.

    What it may see and is on disk comes back into memory; where there is no room for all of it, for a part of the image
    after the other. (Where even what one pixel may see does not fit, its ray meets the nearest of that.)

    Returns:
        depth (H, W) float32 metres (0 = miss), rgb (H, W, 3) uint8, channel (H, W) int64 (-1 = no votes),
        confidence (H, W) float32.
    """
    size = (intrinsics.height, intrinsics.width)
    depth, confidence = np.zeros(size, np.float32), np.zeros(size, np.float32)
    rgb, channel = np.zeros((*size, 3), np.uint8), np.full(size, -1, np.int64)
    limits = (config.voxel_size_m, config.truncation_voxels, config.depth_max_m, config.vote_discount)
    for window, seen in _windows(grid, camera, intrinsics, config):
        if len(seen):
            grid.page_in(seen)
        _cast_rays(window.height, camera, window, limits, grid.index, grid.buffers(), depth, rgb, channel, confidence)
    return depth, rgb, channel, confidence


def _windows(
    grid: BlockGrid, camera: Camera, intrinsics: CameraIntrinsics, config: VoxelMapConfig
) -> Iterator[tuple[Window, NDArray[np.int64]]]:
    """Parts of an image that together are all of it, each with packed keys (B,) of what it may see, nearest first.

    One part, and no keys, where nothing is on disk.
    """
    whole = Window(0, 0, intrinsics.height, intrinsics.width)
    if not grid.stored_count:
        yield whole, np.empty(0, np.int64)
        return
    voxel, reach = config.voxel_size_m, config.depth_max_m + config.truncation_voxels * config.voxel_size_m
    waiting = [(whole, grid.keys_between(*view_bounds(camera, intrinsics, voxel, reach)))]
    while waiting:
        window, keys = waiting.pop()
        moved = camera._replace(cx=camera.cx - window.left, cy=camera.cy - window.top)
        seen = blocks_in_view(moved, (window.height, window.width), keys, voxel, reach)
        if len(seen) <= grid.room or window.height * window.width == 1:
            yield window, seen
        else:
            waiting += [(half, unpack_keys(seen)) for half in reversed(window.halves())]


@parallel_kernel()
def _cast_rays(start, stop, camera, window, limits, index, buffers, depth, rgb, channel, confidence):
    """Fill rows of a window of what ``cast_view`` returns."""
    voxel_size, truncation_voxels, z_max, vote_discount = limits
    classes = buffers.evidence.shape[2]
    for v in range(window.top + start, window.top + stop):
        origin, d, p = np.empty(3), np.empty(3), np.empty(3)
        color, evidence = np.empty(3, np.float64), np.empty(classes, np.float64)
        y = (v - camera.cy) / camera.fy
        for u in range(window.left, window.left + window.width):
            x = (u - camera.cx) / camera.fx
            for axis in range(3):
                origin[axis] = camera.t[axis] / voxel_size
                d[axis] = (camera.R[axis, 0] * x + camera.R[axis, 1] * y + camera.R[axis, 2]) / voxel_size
            z = march(origin, d, truncation_voxels, z_max, index, buffers, p)
            if z <= 0:
                continue
            for axis in range(3):
                p[axis] = origin[axis] + z * d[axis]
            best, confident = read_point(p, index, buffers, vote_discount, rgb[v, u], color, evidence)
            depth[v, u] = z
            channel[v, u] = best
            confidence[v, u] = confident
