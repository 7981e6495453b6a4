"""From frames of the SDK to images: pinhole colour, metres, stamps on this machine's clock, numbers with gaps."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.drivers.opencv.clock import StreamClock
from semantic_mapper.drivers.realsense.library import load_realsense
from semantic_mapper.drivers.realsense.stream import FrameSet
from semantic_mapper.errors import CameraError, FrameError
from semantic_mapper.types import CameraIntrinsics, Float64

GRID = 12  # points a side that the lens model is fitted to
MISFIT_PX = 0.5  # so far OpenCV's model of the lens may be off the SDK's
FUTURE_NS = 100_000_000  # a stamp further ahead of now is wrong


def read_intrinsics(told: Any) -> CameraIntrinsics:
    """Intrinsics that the device tells, with OpenCV's coefficients for whatever lens model it has.

    Args:
        told: The SDK's ``intrinsics``. Its models are fitted by their own rays, since one of them is the inverse of
            OpenCV's.

    Raises:
        CameraError: they are impossible, or no five coefficients fit.
    """
    lens: tuple[float, ...] = ()
    if any(told.coeffs) and told.model != load_realsense().distortion.none:
        lens = _fit_lens(told)
    try:
        return CameraIntrinsics(told.fx, told.fy, told.ppx, told.ppy, told.width, told.height, lens)
    except FrameError as error:
        raise CameraError(f"the RealSense's calibration cannot be used: {error}; calibrate the device") from error


def _fit_lens(told: Any) -> tuple[float, ...]:
    """k1 k2 p1 p2 k3, in which OpenCV's model is linear."""
    deproject = load_realsense().rs2_deproject_pixel_to_point
    u, v = np.meshgrid(np.linspace(0, told.width - 1, GRID), np.linspace(0, told.height - 1, GRID))
    pixels = np.stack((u.ravel(), v.ravel()), axis=1)
    rays: Float64 = np.array([deproject(told, pixel.tolist(), 1.0)[:2] for pixel in pixels])
    seen = (pixels - (told.ppx, told.ppy)) / (told.fx, told.fy)
    x, y = rays.T
    r2 = x * x + y * y
    columns_x = (x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3)
    columns_y = (y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3)
    A = np.concatenate((np.stack(columns_x, axis=1), np.stack(columns_y, axis=1)))
    b = (seen - rays).T.ravel()
    lens = np.linalg.lstsq(A, b, rcond=None)[0]
    misfit_px = float(np.abs(A @ lens - b).max()) * max(told.fx, told.fy)
    if misfit_px > MISFIT_PX:
        raise CameraError(
            f"the RealSense's lens model ({told.model}, {list(told.coeffs)}) cannot be undone: OpenCV's is "
            f"{misfit_px:.1f} px off; choose another colour size"
        )
    return tuple(float(value) for value in lens)


class ImageMaker:
    """Makes the images of one camera, over all its connections.

    Args:
        camera_id: Name in the images.
        told: The SDK's ``intrinsics`` of the colour images.

    Attributes:
        passed_over: Images that could not be used: out of order, or stamped in the future.
        reason: Why the last of them could not.
    """

    def __init__(self, camera_id: str, told: Any) -> None:
        self.passed_over = 0
        self.reason = ""
        self._camera_id = camera_id
        self._last: tuple[int, int] | None = None  # number and stamp of the last image
        self._shift: int | None = None  # from the device's numbers to ours; None = not known of this connection
        self.connected(told)

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """Of its images."""
        return self._rectify.intrinsics

    def connected(self, told: Any) -> None:
        """The device counts again from here, and its clock may have started again."""
        self._rectify = Rectifier(read_intrinsics(told))
        self._lens = any(told.coeffs)
        self._shift = None
        self._clock = StreamClock()

    def image(self, frames: FrameSet) -> CameraImage | None:
        """The image of a set; None for one that is not later than the one before, or claims to be of the future."""
        stamp_ns = self._stamp_ns(frames)
        self.reason = ""
        if stamp_ns > time.monotonic_ns() + FUTURE_NS:
            self.reason = "its stamp is in the future: check the clocks of this machine and of the device"
        elif self._last is not None and stamp_ns <= self._last[1]:
            self.reason = "its stamp is not later than that of the image before"
        if self.reason:
            self.passed_over += 1
            return None
        rgb = np.array(frames.color.get_data(), np.uint8)  # a copy: the SDK has few buffers
        depth_m = None
        if frames.depth is not None:
            depth_m = np.multiply(
                np.asarray(frames.depth.get_data()), np.float32(frames.depth.get_units()), dtype=np.float32
            )
        if self._lens:
            rgb = self._rectify(np.ascontiguousarray(rgb[..., ::-1]))
            depth_m = None if depth_m is None else self._rectify.nearest(depth_m)
        number = self._number(int(frames.color.get_frame_number()))
        self._last = (number, stamp_ns)
        return CameraImage(stamp_ns, number, self._camera_id, rgb, depth_m, self.intrinsics)

    def _stamp_ns(self, frames: FrameSet) -> int:
        """When it was captured, on the monotonic clock; the SDK tells milliseconds of the wall clock or its own."""
        told_ns = round(1e6 * frames.color.get_timestamp())
        if frames.color.get_frame_timestamp_domain() == load_realsense().timestamp_domain.hardware_clock:
            return self._clock.stamp_ns(told_ns, frames.arrived_ns)
        return told_ns - time.time_ns() + time.monotonic_ns()

    def _number(self, counted: int) -> int:
        """From 0, with gaps where images were lost."""
        last = -1 if self._last is None else self._last[0]
        if self._shift is None or counted + self._shift <= last:
            self._shift = last + (1 if self._last is None else 2) - counted  # a gap tells that it was away
        return counted + self._shift
