"""Cameras, poses and what views see: pure functions of numpy arrays.

``p_a = T_a_b @ p_b``; pixel centres are integers; depth is z.

What computes in torch is in ``rays``: most who need geometry need no torch, which takes seconds to load.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2  # SciPy has slerp, too, but a machine that only trains and renders lacks it
import numpy as np
from numpy.typing import ArrayLike, NDArray

from semantic_mapper.errors import PoseError, ShapeError
from semantic_mapper.types import CameraIntrinsics, Float32, Float64

if TYPE_CHECKING:
    import torch

ROTATION_TOLERANCE = 1e-3  # |R^T R - I|: logs store 6 to 9 digits; a real mistake (scale, mirror) is far larger
# Metres along each axis. Views are rendered in float32, whose steps are 8 mm there: less than half a voxel of 2 cm.
MAX_TRANSLATION_M = 1e5
NEAREST_Z_M = 0.05  # nearer points are looked up in no image
SAME_SURFACE = 0.05  # fraction of z by which a measured depth may differ from a point's and still be of its surface
GUESSED_DEPTHS_M = (0.7, 1.5, 3.0)  # where points are put on rays without a measurement
LABELLED_VALUE = 2.0  # of a view whose labels are known, against one without
REPEAT_VALUE = 0.5  # a second view of the same point is worth half of the first, a third a quarter


def expect_shape(x: torch.Tensor | NDArray[np.generic], pattern: str, name: str = "array") -> dict[str, int]:
    """Check ``x`` against a pattern such as ``"M 3 H W"`` and return the sizes of its named dimensions.

    A letter stands for any size, the same letter for the same size, a number for itself. Raises ShapeError: with the
    expected and the actual shape.
    """
    parts = pattern.split()
    shape = tuple(int(n) for n in x.shape)
    sizes: dict[str, int] = {}
    fits = len(parts) == len(shape)
    for part, size in zip(parts, shape, strict=False):
        fits = fits and size == (int(part) if part.isdigit() else sizes.setdefault(part, size))
    if not fits:
        raise ShapeError(f"{name}: expected shape ({', '.join(parts)}), got {shape}")
    return sizes


def check_pose(T_world_camera: Float64, where: str, of: str = "camera") -> None:
    """Refuse what is not a rigid transform (4, 4) ``of`` something; ``where`` names the frame or file in the error.

    Raises PoseError: NaN or infinite numbers, wrong last row, a 3x3 part that is not a rotation, or a position farther
    than ``MAX_TRANSLATION_M`` from the origin.
    """
    expect_shape(T_world_camera, "4 4", f"{where}: T_world_{of}")
    if not np.isfinite(T_world_camera).all():
        raise PoseError(f"{where}: the pose holds NaN or infinity; drop the frame or give it a tracked pose")
    if not np.allclose(T_world_camera[3], (0, 0, 0, 1), atol=1e-9):
        raise PoseError(f"{where}: the last row of the pose must be 0 0 0 1, got {T_world_camera[3]}")
    R = T_world_camera[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):  # huge numbers give infinity or NaN, which are refused
        error = float(np.abs(R.T @ R - np.eye(3)).max())
        det = float(np.linalg.det(R))
    if not (error <= ROTATION_TOLERANCE and det > 0):
        raise PoseError(
            f"{where}: the pose is not a rotation (|R^T R - I| = {error:.2g}, det = {det:.3g}); "
            f"give T_world_{of} as a row-major rigid 4x4 without scale or mirror"
        )
    if np.abs(T_world_camera[:3, 3]).max() > MAX_TRANSLATION_M:
        raise PoseError(
            f"{where}: the {of} is at {T_world_camera[:3, 3]} m, beyond the {MAX_TRANSLATION_M / 1000:g} km from the "
            "origin within which float32 resolves a voxel; give poses in metres, relative to a nearer origin"
        )


def pose_matrix(position: Float64, quaternion: Float64) -> Float64:
    """Pose (4, 4) of a position (3,) and a quaternion (4,) as x y z w, which is normalised."""
    x, y, z, w = quaternion / np.linalg.norm(quaternion)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    )
    T_world_camera[:3, 3] = position
    return T_world_camera


def yaw_transform(position: Float64, yaw_deg: float) -> Float64:
    """Transform (4, 4) that turns by degrees about +z, then shifts by ``position`` (3,)."""
    c, s = np.cos(np.deg2rad(yaw_deg)), np.sin(np.deg2rad(yaw_deg))
    T = np.eye(4)
    T[:2, :2] = ((c, -s), (s, c))
    T[:3, 3] = position
    return T


def rotation_vector(T_a_b: Float64) -> Float64:
    """Axis times angle (3,), in radians, of the rotation of a rigid transform (4, 4)."""
    return np.asarray(cv2.Rodrigues(T_a_b[:3, :3])[0], np.float64)[:, 0]


def move(motion: Float64, T_world_camera: Float64) -> Float64:
    """``motion @ T_world_camera``; no motion leaves the pose as it is, to the bit."""
    return T_world_camera if np.array_equal(motion, np.eye(4)) else motion @ T_world_camera


def interpolate_pose(T_world_a: Float64, T_world_b: Float64, fraction: float) -> Float64:
    """The pose (4, 4) at a fraction of the way from a to b: slerp of the rotation, a line for the position.

    Below 0 and above 1 the motion is extrapolated.
    """
    turn = rotation_vector(T_world_a[:3, :3].T @ T_world_b[:3, :3])
    T = np.eye(4)
    T[:3, :3] = T_world_a[:3, :3] @ cv2.Rodrigues(fraction * turn)[0]
    T[:3, 3] = (1 - fraction) * T_world_a[:3, 3] + fraction * T_world_b[:3, 3]
    return T


def invert_pose(T_a_b: Float64) -> Float64:
    """Return ``T_b_a`` of a rigid transform (..., 4, 4)."""
    R_b_a = np.swapaxes(T_a_b[..., :3, :3], -1, -2)
    T_b_a = np.zeros_like(T_a_b)
    T_b_a[..., :3, :3] = R_b_a
    T_b_a[..., :3, 3] = -(R_b_a @ T_a_b[..., :3, 3:])[..., 0]
    T_b_a[..., 3, 3] = 1
    return T_b_a


def make_pose(turn: ArrayLike, position: ArrayLike) -> Float64:
    """The pose (4, 4) of a rotation vector and a position, three numbers each."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.asarray(turn, np.float64))[0]
    T[:3, 3] = np.ravel(position)
    return T


def nearest_pose(T: Float64) -> Float64:
    """The rigid transform nearest to a (4, 4) whose rotation is inexact, such as by rounding errors that add up."""
    u, _, vt = np.linalg.svd(T[:3, :3])
    exact = T.copy()
    exact[:3, :3] = u @ vt
    return exact


def align_similar(a: Float64, b: Float64) -> tuple[Float64, float]:
    """The similarity that takes points a (N, 3) nearest to points b (N, 3) in least squares: ``T_b_a @ (scale * a)``.

    Umeyama's closed form. Where the points lie on a line, one of the equally good rotations. Raises ShapeError: other
    shapes, fewer than 3 points, or points a that are all one.
    """
    sizes = expect_shape(a, "N 3", "points to align")
    if expect_shape(b, "N 3", "points to align to") != sizes or sizes["N"] < 3:
        raise ShapeError(f"alignment needs as many points on both sides, 3 or more; got {len(a)} and {len(b)}")
    center_a, center_b = a.mean(axis=0), b.mean(axis=0)
    level_a, level_b = a - center_a, b - center_b
    size = float((level_a**2).sum())
    if not size > 0:
        raise ShapeError("alignment needs points that are not all one")
    u, _, vt = np.linalg.svd(level_b.T @ level_a)
    R = u @ np.diag((1.0, 1.0, float(np.sign(np.linalg.det(u) * np.linalg.det(vt))))) @ vt  # a rotation, no mirror
    scale = float(((level_a @ R.T) * level_b).sum()) / size
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = R
    T_b_a[:3, 3] = center_b - scale * R @ center_a
    return T_b_a, scale


def pose_distance(T_world_a: Float64, T_world_b: Float64) -> tuple[float, float]:
    """Metres and radians between two poses (4, 4)."""
    T_a_b = invert_pose(T_world_a) @ T_world_b
    return float(np.linalg.norm(T_a_b[:3, 3])), float(np.linalg.norm(rotation_vector(T_a_b)))


def look_at(eye: Float64, target: Float64, up: Float64) -> Float64:
    """Pose (4, 4) of a camera at ``eye`` that looks at ``target``, with image-up along ``up`` (world).

    Raises PoseError: ``eye`` is ``target``, or the view is along ``up``, so that the roll is not defined.
    """
    forward = target - eye
    right = np.cross(forward, up)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward) * np.linalg.norm(up):
        raise PoseError(f"look_at: no view from {eye} to {target} with up {up}; the view must not be along up")
    forward = forward / np.linalg.norm(forward)
    right = right / np.linalg.norm(right)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.stack((right, np.cross(forward, right), forward), axis=1)
    T_world_camera[:3, 3] = eye
    return T_world_camera


def camera_matrix(intrinsics: CameraIntrinsics) -> Float64:
    """Return K, (3, 3) in pixels."""
    return np.array([[intrinsics.fx, 0, intrinsics.cx], [0, intrinsics.fy, intrinsics.cy], [0, 0, 1]], np.float64)


def scale_intrinsics(intrinsics: CameraIntrinsics, width: int, height: int) -> CameraIntrinsics:
    """Intrinsics of the same view resized to ``width`` x ``height``; pixel centres stay integers."""
    sx, sy = width / intrinsics.width, height / intrinsics.height
    return replace(  # of its lens model
        intrinsics,
        fx=intrinsics.fx * sx,
        fy=intrinsics.fy * sy,
        cx=(intrinsics.cx + 0.5) * sx - 0.5,
        cy=(intrinsics.cy + 0.5) * sy - 0.5,
        width=width,
        height=height,
    )


def project(p_camera: Float64, intrinsics: CameraIntrinsics) -> Float64:
    """Project points (N, 3) in front of the camera to pixels (N, 2) as (u, v)."""
    u = intrinsics.fx * p_camera[:, 0] / p_camera[:, 2] + intrinsics.cx
    v = intrinsics.fy * p_camera[:, 1] / p_camera[:, 2] + intrinsics.cy
    return np.stack((u, v), axis=1)


def nearest_pixels(
    p_camera: Float64, intrinsics: CameraIntrinsics
) -> tuple[NDArray[np.bool_], NDArray[np.int64], NDArray[np.int64]]:
    """The pixels that points (N, 3) of the camera's frame fall on.

    Returns:
        (N,) whether the point is at least 5 cm in front of the camera and in its image; (N,) rows; (N,) columns, both 0
        where it is not.
    """
    z = np.maximum(p_camera[:, 2], NEAREST_Z_M)
    u = np.rint(intrinsics.fx * p_camera[:, 0] / z + intrinsics.cx)
    v = np.rint(intrinsics.fy * p_camera[:, 1] / z + intrinsics.cy)
    inside = (p_camera[:, 2] > NEAREST_Z_M) & (u >= 0) & (u < intrinsics.width) & (v >= 0) & (v < intrinsics.height)
    return inside, np.where(inside, v, 0).astype(np.int64), np.where(inside, u, 0).astype(np.int64)


def unproject(depth_m: Float32, intrinsics: CameraIntrinsics) -> Float64:
    """Unproject a depth image (H, W) of the camera's size to camera points (H, W, 3) in metres; z = 0 without depth."""
    expect_shape(depth_m, f"{intrinsics.height} {intrinsics.width}", "depth_m")
    z = depth_m.astype(np.float64)
    u = np.arange(intrinsics.width)[None, :]
    v = np.arange(intrinsics.height)[:, None]
    x = (u - intrinsics.cx) / intrinsics.fx * z
    y = (v - intrinsics.cy) / intrinsics.fy * z
    return np.stack((x, y, z), axis=-1)


def transform(T_a_b: Float64, p_b: Float64) -> Float64:
    """Map points (..., 3) of frame b to frame a."""
    return p_b @ T_a_b[:3, :3].T + T_a_b[:3, 3]


def turn_onto(a: Float64, b: Float64) -> Float64:
    """The least rotation (3, 3) that takes unit vector ``a`` to ``b``; half a turn about x or y for opposite ones."""
    c = float(a @ b)
    if c < -1 + 1e-9:
        side = np.cross(b, (0.0, 0.0, 1.0) if abs(b[2]) < 0.9 else (0.0, 1.0, 0.0))
        side /= np.linalg.norm(side)
        return 2 * np.outer(side, side) - np.eye(3)
    x, y, z = v = np.cross(a, b)
    return np.array(((c, -z, y), (z, c, -x), (-y, x, c))) + np.outer(v, v) / (1 + c)


def visible_points(
    points: Float64, T_world_camera: Float64, intrinsics: CameraIntrinsics, depth_m: Float32, *, measured: bool
) -> NDArray[np.bool_]:
    """Which points a view sees: (P,), those in its image that nothing hides. A hole in its depth hides nothing.

    ``points`` are (P, 3) in the world, ``depth_m`` (H, W) with 0 = none. ``measured`` points lie on measured surfaces,
    so a depth beyond them speaks of another surface. Others are guesses, and only what stands before them tells that
    they are not seen.
    """
    p = transform(invert_pose(T_world_camera), points)
    inside, row, column = nearest_pixels(p, intrinsics)
    depth, z = depth_m[row, column], p[:, 2]
    free = np.abs(depth - z) < SAME_SURFACE * z if measured else z < depth * (1 + SAME_SURFACE)
    return inside & (free | (depth <= 0))


def select_views(seen: NDArray[np.bool_], value: Float64, bonus: Float64, count: int) -> list[int]:
    """Choose views greedily: each adds most of what is not yet covered.

    Args:
        seen: (K, P) whether view k sees point p.
        value: (K,) what a point that view k sees counts.
        bonus: (K,) added to the gain of views that see anything; breaks ties.
        count: Views wanted.

    Returns:
        At most ``count`` view numbers, the most useful first; none that sees nothing.
    """
    worth = np.ones(seen.shape[1])
    chosen: list[int] = []
    extra = bonus * seen.any(axis=1)
    while len(chosen) < min(count, len(seen)):
        gain = value * (seen @ worth) / max(seen.shape[1], 1) + extra
        gain[chosen] = 0
        best = int(gain.argmax())
        if gain[best] <= 0:
            break
        chosen.append(best)
        worth = np.where(seen[best], worth * REPEAT_VALUE, worth)
    return chosen
