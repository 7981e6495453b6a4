"""Where a camera sits on its rig, and what that makes of the poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from semantic_mapper.drivers.calibration import load_mount, save_calibration
from semantic_mapper.drivers.poses.config import mount_for
from semantic_mapper.drivers.poses.posed_camera import PosedCamera
from semantic_mapper.drivers.poses.sources import make_poses, read_pose_config
from semantic_mapper.errors import ConfigError
from tests.drivers.poses.images import INTRINSICS, ListCamera, image, rigid

T_RIG_CAMERA = rigid((0.02, -0.4, 0.1), (0.12, -0.03, 0.05))
ROWS = tuple(tuple(row) for row in T_RIG_CAMERA.tolist())
TOPIC = {"kind": "topic", "endpoint": "ipc:///tmp/robot", "T_base_rig": np.eye(4).tolist()}
RIG = read_pose_config(TOPIC)


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


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"kind": "fixed", "T_world_rig": np.eye(4).tolist(), "T_world_camera": T_RIG_CAMERA.tolist()}, "T_world_rig"),
        ({**TOPIC, "T_base_camera": T_RIG_CAMERA.tolist()}, "give T_base_camera or"),
        ({**TOPIC, "T_base_rig": (2 * np.eye(4)).tolist()}, "T_base_rig"),
    ],
)
def test_what_contradicts_itself_is_refused(settings: dict[str, object], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        read_pose_config(settings)
