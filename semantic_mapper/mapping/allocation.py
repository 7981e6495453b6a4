"""Which blocks a depth image needs: those that its rays cross within the truncation band.

Every pixel is looked at, for Open3D's own selection takes every fourth and so misses thin things; where the depth is
smooth the ray through the middle of a small tile of pixels stands for theirs.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import FrameError
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.block_index import KEY_LIMIT, first_slot, pack_key, pack_keys, pack_step
from semantic_mapper.mapping.grid_buffers import BLOCK_SIDE
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import CameraIntrinsics, Float32, Float64

_BANDS = 8  # image bands with a key set of their own: enough to share among cores, few enough to merge at no cost
_FIRST_CAPACITY = 1 << 13
_LEVELS = 3  # tiles of 1, 2 and 4 pixels a side: of the largest that is smooth one ray speaks for all pixels
_STRIP = 1 << (_LEVELS - 1)  # rows of pixels looked at together
# Real frames touch up to 3,200 blocks of 2 cm voxels and 13,200 of 1 cm, up to 10 m away: what needs several times
# that is noise or a wrong camera, and would fill memory and map at once.
FRAME_SHARE, LEAST_FRAME_BUDGET = 8, 1 << 14
MAX_CROSSINGS = 1024  # blocks that one ray may cross within the truncation band
_TRAIL = 8  # blocks of the rays before that are kept in mind


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
) -> NDArray[np.int64]:
    """Packed keys (B,) of the blocks that rays cross within ``truncation_m`` of their depth, sorted, each once.

    Time and memory are bounded: by the pixels times ``MAX_CROSSINGS``, and by ``budget``.

    Raises:
        FrameError: the camera stands so far from the origin that block coordinates overflow, a ray would cross more
            than ``MAX_CROSSINGS`` blocks, or all rays together more than ``budget``.
    """
    block_m = voxel_size_m * BLOCK_SIDE
    slope = _steepest(camera, depth_m.shape)
    reach = float(np.abs(camera.t).max()) + slope * (depth_max_m + truncation_m)
    if not reach / block_m < KEY_LIMIT:  # NaN, too
        raise FrameError(
            f"the camera is at {camera.t} m and sees up to {slope * depth_max_m:.4g} m far, beyond the "
            f"{KEY_LIMIT * block_m / 1000:.0f} km that a map of {voxel_size_m} m voxels can address; give poses "
            "relative to a nearer origin, and check the intrinsics"
        )
    crossings = slope * 2 * (truncation_m + voxel_size_m) / block_m * 3**0.5
    if crossings > MAX_CROSSINGS:
        raise FrameError(
            f"a ray at the edge of the image crosses {crossings:.3g} blocks near the surface, at most {MAX_CROSSINGS} "
            "are accepted; check the intrinsics, or lower voxel_map.truncation_voxels"
        )
    capacity = _FIRST_CAPACITY
    while True:
        slots = np.full((_BANDS, 2 * capacity), -1, np.int64)
        keys = np.empty((_BANDS, capacity), np.int64)
        counts = np.zeros(_BANDS, np.int64)
        _collect_bands(_BANDS, depth_m, camera, voxel_size_m, truncation_m, depth_max_m, slots, keys, counts)
        if counts.max() <= capacity:
            found = np.unique(np.concatenate([row[:count] for row, count in zip(keys, counts, strict=True)]))
            if len(found) <= budget:
                return found
        if counts.max() <= capacity or capacity >= budget:
            raise FrameError(
                f"the frame touches more than {budget} blocks of {voxel_size_m} m voxels, its budget (1/{FRAME_SHARE} "
                f"of voxel_map.max_blocks, at least {LEAST_FRAME_BUDGET}); check the depth and the intrinsics, use "
                "larger voxels or a smaller voxel_map.depth_max_m, or raise voxel_map.max_blocks"
            )
        capacity *= 4  # a band of the image crosses unusually many blocks (fine voxels): again with more room


def _steepest(camera: Camera, shape: tuple[int, ...]) -> float:
    """Length of the longest ray of an image (H, W) per metre of z: that of a corner."""
    y, x = (
        max(abs(-0.5 - center), abs(size - 0.5 - center)) / focal
        for size, center, focal in zip(shape, (camera.cy, camera.cx), (camera.fy, camera.fx), strict=True)
    )
    return math.hypot(1.0, x, y)


def blocks_in_view(
    camera: Camera, size: tuple[int, int], keys: NDArray[np.int32], voxel_size_m: float, reach_m: float
) -> NDArray[np.int64]:
    """Packed keys of those blocks of ``keys`` (B, 3) that a camera may see up to ``reach_m`` of z, the nearest first.

    ``size`` is (height, width) of the image, which may be a small part of one far from the optical axis.

    A block counts whose bounding sphere touches the frustum; the sphere is that of the block and a voxel more on each
    side, for a point between two blocks is interpolated from both.
    """
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


def view_bounds(
    camera: Camera, intrinsics: CameraIntrinsics, voxel_size_m: float, reach_m: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Least and greatest block coordinates (3,) that ``blocks_in_view`` may take."""
    side, radius = voxel_size_m * BLOCK_SIDE, _block_radius_m(voxel_size_m)
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


def _block_radius_m(voxel_size_m: float) -> float:
    return float(np.sqrt(3.0)) * (0.5 * BLOCK_SIDE + 1) * voxel_size_m


@kernel(inline=True)
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


@kernel(inline=True)
def _first_crossing(a, d):
    """Share of a way ``d`` from ``a`` after which the next whole number is crossed, and of every further one."""
    every = 1.0 / abs(d) if d != 0 else 1e300
    return (np.floor(a) + 1.0 - a if d >= 0 else a - np.floor(a)) * every, every


@kernel(error_model="numpy")
def _remember_ray(u, v, near, far, camera, per_block, trail, slots, keys, count):
    """Add the blocks that the ray of a pixel crosses between two depths, in that order (Amanatides & Woo).

    ``trail`` (n,) holds those of the rays before, first, second and so on: most are the same again.
    """
    R, t = camera.R, camera.t
    x, y, run = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, (far - near) * per_block
    dx, dy, dz = (
        R[0, 0] * x + R[0, 1] * y + R[0, 2],
        R[1, 0] * x + R[1, 1] * y + R[1, 2],
        R[2, 0] * x + R[2, 1] * y + R[2, 2],
    )
    ax, ay, az = (t[0] + near * dx) * per_block, (t[1] + near * dy) * per_block, (t[2] + near * dz) * per_block
    dx, dy, dz = dx * run, dy * run, dz * run
    i, j, k = np.int64(np.floor(ax)), np.int64(np.floor(ay)), np.int64(np.floor(az))
    steps = abs(np.int64(np.floor(ax + dx)) - i) + abs(np.int64(np.floor(ay + dy)) - j)
    steps += abs(np.int64(np.floor(az + dz)) - k)
    key = pack_key(i, j, k)
    if key != trail[0]:
        trail[0] = key
        count = _remember(key, slots, keys, count)
    (tx, every_x), (ty, every_y), (tz, every_z) = (
        _first_crossing(ax, dx),
        _first_crossing(ay, dy),
        _first_crossing(az, dz),
    )
    step_x, step_y, step_z = pack_step(0, dx), pack_step(1, dy), pack_step(2, dz)
    for n in range(1, steps + 1):
        if tx <= ty and tx <= tz:
            key, tx = key + step_x, tx + every_x
        elif ty <= tz:
            key, ty = key + step_y, ty + every_y
        else:
            key, tz = key + step_z, tz + every_z
        at = min(n, len(trail) - 1)
        if key != trail[at]:
            trail[at] = key
            count = _remember(key, slots, keys, count)
    return count


@kernel()
def _fill_tiles(depth, v0, depth_max, least, most):
    """Least and greatest depth of the tiles of a strip that begins at row ``v0``.

    Args:
        depth: (H, W) float32 metres.
        v0: First row.
        depth_max: Farther is not measured.
        least, most: (levels, 4, >= W) float32 to fill: of level k only (4 >> k, W >> k); ``least`` is 0 where a pixel
            is not measured or outside of the image.
    """
    height, width = depth.shape
    least[0], most[0] = 0, 0
    for v in range(v0, min(v0 + _STRIP, height)):
        for u in range(width):
            z = depth[v, u]
            z = z if (z > 0) & (z <= depth_max) else np.float32(0.0)  # also for NaN
            least[0, v - v0, u], most[0, v - v0, u] = z, z
    for k in range(1, _LEVELS):
        for v in range(_STRIP >> k):
            for u in range(least.shape[2] >> k):
                i, j = 2 * v, 2 * u
                a, b = least[k - 1, i], least[k - 1, i + 1]
                least[k, v, u] = min(min(a[j], a[j + 1]), min(b[j], b[j + 1]))
                a, b = most[k - 1, i], most[k - 1, i + 1]
                most[k, v, u] = max(max(a[j], a[j + 1]), max(b[j], b[j + 1]))


@kernel(inline=True)
def _is_smooth(least, most, flat, wide):
    """Whether one ray speaks for a tile: all measured, depths that differ by at most ``flat``, none beyond ``wide``."""
    return (least > 0) & (most - least <= flat) & (most <= wide)


@parallel_kernel()
def _collect_bands(start, stop, depth, camera, voxel, truncation, depth_max, slots, keys, counts):
    for band in range(start, stop):
        counts[band] = _collect_band(
            band, len(counts), depth, camera, voxel, truncation, depth_max, slots[band], keys[band]
        )


@kernel()
def _collect_band(band, bands, depth, camera, voxel, truncation, depth_max, slots, keys):
    """The blocks of one of the bands of an image; returns how many, more than ``len(keys)`` where there is no room.

    A smooth tile is at most two voxels wide and deep. A block that none of the rays meets has then no more than a
    corner, less than a voxel wide, between two of them: of a thousand blocks a few, often far from the surface, which
    the next frame from elsewhere meets.
    """
    strips = (depth.shape[0] + _STRIP - 1) // _STRIP
    size = (_LEVELS, _STRIP, (depth.shape[1] + _STRIP - 1) // _STRIP * _STRIP)
    least, most, trail = np.empty(size, np.float32), np.empty(size, np.float32), np.full(_TRAIL, -1, np.int64)
    view = (depth.shape, camera, truncation, 1.0 / (voxel * BLOCK_SIDE))
    flat, wide, count = np.float32(2 * voxel), np.full(_LEVELS, depth_max, np.float32), 0
    for k in range(1, _LEVELS):
        wide[k] = 2 * voxel * min(camera.fx, camera.fy) / (1 << k)
    for strip in range(band * strips // bands, (band + 1) * strips // bands):
        if count > len(keys):
            return count
        _fill_tiles(depth, strip * _STRIP, np.float32(depth_max), least, most)
        for k in range(_LEVELS):
            for v in range(_STRIP >> k):
                for u in range(size[2] >> k):
                    low, high = least[k, v, u], most[k, v, u]
                    if not _is_smooth(low, high, flat, wide[k]):
                        continue
                    i, j = v >> 1, u >> 1  # of the tile that this one is a quarter of
                    if k + 1 < _LEVELS and _is_smooth(least[k + 1, i, j], most[k + 1, i, j], flat, wide[k + 1]):
                        continue
                    y = strip * _STRIP + (v << k)
                    count = _remember_tile(u << k, y, (1 << k) - 1, low, high, view, trail, slots, keys, count)
    return count


@kernel()
def _remember_tile(u, v, across, least, most, view, trail, slots, keys, count):
    """Add the blocks on a tile's ray, or those of its corners at the edge of the image: nothing else is beyond them."""
    (height, width), camera, truncation, per_block = view
    near, far = max(least - truncation, 0.0), most + truncation
    inside = (u > 0) & (v > 0) & (u < width - _STRIP) & (v < height - _STRIP)
    if inside or across == 0:
        x, y = u + 0.5 * across, v + 0.5 * across
        return _remember_ray(x, y, near, far, camera, per_block, trail, slots, keys, count)
    for corner in range(4):
        x, y = u + float((corner & 1) * across), v + float((corner >> 1) * across)
        count = _remember_ray(x, y, near, far, camera, per_block, trail, slots, keys, count)
    return count
