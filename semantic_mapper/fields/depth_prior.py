"""Where the surface of each pixel of a view is expected: sensor depth without holes, its borders on the image's edges.

A depth sensor errs at borders: stereo widens what is near and leaves holes next to it, and the nearest measured pixel
of a hole is often on the wrong surface. Where the neighbourhood of a pixel holds two surfaces, the pixel belongs to the
one whose pixels look more like it: a joint bilateral filter that chooses between both, so that no depth lies between.
"""

from __future__ import annotations

import numpy as np

from semantic_mapper.geometry import expect_shape
from semantic_mapper.imaging import fill_holes
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Float32, UInt8

REACH = 1 / 32  # of the image's width is looked at to either side: sensors err by their own pixels, not by ours
SURFACE_STEP, SURFACE_STEP_M = (
    0.04,
    0.08,
)  # a leap from one surface to another: the guided interval, fraction of z + metres
COLOUR_SIGMA = 12.0  # 8-bit steps
ADVANTAGE = 1.5  # times as much must the other surface count for a pixel to go over to it


def depth_prior(depth_m: Float32, rgb: UInt8) -> Float32:
    """Depth prior (H, W) in metres of a view; all 0 without any measured depth.

    Args:
        depth_m: (H, W) float32, 0 = not measured.
        rgb: (H, W, 3) uint8, the view's image.

    Raises:
        ShapeError: images of different sizes.
    """
    sizes = expect_shape(depth_m, "H W", "depth")
    expect_shape(rgb, f"{sizes['H']} {sizes['W']} 3", "rgb")
    filled = np.ascontiguousarray(fill_holes(depth_m), np.float32)
    out = np.empty_like(filled)
    draw_borders_to_edges(
        len(filled),
        filled,
        np.ascontiguousarray(depth_m, np.float32),
        np.ascontiguousarray(rgb),
        out,
        max(round(REACH * sizes["W"]), 1),
        SURFACE_STEP,
        SURFACE_STEP_M,
        1 / (2 * COLOUR_SIGMA**2),
        ADVANTAGE,
    )
    return out


@parallel_kernel()
def draw_borders_to_edges(
    count: int,
    filled: Float32,
    measured: Float32,
    rgb: UInt8,
    out: Float32,
    reach: int,
    step: float,
    step_m: float,
    colour_rate: float,
    advantage: float,
) -> None:
    """The filter of ``depth_prior``.

    Args:
        count: H, rows.
        filled, measured: (H, W) float32 depth without holes, and with.
        rgb: (H, W, 3) uint8.
        out: (H, W) float32, written.
    """
    ...
