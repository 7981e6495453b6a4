from __future__ import annotations

import cv2
import numpy as np
import pytest

from semantic_mapper.drivers.poses.image_turn import find_turn
from semantic_mapper.geometry import camera_matrix, invert_pose, rotation_vector
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

from .images import rigid

LENS = CameraIntrinsics(264.0, 264.0, 159.5, 119.5, 320, 240)


def seen(T: Float64, gain: float = 1.0) -> UInt8:
    """A far wall with blots on it, as seen by a camera that has turned."""
    blots = np.random.default_rng(3).integers(0, 255, (48, 64, 3)).astype(np.uint8)
    wall = cv2.resize(blots, (960, 720), interpolation=cv2.INTER_CUBIC)
    K = camera_matrix(LENS)
    wide = K.copy()
    wide[:2, 2] = 479.5, 359.5
    image = cv2.warpPerspective(wall, K @ T[:3, :3].T @ np.linalg.inv(wide), (320, 240))
    return np.clip(image * gain, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("turn", [(0.0, 0.14, 0.0), (0.06, -0.1, 0.0), (0.0, 0.0, 0.0)])
def test_the_turn_between_two_images_is_found_whatever_their_brightness(turn: tuple[float, float, float]) -> None:
    T = rigid(turn)
    found = find_turn(seen(T, gain=0.5), seen(np.eye(4)), LENS)
    assert found is not None and not found[:3, 3].any()
    assert np.rad2deg(np.linalg.norm(rotation_vector(invert_pose(found) @ T))) < 1.5
