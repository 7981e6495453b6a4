"""Joint bilateral upsampling of a coarse rendered view to full resolution, along the edges of the image and its depth.

The coarse pixels round a full pixel decide together which class it is of; then it takes the probabilities of one of
them. So an upsampled view is an index a pixel, not a vector of probabilities a pixel.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from semantic_mapper.geometry import expect_shape
from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Float32, Int64, UInt8

COLOUR_RATE = 1 / (2 * 20.0**2)  # sigma of 20 8-bit steps
DEPTH_SIGMA = 0.02  # fraction of z
LARGEST_STEP = 8.0  # a depth that differs by more counts no more: then colour decides among the rest
LEAST_WEIGHT = 1e-9  # where nothing looks alike, the coarse pixels still count alike

Int32 = NDArray[np.int32]


def upsample(
    probabilities: Float32, known: NDArray[np.bool_], rgb_low: UInt8, depth_low: Float32, rgb: UInt8, depth: Float32
) -> Int32:
    """Joint bilateral upsampling: every full pixel takes one of the 3x3 coarse pixels round it.

    It is of the class that these nine give together, weighted by how much they look like the pixel, and of that class
    the one that is most like it. Where all nine are of one class it takes the middle one.

    Args:
        probabilities: (h, w, L) float32; known: (h, w) bool.
        rgb_low, depth_low: (h, w, 3) uint8 and (h, w) float32 at the coarse pixels.
        rgb, depth: (H, W, 3) uint8 and (H, W) float32; depth 0 = none, then colour alone decides.

    Returns:
        (H, W) int32 number of the coarse pixel (row * w + column), -1 where none of the nine is known.

    Raises:
        ShapeError: arrays that do not fit together.
    """
    sizes = expect_shape(probabilities, "h w L", "coarse probabilities")
    coarse = f"{sizes['h']} {sizes['w']}"
    expect_shape(known, coarse, "coarse known")
    expect_shape(rgb_low, f"{coarse} 3", "coarse rgb")
    expect_shape(depth_low, coarse, "coarse depth")
    sizes = expect_shape(depth, "H W", "depth")
    expect_shape(rgb, f"{sizes['H']} {sizes['W']} 3", "rgb")
    out = np.full(depth.shape, -1, np.int32)
    if not known.size:
        return out
    channel = np.ascontiguousarray(np.where(known, probabilities.argmax(axis=2), -1))
    look = np.dstack((rgb_low.astype(np.float32), depth_low))
    one_class = np.empty(channel.shape, np.bool_)
    find_one_class(len(channel), channel, one_class)
    upsample_view(
        len(depth),
        np.ascontiguousarray(probabilities.reshape(-1, probabilities.shape[2])),
        channel,
        one_class,
        look,
        np.ascontiguousarray(rgb),
        np.ascontiguousarray(depth),
        out,
        COLOUR_RATE,
        DEPTH_SIGMA,
        LARGEST_STEP,
        LEAST_WEIGHT,
    )
    return out


@parallel_kernel()
def find_one_class(count: int, channel: Int64, one_class: NDArray[np.bool_]) -> None:
    """Whether the 3x3 coarse pixels round each (as far as they are in the image) are known and of one class.

    Args:
        count: h, rows.
        channel: (h, w) int64 likeliest class, -1 = unknown.
        one_class: (h, w) bool, written.
    """
    ...


@parallel_kernel()
def upsample_view(
    count: int,
    probabilities: Float32,
    channel: Int64,
    one_class: NDArray[np.bool_],
    look: Float32,
    rgb: UInt8,
    depth: Float32,
    out: Int32,
    colour_rate: float,
    depth_sigma: float,
    largest_step: float,
    sample_weight_threshold: float,
) -> None:
    """The joint bilateral upsampling of `upsample`.

    Args:
        count: H, rows.
        probabilities: (h * w, L) float32.
        channel: (h, w) int64 likeliest class, -1 = unknown.
        one_class: (h, w) bool; see `find_one_class`.
        look: (h, w, 4) float32 colour and depth of the coarse pixels.
        rgb, depth: (H, W, 3) uint8, (H, W) float32.
        out: (H, W) int32, written.
    """
    ...
