"""A video file as a ``Camera``: every image of it, with the time within it, to its end."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.calibration import Rectifier, guess_intrinsics
from semantic_mapper.drivers.opencv.config import Config
from semantic_mapper.drivers.opencv.stream import nominal_hz
from semantic_mapper.errors import CameraError
from semantic_mapper.log_events import get_logger
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics, UInt8

_log = get_logger(__name__)


class VideoFile:
    """Plays a file once.

    Args:
        config: With the file's name.
        camera_id: What its images are called.
        measured: Calibration of the camera that took it; None: guessed, said in ``warnings``.
    """

    def __init__(self, config: Config, camera_id: str, measured: CameraIntrinsics | None) -> None:
        self._config = config
        self._camera_id = camera_id
        self._measured = measured
        self._capture: cv2.VideoCapture | None = None
        self._rectify: Rectifier | None = None
        self._info: StreamInfo | None = None
        self._stopping = threading.Event()
        self._last_poll_time = 0.0

    @property
    def info(self) -> StreamInfo:
        """As of ``Camera``."""
        if self._info is None:
            raise CameraError(f"{self._config.source}: is not open yet")
        return self._info

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Camera``."""
        if self._measured is None:
            return ("not calibrated: the intrinsics are a guess, good for calibrating only",)
        return ()

    @property
    def can_wait(self) -> bool:
        """As of ``Camera``."""
        return True

    @property
    def last_poll_time(self) -> float:
        """As of ``Camera``."""
        return self._last_poll_time

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
        """Image after image; ends with the file.

        Raises:
            CameraError: not open.
        """
        if self._capture is None or self._rectify is None:
            raise CameraError(f"{self._config.source}: is not open")
        began = time.monotonic()
        first_ns: int | None = None
        seq = -1
        for seq, (within_ns, bgr) in enumerate(_shots(self._capture)):
            self._last_poll_time = time.monotonic()
            first_ns = within_ns if first_ns is None else first_ns
            since_ns = within_ns - first_ns
            if self._config.pace == "recorded":
                self._stopping.wait(max(0.0, began + since_ns / 1e9 - time.monotonic()))
            if self._stopping.is_set():
                return
            stamp_ns = self._config.start_ns + since_ns
            yield CameraImage(stamp_ns, seq, self._camera_id, self._rectify(bgr), None, self._rectify.intrinsics)
        expected = self.info.frame_count or 0
        if seq + 1 < expected - 1:  # some containers tell one too many
            _log.warning("video_ended_early", file=self._config.source, images=seq + 1, expected=expected)

    def stop(self) -> None:
        """As of ``Camera``."""
        self._stopping.set()


def _shots(capture: cv2.VideoCapture) -> Iterator[tuple[int, UInt8]]:
    """Time within the file and image, until there are no more."""
    while capture.isOpened():
        good, bgr = capture.read()
        if not good or bgr is None:
            return
        within_ms = capture.get(cv2.CAP_PROP_POS_MSEC)
        yield round(within_ms * 1e6) if math.isfinite(within_ms) else 0, np.asarray(bgr, np.uint8)
