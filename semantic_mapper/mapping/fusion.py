"""Fusion of one frame in one compiled pass over the blocks it touches: TSDF, colour and class evidence together.

TSDF and colour are the running means of Open3D's ``integrate``. Class evidence is the sum over frames of
``w * log p`` at the pixel a voxel projects to: one vote a voxel a frame, only near the surface, where the field
knows. ``w`` (0..1) trusts near and frontal looks more; see ``make_votes``.

The kernels release the GIL and depend on no order among threads, so a frame gives the same bits every time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.mapping.allocation import Camera
from semantic_mapper.mapping.block_store import BLOCK_VOXELS
from semantic_mapper.mapping.evidence import PROBABILITY_FLOOR, add_vote, dither_seed
from semantic_mapper.mapping.grid_buffers import BLOCK_SIDE
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import Float32

FULL_TRUST_RANGE_M = 2.0  # a vote from farther counts (2 m / z)^2: a pixel covers that much more surface there
LEAST_COSINE = 0.2  # of the angle between ray and surface normal; grazing looks count this much, never nothing


_BOUNDS = {  # of the settings of a map: what is beyond is a slip of units or digits, and would overflow or never end
    "voxel_size_m": (1e-4, 10.0),
    "truncation_voxels": (1e-3, 100.0),
    "depth_max_m": (1e-3, 1000.0),
    "initial_blocks": (1, 1 << 27),
    "max_blocks": (1, 1 << 27),
    "max_weight": (1.0, 1e6),
}


class FusionLimits(NamedTuple):
    """Lengths in metres, and the caps.

    Args:
        voxel_size: Edge of a voxel.
        truncation: TSDF truncation.
        depth_max: Farther depth is ignored.
        vote_band: Voxels at most this far from the surface take votes.
        max_weight: Cap of TSDF weight and of votes; beyond it old measurements fade.
    """

    voxel_size: float
    truncation: float
    depth_max: float
    vote_band: float
    max_weight: float


def make_limits(config: VoxelMapConfig) -> FusionLimits:
    """Limits of a map.

    Raises:
        ConfigError: a value that no map can be built with.
    """
    for name, (least, most) in _BOUNDS.items():
        value = getattr(config, name)
        if not least <= value <= most:  # NaN, too
            raise ConfigError(f"voxel_map.{name} must be from {least:g} to {most:g}, got {value}")
    if not (config.vote_discount >= 0 and config.vote_band_voxels >= 0):
        raise ConfigError("voxel_map.vote_discount and vote_band_voxels must not be negative")
    return FusionLimits(
        voxel_size=config.voxel_size_m,
        truncation=config.truncation_voxels * config.voxel_size_m,
        depth_max=config.depth_max_m,
        vote_band=config.vote_band_voxels * config.voxel_size_m,
        max_weight=config.max_weight,
    )


class Votes(NamedTuple):
    """What a frame says of classes.

    Args:
        log_p: (K, L) float32 log probabilities, floored.
        rows: (H, W) int32, which row each pixel takes; looked at only where ``weights`` > 0.
        weights: (H, W) float32 in 0..1.
    """

    log_p: Float32
    rows: NDArray[np.int32]
    weights: Float32


def make_votes(
    probabilities: Float32, rows: NDArray[np.int32], depth: Float32, camera: Camera, depth_max: float
) -> tuple[Votes, int]:
    """Votes of a frame, each of weight ``max(cos, 0.2) * min(1, (2 m / z)^2)``, 0 where none is due.

    Args:
        probabilities: (K, L) float32, each row that is referred to summing to 1.
        rows: (H, W) int32 row of each pixel, -1 = unknown.
        depth: (H, W) float32 metres.

    Returns:
        The votes, and how many known pixels hold probabilities that are not finite, negative or do not sum to 1.
    """
    log_p, proper = np.empty_like(probabilities), np.empty(len(probabilities), np.bool_)
    _log_rows(len(probabilities), probabilities, log_p, proper)
    weights, bad = np.zeros(depth.shape, np.float32), np.zeros(len(depth), np.int64)
    _vote_weights(len(depth), depth, rows, proper, camera, depth_max, weights, bad)
    return Votes(log_p, rows, weights), int(bad.sum())


def no_votes(height: int, width: int, classes: int) -> Votes:
    """Of a frame without semantics: weights all 0."""
    rows, weights = np.zeros((height, width), np.int32), np.zeros((height, width), np.float32)
    return Votes(np.zeros((1, classes), np.float32), rows, weights)


@parallel_kernel()
def _log_rows(start, stop, probabilities, logs, proper):
    """Floored log of rows (K, L), and whether each is of numbers that are not negative and sum to 1."""
    floor = np.float32(PROBABILITY_FLOOR)
    for n in range(start, stop):
        total, least = 0.0, np.float32(0.0)
        for c in range(probabilities.shape[1]):
            p = probabilities[n, c]
            total += p
            least = min(least, p)
            logs[n, c] = np.log(max(p, floor))
        proper[n] = abs(total - 1.0) < 1e-2 and least >= 0


@parallel_kernel()
def _vote_weights(start, stop, depth, rows, proper, camera, depth_max, weights, bad):
    """Fill weights (H, W), and bad (H,) with the number of pixels of each row whose probabilities are not proper."""
    height, width = depth.shape
    for v in range(start, stop):
        up, down = depth[max(v - 1, 0)], depth[min(v + 1, height - 1)]
        _weigh_row(v, 0 < v < height - 1, up, depth[v], down, camera, depth_max, weights[v])
        for u in range(width):
            row = rows[v, u]
            if row < 0:
                weights[v, u] = 0
            elif not proper[row] and weights[v, u] > 0:
                weights[v, u] = 0
                bad[v] += 1


@kernel(error_model="numpy")
def _weigh_row(v, inside, up, depth, down, camera, depth_max, weights):
    """Vote weights of a row of pixels: |cos| between ray and surface normal, from four neighbours, and nearness."""
    last, one, half = len(depth) - 1, np.float32(1.0), np.float32(0.5)
    fx, fy, cx = np.float32(camera.fx), np.float32(camera.fy), np.float32(camera.cx)
    least, full, far = np.float32(LEAST_COSINE), np.float32(FULL_TRUST_RANGE_M), np.float32(depth_max)
    y = (np.float32(v) - np.float32(camera.cy)) / fy
    for u in range(1, last):  # without branches, for eight at a time
        z, left, right = depth[u], depth[u - 1], depth[u + 1]
        x = (np.float32(u) - cx) / fx
        # With slopes dz/du, dz/dv the normal is (fx dz/du, fy dz/dv, -(z + x fx dz/du + y fy dz/dv)), unnormalised;
        # its product with the ray (x, y, 1) is -z.
        nx, ny = fx * half * (right - left), fy * half * (down[u] - up[u])
        nz = z + x * nx + y * ny
        cosine = z / np.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + one))
        known = inside & (left > 0) & (right > 0) & (up[u] > 0) & (down[u] > 0) & (cosine > least)
        near = full / z
        weights[u] = (cosine if known else least) * min(near * near, one) if (z > 0) & (z <= far) else np.float32(0.0)
    for u in (0, last):
        z = depth[u]
        near = full / z
        weights[u] = least * min(near * near, one) if (z > 0) & (z <= far) else np.float32(0.0)


@parallel_kernel(chunks_per_thread=4)
def fuse_blocks(start, stop, indices, buffers, camera, limits, depth, rgb, trust, votes, moment):
    """Fuse one frame into the blocks with buffer ``indices[start:stop]``, in place.

    Args:
        start, stop: Range of ``indices``; the caller passes their number instead.
        indices: (B,) int32, each once.
        buffers: ``GridBuffers``.
        camera: ``Camera`` of the frame.
        limits: ``FusionLimits``.
        depth: (H, W) float32 metres.
        rgb: (H, W, 3) uint8.
        trust: (H, W) float32 weight of each depth, or (0, 0) where all are measured: 1.
        votes: ``Votes`` of the frame.
        moment: A number that changes from frame to frame; see ``evidence``.
    """
    offsets = voxel_offsets(camera, limits.voxel_size)
    for i in range(start, stop):
        _fuse_block(indices[i], offsets, buffers, camera, limits, depth, rgb, trust, votes, moment)


@kernel()
def voxel_offsets(camera, voxel_size):
    """(3, 512) float32: camera coordinates (R^T p) of the voxels of a block from its first one; metres."""
    R, offsets = camera.R, np.empty((3, BLOCK_VOXELS), np.float32)
    for n in range(BLOCK_VOXELS):
        x, y, z = (n & 7) * voxel_size, ((n >> 3) & 7) * voxel_size, (n >> 6) * voxel_size
        for axis in range(3):
            offsets[axis, n] = R[0, axis] * x + R[1, axis] * y + R[2, axis] * z
    return offsets


@kernel(error_model="numpy")
def look_up_voxels(key, offsets, camera, voxel_size, depth, behind, depth_max):
    """Which voxels of a block a frame says something of: inside the image, where there is depth, not far behind it.

    Args:
        key: (3,) block coordinates.
        offsets: Of ``voxel_offsets``.
        camera: ``Camera`` of the frame.
        voxel_size: Metres.
        depth: (H, W) float32 metres.
        behind: Metres that a voxel may lie behind the surface.
        depth_max: Farther depth is ignored.

    Returns:
        How many there are, and of each, at the start of arrays (512,): the voxel in the block and the pixel that it
        projects to, int32, and its signed distance along z, float32, positive in front of the surface.
    """
    R, side, zero = camera.R, BLOCK_SIDE * voxel_size, np.float32(0.0)
    x, y, z = key[0] * side - camera.t[0], key[1] * side - camera.t[1], key[2] * side - camera.t[2]
    x0 = np.float32(R[0, 0] * x + R[1, 0] * y + R[2, 0] * z)
    y0 = np.float32(R[0, 1] * x + R[1, 1] * y + R[2, 1] * z)
    z0 = np.float32(R[0, 2] * x + R[1, 2] * y + R[2, 2] * z)
    half = np.float32(0.5)  # of a pixel more: truncation then rounds to the pixel
    fx, fy, cx, cy = np.float32(camera.fx), np.float32(camera.fy), np.float32(camera.cx), np.float32(camera.cy)
    width, right, bottom = np.int32(depth.shape[1]), np.float32(depth.shape[1]), np.float32(depth.shape[0])
    at, depths = np.empty(BLOCK_VOXELS, np.int32), np.empty(BLOCK_VOXELS, np.float32)
    for n in range(BLOCK_VOXELS):  # without branches, for eight at a time
        zc = z0 + offsets[2, n]
        inverse = np.float32(1.0) / zc
        u, v = fx * (x0 + offsets[0, n]) * inverse + (cx + half), fy * (y0 + offsets[1, n]) * inverse + (cy + half)
        inside = (zc > zero) & (u >= zero) & (v >= zero) & (u < right) & (v < bottom)
        at[n] = np.int32(v) * width + np.int32(u) if inside else np.int32(-1)
        depths[n] = zc
    flat, count = depth.reshape(-1), 0
    voxels, pixels = np.empty(BLOCK_VOXELS, np.int32), np.empty(BLOCK_VOXELS, np.int32)
    distances = np.empty(BLOCK_VOXELS, np.float32)
    for n in range(BLOCK_VOXELS):  # what counts stays, what does not is written over by the next
        d = flat[max(at[n], 0)]
        distance = d - depths[n]
        voxels[count], pixels[count], distances[count] = n, at[n], distance
        count += (at[n] >= 0) & (d > 0) & (d <= depth_max) & (distance >= -behind)
    return count, voxels, pixels, distances


@kernel(error_model="numpy")
def _fuse_block(block, offsets, buffers, camera, limits, depth, rgb, trust, frame_votes, moment):
    one, truncation = np.float32(1.0), np.float32(limits.truncation)
    band, cap = np.float32(limits.vote_band), np.float32(limits.max_weight)
    depth_max, place = np.float32(limits.depth_max), (buffers.keys[block], offsets, camera, limits.voxel_size)
    count, voxels, pixels, distances = look_up_voxels(*place, depth, truncation, depth_max)
    tsdf, weight, color = buffers.tsdf[block], buffers.weight[block], buffers.color[block]
    evidence, votes = buffers.evidence[block], buffers.votes[block]
    weighs = trust.reshape(-1)
    colors, rows, weights = rgb.reshape(-1, 3), frame_votes.rows.reshape(-1), frame_votes.weights.reshape(-1)
    seed = dither_seed(buffers.keys[block], moment)
    for k in range(count):
        voxel, pixel = voxels[k], pixels[k]
        old, new = weight[voxel], weighs[pixel] if len(weighs) else one
        share = one / (old + new)
        tsdf[voxel] = (old * tsdf[voxel] + new * min(distances[k] / truncation, one)) * share
        for c in range(3):
            color[voxel, c] = (old * color[voxel, c] + new * colors[pixel, c]) * share
        weight[voxel] = min(old + new, cap)
        if weights[pixel] > 0 and abs(distances[k]) <= band:
            add_vote(evidence, votes, voxel, frame_votes.log_p, rows[pixel], weights[pixel], cap, seed)
