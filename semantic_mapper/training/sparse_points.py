"""Points that several posed images show, for the box of a scene without depth: SIFT features, matched between images
that look at one place from two, and triangulated with the poses as they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from semantic_mapper.geometry import camera_matrix, invert_pose
from semantic_mapper.imaging import resize_rgb, working_intrinsics
from semantic_mapper.types import Float32, Float64, PosedFrame

FRAMES, WIDTH, FEATURES = 60, 640, 1500
PARTNERS = (1, 2, 4, 8)  # of a frame: neighbours by distance, so that some are far enough away
RATIO = 0.8  # of the distances of the best and the second best match
LARGEST_ERROR_PX, LEAST_ANGLE_DEG = 1.5, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class _Features:
    """Of one frame: places (N, 2) in pixels, descriptors (N, D), K (3, 3), T_camera_world (4, 4), centre (3,)."""

    places: Float32
    descriptors: Float32
    K: Float64
    T_camera_world: Float64
    centre: Float64


def sparse_points(frames: Sequence[PosedFrame]) -> Float64:
    """Points (N, 3) in the world that images show, triangulated; wrong poses leave few.

    Args:
        frames: With poses, of a scene that stands still; at most 60, evenly spread, are looked at.
    """
    step = max(1, -(-len(frames) // FRAMES))
    seen = [found for frame in frames[::step] if (found := _features(frame)) is not None]
    if len(seen) < 2:
        return np.zeros((0, 3))
    centres = np.array([f.centre for f in seen])
    pairs: set[tuple[int, int]] = set()
    for i, centre in enumerate(centres):
        order = np.argsort(np.linalg.norm(centres - centre, axis=1), kind="stable")
        pairs |= {(min(i, j), max(i, j)) for rank in PARTNERS if rank < len(order) and (j := int(order[rank])) != i}
    return np.concatenate([_triangulated(seen[i], seen[j]) for i, j in sorted(pairs)])


def _features(frame: PosedFrame) -> _Features | None:
    k = working_intrinsics(frame.intrinsics, min(WIDTH, frame.intrinsics.width))
    gray = cv2.cvtColor(resize_rgb(frame, k), cv2.COLOR_RGB2GRAY)
    points, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(gray, None)  # type: ignore[arg-type]
    if descriptors is None or len(points) < 2:
        return None
    places = np.array([point.pt for point in points], np.float32)
    pose = frame.T_world_camera
    return _Features(places, np.asarray(descriptors, np.float32), camera_matrix(k), invert_pose(pose), pose[:3, 3])


def _triangulated(a: _Features, b: _Features) -> Float64:
    """Points (N, 3) of features that match, lie on each other's epipolar lines, and before both cameras."""
    matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a.descriptors, b.descriptors, k=2)
    good = [m[0] for m in matches if len(m) == 2 and m[0].distance < RATIO * m[1].distance]
    if not good:
        return np.zeros((0, 3))
    at_a, at_b = a.places[[m.queryIdx for m in good]], b.places[[m.trainIdx for m in good]]
    P_a, P_b = a.K @ a.T_camera_world[:3], b.K @ b.T_camera_world[:3]
    homogeneous = cv2.triangulatePoints(P_a, P_b, at_a.T.astype(np.float64), at_b.T.astype(np.float64)).T
    w = homogeneous[:, 3:]
    xyz = homogeneous[:, :3] / np.where(np.abs(w) < 1e-12, 1e-12, w)
    to_a, to_b = a.centre - xyz, b.centre - xyz
    cosine = (to_a * to_b).sum(1) / np.maximum(np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1), 1e-12)
    kept = cosine < np.cos(np.deg2rad(LEAST_ANGLE_DEG))
    for P, at in ((P_a, at_a), (P_b, at_b)):
        uvw = xyz @ P[:, :3].T + P[:, 3]
        error = np.linalg.norm(uvw[:, :2] / np.where(np.abs(uvw[:, 2:]) < 1e-12, 1e-12, uvw[:, 2:]) - at, axis=1)
        kept &= (uvw[:, 2] > 0) & (error < LARGEST_ERROR_PX)
    return xyz[kept]
