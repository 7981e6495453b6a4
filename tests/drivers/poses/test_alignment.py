from __future__ import annotations

import numpy as np

from semantic_mapper.drivers.poses.alignment import Target, fit, flat_directions
from semantic_mapper.drivers.poses.alignment import _add_up as add_up  # pyright: ignore[reportPrivateUsage]
from semantic_mapper.drivers.poses.config import OdometryPoses
from semantic_mapper.drivers.poses.depth_view import Level
from semantic_mapper.types import CameraIntrinsics, Float64

from .images import rigid

LENS = CameraIntrinsics(20.0, 22.0, 11.5, 8.5, 24, 18)


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
    """What the kernel adds up, point by point."""
    H, g, sums = np.zeros((6, 6)), np.zeros(6), np.zeros(9)
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
        weight = ratio**2
        robust = weight / (1 + (d * ratio / noise_m) ** 2) ** 2
        sums[[3, 4, 6, 7, 8]] += (1, d * d, weight, weight * d * d, robust)
        m = T[:3, :3].T @ n
        J = np.concatenate((np.cross(p, m), m))
        H += robust * np.outer(J, J)
        g += robust * J * d
    return H, g, sums


def test_sums_over_points_are_those_of_a_plain_loop() -> None:
    level, target = random_level(1), random_level(2)
    for T in (np.eye(4), rigid((0.1, -0.2, 0.05), (0.1, -0.05, 0.3))):
        found = add_up(level, target, T, 0.5, 0.05)
        H, g, sums = twin(level, target, T, 0.5, 0.05)
        assert sums[3] > 50
        assert np.allclose(found.normal_matrix, H, rtol=1e-9) and np.allclose(found.gradient, g, rtol=1e-9)
        told = (found.known, found.seen, found.flat, found.near, found.squares, found.cost, found.weight)
        assert np.allclose((*told, found.weighted_squares, found.robust_weight), sums, rtol=1e-9)


def test_a_wall_leaves_two_shifts_and_a_turn_open_and_a_corner_none() -> None:
    v, u = np.mgrid[: LENS.height, : LENS.width]
    rays = np.stack(((u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy, np.ones(u.shape)), axis=-1)
    wall = np.zeros((6, 6))
    corner = np.zeros((6, 6))
    for p in (2 * rays).reshape(-1, 3):
        J = np.concatenate((np.cross(p, (0, 0, -1.0)), (0, 0, -1.0)))
        wall += np.outer(J, J)
        for n in np.array(((0.7, 0, -0.7), (-0.7, 0, -0.7), (0, -0.8, -0.6))):
            J = np.concatenate((np.cross(p, n), n))
            corner += np.outer(J, J)
    flat = flat_directions([wall])
    assert flat is not None
    assert np.allclose(flat[0], np.diag((0, 0, 1))) and np.allclose(flat[1], np.diag((1, 1, 0)))
    assert flat_directions([corner]) is None


def test_a_view_without_points_fits_nothing() -> None:
    level, nothing = random_level(1), random_level(2)
    nothing.points[:] = np.nan
    found = fit(OdometryPoses(), [level], Target((nothing,), np.eye(4)), np.eye(4))
    assert found.overlap == 0 and found.fitness == 0 and found.cost_m == OdometryPoses().outlier_m
