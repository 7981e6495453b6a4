"""How far a path is from the true one: absolute trajectory error after alignment (Umeyama), and relative pose error."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from semantic_mapper.errors import ShapeError
from semantic_mapper.geometry import expect_shape, invert_pose
from semantic_mapper.types import Float64


class TrajectoryError(NamedTuple):
    """Distances of positions in metres, and of rotations in degrees (0 for the absolute error)."""

    rmse_m: float
    median_m: float
    max_m: float
    rmse_deg: float = 0.0


def align_rigid(a: Float64, b: Float64) -> Float64:
    """The rigid motion T_b_a (4, 4) that takes points a (N, 3) nearest to points b (N, 3) in least squares.

    Umeyama's closed form with the scale held at 1. Where the points lie on a line, one of the equally good rotations.
    Raises ShapeError: other shapes, or fewer than 3 points.
    """
    sizes = expect_shape(a, "N 3", "points to align")
    if expect_shape(b, "N 3", "points to align to") != sizes or sizes["N"] < 3:
        raise ShapeError(f"alignment needs as many points on both sides, 3 or more; got {len(a)} and {len(b)}")
    center_a, center_b = a.mean(axis=0), b.mean(axis=0)
    u, _, vt = np.linalg.svd((b - center_b).T @ (a - center_a))
    keep = np.diag((1.0, 1.0, float(np.sign(np.linalg.det(u) * np.linalg.det(vt)))))  # a rotation, no mirror
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = u @ keep @ vt
    T_b_a[:3, 3] = center_b - T_b_a[:3, :3] @ center_a
    return T_b_a


def align_similar(a: Float64, b: Float64) -> tuple[Float64, float]:
    """The similarity that takes points a (N, 3) nearest to points b (N, 3) in least squares: ``T_b_a @ (scale * a)``.

    Umeyama's closed form; for paths whose scale is unknown. Raises ShapeError: other shapes, fewer than 3 points, or
    points a that are all one.
    """
    rigid = align_rigid(a, b)
    level_a, level_b = a - a.mean(axis=0), b - b.mean(axis=0)
    size = float((level_a**2).sum())
    if not size > 0:
        raise ShapeError("alignment with scale needs points that are not all one")
    scale = float(((level_a @ rigid[:3, :3].T) * level_b).sum()) / size
    T_b_a = rigid.copy()
    T_b_a[:3, 3] = b.mean(axis=0) - scale * rigid[:3, :3] @ a.mean(axis=0)
    return T_b_a, scale


def absolute_trajectory_error(estimated: Float64, truth: Float64) -> TrajectoryError:
    """Distances between positions of T_world_camera (N, 4, 4) of the same moments, after the estimated path has been
    aligned to the true one, without scale; ShapeError for paths of different lengths, or fewer than 3 poses."""
    aligned = align_rigid(estimated[:, :3, 3], truth[:, :3, 3]) @ estimated
    return _error(np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1), np.zeros(len(truth)))


def relative_pose_error(estimated: Float64, truth: Float64, gap: int = 1) -> TrajectoryError:
    """How much the motion over ``gap`` poses T_world_camera (N, 4, 4) of the same moments differs from the true one;
    ShapeError for paths of different lengths, or shorter than ``gap``."""
    sizes = expect_shape(estimated, "N 4 4", "estimated path")
    if expect_shape(truth, "N 4 4", "true path") != sizes or not 1 <= gap < sizes["N"]:
        raise ShapeError(f"relative_pose_error: need two paths of one length above gap {gap}, got {sizes['N']} poses")
    moved = invert_pose(estimated[:-gap]) @ estimated[gap:]
    error = invert_pose(invert_pose(truth[:-gap]) @ truth[gap:]) @ moved
    return _error(np.linalg.norm(error[:, :3, 3], axis=1), rotation_angle(error[:, :3, :3]))


def rotation_angle(R: Float64) -> Float64:
    """Angles (N,) in radians of rotations (N, 3, 3); exact for small ones, too."""
    twice_sine = np.stack((R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]), axis=1)
    return np.arctan2(np.linalg.norm(twice_sine, axis=1), np.trace(R, axis1=1, axis2=2) - 1)


def _error(distance_m: Float64, angle: Float64) -> TrajectoryError:
    return TrajectoryError(
        float(np.sqrt(np.mean(distance_m**2))),
        float(np.median(distance_m)),
        float(distance_m.max()),
        float(np.rad2deg(np.sqrt(np.mean(angle**2)))),
    )
