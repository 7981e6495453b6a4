"""One connection to a RealSense: sensors opened, frames synced, aligned, and made images on this machine's clock."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.calibration import Rectifier
from semantic_mapper.drivers.live import FrameCounter, StreamClock, StreamEnded
from semantic_mapper.drivers.realsense.config import Config
from semantic_mapper.drivers.realsense.devices import about, load_realsense
from semantic_mapper.errors import CameraError, FrameError
from semantic_mapper.types import CameraIntrinsics, Float64

QUEUE = 4  # synced sets that wait; the oldest gives way
_SHOWN = 12  # modes that an error names
START_S, STALL_S = 10.0, 3.0  # without an image for so long after opening, later: it has stalled
GRID = 12  # points a side that the lens model is fitted to
MISFIT_PX = 0.5  # so far OpenCV's model of the lens may be off the SDK's
_SLOW_USB = ("1.", "2.")


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """Frames of one moment, of the SDK: ``depth`` is in the pixels of ``color``; None where none was requested.

    ``arrived_ns`` is when they were read, on the monotonic clock.
    """

    color: Any
    depth: Any | None
    arrived_ns: int


class Stream:
    """The frames of one connection, until ``close``.

    Args:
        device: The SDK's.
        config: Of the camera.

    Attributes:
        name: Of the device, for people; ``serial``: by which it is found again.
        notes: What does not work as it should, as far as one knows at once.

    Raises:
        CameraError: it does not offer what the config asks for, or cannot be opened.
    """

    def __init__(self, device: Any, config: Config) -> None:
        rs = self._rs = load_realsense()
        self._device = device
        self._config = config
        self.serial = about(device, rs.camera_info.serial_number)
        self.name = f"{about(device, rs.camera_info.name) or 'RealSense'} {self.serial}".rstrip()
        usb = about(device, rs.camera_info.usb_type_descriptor)
        slow = f"it is connected at USB {usb}, too slow for its images: use a USB 3 port and cable"
        self.notes: tuple[str, ...] = (slow,) if usb.startswith(_SLOW_USB) else ()
        wanted = [(rs.stream.color, rs.format.rgb8, config.width, config.height)]
        if config.depth:
            wanted.append((rs.stream.depth, rs.format.z16, config.depth_width, config.depth_height))
        self._sensors: list[Any] = []
        self._syncer = rs.syncer(QUEUE)
        self._align = rs.align(rs.stream.color)
        self._heard = time.monotonic()
        self._patience_s = START_S
        try:
            sensors = list(device.query_sensors())
            chosen: dict[int, list[Any]] = {}  # profiles by sensor: those of one sensor are opened together
            for mode in wanted:
                index, profile = self._profile(sensors, *mode)
                chosen.setdefault(index, []).append(profile)
            for index, profiles in chosen.items():
                self._set_options(sensors[index])
                sensors[index].open(profiles)
                self._sensors.append(sensors[index])
                sensors[index].start(self._syncer)
        except RuntimeError as error:
            self.close()
            raise CameraError(
                f"{self.name}: cannot be opened: {error}; end the program that uses it, or plug it in again"
            ) from error
        except CameraError:
            self.close()
            raise

    def read(self, timeout_s: float) -> FrameSet | None:
        """The next frames of one moment; None where they do not come within the time.

        Raises:
            StreamEnded: the device has gone, or has given nothing for ``STALL_S`` (``START_S`` before the first).
        """
        try:
            came, frames = self._syncer.try_wait_for_frames(max(1, round(1000 * timeout_s)))
            arrived_ns = time.monotonic_ns()
            found = self._complete(frames, arrived_ns) if came else None
        except RuntimeError as error:  # the SDK's
            raise StreamEnded(f"it fails: {error}") from error
        now = time.monotonic()
        if found is not None:
            self._heard, self._patience_s = now, STALL_S
            return found
        if not came and not self._device.is_connected():
            raise StreamEnded("it has gone (unplugged, or without power)")
        if now - self._heard > self._patience_s:
            what = "image with depth" if self._config.depth else "image"
            raise StreamEnded(f"it has given no {what} for {self._patience_s:g} s")
        return None

    def close(self) -> None:
        """Stop the sensors; a device that has gone already is no error."""
        for sensor in self._sensors:
            with suppress(RuntimeError):  # the link is dead: there is nothing to stop
                sensor.stop()
            with suppress(RuntimeError):
                sensor.close()
        self._sensors = []

    def _complete(self, frames: Any, arrived_ns: int) -> FrameSet | None:
        """None of a set in which one frame is missing, as the syncer gives where one came late."""
        color, depth = frames.get_color_frame(), frames.get_depth_frame()
        if not self._config.depth:
            return FrameSet(color, None, arrived_ns) if color else None
        if not color or not depth:
            return None
        aligned = self._align.process(frames)
        return FrameSet(aligned.get_color_frame(), aligned.get_depth_frame(), arrived_ns)

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
            f"{self.name}: gives no {name} of {width}x{height} at {self._config.fps} images/s, but "
            f"{there or f'no {name} at all'}; set `fps`, `width`, `height`, `depth_width` and `depth_height` so"
        )

    def _set_options(self, sensor: Any) -> None:
        """What a sensor does not have is left as it is; raises RuntimeError, the SDK's."""
        option, preset = self._rs.option, self._config.preset
        if sensor.supports(option.emitter_enabled):
            sensor.set_option(option.emitter_enabled, float(self._config.ir_dots))
        if preset != "as-is" and sensor.supports(option.visual_preset):
            sensor.set_option(option.visual_preset, float(int(getattr(self._rs.rs400_visual_preset, preset))))


def read_intrinsics(reported: Any) -> CameraIntrinsics:
    """Intrinsics that the device reports, with OpenCV's coefficients for whatever lens model it has.

    Args:
        reported: The SDK's ``intrinsics``. Its models are fitted by their own rays, since one of them is the inverse of
            OpenCV's.

    Raises:
        CameraError: they are impossible, or no five coefficients fit.
    """
    lens: tuple[float, ...] = ()
    if any(reported.coeffs) and reported.model != load_realsense().distortion.none:
        lens = _fit_lens(reported)
    try:
        return CameraIntrinsics(
            reported.fx, reported.fy, reported.ppx, reported.ppy, reported.width, reported.height, lens
        )
    except FrameError as error:
        raise CameraError(f"the RealSense's calibration cannot be used: {error}; calibrate the device") from error


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


class ImageMaker:
    """Makes the images of one camera, over all its connections.

    Args:
        camera_id: Name in the images.
        reported: The SDK's ``intrinsics`` of the colour images.
        hz: Rate of the images.

    Attributes:
        passed_over: Images that could not be used: out of order, or stamped in the future.
        reason: Why the last of them could not.
    """

    def __init__(self, camera_id: str, reported: Any, hz: float) -> None:
        self.passed_over = 0
        self.reason = ""
        self._camera_id = camera_id
        self._counter = FrameCounter(hz)
        self.connected(reported)

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """Of its images."""
        return self._rectify.intrinsics

    def connected(self, reported: Any) -> None:
        """The device counts again from here, and its clock may have started again."""
        self._rectify = Rectifier(read_intrinsics(reported))
        self._lens = any(reported.coeffs)
        self._counter.restart()
        self._clock = StreamClock()

    def image(self, frames: FrameSet) -> CameraImage | None:
        """The image of a set; None for one that is not later than the one before, or claims to be of the future."""
        stamp_ns = self._stamp_ns(frames)
        self.reason = self._counter.refusal(stamp_ns)
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
        number = self._counter.number(int(frames.color.get_frame_number()), stamp_ns)
        return CameraImage(stamp_ns, number, self._camera_id, rgb, depth_m, self.intrinsics)

    def _stamp_ns(self, frames: FrameSet) -> int:
        """When it was captured, on the monotonic clock; the SDK gives milliseconds of the wall clock or its own."""
        sent_ns = round(1e6 * frames.color.get_timestamp())
        if frames.color.get_frame_timestamp_domain() == load_realsense().timestamp_domain.hardware_clock:
            return self._clock.stamp_ns(sent_ns, frames.arrived_ns)
        return sent_ns - time.time_ns() + time.monotonic_ns()
