"""An OAK as a camera: opened, read, waited for where it goes away."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from types import TracebackType
from typing import Any, Self

import msgspec

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.oak.device import connect_device
from semantic_mapper.drivers.oak.images import ImageMaker, geometry_trouble, read_intrinsics, reported_intrinsics
from semantic_mapper.drivers.oak.odometry import Odometry
from semantic_mapper.drivers.oak.stream import Sources, Stream, StreamEnded
from semantic_mapper.errors import CameraError, PoseError
from semantic_mapper.log_events import get_logger
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics

Connect = Callable[[Config, Callable[[str], None]], Sources]

_SLICE_S = 0.1  # how soon a stop is noticed
_TRACKING_RESET = (
    "odometry began again when the camera came back, in another world than before: images go without a pose. Start the "
    "node again for a new map, or take poses from elsewhere"
)

_log = get_logger(__name__)


class OakCamera:
    """One OAK device; see ``semantic_mapper.drivers.base.Camera``. One process a camera.

    Args:
        config: What to open, and how.
        camera_id: Name in the images.
        connect: Gives the sources of each connection; the device's, but for tests.
    """

    def __init__(self, config: Config, camera_id: str, connect: Connect = connect_device) -> None:
        self._config = config
        self._camera_id = camera_id
        self._connect = connect
        self._stopped = threading.Event()
        self._lock = threading.Lock()
        self._warnings: dict[str, str] = {}
        self._stream: Stream | None = None
        self._odometry: Odometry | None = None
        self._maker: ImageMaker | None = None
        self._info: StreamInfo | None = None
        self._connections = 0
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
        """One sentence for each thing that does not work as it should now."""
        odometry = self._odometry
        with self._lock:
            warnings = [f"camera '{self._camera_id}': {text}" for text in self._warnings.values() if text]
        if odometry is not None and odometry.trouble:
            warnings.append(f"camera '{self._camera_id}': {odometry.trouble}")
        return tuple(warnings)

    @property
    def can_wait(self) -> bool:
        """As of ``Camera``."""
        return False

    @property
    def last_poll_time(self) -> float:
        """As of ``Camera``."""
        return self._last_poll_time

    def __enter__(self) -> Self:
        """Open the device.

        Raises:
            CameraError: it is not there, or cannot do what the config asks for.
        """
        self._open(self._config)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Free the device."""
        self._close()

    def stop(self) -> None:
        """End the iteration soon."""
        self._stopped.set()

    def __iter__(self) -> Iterator[CameraImage]:
        """Images in the order of capture, until ``stop``; a device that goes away is waited for.

        Raises:
            CameraError: what comes is not what was requested.
        """
        while not self._stopped.is_set():
            self._last_poll_time = time.monotonic()
            if self._stream is None:
                self._reopen()
                continue
            try:
                yield from self._images(self._stream)
            except StreamEnded as end:
                self._lost(str(end))

    def _images(self, stream: Stream) -> Iterator[CameraImage]:
        """Images of one connection; raises ``StreamEnded`` at its end."""
        waiting: deque[CameraImage] = deque()  # for their poses
        while not self._stopped.is_set():
            try:
                messages = stream.read(_SLICE_S if not waiting else _SLICE_S / 10)
            except StreamEnded:
                yield from waiting
                raise
            self._last_poll_time = time.monotonic()
            if self._odometry is not None:
                self._odometry.check()
            if messages is not None and (image := self._image(*messages)) is not None:
                waiting.append(image)
            while waiting and (done := self._with_pose(waiting[0])) is not None:
                waiting.popleft()
                yield done

    def _image(self, rgb: Any, depth: Any | None) -> CameraImage | None:
        """Raises CameraError."""
        maker = self._maker
        if maker is None:
            raise CameraError(f"camera '{self._camera_id}' is not open")
        image = maker.image(rgb, depth)
        if image is None:
            self._say("stamps", f"an image was passed over ({maker.passed_over} so far): {maker.reason}")
        else:
            self._say("stamps", "")
            self._say("device", "")
        return image

    def _with_pose(self, image: CameraImage) -> CameraImage | None:
        """The image as it can go on; None where it has to wait for its pose."""
        odometry = self._odometry
        if odometry is None:
            return image
        image = replace(image, tracks_itself=True)
        if self._connections > 1 and self._config.on_tracking_reset == "no-poses":
            return image
        late = time.monotonic_ns() - image.stamp_ns > self._config.odometry_wait_s * 1e9
        if not late and not odometry.reaches(image.stamp_ns):
            return None
        return replace(image, own_pose=odometry.pose_at(image.stamp_ns))

    def _open(self, config: Config) -> None:
        """Connect and start.

        Raises:
            CameraError: it does not work, and nothing is left open.
        """
        sources = self._connect(config, self._device_state)
        with ExitStack() as undo:
            undo.callback(sources.close)
            try:
                odometry = Odometry(sources, config) if sources.odometry is not None else None
                stream = Stream(sources, config)
                if odometry is not None:
                    undo.callback(odometry.close)
                undo.callback(stream.close)
                stream.start()
                if odometry is not None:
                    odometry.start()
                intrinsics = self._begin(stream, config)
            except (RuntimeError, PoseError) as error:  # DepthAI's, and of the extrinsics
                raise CameraError(f"{sources.name} cannot be used: {error}") from error
            except StreamEnded as end:
                raise CameraError(
                    f"{sources.name} was opened, but {end}: plug it in again, or set a lower `fps`"
                ) from end
            undo.pop_all()
        if self._maker is None:
            self._maker = ImageMaker(self._camera_id, intrinsics, config.fps)
        else:
            self._maker.reconnected(intrinsics)
        self._stream, self._odometry = stream, odometry
        self._connections += 1
        self._info = StreamInfo(
            source=sources.name,
            cameras={self._camera_id: intrinsics},
            frame_hz=config.fps,
            metadata=sources.metadata,
        )
        self._say("state", "")
        self._say("notes", "; ".join(sources.notes))
        withheld = odometry is not None and self._connections > 1 and config.on_tracking_reset == "no-poses"
        self._say("world", _TRACKING_RESET if withheld else "")
        _log.info("camera_connected", camera=self._camera_id, device=sources.name, connection=self._connections)

    def _begin(self, stream: Stream, config: Config) -> CameraIntrinsics:
        """Wait for the first image.

        Returns:
            What it says of its intrinsics, else what the calibration says.

        Raises:
            CameraError, StreamEnded: there is no image, or neither says anything.
        """
        messages = stream.first(self._stopped)
        reported = None if messages is None else reported_intrinsics(messages[0])
        self._say("geometry", "" if messages is None else geometry_trouble(*messages))
        return reported or read_intrinsics(stream.sources.calibration, config.rgb, config.width, config.height)

    def _close(self) -> None:
        stream, odometry = self._stream, self._odometry
        self._stream = self._odometry = None
        if stream is not None:
            stream.close()
        if odometry is not None:
            odometry.close()

    def _lost(self, reason: str) -> None:
        name = self.info.source
        self._say("device", f"{name}: {reason}; it is looked for every {self._config.retry_s:g} s")
        _log.warning("camera_lost", camera=self._camera_id, device=name, reason=reason)
        if self._stream is not None:  # the next connection is to the same device, whatever else is plugged in
            self._config = msgspec.structs.replace(
                self._config, device=self._stream.sources.address, search_s=min(self._config.search_s, _SLICE_S)
            )
        self._close()

    def _reopen(self) -> None:
        """One attempt to open the device again, after a pause."""
        if self._stopped.wait(self._config.retry_s):
            return
        try:
            self._open(self._config)
        except CameraError as error:
            self._say("device", f"{self.info.source} is away: {error}")
            return
        if self._odometry is not None and self._config.on_tracking_reset == "exit":
            raise CameraError(f"{self.info.source} was away, and its {_TRACKING_RESET}")

    def _device_state(self, state: str) -> None:
        """Called by a thread of DepthAI's, where an exception would end the process: nothing here raises."""
        self._say("state", "" if state == "running" else f"DepthAI says that the device is {state}")

    def _say(self, topic: str, trouble: str) -> None:
        with self._lock:
            self._warnings[topic] = trouble
