"""From messages of the device to images: colours, metres, stamps on this machine's clock, numbers that show losses.

The same code serves the camera and the tests, which replay messages on the host.
"""

from __future__ import annotations

import time
from datetime import timedelta
from typing import Any

import cv2
import numpy as np

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.live import FrameCounter
from semantic_mapper.drivers.oak.devices import load_depthai
from semantic_mapper.errors import CameraError, FrameError
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

DEPTH_UNIT_M = 1e-3  # the stereo node's default
NO_DEPTH = 65535  # beyond what 16 bits hold
ALIGNED_PX = 1.0  # within which intrinsics of depth and colour are the same
MAX_DAMAGED = 30  # images in a row: then it is no accident of the cable
_CLOCK_READINGS = 5


def read_intrinsics(calibration: Any, socket: str, width: int, height: int) -> CameraIntrinsics:
    """Intrinsics of an undistorted image, from a ``dai.CalibrationHandler``; what does not fit the ratio is cropped.

    Raises:
        CameraError: the calibration knows no such camera, or does not fit the image.
    """
    dai = load_depthai()
    try:
        K = np.array(calibration.getCameraIntrinsics(getattr(dai.CameraBoardSocket, socket), width, height))
    except (RuntimeError, IndexError) as error:
        raise CameraError(
            f"the OAK's calibration says nothing of the camera at {socket}: {error}; calibrate the device, name "
            "another socket, or give a file by `calibration`"
        ) from error
    if not (np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0):
        raise CameraError(f"the OAK's calibration of the camera at {socket} is empty: calibrate the device")
    return _pinhole(K, width, height)


def reported_intrinsics(frame: Any) -> CameraIntrinsics | None:
    """Intrinsics that a message carries: the calibration's, after every crop and scaling that the device has made.

    Returns:
        None where it carries none.

    Raises:
        CameraError: they do not fit the image.
    """
    transformation = frame.getTransformation()
    K = np.array(transformation.getIntrinsicMatrix(), np.float64)
    if not transformation.isValid() or np.array_equal(K, np.eye(3)) or not np.isfinite(K).all():
        return None
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        return None
    width, height = transformation.getSize()
    return _pinhole(K, width, height)


def _pinhole(K: Float64, width: int, height: int) -> CameraIntrinsics:
    try:
        return CameraIntrinsics(
            fx=float(K[0, 0]), fy=float(K[1, 1]), cx=float(K[0, 2]), cy=float(K[1, 2]), width=width, height=height
        )
    except FrameError as error:
        raise CameraError(f"the OAK's calibration cannot be used: {error}; calibrate the device") from error


def geometry_trouble(rgb: Any, depth: Any | None) -> str:
    """What two messages say against it that they are undistorted and show the same pixels; empty where nothing."""
    if any(rgb.getTransformation().getDistortionCoefficients()):
        return "the device says that its images are not undistorted: surfaces may bend"
    ours, theirs = reported_intrinsics(rgb), None if depth is None else reported_intrinsics(depth)
    if ours is None or theirs is None:
        return ""
    a, b = (np.array((c.fx, c.fy, c.cx, c.cy, c.width, c.height)) for c in (ours, theirs))
    if np.abs(a - b).max() <= ALIGNED_PX:
        return ""
    return f"depth may not be aligned with colour: the device says {theirs} of the one and {ours} of the other"


def clock_offset_ns() -> int:
    """What to add to a time of DepthAI's host clock to have one of this machine's monotonic clock."""
    dai = load_depthai()
    readings: list[tuple[int, int]] = []
    for _ in range(_CLOCK_READINGS):
        before = time.monotonic_ns()
        theirs = to_ns(dai.Clock.now())
        after = time.monotonic_ns()
        readings.append((after - before, (before + after) // 2 - theirs))
    return min(readings)[1]


def to_ns(moment: timedelta) -> int:
    """A DepthAI time in nanoseconds, exactly."""
    return moment // timedelta(microseconds=1) * 1000


def capture_ns(frame: Any, offset_ns: int) -> int:
    """When the middle of an image was exposed, on this machine's monotonic clock.

    DepthAI keeps the device's clock in step with the host's; ``offset_ns`` is that of ``clock_offset_ns``.
    """
    return to_ns(frame.getTimestamp(load_depthai().CameraExposureOffset.MIDDLE)) + offset_ns


def rgb_pixels(frame: Any) -> UInt8:
    """Colours (H, W, 3) of an image message of any colour format, or grey."""
    kind = load_depthai().ImgFrame.Type.NV12
    if frame.getType() == kind and frame.getPlaneStride() == frame.getWidth() * frame.getHeight():
        # no padding: the same bits as below, in a seventh of the time
        return np.asarray(cv2.cvtColor(frame.getFrame(), cv2.COLOR_YUV2RGB_NV12), np.uint8)
    pixels = frame.getCvFrame()
    code = cv2.COLOR_GRAY2RGB if pixels.ndim == 2 else cv2.COLOR_BGR2RGB
    return np.asarray(cv2.cvtColor(pixels, code), np.uint8)


def depth_metres(frame: Any) -> Float32:
    """Depth (H, W) of a depth message, 0 where nothing was measured.

    Raises:
        CameraError: it is no depth image.
    """
    raw = frame.getFrame()
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise CameraError(f"the OAK's depth must be 16 bits a pixel, got {raw.dtype} {raw.shape}")
    depth_m = np.multiply(raw, np.float32(DEPTH_UNIT_M), dtype=np.float32)
    depth_m[raw == NO_DEPTH] = 0
    return depth_m


class ImageMaker:
    """Makes the images of one camera, over all its connections.

    Args:
        camera_id: Name in the images.
        intrinsics: Of its images.
        fps: Rate, by which the images that are lost while the device is away are counted.
    """

    def __init__(self, camera_id: str, intrinsics: CameraIntrinsics, fps: float) -> None:
        self.passed_over = 0  # images that could not be used: doubles, out of order, stamps of the future, damaged
        self.reason = ""  # why the last of them could not
        self._damaged = 0  # in a row
        self._camera_id = camera_id
        self._intrinsics = intrinsics
        self._counter = FrameCounter(fps)
        self._clock_ns = clock_offset_ns()

    def reconnected(self, intrinsics: CameraIntrinsics) -> None:
        """The device counts again from here."""
        self._counter.restart()
        self._intrinsics = intrinsics

    def image(self, rgb: Any, depth: Any | None) -> CameraImage | None:
        """The image of a colour message and its depth.

        Args:
            rgb, depth: ``dai.ImgFrame`` each.

        Returns:
            None for one that is not later than the one before, that claims to be of the future, or that is damaged.

        Raises:
            CameraError: it is not what was requested of the device, or one of many in a row that are damaged.
        """
        stamp_ns = capture_ns(rgb, self._clock_ns)
        if refusal := self._counter.refusal(stamp_ns):
            return self._pass_over(refusal)
        try:
            pixels = rgb_pixels(rgb)
            depth_m = None if depth is None else depth_metres(depth)
        except (RuntimeError, cv2.error) as error:  # DepthAI's, of a message that is not what it says
            self._damaged += 1
            if self._damaged < MAX_DAMAGED:
                return self._pass_over(f"it cannot be read: {error}")
            raise CameraError(f"images of camera '{self._camera_id}' cannot be read: {error}") from error
        self._damaged = 0
        self._expect_size("colour image", pixels)
        if depth_m is not None:
            self._expect_size("depth", depth_m)
        return CameraImage(
            stamp_ns=stamp_ns,
            seq=self._counter.number(rgb.getSequenceNum(), stamp_ns),
            camera_id=self._camera_id,
            rgb=pixels,
            depth_m=depth_m,
            intrinsics=self._intrinsics,
        )

    def _pass_over(self, reason: str) -> None:
        self.passed_over += 1
        self.reason = reason

    def _expect_size(self, what: str, pixels: UInt8 | Float32) -> None:
        height, width = pixels.shape[:2]
        if (width, height) != (self._intrinsics.width, self._intrinsics.height):
            raise CameraError(
                f"the {what} of camera '{self._camera_id}' is {width}x{height}, but "
                f"{self._intrinsics.width}x{self._intrinsics.height} was requested: choose a `width` and `height` that "
                "this device can give"
            )
