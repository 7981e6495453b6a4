"""Lift a coarse rendered view to full resolution along the edges of the image and its depth.

The coarse pixels round a full pixel decide together which class it is of; then one of them speaks for it. So a lifted
view is an index a pixel, not a vector of probabilities a pixel.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.fields.kernel_math import fast_exp
from semantic_mapper.kernel_cache import kernel
from semantic_mapper.threads import parallel_kernel
from semantic_mapper.types import Float32, UInt8

COLOUR_RATE = 1 / (2 * 20.0**2)  # sigma of 20 8-bit steps
DEPTH_SIGMA = 0.02  # share of z
LARGEST_STEP = 8.0  # a depth that differs by more counts no more: then colour decides among the rest
LEAST_WEIGHT = 1e-9  # where nothing looks alike, something must still be said

Int32 = NDArray[np.int32]


def lift(
    probabilities: Float32, known: NDArray[np.bool_], rgb_low: UInt8, depth_low: Float32, rgb: UInt8, depth: Float32
) -> Int32:
    """Joint bilateral upsampling: every full pixel takes one of the 3x3 coarse pixels round it.

    It is of the class that these nine give together, weighted by how much they look like the pixel, and of that class
    the one that is most like it. Where all nine are of one class the middle one speaks.

    Args:
        probabilities: (h, w, L) float32; known: (h, w) bool.
        rgb_low, depth_low: (h, w, 3) uint8 and (h, w) float32 at the coarse pixels.
        rgb, depth: (H, W, 3) uint8 and (H, W) float32; depth 0 = none, then colour alone decides.

    Returns:
        (H, W) int32 number of the coarse pixel (row * w + column), -1 where none of the nine is known.
    """
    out = np.empty(depth.shape, np.int32)
    channel = np.where(known, probabilities.argmax(axis=2), -1)
    look = np.dstack((rgb_low.astype(np.float32), depth_low))
    one_class = np.empty(channel.shape, np.bool_)
    _of_one_class(len(channel), channel, one_class)
    flat = probabilities.reshape(-1, probabilities.shape[2])
    _lift(len(depth), flat, channel, one_class, look, rgb, depth, out)
    return out


@parallel_kernel()
def _of_one_class(start, stop, channel, out):
    """Whether the 3x3 coarse pixels round each (as far as they are in the image) are known and of one class."""
    height, width = channel.shape
    for j in range(start, stop):
        for i in range(width):
            same = channel[j, i] >= 0
            for y in range(max(j - 1, 0), min(j + 2, height)):
                for x in range(max(i - 1, 0), min(i + 2, width)):
                    same = same and channel[y, x] == channel[j, i]
            out[j, i] = same


@parallel_kernel()
def _lift(start, stop, probabilities, channel, one_class, look, rgb, depth, out):
    for v in range(start, stop):
        _lift_row(v, probabilities, channel, one_class, look, rgb, depth, out)


@kernel()
def _lift_row(v, probabilities, channel, one_class, look, rgb, depth, out):
    """One row of full pixels; a function of its own for each pixel would cost more than what it does."""
    (height, width), half = channel.shape, np.float32(0.5)
    scale_y, scale_x = np.float32(height / depth.shape[0]), np.float32(width / depth.shape[1])
    taps, of_class, weights = np.empty(9, np.int64), np.empty(9, np.int64), np.empty(9, np.float32)
    y = (np.float32(v) + half) * scale_y - half
    j0 = min(max(math.floor(y + half), 0), height - 1)
    for u in range(depth.shape[1]):
        x = (np.float32(u) + half) * scale_x - half
        i0 = min(max(math.floor(x + half), 0), width - 1)
        if one_class[j0, i0]:
            out[v, u] = j0 * width + i0
            continue
        z, count = depth[v, u], 0
        depth_rate = np.float32(1.0 / DEPTH_SIGMA) / z if z > 0 else np.float32(0.0)
        for j in range(max(j0 - 1, 0), min(j0 + 2, height)):
            for i in range(max(i0 - 1, 0), min(i0 + 2, width)):
                if channel[j, i] < 0:
                    continue
                dy, dx = y - np.float32(j), x - np.float32(i)
                r, g = np.float32(rgb[v, u, 0]) - look[j, i, 0], np.float32(rgb[v, u, 1]) - look[j, i, 1]
                b, step = np.float32(rgb[v, u, 2]) - look[j, i, 2], (z - look[j, i, 3]) * depth_rate
                cost = (r * r + g * g + b * b) * np.float32(COLOUR_RATE) + dy * dy + dx * dx
                if look[j, i, 3] > 0:
                    cost += min(step * step, np.float32(LARGEST_STEP))
                weights[count] = fast_exp(-cost) + np.float32(LEAST_WEIGHT)
                taps[count], of_class[count] = j * width + i, channel[j, i]
                count += 1
        out[v, u] = _nearest_of_class(taps, of_class, weights, count, probabilities)


@numba.njit(inline="always")
def _nearest_of_class(taps, of_class, weights, count, probabilities):
    """The tap of the largest weight among those of the class that all give the largest total, -1 without taps."""
    best, top, most = -1, -1, np.float32(-1.0)
    for a in range(count):
        if of_class[a] == top:
            if weights[a] > weights[best]:
                best = a
            continue
        total = np.float32(0.0)
        for b in range(count):
            total += weights[b] * probabilities[taps[b], of_class[a]]
        if total > most:
            best, top, most = a, of_class[a], total
    return taps[best] if best >= 0 else -1
