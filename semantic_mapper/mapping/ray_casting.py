"""The map seen from a pose: a compiled ray caster over the sparse blocks.

Open3D's own ``ray_cast`` is off by half a voxel and can crash when its range buffer overflows; this one walks from
block to block, steps by the TSDF and finds the zero crossing on the interpolated field.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

from semantic_mapper.mapping.block_index import find_block, pack_key
from semantic_mapper.mapping.readout import read_point, sample_tsdf
from semantic_mapper.threads import parallel_kernel

_STEP_SHARE = 0.7  # of the TSDF's distance: it is measured along other rays, so it may be too long for this one
_REFINEMENTS = 5
_WIDENINGS = 3
_CLOSE_ENOUGH = 2e-3  # of the truncation: 0.16 mm at 2 cm voxels


@njit(nogil=True, cache=True, inline="always")
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


@njit(nogil=True, cache=True, inline="always")
def _value_at(z, origin, d, index, buffers, p):
    for axis in range(3):
        p[axis] = origin[axis] + z * d[axis]
    return sample_tsdf(p, index, buffers)


@njit(nogil=True, cache=True)
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


@njit(nogil=True, cache=True)
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


@parallel_kernel()
def cast_rays(camera, height, width, voxel_size, truncation_voxels, z_max, index, buffers, vote_discount):
    """See the map through a camera.

    Returns:
        depth (H, W) float32 metres (0 = miss), rgb (H, W, 3) uint8, channel (H, W) int64 (-1 = no votes),
        confidence (H, W) float32.
    """
    depth = np.zeros((height, width), np.float32)
    rgb = np.zeros((height, width, 3), np.uint8)
    channel = np.full((height, width), -1, np.int64)
    confidence = np.zeros((height, width), np.float32)
    classes = buffers.evidence.shape[2]
    for v in prange(height):
        origin, d, p = np.empty(3), np.empty(3), np.empty(3)
        color, evidence = np.empty(3, np.float64), np.empty(classes, np.float64)
        y = (v - camera.cy) / camera.fy
        for u in range(width):
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
    return depth, rgb, channel, confidence
