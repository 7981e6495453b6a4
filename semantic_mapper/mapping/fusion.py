"""Fusion of one frame in one compiled pass over the blocks it touches: TSDF, colour and class evidence together.

TSDF and colour are the running means of Open3D's ``integrate``. Class evidence is the sum over frames of
``w * log p`` at the pixel a voxel projects to: one vote a voxel a frame, only near the surface, where the field
knows. ``w`` (0..1) trusts near and frontal looks more; see ``make_votes``.

The kernels release the GIL and depend on no order among threads, so a frame gives the same bits every time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from semantic_mapper.config import VoxelMapConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.mapping.allocation import Camera
from semantic_mapper.mapping.block_grid import BLOCK_SIDE
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import Float32

PROBABILITY_FLOOR = 1e-4  # one confident mistake must not outweigh many modest looks: a vote moves at most ln 1e4
FULL_TRUST_RANGE_M = 2.0  # a vote from farther counts (2 m / z)^2: a pixel covers that much more surface there
LEAST_COSINE = 0.2  # of the angle between ray and surface normal; grazing looks count this much, never nothing


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
    for name in ("voxel_size_m", "truncation_voxels", "depth_max_m", "initial_blocks", "max_blocks"):
        value = getattr(config, name)
        if not (np.isfinite(value) and value > 0):
            raise ConfigError(f"voxel_map.{name} must be above 0, got {value}")
    if not config.max_weight >= 1:
        raise ConfigError(f"voxel_map.max_weight must be at least 1, got {config.max_weight}")
    if not (config.vote_discount >= 0 and config.vote_band_voxels >= 0):
        raise ConfigError("voxel_map.vote_discount and vote_band_voxels must not be negative")
    return FusionLimits(
        voxel_size=config.voxel_size_m,
        truncation=config.truncation_voxels * config.voxel_size_m,
        depth_max=config.depth_max_m,
        vote_band=config.vote_band_voxels * config.voxel_size_m,
        max_weight=config.max_weight,
    )


@njit(nogil=True, cache=True, inline="always")
def _cosine(depth, v, u, camera):
    """|cos| between the ray of a pixel and the surface normal from its four neighbours; the least at depth edges."""
    height, width = depth.shape
    if u < 1 or v < 1 or u >= width - 1 or v >= height - 1:
        return LEAST_COSINE
    z = depth[v, u]
    left, right, up, down = depth[v, u - 1], depth[v, u + 1], depth[v - 1, u], depth[v + 1, u]
    if not (left > 0 and right > 0 and up > 0 and down > 0):
        return LEAST_COSINE
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    # With slopes dz/du, dz/dv the normal is (fx dz/du, fy dz/dv, -(z + x fx dz/du + y fy dz/dv)), unnormalised.
    nx, ny = camera.fx * 0.5 * (right - left), camera.fy * 0.5 * (down - up)
    nz = -(z + x * nx + y * ny)
    dot = x * nx + y * ny + nz  # = -z for the ray (x, y, 1)
    norm = np.sqrt((nx * nx + ny * ny + nz * nz) * (x * x + y * y + 1.0))
    return max(abs(dot) / norm, LEAST_COSINE)


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
    proper = _proper(probabilities)
    weights, bad = _vote_weights(depth, rows, proper, camera, depth_max)
    log_p = np.maximum(probabilities, np.float32(PROBABILITY_FLOOR))
    return Votes(np.log(log_p, out=log_p), rows, weights), bad


def no_votes(height: int, width: int, classes: int) -> Votes:
    """Of a frame without semantics: weights all 0."""
    rows, weights = np.zeros((height, width), np.int32), np.zeros((height, width), np.float32)
    return Votes(np.zeros((1, classes), np.float32), rows, weights)


@parallel_kernel()
def _proper(probabilities):
    """Whether each row (K,) is of numbers that are not negative and sum to 1."""
    out = np.empty(len(probabilities), np.bool_)
    for n in prange(len(probabilities)):
        total, least = 0.0, np.float32(0.0)
        for c in range(probabilities.shape[1]):
            total += probabilities[n, c]
            least = min(least, probabilities[n, c])
        out[n] = abs(total - 1.0) < 1e-2 and least >= 0
    return out


@parallel_kernel()
def _vote_weights(depth, rows, proper, camera, depth_max):
    height, width = depth.shape
    weights = np.zeros((height, width), np.float32)
    bad = 0
    for v in prange(height):
        for u in range(width):
            z = depth[v, u]
            if rows[v, u] < 0 or not (z > 0 and z <= depth_max):
                continue
            if not proper[rows[v, u]]:
                bad += 1
                continue
            near = FULL_TRUST_RANGE_M / z
            weights[v, u] = _cosine(depth, v, u, camera) * min(1.0, near * near)
    return weights, bad


@njit(nogil=True, cache=True, inline="always")
def add_vote(evidence, votes, voxel, log_p, row, weight, cap):
    """``e += w log p``; past the cap the old sum shrinks so that the map stays able to change its mind."""
    total = votes[voxel] + weight
    keep = np.float32(1.0)
    if total > cap:
        keep = (cap - weight) / votes[voxel]
        total = cap
    votes[voxel] = total
    for c in range(log_p.shape[1]):
        evidence[voxel, c] = evidence[voxel, c] * keep + weight * log_p[row, c]


@parallel_kernel()
def fuse_blocks(indices, buffers, camera, limits, depth, rgb, votes):
    """Fuse one frame into the blocks with buffer ``indices`` (B,), in place.

    Args:
        indices: (B,) int32, each once.
        buffers: ``GridBuffers``.
        camera: ``Camera`` of the frame.
        limits: ``FusionLimits``.
        depth: (H, W) float32 metres.
        rgb: (H, W, 3) uint8.
        votes: ``Votes`` of the frame.
    """
    for i in prange(len(indices)):
        _fuse_block(indices[i], buffers, camera, limits, depth, rgb, votes)


@njit(nogil=True, cache=True, inline="always")
def pinhole(camera, depth):
    """Lens and image size of a frame's depth (H, W), as ``project_row`` takes them."""
    half = np.float32(0.5)  # of a pixel more: truncation then rounds to the pixel
    lens = (np.float32(camera.fx), np.float32(camera.fy), np.float32(camera.cx) + half, np.float32(camera.cy) + half)
    return lens, (np.int32(depth.shape[1]), np.float32(depth.shape[1]), np.float32(depth.shape[0]))


@njit(nogil=True, cache=True, inline="always")
def place_block(key, camera, voxel_size):
    """First voxel of a block relative to the camera, in world axes, and the step along x in camera axes; metres."""
    R, t = camera.R, camera.t
    origin = (
        key[0] * BLOCK_SIDE * voxel_size - t[0],
        key[1] * BLOCK_SIDE * voxel_size - t[1],
        key[2] * BLOCK_SIDE * voxel_size - t[2],
    )
    step = (np.float32(R[0, 0] * voxel_size), np.float32(R[0, 1] * voxel_size), np.float32(R[0, 2] * voxel_size))
    return origin, step


@njit(nogil=True, cache=True, inline="always")
def row_start(row, origin, R, voxel_size):
    """Camera coordinates (R^T p) of the first voxel of a row; along the row they go on by ``place_block``'s step."""
    x, y, z = origin[0], origin[1] + (row & 7) * voxel_size, origin[2] + (row >> 3) * voxel_size
    return (
        np.float32(R[0, 0] * x + R[1, 0] * y + R[2, 0] * z),
        np.float32(R[0, 1] * x + R[1, 1] * y + R[2, 1] * z),
        np.float32(R[0, 2] * x + R[1, 2] * y + R[2, 2] * z),
    )


@njit(nogil=True, cache=True, inline="always")
def project_row(p, step, lens, size, depth, truncation, depth_max, pixels, distances):
    """Pixel that each voxel of a row projects to and its signed distance; -1 where there is nothing to fuse."""
    fx, fy, cx, cy = lens
    width, right, bottom = size
    px, py, pz = p
    sx, sy, sz = step
    for i in range(BLOCK_SIDE):  # without branches, for eight at a time
        n = np.float32(i)
        zc = pz + n * sz
        inverse = np.float32(1.0) / zc
        u, v = fx * (px + n * sx) * inverse + cx, fy * (py + n * sy) * inverse + cy
        inside = (zc > 0) & (u >= 0) & (v >= 0) & (u < right) & (v < bottom)
        pixels[i] = np.int32(v) * width + np.int32(u) if inside else np.int32(-1)
        distances[i] = zc
    any_left = False
    for i in range(BLOCK_SIDE):
        if pixels[i] >= 0:
            d = depth[pixels[i]]
            distances[i] = d - distances[i]
            if d > 0 and d <= depth_max and distances[i] >= -truncation:
                any_left = True
            else:
                pixels[i] = -1
    return any_left


@njit(nogil=True, cache=True, error_model="numpy")
def _fuse_block(block, buffers, camera, limits, depth, rgb, frame_votes):
    one = np.float32(1.0)
    lens, size = pinhole(camera, depth)
    depth_max, flat_depth = np.float32(limits.depth_max), depth.reshape(-1)
    truncation, band, cap = np.float32(limits.truncation), np.float32(limits.vote_band), np.float32(limits.max_weight)
    tsdf, weight, color = buffers.tsdf[block], buffers.weight[block], buffers.color[block]
    evidence, votes = buffers.evidence[block], buffers.votes[block]
    colors, rows, weights = rgb.reshape(-1, 3), frame_votes.rows.reshape(-1), frame_votes.weights.reshape(-1)
    pixels, distances = np.empty(BLOCK_SIDE, np.int32), np.empty(BLOCK_SIDE, np.float32)
    origin, step = place_block(buffers.keys[block], camera, limits.voxel_size)
    for row in range(BLOCK_SIDE * BLOCK_SIDE):
        p = row_start(row, origin, camera.R, limits.voxel_size)
        if not project_row(p, step, lens, size, flat_depth, truncation, depth_max, pixels, distances):
            continue
        for i in range(BLOCK_SIDE):
            pixel, voxel = pixels[i], row * BLOCK_SIDE + i
            if pixel < 0:
                continue
            old = weight[voxel]
            share = one / (old + one)
            tsdf[voxel] = (old * tsdf[voxel] + min(distances[i] / truncation, one)) * share
            for c in range(3):
                color[voxel, c] = (old * color[voxel, c] + colors[pixel, c]) * share
            weight[voxel] = min(old + one, cap)
            if weights[pixel] > 0 and abs(distances[i]) <= band:
                add_vote(evidence, votes, voxel, frame_votes.log_p, rows[pixel], weights[pixel], cap)
