"""Poses of the frames between those that structure from motion has registered: its points, followed into them."""

from dataclasses import dataclass

import cv2
import numpy as np

from semantic_mapper.geometry import camera_matrix, invert_pose, make_pose
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

MIN_INLIERS = 25
MIN_INLIER_FRACTION = 0.5  # of the points that were followed
MAX_ERROR_PX = 3.0  # of an inlier, for a width of 640
MAX_POINTS = 600


@dataclass(frozen=True, slots=True, eq=False)
class RegisteredFrame:
    """A frame of the model."""

    T_world_camera: Float64  # (4, 4)
    xy: Float64  # (N, 2) pixels of the points that it sees
    xyz: Float64  # (N, 3) these points in the world


def follow_pose(before: UInt8, frame: RegisteredFrame, gray: UInt8, intrinsics: CameraIntrinsics) -> Float64 | None:
    """T_world_camera (4, 4) of a frame soon after a registered one; None where too few of its points are found again.

    ``before`` and ``gray`` (H, W) are their pictures, ``intrinsics`` those of both, with distortion.
    """
    if len(frame.xy) < MIN_INLIERS:
        return None
    chosen = np.linspace(0, len(frame.xy) - 1, min(len(frame.xy), MAX_POINTS)).astype(np.int64)
    after, true = track(before, gray, np.ascontiguousarray(frame.xy[chosen, None], np.float32))
    if true.sum() < MIN_INLIERS:
        return None
    xyz, xy = frame.xyz[chosen][true], after[true, 0].astype(np.float64)
    T_camera_world = invert_pose(frame.T_world_camera)
    turn, shift = cv2.Rodrigues(T_camera_world[:3, :3])[0], T_camera_world[:3, 3:].copy()
    lens = camera_matrix(intrinsics), np.array(intrinsics.distortion or (0.0,) * 4)
    cv2.setRNGSeed(0)
    good, turn, shift, inliers = cv2.solvePnPRansac(
        xyz, xy, *lens, turn, shift, True, 100, MAX_ERROR_PX * intrinsics.width / 640
    )
    if not good or inliers is None or len(inliers) < max(MIN_INLIERS, MIN_INLIER_FRACTION * len(xyz)):
        return None
    rows = np.asarray(inliers, np.int64)[:, 0]
    T = make_pose(*cv2.solvePnPRefineLM(xyz[rows], xy[rows], *lens, turn, shift))
    return invert_pose(T) if np.isfinite(T).all() else None


def track(
    last: UInt8, now: UInt8, xy: np.ndarray, window: tuple[int, int] = (21, 21), levels: int = 4
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 1, 2) float32 of one picture in another, and (N,) whether they come back to where they were."""
    options = {"winSize": window, "maxLevel": levels}
    moved, found, _ = cv2.calcOpticalFlowPyrLK(last, now, xy, np.zeros_like(xy), **options)
    back, found_back, _ = cv2.calcOpticalFlowPyrLK(now, last, moved, np.zeros_like(xy), **options)
    true = (np.linalg.norm(back - xy, axis=2) < 1.0) & (found > 0) & (found_back > 0)
    return np.asarray(moved), true[:, 0]
