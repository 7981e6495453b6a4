"""Depth of one view from several others: matched, compared with its neighbours' depth, smoothed; and how sure it is.

Spreads, in planes of the sweep, are the exponential of a sum of terms, whose factors were fitted so that 68 % of the
errors are within one spread: rooms of training seeds, every second with poses that are off by 0.06 degrees and 1.5 mm.
"""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion.sweep import inverse_depths, relative_projections, stack_images, sweep_and_match
from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView
from semantic_mapper.kernels import kernel, parallel_kernel
from semantic_mapper.types import Float32, Int64, UInt8

TOLERANCE = 0.04  # fraction of the depth by which two estimates of one surface may differ

TIE = 8.0  # between pixels of one colour, where a pixel that is sure to a plane counts 1
COLOUR_SCALE = 10.0  # 8-bit steps, by which a tie falls by a factor of e
LEAST_TIE = 0.01  # fraction of it at the strongest edge
OUTLIER = 2.0  # times its spread, by which a pixel may be off before it counts less
ROUNDS, ITERATIONS, RELAXATION = 3, 50, 1.9

MATCHED = (-0.19, -0.66, -0.47, 0.32, 0.09, -0.63)  # factors of the terms of a spread
SMOOTHED = (0.02, 0.04, 0.94, 0.33, 0.19, 0.24)
LEAST, MOST = 0.1, 40.0  # planes
AROUND = 9  # pixels a side in which other pixels support one


class Agreement(NamedTuple):
    """What neighbours say of a depth image."""

    agree: UInt8  # (h, w) uint8 how many have a depth that agrees
    visible: UInt8  # (h, w) uint8 how many have a depth there
    mean_m: Float32  # (h, w) float32 depth averaged with those that agree, in inverse depth; 0 = none


def estimate_depth(
    reference: PreparedView,
    sources: Sequence[PreparedView],
    config: DepthFromMotionConfig,
    hint: DepthEstimate | None = None,
    neighbours: Sequence[PreparedView] = (),
) -> DepthEstimate:
    """Depth and spread (h, w) of ``reference``, by plane sweep and semi-global matching with at least one source.

    What is not sure is filled from what is, along the surfaces that the image shows. The hint, depth as a map has it at
    the reference's size, breaks ties. Agreement with the ``estimate`` of neighbours makes a depth surer and more exact.
    """
    inverse_depth = inverse_depths(config.planes, config.near_m, config.far_m)
    swept = sweep_and_match(reference, sources, inverse_depth, hint)
    first, step = float(inverse_depth[0]), float(inverse_depth[1] - inverse_depth[0])
    depth = (1 / (first + swept.plane * step)).astype(np.float32)
    agreement = find_agreement(reference, depth, neighbours)
    plane = ((1 / agreement.mean_m - first) / step).astype(np.float32)
    agree, visible = agreement.agree.astype(np.float32), agreement.visible.astype(np.float32)
    unsure, alone = (visible - agree) / 6, (swept.seen < 2).astype(np.float32)
    agreeing = np.log1p(agree)
    sure, far = np.log(swept.confidence + 0.02), np.log(agreement.mean_m)
    matched = _spread(MATCHED, sure, agreeing, unsure, alone, far)  # of what was matched
    surface = np.clip(smooth_planes(plane, matched, reference.rgb), 0, config.planes - 1)
    depth = (1 / (first + surface * step)).astype(np.float32)
    around, off = cv2.blur(1 / matched**2, (AROUND, AROUND)) ** -0.5, np.log(np.abs(plane - surface) + 0.1)
    sigma = _spread(SMOOTHED, np.log(matched), np.log(around), off, agreeing, np.log(depth))  # of the surface
    return DepthEstimate(depth, (depth**2 * step * sigma).astype(np.float32))


def find_agreement(reference: PreparedView, depth_m: Float32, neighbours: Sequence[PreparedView]) -> Agreement:
    """Compare ``depth_m`` (h, w) of a view with the depths that were estimated for others."""
    known = [(n, n.estimate) for n in neighbours if n.estimate is not None]
    ways = relative_projections(reference, [(n.intrinsics, n.T_world_camera) for n, _ in known])
    depths = stack_images([estimate.depth_m for _, estimate in known], np.float32)
    shape = depth_m.shape
    found = Agreement(np.empty(shape, np.uint8), np.empty(shape, np.uint8), np.empty(shape, np.float32))
    count_agreement(len(depth_m), depth_m, *depths, *ways, *found, TOLERANCE)
    return found


def smooth_planes(plane: Float32, sigma: Float32, rgb: UInt8) -> Float32:
    """A membrane (h, w) through what matching is sure of, in planes of the sweep, that tears at edges of the image.

    A membrane of inverse depth is plane where the surface is: plain walls take the plane of what surrounds them.
    ``sigma`` (h, w) is the spread of ``plane``, in planes.
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


def _spread(factors: tuple[float, ...], *terms: NDArray[np.floating]) -> Float32:
    """In planes, (h, w): the exponential of the sum of terms, of which the first is 1, times their factors."""
    stacked = np.stack((np.ones_like(terms[0]), *terms), axis=-1).astype(np.float32, copy=False)
    return np.clip(np.exp(stacked @ np.array(factors, np.float32)), LEAST, MOST).astype(np.float32)


@parallel_kernel()
def count_agreement(
    count: int,
    depth: Float32,
    neighbour_depth: Float32,
    neighbour_size: Int64,
    rotation: Float32,
    translation: Float32,
    agree: UInt8,
    visible: UInt8,
    mean: Float32,
    tolerance: float,
) -> None:
    """Write ``agree``, ``visible`` and ``mean`` (h, w) of `Agreement` with depths of neighbours (n, H, W)."""


@kernel
def relax_membrane(
    data: Float32, weight: Float32, right: Float32, below: Float32, out: Float32, iterations: int, relaxation: float
) -> None:
    """Minimise sum weight (out - data)^2 + sum tie (difference of neighbours)^2 by red-black over-relaxation.

    ``right`` and ``below`` (h, w) are ties to the pixel to the right, and below; those of the last column and row are
    not used. ``out`` (h, w) is the first guess, then the solution.
    """
