"""Camera paths: valid poses, free space, views worth having."""

from __future__ import annotations

import numpy as np
import pytest

from research.scenes import CameraPathConfig, RoomConfig, camera_path, make_room, render_view
from research.scenes.camera import clearance, pose_of
from semantic_mapper.errors import ConfigError, SemanticMapperError
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import CameraIntrinsics

SMALL = CameraIntrinsics(fx=27.6, fy=27.6, cx=19.5, cy=14.5, width=40, height=30)
FAST = RoomConfig(shadow_resolution=8)
SHELL = [ROOMS.ids[ROOMS.names.index(name)] for name in ("wall", "floor", "ceiling")]


def test_the_same_seed_gives_the_same_path() -> None:
    scene = make_room(5, FAST)
    np.testing.assert_array_equal(camera_path(scene, 9, 2), camera_path(scene, 9, 2))
    assert not np.array_equal(camera_path(scene, 9, 2), camera_path(scene, 9, 3))


@pytest.mark.parametrize("seed", range(12))
def test_cameras_are_valid_and_clear_of_everything(seed: int) -> None:
    scene = make_room(seed, FAST)
    config = CameraPathConfig(step_m=0.2)
    poses = camera_path(scene, 24, 0, config)
    assert poses.shape == (24, 4, 4)
    assert poses.dtype == np.float64
    for pose in poses:
        check_pose(pose, "test")
    assert clearance(scene, poses[:, :3, 3]).min() > config.clearance_m - 4 * config.tremor_m


@pytest.mark.parametrize("seed", range(6))
def test_views_show_furniture_and_no_void(seed: int) -> None:
    scene = make_room(seed, FAST)
    shares = []
    for pose in camera_path(scene, 12, 1, CameraPathConfig(step_m=0.25)):
        view = render_view(scene, SMALL, pose)
        assert (view.label != ROOMS.ignore_id).all()
        assert (view.depth_m > 0).all()
        shares.append((~np.isin(view.label, SHELL)).mean())
    assert np.mean(shares) > 0.15


@pytest.mark.parametrize("seed", [0, 6, 10])
def test_close_ups_look_down_at_things_near_by(seed: int) -> None:
    scene = make_room(seed, FAST)
    near, far = CameraPathConfig(step_m=0.3, close_up=1.0), CameraPathConfig(step_m=0.3)
    poses = camera_path(scene, 16, 0, near)
    assert clearance(scene, poses[:, :3, 3]).min() > 0.15 - 4 * near.tremor_m
    middle = [
        np.median([render_view(scene, SMALL, p).exact_depth_m for p in ps])
        for ps in (poses, camera_path(scene, 16, 0, far))
    ]
    assert middle[0] < 0.75 * middle[1]
    assert poses[:, 2, 2].mean() < -0.2  # the camera's z axis points down


def test_cameras_stay_upright() -> None:
    poses = camera_path(make_room(2, FAST), 30, 0)
    assert (poses[:, 2, 1] < -0.5).all()  # the camera's y axis points down in the world


def test_frames_follow_each_other_closely() -> None:
    config = CameraPathConfig(step_m=0.05)
    poses = camera_path(make_room(4, FAST), 60, 0, config)
    steps = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    assert steps.max() < config.step_m + 8 * config.tremor_m


def test_pose_of_looks_along_its_yaw_and_pitch() -> None:
    T = pose_of(np.array([1.0, 2.0, 3.0]), yaw=np.pi / 2, pitch=np.pi / 6)
    np.testing.assert_allclose(T[:3, 2], [0.0, np.cos(np.pi / 6), np.sin(np.pi / 6)], atol=1e-12)
    np.testing.assert_allclose(T[:3, 0], [1.0, 0.0, 0.0], atol=1e-12)  # right of someone who looks along +y
    np.testing.assert_allclose(T[:3, 3], [1.0, 2.0, 3.0])


def test_one_frame_is_enough_and_none_is_refused() -> None:
    scene = make_room(0, FAST)
    assert camera_path(scene, 1, 0).shape == (1, 4, 4)
    with pytest.raises(ConfigError, match="count"):
        camera_path(scene, 0, 0)


def test_a_room_without_free_space_is_named() -> None:
    with pytest.raises(SemanticMapperError, match="room 0"):
        camera_path(make_room(0, FAST), 1, 0, CameraPathConfig(clearance_m=5.0))


def test_contradictory_settings_are_refused() -> None:
    with pytest.raises(ConfigError, match="min_height_m"):
        camera_path(make_room(0, FAST), 1, 0, CameraPathConfig(min_height_m=1.8, max_height_m=1.2))
