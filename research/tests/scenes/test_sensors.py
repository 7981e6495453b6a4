"""Sensors: depth cameras by name, the colour camera, drift along a sequence, odometry."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from research.scenes import (
    CameraPathConfig,
    NoiseConfig,
    PoseNoiseConfig,
    RoomConfig,
    camera_path,
    make_room,
    render_view,
)
from research.scenes.pose_noise import drifting_poses
from research.scenes.primitives import rotation_x, rotation_z
from research.scenes.sensor_color import blur_motion, expose
from research.scenes.sensor_depth import STEREO_SENSORS, depth_edges, hidden_from_other_eye, measure_depth
from research.scenes.shots import Shot
from semantic_mapper.errors import ShapeError
from semantic_mapper.geometry import check_pose, invert_pose
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

CAMERA = CameraIntrinsics(fx=220.6, fy=220.6, cx=159.5, cy=119.5, width=320, height=240)
SIZE = (240, 320)
FAST = RoomConfig(shadow_resolution=16)


def textured() -> UInt8:
    return np.random.default_rng(0).integers(0, 255, (*SIZE, 3)).astype(np.uint8)


def flat(z: float) -> Float32:
    return np.full(SIZE, z, np.float32)


def errors_at(sensor: str, z: float) -> np.ndarray:
    measured = measure_depth(flat(z), textured(), CAMERA, sensor, np.random.default_rng(1))  # type: ignore[arg-type]
    return measured[measured > 0] - z


@pytest.mark.parametrize("sensor", sorted(STEREO_SENSORS))
def test_stereo_noise_grows_with_the_square_of_range(sensor: str) -> None:
    model = STEREO_SENSORS[sensor]
    for z in (1.5, 3.0, 6.0):
        errors = errors_at(sensor, z)
        step = model.step_px / np.sqrt(12)  # what quantisation adds
        sigma_z = z * z / (882.4 * model.baseline_m) * float(np.hypot(model.sigma_px, step))
        assert errors.std() == pytest.approx(sigma_z, rel=0.25)
        assert abs(errors.mean()) < 0.5 * sigma_z


@pytest.mark.parametrize("sensor", sorted(STEREO_SENSORS))
def test_disparities_are_multiples_of_the_sensors_step(sensor: str) -> None:
    model = STEREO_SENSORS[sensor]
    measured = measure_depth(flat(2.0), textured(), CAMERA, sensor, np.random.default_rng(1))  # type: ignore[arg-type]
    steps = 882.4 * model.baseline_m / measured[measured > 0] / model.step_px
    np.testing.assert_allclose(steps, np.round(steps), atol=2e-2)


def test_the_passive_sensor_fails_on_blank_surfaces_and_the_active_one_does_not() -> None:
    blank = np.full((*SIZE, 3), 128, np.uint8)
    rng = np.random.default_rng
    assert (measure_depth(flat(2.0), blank, CAMERA, "oak_d", rng(0)) == 0).mean() > 0.9
    assert (measure_depth(flat(2.0), blank, CAMERA, "d435", rng(0)) == 0).mean() < 0.01


def test_structured_light_is_lost_on_dark_floors_that_are_seen_at_a_flat_angle() -> None:
    dark = np.full((*SIZE, 3), 30, np.uint8)
    down = (np.arange(SIZE[0]) - SIZE[0] / 2)[:, None] / CAMERA.fy
    floor = np.broadcast_to(np.where(down > 0.05, 0.4 / np.maximum(down, 0.05), 0.0), SIZE).astype(np.float32)
    far, facing = (floor > 1.5) & (floor < 2.5), flat(2.0)
    measured = [measure_depth(z, dark, CAMERA, "kinect", np.random.default_rng(0)) for z in (floor, facing)]
    assert (measured[0][far] == 0).mean() > 0.5 and (measured[1] == 0).mean() < 0.2


def test_a_band_beside_a_near_thing_is_hidden_from_the_other_eye() -> None:
    disparity = np.full((1, 40), 2.0, np.float32)
    disparity[0, 20:30] = 8.0
    hidden = hidden_from_other_eye(disparity)
    # The background at columns 14 to 19 lands behind the near thing in the right image: 8 - 2 = 6 pixels.
    np.testing.assert_array_equal(np.flatnonzero(hidden[0]), np.arange(14, 20))


@pytest.mark.parametrize(
    ("sensor", "least", "most"), [("oak_d", 0.08, 0.5), ("d435", 0.01, 0.2), ("kinect", 0.03, 0.4)]
)
def test_depth_of_rooms_has_a_realistic_share_of_holes_and_stays_near_the_truth(
    sensor: str, least: float, most: float
) -> None:
    holes, far_off = [], []
    for seed in range(5):
        scene = make_room(seed, FAST)
        for k, pose in enumerate(camera_path(scene, 2, 0, CameraPathConfig(step_m=0.5))):
            config = NoiseConfig(depth=sensor)  # type: ignore[arg-type]
            view = render_view(scene, CAMERA, pose, noise=k, noise_config=config)
            seen = (view.depth_m > 0) & ~depth_edges(view.exact_depth_m, 0.03)
            holes.append((view.depth_m == 0).mean())
            error = np.abs(view.depth_m - view.exact_depth_m)[seen]
            far_off.append((error > 0.03 + 0.02 * view.exact_depth_m[seen] ** 2).mean())
    assert least < np.mean(holes) < most
    assert np.mean(far_off) < 0.02


def shot(**changes: object) -> Shot:
    neutral = Shot(np.ones(3), 1.0, 1.0, 1.0, 0.0, 0.0, np.eye(4))
    return replace(neutral, **changes)  # type: ignore[arg-type]


QUIET = NoiseConfig(auto_exposure=0.0, shot_noise=0.0, read_noise=0.0)


def taken(linear: Float32, how: Shot, config: NoiseConfig = QUIET, z: float = 2.0) -> UInt8:
    return expose(linear, flat(z), CAMERA, how, config, np.random.default_rng(0))


def plain_blur(linear: Float32, depth_m: Float32, T_close_open: Float64) -> Float32:
    """``blur_motion`` in numpy, for 7 samples."""
    height, width = depth_m.shape
    v, u = np.indices(depth_m.shape)
    z = depth_m.astype(np.float64)
    point = np.stack(((u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z), -1)
    then = point @ T_close_open[:3, :3].T + T_close_open[:3, 3]
    safe = np.where((z > 0) & (then[..., 2] > 0.02), then[..., 2], np.nan)
    du, dv = (then[..., 0] / safe * CAMERA.fx + CAMERA.cx - u, then[..., 1] / safe * CAMERA.fy + CAMERA.cy - v)
    moved = du**2 + dv**2 >= 0.25
    du, dv = np.where(moved, du, 0), np.where(moved, dv, 0)
    total = np.zeros(linear.shape)
    for moment in np.arange(7) / 6 - 0.5:
        column = np.clip(np.floor(u + moment * du + 0.5), 0, width - 1).astype(int)
        row = np.clip(np.floor(v + moment * dv + 0.5), 0, height - 1).astype(int)
        total += linear[row, column]
    return np.where(moved[..., None], total / 7, linear).astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_motion_blur_is_as_in_numpy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    linear = rng.random((*SIZE, 3), np.float32)
    depth_m = rng.uniform(-0.2, 5.0, SIZE).astype(np.float32)  # without a measurement, and behind the camera later on
    T = np.eye(4)
    T[:3, :3] = rotation_z(float(rng.normal(0, 0.02))) @ rotation_x(float(rng.normal(0, 0.02)))
    T[:3, 3] = rng.normal(0, 0.05, 3)
    blurred = blur_motion(linear, depth_m, CAMERA, shot(T_open_close=T))
    expected = plain_blur(linear, depth_m, invert_pose(T))
    off = np.abs(blurred - expected).max(-1) > 1e-6
    assert off.mean() < 1e-4  # samples on the edge between two pixels may fall either way
    assert (blurred != linear).any(-1).mean() > 0.5


def test_motion_blur_refuses_a_depth_image_of_another_size() -> None:
    T = np.eye(4)
    T[0, 3] = 0.05
    with pytest.raises(ShapeError, match="depth_m"):
        blur_motion(np.zeros((*SIZE, 3), np.float32), flat(2.0)[1:], CAMERA, shot(T_open_close=T))


def plain_expose(linear: Float32, how: Shot, noise: Float32) -> np.ndarray:
    """Grey levels (H, W, 3), before rounding, of a camera with a neutral tone curve."""
    y, x = np.meshgrid(np.linspace(-1, 1, SIZE[0]), np.linspace(-1, 1, SIZE[1]), indexing="ij")
    light = linear * how.gain
    grey = (light @ [0.299, 0.587, 0.114])[..., None]
    light = np.maximum(
        (grey + how.saturation * (light - grey)) * (1 - how.vignetting / 2 * (x**2 + y**2))[..., None], 0
    )
    light = light + noise * np.sqrt(0.002 * light + 0.01**2)
    light = np.clip(light, 0, 4)
    return np.minimum(light * (1 + light / 9) / (1 + light), 1) ** (1 / 2.2) * 255


def test_exposure_is_as_in_numpy() -> None:
    rng = np.random.default_rng(0)
    linear = rng.gamma(0.5, 1.0, (*SIZE, 3)).astype(np.float32)
    config = NoiseConfig(auto_exposure=0.0, shot_noise=0.002, read_noise=0.01)
    how = shot(gain=np.array([0.8, 1.0, 1.3]), saturation=0.7, vignetting=0.3)
    expected = plain_expose(linear, how, np.random.default_rng(0).standard_normal(linear.shape, np.float32))
    # The tone curve is a table of 4096 entries: near black one is up to 3 grey levels wide.
    assert np.quantile(np.abs(taken(linear, how, config) - expected), 0.99) < 1.0


def test_light_that_is_no_number_is_black() -> None:
    linear = np.full((*SIZE, 3), 0.3, np.float32)
    linear[0, 0, 1] = np.nan
    picture = taken(linear, shot())
    assert (picture[0, 0] == 0).all() and (picture[0, 1:] > 0).all()


def test_odometry_drifts_a_little_and_a_loop_closure_takes_part_of_it_back() -> None:
    poses = camera_path(make_room(3, FAST), 120, 0)
    config = PoseNoiseConfig(translation_share=0.03, closure_frames=60)
    drifted = drifting_poses(poses, 9, config)
    for pose in drifted:
        check_pose(pose, "test")
    error = np.linalg.norm(drifted[:, :3, 3] - poses[:, :3, 3], axis=1)
    np.testing.assert_array_equal(drifted[0], poses[0])
    assert 0.005 < error.max() < 0.5
    jumps = np.abs(np.diff(error))
    assert jumps.max() > 4 * np.median(jumps)
    np.testing.assert_array_equal(drifting_poses(poses, 9, config), drifted)
