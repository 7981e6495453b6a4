"""Aligning one depth view to others with Open3D's tensor odometry (point to plane), and judging the result.

Open3D tells the step of one view toward one other. Toward several at once, each of them proposes a pose, and what a
proposal is worth in each direction is its normal matrix: a wall says much about the way toward it and nothing about the
way along it. The step that all take together is the least-squares one of all their points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from semantic_mapper.drivers.poses.config import OdometryPoses
from semantic_mapper.drivers.poses.depth_view import Level
from semantic_mapper.geometry import camera_matrix, invert_pose, nearest_pixels, transform
from semantic_mapper.mapping.open3d_loader import load_open3d
from semantic_mapper.types import Float64

_STILL_M, _STILL_RAD = 2e-5, 2e-5  # smaller steps end a level
_DAMPING = 1e-3  # of the normal matrix's mean diagonal: directions that no point tells of stay as they are
_SINGULAR = "ingular"  # what Open3D says where the points leave a direction open


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """What is aligned to: a view with a pose.

    Args:
        levels: Finest first.
        T_world_camera: (4, 4).
    """

    levels: tuple[Level, ...]
    T_world_camera: Float64


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How well a view at a pose lies on a target.

    Args:
        overlap: Fraction of the view's points that the target's image holds.
        fitness: Fraction of these that lie on its surface.
        rmse_m: Of the distances of these.
        cost_m: Mean distance of the points that the target's image holds, no one's more than the outlier distance.
        normal_matrix: (6, 6) of turning about and shifting the camera, in the world's axes, in points.
    """

    overlap: float
    fitness: float
    rmse_m: float
    cost_m: float
    normal_matrix: Float64


class Aligner:
    """Finds poses of views. Loads Open3D when made.

    Raises:
        DependencyError: Open3D cannot be loaded.
    """

    def __init__(self, config: OdometryPoses) -> None:
        self._config = config
        open3d = load_open3d()
        self._tensor: Any = open3d.core.Tensor
        self._step: Any = open3d.t.pipelines.odometry.compute_odometry_result_point_to_plane

    def align(self, levels: Sequence[Level], targets: Sequence[Target], T_world_camera: Float64) -> Float64 | None:
        """Pose of a view, from a first guess: to the first target from coarse to fine, then to all at the finest level.

        Returns:
            (4, 4), or None where the points do not hold the camera in all directions.
        """
        pose = T_world_camera
        iterations = self._config.iterations
        for number, count in zip(range(len(levels) - 1, -1, -1), iterations, strict=True):
            chosen = targets if number == 0 else targets[:1]
            weights = [fit(levels, t, pose, self._config.outlier_m).normal_matrix for t in chosen]
            for _ in range(count):
                moved = self._move(levels[number], number, chosen, weights, pose)
                if moved is None:
                    return None
                still = _is_still(pose, moved)
                pose = moved
                if still:
                    break
        return pose

    def _move(
        self, level: Level, number: int, targets: Sequence[Target], weights: Sequence[Float64], pose: Float64
    ) -> Float64 | None:
        """One Gauss-Newton step toward all targets."""
        total, wanted = np.zeros((6, 6)), np.zeros(6)
        for target, weight in zip(targets, weights, strict=True):
            proposed = self._propose(level, target.levels[number], target.T_world_camera, pose)
            if proposed is None:
                continue
            if len(targets) == 1:
                return proposed
            turn = np.asarray(cv2.Rodrigues(proposed[:3, :3] @ pose[:3, :3].T)[0], np.float64)[:, 0]
            total += weight
            wanted += weight @ np.concatenate((turn, proposed[:3, 3] - pose[:3, 3]))
        if not total.any():
            return None
        change = np.linalg.solve(total + _DAMPING * np.trace(total) / 6 * np.eye(6), wanted)
        moved = pose.copy()
        moved[:3, :3] = np.asarray(cv2.Rodrigues(change[:3])[0]) @ pose[:3, :3]
        moved[:3, 3] += change[3:]
        return moved

    def _propose(self, level: Level, target: Level, T_world_target: Float64, pose: Float64) -> Float64 | None:
        """Where one step toward one target takes the camera."""
        T_target_camera = invert_pose(T_world_target) @ pose
        try:
            result = self._step(
                self._tensor.from_numpy(level.points),
                self._tensor.from_numpy(target.points),
                self._tensor.from_numpy(target.normals),
                self._tensor.from_numpy(camera_matrix(level.intrinsics)),
                self._tensor.from_numpy(np.ascontiguousarray(T_target_camera)),
                self._config.outlier_m,
                self._config.huber_m,
            )
        except RuntimeError as error:
            if _SINGULAR in str(error):
                return None
            raise
        moved = T_world_target @ result.transformation.numpy() @ T_target_camera
        if not np.isfinite(moved).all():
            return None
        u, _, vt = np.linalg.svd(moved[:3, :3])  # Open3D's steps are rotations to float32 only, and errors would add up
        moved[:3, :3] = u @ vt
        return moved


def fit(levels: Sequence[Level], target: Target, T_world_camera: Float64, outlier_m: float) -> Fit:
    """How a view at a pose lies on a target, from its coarsest level."""
    level, other = levels[-1], target.levels[-1]
    own = level.points[np.isfinite(level.points[..., 2])].astype(np.float64)
    world = transform(T_world_camera, own)
    inside, rows, columns = nearest_pixels(transform(invert_pose(target.T_world_camera), world), other.intrinsics)
    points, normals = other.points[rows, columns], other.normals[rows, columns]
    seen = inside & np.isfinite(points[:, 2])
    with np.errstate(invalid="ignore"):
        flat = seen & np.isfinite(normals[:, 0])
    normals_world = normals[flat].astype(np.float64) @ target.T_world_camera[:3, :3].T
    gap = world[flat] - transform(target.T_world_camera, points[flat].astype(np.float64))
    distance = (gap * normals_world).sum(axis=1)
    near = np.abs(distance) < outlier_m
    count = max(int(near.sum()), 1)
    arm = world[flat][near] - T_world_camera[:3, 3]
    by_pose = np.concatenate((np.cross(arm, normals_world[near]), normals_world[near]), axis=1)  # (N, 6)
    return Fit(
        overlap=float(seen.sum()) / max(len(own), 1),
        fitness=float(near.sum()) / max(int(flat.sum()), 1),
        rmse_m=float(np.sqrt((distance[near] ** 2).sum() / count)),
        cost_m=float(np.minimum(np.abs(distance), outlier_m).mean()) if len(distance) else outlier_m,
        normal_matrix=by_pose.T @ by_pose,
    )


def _is_still(a: Float64, b: Float64) -> bool:
    turned = 0.5 * float(np.linalg.norm(a[:3, :3] - b[:3, :3]))
    return bool(np.linalg.norm(a[:3, 3] - b[:3, 3]) < _STILL_M) and turned < _STILL_RAD
