"""How far a camera has turned between two images, from the shift of the picture as a whole."""

from __future__ import annotations

import cv2
import numpy as np

from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

_LEAST_RESPONSE = 0.05  # of the peak, 1 = the same picture; those that overlap well give 0.1 to 0.7


def find_turn(rgb: UInt8, before: UInt8, intrinsics: CameraIntrinsics) -> Float64 | None:
    """T_before_camera (4, 4), about its x and y axes; None where the pictures share too little.

    Phase correlation: brightness and contrast do not count. A first guess only: what lies near shifts by more where the
    camera moves, too.

    Args:
        rgb: (H, W, 3) of this image.
        before: (H, W, 3) of the earlier one.
        intrinsics: Of both.
    """
    earlier, now = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(np.float32) for image in (before, rgb))
    window = cv2.createHanningWindow((intrinsics.width, intrinsics.height), cv2.CV_32F)
    (right, down), response = cv2.phaseCorrelate(earlier, now, window)
    if response < _LEAST_RESPONSE:
        return None
    ahead = np.array((-right / intrinsics.fx, -down / intrinsics.fy, 1.0))  # its view, in the earlier axes
    ahead /= np.linalg.norm(ahead)
    axis = np.cross((0.0, 0.0, 1.0), ahead)
    sine = float(np.linalg.norm(axis))
    T = np.eye(4)
    if sine > 1e-9:
        T[:3, :3] = np.asarray(cv2.Rodrigues(axis / sine * np.arctan2(sine, ahead[2]))[0])
    return T
