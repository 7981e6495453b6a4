"""One open stream: RTSP, HTTP and what else FFmpeg reads by a URL."""

from __future__ import annotations

import time

import cv2
import numpy as np

from semantic_mapper.drivers.live import Shot
from semantic_mapper.drivers.opencv.clock import StreamClock
from semantic_mapper.drivers.opencv.config import Config
from semantic_mapper.errors import CameraError
from semantic_mapper.redaction import without_secrets

MIN_HZ = 1e-3  # of a film or camera: one divided by it is still a time


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

    def read(self) -> Shot | None:
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
        return Shot(stamp_ns - round(self._config.latency_s * 1e9), image)

    def close(self) -> None:
        """As of ``Device``."""
        self._capture.release()

    def _get(self, name: int) -> float:
        value = float(self._capture.get(name))
        return value if np.isfinite(value) else 0.0


def nominal_hz(told: float) -> float:
    """A rate as a container or a device tells it; 0 for what cannot be one."""
    return told if MIN_HZ <= told <= 1000 else 0.0
