import numpy as np
import pytest

from research.scenes import CameraPathConfig, NoiseConfig
from research.train.cameras import Camera, CameraDraw, draw_camera
from research.train.rooms import RoomPoolConfig, render_room
from semantic_mapper.config import convert_config

USUAL = CameraDraw().usual


def drawn(count: int, **changes: object) -> list[Camera]:
    config = convert_config(changes, CameraDraw, "test config")
    return [draw_camera(seed, 160, 0.1, config) for seed in range(count)]


def test_a_share_of_the_rooms_is_seen_as_the_benchmark_sees_them():
    cameras = drawn(400, close_up=0.0)
    usual = [c for c in cameras if c.path == CameraPathConfig(step_m=0.1)]
    assert abs(len(usual) / 400 - USUAL) < 0.08
    assert all(c.noise == NoiseConfig() and c.pose_noise is None for c in usual)
    assert {c.intrinsics.fx for c in usual} == {0.69 * 160}


def test_a_camera_follows_from_the_seed():
    assert drawn(20) == drawn(20)
    assert len({(c.intrinsics.fx, c.path.roll_deg) for c in drawn(20, usual=0.0)}) == 20


def test_rooms_are_seen_with_the_drawn_camera():
    low = {
        "usual": 0.0,
        "close_up": 0.0,
        "height_min_m": 0.5,
        "height_max_m": 0.9,
        "focal_min": 0.9,
        "focal_max": 0.9,
        "roll_deg": 20.0,
    }
    config = convert_config({"width": 48, "views": 3, "camera": low}, RoomPoolConfig, "test config")
    room = render_room(3, config)
    poses = np.stack([v.T_world_camera.numpy() for v in room.views])
    assert ((poses[:, 2, 3] > 0.45) & (poses[:, 2, 3] < 0.95)).all()
    assert room.views[0].intrinsics.fx == pytest.approx(0.9 * 48)
    expected = draw_camera(3, 48, 0.1, config.camera).path.roll_deg
    tilt = np.degrees(np.arcsin(poses[:, 2, 0]))  # of the image's x axis against the floor
    assert abs(abs(tilt) - abs(expected)).max() < 5
