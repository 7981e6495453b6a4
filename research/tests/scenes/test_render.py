"""Pictures: hand-computed hits, agreement of both renderers, mirrors, consistency between views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from research.scenes import CameraPathConfig, RoomConfig, camera_path, make_room, render_view
from research.scenes.camera import pose_of
from research.scenes.fast_cast import cast_pixels
from research.scenes.primitives import Shape
from research.scenes.sensor_depth import depth_edges
from semantic_mapper.errors import PoseError
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


@pytest.mark.parametrize("seed", [0, 3])
def test_quick_answers_of_the_shadow_extremes_change_no_picture(seed: int) -> None:
    scene = make_room(seed)
    pose = camera_path(scene, 1, 0)[0]
    nothing = np.full_like(scene.lights.shadow, -np.inf)
    slow = replace(scene, lights=replace(scene.lights, shadow_low=nothing, shadow_high=-nothing))
    np.testing.assert_array_equal(render_view(scene, CAMERA, pose).rgb, render_view(slow, CAMERA, pose).rgb)


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


def test_a_broken_pose_is_refused() -> None:
    pose = np.eye(4)
    pose[0, 3] = np.nan
    with pytest.raises(PoseError):
        render_view(make_room(0), CAMERA, pose)
