"""Depth that is computed from the pictures of training rooms, as a camera without a depth sensor has it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion.stream import DepthFromMotion
from semantic_mapper.types import PosedFrame

BETWEEN_M = 0.12  # way between two pictures at most: views farther apart get others in between, as a video has them
DELAY_FRAMES = 6  # that half of the rooms' frames wait for later ones, as in ``map``; the others are as if live
_STREAM = 11  # number of the random stream; rooms, paths, shots, poses and cameras use others


@dataclass(frozen=True, slots=True)
class ComputedDepth:
    """How the depth of a room's views is computed.

    Args:
        between: Pictures a view, counting the view's own.
        delay_frames: Pictures that each waits for.
    """

    between: int
    delay_frames: int


def draw_computed_depth(seed: int, fraction: float, step_m: float) -> ComputedDepth | None:
    """Whether and how depth is computed in the room of ``seed``; None = it is measured.

    Args:
        fraction: Of the rooms.
        step_m: Way between two views.
    """
    rng = np.random.default_rng((_STREAM, seed))
    if rng.uniform() >= fraction:
        return None
    return ComputedDepth(math.ceil(step_m / BETWEEN_M), DELAY_FRAMES if rng.uniform() < 0.5 else 0)


def compute_depth(frames: Sequence[PosedFrame], how: ComputedDepth) -> list[PosedFrame]:
    """Every ``how.between``-th frame, with depth and spread computed from the pictures and poses of all."""
    computer = DepthFromMotion(DepthFromMotionConfig(delay_frames=how.delay_frames))
    ready = [done for frame in frames for done in computer.push(replace(frame, depth_m=None))]
    return [*ready, *computer.finish()][:: how.between]
