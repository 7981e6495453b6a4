"""From settings to a pose source; what a kind needs is loaded with it."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from semantic_mapper.config import convert_config
from semantic_mapper.drivers.calibration import rigid_matrix
from semantic_mapper.drivers.poses.config import (
    KINDS,
    BoardPoses,
    DevicePoses,
    FixedPose,
    Matrix,
    OdometryPoses,
    PoseConfig,
    TopicPoses,
    VisualPoses,
)
from semantic_mapper.drivers.poses.posed_camera import DiagnosticPoseSource
from semantic_mapper.errors import ConfigError


def open_poses(config: Mapping[str, Any], where: str = "poses") -> DiagnosticPoseSource:
    """A pose source as a launch file tells of it, ready to be entered.

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
    for name, rows in _matrices(checked).items():
        rigid_matrix(rows, f"{where}: {name}")
    if isinstance(checked, VisualPoses) and checked.scale:
        read_pose_config(checked.scale, f"{where}: scale")
    return checked


def make_poses(config: PoseConfig) -> DiagnosticPoseSource:
    """The source that checked settings stand for."""
    match config:
        case DevicePoses():
            from semantic_mapper.drivers.poses.still import DevicePoseSource

            return DevicePoseSource(config)
        case FixedPose():
            from semantic_mapper.drivers.poses.still import FixedPoseSource

            return FixedPoseSource(config)
        case TopicPoses():
            from semantic_mapper.drivers.poses.topic import TopicPoseSource

            return TopicPoseSource(config)
        case BoardPoses():
            from semantic_mapper.drivers.poses.board import BoardPoseSource

            return BoardPoseSource(config)
        case OdometryPoses():
            from semantic_mapper.drivers.poses.odometry import OdometryPoseSource

            return OdometryPoseSource(config)
        case VisualPoses():
            from semantic_mapper.drivers.poses.visual import VisualPoseSource

            return VisualPoseSource(config, open_poses(config.scale, "poses: scale") if config.scale else None)


def _matrices(config: PoseConfig) -> dict[str, Matrix]:
    """All matrices of a config, by the name of their setting."""
    match config:
        case FixedPose():
            return {"T_world_camera": config.T_world_camera} | _given("T_world_rig", config.T_world_rig)
        case TopicPoses():
            mounts = {f"cameras.{name}": rows for name, rows in config.cameras.items()}
            rig = _given("T_base_rig", config.T_base_rig)
            return {"T_base_camera": config.T_base_camera, **mounts} | rig
        case BoardPoses():
            return {"T_world_board": config.T_world_board}
        case OdometryPoses() | VisualPoses():
            return {"T_world_start": config.T_world_start}
        case DevicePoses():
            return {}


def _given(name: str, rows: Matrix | None) -> dict[str, Matrix]:
    return {} if rows is None else {name: rows}
