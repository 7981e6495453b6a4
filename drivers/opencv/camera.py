"""Video files and streams as cameras: RTSP, HTTP and what else FFmpeg reads by a URL."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from semantic_mapper.drivers.base import Camera, CameraImage
from semantic_mapper.drivers.calibration import Rectifier, guess_intrinsics, require_calibration
from semantic_mapper.drivers.live import NOT_CALIBRATED, LiveCamera, RawImage, StreamClock, nominal_hz
from semantic_mapper.drivers.opencv.config import Config
from semantic_mapper.errors import CameraError
from semantic_mapper.log_events import get_logger
from semantic_mapper.plain_text import without_secrets
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, UInt8

_log = get_logger(__name__)


def open_camera(config: Config, camera_id: str = "camera") -> Camera:
    """A camera that is opened when it is entered; see ``drivers/registry.py``.

    Raises:
        CameraError: no source or no calibration is named.
        ConfigError: the calibration cannot be read.
    """
    if not config.source:
        raise CameraError(f'camera \'{camera_id}\': no video is named; give source = "FILE" or source = "rtsp://..."')
    shown = without_secrets(config.source)
    measured = require_calibration(config.calibration, config.uncalibrated, f"video {shown}")
    if "://" not in config.source:
        return VideoFile(config, camera_id, measured)
    metadata = {"driver": "opencv", "url": shown, "stamps": config.stamps}
    return LiveCamera(camera_id, partial(StreamDevice, config), measured, config.stall_s, metadata)


class VideoFile(Camera):
    """Plays a file once.

    Args:
        config: With the file's name.
        camera_id: What its images are called.
        measured: Calibration of the camera that took it; None: guessed, said in ``warnings``.
    """

    can_wait = True

    def __init__(self, config: Config, camera_id: str, measured: CameraIntrinsics | None) -> None:
        super().__init__(camera_id)
        self._config = config
        self._measured = measured
        self._capture: cv2.VideoCapture | None = None
        self._rectify: Rectifier | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Camera``."""
        return () if self._measured is not None else (NOT_CALIBRATED,)

    def __enter__(self) -> Self:
        """Open the file.

        Raises:
            CameraError: missing, no video, or of another size than was calibrated.
        """
        source = self._config.source
        if not Path(source).is_file():
            raise CameraError(f"{source}: no such video file")
        capture = cv2.VideoCapture(source)
        size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        if not capture.isOpened() or min(size) <= 0:
            capture.release()
            raise CameraError(f"{source}: is no video that OpenCV can read; is it complete, and its codec common?")
        measured = self._measured or guess_intrinsics(*size)
        if size != (measured.width, measured.height):
            capture.release()
            raise CameraError(
                f"{source}: has images of {size[0]}x{size[1]}, but the camera was calibrated at "
                f"{measured.width}x{measured.height}; calibrate for the size of the video"
            )
        rectify = Rectifier(measured)
        count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        self._info = StreamInfo(
            source=f"video {Path(source).name}",
            cameras={self._camera_id: rectify.intrinsics},
            frame_count=count if count > 0 else None,
            frame_hz=nominal_hz(capture.get(cv2.CAP_PROP_FPS)),
            metadata={"driver": "opencv", "stamps": "time within the file"},
        )
        self._capture, self._rectify = capture, rectify
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        if self._capture is not None:
            self._capture.release()
            self._capture = None

    def __iter__(self) -> Iterator[CameraImage]:
        """Image after image; ends with the file."""
        if self._capture is None or self._rectify is None:
            raise CameraError(f"{self._config.source}: is not open")
        began = time.monotonic()
        first_ns: int | None = None
        seq = -1
        for seq, (within_ns, bgr) in enumerate(_captures(self._capture)):
            self._last_poll_time = time.monotonic()
            first_ns = within_ns if first_ns is None else first_ns
            since_ns = within_ns - first_ns
            if self._config.pace == "recorded":
                self._stopping.wait(max(0.0, began + since_ns / 1e9 - time.monotonic()))
            if self._stopping.is_set():
                return
            yield CameraImage(since_ns, seq, self._camera_id, self._rectify(bgr), None, self._rectify.intrinsics)
        expected = self.info.frame_count or 0
        if seq + 1 < expected - 1:  # some containers count one too many
            _log.warning("video_ended_early", file=self._config.source, images=seq + 1, expected=expected)


def _captures(capture: cv2.VideoCapture) -> Iterator[tuple[int, UInt8]]:
    """Time within the file and image, until there are no more."""
    while capture.isOpened():
        good, bgr = capture.read()
        if not good or bgr is None:
            return
        within_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
        yield round(within_ms * 1e6) if math.isfinite(within_ms) else 0, np.asarray(bgr, np.uint8)


class StreamDevice:
    """A ``Device`` (drivers/live.py) over a URL.

    Raises:
        CameraError: it cannot be connected to within the time, or holds no video.
    """

    def __init__(self, config: Config) -> None:
        self.description = f"stream {without_secrets(config.source)}"
        self._config = config
        self._clock = StreamClock()
        timeouts = {
            cv2.CAP_PROP_OPEN_TIMEOUT_MSEC: config.open_timeout_s,
            cv2.CAP_PROP_READ_TIMEOUT_MSEC: config.stall_s,
        }
        parameters = [number for name, seconds in timeouts.items() for number in (name, round(1000 * seconds))]
        self._capture = cv2.VideoCapture(config.source, cv2.CAP_FFMPEG, parameters)
        self.size = (int(self._get(cv2.CAP_PROP_FRAME_WIDTH)), int(self._get(cv2.CAP_PROP_FRAME_HEIGHT)))
        self.frame_hz = nominal_hz(self._get(cv2.CAP_PROP_FPS))
        if not self._capture.isOpened() or min(self.size) <= 0:
            self._capture.release()
            raise CameraError(
                f"{self.description}: cannot be opened within {config.open_timeout_s:g} s; is the address right, the "
                "sender on, and the network between?"
            )

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Device``."""
        if self._config.stamps == "arrival" or self._clock.trustworthy:
            return ()
        return (f"{self.description}: its own clock does not keep time; images are stamped when they arrive",)

    def read(self) -> RawImage | None:
        """As of ``Device``."""
        try:
            good, bgr = self._capture.read()
        except cv2.error as error:
            raise CameraError(f"{self.description}: {error}") from error
        arrived_ns = time.monotonic_ns()
        if not good or bgr is None:  # FFmpeg has tried again by itself; a stream that has ended gives no more
            raise CameraError(f"{self.description}: has ended or broken off")
        image = np.asarray(bgr, np.uint8)
        if image.shape != (self.size[1], self.size[0], 3):
            raise CameraError(f"{self.description}: has changed the size of its images")
        stamp_ns = arrived_ns
        if self._config.stamps == "container":
            stamp_ns = self._clock.stamp_ns(round(self._get(cv2.CAP_PROP_POS_MSEC) * 1e6), arrived_ns)
        return RawImage(stamp_ns - round(self._config.latency_s * 1e9), image)

    def close(self) -> None:
        """As of ``Device``."""
        self._capture.release()

    def _get(self, name: int) -> float:
        value = float(self._capture.get(name))
        return value if np.isfinite(value) else 0.0
