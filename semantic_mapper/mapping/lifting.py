"""Lift a coarse rendered view to full resolution along the edges of the image and its depth."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import Float32, UInt8

COLOUR_SIGMA = 20.0  # 8-bit steps
DEPTH_SIGMA = 0.02  # share of z


def lift(
    probabilities: Float32, known: NDArray[np.bool_], rgb_low: UInt8, depth_low: Float32, rgb: UInt8, depth: Float32
) -> tuple[Float32, NDArray[np.bool_]]:
    """Joint bilateral upsampling: every full pixel mixes the 3x3 coarse pixels round it that look like it.

    Args:
        probabilities: (h, w, L) float32; known: (h, w) bool.
        rgb_low, depth_low: (h, w, 3) uint8 and (h, w) float32 at the coarse pixels.
        rgb, depth: (H, W, 3) uint8 and (H, W) float32; depth 0 = none, then colour alone decides.

    Returns:
        (H, W, L) float32 probabilities and (H, W) bool known.
    """
    height, width = depth.shape
    out = np.zeros((height, width, probabilities.shape[2]), np.float32)
    out_known = np.zeros((height, width), np.bool_)
    _lift(probabilities, known, rgb_low, depth_low, rgb, depth, out, out_known)
    return out, out_known


@parallel_kernel(fastmath=True)
def _lift(  # pragma: no cover - compiled
    probabilities: Float32,
    known: NDArray[np.bool_],
    rgb_low: UInt8,
    depth_low: Float32,
    rgb: UInt8,
    depth: Float32,
    out: Float32,
    out_known: NDArray[np.bool_],
) -> None:
    low_height, low_width, classes = probabilities.shape
    height, width = depth.shape
    scale_y, scale_x = low_height / height, low_width / width
    colour_rate = 1.0 / (2.0 * COLOUR_SIGMA * COLOUR_SIGMA)
    for v in numba.prange(height):
        y = (v + 0.5) * scale_y - 0.5
        y0 = math.floor(y + 0.5)
        for u in range(width):
            x = (u + 0.5) * scale_x - 0.5
            x0 = math.floor(x + 0.5)
            total = 0.0
            z = depth[v, u]
            for dy in range(-1, 2):
                j = y0 + dy
                if j < 0 or j >= low_height:
                    continue
                for dx in range(-1, 2):
                    i = x0 + dx
                    if i < 0 or i >= low_width or not known[j, i]:
                        continue
                    exponent = (y - j) * (y - j) + (x - i) * (x - i)
                    r = float(rgb[v, u, 0]) - float(rgb_low[j, i, 0])
                    g = float(rgb[v, u, 1]) - float(rgb_low[j, i, 1])
                    b = float(rgb[v, u, 2]) - float(rgb_low[j, i, 2])
                    exponent += (r * r + g * g + b * b) * colour_rate
                    z_low = depth_low[j, i]
                    if z > 0 and z_low > 0:
                        step = (z - z_low) / (DEPTH_SIGMA * z)
                        exponent += min(step * step, 8.0)
                    weight = math.exp(-exponent) + 1e-9
                    total += weight
                    for c in range(classes):
                        out[v, u, c] += weight * probabilities[j, i, c]
            if total > 0:
                out_known[v, u] = True
                for c in range(classes):
                    out[v, u, c] /= total
