"""From settings to a pose source; those of devices and of cameras that never move are here."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from semantic_mapper.config import convert_config, nearest
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
)
from semantic_mapper.drivers.poses.odometry import OdometryPoseSource
from semantic_mapper.drivers.poses.topic import TopicPoseSource
from semantic_mapper.drivers.poses.visual import VisualPoseSource
from semantic_mapper.errors import CameraError, ConfigError


def read_pose_config(config: Mapping[str, Any], where: str = "poses") -> PoseConfig:
    """Plain data -> checked settings of one ``kind`` (of ``KINDS``); opens nothing.

    Raises ConfigError: no such kind, an unknown or bad setting, or a matrix that is no rigid transform.
    """
    kind = config.get("kind")
    if not isinstance(kind, str) or kind not in KINDS:
        raise ConfigError(f"{where}: no kind of poses is called {kind!r}{nearest(str(kind), [*KINDS])}")
    checked = convert_config(dict(config), KINDS[kind], where)
    for name in checked.__struct_fields__:
        if name.startswith("T_") and (rows := getattr(checked, name)) is not None:
            rigid_matrix(rows, f"{where}: {name}")
    if isinstance(checked, VisualPoses) and checked.scale:
        read_pose_config(checked.scale, f"{where}: scale")
    return checked


def make_poses(config: PoseConfig) -> PoseSource:
    """The source of checked settings, ready to be entered."""
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
        case VisualPoses(scale=scale):
            return VisualPoseSource(config, make_poses(read_pose_config(scale, "poses: scale")) if scale else None)


class DevicePoseSource(PoseSource):
    """Takes the poses that the device itself puts into its images."""

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """The image's own pose; None where it is not known now. ``CameraError``: the camera does not track itself."""
        if image.own_pose is not None:
            self._warnings = ()
            return image.own_pose
        if not image.tracks_itself:
            raise CameraError(
                f"camera '{image.camera_id}' gives no pose of its own: it does not track itself, or its tracking is "
                f"not switched on; {WAYS_OUT}"
            )
        self._warnings = (f"camera '{image.camera_id}' does not know where it is; frames are left out until it does",)
        return None


class FixedPoseSource(PoseSource):
    """The same pose for every image."""

    def __init__(self, config: FixedPose) -> None:
        super().__init__()
        self._estimate = PoseEstimate(np.array(config.T_world_rig or config.T_world_camera), "fixed")

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """The pose."""
        return self._estimate
