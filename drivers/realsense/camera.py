"""A RealSense as a camera: sensors opened, frames synced, aligned, and made images on this machine's clock."""

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from typing import Any

import numpy as np

from semantic_mapper.drivers.base import CameraImage, as_camera_error
from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.drivers.live import SLICE_S, Device, LiveCamera, StreamClock, first_of
from semantic_mapper.drivers.realsense.config import Config
from semantic_mapper.drivers.realsense.devices import about, find_device, load_realsense
from semantic_mapper.drivers.realsense.devices import list_devices as list_devices
from semantic_mapper.errors import CameraError, FrameError
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, Float64

QUEUE = 4  # synced sets that wait; the oldest gives way
_SHOWN = 12  # modes that an error names
GRID = 12  # points a side that the lens model is fitted to
MISFIT_PX = 0.5  # so far OpenCV's model of the lens may be off the SDK's
_SLOW_USB = ("1.", "2.")


def open_camera(config: Config, camera_id: str, find: Callable[[str], Any] = find_device) -> LiveCamera:
    """The camera of a config, opened when it is entered. ``find`` gives the SDK's device by serial number."""
    serial = config.device

    def open_device(stopping: threading.Event) -> RealSenseDevice:
        nonlocal serial
        found = find(serial)
        serial = about(found, "serial_number")  # the next connection is to the same one
        return RealSenseDevice(found, config, camera_id, stopping)

    return LiveCamera(camera_id, open_device)


class RealSenseDevice(Device):
    """One connection to the SDK's device; raises ``CameraError`` where it does not offer what the config asks for."""

    def __init__(self, device: Any, config: Config, camera_id: str, stopping: threading.Event) -> None:
        rs = self._rs = load_realsense()
        self._device = device
        self._config = config
        self._camera_id = camera_id
        serial, usb = about(device, "serial_number"), about(device, "usb_type_descriptor")
        self._name = f"{about(device, 'name') or 'RealSense'} {serial}".rstrip()
        self._slow = f"USB {usb}, too slow for its images: use a USB 3 port and cable" if usb[:2] in _SLOW_USB else ""
        self._sensors: list[Any] = []
        self._syncer = rs.syncer(QUEUE)
        self._align = rs.align(rs.stream.color)
        self._clock = StreamClock()
        self._rectify: Rectifier | None = None
        fix = "end the program that uses it, plug it in again, or calibrate it"
        with ExitStack() as undo, as_camera_error(f"{self._name}: cannot be opened", fix, RuntimeError, FrameError):
            undo.callback(self.close)
            self._open_sensors()
            self._first: CameraImage | None = first_of(self._next, stopping, self._name)
            undo.pop_all()
        metadata = {"driver": "realsense", "device": serial}
        cameras = {camera_id: self._first.intrinsics}
        self.info = StreamInfo(self._name, cameras, frame_hz=float(config.fps), metadata=metadata)

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Device``."""
        return (f"camera '{self._camera_id}' is connected at {self._slow}",) if self._slow else ()

    def read(self) -> CameraImage | None:
        """As of ``Device``."""
        first, self._first = self._first, None
        with as_camera_error(f"{self._name} fails", "plug it in again", RuntimeError):
            return first or self._next()

    def close(self) -> None:
        """As of ``Device``."""
        for sensor in self._sensors:
            with suppress(RuntimeError):  # the link is dead: there is nothing to stop
                sensor.stop()
            with suppress(RuntimeError):
                sensor.close()
        self._sensors = []

    def _open_sensors(self) -> None:
        """Raises CameraError, or RuntimeError: the SDK's."""
        rs, config = self._rs, self._config
        wanted = [(rs.stream.color, rs.format.rgb8, config.width, config.height)]
        if config.depth:
            wanted.append((rs.stream.depth, rs.format.z16, config.depth_width, config.depth_height))
        sensors = list(self._device.query_sensors())
        chosen: dict[int, list[Any]] = {}  # profiles by sensor: those of one sensor are opened together
        for mode in wanted:
            index, profile = self._profile(sensors, *mode)
            chosen.setdefault(index, []).append(profile)
        for index, profiles in chosen.items():
            sensor = sensors[index]
            if sensor.supports(rs.option.emitter_enabled):
                sensor.set_option(rs.option.emitter_enabled, float(config.ir_dots))
            if config.preset != "as-is" and sensor.supports(rs.option.visual_preset):
                preset = int(getattr(rs.rs400_visual_preset, config.preset))
                sensor.set_option(rs.option.visual_preset, float(preset))
            sensor.open(profiles)
            self._sensors.append(sensor)
            sensor.start(self._syncer)

    def _profile(self, sensors: list[Any], stream: Any, format_: Any, width: int, height: int) -> tuple[int, Any]:
        """Index of the sensor and its mode. Raises CameraError, with the modes that there are."""
        offered: set[tuple[int, int, int]] = set()
        for index, sensor in enumerate(sensors):
            for profile in sensor.get_stream_profiles():
                if profile.stream_type() != stream or profile.format() != format_:
                    continue
                video = profile.as_video_stream_profile()
                mode = (video.width(), video.height(), profile.fps())
                if mode == (width, height, self._config.fps):
                    return index, profile
                offered.add(mode)
        name = str(stream).rpartition(".")[2]
        there = ", ".join(f"{w}x{h} at {fps}" for w, h, fps in sorted(offered, reverse=True)[:_SHOWN])
        raise CameraError(
            f"{self._name}: gives no {name} of {width}x{height} at {self._config.fps} images/s, but "
            f"{there or f'no {name} at all'}; set `fps`, `width`, `height`, `depth_width` and `depth_height` so"
        )

    def _next(self) -> CameraImage | None:
        """None where no frame comes in a while, or one of the set is missing, as where it came late."""
        came, frames = self._syncer.try_wait_for_frames(max(1, round(1000 * SLICE_S)))
        arrived_ns = time.monotonic_ns()
        if not came:
            if self._device.is_connected():
                return None
            raise CameraError(f"{self._name} has gone (unplugged, or without power)")
        if not frames.get_color_frame() or (self._config.depth and not frames.get_depth_frame()):
            return None
        if self._config.depth:  # in the pixels of colour
            frames = self._align.process(frames)
        color = frames.get_color_frame()
        bgr, depth_m = np.ascontiguousarray(np.asarray(color.get_data())[..., ::-1]), None
        if self._config.depth:
            depth = frames.get_depth_frame()
            depth_m = np.multiply(np.asarray(depth.get_data()), np.float32(depth.get_units()), dtype=np.float32)
        if self._rectify is None:
            self._rectify = Rectifier(read_intrinsics(color.profile.as_video_stream_profile().get_intrinsics()))
        rgb = self._rectify(bgr)
        depth_m = None if depth_m is None else self._rectify.nearest(depth_m)
        number, stamp_ns = int(color.get_frame_number()), self._stamp_ns(color, arrived_ns)
        return CameraImage(stamp_ns, number, self._camera_id, rgb, depth_m, self._rectify.intrinsics)

    def _stamp_ns(self, color: Any, arrived_ns: int) -> int:
        """When it was captured, on the monotonic clock; the SDK gives milliseconds of the wall clock or its own."""
        sent_ns = round(1e6 * color.get_timestamp())
        if color.get_frame_timestamp_domain() == self._rs.timestamp_domain.hardware_clock:
            return self._clock.stamp_ns(sent_ns, arrived_ns)
        return sent_ns - time.time_ns() + time.monotonic_ns()


def read_intrinsics(reported: Any) -> CameraIntrinsics:
    """Of the SDK's ``intrinsics``, with OpenCV's coefficients for whatever lens model it has, fitted by its own rays,
    since one of them is the inverse of OpenCV's. ``FrameError``: impossible ones; ``CameraError``: none fit."""
    lens: tuple[float, ...] = ()
    if any(reported.coeffs) and reported.model != load_realsense().distortion.none:
        lens = _fit_lens(reported)
    k = (reported.fx, reported.fy, reported.ppx, reported.ppy)
    return CameraIntrinsics(*k, reported.width, reported.height, lens)


def _fit_lens(reported: Any) -> tuple[float, ...]:
    """k1 k2 p1 p2 k3, in which OpenCV's model is linear."""
    deproject = load_realsense().rs2_deproject_pixel_to_point
    u, v = np.meshgrid(np.linspace(0, reported.width - 1, GRID), np.linspace(0, reported.height - 1, GRID))
    pixels = np.stack((u.ravel(), v.ravel()), axis=1)
    rays: Float64 = np.array([deproject(reported, pixel.tolist(), 1.0)[:2] for pixel in pixels])
    seen = (pixels - (reported.ppx, reported.ppy)) / (reported.fx, reported.fy)
    x, y = rays.T
    r2 = x * x + y * y
    columns_x = (x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3)
    columns_y = (y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3)
    A = np.concatenate((np.stack(columns_x, axis=1), np.stack(columns_y, axis=1)))
    b = (seen - rays).T.ravel()
    lens = np.linalg.lstsq(A, b, rcond=None)[0]
    misfit_px = float(np.abs(A @ lens - b).max()) * max(reported.fx, reported.fy)
    if misfit_px > MISFIT_PX:
        raise CameraError(
            f"the RealSense's lens model ({reported.model}, {list(reported.coeffs)}) cannot be undone: OpenCV's is "
            f"{misfit_px:.1f} px off; choose another colour size"
        )
    return tuple(float(value) for value in lens)
