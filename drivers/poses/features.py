"""Corners of an image with their depth (ORB), and a pose from those that two images share (PnP with RANSAC)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from semantic_mapper.geometry import camera_matrix, invert_pose
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

_RANSAC_ROUNDS = 200
_RANSAC_PX = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """N corners.

    Args:
        pixels: (N, 2) float64 as (u, v).
        depth_m: (N,) float64, 0 = none.
        descriptors: (N, 32) uint8.
    """

    pixels: Float64
    depth_m: Float64
    descriptors: UInt8


def find_features(rgb: UInt8, depth_m: Float32, count: int) -> Features:
    """The strongest ``count`` corners of an image and their depth (same size, 0 = none)."""
    detector: Any = cv2.ORB.create(nfeatures=count, fastThreshold=10)
    corners, descriptors = detector.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
    if descriptors is None or not len(corners):
        return Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 32), np.uint8))
    pixels = np.array([corner.pt for corner in corners], np.float64)
    nearest = np.rint(pixels).astype(np.int64)
    rows = np.clip(nearest[:, 1], 0, depth_m.shape[0] - 1)
    columns = np.clip(nearest[:, 0], 0, depth_m.shape[1] - 1)
    return Features(pixels, depth_m[rows, columns].astype(np.float64), np.asarray(descriptors, np.uint8))


def pose_from_features(
    image: Features, other: Features, intrinsics: CameraIntrinsics, min_matches: int
) -> tuple[Float64, int] | None:
    """Where the camera was in the axes of another image, ``T_other_camera`` (4, 4), and how many corners say so.

    The depth of the other image alone is used. None where fewer than ``min_matches`` corners agree.
    """
    deep = np.flatnonzero(other.depth_m > 0)
    if len(deep) < min_matches or len(image.pixels) < min_matches:
        return None
    matcher: Any = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
    matches = matcher.match(image.descriptors, other.descriptors[deep])
    if len(matches) < min_matches:
        return None
    ours = image.pixels[[m.queryIdx for m in matches]]
    theirs = deep[[m.trainIdx for m in matches]]
    z = other.depth_m[theirs]
    x = (other.pixels[theirs, 0] - intrinsics.cx) / intrinsics.fx * z
    y = (other.pixels[theirs, 1] - intrinsics.cy) / intrinsics.fy * z
    points = np.stack((x, y, z), axis=1)
    found, turn, shift, inliers = cv2.solvePnPRansac(
        points,
        ours,
        camera_matrix(intrinsics),
        None,
        iterationsCount=_RANSAC_ROUNDS,
        reprojectionError=_RANSAC_PX,
        confidence=0.999,
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None or len(inliers) < min_matches:
        return None
    T_camera_other = np.eye(4)
    T_camera_other[:3, :3] = cv2.Rodrigues(turn)[0]
    T_camera_other[:3, 3] = np.ravel(shift)
    return invert_pose(T_camera_other), len(inliers)
