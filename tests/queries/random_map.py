"""Snapshots of random blocks that no camera would see, to hold kernels against plain numpy."""

from __future__ import annotations

import numpy as np

from semantic_mapper.mapping.changes import UNOBSERVED, BlockChanges
from semantic_mapper.queries.snapshot import MapMirror, MapSnapshot
from tests.queries.scene import LABELS


def random_changes(seed: int, version: int = 0, blocks: int = 20) -> BlockChanges:
    """A wavy field with noise, in some of the blocks round the origin; zeros and jumps of the TSDF are among it."""
    rng = np.random.default_rng(seed)
    keys = np.unique(rng.integers(-2, 2, (blocks, 3)), axis=0).astype(np.int32)
    x = keys[:, None] * 8 + np.stack(np.unravel_index(np.arange(512), (8, 8, 8))[::-1], 1)
    tsdf = 60 * np.sin(x @ [0.5, 0.3, 0.4] + seed) + rng.normal(0, 25, (len(keys), 512))
    tsdf = np.clip(np.where(rng.random(tsdf.shape) < 0.05, 0, tsdf), -127, 127).astype(np.int8)
    tsdf[rng.random(tsdf.shape) < 0.1] = UNOBSERVED
    label = rng.choice([0, *LABELS.ids], tsdf.shape).astype(np.uint8)
    confidence, rgb = rng.integers(0, 256, tsdf.shape, np.uint8), rng.integers(0, 256, (*tsdf.shape, 3), np.uint8)
    return BlockChanges(version, version + 1, version + 1, 0, keys, tsdf, label, confidence, rgb)


def random_map(seed: int) -> MapSnapshot:
    return MapMirror(0.02, 4.0, LABELS).apply(random_changes(seed))


def voxel_places(snapshot: MapSnapshot, row: np.ndarray, voxel: np.ndarray) -> np.ndarray:
    """Coordinates (N, 3) of voxels (N,) of the blocks in rows (N,)."""
    return snapshot.keys[row] * 8 + np.stack((voxel & 7, (voxel >> 3) & 7, voxel >> 6), axis=1)
