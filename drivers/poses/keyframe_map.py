"""The keyframes that odometry aligns to, and which of them a view is near."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from semantic_mapper.drivers.poses.alignment import Target
from semantic_mapper.localization.features import Features
from semantic_mapper.types import Float64

_REACH_M, _REACH_RAD = 0.6, 0.6  # further away, or turned further, keyframes share too little with a view


@dataclass(frozen=True, slots=True, eq=False)
class OdometryKeyframe:
    """One.

    Args:
        number: Counts keyframes.
        target: What views are aligned to.
        features: For finding back.
        place: For loop closure.
        way_m: Length of the shortest chain of keyframes back to the first one: errors add up along it.
        unsure_m: How far it may be off along what no point told of.
    """

    number: int
    target: Target
    features: Features
    place: Features
    way_m: float
    unsure_m: float = 0.0

    def moved(self, T_world_camera: Float64) -> OdometryKeyframe:
        """The same at another pose."""
        return replace(self, target=replace(self.target, T_world_camera=T_world_camera))


class KeyframeMap:
    """Keyframes in the order they were made.

    Args:
        capacity: Beyond it the younger of the two that are nearest to each other goes.
    """

    def __init__(self, capacity: int) -> None:
        self.frames: list[OdometryKeyframe] = []
        self._capacity = capacity
        self._positions = np.zeros((0, 3))
        self._rotations = np.zeros((0, 3, 3))

    def __len__(self) -> int:
        return len(self.frames)

    def add(self, keyframe: OdometryKeyframe) -> tuple[int, int] | None:
        """Append one; the number of the one that had to go, and of that nearest to it, or None."""
        self.frames.append(keyframe)
        gone: tuple[int, int] | None = None
        if len(self.frames) > self._capacity:
            heir, leaving = self._most_crowded()
            gone = self.frames[leaving].number, self.frames[heir].number
            del self.frames[leaving]
        self._place()
        return gone

    def move(self, poses: Mapping[int, Float64]) -> None:
        """Put keyframes at other poses, by number."""
        self.frames = [k.moved(poses[k.number]) for k in self.frames]
        self._place()

    def _place(self) -> None:
        poses = np.array([k.target.T_world_camera for k in self.frames])
        self._positions, self._rotations = poses[:, :3, 3], poses[:, :3, :3]

    def distances(self, T_world_camera: Float64) -> tuple[Float64, Float64]:
        """Metres (N,) and radians (N,) from a pose to each keyframe's."""
        way = np.linalg.norm(self._positions - T_world_camera[:3, 3], axis=1)
        trace = np.einsum("nij,ij->n", self._rotations, T_world_camera[:3, :3])
        return way, np.arccos(np.clip((trace - 1) / 2, -1, 1))

    def near(self, T_world_camera: Float64, count: int) -> list[OdometryKeyframe]:
        """Up to ``count`` keyframes to align a view to: the nearest one first, then the oldest ones within reach.

        Old ones have the least drift, and hold later ones to them where the camera comes back. Where none is within
        reach, the nearest one alone.
        """
        way, turn = self.distances(T_world_camera)
        apart = np.hypot(way / _REACH_M, turn / _REACH_RAD)
        nearest = int(apart.argmin())
        others = [i for i in np.flatnonzero(apart < 1) if i != nearest]
        return [self.frames[i] for i in (nearest, *others[: count - 1])]

    def _most_crowded(self) -> tuple[int, int]:
        """Indices of the two frames nearest to each other, the older first; never the newest, which is in use."""
        poses = np.array([k.target.T_world_camera for k in self.frames[:-1]])
        turn = np.arccos(np.clip((np.einsum("nij,mij->nm", poses[:, :3, :3], poses[:, :3, :3]) - 1) / 2, -1, 1))
        way = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=-1)
        apart = np.hypot(way / _REACH_M, turn / _REACH_RAD) + np.diag(np.full(len(poses), np.inf))
        a, b = np.unravel_index(int(apart.argmin()), apart.shape)
        return int(min(a, b)), int(max(a, b))
