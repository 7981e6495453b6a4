"""How far a path is from the true one: absolute trajectory error after alignment, and relative pose error."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from semantic_mapper.geometry import align_similar, invert_pose
from semantic_mapper.types import Float64


class TrajectoryError(NamedTuple):
    """Distances of positions in metres, and of rotations in degrees (0 for the absolute error)."""

    rmse_m: float
    median_m: float
    max_m: float
    rmse_deg: float = 0.0


def align_rigid(a: Float64, b: Float64) -> Float64:
    """The rigid motion T_b_a (4, 4) that takes points a (N, 3) nearest to points b (N, 3) in least squares."""
    T_b_a, _ = align_similar(a, b)  # whose rotation does not depend on the scale
    T_b_a[:3, 3] = b.mean(axis=0) - T_b_a[:3, :3] @ a.mean(axis=0)
    return T_b_a


def absolute_trajectory_error(estimated: Float64, truth: Float64) -> TrajectoryError:
    """Distances between positions of T_world_camera (N, 4, 4) of the same moments, after the estimated path has been
    aligned to the true one, without scale."""
    aligned = align_rigid(estimated[:, :3, 3], truth[:, :3, 3]) @ estimated
    return _error(aligned[:, :3, 3] - truth[:, :3, 3], np.zeros(len(truth)))


def relative_pose_error(estimated: Float64, truth: Float64, gap: int = 1) -> TrajectoryError:
    """How much the motion over ``gap`` poses T_world_camera (N, 4, 4) of the same moments differs from the true one."""
    moved = invert_pose(estimated[:-gap]) @ estimated[gap:]
    error = invert_pose(invert_pose(truth[:-gap]) @ truth[gap:]) @ moved
    return _error(error[:, :3, 3], Rotation.from_matrix(error[:, :3, :3]).magnitude())


def _error(offset_m: Float64, angle: Float64) -> TrajectoryError:
    distance = np.linalg.norm(offset_m, axis=1)
    rmse_m, rmse = (float(np.sqrt(np.mean(x**2))) for x in (distance, angle))
    return TrajectoryError(rmse_m, float(np.median(distance)), float(distance.max()), float(np.rad2deg(rmse)))
