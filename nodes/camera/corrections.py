"""Closed loops of the pose source, on their way to the mapper: a thread asks it to move its map, frames go on."""

import threading
from typing import Self

import msgspec
import structlog

from semantic_mapper.client import MapClient
from semantic_mapper.drivers.base import CorrectedWorld
from semantic_mapper.errors import SemanticMapperError, TransportError
from semantic_mapper.nodes.options import LiveCamera, table_of
from semantic_mapper.nodes.publishing import PartStatus

RETRY_S = 2.0
LAST_S = 10.0  # how long the last correction may take to reach the mapper, once the stream has ended
_SAME_FRAME_NS = 1  # poses of images that were never mapped are left out, instead of refused

_log = structlog.get_logger(__name__)


def without_loops(live: LiveCamera) -> tuple[LiveCamera, str]:
    """A camera whose poses close no loops, since the map would not follow, and what to tell the user; empty where its
    poses close none anyway."""
    poses, _ = table_of(live.poses, "camera.poses")
    if poses.get("kind") != "rgbd" or not poses.get("loop_closure", True):
        return live, ""
    note = (
        "loop closure is off: the option `corrections` of this node is empty, so the map would not follow. Set "
        "corrections = \"query\" (the mapper's option `query`) and, in the mapper's options, history_frames = 3000; or "
        "loop_closure = false in the poses"
    )
    _log.warning("no_loop_closure", reason=note)
    return msgspec.structs.replace(live, poses={**poses, "loop_closure": False}), note


class CorrectionSender:
    """Sends the mapper the newest correction that has not arrived; each one says all that the one before it did."""

    def __init__(self, endpoint: str, camera_id: str) -> None:
        self._endpoint = endpoint
        self._camera_id = camera_id
        self._changed = threading.Condition()
        self._next: CorrectedWorld | None = None
        self._ended = False
        self._sent = 0
        self._trouble = ""
        self._thread = threading.Thread(target=self._run, name="corrections", daemon=True)

    def status(self) -> PartStatus:
        """For the status of the camera."""
        return PartStatus({"corrections_sent": self._sent}, (self._trouble,))

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._thread.join(LAST_S)

    def put(self, corrected: CorrectedWorld) -> None:
        """Send it soon; does not wait."""
        with self._changed:
            self._next = corrected
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._ended or self._next is not None)
                corrected, self._next = self._next, None
            if corrected is None:
                return
            poses = {(self._camera_id, stamp_ns): pose for stamp_ns, pose in corrected.poses.items()}
            try:
                with MapClient(self._endpoint) as client:
                    client.correct_poses(poses, until_ns=corrected.until_ns, within_ns=_SAME_FRAME_NS)
                self._sent += 1
                self._trouble = ""
            except SemanticMapperError as error:
                if not self._trouble:
                    _log.warning("correction_not_taken", reason=str(error))
                self._trouble = f"the map does not follow closed loops: {error}"
                if not isinstance(error, TransportError):
                    continue  # the mapper refuses; it says what to set
                with self._changed:  # it starts again, or hangs
                    if self._ended:
                        return
                    self._next = self._next or corrected
                    self._changed.wait_for(lambda: self._ended, RETRY_S)
