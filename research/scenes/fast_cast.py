"""First hit of every pixel, compiled: each primitive is tested only inside its rectangle on the screen.

``reference.first_hits`` is the same in plain torch; a test holds the two together.
"""

from __future__ import annotations

import numpy as np

from research.kernels import kernel
from semantic_mapper.geometry import expect_shape
from semantic_mapper.types import Float64, Int32, Int64

NEAR_M = 0.02  # nothing nearer than this is seen; as in fast_cast.h


def cast_pixels(
    shape: Int64,
    center: Float64,
    half: Float64,
    rotation: Float64,
    origin: Float64,
    camera_axes: Float64,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
) -> tuple[Float64, Int32]:
    """Depth along the camera's z (H, W) float64 (inf = miss) and number of the primitive (H, W) int32 (-1 = miss).

    Args:
        shape: (P,) int64 ``primitives.Shape``.
        center, half: (P, 3) float64 metres; ``half`` along the primitive's own axes.
        rotation: (P, 3, 3) float64 own axes -> world.
        origin: (3,) float64 of the camera.
        camera_axes: (3, 3) float64 the camera's x, y, z axes in world coordinates as columns (any handedness).
        fx, fy, cx, cy, width, height: Pinhole model in pixels.
    """
    expect_primitives(shape, center, half, rotation)
    expect_shape(origin, "3", "origin")
    expect_shape(camera_axes, "3 3", "camera_axes")
    depth, index = np.full((height, width), np.inf), np.full((height, width), -1, np.int32)
    shape, center, half = np.ascontiguousarray(shape), np.ascontiguousarray(center), np.ascontiguousarray(half)
    rotation, origin = np.ascontiguousarray(rotation), np.ascontiguousarray(origin)
    camera_axes = np.ascontiguousarray(camera_axes)
    cast_primitives(shape, center, half, rotation, origin, camera_axes, fx, fy, cx, cy, depth, index)
    return depth, index


def expect_primitives(shape: Int64, center: Float64, half: Float64, rotation: Float64) -> None:
    """Check the shapes of the arrays of primitives. Raises ShapeError: one has another shape."""
    count = expect_shape(shape, "P", "shape")["P"]
    expect_shape(center, f"{count} 3", "center")
    expect_shape(half, f"{count} 3", "half")
    expect_shape(rotation, f"{count} 3 3", "rotation")


@kernel
def cast_primitives(
    shape: Int64,
    center: Float64,
    half: Float64,
    rotation: Float64,
    origin: Float64,
    camera_axes: Float64,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    depth: Float64,
    index: Int32,
) -> None:
    """Write ``depth`` (H, W), which holds inf, and ``index`` (H, W), which holds -1."""
    ...
