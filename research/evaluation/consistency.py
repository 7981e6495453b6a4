"""Whether a surface keeps its label when it is seen from another place."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.errors import ShapeError
from semantic_mapper.geometry import invert_pose, nearest_pixels, transform, unproject
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

SAME_SURFACE = (
    0.02  # fraction of z by which two depths of one surface may differ, for the half pixel that rounding moves
)
Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Agreement:
    """Pixels of one view that were found again in another, and how many of them have the same label there."""

    agreeing: int = 0
    compared: int = 0

    @property
    def fraction(self) -> float | None:
        """In 0..1; None where nothing was compared."""
        return self.agreeing / self.compared if self.compared else None

    def __add__(self, other: Agreement) -> Agreement:
        return Agreement(self.agreeing + other.agreeing, self.compared + other.compared)


def matching_pixels(
    depth_a_m: Float32,
    T_world_a: Float64,
    depth_b_m: Float32,
    T_world_b: Float64,
    intrinsics: CameraIntrinsics,
    *,
    tolerance: float = SAME_SURFACE,
) -> tuple[Indices, Indices]:
    """Pixels of view a that view b shows, too: each is carried over by its depth, to the nearest pixel of b.

    A pixel counts where b's depth there is that of the carried point; what hides it in b has another. Raises
    ShapeError: a depth image is not of the camera's size.

    Args:
        depth_a_m, depth_b_m: (H, W) float32 true z in metres, 0 = none.
        T_world_a, T_world_b: (4, 4).
        intrinsics: Of both views.
        tolerance: Fraction of z by which the depths may differ.

    Returns:
        Flat, row-major indices (N,) int64 into a and into b.
    """
    k = intrinsics
    p = transform(invert_pose(T_world_b) @ T_world_a, unproject(depth_a_m, k)).reshape(-1, 3)
    size = (k.height, k.width)
    if depth_b_m.shape != size:
        raise ShapeError(f"depth_b_m: expected shape {size}, got {depth_b_m.shape}")
    inside, row, column = nearest_pixels(p, k)
    index_a = np.flatnonzero(inside & (depth_a_m.ravel() > 0))
    index_b = row[index_a] * k.width + column[index_a]
    found, z = depth_b_m.ravel()[index_b], p[index_a, 2]
    same = (found > 0) & (np.abs(found - z) <= tolerance * z)
    return index_a[same], index_b[same]


def label_agreement(label_a: UInt8, label_b: UInt8, matches: tuple[Indices, Indices], ignore_id: int) -> Agreement:
    """How many matched pixels have the same known label; "unknown" agrees with nothing, not even with itself.

    Args:
        label_a, label_b: (H, W) uint8 class ids.
        matches: From ``matching_pixels``, or a part of it.
        ignore_id: The label set's.
    """
    a, b = label_a.ravel()[matches[0]], label_b.ravel()[matches[1]]
    return Agreement(int(((a == b) & (a != ignore_id)).sum()), len(a))
