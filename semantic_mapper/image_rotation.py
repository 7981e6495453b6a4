"""Frames of a camera that is mounted on its side, or upside down, turned upright: the field knows upright rooms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from semantic_mapper.errors import FrameError
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame


def rotate_intrinsics(intrinsics: CameraIntrinsics, quarters: int) -> CameraIntrinsics:
    """Intrinsics of an image that was turned clockwise by this many quarters of a full turn.

    Raises:
        FrameError: an image that is not rectified.
    """
    if intrinsics.distorted:
        raise FrameError("an image with lens distortion cannot be turned by itself; rectify it first")
    k = intrinsics
    for _ in range(quarters % 4):
        k = CameraIntrinsics(k.fy, k.fx, k.height - 1 - k.cy, k.cx, k.height, k.width)
    return k


def rotate_frame(frame: PosedFrame, quarters: int) -> PosedFrame:
    """The frame with its images turned clockwise by this many quarters of a full turn, and its pose and intrinsics with
    them: every pixel keeps its ray in the world.

    Raises:
        FrameError: an image that is not rectified.
    """
    quarters %= 4
    if quarters == 0:
        return frame
    return replace(
        frame,
        rgb=np.ascontiguousarray(np.rot90(frame.rgb, -quarters)),
        depth_m=None if frame.depth_m is None else np.ascontiguousarray(np.rot90(frame.depth_m, -quarters)),
        label=None if frame.label is None else np.ascontiguousarray(np.rot90(frame.label, -quarters)),
        depth_sigma_m=(
            None if frame.depth_sigma_m is None else np.ascontiguousarray(np.rot90(frame.depth_sigma_m, -quarters))
        ),
        intrinsics=rotate_intrinsics(frame.intrinsics, quarters),
        T_world_camera=frame.T_world_camera @ _turn(quarters),
    )


def _turn(quarters: int) -> Float64:
    """(4, 4): turning the image clockwise turns the camera's axes the other way about its optical axis."""
    T = np.eye(4)
    T[:2, :2] = np.linalg.matrix_power(np.array([[0.0, 1.0], [-1.0, 0.0]]), quarters)
    return T
