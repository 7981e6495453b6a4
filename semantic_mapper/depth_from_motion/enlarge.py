"""Depth of the working size brought to the full image, its borders on the image's edges."""

from __future__ import annotations

import numpy as np

from semantic_mapper.depth_from_motion.views import DepthEstimate
from semantic_mapper.geometry import expect_shape
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Float32, UInt8

SAME_SURFACE = 0.05  # fraction of the depth by which neighbouring pixels of one surface differ at most
COLOUR_RATE = 1 / (2 * 20.0**2)  # sigma of 20 8-bit steps


def enlarge_estimate(estimate: DepthEstimate, coarse_rgb: UInt8, rgb: UInt8) -> DepthEstimate:
    """Bring an estimate (h, w) to the size of ``rgb``; no depth lies between two surfaces.

    Within a surface inverse depth is interpolated, which keeps planes plane. Where the coarse pixels round a pixel
    belong to several surfaces, it takes the one that looks most like it.

    Args:
        coarse_rgb: (h, w, 3) uint8; rgb: (H, W, 3) uint8.

    Raises:
        ShapeError: arrays that do not fit together.
    """
    sizes = expect_shape(estimate.depth_m, "h w", "depth")
    expect_shape(estimate.sigma_m, f"{sizes['h']} {sizes['w']}", "sigma")
    expect_shape(coarse_rgb, f"{sizes['h']} {sizes['w']} 3", "coarse rgb")
    full = expect_shape(rgb, "H W 3", "rgb")
    depth, sigma = (np.zeros((full["H"], full["W"]), np.float32) for _ in range(2))
    enlarge_depth(
        full["H"],
        np.ascontiguousarray(estimate.depth_m),
        np.ascontiguousarray(estimate.sigma_m),
        np.ascontiguousarray(coarse_rgb),
        np.ascontiguousarray(rgb),
        depth,
        sigma,
        SAME_SURFACE,
        COLOUR_RATE,
    )
    return DepthEstimate(depth, sigma)


@parallel_kernel()
def enlarge_depth(
    count: int,
    depth: Float32,
    sigma: Float32,
    coarse_rgb: UInt8,
    rgb: UInt8,
    out_depth: Float32,
    out_sigma: Float32,
    same: float,
    colour_rate: float,
) -> None:
    """The upsampling of `enlarge_estimate`.

    Args:
        count: H, rows.
        depth, sigma: (h, w) float32, 0 = none.
        coarse_rgb, rgb: (h, w, 3), (H, W, 3) uint8.
        out_depth, out_sigma: (H, W) float32 zeros, written.
        same: Fraction of the depth by which pixels of one surface differ at most.
        colour_rate: A coarse pixel counts by exp(-rate * squared distance of the colours).
    """
    ...
