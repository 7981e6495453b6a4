"""Aligning one depth view to others (point to plane, Gauss-Newton), and judging the result.

The noise of depth grows with the square of the depth, and so does what a distance is compared with. Distances that
are large beside the noise count less (Geman-McClure), at coarse levels later than at fine ones. Same views, same pose,
bit for bit.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.drivers.poses.config import OdometryPoses
from semantic_mapper.drivers.poses.depth_view import Level
from semantic_mapper.geometry import invert_pose
from semantic_mapper.kernels import kernel
from semantic_mapper.types import Float64

_STILL_M, _STILL_RAD = 2e-5, 2e-5  # smaller steps end a level
_DAMPING = 1e-4  # of the normal matrix's mean diagonal: directions that no point tells of stay as they are
_LEAST_POINTS = 30
FALSE = 0.01  # of the information about the best known direction: noise of normals gives so much about every direction
_FLAT_TURN = 0.015  # the same for turns
_COARSER = 2.0  # noise at each level, by that of the next finer one


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
        noise_m: Of the distances, as of points at 1 m.
        normal_matrix: (6, 6) of turning and shifting the camera, in its own axes, in points at 1 m.
    """

    overlap: float
    fitness: float
    rmse_m: float
    cost_m: float
    noise_m: float
    normal_matrix: Float64


@kernel
def _point_to_plane(
    points: NDArray[np.float32],
    target_points: NDArray[np.float32],
    normals: NDArray[np.float32],
    pose: NDArray[np.float64],
    lens: NDArray[np.float64],
    outlier_m: float,
    noise_m: float,
    normal_matrix: NDArray[np.float64],
    gradient: NDArray[np.float64],
    sums: NDArray[np.float64],
) -> None: ...


@dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """What ``point_to_plane`` adds up."""

    normal_matrix: Float64
    gradient: Float64
    known: float
    seen: float
    flat: float
    near: float
    squares: float
    cost: float
    weight: float
    weighted_squares: float
    robust_weight: float


def align(
    config: OdometryPoses, levels: Sequence[Level], targets: Sequence[Target], T_world_camera: Float64
) -> Float64 | None:
    """Pose of a view, from a first guess: to the first target from coarse to fine, then to all at the finest level.

    Returns:
        (4, 4), or None where hardly a point lies on a target.
    """
    pose = T_world_camera
    for number, count in zip(range(len(levels) - 1, -1, -1), config.iterations, strict=True):
        chosen = targets if number == 0 else targets[:1]
        noise_m = config.noise_m * _COARSER**number
        for _ in range(count):
            step = _step(config, levels[min(number + 1, len(levels) - 1)], number, chosen, pose, noise_m)
            if step is None:
                return None
            pose = pose @ step
            if np.linalg.norm(step[:3, 3]) < _STILL_M and np.linalg.norm(step[:3, :3] - np.eye(3)) < 2 * _STILL_RAD:
                break
    u, _, vt = np.linalg.svd(pose[:3, :3])  # rounding errors would add up from keyframe to keyframe
    pose = pose.copy()
    pose[:3, :3] = u @ vt
    return pose


def fit(config: OdometryPoses, levels: Sequence[Level], target: Target, T_world_camera: Float64) -> Fit:
    """How a view at a pose lies on a target, from its coarsest level."""
    T_target_camera = invert_pose(target.T_world_camera) @ T_world_camera
    s = _add_up(levels[-1], target.levels[-1], T_target_camera, config.outlier_m, np.inf)
    return Fit(
        overlap=s.seen / max(s.known, 1),
        fitness=s.near / max(s.flat, 1),
        rmse_m=float(np.sqrt(s.squares / max(s.near, 1))),
        cost_m=s.cost / s.flat if s.flat else config.outlier_m,
        noise_m=float(np.sqrt(s.weighted_squares / max(s.weight, 1e-9))),
        normal_matrix=s.normal_matrix,
    )


def flat_directions(normal_matrices: Sequence[Float64]) -> tuple[Float64, Float64] | None:
    """Projections (3, 3) on the turns and on the shifts of the camera, in its own axes, that points tell nothing of.

    None where they tell of all: the usual case. A wall that fills the picture leaves a turn and two shifts open.

    Args:
        normal_matrices: (6, 6) each, of ``fit``.
    """
    total = sum(normal_matrices, np.zeros((6, 6)))
    flat: list[Float64] = []
    for part, least in ((total[:3, :3], _FLAT_TURN), (total[3:, 3:], FALSE)):
        values, axes = np.linalg.eigh(part)
        chosen = axes[:, values < least * values[-1]]
        flat.append(chosen @ chosen.T)
    return (flat[0], flat[1]) if flat[0].any() or flat[1].any() else None


def _step(
    config: OdometryPoses, level: Level, number: int, targets: Sequence[Target], pose: Float64, noise_m: float
) -> Float64 | None:
    """The motion (4, 4) of the camera, in its own axes, that brings it nearest to all targets; None without points."""
    total, gradient, points = np.zeros((6, 6)), np.zeros(6), 0.0
    for target in targets:
        T_target_camera = invert_pose(target.T_world_camera) @ pose
        s = _add_up(level, target.levels[number], T_target_camera, config.outlier_m, noise_m)
        total += s.normal_matrix
        gradient += s.gradient
        points += s.near
    if points < _LEAST_POINTS:
        return None
    change = -np.linalg.solve(total + _DAMPING * np.trace(total) / 6 * np.eye(6), gradient)
    step = np.eye(4)
    step[:3, :3] = np.asarray(cv2.Rodrigues(change[:3])[0])
    step[:3, 3] = change[3:]
    return step


def _add_up(level: Level, target: Level, T_target_camera: Float64, outlier_m: float, noise_m: float) -> _Sums:
    matrix, gradient, sums = np.empty((6, 6)), np.empty(6), np.empty(9)
    lens = target.intrinsics
    _point_to_plane(
        level.points,
        target.points,
        target.normals,
        np.ascontiguousarray(T_target_camera),
        np.array((lens.fx, lens.fy, lens.cx, lens.cy)),
        outlier_m,
        noise_m,
        matrix,
        gradient,
        sums,
    )
    return _Sums(matrix, gradient, *sums.tolist())
