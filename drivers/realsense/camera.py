"""A RealSense as a camera: opened, read, waited for where it goes away."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Self

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.realsense.config import Config
from semantic_mapper.drivers.realsense.devices import find_device
from semantic_mapper.drivers.realsense.images import ImageMaker
from semantic_mapper.drivers.realsense.stream import FrameSet, Stream, StreamEnded
from semantic_mapper.errors import CameraError
from semantic_mapper.log_events import get_logger
from semantic_mapper.transport.messages import StreamInfo

FindDevice = Callable[[str, float], Any]

_SLICE_S = 0.1  # how soon a stop is noticed

_log = get_logger(__name__)


class RealSenseCamera:
    """One device; see ``semantic_mapper.drivers.base.Camera``.

    Args:
        config: What to open, and how.
        camera_id: Name in the images.
        find: Gives the SDK's device by serial number within a time; but for tests, one that is connected.
    """

    def __init__(self, config: Config, camera_id: str, find: FindDevice = find_device) -> None:
        self._config = config
        self._camera_id = camera_id
        self._find = find
        self._stopped = threading.Event()
        self._stream: Stream | None = None
        self._maker: ImageMaker | None = None
        self._info: StreamInfo | None = None
        self._serial = config.device
        self._first: FrameSet | None = None
        self._lost = ""
        self._notes: tuple[str, ...] = ()
        self._last_poll_time = 0.0

    @property
    def info(self) -> StreamInfo:
        """Name and intrinsics of the device.

        Raises:
            CameraError: it is not open.
        """
        if self._info is None:
            raise CameraError(f"camera '{self._camera_id}' is not open")
        return self._info

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Camera``."""
        texts = (*((self._lost,) if self._lost else ()), *self._notes)
        return tuple(f"camera '{self._camera_id}': {text}" for text in texts)

    @property
    def can_wait(self) -> bool:
        """As of ``Camera``."""
        return False

    @property
    def last_poll_time(self) -> float:
        """As of ``Camera``."""
        return self._last_poll_time

    def __enter__(self) -> Self:
        """Open the device and wait for its first image.

        Raises:
            CameraError: it is not there, or cannot do what the config asks for.
        """
        self._open(self._config.search_s)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Free the device."""
        self._close()

    def stop(self) -> None:
        """As of ``Camera``."""
        self._stopped.set()

    def __iter__(self) -> Iterator[CameraImage]:
        """Images in the order of capture, until ``stop``; a device that goes away is waited for.

        Raises:
            CameraError: not open.
        """
        if self._maker is None:
            raise CameraError(f"camera '{self._camera_id}' is not open")
        while not self._stopped.is_set():
            self._last_poll_time = time.monotonic()
            if self._stream is None:
                self._reopen()
                continue
            frames, self._first = self._first, None
            try:
                frames = frames or self._stream.read(_SLICE_S)
            except StreamEnded as end:
                self._lose(str(end))
                continue
            if frames is None:
                continue
            image, self._lost = self._maker.image(frames), ""
            if image is not None:
                yield image
            else:
                self._lost = f"an image was passed over ({self._maker.passed_over} so far): {self._maker.reason}"

    def _open(self, search_s: float) -> None:
        """Connect, and wait for the first image, whose profile has the intrinsics.

        Raises:
            CameraError: it does not work, and nothing is left open.
        """
        stream = Stream(self._find(self._serial, search_s), self._config)
        try:
            frames = None
            while frames is None and not self._stopped.is_set():
                self._last_poll_time = time.monotonic()
                frames = stream.read(_SLICE_S)
            if frames is None:
                raise CameraError(f"{stream.name}: a stop was asked for before its first image")
            told = frames.color.profile.as_video_stream_profile().get_intrinsics()
            if self._maker is None:
                self._maker = ImageMaker(self._camera_id, told)
            else:
                self._maker.connected(told)
        except StreamEnded as end:
            stream.close()
            raise CameraError(f"{stream.name} was opened, but {end}: plug it in again, or set a lower `fps`") from end
        except CameraError:
            stream.close()
            raise
        self._stream, self._first, self._serial, self._notes = stream, frames, stream.serial, stream.notes
        self._info = StreamInfo(
            source=stream.name,
            cameras={self._camera_id: self._maker.intrinsics},
            frame_hz=float(self._config.fps),
            metadata={"driver": "realsense", "device": stream.serial},
        )
        _log.info("camera_connected", camera=self._camera_id, device=stream.name)

    def _lose(self, reason: str) -> None:
        name = self.info.source
        self._lost = f"{name}: {reason}; it is looked for every {self._config.retry_s:g} s"
        _log.warning("camera_lost", camera=self._camera_id, device=name, reason=reason)
        self._close()

    def _reopen(self) -> None:
        """One attempt to open the device again, after a pause."""
        if self._stopped.wait(self._config.retry_s):
            return
        try:
            self._open(min(self._config.search_s, _SLICE_S))
        except CameraError as error:
            self._lost = f"{self.info.source} is away: {error}"

    def _close(self) -> None:
        stream, self._stream, self._first = self._stream, None, None
        if stream is not None:
            stream.close()
