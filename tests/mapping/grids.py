"""Small voxel grids of random values, and a plain reading of them, to hold kernels against."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from semantic_mapper.mapping.block_grid import GridBuffers
from semantic_mapper.mapping.blocks import BlockIndex, make_block_index
from semantic_mapper.mapping.fusion import EVIDENCE_STEPS, evidence_of
from semantic_mapper.types import Float64


def random_grid(rng: np.random.Generator, classes: int = 4) -> tuple[BlockIndex, GridBuffers]:
    """Nine blocks around the origin, in any order; some voxels without a measurement, some without votes."""
    keys = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0) for z in (-1, 0)], np.int32)
    keys = rng.permutation(keys)[:9]
    n = len(keys)
    x = (keys[:, None] * 8 + np.stack(np.unravel_index(np.arange(512), (8, 8, 8))[::-1], 1)).astype(np.float64)
    tsdf = np.clip(0.3 * np.sin(x @ [0.3, 0.2, 0.5]) + rng.normal(0, 0.2, (n, 512)), -1, 1).astype(np.float32)
    weight = np.where(rng.random((n, 512)) < 0.8, rng.uniform(0.5, 9, (n, 512)), 0).astype(np.float32)
    votes = np.where((weight > 0) & (rng.random((n, 512)) < 0.8), rng.uniform(0.1, 5, (n, 512)), 0).astype(np.float32)
    said = np.log(rng.dirichlet(np.full(classes, 0.5), (n, 512)) + 1e-4)
    stored = evidence_of(np.where(votes[..., None] > 0, said, 0))
    color = (rng.uniform(0, 255, (n, 512, 3)) * (weight > 0)[..., None]).astype(np.float32)
    buffers = GridBuffers(keys, tsdf, weight, color, stored, votes)
    return make_block_index(keys, np.arange(n, dtype=np.int32)), buffers


def corners(buffers: GridBuffers, p: Float64) -> Iterator[tuple[float, tuple[int, int]]]:
    """The voxels around a point (voxel units) that are in the grid: fraction, and block and voxel."""
    rows = {tuple(key): row for row, key in enumerate(buffers.keys.tolist())}
    low = np.floor(p).astype(int)
    for corner in np.ndindex(2, 2, 2):
        at = low + corner[::-1]
        row = rows.get(tuple((at // 8).tolist()))
        fraction = float(np.prod(1 - np.abs(p - at)))
        if row is not None:
            x, y, z = at % 8
            yield fraction, (row, int(z * 64 + y * 8 + x))


def decided(evidence: np.ndarray, votes: float, rho: float, unknown_below: float = 0.0) -> tuple[int, float]:
    """Channel and confidence of one voxel (L,); (-1, 0) without votes, channel -1 below ``unknown_below``."""
    if votes <= 0:
        return -1, 0.0
    worth = votes / (1 + rho * (votes - 1)) if votes > 1 else 1.0
    p = np.exp((evidence.min() - evidence.astype(np.float64)) * worth / EVIDENCE_STEPS)
    confidence = float(1 / p.sum())
    return (int(evidence.argmin()) if confidence >= unknown_below else -1), confidence
