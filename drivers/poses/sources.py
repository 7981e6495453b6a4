"""From settings to a pose source; those of devices and of cameras that never move are here."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from semantic_mapper.config import convert_config
from semantic_mapper.drivers.base import CameraImage, PoseEstimate, PoseSource
from semantic_mapper.drivers.calibration import rigid_matrix
from semantic_mapper.drivers.poses.board import BoardPoseSource
from semantic_mapper.drivers.poses.config import (
    KINDS,
    WAYS_OUT,
    BoardPoses,
    DevicePoses,
    FixedPose,
    OdometryPoses,
    PoseConfig,
    TopicPoses,
    VisualPoses,
    matrices,
    matrix,
)
from semantic_mapper.drivers.poses.odometry import OdometryPoseSource
from semantic_mapper.drivers.poses.topic import TopicPoseSource
from semantic_mapper.drivers.poses.visual import VisualPoseSource
from semantic_mapper.errors import CameraError, ConfigError

PATIENCE_S = 20.0  # how long a device that does not say that it tracks itself may take for its first pose


def open_poses(config: Mapping[str, Any], where: str = "poses") -> PoseSource:
    """A pose source of a launch file, ready to be entered.

    Args:
        config: ``kind`` ("device", "fixed", "topic", "board", "rgbd", "visual") and its settings, see ``config.py``.
        where: Names the file or section in errors.

    Raises:
        ConfigError: no such kind, an unknown or bad setting, or a matrix that is no rigid transform.
    """
    return make_poses(read_pose_config(config, where))


def read_pose_config(config: Mapping[str, Any], where: str = "poses") -> PoseConfig:
    """Plain data -> checked settings of one kind; opens nothing. See ``open_poses``."""
    kind = config.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        near = difflib.get_close_matches(str(kind), KINDS, n=1)
        hint = f"; did you mean '{near[0]}'?" if near else ""
        raise ConfigError(f"{where}: kind must be one of {', '.join(KINDS)}, got {kind!r}{hint}")
    checked = convert_config(dict(config), KINDS[kind], where)
    for name, rows in matrices(checked).items():
        rigid_matrix(rows, f"{where}: {name}")
    if isinstance(checked, VisualPoses) and checked.scale:
        read_pose_config(checked.scale, f"{where}: scale")
    return checked


def make_poses(config: PoseConfig) -> PoseSource:
    """The source of checked settings."""
    match config:
        case DevicePoses():
            return DevicePoseSource()
        case FixedPose():
            return FixedPoseSource(config)
        case TopicPoses():
            return TopicPoseSource(config)
        case BoardPoses():
            return BoardPoseSource(config)
        case OdometryPoses():
            return OdometryPoseSource(config)
        case VisualPoses():
            return VisualPoseSource(config, open_poses(config.scale, "poses: scale") if config.scale else None)


class DevicePoseSource(PoseSource):
    """Takes the poses that the device itself puts into its images."""

    def __init__(self) -> None:
        super().__init__()
        self._first_ns: int | None = None  # of the images
        self._tracked = False

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """The image's own pose; None where the device does not know it now, or not yet.

        Raises:
            CameraError: no image had one for ``PATIENCE_S``, and the camera does not track itself.
        """
        self._tracked |= image.tracks_itself
        if image.own_pose is not None:
            self._tracked, self._warnings = True, ()
            return image.own_pose
        self._first_ns = image.stamp_ns if self._first_ns is None else self._first_ns
        waited_s = (image.stamp_ns - self._first_ns) / 1e9
        if not self._tracked and waited_s > PATIENCE_S:
            raise CameraError(
                f"camera '{image.camera_id}' has given no pose of its own for {waited_s:.1f} s, so it does not "
                f"track itself, or its tracking is not switched on; {WAYS_OUT}"
            )
        self._warnings = (f"camera '{image.camera_id}' does not know where it is; frames are left out until it does",)
        return None


class FixedPoseSource(PoseSource):
    """The same pose for every image.

    Args:
        config: Which.
    """

    def __init__(self, config: FixedPose) -> None:
        super().__init__()
        self._estimate = PoseEstimate(matrix(config.T_world_rig or config.T_world_camera), "fixed")

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """The pose."""
        return self._estimate
