"""Video files and streams as cameras: RTSP, HTTP and what else FFmpeg reads by a URL."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Self

import cv2
import msgspec

from semantic_mapper.drivers.base import Camera, CameraImage
from semantic_mapper.drivers.calibration import require_calibration
from semantic_mapper.drivers.live import NOT_CALIBRATED, CaptureDevice, LiveCamera, StreamClock
from semantic_mapper.drivers.opencv.config import Config
from semantic_mapper.drivers.registry import FoundCamera
from semantic_mapper.errors import CameraError
from semantic_mapper.log_events import get_logger
from semantic_mapper.plain_text import without_secrets
from semantic_mapper.types import CameraIntrinsics

_log = get_logger(__name__)


def list_devices() -> list[FoundCamera]:
    """None: files and URLs are named, not found."""
    return []


def open_camera(config: Config, camera_id: str = "camera") -> Camera:
    """A camera that is opened when it is entered; see ``drivers/registry.py``."""
    if not config.source:
        raise CameraError(f'camera \'{camera_id}\': no video is named; give source = "FILE" or source = "rtsp://..."')
    measured = require_calibration(config.calibration, config.uncalibrated, f"video {without_secrets(config.source)}")
    if "://" not in config.source:
        return VideoFile(config, camera_id, measured)
    return LiveCamera(camera_id, lambda _: _StreamDevice(config, camera_id, measured), config.stall_s)


class _FileDevice(CaptureDevice):
    def _stamp_ns(self, arrived_ns: int) -> int:
        """Time within the file."""
        return round(self.get(cv2.CAP_PROP_POS_MSEC) * 1e6)


class VideoFile(Camera):
    """Plays a file once; its camera's calibration is ``measured``, or a guess, which ``warnings`` says."""

    can_wait = True

    def __init__(self, config: Config, camera_id: str, measured: CameraIntrinsics | None) -> None:
        super().__init__(camera_id)
        self._config = config
        self._measured = measured
        self._device: _FileDevice | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Camera``."""
        return () if self._measured is not None else (NOT_CALIBRATED,)

    def __enter__(self) -> Self:
        """Open the file; raises ``CameraError`` where it is missing, no video, or of another size than calibrated."""
        path = Path(self._config.source)
        if not path.is_file():
            raise CameraError(f"{path}: no such video file")
        capture = cv2.VideoCapture(str(path))
        metadata = {"driver": "opencv", "stamps": "time within the file"}
        self._device = _FileDevice(self._camera_id, f"video {path.name}", capture, self._measured, metadata)
        count = round(self._device.get(cv2.CAP_PROP_FRAME_COUNT))
        self._info = msgspec.structs.replace(self._device.info, frame_count=count if count > 0 else None)
        return self

    def __exit__(self, *error: object) -> None:
        self.stop()
        if self._device is not None:
            self._device.close()

    def __iter__(self) -> Iterator[CameraImage]:
        """Image after image; ends with the file."""
        expected = self.info.frame_count or 0
        began = time.monotonic()
        first_ns: int | None = None
        seq = -1
        while self._device is not None and (image := self._device.read()) is not None:
            self._last_poll_time = time.monotonic()
            seq = image.seq
            first_ns = image.stamp_ns if first_ns is None else first_ns
            since_ns = image.stamp_ns - first_ns
            if self._config.pace == "recorded":
                self._stopping.wait(max(0.0, began + since_ns / 1e9 - time.monotonic()))
            if self._stopping.is_set():
                return
            yield replace(image, stamp_ns=since_ns)
        if seq + 1 < expected - 1:  # some containers count one too many
            _log.warning("video_ended_early", file=self._config.source, images=seq + 1, expected=expected)


class _StreamDevice(CaptureDevice):
    """A URL; raises ``CameraError`` where it cannot be connected to within the time, or holds no video."""

    def __init__(self, config: Config, camera_id: str, measured: CameraIntrinsics | None) -> None:
        shown = without_secrets(config.source)
        timeouts = {
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: config.open_timeout_s,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC: config.stall_s,
        }
        parameters = [number for name, seconds in timeouts.items() for number in (name, round(1000 * seconds))]
        capture = cv2.VideoCapture(config.source, cv2.CAP_FFMPEG, parameters)
        if not capture.isOpened():
            raise CameraError(
                f"stream {shown}: cannot be opened within {config.open_timeout_s:g} s; is the address right, the "
                "sender on, and the network between?"
            )
        metadata = {"driver": "opencv", "url": shown, "stamps": config.stamps}
        super().__init__(camera_id, f"stream {shown}", capture, measured, metadata)
        self._config = config
        self._clock = StreamClock()

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Device``."""
        if self._clock.trustworthy:
            return super().warnings
        clock = f"{self.info.source}: its own clock does not keep time; images are stamped when they arrive"
        return (*super().warnings, clock)

    def _nothing(self) -> None:  # FFmpeg has tried again by itself; a stream that has ended gives no more
        raise CameraError(f"{self.info.source}: has ended or broken off")

    def _stamp_ns(self, arrived_ns: int) -> int:
        stamp_ns = arrived_ns
        if self._config.stamps == "container":
            stamp_ns = self._clock.stamp_ns(round(self.get(cv2.CAP_PROP_POS_MSEC) * 1e6), arrived_ns)
        return stamp_ns - round(self._config.latency_s * 1e9)
