"""An OAK as a camera: opened, read, waited for where it goes away."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Any

import msgspec

from semantic_mapper.drivers.base import CameraImage
from semantic_mapper.drivers.live import SLICE_S, PolledCamera, StreamEnded
from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.oak.device import connect_device
from semantic_mapper.drivers.oak.images import ImageMaker, geometry_trouble, read_intrinsics, reported_intrinsics
from semantic_mapper.drivers.oak.odometry import Odometry
from semantic_mapper.drivers.oak.stream import Sources, Stream
from semantic_mapper.errors import CameraError, PoseError
from semantic_mapper.log_events import get_logger
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import CameraIntrinsics

Connect = Callable[[Config, Callable[[str], None], float], Sources]

SEARCH_S = 2.0  # how long the device is looked for before it counts as missing
ODOMETRY_WAIT_S = 0.3  # how long an image waits for its pose; then it goes without
_log = get_logger(__name__)


class OakCamera(PolledCamera):
    """One OAK device; see ``semantic_mapper.drivers.base.Camera``. One process a camera.

    Args:
        config: What to open, and how.
        camera_id: Name in the images.
        connect: Gives the sources of each connection; the device's, but for tests.
    """

    def __init__(self, config: Config, camera_id: str, connect: Connect = connect_device) -> None:
        super().__init__(camera_id)
        self._config = config
        self._open_sources = connect
        self._lock = threading.Lock()
        self._warnings: dict[str, str] = {}
        self._stream: Stream | None = None
        self._odometry: Odometry | None = None
        self._maker: ImageMaker | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each thing that does not work as it should now."""
        odometry = self._odometry
        with self._lock:
            warnings = [f"camera '{self._camera_id}': {text}" for text in self._warnings.values() if text]
        if odometry is not None and odometry.trouble:
            warnings.append(f"camera '{self._camera_id}': {odometry.trouble}")
        return tuple(warnings)

    def _images(self) -> Iterator[CameraImage]:
        waiting: deque[CameraImage] = deque()  # for their poses
        while not self._stopping.is_set() and self._stream is not None:
            try:
                messages = self._stream.read(SLICE_S if not waiting else SLICE_S / 10)
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
            self._warn("stamps", f"an image was passed over ({maker.passed_over} so far): {maker.reason}")
        else:
            self._warn("stamps", "")
            self._warn("device", "")
        return image

    def _with_pose(self, image: CameraImage) -> CameraImage | None:
        """The image as it can go on; None where it has to wait for its pose."""
        odometry = self._odometry
        if odometry is None:
            return image
        image = replace(image, tracks_itself=True)
        late = time.monotonic_ns() - image.stamp_ns > ODOMETRY_WAIT_S * 1e9
        if not late and not odometry.reaches(image.stamp_ns):
            return None
        return replace(image, own_pose=odometry.pose_at(image.stamp_ns))

    def _connect(self, *, again: bool) -> None:
        config = self._config
        sources = self._open_sources(config, self._device_state, SLICE_S if again else SEARCH_S)
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
                intrinsics = self._wait_for_first(stream)
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
        self._info = StreamInfo(
            source=sources.name,
            cameras={self._camera_id: intrinsics},
            frame_hz=config.fps,
            metadata=sources.metadata,
        )
        # The next connection is to the same device, whatever else is plugged in.
        self._config = msgspec.structs.replace(config, device=sources.address)
        self._warn("state", "")
        self._warn("notes", "; ".join(sources.notes))
        _log.info("camera_connected", camera=self._camera_id, device=sources.name)

    def _wait_for_first(self, stream: Stream) -> CameraIntrinsics:
        """What the first image says of its intrinsics, else what the calibration says.

        Raises:
            CameraError, StreamEnded: there is no image, or neither says anything.
        """
        messages = stream.first(self._stopping)
        reported = None if messages is None else reported_intrinsics(messages[0])
        self._warn("geometry", "" if messages is None else geometry_trouble(*messages))
        config = self._config
        return reported or read_intrinsics(stream.sources.calibration, config.rgb, config.width, config.height)

    def _disconnect(self) -> None:
        stream, odometry = self._stream, self._odometry
        self._stream = self._odometry = None
        if stream is not None:
            stream.close()
        if odometry is not None:
            odometry.close()

    def _device_state(self, state: str) -> None:
        """Called by a thread of DepthAI's, where an exception would end the process: nothing here raises."""
        self._warn("state", "" if state == "running" else f"DepthAI says that the device is {state}")

    def _warn_of_device(self, text: str) -> None:
        self._warn("device", text)

    def _warn(self, topic: str, text: str) -> None:
        with self._lock:
            self._warnings[topic] = text


def open_camera(config: Config, camera_id: str) -> OakCamera:
    """The camera of a config, opened when it is entered; see ``drivers/registry.py``."""
    return OakCamera(config, camera_id)
