"""The memory of Open3D's block hash map as numpy arrays, without a copy."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.mapping.block_store import BLOCK_VOXELS
from semantic_mapper.types import Float32

ATTRIBUTES = ("tsdf", "weight", "color", "evidence", "votes")


class GridBuffers(NamedTuple):
    """Zero-copy views of the grid's memory, valid until the next ``BlockGrid.activate``.

    Args:
        keys: (capacity, 3) int32 block coordinates.
        tsdf: (capacity, 512) float32, signed distance over truncation in [-1, 1].
        weight: (capacity, 512) float32, number of depth measurements (capped).
        color: (capacity, 512, 3) float32 in 0..255.
        evidence: (capacity, 512, L), sum (float32) or mean (int16) of log probabilities by weight; see ``evidence``.
        votes: (capacity, 512) float32, sum of vote weights.
    """

    keys: NDArray[np.int32]
    tsdf: Float32
    weight: Float32
    color: Float32
    evidence: NDArray[Any]
    votes: Float32


def view_buffers(hash_map: Any) -> GridBuffers:
    """Views of an ``open3d.core.HashMap`` whose values are ``ATTRIBUTES``, valid until its memory moves."""
    tsdf, weight, color, evidence, votes = (hash_map.value_tensor(i).numpy() for i in range(len(ATTRIBUTES)))
    n = len(tsdf)
    return GridBuffers(
        keys=hash_map.key_tensor().numpy(),
        tsdf=tsdf.reshape(n, BLOCK_VOXELS),
        weight=weight.reshape(n, BLOCK_VOXELS),
        color=color.reshape(n, BLOCK_VOXELS, 3),
        evidence=evidence.reshape(n, BLOCK_VOXELS, -1),
        votes=votes.reshape(n, BLOCK_VOXELS),
    )
