"""The keyframes that odometry aligns to, which of them a view is near, and the poses that were given along them."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from semantic_mapper.drivers.base import CorrectedWorld
from semantic_mapper.geometry import invert_pose, pose_distance
from semantic_mapper.localization.depth_alignment import Fit, Target
from semantic_mapper.localization.features import Features
from semantic_mapper.types import Float64

MAX_KEYFRAMES = 500  # 0.5 MB each; the younger of the two that are nearest to each other goes
MIN_MATCHES = 15  # corners that agree, for a guess
MIN_FITNESS = 0.5  # of the frame's points that the keyframe sees must lie on its surface
MIN_OVERLAP = 0.35  # of the frame's points that have to be in a keyframe's view
MAX_RMSE_M = 0.025  # of the distances that count
DRIFT = 0.05  # of the way: what ``sigma`` grows by with the chain of keyframes
_REACH_M, _REACH_RAD = 0.6, 0.6  # further away, or turned further, keyframes share too little with a view
_KEPT = 20_000  # poses that were given; 2 x 128 bytes each
_VISIBLE_M = 0.02  # no correction for less; what is left is given at the end
_LEFT_M = 0.002


def apart(T_a: Float64, T_b: Float64) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    moved_m, turned = pose_distance(T_a, T_b)
    return moved_m, float(np.rad2deg(turned))


def lies_on(found: Fit) -> bool:
    """Whether a view lies on the surface of a keyframe."""
    return found.overlap >= MIN_OVERLAP and found.fitness >= MIN_FITNESS and found.rmse_m <= MAX_RMSE_M


@dataclass(frozen=True, slots=True, eq=False)
class OdometryKeyframe:
    """One.

    Args:
        number: Counts keyframes.
        target: What views are aligned to.
        features: For finding back.
        place: For loop closure.
        way_m: Length of the shortest chain of keyframes back to the first one: errors add up along it.
        unsure_m: How far it may be off along what no point showed.
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

    def __init__(self, capacity: int = MAX_KEYFRAMES) -> None:
        self.frames: list[OdometryKeyframe] = []
        self._capacity = capacity

    def __len__(self) -> int:
        return len(self.frames)

    @property
    def poses(self) -> dict[int, Float64]:
        """T_world_camera (4, 4) by number."""
        return {k.number: k.target.T_world_camera for k in self.frames}

    def add(self, keyframe: OdometryKeyframe) -> tuple[int, int] | None:
        """Append one; the number of the one that had to go, and of that nearest to it, or None."""
        self.frames.append(keyframe)
        if len(self.frames) <= self._capacity:
            return None
        poses = np.array([k.target.T_world_camera for k in self.frames[:-1]])  # never the newest, which is in use
        way, turn = _distances(poses[:, None], poses[None])
        crowded = np.hypot(way / _REACH_M, turn / _REACH_RAD) + np.diag(np.full(len(poses), np.inf))
        heir, leaving = sorted(int(i) for i in np.unravel_index(int(crowded.argmin()), crowded.shape))
        gone = self.frames[leaving].number, self.frames[heir].number
        del self.frames[leaving]
        return gone

    def move(self, poses: Mapping[int, Float64]) -> None:
        """Put keyframes at other poses, by number."""
        self.frames = [k.moved(poses[k.number]) for k in self.frames]

    def distances(self, T_world_camera: Float64) -> tuple[Float64, Float64]:
        """Metres (N,) and radians (N,) from a pose to each keyframe's."""
        return _distances(np.array([k.target.T_world_camera for k in self.frames]), T_world_camera)

    def near(self, T_world_camera: Float64, count: int) -> list[OdometryKeyframe]:
        """Up to ``count`` keyframes to align a view to: the nearest one first, then the oldest ones within reach.

        Old ones have the least drift, and hold later ones to them where the camera comes back. Where none is within
        reach, the nearest one alone.
        """
        way, turn = self.distances(T_world_camera)
        spacing = np.hypot(way / _REACH_M, turn / _REACH_RAD)
        nearest = int(spacing.argmin())
        others = [i for i in np.flatnonzero(spacing < 1) if i != nearest]
        return [self.frames[i] for i in (nearest, *others[: count - 1])]


def _distances(T_world_a: Float64, T_world_b: Float64) -> tuple[Float64, Float64]:
    """Metres and radians between poses (..., 4, 4)."""
    way = np.linalg.norm(T_world_a[..., :3, 3] - T_world_b[..., :3, 3], axis=-1)
    trace = (T_world_a[..., :3, :3] * T_world_b[..., :3, :3]).sum(axis=(-2, -1))
    return way, np.arccos(np.clip((trace - 1) / 2, -1, 1))


@dataclass(slots=True, eq=False)
class _Given:
    """A pose that was given: relative to its keyframe, and as of the last correction."""

    stamp_ns: int
    keyframe: int
    T_keyframe_camera: Float64
    T_world_camera: Float64


class PoseTrail:
    """The last poses that a camera was given, oldest first: where keyframes move, they move along."""

    def __init__(self) -> None:
        self._given: deque[_Given] = deque(maxlen=_KEPT)

    def add(self, stamp_ns: int, keyframe: int, T_world_keyframe: Float64, T_world_camera: Float64) -> None:
        """A pose is given."""
        relative = invert_pose(T_world_keyframe) @ T_world_camera
        self._given.append(_Given(stamp_ns, keyframe, relative, T_world_camera))

    def hand_over(self, gone: int, heir: int, T_heir_gone: Float64) -> None:
        """A keyframe is no longer kept: poses relative to it are those of another one from now on."""
        for given in self._given:
            if given.keyframe == gone:
                given.keyframe, given.T_keyframe_camera = heir, T_heir_gone @ given.T_keyframe_camera

    def correction(self, T_world_keyframe: Mapping[int, Float64], final: bool) -> CorrectedWorld | None:
        """All poses as the keyframes stand now, if that moves one visibly.

        Args:
            T_world_keyframe: (4, 4) of the keyframes that are kept, by number.
            final: No more poses will come.
        """
        if not self._given:
            return None
        poses = np.array([T_world_keyframe[g.keyframe] for g in self._given]) @ np.array(
            [g.T_keyframe_camera for g in self._given]
        )
        before = np.array([g.T_world_camera for g in self._given])
        moved_m = float(np.linalg.norm(poses[:, :3, 3] - before[:, :3, 3], axis=1).max())
        if moved_m < (_LEFT_M if final else _VISIBLE_M):
            return None
        for given, pose in zip(self._given, poses, strict=True):
            given.T_world_camera = pose
        last = self._given[-1]
        motion = last.T_world_camera @ invert_pose(before[-1])
        return CorrectedWorld({g.stamp_ns: g.T_world_camera for g in self._given}, last.stamp_ns, motion)
