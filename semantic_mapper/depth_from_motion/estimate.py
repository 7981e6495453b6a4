"""Depth of one view from several others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion.agreement import Agreement, find_agreement
from semantic_mapper.depth_from_motion.smooth import smooth_planes
from semantic_mapper.depth_from_motion.spread import spread_of_match, spread_of_surface
from semantic_mapper.depth_from_motion.sweep import SweepResult, inverse_depths, sweep_and_match
from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView
from semantic_mapper.geometry import expect_shape
from semantic_mapper.types import Float32


def estimate_depth(
    reference: PreparedView,
    sources: Sequence[PreparedView],
    config: DepthFromMotionConfig,
    hint: DepthEstimate | None = None,
    neighbours: Sequence[PreparedView] = (),
) -> DepthEstimate:
    """Depth and spread (h, w) of ``reference``, by plane sweep and semi-global matching.

    What is not sure is filled from what is, along the surfaces that the image shows.

    Args:
        sources: Views with some way between, see ``choose_sources``; without any there is no depth.
        hint: Depth of the reference as a map has it, at the reference's size. Breaks ties of the pictures.
        neighbours: Views whose ``estimate`` is compared: agreement makes a depth surer and more exact.

    Raises:
        ShapeError: a hint of another size.
    """
    size = reference.gray.shape
    if hint is not None:
        expect_shape(hint.depth_m, f"{size[0]} {size[1]}", "hint depth")
        expect_shape(hint.sigma_m, f"{size[0]} {size[1]}", "hint sigma")
    if not sources:
        return no_depth(size)
    return match_views(reference, sources, config, hint, neighbours).estimate


class Matched(NamedTuple):
    """What matching found of a view, and the depth that follows."""

    swept: SweepResult
    agreement: Agreement
    surface: Float32  # (h, w) planes
    estimate: DepthEstimate


def match_views(
    reference: PreparedView,
    sources: Sequence[PreparedView],
    config: DepthFromMotionConfig,
    hint: DepthEstimate | None,
    neighbours: Sequence[PreparedView],
) -> Matched:
    """The work of ``estimate_depth``, with at least one source."""
    inverse_depth = inverse_depths(config.planes, config.near_m, config.far_m)
    swept = sweep_and_match(reference, sources, inverse_depth, hint)
    first, step = float(inverse_depth[0]), float(inverse_depth[1] - inverse_depth[0])
    depth = (1 / (first + swept.plane * step)).astype(np.float32)
    agreement = find_agreement(reference, depth, neighbours)
    plane = ((1 / agreement.mean_m - first) / step).astype(np.float32)
    matched = spread_of_match(swept, agreement)
    surface = np.clip(smooth_planes(plane, matched, reference.rgb), 0, config.planes - 1)
    depth = (1 / (first + surface * step)).astype(np.float32)
    sigma = spread_of_surface(plane, surface, matched, agreement, depth)
    return Matched(swept, agreement, surface, DepthEstimate(depth, (depth**2 * step * sigma).astype(np.float32)))


def no_depth(size: tuple[int, int]) -> DepthEstimate:
    """No depth at all, for an image of ``size``."""
    return DepthEstimate(np.zeros(size, np.float32), np.zeros(size, np.float32))
