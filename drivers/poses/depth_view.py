"""One depth image as alignment needs it: smoothed points and normals at several sizes, and the camera of each."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from semantic_mapper.geometry import unproject
from semantic_mapper.types import CameraIntrinsics, Float32

_SMOOTH_PX = 7  # width of the filter that takes the sensor's noise off points and normals
_RIM_PX = _SMOOTH_PX // 2
_SMOOTH_M = 0.05  # depths further apart are of two surfaces and stay apart
_STEP_PX = 2  # a normal comes from the points this far to its sides
_EDGE = 0.05  # fraction of the depth by which these may differ, or they are of two surfaces


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One size.

    Args:
        points: (H, W, 3) float32 in the camera's axes, metres; NaN = none.
        normals: (H, W, 3) float32 of unit length; NaN = none.
        intrinsics: Of this size.
    """

    points: Float32
    normals: Float32
    intrinsics: CameraIntrinsics


def thinned(intrinsics: CameraIntrinsics, stride: int, first: int) -> CameraIntrinsics:
    """Intrinsics of an image of every ``stride``-th row and column, beginning with number ``first``: exact."""
    return CameraIntrinsics(
        fx=intrinsics.fx / stride,
        fy=intrinsics.fy / stride,
        cx=(intrinsics.cx - first) / stride,
        cy=(intrinsics.cy - first) / stride,
        width=len(range(first, intrinsics.width, stride)),
        height=len(range(first, intrinsics.height, stride)),
    )


def thin_depth(depth_m: Float32, stride: int, depth_max_m: float) -> Float32:
    """Every ``stride``-th pixel of a depth image, 0 where it is no number, not positive, or beyond the maximum."""
    depth = depth_m[stride // 2 :: stride, stride // 2 :: stride]
    return np.where(np.isfinite(depth) & (depth > 0) & (depth <= depth_max_m), depth, 0).astype(np.float32)


def make_levels(depth_m: Float32, intrinsics: CameraIntrinsics, count: int) -> tuple[Level, ...]:
    """Points and normals of a depth image (0 = none), finest first, each level half as wide as the one before."""
    smooth = depth_m.copy()
    inner = (
        slice(_RIM_PX, -_RIM_PX),
    ) * 2  # nearer to the rim the filter sees one side alone and shifts what is aslant
    smooth[inner] = cv2.bilateralFilter(depth_m, _SMOOTH_PX, _SMOOTH_M, _SMOOTH_PX / 3)[inner]
    smooth[depth_m <= 0] = 0
    points = unproject(smooth, intrinsics).astype(np.float32)
    points[smooth <= 0] = np.nan
    normals = _normals(points)
    levels = [Level(points, normals, intrinsics)]
    for _ in range(count - 1):
        points, normals = np.ascontiguousarray(points[::2, ::2]), np.ascontiguousarray(normals[::2, ::2])
        intrinsics = thinned(intrinsics, 2, 0)
        levels.append(Level(points, normals, intrinsics))
    return tuple(levels)


def _normals(points: Float32) -> Float32:
    normals = np.full_like(points, np.nan)
    step = _STEP_PX
    middle = points[step:-step, step:-step]
    across = points[step:-step, 2 * step :] - points[step:-step, : -2 * step]
    down = points[2 * step :, step:-step] - points[: -2 * step, step:-step]
    square = np.cross(across, down)
    with np.errstate(invalid="ignore"):
        square /= np.linalg.norm(square, axis=-1, keepdims=True)
        edge = _EDGE * middle[..., 2]
        whole = (np.abs(across[..., 2]) < edge) & (np.abs(down[..., 2]) < edge)
    square[~whole] = np.nan
    normals[step:-step, step:-step] = square
    return normals
