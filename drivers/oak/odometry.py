"""Feeds the stereo pair to the odometry node, one at a time, and stamps the poses that come back.

DepthAI's poses carry no time. With one pair under way there is no doubt which one a pose is of, and where this machine
is too slow, pairs are left out instead of queueing up.
"""

from __future__ import annotations

import threading
import time
from typing import Any

from semantic_mapper.drivers.oak.config import Config
from semantic_mapper.drivers.oak.images import capture_ns, clock_offset_ns
from semantic_mapper.drivers.oak.stream import Sources, StreamEnded, synced_queue, take
from semantic_mapper.drivers.oak.tracking import PoseTrack, basalt_pose
from semantic_mapper.errors import CameraError, PoseError

ANSWER_S = 2.0  # a pair without a pose for so long will have none
_SLICE_S = 0.1


class Odometry:
    """The poses of one connection; its thread runs from ``start`` to ``close``.

    Args:
        sources: With odometry ports, of a pipeline that is not started yet.
        config: Of the camera.

    Raises:
        PoseError: the extrinsics are no rigid transform.
    """

    def __init__(self, sources: Sources, config: Config) -> None:
        ports = sources.odometry
        if ports is None:
            raise ValueError("these sources have no odometry")
        self.track = PoseTrack(ports.T_left_rgb)
        self._pairs = synced_queue(
            sources.pipeline, {"left": ports.left_out, "right": ports.right_out}, 0.5 / config.fps, size=1
        )
        self._inputs = {
            name: port.createInputQueue() for name, port in (("left", ports.left_in), ("right", ports.right_in))
        }
        self._poses = ports.pose_out.createOutputQueue(maxSize=16, blocking=False)
        self._clock_ns = clock_offset_ns()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run, name="oak-odometry", daemon=True)
        self._trouble = ""
        self._error: Exception | None = None

    @property
    def trouble(self) -> str:
        """What does not work now; empty when all is well."""
        return self._trouble

    def start(self) -> None:
        """Begin, once the pipeline runs."""
        self._thread.start()

    def close(self) -> None:
        """End, once the pipeline has ended."""
        self._closed.set()
        if self._thread.is_alive():
            self._thread.join()

    def check(self) -> None:
        """Raise what ended the thread, if anything did.

        Raises:
            CameraError: with the cause.
        """
        if self._error is not None:
            raise CameraError(f"odometry has ended: {self._error}; `odometry = false` does without") from self._error

    def _run(self) -> None:
        try:
            while not self._closed.is_set():
                pair = take(self._pairs, _SLICE_S)
                if pair is not None:
                    self._track_pair(pair)
        except StreamEnded:  # the reader of the images says so
            pass
        except Exception as error:  # noqa: BLE001 -- whatever it is, it must be told where the images are read
            self._error = error

    def _track_pair(self, pair: Any) -> None:
        stamp_ns = capture_ns(pair["left"], self._clock_ns)
        self._poses.tryGetAll()  # a late answer to a pair that was given up
        for name, port in self._inputs.items():
            port.send(pair[name])
        deadline = time.monotonic() + ANSWER_S
        while not self._closed.is_set():
            pose = take(self._poses, _SLICE_S)
            if pose is not None:
                self._add(stamp_ns, pose)
                return
            if time.monotonic() > deadline:
                self._trouble = f"odometry has not answered for {ANSWER_S:g} s: too few features, or a busy processor"
                return

    def _add(self, stamp_ns: int, pose: Any) -> None:
        t, q = pose.getTranslation(), pose.getQuaternion()
        try:
            self.track.add(stamp_ns, basalt_pose((t.x, t.y, t.z), (q.qx, q.qy, q.qz, q.qw)))
            self._trouble = ""
        except PoseError as error:
            self._trouble = f"odometry has lost track: {error}"
