"""Pictures: hand-computed hits, agreement of both renderers, consistency between views, noise."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from semantic_mapper.errors import PoseError
from semantic_mapper.labels import ROOMS
from semantic_mapper.scenes import CameraPathConfig, NoiseConfig, camera_path, make_room, render_view, room_frames
from semantic_mapper.scenes.camera import pose_of
from semantic_mapper.scenes.fast_cast import cast_pixels
from semantic_mapper.scenes.materials import Pattern
from semantic_mapper.scenes.noise import add_noise, depth_edges
from semantic_mapper.scenes.primitives import Shape
from semantic_mapper.scenes.reference import render_view_torch
from semantic_mapper.types import CameraIntrinsics

CAMERA = CameraIntrinsics(fx=66.0, fy=66.0, cx=47.5, cy=35.5, width=96, height=72)


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


@pytest.mark.parametrize("shape", list(Shape))
def test_a_primitive_ahead_is_hit_at_its_near_face(shape: Shape) -> None:
    assert middle_depth(shape, (0.5, 0.25, 0.25)) == pytest.approx(2.5, abs=1e-6)


@pytest.mark.parametrize("seed", [0, 3, 10])
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


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU on this machine")
def test_the_plain_renderer_gives_the_same_on_a_gpu() -> None:
    scene = make_room(1)
    pose = camera_path(scene, 1, 0)[0]
    cpu, gpu = render_view_torch(scene, CAMERA, pose), render_view_torch(scene, CAMERA, pose, device="cuda")
    assert (cpu.label != gpu.label).mean() < 0.005
    assert np.median(np.abs(cpu.depth_m - gpu.depth_m)) < 1e-4


def test_every_pattern_is_compared() -> None:
    seen: set[int] = set()
    for seed in (0, 3, 10):
        scene = make_room(seed)
        seen |= set(scene.materials.pattern[np.unique(scene.primitives.material)].tolist())
    assert seen == {int(p) for p in Pattern}


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
    assert visible.mean() > 0.6
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


def test_noise_is_repeatable_and_grows_with_range() -> None:
    depth = np.repeat(np.array([[1.0, 4.0]], np.float32), 4000, axis=0)
    config = NoiseConfig(edge_hole_rate=0.0)
    linear = np.full((4000, 2, 3), 0.2, np.float32)
    _, first, _ = add_noise(linear, depth, 1, config)
    _, again, _ = add_noise(linear, depth, 1, config)
    np.testing.assert_array_equal(first, again)
    spread = (first - depth).std(0)
    np.testing.assert_allclose(spread, config.depth_sigma * np.array([1.0, 16.0]), rtol=0.1)


def test_noise_makes_holes_at_depth_edges_only() -> None:
    scene = make_room(2)
    pose = camera_path(scene, 1, 0)[0]
    clean, noisy = render_view(scene, CAMERA, pose), render_view(scene, CAMERA, pose, noise=3)
    holes = noisy.depth_m == 0
    assert holes.any()
    assert not (holes & ~depth_edges(clean.depth_m, NoiseConfig().edge_ratio)).any()
    np.testing.assert_array_equal(clean.label, noisy.label)
    assert (clean.rgb != noisy.rgb).any()


def test_a_broken_pose_is_refused() -> None:
    pose = np.eye(4)
    pose[0, 3] = np.nan
    with pytest.raises(PoseError):
        render_view(make_room(0), CAMERA, pose)


def test_room_frames_are_a_stream_of_posed_frames() -> None:
    frames = list(room_frames(11, 5, CAMERA, noise=NoiseConfig()))
    assert [f.seq for f in frames] == [0, 1, 2, 3, 4]
    assert (np.diff([f.stamp_ns for f in frames]) > 0).all()
    for frame in frames:
        assert frame.depth_m is not None
        assert frame.label is not None
        assert set(np.unique(frame.label)) <= {*ROOMS.ids, ROOMS.ignore_id}
    again = list(room_frames(11, 5, CAMERA, noise=NoiseConfig()))
    np.testing.assert_array_equal(frames[3].rgb, again[3].rgb)
