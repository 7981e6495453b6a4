"""Which way is up in a model: where the upright edges of walls, doors and furniture meet."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from semantic_mapper.geometry import camera_matrix
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

MIN_LENGTH = 0.06  # of an edge, of the image's width
CONE_DEG = 40.0  # about the first guess: people hold cameras askew, and look down
TOLERANCE_DEG = 1.5  # between an edge and the direction
MIN_EDGES, MIN_SUPPORT = 40, 0.12  # of all edges' length: fewer upright ones are no evidence


def find_edges(gray: UInt8) -> Float64:
    """Straight edges (N, 4) of a picture, pixels u v u v."""
    found = cv2.createLineSegmentDetector().detect(gray)[0]
    if found is None:
        return np.zeros((0, 4))
    edges = np.asarray(found, np.float64).reshape(-1, 4)
    return edges[np.hypot(edges[:, 2] - edges[:, 0], edges[:, 3] - edges[:, 1]) > MIN_LENGTH * gray.shape[1]]


def vertical(
    edges: Mapping[int, Float64], poses: Mapping[int, Float64], intrinsics: CameraIntrinsics, guess: Float64
) -> Float64 | None:
    """Up (3,) in the world; None where too few edges agree.

    An edge and its camera span a plane, in which the edge's direction lies. The direction is sought that lies in the
    planes of most edges, by their length.

    Args:
        edges: Of some frames, as ``find_edges`` gives them.
        poses: T_world_camera of frames; edges of others do not count.
        intrinsics: Of all frames, with distortion.
        guess: (3,) rough up.
    """
    K, lens = camera_matrix(intrinsics), np.array(intrinsics.distortion or (0.0,) * 4)
    normals: list[Float64] = []
    weights: list[Float64] = []
    for index, rows in edges.items():
        if index not in poses or not len(rows):
            continue
        flat = cv2.undistortPoints(rows.reshape(-1, 1, 2), K, lens).reshape(-1, 2, 2)
        rays = np.concatenate((flat, np.ones((*flat.shape[:2], 1))), axis=2)
        across = np.cross(rays[:, 0], rays[:, 1])
        length = np.linalg.norm(across, axis=1)
        good = length > 1e-9
        normals.append((across[good] / length[good, None]) @ poses[index][:3, :3].T)
        weights.append(length[good])
    if not normals or sum(map(len, normals)) < MIN_EDGES:
        return None
    planes, weight = np.concatenate(normals), np.concatenate(weights)
    best = guess / np.linalg.norm(guess)
    for cone, step in ((CONE_DEG, 1.5), (1.5, 0.25)):
        directions = _cone(best, cone, step)
        support = ((np.abs(planes @ directions.T) < np.sin(np.radians(TOLERANCE_DEG))) * weight[:, None]).sum(axis=0)
        best = directions[int(np.argmax(support))]
    for _ in range(5):
        near = np.abs(planes @ best) < np.sin(np.radians(TOLERANCE_DEG))
        if near.sum() < 8:
            return None
        _, axes = np.linalg.eigh((planes[near] * weight[near, None]).T @ planes[near])
        best = axes[:, 0] * np.sign(axes[:, 0] @ best)
    near = np.abs(planes @ best) < np.sin(np.radians(TOLERANCE_DEG))
    return best if weight[near].sum() > MIN_SUPPORT * weight.sum() else None


def _cone(axis: Float64, half_deg: float, step_deg: float) -> Float64:
    """Unit directions (N, 3) within an angle of an axis, about a step apart; the axis comes first."""
    side = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    rows = [axis]
    for tilt in np.radians(np.arange(step_deg, half_deg + 1e-9, step_deg)):
        count = max(6, int(np.ceil(2 * np.pi * np.sin(tilt) / np.radians(step_deg))))
        turn = np.arange(count) * 2 * np.pi / count
        ring = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other
        rows += list(np.cos(tilt) * axis + np.sin(tilt) * ring)
    return np.stack(rows)
