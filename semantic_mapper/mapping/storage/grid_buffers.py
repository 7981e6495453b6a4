"""The memory of the voxel grid: one array for each attribute of a voxel."""

from __future__ import annotations

import math
import mmap
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernels import kernel
from semantic_mapper.mapping.fusion.evidence import EVIDENCE_DTYPES
from semantic_mapper.mapping.storage.block_store import BLOCK_VOXELS
from semantic_mapper.types import Float32, Int32, UInt8

BLOCK_SIDE = 8
SPARE_SHARE = 1.5  # of what one frame touches, where memory is to have room for it without pushing the last one out
ATTRIBUTES = ("tsdf", "weight", "color", "evidence", "votes")


class GridBuffers(NamedTuple):
    """The grid's memory; growing replaces it.

    Args:
        keys: (capacity, 3) int32 block coordinates.
        tsdf: (capacity, 512) float32, signed distance over truncation in [-1, 1].
        weight: (capacity, 512) float32, number of depth measurements (capped); below 1 the depth was computed.
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


def make_buffers(capacity: int, classes: int, evidence: str) -> GridBuffers:
    """Zeros for this many blocks; the machine gives the memory page by page as it is written.

    Raises:
        OSError: it has none.
    """
    flat = (capacity, BLOCK_VOXELS)
    return GridBuffers(
        keys=_zeros((capacity, 3), np.int32),
        tsdf=_zeros(flat, np.float32),
        weight=_zeros(flat, np.float32),
        color=_zeros((*flat, 3), np.float32),
        evidence=_zeros((*flat, classes), EVIDENCE_DTYPES[evidence]),
        votes=_zeros(flat, np.float32),
    )


def _zeros(shape: tuple[int, ...], dtype: type[np.generic]) -> NDArray[Any]:
    """As ``np.zeros``, which asks for huge pages: to find these holds up a frame for long when the map grows."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    return np.frombuffer(memory, dtype).reshape(shape)


def advised_mb(blocks: int, block_bytes: int) -> int:
    """The ``voxel_map.memory_mb`` that this many blocks of one frame, and some of the frames before, fit in."""
    return math.ceil(SPARE_SHARE * blocks * block_bytes / 1e6)


@kernel
def blocks_hold_surface(indices: Int32, tsdf: Float32, weight: Float32, holds: UInt8) -> None:
    """Which blocks have a voxel that may have to be cleared one day (``fusion/clearing``).

    Args:
        indices: (B,) buffer indices.
        tsdf, weight: Of the grid.
        holds: (B,) to fill, 0 or 1.
    """
    ...
