"""Depth of one view from several others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion.agreement import find_agreement
from semantic_mapper.depth_from_motion.evidence import Matched, gather_evidence
from semantic_mapper.depth_from_motion.refine import default_refiner
from semantic_mapper.depth_from_motion.smooth import smooth_planes
from semantic_mapper.depth_from_motion.spread import spread_of_match
from semantic_mapper.depth_from_motion.sweep import inverse_depths, sweep_and_match
from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView
from semantic_mapper.geometry import expect_shape


def estimate_depth(
    reference: PreparedView,
    sources: Sequence[PreparedView],
    config: DepthFromMotionConfig,
    hint: DepthEstimate | None = None,
    neighbours: Sequence[PreparedView] = (),
) -> DepthEstimate:
    """Depth and spread (h, w) of ``reference``, by plane sweep, semi-global matching and a small network.

    A network weighs what matching offers, so that plain walls are filled as well.

    Args:
        sources: Views with some way between, see ``choose_sources``; without any there is no depth.
        hint: Depth of the reference as a map has it, at the reference's size. Breaks ties of the pictures.
        neighbours: Views whose ``estimate`` is compared: agreement makes a depth surer and more exact.

    Raises:
        ShapeError: a hint of another size.
        WeightsError: the package's weights of the network are missing or damaged.
    """
    size = reference.gray.shape
    if hint is not None:
        expect_shape(hint.depth_m, f"{size[0]} {size[1]}", "hint depth")
        expect_shape(hint.sigma_m, f"{size[0]} {size[1]}", "hint sigma")
    if not sources:
        return no_depth(size)
    matched = match_views(reference, sources, config, hint, neighbours)
    refined = default_refiner()(gather_evidence(reference, matched, len(sources), hint))
    depth = (np.exp(-refined.log_inverse) / matched.inverse_depth[-1]).astype(np.float32)
    return DepthEstimate(depth, (depth * refined.spread).astype(np.float32))


def match_views(
    reference: PreparedView,
    sources: Sequence[PreparedView],
    config: DepthFromMotionConfig,
    hint: DepthEstimate | None,
    neighbours: Sequence[PreparedView],
) -> Matched:
    """What ``estimate_depth`` knows before the network: matching, agreement, and the membrane through both.

    Args:
        sources: At least one; the others are as of ``estimate_depth``.
    """
    inverse_depth = inverse_depths(config.planes, config.near_m, config.far_m)
    swept = sweep_and_match(reference, sources, inverse_depth, hint)
    first, step = float(inverse_depth[0]), float(inverse_depth[1] - inverse_depth[0])
    depth = (1 / (first + swept.plane * step)).astype(np.float32)
    agreement = find_agreement(reference, depth, neighbours)
    plane = ((1 / agreement.mean_m - first) / step).astype(np.float32)
    spread = spread_of_match(swept, agreement, config.near_m)
    surface = np.clip(smooth_planes(plane, spread, reference.rgb), 0, config.planes - 1)
    return Matched(inverse_depth, swept, agreement, surface)


def no_depth(size: tuple[int, int]) -> DepthEstimate:
    """No depth at all, for an image of ``size``."""
    return DepthEstimate(np.zeros(size, np.float32), np.zeros(size, np.float32))
