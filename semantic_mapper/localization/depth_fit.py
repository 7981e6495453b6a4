"""A measured depth image against the map's own view: point-to-plane alignment, and what agrees and what contradicts.

The map's view is a ray cast; the points of the frame are looked up in it (projective association), as in KinectFusion.
Features that were found in the map hold the pose where surfaces leave it free to slide.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np

from semantic_mapper.geometry import (
    invert_pose,
    make_pose,
    nearest_pixels,
    nearest_pose,
    scale_intrinsics,
    transform,
    unproject,
)
from semantic_mapper.localization.depth_alignment import Level, make_level
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, UInt8

_WIDTH = 160  # of both depth images
_POINTS = 5000  # of the frame that are aligned, at most
_ROUNDS, _STEPS = 3, 6  # ray casts, and steps on each
_REACH_M = (0.15, 0.08, 0.05)  # in each round: points further from the map's surface do not pull
_POINTS_A_VOTE = 10  # neighbouring points have the same error: that many count as one
_DEPTH_SIGMA_M = 0.01
_FEATURE_SIGMA_PX = 8.0
_HUBER = 2.0  # in sigmas
_AWAY_M = 0.5  # further from the first guess the alignment has lost it
_TOLERANCE_M, _TOLERANCE = 0.04, 0.025  # depths agree within the sum of both, the second as a fraction of the depth


class MapView(Protocol):
    """The map seen from a pose; see ``mapping.map_types.MapView``."""

    @property
    def depth_m(self) -> Float32:
        """(H, W) z-depth, 0 where there is nothing."""
        ...

    @property
    def rgb(self) -> UInt8:
        """(H, W, 3)."""
        ...

    @property
    def label(self) -> UInt8:
        """(H, W) class ids."""
        ...

    @property
    def confidence(self) -> Float32:
        """(H, W) 0..1."""
        ...


class MapSurface(Protocol):
    """What can be seen from anywhere, such as ``VoxelMap``."""

    def ray_cast(self, T_world_camera: Float64, intrinsics: CameraIntrinsics) -> MapView:
        """The map as a camera would see it."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class Landmarks:
    """Features of a frame that were found in the map.

    Args:
        points: (K, 3) float64 in the map's world, metres.
        pixels: (K, 2) float64 where the frame shows them.
    """

    points: Float64
    pixels: Float64


@dataclass(frozen=True, slots=True)
class DepthFit:
    """How a frame's depth lies on the map.

    Args:
        overlap: Fraction of the measured pixels that show what the map has, too.
        agree: Fraction of these whose depth is the map's.
        through: Fraction of these that see through a surface of the map.
        before: Fraction of these that show something before the map's surface.
        likeness: Correlation of the brightness of frame and map where the depth agrees, -1..1; 0 where all is one grey.
        classes: Fraction of pixels of the map's class, among those where both are sure and the depth agrees; NaN where
            there are hardly any.
    """

    overlap: float
    agree: float
    through: float
    before: float
    likeness: float
    classes: float


def small_depth(depth_m: Float32, intrinsics: CameraIntrinsics) -> tuple[Float32, CameraIntrinsics]:
    """A depth image thinned to some 160 pixels of width, without means over edges; 0 where there is no number."""
    width = min(_WIDTH, intrinsics.width)
    small = scale_intrinsics(intrinsics, width, max(1, round(width * intrinsics.height / intrinsics.width)))
    depth = np.asarray(cv2.resize(depth_m, (small.width, small.height), interpolation=cv2.INTER_NEAREST), np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32), small


def align_depth(
    surface: MapSurface,
    depth_m: Float32,
    intrinsics: CameraIntrinsics,
    landmarks: Landmarks,
    frame_intrinsics: CameraIntrinsics,
    T_world_camera: Float64,
) -> Float64 | None:
    """The pose near a first guess at which depth (of ``small_depth``) and landmarks fit the map best, (4, 4).

    None where that leads away from the guess.
    """
    points = unproject(depth_m, intrinsics).reshape(-1, 3)
    points = points[points[:, 2] > 0]
    points = points[:: max(1, len(points) // _POINTS)]
    pose = T_world_camera
    for number in range(_ROUNDS):
        view = make_level(surface.ray_cast(pose, intrinsics).depth_m, intrinsics)
        T_world_view = pose
        for _ in range(_STEPS):
            by_depth = _step(points, view, T_world_view, pose, _REACH_M[number])
            by_features = _landmark_step(landmarks, frame_intrinsics, pose)
            normal, gradient = (a + b for a, b in zip(by_depth, by_features, strict=True))
            twist = np.linalg.solve(normal + 1e-6 * np.eye(6), -gradient).astype(np.float64)
            turned = make_pose(twist[:3], (0, 0, 0)) @ pose
            turned[:3, 3] = pose[:3, 3] + twist[3:]
            pose = nearest_pose(turned)
            away = np.linalg.norm(pose[:3, 3] - T_world_camera[:3, 3])
            if not away < _AWAY_M:  # NaN, too
                return None
            if np.abs(twist).max() < 1e-4:
                break
    return pose


def compare_depth(
    surface: MapSurface,
    depth_m: Float32,
    intrinsics: CameraIntrinsics,
    rgb: UInt8,
    T_world_camera: Float64,
    label: UInt8 | None = None,
    ignore_id: int = 255,
    sure: float = 0.7,
) -> DepthFit:
    """What of a frame (depth of ``small_depth``, images of any size) agrees with the map at a pose."""
    view = surface.ray_cast(T_world_camera, intrinsics)
    measured = depth_m > 0
    both = measured & (view.depth_m > 0)
    gap = depth_m - view.depth_m
    limit = _TOLERANCE_M + _TOLERANCE * view.depth_m
    # Next to an edge a pixel may show either surface: it contradicts only where no neighbour of the map's agrees.
    near = _any_neighbour_agrees(depth_m, view.depth_m)
    agree = both & (near | (np.abs(gap) < limit))
    count = max(int(both.sum()), 1)
    size = (intrinsics.width, intrinsics.height)
    gray = cv2.cvtColor(np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), np.uint8), cv2.COLOR_RGB2GRAY)
    theirs = cv2.cvtColor(np.ascontiguousarray(view.rgb), cv2.COLOR_RGB2GRAY)
    classes = float("nan")
    if label is not None:
        own = np.asarray(cv2.resize(label, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        known = agree & (own != ignore_id) & (view.label != ignore_id) & (view.confidence >= sure)
        if known.sum() > 0.05 * measured.size:
            classes = float((own == view.label)[known].mean())
    return DepthFit(
        overlap=float(both.sum()) / max(int(measured.sum()), 1),
        agree=float(agree.sum()) / count,
        through=float((both & ~agree & (gap > 0)).sum()) / count,
        before=float((both & ~agree & (gap < 0)).sum()) / count,
        likeness=_correlation(np.asarray(gray, np.uint8), np.asarray(theirs, np.uint8), agree),
        classes=classes,
    )


def _step(
    points: Float64,
    view: Level,
    T_world_view: Float64,
    pose: Float64,
    reach_m: float,
) -> tuple[Float64, Float64]:
    """Normal matrix (6, 6) and gradient (6,) of points to planes, for a turn about the camera and a shift, both in the
    world's axes."""
    lever = points @ pose[:3, :3].T
    world = lever + pose[:3, 3]
    inside, rows, columns = nearest_pixels(transform(invert_pose(T_world_view), world), view.intrinsics)
    there, facing = (a[rows, columns].astype(np.float64) for a in (view.points, view.normals))
    use = inside & np.isfinite(facing[:, 0])
    n = facing[use] @ T_world_view[:3, :3].T
    gap = ((world[use] - transform(T_world_view, there[use])) * n).sum(axis=1)
    near = np.abs(gap) < reach_m
    gap, n, lever = gap[near], n[near], lever[use][near]
    weight = _huber(gap / _DEPTH_SIGMA_M) / (_DEPTH_SIGMA_M**2 * _POINTS_A_VOTE)
    j = np.concatenate((np.cross(lever, n), n), axis=1)
    return (j * weight[:, None]).T @ j, (j * (weight * gap)[:, None]).sum(axis=0)


def _landmark_step(landmarks: Landmarks, intrinsics: CameraIntrinsics, pose: Float64) -> tuple[Float64, Float64]:
    """The same of the distances in the image."""
    seen = transform(invert_pose(pose), landmarks.points)
    front = seen[:, 2] > 0.05
    x, y, z = seen[front].T
    off = np.stack((intrinsics.fx * x / z + intrinsics.cx, intrinsics.fy * y / z + intrinsics.cy), axis=1)
    off = (off - landmarks.pixels[front]).reshape(-1)
    zero = np.zeros_like(z)
    by_point = np.stack(
        (
            np.stack((intrinsics.fx / z, zero, -intrinsics.fx * x / z**2), axis=1),
            np.stack((zero, intrinsics.fy / z, -intrinsics.fy * y / z**2), axis=1),
        ),
        axis=1,
    )  # (K, 2, 3) of the point in the camera's axes
    by_world = by_point @ pose[:3, :3].T
    lever = landmarks.points[front] - pose[:3, 3]
    # A turn w of the camera moves the point in its axes as -w x lever in the world's, a shift t as -t.
    by_turn = -np.cross(np.broadcast_to(lever[:, None], by_world.shape), by_world)
    j = np.concatenate((by_turn, -by_world), axis=2).reshape(-1, 6)
    weight = _huber(off / _FEATURE_SIGMA_PX) / _FEATURE_SIGMA_PX**2
    return (j * weight[:, None]).T @ j, (j * (weight * off)[:, None]).sum(axis=0)


def _huber(sigmas: Float64) -> Float64:
    return np.minimum(1.0, _HUBER / np.maximum(np.abs(sigmas), 1e-9))


def _any_neighbour_agrees(depth_m: Float32, map_m: Float32) -> Bool:
    limit = _TOLERANCE_M + _TOLERANCE * map_m
    low = np.where(map_m > 0, map_m - limit, np.float32(np.inf)).astype(np.float32)
    high = np.where(map_m > 0, map_m + limit, np.float32(0)).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray((depth_m > cv2.erode(low, kernel)) & (depth_m < cv2.dilate(high, kernel)), np.bool_)


def _correlation(a: UInt8, b: UInt8, where: Bool) -> float:
    if where.sum() < 50:
        return 0.0
    x, y = a[where].astype(np.float64), b[where].astype(np.float64)
    x, y = x - x.mean(), y - y.mean()
    size = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / size if size > 0 else 0.0
