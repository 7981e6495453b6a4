"""Fills what matching is not sure of: a membrane through what it is sure of, that tears at edges of the image.

A membrane of inverse depth is plane where the surface is: plain walls take the plane of what surrounds them.
"""

from __future__ import annotations

import numpy as np

from semantic_mapper.kernels import kernel
from semantic_mapper.types import Float32, UInt8

TIE = 8.0  # between pixels of one colour, where a pixel that is sure to a plane counts 1
COLOUR_SCALE = 10.0  # 8-bit steps, by which a tie falls by a factor of e
LEAST_TIE = 0.01  # fraction of it at the strongest edge
OUTLIER = 2.0  # times its spread, by which a pixel may be off before it counts less
ROUNDS, ITERATIONS, RELAXATION = 3, 50, 1.9


def smooth_planes(plane: Float32, sigma: Float32, rgb: UInt8) -> Float32:
    """The surface (h, w) through ``plane``, in planes of the sweep.

    Args:
        plane: (h, w) best plane; sigma: (h, w) its spread, in planes.
        rgb: (h, w, 3) uint8.
    """
    right, below = np.zeros_like(plane), np.zeros_like(plane)
    right[:, :-1], below[:-1] = _ties(rgb[:, 1:], rgb[:, :-1]), _ties(rgb[1:], rgb[:-1])
    sure = 1 / np.maximum(sigma, 0.1) ** 2
    weight, out = sure.astype(np.float32), plane.copy()
    for _ in range(ROUNDS):
        relax_membrane(plane, weight, right, below, out, ITERATIONS, RELAXATION)
        off = (plane - out) / (OUTLIER * sigma)
        weight = (sure / (1 + off**2)).astype(np.float32)
    return out


def _ties(one: UInt8, other: UInt8) -> Float32:
    step = np.abs(one.astype(np.float32) - other.astype(np.float32)).max(axis=2)
    return (TIE * np.maximum(np.exp(-step / COLOUR_SCALE), LEAST_TIE)).astype(np.float32)


@kernel
def relax_membrane(
    data: Float32, weight: Float32, right: Float32, below: Float32, out: Float32, iterations: int, relaxation: float
) -> None:
    """Minimise sum weight (out - data)^2 + sum tie (difference of neighbours)^2.

    Args:
        data, weight: (h, w) float32.
        right, below: (h, w) ties to the pixel to the right, and below; those of the last column and row are not used.
        out: (h, w) first guess, then the solution.
        iterations: Of red-black over-relaxation by ``relaxation``.
    """
    ...
