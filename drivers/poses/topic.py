"""Poses from outside: a robot's own odometry on a ZeroMQ topic, brought to the moment of each image."""

import threading
import time
from pathlib import Path
from typing import Self

import numpy as np
import zmq

from semantic_mapper.drivers.base import CameraImage, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import TopicPoses
from semantic_mapper.drivers.poses.motion import PoseTrack, StampedPose
from semantic_mapper.errors import CameraError, CodecError, TransportError
from semantic_mapper.log_events import get_logger, is_power_of_two
from semantic_mapper.transport.endpoints import check_connect
from semantic_mapper.transport.keys import ServerIdentity, load_keys, secure_client
from semantic_mapper.transport.pose_message import MAX_POSE_BYTES, decode_pose
from semantic_mapper.transport.sockets import MAX_PART_BYTES, receive_bounded

WAIT_S = 0.05  # how long an image waits for a pose at or after it, before the motion is extrapolated
_KEPT = 2000  # poses
_MAX_GAP_NS = 300_000_000  # between two poses further apart nothing is interpolated
_MAX_AHEAD_NS = 50_000_000  # beyond the last pose; an image that is further ahead has none
_POLL_MS = 50
# A pose cannot be of a moment that has not come. So much is left to publishers that predict where the robot will be
# when the message arrives, and to an offset between two clocks that is not exact.
_FUTURE_NS = 50_000_000
_CLOCKS = "stamp poses with CLOCK_MONOTONIC of this machine, or set clock_offset_ns if the difference is constant"

_log = get_logger(__name__)


class TopicPoseSource(PoseSource):
    """Listens to a publisher of ``pose_message`` and interpolates to the stamps of images.

    A thread takes messages as they come. ``pose`` waits up to ``wait_s`` for one at or after the image's stamp.
    ``CameraError``: not an endpoint; one of another machine, and there is no `server`; or there are no keys.

    Attributes:
        counters: Messages ("messages"), those that were no pose ("rejected"), of a moment that has not come
            ("future"), not later than the one before ("out_of_order"), and images without a pose by reason ("empty",
            "before", "gap", "stale").
    """

    def __init__(self, config: TopicPoses, wait_s: float = WAIT_S) -> None:
        super().__init__()
        self._config = config
        self._wait_s = wait_s
        try:
            self._identity = None
            if config.server:
                self._identity = ServerIdentity(load_keys(Path(config.keys).expanduser()), config.server)
            check_connect(config.endpoint, self._identity)
        except TransportError as error:  # now: a camera that cannot be opened is waited for
            raise CameraError(f"pose topic: {error}") from error
        self._mount = np.array(config.T_base_rig or config.T_base_camera)
        self._track = PoseTrack(_KEPT, _MAX_GAP_NS, _MAX_AHEAD_NS)
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        self._message_trouble = ""
        self._image_trouble = ""

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is wrong with messages, and why the last image had no pose."""
        return tuple(text for text in (self._message_trouble, self._image_trouble) if text)

    def __enter__(self) -> Self:
        """Connect; ``CameraError`` where it is not an endpoint."""
        socket = zmq.Context.instance().socket(zmq.SUB)
        try:
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.RCVHWM, 1000)
            socket.setsockopt(zmq.MAXMSGSIZE, MAX_PART_BYTES)
            socket.setsockopt(zmq.RECONNECT_IVL_MAX, 1000)
            socket.subscribe(self._config.topic.encode())
            if self._identity is not None:
                secure_client(socket, self._identity)
            socket.connect(self._config.endpoint)
        except (zmq.ZMQError, TransportError) as error:
            socket.close(linger=0)
            raise CameraError(
                f"pose topic {self._config.endpoint}: cannot be subscribed to: {error}; endpoints read ipc://PATH or "
                "tcp://HOST:PORT"
            ) from error
        self._closed.clear()
        self._thread = threading.Thread(target=self._run, args=(socket,), name="pose topic", daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._closed.set()
        if self._thread is not None:
            self._thread.join()

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """Pose at the image's stamp; None, with the reason in ``warnings``, where the messages do not give it."""
        stamp_ns, endpoint = image.stamp_ns, self._config.endpoint
        with self._changed:
            self._changed.wait_for(lambda: self._track.newest_ns >= stamp_ns, self._wait_s)
            newest_ns = self._track.newest_ns
            found = self._track.at(stamp_ns)
        if isinstance(found, StampedPose):
            self._image_trouble = ""
            return PoseEstimate(found.T @ self._mount, "topic", found.sigma)
        trouble = f"no pose that can be used has come from {endpoint}; is its publisher running?"
        if found != "empty":
            trouble = (
                f"no pose of {endpoint} is of the time of the last image of '{image.camera_id}' ({found}): the newest "
                f"is {(stamp_ns - newest_ns) / 1e9:.3f} s older; if both are of different clocks, {_CLOCKS}"
            )
        if not self._image_trouble:
            _log.warning("image_without_pose", reason=found, detail=trouble)
        self._image_trouble = trouble
        self._counters[found] += 1
        return None

    def _run(self, socket: zmq.Socket[bytes]) -> None:
        with socket:
            while not self._closed.is_set():
                if socket.poll(_POLL_MS):
                    self._take(*receive_bounded(socket, max_parts=2, max_bytes=2 * MAX_POSE_BYTES))

    def _take(self, parts: list[bytes], trouble: str) -> None:
        """A message, or why it is not kept as a whole; one that cannot be used costs itself and nothing else."""
        try:
            if trouble:
                raise CodecError(trouble)
            message = decode_pose(parts)
        except CodecError as error:
            self._drop("rejected", str(error))
            return
        sample = StampedPose(message.stamp_ns + self._config.clock_offset_ns, message.matrix, message.sigma)
        ahead_ns = sample.stamp_ns - time.monotonic_ns()
        if ahead_ns > _FUTURE_NS:
            ahead = f"it is stamped {ahead_ns / 1e9:.3f} s ahead of this machine's CLOCK_MONOTONIC"
            self._drop("future", f"{ahead}, so it is of another clock; {_CLOCKS}")
            return
        with self._changed:
            if not self._track.add(sample):
                self._drop("out_of_order", f"stamp {sample.stamp_ns} is not after {self._track.newest_ns}")
                return
            self._message_trouble = ""
            self._counters["messages"] += 1
            self._changed.notify_all()

    def _drop(self, reason: str, detail: str) -> None:
        """Count a message that cannot be used; log it at each power of two."""
        self._message_trouble = f"a message of {self._config.endpoint} was dropped: {detail}"
        self._counters[reason] += 1
        count = self._counters[reason]
        if is_power_of_two(count):
            _log.warning("pose_message_dropped", reason=reason, count=count, detail=detail)
