"""A RealSense of the SDK's own: ``software_device``, whose sensors give the frames that a test hands them.

Everything behind the list of connected devices is the SDK: sensors, profiles, options, syncer, alignment, lens models.
A software device does not show in that list (pyrealsense2 2.59), so tests hand it to the camera.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from semantic_mapper.drivers.realsense.devices import load_realsense
from semantic_mapper.types import Float64, UInt8

WIDTH, HEIGHT, FPS = 96, 72, 30
SERIAL = "0123"


def lens(width: int, height: int, focal: float, model: str = "none", coeffs: tuple[float, ...] = (0.0,) * 5) -> Any:
    rs = load_realsense()
    told = rs.intrinsics()
    told.width, told.height = width, height
    told.fx = told.fy = focal
    told.ppx, told.ppy = (width - 1) / 2, (height - 1) / 2
    told.model, told.coeffs = getattr(rs.distortion, model), list(coeffs)
    return told


class SoftDevice:
    """One device, plugged in until ``gone``.

    Args:
        color, depth: Intrinsics of the two sensors; no depth sensor where ``depth`` is None.
        T_color_depth: (4, 4).
        usb: Of the connection.
    """

    def __init__(
        self, color: Any | None = None, depth: Any | None = None, T_color_depth: Float64 | None = None, usb: str = "3.2"
    ) -> None:
        rs = load_realsense()
        self.device = rs.software_device()
        for what, text in (("name", "Soft D435"), ("serial_number", SERIAL), ("usb_type_descriptor", usb)):
            self.device.register_info(getattr(rs.camera_info, what), text)
        self.color_sensor, self.depth_sensor = self.device.add_sensor("RGB"), self.device.add_sensor("Stereo")
        self.color_lens = color or lens(WIDTH, HEIGHT, 66.0)
        self.depth_lens = depth or lens(WIDTH, HEIGHT, 66.0)
        self.color = self.color_sensor.add_video_stream(_stream(rs.stream.color, rs.format.rgb8, 1, 3, self.color_lens))
        self.depth = self.depth_sensor.add_video_stream(_stream(rs.stream.depth, rs.format.z16, 2, 2, self.depth_lens))
        self.depth_sensor.add_read_only_option(rs.option.depth_units, 0.001)
        for option in (rs.option.visual_preset, rs.option.emitter_enabled):
            span = rs.option_range()
            span.min, span.max, span.default, span.step = 0.0, 10.0, 0.0, 1.0
            self.depth_sensor.add_option(option, span, True)
        T = np.eye(4) if T_color_depth is None else T_color_depth
        extrinsics = rs.extrinsics()
        extrinsics.rotation, extrinsics.translation = T[:3, :3].T.ravel().tolist(), T[:3, 3].tolist()
        self.depth.register_extrinsics_to(self.color, extrinsics)
        self.device.create_matcher(rs.matchers.default)
        self.gone = False
        self._number = 0
        self._keep: list[Any] = []  # pixels that the SDK still reads

    def __getattr__(self, name: str) -> Any:
        return getattr(self.device, name)

    def is_connected(self) -> bool:
        return not self.gone

    def give(self, rgb: UInt8, units: np.ndarray | None, ts_ms: float, domain: str = "global_time") -> None:
        """One colour image and one depth image, in millimetres."""
        rs = load_realsense()
        parts = [(self.color_sensor, self.color, rgb, 3)]
        if units is not None:
            parts.append((self.depth_sensor, self.depth, units, 2))
        for sensor, profile, pixels, size in parts:
            frame = rs.software_video_frame()
            frame.pixels = np.ascontiguousarray(pixels)
            frame.stride, frame.bpp = size * pixels.shape[1], size
            frame.timestamp, frame.domain = ts_ms, getattr(rs.timestamp_domain, domain)
            frame.frame_number = self._number
            frame.profile = profile.as_video_stream_profile()
            # Else the SDK takes number / stamp for the rate, by which its syncer decides whether to wait for depth.
            sensor.set_metadata(rs.frame_metadata_value.actual_fps, 1000 * FPS)
            if size == 2:
                frame.depth_units = 0.001
            self._keep = [*self._keep[-16:], frame]
            sensor.on_video_frame(frame)
        self._number += 1


class Feed:
    """Gives frames at 30 Hz until it is left.

    Args:
        make: Colour and depth of the image of a number.
        device: That gives them; another may take its place, None = nothing comes.
        domain: Whose clock their stamps are of.
    """

    def __init__(
        self, make: Callable[[int], tuple[UInt8, np.ndarray | None]], device: SoftDevice, domain: str = "global_time"
    ) -> None:
        self.device: SoftDevice | None = device
        self.ahead_ms = 0.0  # of the true time
        self.captured_ns: list[int] = []  # of the image of each number, on the monotonic clock
        self._make, self._domain = make, domain
        self._began_ns = time.monotonic_ns() - 1_000_000_000  # the device has been on for a second
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Feed:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(1 / FPS):
            device = self.device
            if device is None or not device.color_sensor.get_active_streams():
                continue
            captured_ns = time.monotonic_ns() - 20_000_000
            self.captured_ns.append(captured_ns)
            zero_ns = self._began_ns if self._domain == "hardware_clock" else time.monotonic_ns() - time.time_ns()
            device.give(*self._make(number), (captured_ns - zero_ns) / 1e6 + self.ahead_ms, self._domain)
            number += 1


def _stream(kind: Any, format_: Any, uid: int, size: int, told: Any) -> Any:
    made = load_realsense().video_stream()
    made.type, made.index, made.uid, made.fmt, made.bpp = kind, 0, uid, format_, size
    made.width, made.height, made.fps, made.intrinsics = told.width, told.height, FPS, told
    return made
