"""Convolutions of images (h, w, C). Unlike torch's they give the same bits on any number of threads."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from semantic_mapper.kernels import parallel_kernel
from semantic_mapper.types import Float32

BLOCK = 16  # output channels that the kernel computes at a time


@dataclass(frozen=True, slots=True, eq=False)
class Convolution:
    """A square convolution, packed for the kernel.

    Args:
        weight: (blocks, size * size, C, 16) float32; output channels beyond the last one are 0.
        bias: (blocks * 16,) float32.
        size, stride, dilation: Pixels.
        channels: Of the output.
    """

    weight: Float32
    bias: Float32
    size: int
    stride: int
    dilation: int
    channels: int

    def __call__(self, image: Float32) -> Float32:
        """(H, W, C) to (h, w, channels), without a margin."""
        out = np.zeros((image.shape[0] // self.stride, image.shape[1] // self.stride, len(self.bias)), np.float32)
        self._add(image, out)
        return out[..., : self.channels]

    def add_activated(self, image: Float32) -> None:
        """``image += convolution(max(image, 0))``, zeros round the image."""
        margin = self.dilation * (self.size // 2)
        padded = np.zeros((image.shape[0] + 2 * margin, image.shape[1] + 2 * margin, image.shape[2]), np.float32)
        np.maximum(image, 0, out=padded[margin:-margin, margin:-margin])
        self._add(padded, image)

    def _add(self, image: Float32, out: Float32) -> None:
        convolve_rows(len(out), image, self.weight, self.bias, out, self.size, self.stride, self.dilation)


def pack_convolution(weight: Float32, bias: Float32, stride: int, dilation: int) -> Convolution:
    """A convolution of torch's weights (O, C, k, k) and bias (O,)."""
    channels, depth, size = weight.shape[:3]
    filled = np.zeros((-(-channels // BLOCK) * BLOCK, depth, size, size), np.float32)
    filled[:channels] = weight
    packed = filled.reshape(-1, BLOCK, depth, size * size).transpose(0, 3, 2, 1)  # blocks, k k, C, 16
    filled_bias = np.zeros(len(filled), np.float32)
    filled_bias[:channels] = bias
    return Convolution(np.ascontiguousarray(packed), filled_bias, size, stride, dilation, channels)


def add_doubled(small: Float32, out: Float32) -> None:
    """Add ``small`` (h, w, C), bilinearly enlarged, to ``out`` (2h, 2w, C)."""
    add_doubled_rows(len(out), small, out)


@parallel_kernel()
def convolve_rows(
    count: int, image: Float32, weight: Float32, bias: Float32, out: Float32, size: int, stride: int, dilation: int
) -> None:
    """Add a convolution.

    Args:
        count: h, rows of ``out``.
        image: (H, W, C) with its margin.
        weight, bias: Of a `Convolution`.
        out: (h, w, blocks * 16), added to.
    """
    ...


@parallel_kernel()
def add_doubled_rows(count: int, small: Float32, out: Float32) -> None:
    """Add ``small`` (h, w, C), bilinearly enlarged.

    Args:
        count: 2h, rows of ``out`` (2h, 2w, C).
    """
    ...
