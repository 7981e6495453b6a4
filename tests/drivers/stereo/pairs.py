"""Pictures of a rendered room, and of a printed board, as a stereo pair gives them: side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from research.scenes import TEST_SEEDS, camera_path, make_room, render_view
from semantic_mapper.drivers.calibration import StereoCalibration, save_stereo
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

LEFT = CameraIntrinsics(330.0, 330.0, 239.5, 179.5, 480, 360)
RIGHT = CameraIntrinsics(334.0, 334.0, 242.0, 177.0, 480, 360)
BASELINE_M = 0.12


def T_left_right() -> Float64:  # noqa: N802 - a transform
    """The right camera stands 12 cm aside, a little lower, and is turned by a degree, as cheap pairs are."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.radians((0.6, -1.0, 0.4)))[0]
    T[:3, 3] = (BASELINE_M, 0.002, -0.001)
    return T


def pair(*, swapped: bool = False) -> StereoCalibration:
    return StereoCalibration(LEFT, RIGHT, np.linalg.inv(T_left_right()), swapped)


def write_pair(path: Path, *, swapped: bool = False) -> str:
    save_stereo(path, pair(swapped=swapped), {"made_by": "a test"})
    return str(path)


def room_poses(count: int, seed: int = 0) -> tuple[object, list[Float64]]:
    scene = make_room(TEST_SEEDS[seed])
    return scene, list(camera_path(scene, count, TEST_SEEDS[seed]))


def room_pairs(scene: object, poses: Sequence[Float64]) -> list[UInt8]:
    """(H, 2 W, 3) RGB of each pose of the left camera; a little noise, as sensors have."""
    rng = np.random.default_rng(5)
    found: list[UInt8] = []
    for T in poses:
        left = render_view(scene, LEFT, T).rgb  # type: ignore[arg-type]
        right = render_view(scene, RIGHT, T @ T_left_right()).rgb  # type: ignore[arg-type]
        both = np.hstack((left, right)).astype(np.float32)
        found.append(np.clip(both + rng.normal(0, 1.5, both.shape), 0, 255).astype(np.uint8))
    return found
