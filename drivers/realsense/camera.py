"""A RealSense as a camera: opened, read, waited for where it goes away."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.live import SLICE_S, PolledCamera, StreamEnded
from semantic_mapper.drivers.realsense.config import Config
from semantic_mapper.drivers.realsense.devices import find_device
from semantic_mapper.drivers.realsense.frames import FrameSet, ImageMaker, Stream
from semantic_mapper.errors import CameraError
from semantic_mapper.log_events import get_logger
from semantic_mapper.transport.messages import StreamInfo

FindDevice = Callable[[str, float], Any]

SEARCH_S = 2.0  # how long the device is looked for before it counts as missing

_log = get_logger(__name__)


class RealSenseCamera(PolledCamera):
    """One device; see ``semantic_mapper.drivers.base.Camera``.

    Args:
        config: What to open, and how.
        camera_id: Name in the images.
        find: Gives the SDK's device by serial number within a time; but for tests, one that is connected.
    """

    def __init__(self, config: Config, camera_id: str, find: FindDevice = find_device) -> None:
        super().__init__(camera_id)
        self._config = config
        self._find = find
        self._stream: Stream | None = None
        self._maker: ImageMaker | None = None
        self._serial = config.device
        self._first: FrameSet | None = None
        self._trouble = ""
        self._notes: tuple[str, ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """As of ``Camera``."""
        texts = (*((self._trouble,) if self._trouble else ()), *self._notes)
        return tuple(f"camera '{self._camera_id}': {text}" for text in texts)

    def _images(self) -> Iterator[CameraImage]:
        while not self._stopping.is_set() and self._stream is not None and self._maker is not None:
            self._last_poll_time = time.monotonic()
            frames, self._first = self._first, None
            frames = frames or self._stream.read(SLICE_S)
            if frames is None:
                continue
            image, self._trouble = self._maker.image(frames), ""
            if image is not None:
                yield image
            else:
                self._trouble = f"an image was passed over ({self._maker.passed_over} so far): {self._maker.reason}"

    def _connect(self, *, again: bool) -> None:
        stream = Stream(self._find(self._serial, SLICE_S if again else SEARCH_S), self._config)
        try:
            frames = None  # the first ones, whose profile has the intrinsics
            while frames is None and not self._stopping.is_set():
                self._last_poll_time = time.monotonic()
                frames = stream.read(SLICE_S)
            if frames is None:
                raise CameraError(f"{stream.name}: a stop was requested before its first image")
            lens = frames.color.profile.as_video_stream_profile().get_intrinsics()
            if self._maker is None:
                self._maker = ImageMaker(self._camera_id, lens, self._config.fps)
            else:
                self._maker.connected(lens)
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

    def _disconnect(self) -> None:
        stream, self._stream, self._first = self._stream, None, None
        if stream is not None:
            stream.close()

    def _warn_of_device(self, text: str) -> None:
        self._trouble = text


def open_camera(config: Config, camera_id: str) -> RealSenseCamera:
    """The camera of a config, opened when it is entered; see ``drivers/registry.py``."""
    return RealSenseCamera(config, camera_id)
