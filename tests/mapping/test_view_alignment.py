"""A pose is put right by what views saw."""

from __future__ import annotations

import numpy as np

from semantic_mapper.geometry import invert_pose
from semantic_mapper.mapping.view_alignment import SlopedViews, align_pose, depth_slopes
from semantic_mapper.types import Float32, Float64
from tests.mapping.test_moving import CAMERA, corner, off_by

MARGIN = (0.1, 0.03)


def views(depth: Float32) -> SlopedViews:
    focal, centre = ((CAMERA.fx, CAMERA.fy), (CAMERA.cx, CAMERA.cy))
    at = np.eye(4)[None]
    return SlopedViews(at, np.array([focal], np.float32), np.array([centre], np.float32), depth_slopes(depth)[None])


def points(depth: Float32) -> Float32:
    v, u = (3 * i for i in np.nonzero(depth[::3, ::3]))
    rays = np.stack(((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(len(u))), axis=1)
    return (depth[v, u][:, None] * rays).astype(np.float32)


def depth_at(T_world_camera: Float64) -> Float32:
    depth = corner(0, T_world_camera).depth_m
    assert depth is not None
    return depth


def test_a_pose_that_is_a_little_off_is_put_right() -> None:
    rng = np.random.default_rng(0)
    seen = views(depth_at(np.eye(4)))
    for _ in range(5):
        right, wrong = off_by(0.02, 0.5, rng), np.eye(4)
        aligned = align_pose(points(depth_at(right)), wrong, seen, MARGIN)
        left = invert_pose(right) @ aligned.T_world_camera
        assert np.linalg.norm(left[:3, 3]) < 0.01 and np.linalg.norm(left[:3, :3] - np.eye(3)) < 0.005
        assert aligned.misfit < 0.1
        np.testing.assert_allclose(aligned.moved[:3], right[:3, 3], atol=0.01)


def test_a_pose_that_is_far_off_stays_and_does_not_fit() -> None:
    far = np.eye(4)
    far[2, 3] = -1.0
    aligned = align_pose(points(depth_at(np.eye(4))), far, views(depth_at(np.eye(4))), MARGIN)
    assert aligned.misfit == np.inf and np.array_equal(aligned.T_world_camera, far) and not aligned.moved.any()


def test_without_a_surface_to_compare_with_a_pose_is_trusted() -> None:
    nothing = np.zeros((120, 160), np.float32)
    aligned = align_pose(points(depth_at(np.eye(4))), np.eye(4), views(nothing), MARGIN)
    assert aligned.misfit == 0 and np.array_equal(aligned.T_world_camera, np.eye(4))


def test_edges_and_holes_are_no_surface() -> None:
    depth = np.full((8, 8), 2.0, np.float32)
    depth[:, 4:], depth[2, 1] = 3.0, 0.0
    known = np.isfinite(depth_slopes(depth)[0])
    assert known[5, 2] and not known[:, 3:5].any() and not known[1:4, 1].any() and not known[2, :3].any()
    assert not known[[0, -1]].any() and not known[:, [0, -1]].any()
