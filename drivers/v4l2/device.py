"""One open V4L2 device: requested size, rate and pixel format, and what it gives instead is read back."""

from __future__ import annotations

import errno
import time
from pathlib import Path

import cv2
import numpy as np

from semantic_mapper.drivers.live import Shot
from semantic_mapper.drivers.opencv.stream import nominal_hz
from semantic_mapper.drivers.v4l2 import ioctls
from semantic_mapper.drivers.v4l2.config import Config
from semantic_mapper.drivers.v4l2.controls import apply_controls
from semantic_mapper.drivers.v4l2.listing import SHOWN_FORMATS
from semantic_mapper.errors import CameraError

OLDEST_STAMP_S = 10.0  # a buffer is never older; a stamp that is comes from another clock
AHEAD_S = 0.1  # so far a driver may foretell the end of an exposure
RATE_TOLERANCE = 0.02  # 29.97 is 30


class V4l2Device:
    """A ``Device`` (drivers/live.py) over ``cv2.VideoCapture``.

    Args:
        path: Of the device, best a link by its id.
        config: What to ask of it.
        size: Width and height to ask for; None = as the device has it.

    Raises:
        CameraError: it is not there, may not be opened, is in use, or gives no images.
    """

    def __init__(self, path: Path, config: Config, size: tuple[int, int] | None) -> None:
        self._path = path
        who, formats = _examine(path)
        self.description = f"V4L2 {who.card} at {path}"
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_V4L2)
        if not self._capture.isOpened():
            raise CameraError(f"{self.description}: cannot be opened for streaming; is another program using it?")
        try:
            self._negotiate(config, size, formats)
            self._warnings += apply_controls(path, config)
        except OSError as error:
            self._capture.release()
            raise CameraError(f"{self.description}: went away while it was opened ({error.strerror})") from error
        self._clock_trouble = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Device``."""
        clock = (self._clock_trouble,) if self._clock_trouble else ()
        return tuple(f"{self.description}: {trouble}" for trouble in (*self._warnings, *clock))

    def read(self) -> Shot | None:
        """As of ``Device``."""
        try:
            good, bgr = self._capture.read()
        except cv2.error as error:
            raise CameraError(f"{self.description}: {error}") from error
        arrived_ns = time.monotonic_ns()
        if not good or bgr is None:
            if not self._path.exists():
                raise CameraError(f"{self.description}: is gone; plug it in again")
            return None
        image = np.asarray(bgr, np.uint8)
        if image.shape != (self.size[1], self.size[0], 3):
            return None
        return Shot(self._stamp_ns(arrived_ns), image)

    def close(self) -> None:
        """As of ``Device``."""
        self._capture.release()

    def _negotiate(self, config: Config, size: tuple[int, int] | None, formats: tuple[str, ...]) -> None:
        """Ask, then read back: a device takes what it cannot do for a wish, and says nothing."""
        capture = self._capture
        if config.fourcc:
            capture.set(cv2.CAP_PROP_FOURCC, cv2.VideoWriter.fourcc(*config.fourcc))
        if size is not None:
            capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
            capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
        capture.set(cv2.CAP_PROP_FPS, config.fps)
        self.size = (int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT)))
        self.frame_hz = nominal_hz(float(capture.get(cv2.CAP_PROP_FPS)))
        self._warnings: tuple[str, ...] = ()
        given = ioctls.fourcc_text(int(capture.get(cv2.CAP_PROP_FOURCC)))
        if config.fourcc and given != config.fourcc:
            more = ", ..." if len(formats) > SHOWN_FORMATS else ""
            offer = f"; it offers {', '.join(formats[:SHOWN_FORMATS])}{more}" if formats else ""
            self._warnings += (f"requested pixels as {config.fourcc}, it gives {given}{offer}",)
        if abs(self.frame_hz - config.fps) > RATE_TOLERANCE * config.fps:
            self._warnings += (
                f"asked for {config.fps:g} images/s, it gives {self.frame_hz:g} at this size and format",
            )

    def _stamp_ns(self, arrived_ns: int) -> int:
        """When the buffer was filled, as the kernel says; else when it arrived here, which ``warnings`` tells."""
        stamp_ns = round(self._capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
        if -AHEAD_S * 1e9 < arrived_ns - stamp_ns < OLDEST_STAMP_S * 1e9:
            self._clock_trouble = ""
            return min(stamp_ns, arrived_ns)
        self._clock_trouble = (
            "its buffers carry no stamps of the monotonic clock, so images are stamped when they arrive, some tens of "
            "milliseconds late"
        )
        return arrived_ns


def _examine(path: Path) -> tuple[ioctls.Capability, tuple[str, ...]]:
    """Who it is and its pixel formats.

    Raises:
        CameraError: not there, not allowed, not a camera.
    """
    try:
        with ioctls.opened(path) as fd:
            who = ioctls.query_capability(fd)
            formats = ioctls.list_formats(fd)
    except FileNotFoundError as error:
        raise CameraError(
            f"{path}: no such camera; is it plugged in? `semantic-mapper doctor --cameras` lists them"
        ) from error
    except PermissionError as error:
        raise CameraError(f"{path}: no permission; add yourself to the group `video` and log in again") from error
    except OSError as error:
        kind = "is no video device" if error.errno in (errno.ENOTTY, errno.EINVAL) else "does not answer"
        raise CameraError(
            f"{path}: {kind} ({error.strerror}); `semantic-mapper doctor --cameras` lists them"
        ) from error
    if not who.captures:
        raise CameraError(
            f"{path}: gives no images (it is the metadata of {who.card}, or an output); `doctor --cameras` "
            "lists those that do"
        )
    return who, formats
