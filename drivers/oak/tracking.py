"""Poses of the device's odometry, for the moments of the images."""

from __future__ import annotations

import threading
from collections import deque

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from semantic_mapper.drivers.base import PoseEstimate
from semantic_mapper.errors import PoseError
from semantic_mapper.geometry import check_pose
from semantic_mapper.types import Float64

SOURCE = "vio"
KEPT = 200  # poses: some seconds
GAP_NS = 200_000_000  # nothing is interpolated across a longer silence

# Basalt's poses are those of the left camera's body: x forward, y left, z up.
T_BODY_LEFT: Float64 = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)


def basalt_pose(position: tuple[float, float, float], quaternion: tuple[float, float, float, float]) -> Float64:
    """Pose (4, 4) of the left camera, from what Basalt says of its body.

    Args:
        position: Metres.
        quaternion: x, y, z, w.

    Raises:
        PoseError: no rotation, or no finite numbers: it has lost track.
    """
    if not np.isfinite((*position, *quaternion)).all() or not np.linalg.norm(quaternion) > 0.5:
        raise PoseError(f"odometry gave no pose: position {position}, quaternion {quaternion}")
    T_world_body = np.eye(4)
    T_world_body[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
    T_world_body[:3, 3] = position
    return T_world_body @ T_BODY_LEFT


class PoseTrack:
    """The latest poses of the left camera; any thread may add and ask.

    Args:
        T_left_rgb: (4, 4) from the colour camera to the left one.
    """

    def __init__(self, T_left_rgb: Float64) -> None:
        check_pose(T_left_rgb, "extrinsics of the OAK's colour camera")
        self._T_left_rgb = T_left_rgb
        self._lock = threading.Lock()
        self._poses: deque[tuple[int, Float64]] = deque(maxlen=KEPT)

    def add(self, stamp_ns: int, T_world_left: Float64) -> None:
        """Add a pose; one that is not later than the last is passed over."""
        with self._lock:
            if not self._poses or stamp_ns > self._poses[-1][0]:
                self._poses.append((stamp_ns, T_world_left))

    def reaches(self, stamp_ns: int) -> bool:
        """Whether the poses go as far as this moment: waiting longer brings nothing new for it."""
        with self._lock:
            return bool(self._poses) and self._poses[-1][0] >= stamp_ns

    def at(self, stamp_ns: int) -> PoseEstimate | None:
        """Pose of the colour camera at a moment between two poses; None where there are none round it."""
        with self._lock:
            after = next((pose for pose in self._poses if pose[0] >= stamp_ns), None)
            before = next((pose for pose in reversed(self._poses) if pose[0] <= stamp_ns), None)
        if before is None or after is None or after[0] - before[0] > GAP_NS:
            return None
        return PoseEstimate(T_world_camera=_between(stamp_ns, before, after) @ self._T_left_rgb, source=SOURCE)


def _between(stamp_ns: int, before: tuple[int, Float64], after: tuple[int, Float64]) -> Float64:
    if before[0] == after[0]:
        return before[1]
    share = (stamp_ns - before[0]) / (after[0] - before[0])
    pose = np.eye(4)
    pose[:3, :3] = Slerp((0, 1), Rotation.from_matrix((before[1][:3, :3], after[1][:3, :3])))(share).as_matrix()
    pose[:3, 3] = (1 - share) * before[1][:3, 3] + share * after[1][:3, 3]
    return pose
