"""What a mapper that is kept in waiting does before it is needed: all that would take long at its first frame."""

from __future__ import annotations

import numpy as np

from semantic_mapper.geometry import pose_matrix
from semantic_mapper.mapper import Mapper
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.types import CameraIntrinsics, PosedFrame

_WIDTH, _HEIGHT = 160, 120
_FRAMES = 3  # the second is rendered from the first; the third meets what the second left


def warm_up_mapper(bundle: Mapper) -> None:
    """Map a wall in a pipeline that is thrown away, and copy a map once.

    What computes loads its code and allocates what it keeps. The pipeline of ``bundle`` is as it was.
    """
    own = bundle.pipeline
    pipeline = MappingPipeline(own.config, own.field, own.label_set)
    for number in range(_FRAMES):
        pipeline.step(_wall(number))


def _wall(number: int) -> PosedFrame:
    """A frame that looks at a speckled wall, from a little further right each time."""
    intrinsics = CameraIntrinsics(130.0, 130.0, _WIDTH / 2, _HEIGHT / 2, _WIDTH, _HEIGHT)
    rgb = np.random.default_rng(0).integers(0, 256, (_HEIGHT, _WIDTH, 3), np.uint8)
    depth = np.full((_HEIGHT, _WIDTH), 1.5, np.float32)
    T = pose_matrix(np.array((0.05 * number, 0.0, 0.0)), np.array((0.0, 0.0, 0.0, 1.0)))
    return PosedFrame(number + 1, number, "warm-up", rgb, depth, None, intrinsics, T, "none", 0.0)
