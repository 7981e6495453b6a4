"""Aligning one depth view to others (point to plane, Gauss-Newton), and judging the result.

Points are looked up in the other depth image (projective association). The noise of depth grows with the square of the
depth, and so does what a distance is compared with. Distances that are large against the noise count less
(Geman-McClure), at coarse levels later than at fine ones. Same views, same pose, bit for bit.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.geometry import invert_pose, make_pose, nearest_pose, unproject
from semantic_mapper.kernels import kernel
from semantic_mapper.types import CameraIntrinsics, Float32, Float64

ITERATIONS = (20, 15, 10)  # at most, from the coarsest level, each half as wide as the next
OUTLIER_M = 0.07  # points further than this from the surface do not count
NOISE_M = 0.009  # of depth at 1 m, growing with its square; beyond this a distance counts less
POINTS_A_VOTE = 50  # neighbouring points have the same error: that many count as one
FALSE = 0.01  # of the information about the best known direction: noise of normals gives so much about every direction
_FLAT_TURN = 0.015  # the same for turns
_STILL_M, _STILL_RAD = 2e-5, 2e-5  # smaller steps end a level
_DAMPING = 1e-4  # of the normal matrix's mean diagonal: directions of which no point says anything stay as they are
_LEAST_DAMPING = 1e-9  # where nothing says anything: then the camera stays
_LEAST_POINTS = 30
_COARSER = 2.0  # noise at each level, by that of the next finer one
_SMOOTH_PX = 7  # width of the filter that takes the sensor's noise off points and normals
_RIM_PX = _SMOOTH_PX // 2  # nearer to the rim the filter sees one side alone and shifts what is aslant
_SMOOTH_M = 0.05  # depths further apart are of two surfaces and stay apart
_STEP_PX = 2  # a normal comes from the points this far to its sides: less of the noise
_EDGE = 0.05  # fraction of the depth by which these may differ, or they are of two surfaces


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """A depth image at one size."""

    points: Float32  # (H, W, 3) float32 in the camera's axes, metres; NaN = none
    normals: Float32  # (H, W, 3) float32 of unit length; NaN = none
    intrinsics: CameraIntrinsics  # of this size


@dataclass(frozen=True, slots=True, eq=False)
class Target:
    """What is aligned to: a view with a pose."""

    levels: tuple[Level, ...]  # finest first
    T_world_camera: Float64  # (4, 4)


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How well a view at a pose lies on a target."""

    overlap: float  # fraction of the view's points that the target's image holds
    fitness: float  # fraction of these that lie on its surface
    near: int  # how many these are
    rmse_m: float  # of the distances of these
    cost_m: float  # mean distance of the points that the target's image holds, no one's more than the outlier distance
    noise_m: float  # of the distances, as of points at 1 m
    # normal_matrix, gradient: (6, 6) and (6,) of turning and shifting the camera, in its own axes, in points at 1 m.
    normal_matrix: Float64
    gradient: Float64


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


def compare(
    level: Level, target: Level, T_target_camera: Float64, outlier_m: float = OUTLIER_M, noise_m: float = np.inf
) -> Fit:
    """How a view lies on another one, at one size, from a pose ``T_target_camera`` (4, 4). Points further than
    ``outlier_m`` from the surface do not count; distances beyond ``noise_m``, of depth at 1 m, count less."""
    matrix, gradient, sums = np.empty((6, 6)), np.empty(6), np.empty(9)
    lens = np.array((target.intrinsics.fx, target.intrinsics.fy, target.intrinsics.cx, target.intrinsics.cy))
    pose, limits = np.ascontiguousarray(T_target_camera), (outlier_m, noise_m)
    _point_to_plane(level.points, target.points, target.normals, pose, lens, *limits, matrix, gradient, sums)
    known, seen, flat, near, squares, cost, weight, weighted_squares, _ = sums.tolist()
    return Fit(
        overlap=seen / max(known, 1),
        fitness=near / max(flat, 1),
        near=round(near),
        rmse_m=float(np.sqrt(squares / max(near, 1))),
        cost_m=cost / flat if flat else outlier_m,
        noise_m=float(np.sqrt(weighted_squares / max(weight, 1e-9))),
        normal_matrix=matrix,
        gradient=gradient,
    )


def fit(levels: Sequence[Level], target: Target, T_world_camera: Float64) -> Fit:
    """How a view at a pose lies on a target, by the coarsest level of both."""
    return compare(levels[-1], target.levels[-1], invert_pose(target.T_world_camera) @ T_world_camera)


def align(levels: Sequence[Level], targets: Sequence[Target], T_world_camera: Float64) -> Float64 | None:
    """Pose (4, 4) of a view, from a first guess: to the first target from coarse to fine, then to all at the finest
    level; None where hardly a point lies on a target."""
    pose = T_world_camera
    for number, count in zip(range(len(levels) - 1, -1, -1), ITERATIONS, strict=True):
        chosen = targets if number == 0 else targets[:1]
        level = levels[min(number + 1, len(levels) - 1)]
        for _ in range(count):
            noise_m = NOISE_M * _COARSER**number
            relative = [invert_pose(target.T_world_camera) @ pose for target in chosen]
            fits = [compare(level, t.levels[number], T, noise_m=noise_m) for t, T in zip(chosen, relative, strict=True)]
            if sum(f.near for f in fits) < _LEAST_POINTS:
                return None
            total = sum((f.normal_matrix for f in fits), np.zeros((6, 6)))
            gradient = sum((f.gradient for f in fits), np.zeros(6))
            step = gauss_newton_step(total, gradient)
            pose = pose @ step
            if np.linalg.norm(step[:3, 3]) < _STILL_M and np.linalg.norm(step[:3, :3] - np.eye(3)) < 2 * _STILL_RAD:
                break
    return nearest_pose(pose)  # rounding errors would add up from keyframe to keyframe


def gauss_newton_step(normal_matrix: Float64, gradient: Float64) -> Float64:
    """Motion of the camera in its own axes, (4, 4) to be multiplied from the right, that lowers the cost the most."""
    damping = max(_DAMPING * np.trace(normal_matrix) / 6, _LEAST_DAMPING) * np.eye(6)
    change = -np.linalg.solve(normal_matrix + damping, gradient)
    return make_pose(change[:3], change[3:])


def flat_directions(normal_matrices: Sequence[Float64]) -> tuple[Float64, Float64] | None:
    """Projections (3, 3) on the turns and on the shifts of the camera, in its own axes, of which points say nothing by
    the (6, 6) matrices of ``fit``; None where they say something of all. A wall leaves a turn and two shifts open."""
    total = sum(normal_matrices, np.zeros((6, 6)))
    flat: list[Float64] = []
    for part, least in ((total[:3, :3], _FLAT_TURN), (total[3:, 3:], FALSE)):
        values, axes = np.linalg.eigh(part)
        chosen = axes[:, values < least * values[-1]]
        flat.append(chosen @ chosen.T)
    return (flat[0], flat[1]) if flat[0].any() or flat[1].any() else None


def thin_intrinsics(intrinsics: CameraIntrinsics, stride: int, first: int) -> CameraIntrinsics:
    """Intrinsics of an image of every ``stride``-th row and column, beginning with number ``first``: exact."""
    return CameraIntrinsics(
        fx=intrinsics.fx / stride,
        fy=intrinsics.fy / stride,
        cx=(intrinsics.cx - first) / stride,
        cy=(intrinsics.cy - first) / stride,
        width=len(range(first, intrinsics.width, stride)),
        height=len(range(first, intrinsics.height, stride)),
    )


def thin_depth(depth_m: Float32, stride: int, depth_max_m: float) -> Float32:
    """Every ``stride``-th pixel of a depth image, 0 where it is no number, not positive, or beyond the maximum."""
    depth = depth_m[stride // 2 :: stride, stride // 2 :: stride]
    return np.where(np.isfinite(depth) & (depth > 0) & (depth <= depth_max_m), depth, 0).astype(np.float32)


def make_levels(depth_m: Float32, intrinsics: CameraIntrinsics, count: int = len(ITERATIONS)) -> tuple[Level, ...]:
    """Smoothed points and normals of a depth image (0 = none), finest first, each level half as wide as before."""
    smooth = depth_m.copy()
    inner = (slice(_RIM_PX, -_RIM_PX),) * 2
    smooth[inner] = cv2.bilateralFilter(depth_m, _SMOOTH_PX, _SMOOTH_M, _SMOOTH_PX / 3)[inner]
    smooth[depth_m <= 0] = 0
    levels = [make_level(smooth, intrinsics, _STEP_PX)]
    for _ in range(count - 1):
        points, normals = (np.ascontiguousarray(a[::2, ::2]) for a in (levels[-1].points, levels[-1].normals))
        levels.append(Level(points, normals, thin_intrinsics(levels[-1].intrinsics, 2, 0)))
    return tuple(levels)


def make_level(depth_m: Float32, intrinsics: CameraIntrinsics, step_px: int = 1) -> Level:
    """Points and normals of a depth image (0 = none) as it is; a normal comes from the points this far to its sides."""
    points = unproject(depth_m, intrinsics).astype(np.float32)
    points[depth_m <= 0] = np.nan
    normals = np.full_like(points, np.nan)
    inner = slice(step_px, -step_px)
    across = points[inner, 2 * step_px :] - points[inner, : -2 * step_px]
    down = points[2 * step_px :, inner] - points[: -2 * step_px, inner]
    square = np.cross(across, down)
    with np.errstate(invalid="ignore"):
        square /= np.linalg.norm(square, axis=-1, keepdims=True)
        edge = _EDGE * points[inner, inner, 2]
        whole = (np.abs(across[..., 2]) < edge) & (np.abs(down[..., 2]) < edge)
    square[~whole] = np.nan
    normals[inner, inner] = square
    return Level(points, normals, intrinsics)
