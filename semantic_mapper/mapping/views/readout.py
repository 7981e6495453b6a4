"""Reading the map at any point: interpolation over the eight voxels around it, then label and confidence.

With n votes of evidence e, what the votes say together is ``p = softmax(e * n_eff / n)``, where
``n_eff = n / (1 + rho (n - 1))`` for n > 1: views of one place repeat each other's errors, so a hundred of them are
worth at most 1 / rho independent ones. A vote that is trusted less, n < 1, weighs less against others, but where it is
the only one it means what the field said: n_eff = 1. The label is the argmax, its confidence p[label]. Below
``unknown_below`` the label is unknown; the confidence stays that of the likeliest class.

The C code of it is in ``readout.h``.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.kernels import kernel, parallel_kernel
from semantic_mapper.labels import LabelSet
from semantic_mapper.mapping.storage.block_index import BlockIndex
from semantic_mapper.mapping.storage.grid_buffers import GridBuffers
from semantic_mapper.types import Bool, Float32, Float64, Int64, UInt8


def read_points(
    voxels: Float64,
    index: BlockIndex,
    buffers: GridBuffers,
    label_set: LabelSet,
    vote_discount: float,
    unknown_below: float,
) -> tuple[UInt8, UInt8, Float32, Bool]:
    """Colour, label and confidence at points, and whether their surface was measured.

    Args:
        voxels: (N, 3) float64 world points in units of voxels.
        index, buffers: Of the grid.
        label_set: For the ids.
        vote_discount: rho.
        unknown_below: Confidence below which a label is the ignore id.

    Returns:
        rgb (N, 3) uint8, label (N,) uint8 ids (ignore id = unknown), confidence (N,) float32 (0 = no votes), measured
        (N,) bool, False where depth of a voxel around was computed or there is none.
    """
    rgb, channel = np.zeros((len(voxels), 3), np.uint8), np.full(len(voxels), -1, np.int64)
    confidence, measured = np.zeros(len(voxels), np.float32), np.zeros(len(voxels), np.bool_)
    points = np.ascontiguousarray(voxels)
    decision = (vote_discount, unknown_below)
    _read_map_points(len(points), points, index, buffers, *decision, rgb, channel, confidence, measured)
    return rgb, label_set.to_ids(channel), confidence, measured


def decide(evidence: NDArray[Any], votes: float, vote_discount: float, unknown_below: float = 0.0) -> tuple[int, float]:
    """Channel and confidence of one voxel; (-1, 0) without votes, channel -1 below ``unknown_below``.

    Args:
        evidence: (L,) as it is stored, float32 or int16, or a float64 sum of log probabilities.
        votes: Sum of its vote weights.
        vote_discount: rho.
        unknown_below: Confidence.
    """
    confidence = np.empty(1, np.float64)
    channel = _decide_voxel(np.ascontiguousarray(evidence), votes, vote_discount, unknown_below, confidence)
    return channel, float(confidence[0])


@kernel
def _decide_voxel(
    evidence: NDArray[Any], votes: float, vote_discount: float, unknown_below: float, confidence: Float64
) -> int:
    """Channel of evidence (L,); confidence (1,) is filled."""
    ...


@parallel_kernel()
def _read_map_points(
    count: int,
    voxels: Float64,
    index: BlockIndex,
    buffers: GridBuffers,
    vote_discount: float,
    unknown_below: float,
    rgb: UInt8,
    channel: Int64,
    confidence: Float32,
    measured: Bool,
) -> None:
    """Fill rgb (N, 3), channel (N,), -1 = unknown, confidence (N,) and measured (N,) of points (N, 3)."""
    ...
