"""An OAK as a camera: messages of the device become images with colours, metres and stamps on this machine's clock."""

import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import cv2
import msgspec
import numpy as np

from semantic_mapper.drivers.base import CameraImage, as_camera_error
from semantic_mapper.drivers.live import SLICE_S, Device, LiveCamera, first_of
from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.oak.device import Sources, capture_ns, clock_offset_ns, connect_device, synced_queue, take
from semantic_mapper.drivers.oak.devices import list_devices as list_devices
from semantic_mapper.drivers.oak.devices import load_depthai
from semantic_mapper.drivers.oak.odometry import Odometry
from semantic_mapper.errors import CameraError, FrameError, PoseError
from semantic_mapper.geometry import rotation_vector
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float32, UInt8

QUEUE = 4  # images that wait where the reader is slow; the oldest gives way, which is a gap
ODOMETRY_WAIT_S = 0.3  # how long an image waits for its pose; then it goes without
DEPTH_UNIT_M = 1e-3  # the stereo node's default
NO_DEPTH = 65535  # beyond what 16 bits hold
ALIGNED_PX, ALIGNED_M, ALIGNED_DEG = 1.0, 0.005, 0.3  # within which depth and colour are seen by the same camera


def open_camera(config: Config, camera_id: str, connect: Callable[[Config], Sources] = connect_device) -> LiveCamera:
    """The camera of a config, opened when it is entered. ``connect`` gives the sources of each connection."""
    known = config

    def open_device(stopping: threading.Event) -> OakDevice:
        nonlocal known
        sources = connect(known)
        # The next connection is to the same device, whatever else is plugged in.
        known = msgspec.structs.replace(config, device=sources.address)
        return OakDevice(sources, config, camera_id, stopping)

    return LiveCamera(camera_id, open_device)


class OakDevice(Device):
    """One connection; raises ``CameraError`` where it does not start, or gives no image that can be used."""

    def __init__(self, sources: Sources, config: Config, camera_id: str, stopping: threading.Event) -> None:
        self._sources = sources
        self._config = config
        self._camera_id = camera_id
        self._clock_ns = clock_offset_ns()
        self._intrinsics: CameraIntrinsics | None = None
        self._notes = list(sources.notes)
        self._odometry: Odometry | None = None
        fix = "try a smaller `width`, `height` or `fps`, calibrate the device, or give a file by `calibration`"
        kinds = (RuntimeError, IndexError, FrameError, PoseError)  # DepthAI's, and of intrinsics and extrinsics
        with ExitStack() as undo, as_camera_error(f"{sources.name} cannot be used", fix, *kinds):
            undo.callback(self.close)
            self._groups = synced_queue(sources.pipeline, sources.outputs, 0.5 / config.fps, QUEUE)
            if sources.odometry is not None:
                self._odometry = Odometry(sources.pipeline, sources.odometry, config.fps)
            sources.pipeline.start()
            # Images that wait for their poses.
            self._waiting = deque([first_of(lambda: self._next(SLICE_S), stopping, sources.name)])
            undo.pop_all()
        cameras = {camera_id: self._waiting[0].intrinsics}
        self.info = StreamInfo(sources.name, cameras, frame_hz=config.fps, metadata={**sources.metadata})

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Device``."""
        trouble = () if self._odometry is None or not self._odometry.trouble else (self._odometry.trouble,)
        return tuple(f"camera '{self._camera_id}': {text}" for text in (*self._notes, *trouble))

    def read(self) -> CameraImage | None:
        """As of ``Device``; of a camera with odometry, once the pose is known or late."""
        if self._odometry is not None:
            self._odometry.check()
        if (done := self._with_pose()) is not None:
            return done
        image = self._next(SLICE_S / 10 if self._waiting else SLICE_S)
        if image is not None:
            self._waiting.append(image)
        return self._with_pose()

    def close(self) -> None:
        """As of ``Device``."""
        self._sources.close()
        if self._odometry is not None:
            self._odometry.close()

    def _with_pose(self) -> CameraImage | None:
        """The oldest image that waits, as it can go on; None without one, or where it has to wait for its pose."""
        if not self._waiting:
            return None
        image, odometry = self._waiting[0], self._odometry
        if odometry is not None:
            late = time.monotonic_ns() - image.stamp_ns > ODOMETRY_WAIT_S * 1e9
            found = odometry.at(image.stamp_ns)
            if found in ("empty", "stale") and not late:
                return None
            image = replace(image, tracks_itself=True, own_pose=None if isinstance(found, str) else found)
        self._waiting.popleft()
        return image

    def _next(self, timeout_s: float) -> CameraImage | None:
        """The next image, without its pose; None where it does not come within the time, or is damaged."""
        try:
            group = take(self._groups, timeout_s)
        except EOFError:
            group = None
        if group is None:
            if self._sources.pipeline.isRunning():
                return None
            raise CameraError(f"{self._sources.name} has gone (unplugged, without power, or its firmware has crashed)")
        rgb, depth = group["rgb"], group["depth"] if "depth" in self._sources.outputs else None
        try:
            pixels = rgb_pixels(rgb)
            depth_m = None if depth is None else depth_metres(depth)
        except (RuntimeError, cv2.error):  # DepthAI's, of a message that is not what it says
            return None
        lens = self._intrinsics
        if lens is None:
            size = self._config.width, self._config.height
            lens = reported_intrinsics(rgb) or read_intrinsics(self._sources.calibration, self._config.rgb, *size)
            self._intrinsics = lens
            self._notes += geometry_troubles(rgb, depth)
        for image in (pixels, depth_m):
            if image is not None and image.shape[:2] != (lens.height, lens.width):
                raise CameraError(
                    f"an image of camera '{self._camera_id}' is {image.shape[1]}x{image.shape[0]}, but {lens.width}x"
                    f"{lens.height} was requested: choose a `width` and `height` that this device can give"
                )
        stamp_ns = capture_ns(rgb, self._clock_ns)
        return CameraImage(stamp_ns, rgb.getSequenceNum(), self._camera_id, pixels, depth_m, lens)


def read_intrinsics(calibration: Any, socket: str, width: int, height: int) -> CameraIntrinsics:
    """Intrinsics of an undistorted image, from a ``dai.CalibrationHandler``; what does not fit the ratio is cropped.

    Raises RuntimeError, FrameError: the calibration knows no such camera, or does not fit the image.
    """
    # `getCameraIntrinsics` of another ratio is for an image with bars; `requestOutput` fills the image and crops.
    K, *size = calibration.getDefaultIntrinsics(getattr(load_depthai().CameraBoardSocket, socket))
    scale = max(width / size[0], height / size[1])
    K = scale * np.array(K)
    K[:2, 2] -= (scale * np.array(size) - (width, height)) / 2
    return CameraIntrinsics(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), width, height)


def reported_intrinsics(frame: Any) -> CameraIntrinsics | None:
    """Intrinsics that a message carries: the calibration's, after every crop and scaling that the device has made.

    None where it carries none. Raises FrameError: they do not fit the image. CameraError: it is mirrored.
    """
    transformation = frame.getTransformation()
    K = np.array(transformation.getIntrinsicMatrix(), np.float64)
    focal = np.linalg.norm(K[:2, :2], axis=1)  # also of a picture that was turned or mirrored
    if not transformation.isValid() or np.array_equal(K, np.eye(3)) or not focal.all():
        return None
    if np.linalg.det(K[:2, :2]) < 0:
        raise CameraError("the OAK mirrors its pictures, and so the map: leave its image orientation alone")
    return CameraIntrinsics(float(focal[0]), float(focal[1]), float(K[0, 2]), float(K[1, 2]), *transformation.getSize())


def geometry_troubles(rgb: Any, depth: Any | None) -> list[str]:
    """What two messages say against it that they are undistorted and show the same pixels."""
    first, ours = rgb.getTransformation(), reported_intrinsics(rgb)
    theirs = None if depth is None else reported_intrinsics(depth)
    if any(first.getDistortionCoefficients()):
        return ["the device says that its images are not undistorted: surfaces may bend"]
    troubles: list[str] = []
    if ours and np.abs(np.array(first.getIntrinsicMatrix())[:2, :2] - np.diag((ours.fx, ours.fy))).max() > ALIGNED_PX:
        troubles.append("the device turns its pictures: poses of its own tracking are of those before")
    if depth is None or ours is None or theirs is None:
        return troubles
    a, b = (np.array((k.fx, k.fy, k.cx, k.cy, k.width, k.height)) for k in (ours, theirs))
    misaligned = "depth may not be aligned with colour: the device says"
    if np.abs(a - b).max() > ALIGNED_PX:
        troubles.append(f"{misaligned} {theirs} of the one and {ours} of the other")
    try:  # not compared by isAlignedTo
        meter = load_depthai().LengthUnit.METER
        T = np.array(first.getExtrinsicsTransformationMatrixTo(depth.getTransformation(), sourceUnit=meter))
    except RuntimeError:  # one of them does not say where it is
        return troubles
    apart_m, apart_deg = np.linalg.norm(T[:3, 3]), np.degrees(np.linalg.norm(rotation_vector(T)))
    if apart_m > ALIGNED_M or apart_deg > ALIGNED_DEG:
        troubles.append(f"{misaligned} that they are {1000 * apart_m:.0f} mm and {apart_deg:.1f} degrees apart")
    return troubles


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
    """Depth (H, W) of a depth message, 0 where nothing was measured; ``CameraError``: another message."""
    raw = frame.getFrame()
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise CameraError(f"the OAK's depth must be 16 bits a pixel, got {raw.dtype} {raw.shape}")
    depth_m = np.multiply(raw, np.float32(DEPTH_UNIT_M), dtype=np.float32)
    depth_m[raw == NO_DEPTH] = 0
    return depth_m
