"""Poses from outside: a robot's own odometry on a ZeroMQ topic, brought to the moment of each image."""

from __future__ import annotations

import threading
import time
from collections import Counter
from pathlib import Path
from types import TracebackType
from typing import Self

import zmq

from semantic_mapper.drivers.base import CameraImage, PoseEstimate
from semantic_mapper.drivers.poses.config import TopicPoses, matrix
from semantic_mapper.drivers.poses.motion import PoseTrack, StampedPose
from semantic_mapper.errors import CameraError, CodecError, TransportError
from semantic_mapper.log_events import get_logger, is_power_of_two
from semantic_mapper.transport.endpoints import check_connect
from semantic_mapper.transport.keys import ServerIdentity, load_keys, secure_client
from semantic_mapper.transport.pose_message import MAX_POSE_BYTES, PoseMessage, decode_pose
from semantic_mapper.transport.sockets import receive_bounded

_POLL_MS = 50
_SILENCE_S = 1.0  # after so long without a message the connection is made again
_FRESH_NS = 500_000_000  # a message that came so long ago was sent just now, as far as clocks go
# A pose cannot be of a moment that has not come. So much is left to publishers that tell where the robot will be when
# the message arrives, and to an offset between two clocks that is not exact; it is what ``max_ahead_s`` bridges, too.
_FUTURE_NS = 50_000_000
_MISSES = {
    "before": "is older than the poses that are kept",
    "gap": "falls into a gap between two poses",
    "stale": "is too far ahead of the newest pose",
}

_log = get_logger(__name__)


class TopicPoseSource:
    """Listens to a publisher of ``pose_message`` and interpolates to the stamps of images.

    A thread takes messages as they come. ``pose`` waits up to ``wait_s`` for one at or after the image's stamp.

    Args:
        config: Where to listen, what to expect, where the cameras sit.

    Raises:
        CameraError: not an endpoint; one of another machine, and there is no `server`; or there are no keys.

    Attributes:
        counters: Messages ("messages"), those that were none ("rejected"), of other frames ("other_frames"), of
            a moment that has not come ("future"), not later than the one before ("out_of_order"), and images without a
            pose by reason ("empty", "before", "gap", "stale", "clock": messages are far from the images' clock).
    """

    def __init__(self, config: TopicPoses) -> None:
        self._config = config
        try:
            self._identity = None
            if config.server:
                self._identity = ServerIdentity(load_keys(Path(config.keys).expanduser()), config.server)
            check_connect(config.endpoint, self._identity)
        except TransportError as error:  # now: a camera that cannot be opened is waited for
            raise CameraError(f"pose topic: {error}") from error
        self._mounts = {name: matrix(rows) for name, rows in config.cameras.items()}
        self._mount = matrix(config.T_base_rig or config.T_base_camera)
        self._track = PoseTrack(config.keep, round(config.max_gap_s * 1e9), round(config.max_ahead_s * 1e9))
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._thread: threading.Thread | None = None
        self._arrived_ns = 0  # on this machine's clock
        self._connection_trouble = ""
        self._message_trouble = ""
        self._image_trouble = ""
        self.counters: Counter[str] = Counter()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What is the matter with the connection and with messages, and why the last image had no pose."""
        told = (self._connection_trouble, self._message_trouble, self._image_trouble)
        return tuple(text for text in told if text)

    def __enter__(self) -> Self:
        """Connect.

        Raises:
            CameraError: not an endpoint.
        """
        socket = self._connect()
        self._closed.clear()
        self._thread = threading.Thread(target=self._run, args=(socket,), name="pose topic", daemon=True)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closed.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """Pose at the image's stamp; None, counted and told in ``warnings``, where the messages do not give it."""
        with self._changed:
            self._changed.wait_for(lambda: self._reaches(image.stamp_ns) or self._is_off(image), self._config.wait_s)
            if self._is_off(image):
                return self._refuse("clock", self._clock_trouble(image))
            found = self._track.at(image.stamp_ns)
        if found == "empty":
            return self._refuse("empty", self._empty_trouble())
        if isinstance(found, str):
            return self._refuse(found, self._miss_trouble(image, found))
        self._image_trouble = ""
        mount = self._mounts.get(image.camera_id, self._mount)
        return PoseEstimate(found.T @ mount, "topic", found.sigma)

    def _reaches(self, stamp_ns: int) -> bool:
        newest = self._track.newest_ns
        return newest is not None and newest >= stamp_ns

    def _is_off(self, image: CameraImage) -> bool:
        """Whether messages come now whose stamps are of another clock than the image's."""
        newest = self._track.newest_ns
        fresh = time.monotonic_ns() - self._arrived_ns < _FRESH_NS
        return newest is not None and fresh and self._difference_s(image) > self._config.max_clock_difference_s

    def _difference_s(self, image: CameraImage) -> float:
        newest = self._track.newest_ns
        return 0.0 if newest is None else abs(newest - image.stamp_ns) / 1e9

    def _clock_trouble(self, image: CameraImage) -> str:
        newest = self._track.newest_ns or 0
        return (
            f"poses of {self._config.endpoint} that come now are stamped {(newest - image.stamp_ns) / 1e9:+.3f} s from "
            f"the images of '{image.camera_id}': they are of another clock; stamp both with CLOCK_MONOTONIC of one "
            f"machine, or set clock_offset_ns (now {self._config.clock_offset_ns}) if the difference is constant; on a "
            "machine that is too slow for its camera, and has its images so late, raise max_clock_difference_s (now "
            f"{self._config.max_clock_difference_s:g})"
        )

    def _empty_trouble(self) -> str:
        if self._message_trouble:
            return f"no pose that came from {self._config.endpoint} could be used"
        return f"no pose has come from {self._config.endpoint}; is its publisher running?"

    def _miss_trouble(self, image: CameraImage, miss: str) -> str:
        newest = self._track.newest_ns or 0
        return (
            f"the last image of '{image.camera_id}' {_MISSES[miss]} of {self._config.endpoint}: the newest one is "
            f"{(image.stamp_ns - newest) / 1e9:.3f} s older"
        )

    def _refuse(self, reason: str, trouble: str) -> None:
        if not self._image_trouble:
            _log.warning("image_without_pose", reason=reason, detail=trouble)
        self._image_trouble = trouble
        self.counters[reason] += 1

    def _connect(self) -> zmq.Socket[bytes]:
        socket = zmq.Context.instance().socket(zmq.SUB)
        try:
            socket.setsockopt(zmq.LINGER, 0)
            socket.setsockopt(zmq.RCVHWM, 1000)
            socket.setsockopt(zmq.MAXMSGSIZE, MAX_POSE_BYTES)
            socket.setsockopt(zmq.RECONNECT_IVL, 50)
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
        return socket

    def _run(self, socket: zmq.Socket[bytes]) -> None:
        heard = time.monotonic()
        try:
            while not self._closed.is_set():
                if socket.poll(_POLL_MS):
                    self._take(*receive_bounded(socket, max_parts=2, max_bytes=2 * MAX_POSE_BYTES))
                    heard = time.monotonic()
                elif time.monotonic() - heard > _SILENCE_S:
                    # ZeroMQ gives a connection up for good after a message beyond MAXMSGSIZE, and does not tell.
                    socket = self._connect_anew(socket)
                    heard = time.monotonic()
        finally:
            socket.close(linger=0)

    def _connect_anew(self, old: zmq.Socket[bytes]) -> zmq.Socket[bytes]:
        """A new socket; the old one, to be tried again later, while there can be none, such as for want of a key."""
        try:
            new = self._connect()
        except (CameraError, zmq.ZMQError) as error:
            if not self._connection_trouble:
                _log.warning("pose_topic_lost", detail=str(error))
            self._connection_trouble = str(error)
            return old
        self._connection_trouble = ""
        old.close(linger=0)
        return new

    def _take(self, parts: list[bytes], trouble: str) -> None:
        """A message, or why it is not kept as a whole."""
        if trouble:
            self._drop("rejected", trouble)
            return
        try:
            message = decode_pose(parts)
        except CodecError as error:
            self._drop("rejected", str(error))
            return
        for name, told, wanted in (
            ("parent", message.parent, self._config.parent),
            ("child", message.child, self._config.child),
        ):
            if wanted not in ("", told):
                self._drop("other_frames", f"the message's {name} frame is '{told}', not '{wanted}'")
                return
        sample = _sample(message, self._config.clock_offset_ns)
        now_ns = time.monotonic_ns()
        if sample.stamp_ns - now_ns > _FUTURE_NS:
            self._drop("future", self._future_trouble(sample, now_ns))
            return
        with self._changed:
            newest = self._track.newest_ns
            if newest is not None and self._is_set_back(newest - sample.stamp_ns, now_ns):
                self._track.clear()
            if not self._track.add(sample):
                self._drop("out_of_order", f"stamp {sample.stamp_ns} is not after {newest}")
                return
            self._arrived_ns = now_ns
            self._connection_trouble = self._message_trouble = ""
            self.counters["messages"] += 1
            self._changed.notify_all()

    def _is_set_back(self, behind_ns: int, now_ns: int) -> bool:
        """Whether the publisher's clock was set back, or it was restarted, as told by a message so far behind.

        Not while others keep coming that are not behind: then it is of a second publisher, on another clock.
        """
        silent = now_ns - self._arrived_ns > _FRESH_NS
        return silent and behind_ns > self._config.max_clock_difference_s * 1e9

    def _future_trouble(self, sample: StampedPose, now_ns: int) -> str:
        return (
            f"it is stamped {(sample.stamp_ns - now_ns) / 1e9:.3f} s ahead of this machine's CLOCK_MONOTONIC, so it is "
            "of another clock; stamp poses with CLOCK_MONOTONIC of this machine, or set clock_offset_ns (now "
            f"{self._config.clock_offset_ns}) if the difference is constant"
        )

    def _drop(self, reason: str, detail: str) -> None:
        """A message that cannot be used costs itself and nothing else; told of at each power of two."""
        self._message_trouble = f"a message of {self._config.endpoint} was dropped: {detail}"
        self.counters[reason] += 1
        count = self.counters[reason]
        if is_power_of_two(count):
            _log.warning("pose_message_dropped", reason=reason, count=count, detail=detail)


def _sample(message: PoseMessage, offset_ns: int) -> StampedPose:
    return StampedPose(message.stamp_ns + offset_ns, message.matrix, message.sigma)
