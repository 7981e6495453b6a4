import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from semantic_mapper.drivers.calibration import load_mount, save_calibration
from semantic_mapper.drivers.poses.board import BoardPoseSource
from semantic_mapper.drivers.poses.config import IDENTITY, mount_for
from semantic_mapper.drivers.poses.odometry import OdometryPoseSource
from semantic_mapper.drivers.poses.posed_camera import PosedCamera
from semantic_mapper.drivers.poses.sources import DevicePoseSource, FixedPoseSource, make_poses, read_pose_config
from semantic_mapper.drivers.poses.topic import TopicPoseSource
from semantic_mapper.drivers.poses.visual import VisualPoseSource
from semantic_mapper.errors import ConfigError

from .images import INTRINSICS, ListCamera, image, rigid


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ('kind = "device"', DevicePoseSource),
        ('kind = "fixed"\nT_world_camera = [[1,0,0,2],[0,1,0,0],[0,0,1,0],[0,0,0,1]]', FixedPoseSource),
        ('kind = "topic"\nendpoint = "ipc:///tmp/robot"', TopicPoseSource),
        ('kind = "board"\ncolumns = 5', BoardPoseSource),
        ('kind = "rgbd"\nloop_closure = false', OdometryPoseSource),
        ('kind = "visual"\ncamera_height_m = 1.0', VisualPoseSource),
        ('kind = "visual"\nscale = { kind = "board", columns = 5 }', VisualPoseSource),
    ],
)
def test_a_section_of_a_launch_file_becomes_a_pose_source(text: str, kind: type) -> None:
    source = make_poses(read_pose_config(tomllib.loads(text)))
    assert isinstance(source, kind)
    assert source.warnings == () and not source.counters


T_RIG_CAMERA = rigid((0.02, -0.4, 0.1), (0.12, -0.03, 0.05))
ROWS = tuple(tuple(row) for row in T_RIG_CAMERA.tolist())
TOPIC = {"kind": "topic", "endpoint": "ipc:///tmp/robot", "T_base_rig": np.eye(4).tolist()}
RIG = read_pose_config(TOPIC)
NO_ROTATION = [[2.0, 0, 0, 0], *IDENTITY[1:]]
NO_NUMBER = [[math.nan, 0, 0, 0], *IDENTITY[1:]]


@pytest.mark.parametrize(
    ("config", "reason"),
    [
        ({}, "no kind of poses is called None; there are device, fixed, topic, board, rgbd, visual"),
        ({"kind": "bord"}, "did you mean `board`"),
        ({"kind": "topic"}, "endpoint"),
        ({"kind": "board", "column": 3}, "did you mean `columns`"),
        ({"kind": "board", "square_m": 0.02}, "must be smaller than square_m"),
        ({"kind": "board", "rows": 1}, "at least 2 columns"),
        ({"kind": "board", "T_world_board": NO_ROTATION}, "poses: T_world_board"),
        ({"kind": "fixed", "T_world_camera": [[1, 0], [0, 1]]}, "T_world_camera"),
        ({"kind": "fixed", "T_world_camera": NO_NUMBER}, "poses: T_world_camera"),
        ({"kind": "topic", "endpoint": "ipc:///tmp/x", "T_base_camera": NO_ROTATION}, "poses: T_base_camera"),
        ({"kind": "rgbd", "loop_closure": 1.5}, "loop_closure"),
        ({"kind": "rgbd", "T_world_start": NO_NUMBER}, "poses: T_world_start"),
        ({"kind": "visual", "scale": {"kind": "fixed"}}, 'must be "topic" or "board"'),
        ({"kind": "visual", "scale": {"kind": "board", "colums": 5}}, "did you mean `columns`"),
        ({"kind": "visual", "scale": {"kind": "board"}, "camera_height_m": 1.0}, "one of scale and camera_height"),
        ({"kind": "fixed", "T_world_rig": np.eye(4).tolist(), "T_world_camera": T_RIG_CAMERA.tolist()}, "T_world_rig"),
        ({**TOPIC, "T_base_camera": T_RIG_CAMERA.tolist()}, "give T_base_camera or"),
        ({**TOPIC, "T_base_rig": (2 * np.eye(4)).tolist()}, "T_base_rig"),
    ],
)
def test_what_is_wrong_is_named(config: dict[str, Any], reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        read_pose_config(config, "launch.toml: poses")


def test_frames_are_where_the_rig_is_times_where_the_camera_sits() -> None:
    T_world_rig = rigid((0.3, 0.1, -0.2), (1, 2, 3))
    poses = read_pose_config({"kind": "fixed", "T_world_rig": T_world_rig.tolist()})
    mount = mount_for(poses, ROWS, "v4l2", {}, "camera 'left'")
    with PosedCamera(ListCamera([image(5)]), make_poses(poses), T_rig_camera=mount) as camera:
        (frame,) = camera
    np.testing.assert_allclose(frame.T_world_camera, T_world_rig @ T_RIG_CAMERA, atol=1e-12)


def test_the_calibration_file_says_where_the_camera_sits_unless_the_settings_do(tmp_path: Path) -> None:
    path = tmp_path / "left.toml"
    config = {"calibration": str(path)}
    save_calibration(path, INTRINSICS, T_RIG_CAMERA, {})
    np.testing.assert_array_equal(mount_for(RIG, None, "v4l2", config, "left"), T_RIG_CAMERA)
    np.testing.assert_array_equal(mount_for(RIG, tuple(map(tuple, np.eye(4))), "v4l2", config, "left"), np.eye(4))
    own = read_pose_config({"kind": "board"})
    assert mount_for(own, None, "v4l2", config, "left") is None
    with pytest.raises(ConfigError, match=r'poses \(kind "board"\) are the camera\'s own'):
        mount_for(own, ROWS, "v4l2", {}, "left")
    for kind, file in (("v4l2", {}), ("oak", {"calibration": "depthai.json"})):
        with pytest.raises(ConfigError, match="left: its poses are those of a rig, and nothing says where it sits"):
            mount_for(RIG, None, kind, file, "left")
    save_calibration(path, INTRINSICS, 2 * np.eye(4), {})
    with pytest.raises(ConfigError, match=r"left\.toml: T_rig_camera.*last row"):
        load_mount(path)
    with pytest.raises(ConfigError, match="left: T_rig_camera"):
        mount_for(RIG, tuple(map(tuple, 2 * np.eye(4))), "v4l2", {}, "left")
