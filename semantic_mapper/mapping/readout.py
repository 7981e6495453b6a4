"""Reading the map at any point: interpolation over the eight voxels around it, then label and confidence.

With n votes of evidence e, what the votes say together is ``p = softmax(e * n_eff / n)``, where
``n_eff = n / (1 + rho (n - 1))`` for n > 1: views of one place repeat each other's errors, so a hundred of them are
worth at most 1 / rho independent ones. A vote that is trusted less, n < 1, weighs less against others, but where it is
the only one it means what the field said: n_eff = 1. The label is the argmax, its confidence p[label].
"""

from __future__ import annotations

import numpy as np

from semantic_mapper.kernel_cache import kernel
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.block_index import BlockIndex, find_block, pack_key
from semantic_mapper.mapping.evidence import evidence_scale
from semantic_mapper.mapping.grid_buffers import GridBuffers
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import Float32, Float64, UInt8

_LEAST_SHARE = 1e-3  # corners with less are rounding dust of a point that lies on a voxel edge


def read_points(
    voxels: Float64, index: BlockIndex, buffers: GridBuffers, label_set: LabelSet, vote_discount: float
) -> tuple[UInt8, UInt8, Float32]:
    """Colour, label and confidence at points.

    Args:
        voxels: (N, 3) float64 world points in units of voxels.
        index, buffers: Of the grid.
        label_set: For the ids.
        vote_discount: rho.

    Returns:
        rgb (N, 3) uint8, label (N,) uint8 ids (ignore id = no votes), confidence (N,) float32 (0 = no votes).
    """
    rgb, channel = np.zeros((len(voxels), 3), np.uint8), np.full(len(voxels), -1, np.int64)
    confidence = np.zeros(len(voxels), np.float32)
    _read_points(len(voxels), voxels, index, buffers, vote_discount, rgb, channel, confidence)
    return rgb, label_set.to_ids(channel), confidence


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


@kernel()
def _gather(p, index, buffers, color, evidence):
    """Interpolate colour (3,) and evidence (L,) at a point; returns the interpolated votes."""
    color[:] = 0
    evidence[:] = 0
    x0, y0, z0 = int(np.floor(p[0])), int(np.floor(p[1])), int(np.floor(p[2]))
    fx, fy, fz = p[0] - x0, p[1] - y0, p[2] - z0
    color_sum, vote_sum, votes = 0.0, 0.0, 0.0
    for corner in range(8):
        i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
        share = (fx if i else 1 - fx) * (fy if j else 1 - fy) * (fz if k else 1 - fz)
        if share < _LEAST_SHARE:
            continue
        x, y, z = x0 + i, y0 + j, z0 + k
        block = find_block(index, pack_key(x >> 3, y >> 3, z >> 3))
        if block < 0:
            continue
        voxel = ((z & 7) << 6) | ((y & 7) << 3) | (x & 7)
        if buffers.weight[block, voxel] > 0:
            color_sum += share
            for c in range(3):
                color[c] += share * buffers.color[block, voxel, c]
        if buffers.votes[block, voxel] > 0:
            vote_sum += share
            votes += share * buffers.votes[block, voxel]
            scale = share * evidence_scale(buffers.evidence, buffers.votes[block, voxel])
            for c in range(len(evidence)):
                evidence[c] += scale * buffers.evidence[block, voxel, c]
    if color_sum > 0:
        color /= color_sum
    if vote_sum > 0:
        evidence /= vote_sum
        votes /= vote_sum
    return votes


@kernel()
def decide(evidence, votes, vote_discount):
    """Channel and confidence of one evidence vector (L,), as it is stored or a sum; (-1, 0) without votes."""
    if votes <= 0:
        return -1, 0.0
    worth = 1.0 / (1.0 + vote_discount * (votes - 1.0)) if votes > 1 else 1.0 / votes  # n_eff / n
    worth *= evidence_scale(evidence, votes)
    best = 0
    for c in range(1, len(evidence)):
        if evidence[c] > evidence[best]:
            best = c
    total = 0.0
    for c in range(len(evidence)):
        total += np.exp((evidence[c] - evidence[best]) * worth)
    return best, 1.0 / total


@kernel()
def read_point(p, index, buffers, vote_discount, rgb, color, evidence):
    """Channel and confidence of a point, its colour written to ``rgb`` (3,); ``color``, ``evidence`` are scratch."""
    votes = _gather(p, index, buffers, color, evidence)
    for c in range(3):
        rgb[c] = np.uint8(min(max(color[c] + 0.5, 0.0), 255.0))
    return decide(evidence, votes, vote_discount)


@parallel_kernel()
def _read_points(start, stop, voxels, index, buffers, vote_discount, rgb, channel, confidence):
    color, evidence = np.empty(3, np.float64), np.empty(buffers.evidence.shape[2], np.float64)
    for i in range(start, stop):
        best, p = read_point(voxels[i], index, buffers, vote_discount, rgb[i], color, evidence)
        channel[i] = best
        confidence[i] = p
