"""Pictures: hand-computed hits, agreement of both renderers, mirrors, consistency between views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from research.scenes import CameraPathConfig, NoiseConfig, RoomConfig, Scene, camera_path, make_room, render_view
from research.scenes.camera import pose_of
from research.scenes.fast_cast import cast_pixels
from research.scenes.materials import MaterialTable, Pattern
from research.scenes.primitives import Primitives, Shape
from research.scenes.render import Sensor
from research.scenes.scene import Lights, extremes, shadow_cubes
from research.scenes.sensor_depth import depth_edges
from research.tests.scenes.torch_renderer import render_view_torch, render_views_torch
from semantic_mapper.errors import ConfigError, PoseError
from semantic_mapper.labels import ROOMS
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(fx=66.0, fy=66.0, cx=47.5, cy=35.5, width=96, height=72)
SMALL = CameraIntrinsics(fx=22.0, fy=22.0, cx=15.5, cy=11.5, width=32, height=24)
FAST = RoomConfig(shadow_resolution=8)


def middle_depth(shape: Shape, half: tuple[float, float, float]) -> float:
    """Depth at the image centre of one primitive 3 m ahead of a camera that looks along +x."""
    T = pose_of(np.zeros(3), 0.0, 0.0)
    depth, index = cast_pixels(
        np.array([int(shape)]), np.array([[3.0, 0.0, 0.0]]), np.array([half]), np.eye(3)[None],
        T[:3, 3].copy(), T[:3, :3].copy(), 50.0, 50.0, 10.0, 10.0, 21, 21,
    )  # fmt: skip
    assert index[10, 10] == 0
    assert index[0, 0] == -1
    assert np.isinf(depth[0, 0])
    return float(depth[10, 10])


@pytest.mark.parametrize("shape", [Shape.BOX, Shape.CYLINDER, Shape.ELLIPSOID])
def test_a_primitive_ahead_is_hit_at_its_near_face(shape: Shape) -> None:
    assert middle_depth(shape, (0.5, 0.25, 0.25)) == pytest.approx(2.5, abs=1e-6)


def test_a_frustum_is_narrower_at_its_top_than_at_its_foot() -> None:
    # Half way up its radius is 0.8 of the half extent.
    assert middle_depth(Shape.FRUSTUM, (0.5, 0.25, 0.25)) == pytest.approx(3 - 0.8 * 0.5, abs=1e-6)


COMPARED = (1, 2, 10, 14)


@pytest.mark.slow
@pytest.mark.parametrize("seed", COMPARED)
def test_fast_and_plain_renderer_agree(seed: int) -> None:
    scene = make_room(seed)
    for pose in camera_path(scene, 2, 4, CameraPathConfig(step_m=0.6)):
        fast, plain = render_view(scene, CAMERA, pose), render_view_torch(scene, CAMERA, pose)
        # Ties at edges may fall either way: a handful of pixels out of 6912.
        same = fast.instance == plain.instance
        assert (~same).sum() <= 5
        np.testing.assert_array_equal(fast.label[same], plain.label[same])
        np.testing.assert_allclose(fast.depth_m[same], plain.depth_m[same], atol=1e-5)
        difference = np.abs(fast.rgb.astype(int) - plain.rgb.astype(int)).max(-1)
        assert (difference > 2).sum() <= 20


def test_a_batch_of_views_gives_what_single_views_give() -> None:
    scene = make_room(4, FAST)
    poses = camera_path(scene, 3, 0, CameraPathConfig(step_m=0.5))
    sensors = [None, Sensor(5, NoiseConfig()), Sensor(6, NoiseConfig(depth="d435"))]
    for pose, sensor, batched in zip(poses, sensors, render_views_torch(scene, SMALL, poses, sensors), strict=True):
        noise = {} if sensor is None else {"noise": sensor.seed, "noise_config": sensor.config}
        alone = render_view_torch(scene, SMALL, pose, **noise)  # type: ignore[arg-type]
        for name in ("rgb", "depth_m", "label", "instance", "exact_depth_m"):
            np.testing.assert_array_equal(getattr(batched, name), getattr(alone, name))


def test_a_batch_needs_one_sensor_a_pose() -> None:
    scene = make_room(4, FAST)
    with pytest.raises(ConfigError, match="2 poses but 1 sensors"):
        render_views_torch(scene, CAMERA, camera_path(scene, 2, 0), [None])


def mirror_room() -> Scene:
    """A mirror at x = 2 that fills the view of a camera at the origin, and a red box behind the camera."""
    wall, prop = (ROOMS.ids[ROOMS.names.index(name)] for name in ("otherfurniture", "otherprop"))
    one = np.ones(2)
    primitives = Primitives(
        shape=np.zeros(2, np.int64),
        center=np.array([[2.05, 0.0, 0.0], [-2.0, 0.0, 0.0]]),
        half=np.array([[0.05, 3.0, 3.0], [0.5, 0.4, 0.4]]),
        rotation=np.stack((np.eye(3), np.eye(3))),
        label=np.array([wall, prop], np.uint8),
        instance=np.array([1, 2], np.uint16),
        group=np.array([6, 7]),
        material=np.arange(2),
        casts_shadow=np.ones(2, np.bool_),
    )
    colors = np.array([[0.0, 0.0, 0.3], [0.8, 0.0, 0.0]])
    materials = MaterialTable(
        np.full(2, int(Pattern.PLAIN)), colors, colors, one, np.arange(2), 0 * one, 0 * one, np.array([0.9, 0.0])
    )
    position = np.array([[0.0, 0.0, 1.0]])
    cubes = shadow_cubes(primitives, position, 16)
    lights = Lights(position, np.ones((1, 3)), cubes, *extremes(cubes), np.array([0.5]), np.full(3, 0.5))
    return Scene(0, "test", (4.0, 4.0, 3.0), primitives, materials, lights)


@pytest.mark.parametrize("render", [render_view, render_view_torch])
def test_a_mirror_shows_what_stands_behind_the_camera_but_keeps_its_own_depth_and_label(render) -> None:
    view = render(mirror_room(), CAMERA, pose_of(np.zeros(3), 0.0, 0.0))
    red, blue = view.rgb[36, 48, 0], view.rgb[36, 48, 2]
    assert red > 2 * blue
    assert view.rgb[36, 2, 2] > view.rgb[36, 2, 0]  # beside the image of the box the mirror has its own colour
    assert view.instance[36, 48] == 1
    assert view.depth_m[36, 48] == pytest.approx(2.0)


@pytest.mark.parametrize("seed", [0, 3])
def test_quick_answers_of_the_shadow_extremes_change_no_picture(seed: int) -> None:
    scene = make_room(seed)
    pose = camera_path(scene, 1, 0)[0]
    nothing = np.full_like(scene.lights.shadow, -np.inf)
    slow = replace(scene, lights=replace(scene.lights, shadow_low=nothing, shadow_high=-nothing))
    np.testing.assert_array_equal(render_view(scene, CAMERA, pose).rgb, render_view(slow, CAMERA, pose).rgb)


def test_soft_shadows_have_wider_edges_than_hard_ones() -> None:
    scene = make_room(3)
    pose = camera_path(scene, 1, 0)[0]
    between = []
    for softness in (0.0, 1.0):
        lights = replace(scene.lights, softness=np.full_like(scene.lights.softness, softness))
        between.append(render_view(replace(scene, lights=lights), CAMERA, pose).rgb.astype(int))
    assert (np.abs(between[0] - between[1]).max(-1) > 2).mean() > 0.005


def test_single_precision_as_on_a_gpu_gives_nearly_the_same_picture() -> None:
    scene = make_room(2)
    pose = camera_path(scene, 1, 0)[0]
    fast, single = render_view(scene, SMALL, pose), render_view_torch(scene, SMALL, pose, dtype=torch.float32)
    assert (fast.label != single.label).mean() < 0.005
    assert np.median(np.abs(fast.depth_m - single.depth_m)) < 1e-4
    assert (np.abs(fast.rgb.astype(int) - single.rgb.astype(int)).max(-1) > 6).mean() < 0.02


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")
def test_the_plain_renderer_gives_the_same_on_a_gpu() -> None:
    scene = make_room(1)
    pose = camera_path(scene, 1, 0)[0]
    cpu, gpu = render_view_torch(scene, CAMERA, pose), render_view_torch(scene, CAMERA, pose, device="cuda")
    assert (cpu.label != gpu.label).mean() < 0.005
    assert np.median(np.abs(cpu.depth_m - gpu.depth_m)) < 1e-4


def test_every_pattern_is_compared() -> None:
    seen: set[int] = set()
    for seed in COMPARED:
        scene = make_room(seed)
        seen |= set(scene.materials.pattern[np.unique(scene.primitives.material)].tolist())
    assert seen == {int(p) for p in Pattern} - {int(Pattern.FLAT), int(Pattern.WINDOWS)}


@pytest.mark.parametrize("seed", range(4))
def test_two_views_agree_on_depth_and_labels(seed: int) -> None:
    """Points of one view, carried to the other by the poses, meet the same depth and class unless hidden."""
    scene = make_room(seed)
    a, b = camera_path(scene, 2, 0, CameraPathConfig(step_m=0.25))
    first, second = render_view(scene, CAMERA, a), render_view(scene, CAMERA, b)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    z = first.depth_m.astype(np.float64)
    local = np.stack(((u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z, np.ones_like(z)), -1)
    there = local @ (np.linalg.inv(b) @ a).T
    safe = np.where(there[..., 2] > 0.1, there[..., 2], np.inf)
    col = np.round(there[..., 0] / safe * CAMERA.fx + CAMERA.cx).astype(int)
    row = np.round(there[..., 1] / safe * CAMERA.fy + CAMERA.cy).astype(int)
    seen = np.isfinite(safe) & (col >= 0) & (col < CAMERA.width) & (row >= 0) & (row < CAMERA.height)
    edges = depth_edges(second.depth_m, 0.03)
    z_there, z_second = there[..., 2][seen], second.depth_m[row[seen], col[seen]]
    visible = (np.abs(z_there - z_second) < 0.05) & ~edges[row[seen], col[seen]]
    assert seen.mean() > 0.3
    assert visible.mean() > 0.5  # full rooms have many edges, which do not count
    # No point of the first view may float in front of what the second one sees.
    flat = ~edges[row[seen], col[seen]]
    assert (z_there[flat] < z_second[flat] - 0.15).mean() < 0.02
    agree = first.label[seen][visible] == second.label[row[seen], col[seen]][visible]
    assert agree.mean() > 0.93  # rounding to the nearest pixel moves borders


def test_labels_follow_instances() -> None:
    scene = make_room(6)
    view = render_view(scene, CAMERA, camera_path(scene, 1, 0)[0])
    owner = dict(zip(scene.primitives.instance.tolist(), scene.primitives.label.tolist(), strict=True))
    np.testing.assert_array_equal(np.vectorize(owner.__getitem__)(view.instance), view.label)


def test_pictures_are_neither_black_nor_burnt_out() -> None:
    means = []
    for seed in range(10):
        scene = make_room(seed)
        means.append(render_view(scene, CAMERA, camera_path(scene, 1, 0)[0]).rgb.mean())
    assert min(means) > 35
    assert max(means) < 225


def test_a_broken_pose_is_refused() -> None:
    pose = np.eye(4)
    pose[0, 3] = np.nan
    with pytest.raises(PoseError):
        render_view(make_room(0), CAMERA, pose)
