"""Fusion of one frame in one compiled pass over the blocks it touches: TSDF, colour and class evidence together.

TSDF and colour are the running means of Open3D's ``integrate``. Class evidence is the sum over frames of
``w * log p`` at the pixel a voxel projects to: one vote a voxel a frame, only near the surface, where the field
knows. ``w`` (0..1) trusts near and frontal looks more; see ``vote_weights``.

The kernels release the GIL and depend on no order among threads, so a frame gives the same bits every time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit, prange

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


@parallel_kernel()
def vote_weights(depth, known, probabilities, camera, depth_max):
    """Weight of each pixel's vote, (H, W) float32: ``max(cos, 0.2) * min(1, (2 m / z)^2)``, 0 where none is due.

    Returns:
        The weights, and how many known pixels hold probabilities that are not finite, negative or do not sum to 1.
    """
    height, width = depth.shape
    weights = np.zeros((height, width), np.float32)
    bad = 0
    for v in prange(height):
        for u in range(width):
            z = depth[v, u]
            if not known[v, u] or not (z > 0 and z <= depth_max):
                continue
            total, least = 0.0, np.float32(0.0)
            for c in range(probabilities.shape[2]):
                p = probabilities[v, u, c]
                total += p
                least = min(least, p)
            if not (abs(total - 1.0) < 1e-2 and least >= 0):
                bad += 1
                continue
            near = FULL_TRUST_RANGE_M / z
            weights[v, u] = _cosine(depth, v, u, camera) * min(1.0, near * near)
    return weights, bad


@njit(nogil=True, cache=True, inline="always")
def _add_vote(evidence, votes, voxel, probabilities, weight, cap):
    """``e += w log p``; past the cap the old sum shrinks so that the map stays able to change its mind."""
    total = votes[voxel] + weight
    keep = np.float32(1.0)
    if total > cap:
        keep = (cap - weight) / votes[voxel]
        total = cap
    votes[voxel] = total
    for c in range(len(probabilities)):
        p = max(probabilities[c], np.float32(PROBABILITY_FLOOR))
        evidence[voxel, c] = evidence[voxel, c] * keep + weight * np.log(p)


@parallel_kernel()
def fuse_blocks(indices, buffers, camera, limits, depth, rgb, weights, probabilities):
    """Fuse one frame into the blocks with buffer ``indices`` (B,), in place.

    Args:
        indices: (B,) int32, each once.
        buffers: ``GridBuffers``.
        camera: ``Camera`` of the frame.
        limits: ``FusionLimits``.
        depth: (H, W) float32 metres.
        rgb: (H, W, 3) uint8.
        weights: (H, W) float32 of ``vote_weights``; all 0 for geometry alone.
        probabilities: (H, W, L) float32; looked at only where ``weights`` > 0.
    """
    for i in prange(len(indices)):
        _fuse_block(indices[i], buffers, camera, limits, depth, rgb, weights, probabilities)


@njit(nogil=True, cache=True)
def _fuse_block(block, buffers, camera, limits, depth, rgb, weights, probabilities):
    height, width = depth.shape
    one, half = np.float32(1.0), np.float32(0.5)
    fx, fy = np.float32(camera.fx), np.float32(camera.fy)
    cx, cy = np.float32(camera.cx) + half, np.float32(camera.cy) + half  # truncation then rounds to the pixel
    truncation, depth_max = np.float32(limits.truncation), np.float32(limits.depth_max)
    band, cap = np.float32(limits.vote_band), np.float32(limits.max_weight)
    tsdf, weight, color = buffers.tsdf[block], buffers.weight[block], buffers.color[block]
    evidence, votes = buffers.evidence[block], buffers.votes[block]
    R, vs = camera.R, limits.voxel_size
    ox = buffers.keys[block, 0] * BLOCK_SIDE * vs - camera.t[0]
    oy = buffers.keys[block, 1] * BLOCK_SIDE * vs - camera.t[1]
    oz = buffers.keys[block, 2] * BLOCK_SIDE * vs - camera.t[2]
    voxel = -1
    for k in range(BLOCK_SIDE):
        for j in range(BLOCK_SIDE):
            y, z = oy + j * vs, oz + k * vs
            # Camera coordinates of the row's first voxel (R^T p) and the step along the row, R[0] * voxel size.
            px = np.float32(R[0, 0] * ox + R[1, 0] * y + R[2, 0] * z)
            py = np.float32(R[0, 1] * ox + R[1, 1] * y + R[2, 1] * z)
            pz = np.float32(R[0, 2] * ox + R[1, 2] * y + R[2, 2] * z)
            sx, sy, sz = np.float32(R[0, 0] * vs), np.float32(R[0, 1] * vs), np.float32(R[0, 2] * vs)
            for i in range(BLOCK_SIDE):
                voxel += 1
                n = np.float32(i)
                zc = pz + n * sz
                if zc <= 0:
                    continue
                inverse = one / zc
                uf, vf = fx * (px + n * sx) * inverse + cx, fy * (py + n * sy) * inverse + cy
                if not (uf >= 0 and vf >= 0 and uf < width and vf < height):
                    continue
                u, v = int(uf), int(vf)
                d = depth[v, u]
                sdf = d - zc
                if not (d > 0 and d <= depth_max and sdf >= -truncation):
                    continue
                old = weight[voxel]
                share = one / (old + one)
                tsdf[voxel] = (old * tsdf[voxel] + min(sdf / truncation, one)) * share
                for c in range(3):
                    color[voxel, c] = (old * color[voxel, c] + rgb[v, u, c]) * share
                weight[voxel] = min(old + one, cap)
                if weights[v, u] > 0 and abs(sdf) <= band:
                    _add_vote(evidence, votes, voxel, probabilities[v, u], weights[v, u], cap)


def no_votes(height: int, width: int, classes: int) -> tuple[Float32, Float32]:
    """Weights and probabilities of a frame without semantics: weights all 0, probabilities a stub never looked at."""
    return np.zeros((height, width), np.float32), np.zeros((1, 1, classes), np.float32)
