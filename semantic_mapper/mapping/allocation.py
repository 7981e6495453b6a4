"""Which blocks a depth image needs: those that its rays cross within the truncation band.

Every pixel is looked at, for Open3D's own selection takes every fourth and so misses thin things; where the depth is
smooth the corner rays of small tiles stand for the rays between them.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from semantic_mapper.errors import FrameError
from semantic_mapper.mapping.block_grid import BLOCK_SIDE
from semantic_mapper.mapping.block_index import KEY_LIMIT, first_slot, pack_key, pack_keys
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import CameraIntrinsics, Float32, Float64

_BANDS = 8  # image bands with a key set of their own: enough to share among cores, few enough to merge at no cost
_FIRST_CAPACITY = 1 << 13
_TILE = 4  # pixels a side; the corners of a smooth tile speak for it, elsewhere every pixel is looked at


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
    return Camera(
        float(intrinsics.fx),
        float(intrinsics.fy),
        float(intrinsics.cx),
        float(intrinsics.cy),
        np.ascontiguousarray(T_world_camera[:3, :3], np.float64),
        np.ascontiguousarray(T_world_camera[:3, 3], np.float64),
    )


def blocks_in_band(
    depth_m: Float32, camera: Camera, voxel_size_m: float, truncation_m: float, depth_max_m: float
) -> NDArray[np.int64]:
    """Packed keys (B,) of the blocks that rays cross within ``truncation_m`` of their depth, sorted, each once.

    Raises:
        FrameError: the camera stands so far from the origin that block coordinates overflow.
    """
    block_m = voxel_size_m * BLOCK_SIDE
    reach = float(np.abs(camera.t).max()) + 4 * (depth_max_m + truncation_m)
    if reach / block_m >= KEY_LIMIT:
        raise FrameError(
            f"the camera is at {camera.t} m, beyond the {KEY_LIMIT * block_m / 1000:.0f} km that a map of "
            f"{voxel_size_m} m voxels can address; give poses relative to a nearer origin"
        )
    capacity = _FIRST_CAPACITY
    while True:
        slots = np.full((_BANDS, 2 * capacity), -1, np.int64)
        keys = np.empty((_BANDS, capacity), np.int64)
        counts = np.zeros(_BANDS, np.int64)
        _collect_bands(depth_m, camera, voxel_size_m, truncation_m, depth_max_m, slots, keys, counts)
        if counts.max() <= capacity:
            return np.unique(np.concatenate([row[:count] for row, count in zip(keys, counts, strict=True)]))
        capacity *= 4  # a band of the image crosses unusually many blocks (fine voxels): again with more room


def blocks_in_view(
    camera: Camera, intrinsics: CameraIntrinsics, keys: NDArray[np.int32], voxel_size_m: float, reach_m: float
) -> NDArray[np.int64]:
    """Packed keys of those blocks of ``keys`` (B, 3) that a camera may see up to ``reach_m`` of z, the nearest first.

    A block counts whose bounding sphere touches the frustum.
    """
    side = voxel_size_m * BLOCK_SIDE
    radius = 0.5 * np.sqrt(3.0) * side
    p = ((keys + 0.5) * side - camera.t) @ camera.R
    z = p[:, 2]
    seen = (z > -radius) & (z < reach_m + radius)
    for at, focal, center, size in (
        (p[:, 0], camera.fx, camera.cx, intrinsics.width),
        (p[:, 1], camera.fy, camera.cy, intrinsics.height),
    ):
        for edge, sign in ((-0.5, 1.0), (size - 0.5, -1.0)):
            slope = (edge - center) / focal  # of the plane through the camera and this edge of the image
            seen &= sign * (at - slope * z) / np.hypot(1.0, slope) > -radius
    order = np.argsort(z[seen], kind="stable")
    return pack_keys(keys[seen][order])


def view_bounds(
    camera: Camera, intrinsics: CameraIntrinsics, voxel_size_m: float, reach_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Least and greatest block coordinates (3,) that ``blocks_in_view`` may take."""
    side = voxel_size_m * BLOCK_SIDE
    radius = 0.5 * np.sqrt(3.0) * side
    z = np.array([-radius, reach_m + radius])
    ends: list[Float64] = []
    for focal, center, size in (
        (camera.fx, camera.cx, intrinsics.width),
        (camera.fy, camera.cy, intrinsics.height),
    ):
        slopes = (np.array([-0.5, size - 0.5]) - center) / focal
        ends.append(slopes * z[:, None] + np.array([-radius, radius]) * np.hypot(1.0, slopes))  # (2 of z, 2)
    corners = np.array([(ends[0][k, i], ends[1][k, j], z[k]) for k in (0, 1) for i in (0, 1) for j in (0, 1)])
    blocks = (corners @ camera.R.T + camera.t) / side
    return np.floor(blocks.min(axis=0) - 1).astype(np.int64), np.ceil(blocks.max(axis=0)).astype(np.int64)


@njit(nogil=True, cache=True, inline="always")
def _remember(packed, slots, keys, count):
    """Add a key to one band's set; returns the new count, more than ``len(keys)`` where there is no room."""
    if count > len(keys):
        return count
    mask = len(slots) - 1
    slot = first_slot(packed, len(slots))
    while slots[slot] != -1:
        if slots[slot] == packed:
            return count
        slot = (slot + 1) & mask
    if count < len(keys):
        slots[slot] = packed
        keys[count] = packed
    return count + 1


@njit(nogil=True, cache=True)
def _walk(a, b, slots, keys, count):
    """Add every block on the segment a -> b (block units), in the order of crossing (Amanatides & Woo)."""
    x, y, z = np.floor(a[0]), np.floor(a[1]), np.floor(a[2])
    steps = int(abs(np.floor(b[0]) - x) + abs(np.floor(b[1]) - y) + abs(np.floor(b[2]) - z))
    dx, dy, dz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    sx, sy, sz = np.sign(dx), np.sign(dy), np.sign(dz)
    tx = (x + (sx > 0) - a[0]) / dx if dx != 0 else np.inf
    ty = (y + (sy > 0) - a[1]) / dy if dy != 0 else np.inf
    tz = (z + (sz > 0) - a[2]) / dz if dz != 0 else np.inf
    count = _remember(pack_key(x, y, z), slots, keys, count)
    for _ in range(steps):
        if tx <= ty and tx <= tz:
            x += sx
            tx += sx / dx
        elif ty <= tz:
            y += sy
            ty += sy / dy
        else:
            z += sz
            tz += sz / dz
        count = _remember(pack_key(x, y, z), slots, keys, count)
    return count


@njit(nogil=True, cache=True, inline="always")
def _next_to(a, b):
    """Whether the blocks of two points are the same or share a face, so that no third lies between."""
    gap = abs(np.floor(a[0]) - np.floor(b[0])) + abs(np.floor(a[1]) - np.floor(b[1]))
    return gap + abs(np.floor(a[2]) - np.floor(b[2])) <= 1


@njit(nogil=True, cache=True, inline="always")
def _remember_ray(u, v, near, far, camera, per_block, last, slots, keys, count):
    """Add the blocks that the ray of a pixel crosses between two depths; ``last`` (2,) holds the ends seen before."""
    R, t = camera.R, camera.t
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    dx = (R[0, 0] * x + R[0, 1] * y + R[0, 2]) * per_block
    dy = (R[1, 0] * x + R[1, 1] * y + R[1, 2]) * per_block
    dz = (R[2, 0] * x + R[2, 1] * y + R[2, 2]) * per_block
    a = (t[0] * per_block + near * dx, t[1] * per_block + near * dy, t[2] * per_block + near * dz)
    b = (t[0] * per_block + far * dx, t[1] * per_block + far * dy, t[2] * per_block + far * dz)
    key_a = pack_key(np.floor(a[0]), np.floor(a[1]), np.floor(a[2]))
    key_b = pack_key(np.floor(b[0]), np.floor(b[1]), np.floor(b[2]))
    if key_a == last[0] and key_b == last[1] and _next_to(a, b):
        return count  # same two blocks as the ray before, nothing in between
    last[0], last[1] = key_a, key_b
    return _walk(a, b, slots, keys, count)


@njit(nogil=True, cache=True)
def _is_smooth(depth, v0, v1, u0, u1, camera, voxel, depth_max):
    """Nearest and farthest depth of a tile that its corners speak for; (0, 0) where every pixel has to be looked at.

    A tile is smooth where all its pixels are measured, its depths differ by at most two voxels, and it is at most two
    voxels wide: then no pixel's ray is farther than a voxel from the ray of a corner.
    """
    least, most = depth[v0, u0], depth[v0, u0]
    for v in range(v0, v1):
        for u in range(u0, u1):
            z = depth[v, u]
            if not (z > 0 and z <= depth_max):
                return np.float32(0), np.float32(0)
            least, most = min(least, z), max(most, z)
    if most - least > 2 * voxel or _TILE * most > 2 * voxel * min(camera.fx, camera.fy):
        return np.float32(0), np.float32(0)
    return least, most


@parallel_kernel()
def _collect_bands(depth, camera, voxel, truncation, depth_max, slots, keys, counts):
    height, width = depth.shape
    bands, rows = len(counts), (height + _TILE - 1) // _TILE
    per_block = 1.0 / (voxel * BLOCK_SIDE)
    for band in prange(bands):
        count = 0
        last = np.full(2, -1, np.int64)
        own_slots, own_keys = slots[band], keys[band]
        for row in range(band * rows // bands, (band + 1) * rows // bands):
            v0, v1 = row * _TILE, min((row + 1) * _TILE, height)
            for u0 in range(0, width, _TILE):
                u1 = min(u0 + _TILE, width)
                least, most = _is_smooth(depth, v0, v1, u0, u1, camera, voxel, depth_max)
                smooth = least > 0
                for v in range(v0, v1, max(v1 - v0 - 1, 1) if smooth else 1):
                    for u in range(u0, u1, max(u1 - u0 - 1, 1) if smooth else 1):
                        z = depth[v, u]
                        if not (z > 0 and z <= depth_max):  # also false for NaN
                            continue
                        near = max((least if smooth else z) - truncation, 0.0)
                        far = (most if smooth else z) + truncation
                        count = _remember_ray(u, v, near, far, camera, per_block, last, own_slots, own_keys, count)
        counts[band] = count
