from __future__ import annotations

import numpy as np

from semantic_mapper.geometry import make_pose, unproject
from semantic_mapper.localization.depth_alignment import (
    Level,
    Target,
    align,
    compare,
    fit,
    flat_directions,
    make_levels,
    thin_depth,
    thin_intrinsics,
)
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame
from tests.drawn_room import walk_frames

LENS = CameraIntrinsics(20.0, 22.0, 11.5, 8.5, 24, 18)
INTRINSICS = CameraIntrinsics(132.0, 132.0, 79.5, 59.5, 160, 120)


def random_level(seed: int) -> Level:
    rng = np.random.default_rng(seed)
    v, u = np.mgrid[: LENS.height, : LENS.width]
    z = rng.uniform(0.7, 2.5, u.shape)
    points = np.stack(((u - LENS.cx) / LENS.fx * z, (v - LENS.cy) / LENS.fy * z, z), axis=-1).astype(np.float32)
    points[rng.random(u.shape) < 0.1] = np.nan
    normals = rng.normal(size=(*u.shape, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals[rng.random(u.shape) < 0.1] = np.nan
    return Level(points, normals.astype(np.float32), LENS)


def twin(level: Level, target: Level, T: Float64, outlier_m: float, noise_m: float) -> tuple[Float64, Float64, Float64]:
    """What the kernel adds up, point by point: normal matrix, gradient and
    (known, seen, flat, near, squares, cost, weight, weighted squares)."""
    H, g, sums = np.zeros((6, 6)), np.zeros(6), np.zeros(8)
    for p in level.points.reshape(-1, 3).astype(np.float64):
        if not p[2] > 0:
            continue
        sums[0] += 1
        q = T[:3, :3] @ p + T[:3, 3]
        u = int(np.floor(LENS.fx * q[0] / q[2] + LENS.cx + 0.5)) if q[2] > 1e-6 else -1
        v = int(np.floor(LENS.fy * q[1] / q[2] + LENS.cy + 0.5)) if q[2] > 1e-6 else -1
        if not (0 <= u < LENS.width and 0 <= v < LENS.height and target.points[v, u, 2] > 0):
            continue
        sums[1] += 1
        n = target.normals[v, u].astype(np.float64)
        if not np.isfinite(n[0]):
            continue
        d = (q - target.points[v, u]) @ n
        sums[2] += 1
        sums[5] += min(abs(d), outlier_m)
        if abs(d) >= outlier_m:
            continue
        ratio = 1 / max(p[2] ** 2, 1.0)
        robust = ratio**2 / (1 + (d * ratio / noise_m) ** 2) ** 2
        sums[[3, 4, 6, 7]] += (1, d * d, ratio**2, ratio**2 * d * d)
        m = T[:3, :3].T @ n
        J = np.concatenate((np.cross(p, m), m))
        H += robust * np.outer(J, J)
        g += robust * J * d
    return H, g, sums


def test_sums_over_points_are_those_of_a_plain_loop() -> None:
    level, target = random_level(1), random_level(2)
    for T in (np.eye(4), make_pose((0.1, -0.2, 0.05), (0.1, -0.05, 0.3))):
        found = compare(level, target, T, 0.5, 0.05)
        H, g, (known, seen, flat, near, squares, cost, weight, weighted) = twin(level, target, T, 0.5, 0.05)
        assert near > 50 and found.near == near
        assert np.allclose(found.normal_matrix, H, rtol=1e-9) and np.allclose(found.gradient, g, rtol=1e-9)
        expected = (seen / known, near / flat, np.sqrt(squares / near), cost / flat, np.sqrt(weighted / weight))
        measured = (found.overlap, found.fitness, found.rmse_m, found.cost_m, found.noise_m)
        assert np.allclose(measured, expected, rtol=1e-9)


def levels_of(frame: PosedFrame) -> tuple[Level, ...]:
    assert frame.depth_m is not None
    return make_levels(thin_depth(frame.depth_m, 1, 6.0), INTRINSICS)


def test_alignment_finds_the_way_between_two_views() -> None:
    a, _, b = walk_frames(7, 3, INTRINSICS)
    target = Target(levels_of(a), a.T_world_camera)
    guess = b.T_world_camera @ make_pose((0.01, -0.015, 0.01), (0.02, -0.01, 0.02))
    found = align(levels_of(b), [target], guess)
    assert found is not None
    assert np.linalg.norm(found[:3, 3] - b.T_world_camera[:3, 3]) < 0.005
    assert np.allclose(found[:3, :3] @ found[:3, :3].T, np.eye(3), atol=1e-12)
    before, after = (fit(levels_of(b), target, T) for T in (guess, found))
    assert after.rmse_m < 0.5 * before.rmse_m and after.fitness > 0.9 and after.overlap > 0.6


def test_a_wall_leaves_two_shifts_and_a_turn_open_and_a_corner_none() -> None:
    wall = make_levels(np.full((120, 160), 2.0, np.float32), INTRINSICS)
    flat = flat_directions([fit(wall, Target(wall, np.eye(4)), np.eye(4)).normal_matrix])
    assert flat is not None
    assert np.allclose(flat[0], np.diag((0, 0, 1)), atol=1e-3) and np.allclose(flat[1], np.diag((1, 1, 0)), atol=1e-3)
    room = levels_of(walk_frames(7, 1, INTRINSICS)[0])
    assert flat_directions([fit(room, Target(room, np.eye(4)), np.eye(4)).normal_matrix]) is None


def test_points_and_rays_of_thinned_images_are_those_of_the_whole() -> None:
    (frame,) = walk_frames(7, 1, INTRINSICS)
    assert frame.depth_m is not None
    whole = unproject(frame.depth_m, INTRINSICS)
    for stride in (2, 3):
        small = thin_intrinsics(INTRINSICS, stride, stride // 2)
        depth = thin_depth(frame.depth_m, stride, 100.0)
        assert depth.shape == (small.height, small.width)
        assert np.allclose(unproject(depth, small), whole[stride // 2 :: stride, stride // 2 :: stride], atol=1e-5)
