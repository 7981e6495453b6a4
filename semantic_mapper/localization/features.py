"""Features of an image with their depth, which of two images' features match, and a pose from those (PnP with RANSAC).

Two kinds: ORB corners for images in a row (3 ms at 320x240), and SIFT features for a place that is seen again from
elsewhere, in other light (30 ms). Both are rotation invariant. Everything is deterministic.
"""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from semantic_mapper.geometry import camera_matrix, invert_pose, make_pose
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

Matches = NDArray[np.int64]

_SIFT_LENGTH = 128
_SIFT_SCALE = 512.0  # of a unit vector, so that its elements fill a byte; squared distances stay exact in float32
_SIFT_CONTRAST = 0.015  # low, so that dark images have features, too
_SIFT_RATIO = 0.8  # nearest to second nearest distance, at most
_RANSAC_ROUNDS = 300
_LEAST = 4  # points that PnP needs


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """N features."""

    pixels: Float64  # (N, 2) float64 as (u, v)
    depth_m: Float64  # (N,) float64, 0 = none
    descriptors: UInt8  # (N, 32) uint8 of ORB, or (N, 128) uint8 of SIFT

    def points(self, intrinsics: CameraIntrinsics) -> Float64:
        """(N, 3) in the camera's axes, metres; 0 where there is no depth."""
        x = (self.pixels[:, 0] - intrinsics.cx) / intrinsics.fx
        y = (self.pixels[:, 1] - intrinsics.cy) / intrinsics.fy
        return np.stack((x, y, np.ones_like(x)), axis=1) * self.depth_m[:, None]


def find_features(rgb: UInt8, depth_m: Float32, count: int) -> Features:
    """The strongest ``count`` ORB corners of an image and their depth (same size, 0 = none)."""
    detector: Any = cv2.ORB.create(nfeatures=count, fastThreshold=10)
    corners, descriptors = detector.detectAndCompute(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), None)
    if descriptors is None or not len(corners):
        return Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, 32), np.uint8))
    pixels = np.array([corner.pt for corner in corners], np.float64)
    return Features(pixels, _depth_at(depth_m, pixels), np.asarray(descriptors, np.uint8))


def find_place_features(rgb: UInt8, depth_m: Float32, count: int, width: int = 320) -> Features:
    """The strongest ``count`` SIFT features of an image, made ``width`` pixels wide where it is wider, and their depth:
    RootSIFT in bytes, pixels of ``rgb``, which is as big as ``depth_m``."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, width / gray.shape[1])
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    detector: Any = cv2.SIFT.create(nfeatures=count, contrastThreshold=_SIFT_CONTRAST)
    found, descriptors = detector.detectAndCompute(gray, None)
    if descriptors is None or not len(found):
        return Features(np.zeros((0, 2)), np.zeros(0), np.zeros((0, _SIFT_LENGTH), np.uint8))
    pixels = (np.array([f.pt for f in found], np.float64) + 0.5) / scale - 0.5
    share = np.sqrt(descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9))
    return Features(pixels, _depth_at(depth_m, pixels), np.clip(np.rint(share * _SIFT_SCALE), 0, 255).astype(np.uint8))


def match_features(ours: UInt8, theirs: UInt8) -> Matches:
    """Pairs of alike descriptors (M, 2) int64, as (number of ours, of theirs), each in one pair at most: of ORB the
    mutually nearest ones, of SIFT those whose second nearest is clearly further off."""
    if len(ours) < 2 or len(theirs) < 2:
        return np.zeros((0, 2), np.int64)
    if ours.shape[1] != _SIFT_LENGTH:
        orb: Any = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True)
        return np.array([(m.queryIdx, m.trainIdx) for m in orb.match(ours, theirs)], np.int64).reshape(-1, 2)
    # Whole numbers below 2^24: exact in float32, in whatever order they are added. Twice as fast as cv2.BFMatcher.
    mine, other = ours.astype(np.float32), theirs.astype(np.float32)
    square = (mine**2).sum(axis=1)[:, None] + (other**2).sum(axis=1) - 2 * (mine @ other.T)
    nearest = square.argmin(axis=1)
    rows = np.arange(len(mine))
    best = square[rows, nearest]
    square[rows, nearest] = np.inf
    good = np.flatnonzero(best < _SIFT_RATIO**2 * square.min(axis=1))
    good = good[np.lexsort((good, best[good]))]  # the most alike first
    _, first = np.unique(nearest[good], return_index=True)
    good = np.sort(good[first])
    return np.stack((good, nearest[good]), axis=1).astype(np.int64)


def pose_from_points(
    points: Float64, pixels: Float64, intrinsics: CameraIntrinsics, min_inliers: int, reprojection_px: float
) -> tuple[Float64, Matches] | None:
    """Pose of a camera that sees points (M, 3) at pixels (M, 2): ``T_points_camera`` (4, 4), and which ones agree (K,);
    None where fewer than ``min_inliers`` do."""
    if len(points) < max(min_inliers, _LEAST):
        return None
    found, turn, shift, inliers = cv2.solvePnPRansac(
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(pixels, np.float64),
        camera_matrix(intrinsics),
        None,
        iterationsCount=_RANSAC_ROUNDS,
        reprojectionError=reprojection_px,
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,  # SQPNP raises where drawn points coincide
    )
    if not found or inliers is None or len(inliers) < min_inliers:
        return None
    chosen = np.ravel(inliers).astype(np.int64)
    fit, seen = (np.ascontiguousarray(values[chosen], np.float64) for values in (points, pixels))
    turn, shift = cv2.solvePnPRefineLM(fit, seen, camera_matrix(intrinsics), None, turn, shift)
    T_camera_points = make_pose(turn, shift)
    if not np.isfinite(T_camera_points).all():
        return None
    return invert_pose(T_camera_points), chosen


def pose_from_features(
    image: Features, other: Features, intrinsics: CameraIntrinsics, min_matches: int, reprojection_px: float = 2.0
) -> tuple[Float64, int] | None:
    """Where the camera was in the axes of another image, ``T_other_camera`` (4, 4), by that one's depth, and how many
    features say so; None where fewer than ``min_matches`` agree."""
    deep = np.flatnonzero(other.depth_m > 0)
    if len(deep) < min_matches or len(image.pixels) < min_matches:
        return None
    pairs = match_features(image.descriptors, other.descriptors[deep])
    points = other.points(intrinsics)[deep[pairs[:, 1]]]
    found = pose_from_points(points, image.pixels[pairs[:, 0]], intrinsics, min_matches, reprojection_px)
    return None if found is None else (found[0], len(found[1]))


def _depth_at(depth_m: Float32, pixels: Float64) -> Float64:
    nearest = np.rint(pixels).astype(np.int64)
    rows = np.clip(nearest[:, 1], 0, depth_m.shape[0] - 1)
    columns = np.clip(nearest[:, 0], 0, depth_m.shape[1] - 1)
    return depth_m[rows, columns].astype(np.float64)
