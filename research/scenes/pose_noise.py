"""Poses as odometry would give them: a random walk away from the truth, with loop closures."""

from __future__ import annotations

import cv2
import numpy as np

from research.scenes.config import SUITE_VERSION, PoseNoiseConfig
from semantic_mapper.geometry import interpolate_pose, invert_pose, rotation_vector
from semantic_mapper.types import Float64

_POSE_STREAM = 3  # number of the random stream; rooms, paths and shots use others


def drifting_poses(poses: Float64, seed: int, config: PoseNoiseConfig) -> Float64:
    """Exact T_world_camera (N, 4, 4) -> drifted ones, deterministic in the arguments. The first pose is exact.

    Each step's motion is off by ``translation_share`` and ``rotation_deg_per_m`` of its way (standard deviations);
    errors add up. Every ``closure_frames`` the accumulated error is cut by ``closure_share`` at once, which makes the
    jump that a loop closure makes.
    """
    rng = np.random.default_rng((SUITE_VERSION, seed, _POSE_STREAM))
    error = np.eye(4)  # T_drifted_true, in world axes
    out = [poses[0].copy()]
    jump_at = int(rng.integers(1, config.closure_frames + 1)) if config.closure_frames > 0 else 0
    for k in range(1, len(poses)):
        step = invert_pose(poses[k - 1]) @ poses[k]
        way = float(np.linalg.norm(step[:3, 3])) + 0.35 * float(np.linalg.norm(rotation_vector(step)))
        turn = np.radians(config.rotation_deg_per_m) * np.sqrt(way) * rng.standard_normal(3)
        shift = config.translation_share * np.sqrt(way) * rng.standard_normal(3)
        error = error @ _about(poses[k], turn, shift)
        if config.closure_frames > 0 and k % config.closure_frames == jump_at % config.closure_frames:
            error = interpolate_pose(np.eye(4), error, 1.0 - config.closure_share)
        out.append(error @ poses[k])
    return np.array(out)


def _about(pose: Float64, turn: Float64, shift: Float64) -> Float64:
    """A small motion of the camera at ``pose``, (4, 4) in world axes."""
    local = np.eye(4)
    local[:3, :3] = cv2.Rodrigues(turn)[0]
    local[:3, 3] = shift
    return pose @ local @ invert_pose(pose)
