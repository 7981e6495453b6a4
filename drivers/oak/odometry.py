"""Feeds the stereo pair to the odometry node, one at a time, and stamps the poses that come back.

DepthAI's poses carry no time. With one pair under way it is certain which one a pose is of, and where this machine
is too slow, pairs are left out instead of queueing up.
"""

import threading
import time
from typing import Any

import numpy as np

from semantic_mapper.drivers.base import PoseEstimate
from semantic_mapper.drivers.live import SLICE_S
from semantic_mapper.drivers.oak.device import OdometryPorts, capture_ns, clock_offset_ns, synced_queue, take
from semantic_mapper.drivers.poses.motion import Miss, PoseTrack, StampedPose
from semantic_mapper.errors import CameraError, PoseError
from semantic_mapper.geometry import check_pose, pose_matrix
from semantic_mapper.types import Float64

ANSWER_S = 2.0  # a pair without a pose for so long will have none
KEPT = 200  # poses: some seconds
GAP_NS = 200_000_000  # nothing is interpolated across a longer silence

# Basalt's poses are those of the left camera's body: x forward, y left, z up.
T_BODY_LEFT: Float64 = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)


def basalt_pose(position: tuple[float, float, float], quaternion: tuple[float, float, float, float]) -> Float64:
    """Pose (4, 4) of the left camera, from what Basalt says of its body: metres, and a quaternion x, y, z, w.

    ``PoseError``: no rotation, or no finite numbers: it has lost track.
    """
    if not np.isfinite((*position, *quaternion)).all() or not np.linalg.norm(quaternion) > 0.5:
        raise PoseError(f"odometry gave no pose: position {position}, quaternion {quaternion}")
    return pose_matrix(np.array(position), np.array(quaternion)) @ T_BODY_LEFT


class Odometry:
    """The poses of one connection; ``trouble`` says what does not work now. Its thread runs to ``close``, which comes
    once the pipeline has ended. ``PoseError``: the extrinsics are no rigid transform."""

    def __init__(self, pipeline: Any, ports: OdometryPorts, fps: float) -> None:
        check_pose(ports.T_left_rgb, "extrinsics of the OAK's colour camera")
        self.trouble = ""
        self._T_left_rgb = ports.T_left_rgb
        self._world = time.monotonic_ns()
        self._track = PoseTrack(KEPT, GAP_NS, max_ahead_ns=0)
        self._lock = threading.Lock()  # of the track
        self._pairs = synced_queue(pipeline, ports.pair, 0.5 / fps, size=1)
        self._inputs = {side: port.createInputQueue() for side, port in ports.inputs.items()}
        self._poses = ports.pose_out.createOutputQueue(maxSize=16, blocking=False)
        self._clock_ns = clock_offset_ns()
        self._closed = threading.Event()
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="oak-odometry", daemon=True)
        self._thread.start()

    def at(self, stamp_ns: int) -> PoseEstimate | Miss:
        """Pose of the colour camera at a moment between two poses, or why it is missing."""
        with self._lock:
            found = self._track.at(stamp_ns)
        return found if isinstance(found, str) else PoseEstimate(found.T @ self._T_left_rgb, "vio", world=self._world)

    def close(self) -> None:
        """End, once the pipeline has ended."""
        self._closed.set()
        self._thread.join()

    def check(self) -> None:
        """Raise what ended the thread, if anything did, as a ``CameraError``."""
        if self._error is not None:
            raise CameraError(f"odometry has ended: {self._error}; `odometry = false` does without") from self._error

    def _run(self) -> None:
        try:
            while not self._closed.is_set():
                pair = take(self._pairs, SLICE_S)
                if pair is not None:
                    self._track_pair(pair)
        except EOFError:  # the reader of the images says so
            pass
        except Exception as error:  # noqa: BLE001 -- whatever it is, it must be reported where the images are read
            self._error = error

    def _track_pair(self, pair: Any) -> None:
        stamp_ns = capture_ns(pair["left"], self._clock_ns)
        self._poses.tryGetAll()  # a late answer to a pair that was given up
        for name, port in self._inputs.items():
            port.send(pair[name])
        deadline, pose = time.monotonic() + ANSWER_S, None
        while pose is None and not self._closed.is_set() and time.monotonic() < deadline:
            pose = take(self._poses, SLICE_S)
        if pose is None:
            self.trouble = f"odometry has not answered for {ANSWER_S:g} s: too few features, or a busy processor"
            return
        t, q = pose.getTranslation(), pose.getQuaternion()
        try:
            T_world_left = basalt_pose((t.x, t.y, t.z), (q.qx, q.qy, q.qz, q.qw))
            with self._lock:
                self._track.add(StampedPose(stamp_ns, T_world_left))
            self.trouble = ""
        except PoseError as error:
            self.trouble = f"odometry has lost track: {error}"
