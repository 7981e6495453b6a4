"""One connection to a RealSense: sensors opened, frames synced and aligned, the end told."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from semantic_mapper.drivers.realsense.config import Config
from semantic_mapper.drivers.realsense.devices import about
from semantic_mapper.drivers.realsense.library import load_realsense
from semantic_mapper.errors import CameraError

QUEUE = 4  # synced sets that wait; the oldest gives way
_SHOWN = 12  # modes that an error names
_SLOW_USB = ("1.", "2.")


class StreamEnded(Exception):  # noqa: N818 -- an event, not an error: the camera is gone and may come back
    """The device has gone, or gives nothing any more; the text says which."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameSet:
    """Frames of one moment, of the SDK: ``depth`` is in the pixels of ``color``; None where none was asked for.

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
        notes: What does not work as it should, as far as one can tell at once.

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
        self._patience_s = config.start_s
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
        """The next frames of one moment; None where there are none within the time.

        Raises:
            StreamEnded: the device has gone, or has given nothing for ``stall_s`` (``start_s`` before the first).
        """
        try:
            came, frames = self._syncer.try_wait_for_frames(max(1, round(1000 * timeout_s)))
            arrived_ns = time.monotonic_ns()
            found = self._complete(frames, arrived_ns) if came else None
        except RuntimeError as error:  # the SDK's
            raise StreamEnded(f"it fails: {error}") from error
        now = time.monotonic()
        if found is not None:
            self._heard, self._patience_s = now, self._config.stall_s
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
