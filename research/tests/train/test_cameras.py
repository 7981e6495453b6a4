import numpy as np
import pytest

from research.scenes import CameraPathConfig, NoiseConfig
from research.train.cameras import Camera, CameraDraw, draw_camera
from research.train.rooms import RoomPoolConfig, render_room
from semantic_mapper.config import convert_config
from semantic_mapper.errors import ConfigError

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


def test_the_others_cover_lenses_heights_tilts_and_sensors():
    config, cameras = CameraDraw(), drawn(400, usual=0.0)
    focal = np.array([c.intrinsics.fx / c.intrinsics.width for c in cameras])
    low = np.array([c.path.min_height_m for c in cameras])
    high = np.array([c.path.max_height_m for c in cameras])
    roll = np.array([c.path.roll_deg for c in cameras])
    assert config.focal_min <= focal.min() < 0.5 and 0.95 < focal.max() <= config.focal_max
    assert config.height_min_m <= low.min() < 0.5 and 1.7 < high.max() <= config.height_max_m
    assert 0.8 * config.roll_deg < roll.std() < 1.2 * config.roll_deg and abs(roll).max() <= 2 * config.roll_deg
    assert {c.noise.depth for c in cameras} == {"oak_d", "d435", "exact"}
    assert abs(np.mean([c.pose_noise is not None for c in cameras]) - config.odometry) < 0.08


def test_a_share_of_the_rooms_is_seen_from_near_by():
    cameras = drawn(400)
    near = [c.path.close_up > 0 for c in cameras]
    assert abs(np.mean(near) - CameraDraw().close_up) < 0.08
    focal = [c.intrinsics.fx for c in cameras]
    assert drawn(400, close_up=0.0)[0].intrinsics.fx == focal[0], "the lens does not depend on it"


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


def test_bounds_that_contradict_each_other_are_refused():
    with pytest.raises(ConfigError, match="focal_min"):
        drawn(1, focal_min=2.0)
    with pytest.raises(ConfigError, match="sensor"):
        drawn(1, sensors=[])
