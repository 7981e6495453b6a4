"""What numba kernels of other packages call of ``block_index`` and ``ray_casting``, until they are C too."""

from __future__ import annotations

import numpy as np

from semantic_mapper.kernel_cache import kernel

KEY_BITS = 21
KEY_LIMIT = 1 << (KEY_BITS - 1)
_KEY_MASK = (1 << KEY_BITS) - 1
_EMPTY = -1
_HASH_FACTOR = -7046029254386353131
_STEP_SHARE = 0.7
_REFINEMENTS = 5
_WIDENINGS = 3
_CLOSE_ENOUGH = 2e-3


@kernel(inline=True)
def pack_key(bx, by, bz):
    """One packed key of integer coordinates."""
    limit = np.int64(KEY_LIMIT)
    return ((np.int64(bx) + limit) << (2 * KEY_BITS)) | ((np.int64(by) + limit) << KEY_BITS) | (np.int64(bz) + limit)


@kernel(inline=True)
def key_part(packed, axis):
    """One coordinate of a packed key."""
    return ((packed >> ((2 - axis) * KEY_BITS)) & _KEY_MASK) - KEY_LIMIT


@kernel(inline=True)
def first_slot(packed, slot_count):
    """Where the search for a key begins."""
    h = packed * np.int64(_HASH_FACTOR)
    return (h ^ (h >> np.int64(29))) & np.int64(slot_count - 1)


@kernel()
def find_block(index, packed):
    """Buffer index of a packed key, -1 where there is no such block."""
    slots = len(index.slot_keys)
    slot = first_slot(packed, slots)
    while True:
        key = index.slot_keys[slot]
        if key == packed:
            return np.int64(index.slot_values[slot])
        if key == _EMPTY:
            return np.int64(-1)
        slot = (slot + 1) & (slots - 1)


@kernel()
def sample_tsdf(p, index, buffers):
    """Interpolated TSDF at a point (voxel units) over its observed corners; 2.0 where none was observed."""
    x0, y0, z0 = int(np.floor(p[0])), int(np.floor(p[1])), int(np.floor(p[2]))
    fx, fy, fz = p[0] - x0, p[1] - y0, p[2] - z0
    total, share_sum = 0.0, 0.0
    last_key, block = np.int64(-1), np.int64(-1)
    for corner in range(8):
        i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
        share = (fx if i else 1 - fx) * (fy if j else 1 - fy) * (fz if k else 1 - fz)
        if share <= 0:
            continue
        x, y, z = x0 + i, y0 + j, z0 + k
        key = pack_key(x >> 3, y >> 3, z >> 3)
        if key != last_key:
            last_key, block = key, find_block(index, key)
        if block < 0:
            continue
        voxel = ((z & 7) << 6) | ((y & 7) << 3) | (x & 7)
        if buffers.weight[block, voxel] > 0:
            total += share * buffers.tsdf[block, voxel]
            share_sum += share
    return total / share_sum if share_sum > 0 else 2.0


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
