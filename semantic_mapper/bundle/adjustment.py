"""Bundle adjustment of keyframes and points with GTSAM: pixels, given poses as priors, old keyframes held."""

from __future__ import annotations

from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X

from semantic_mapper.log_events import get_logger
from semantic_mapper.types import Bool, CameraIntrinsics, Float64, Int64

_log = get_logger(__name__)

_PIXEL_SIGMA = 0.7  # of a corner that is followed
_HUBER_SIGMAS = 1.5  # errors beyond count less
_PRIOR_HUBER_SIGMAS = 2.0
_HELD_SIGMA = 1e-4  # metres and radians, of keyframes that stay where they are
_TOLERANCE = 1e-4  # relative decrease of the cost that ends it


@dataclass(frozen=True, slots=True, eq=False)
class BundleProblem:
    """K keyframes, P points, N sights of them.

    Args:
        intrinsics: Of the images that the pixels are in.
        poses: (K, 4, 4) T_world_camera, first guesses.
        held: (K,) whether a keyframe stays at its first guess.
        priors: (K, 4, 4) T_world_camera as given.
        prior_sigmas: (K, 2) one sigma of these in metres and radians; infinite = none was given.
        points: (P, 3) first guesses, world.
        keyframe, point: (N,) rows of what sees and what is seen.
        pixels: (N, 2) as (u, v).
    """

    intrinsics: CameraIntrinsics
    poses: Float64
    held: Bool
    priors: Float64
    prior_sigmas: Float64
    points: Float64
    keyframe: Int64
    point: Int64
    pixels: Float64


@dataclass(frozen=True, slots=True, eq=False)
class BundleResult:
    """What a bundle adjustment found.

    Args:
        poses: (K, 4, 4).
        points: (P, 3).
        errors_px: (N,) of each sight; infinite behind the camera.
    """

    poses: Float64
    points: Float64
    errors_px: Float64


def adjust_bundle(problem: BundleProblem, iterations: int) -> BundleResult:
    """Least squares of all sights and priors (Levenberg-Marquardt, Huber). Deterministic.

    Args:
        problem: At least one keyframe must be held or have a prior.
        iterations: At most.
    """
    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    k = problem.intrinsics
    lens = gtsam.Cal3_S2(k.fx, k.fy, 0.0, k.cx, k.cy)
    noise = gtsam.noiseModel
    held = noise.Isotropic.Sigma(6, _HELD_SIGMA)
    for row, pose in enumerate(problem.poses):
        start.insert(X(row), gtsam.Pose3(pose))
        metres, radians = problem.prior_sigmas[row]
        if problem.held[row]:
            graph.add(gtsam.PriorFactorPose3(X(row), gtsam.Pose3(pose), held))
        elif np.isfinite(metres):
            sigmas = noise.Diagonal.Sigmas(np.array([radians] * 3 + [metres] * 3))
            robust = noise.Robust.Create(noise.mEstimator.Huber.Create(_PRIOR_HUBER_SIGMAS), sigmas)
            graph.add(gtsam.PriorFactorPose3(X(row), gtsam.Pose3(problem.priors[row]), robust))
    for row, point in enumerate(problem.points):
        start.insert(L(row), point)
    pixel = noise.Robust.Create(noise.mEstimator.Huber.Create(_HUBER_SIGMAS), noise.Isotropic.Sigma(2, _PIXEL_SIGMA))
    factor = gtsam.GenericProjectionFactorCal3_S2
    for seen, row, column in zip(problem.pixels, problem.keyframe.tolist(), problem.point.tolist(), strict=True):
        graph.add(factor(seen, pixel, X(row), L(column), lens, False, False))
    try:
        found = minimize(graph, start, iterations)
    except RuntimeError as error:  # what GTSAM raises where sights leave a direction open
        _log.warning("bundle_left_out", reason=str(error).strip()[:200])
        found = start
    poses = np.array([found.atPose3(X(row)).matrix() for row in range(len(problem.poses))])
    poses[problem.held] = problem.poses[problem.held]
    points = np.array([found.atPoint3(L(row)) for row in range(len(problem.points))]).reshape(-1, 3)
    return BundleResult(poses, points, sight_errors(problem, poses, points))


def minimize(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, iterations: int) -> gtsam.Values:
    """Values of the least cost (Levenberg-Marquardt), after at most so many iterations.

    Raises:
        RuntimeError: by GTSAM, where the factors leave a direction open.
    """
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, gtsam.LevenbergMarquardtParams())
    cost = optimizer.error()
    for _ in range(iterations):  # ``optimize`` would keep Python's other threads waiting until its end
        optimizer.iterate()
        before, cost = cost, optimizer.error()
        if before - cost <= _TOLERANCE * before:
            break
    return optimizer.values()


def sight_errors(problem: BundleProblem, poses: Float64, points: Float64) -> Float64:
    """Reprojection errors (N,) in pixels; infinite behind the camera."""
    R, t = poses[problem.keyframe, :3, :3], poses[problem.keyframe, :3, 3]
    return reprojection_errors(
        np.einsum("nji,nj->ni", R, points[problem.point] - t), problem.pixels, problem.intrinsics
    )


def reprojection_errors(p_camera: Float64, pixels: Float64, intrinsics: CameraIntrinsics) -> Float64:
    """Distances (N,) in pixels between points (N, 3) of the camera's frame and where they are seen (N, 2)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = p_camera[:, :2] / p_camera[:, 2:] * (intrinsics.fx, intrinsics.fy) + (intrinsics.cx, intrinsics.cy)
    errors = np.linalg.norm(uv - pixels, axis=1)
    return np.where((p_camera[:, 2] > 1e-3) & np.isfinite(errors), errors, np.inf)
