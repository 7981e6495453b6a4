"""A walk through a furnished room, for tests of poses from pictures."""

from functools import cache

import numpy as np

from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame
from tests.drawn_room import truth_of, walk_frames

INTRINSICS = CameraIntrinsics(220.0, 220.0, 159.5, 119.5, 320, 240)


@cache
def walk() -> tuple[PosedFrame, ...]:
    """Frames 5 cm apart, and where they truly are."""
    return walk_frames(7, 30, INTRINSICS, step_m=0.05)


def truth() -> Float64:
    """(N, 4, 4) T_world_camera of the walk."""
    return truth_of(walk())


def way_m() -> float:
    """Length of the walk."""
    return float(np.linalg.norm(np.diff(truth()[:, :3, 3], axis=0), axis=1).sum())
