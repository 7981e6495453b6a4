"""Depths of neighbouring views, looked up in a view: how many agree with its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from semantic_mapper.depth_from_motion.sweep import relative_projections, stack_images
from semantic_mapper.depth_from_motion.views import PreparedView
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Float32, Int64, UInt8

TOLERANCE = 0.04  # fraction of the depth by which two estimates of one surface may differ


class Agreement(NamedTuple):
    """What neighbours say of a depth image.

    Args:
        agree, visible: (h, w) uint8 neighbours whose depth agrees; that have a depth there.
        mean_m: (h, w) float32 depth averaged with those that agree, in inverse depth; 0 = none.
    """

    agree: UInt8
    visible: UInt8
    mean_m: Float32


def find_agreement(reference: PreparedView, depth_m: Float32, neighbours: Sequence[PreparedView]) -> Agreement:
    """Compare ``depth_m`` (h, w) of a view with the depths that were estimated for others."""
    known = [(n, n.estimate) for n in neighbours if n.estimate is not None]
    rotation, translation = relative_projections(reference, [(n.intrinsics, n.T_world_camera) for n, _ in known])
    depths, sizes = stack_images([estimate.depth_m for _, estimate in known], np.float32)
    agree, visible = np.empty(depth_m.shape, np.uint8), np.empty(depth_m.shape, np.uint8)
    mean_m = np.empty_like(depth_m)
    count_agreement(
        len(depth_m), depth_m, depths, sizes, rotation, translation, agree, visible,
        mean_m, TOLERANCE,
    )  # fmt: skip
    return Agreement(agree, visible, mean_m)


@parallel_kernel()
def count_agreement(
    count: int,
    depth: Float32,
    neighbour_depth: Float32,
    neighbour_size: Int64,
    rotation: Float32,
    translation: Float32,
    agree: UInt8,
    visible: UInt8,
    mean: Float32,
    tolerance: float,
) -> None:
    """Count neighbours whose depth agrees.

    Args:
        count: h, rows.
        depth: (h, w) float32, 0 = none.
        neighbour_depth: (n, H, W) float32, 0 = none; neighbour_size: (n, 2) int64 height and width.
        rotation, translation: (n, 3, 3), (n, 3) of `relative_projections`.
        agree, visible, mean: (h, w), written; see `Agreement`.
        tolerance: Fraction of the depth.
    """
    ...
