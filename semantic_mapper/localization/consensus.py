"""Several frames that were found in a map, each by itself: whether they say the same of where the map is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from semantic_mapper.geometry import invert_pose, rotation_vector
from semantic_mapper.types import Float64

AGREEING = 3  # frames that must say the same
_SAME_M, _SAME_RAD = 0.08, np.deg2rad(3.0)  # what they may differ by


@dataclass(frozen=True, slots=True, eq=False)
class Sighting:
    """A frame that was found.

    Args:
        T_map_world: (4, 4) where that puts the world of its pose.
        T_world_camera: (4, 4) its pose there.
        inliers: Features that agree.
    """

    T_map_world: Float64
    T_world_camera: Float64
    inliers: int


def sighting(T_map_camera: Float64, T_world_camera: Float64, inliers: int) -> Sighting:
    """A frame of this pose that was found at that one."""
    return Sighting(T_map_camera @ invert_pose(T_world_camera), T_world_camera, inliers)


def agreeing_with(one: Sighting, others: Sequence[Sighting]) -> list[Sighting]:
    """Those that say the same as ``one`` of where both cameras were; itself, too, if it is among them."""
    return [other for other in others if _agree(one, other)]


def best_consensus(seen: Sequence[Sighting]) -> list[Sighting]:
    """The most that agree with one of them; earlier ones first if equal."""
    return max((agreeing_with(one, seen) for one in seen), key=len, default=[])


def agreed(agreeing: Sequence[Sighting]) -> Float64:
    """T_map_world (4, 4) of those that agree: that of the one with the most features, its rotation exact."""
    T = max(agreeing, key=lambda s: s.inliers).T_map_world.copy()
    u, _, vt = np.linalg.svd(T[:3, :3])
    T[:3, :3] = u @ vt
    return T


def _agree(a: Sighting, b: Sighting) -> bool:
    for pose in (a.T_world_camera, b.T_world_camera):
        apart = invert_pose(a.T_map_world @ pose) @ (b.T_map_world @ pose)
        if np.linalg.norm(apart[:3, 3]) > _SAME_M or np.linalg.norm(rotation_vector(apart)) > _SAME_RAD:
            return False
    return True
