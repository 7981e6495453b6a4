"""The poses that a camera was given, each relative to a keyframe: where keyframes move, they move along."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from semantic_mapper.drivers.base import CorrectedWorld
from semantic_mapper.geometry import invert_pose
from semantic_mapper.types import Float64

_KEPT = 20_000  # poses; 2 x 128 bytes each
_VISIBLE_M = 0.02  # no correction for less; what is left is given at the end
_LEFT_M = 0.002


class PoseTrail:
    """The last poses given, oldest first."""

    def __init__(self) -> None:
        self._stamps: list[int] = []
        self._keyframes: list[int] = []
        self._relative: list[Float64] = []  # T_keyframe_camera
        self._given: list[Float64] = []  # T_world_camera, as of the last correction

    def add(self, stamp_ns: int, keyframe: int, T_world_keyframe: Float64, T_world_camera: Float64) -> None:
        """A pose is given."""
        self._stamps.append(stamp_ns)
        self._keyframes.append(keyframe)
        self._relative.append(invert_pose(T_world_keyframe) @ T_world_camera)
        self._given.append(T_world_camera)
        if len(self._stamps) > _KEPT:
            for column in (self._stamps, self._keyframes, self._relative, self._given):
                del column[0]

    def hand_over(self, gone: int, heir: int, T_heir_gone: Float64) -> None:
        """A keyframe is no longer kept: poses relative to it are those of another one from now on."""
        for row, number in enumerate(self._keyframes):
            if number == gone:
                self._keyframes[row] = heir
                self._relative[row] = T_heir_gone @ self._relative[row]

    def correction(self, T_world_keyframe: Mapping[int, Float64], final: bool) -> CorrectedWorld | None:
        """All poses as the keyframes stand now, if that moves one visibly.

        Args:
            T_world_keyframe: (4, 4) of the keyframes that are kept, by number.
            final: No more poses will come.
        """
        if not self._stamps:
            return None
        poses = np.array([T_world_keyframe[n] for n in self._keyframes]) @ np.array(self._relative)
        moved_m = float(np.linalg.norm(poses[:, :3, 3] - np.array(self._given)[:, :3, 3], axis=1).max())
        if moved_m < (_LEFT_M if final else _VISIBLE_M):
            return None
        motion = poses[-1] @ invert_pose(self._given[-1])
        self._given = list(poses)
        return CorrectedWorld(dict(zip(self._stamps, poses, strict=True)), self._stamps[-1], motion)
