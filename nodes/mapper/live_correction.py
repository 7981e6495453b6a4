"""Corrected poses that reach a mapper while it maps: any thread hands them in, the mapper's thread carries them out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import asdict

import numpy as np
import structlog
from numpy.typing import NDArray

from semantic_mapper.errors import CodecError, MapError
from semantic_mapper.mapping.map_types import CorrectedPoses
from semantic_mapper.mapping.odometry_sessions import OdometrySessions
from semantic_mapper.mapping.pipeline import MappingPipeline
from semantic_mapper.nodes.publishing import PartStatus
from semantic_mapper.queries.questions import Correction, CorrectPosesRequest
from semantic_mapper.replay.corrected_poses import match_frames
from semantic_mapper.replay.session import MapSession
from semantic_mapper.types import Float64

HISTORY_A_STEP = 2  # frames of the history for each step where no time is to spare: more than come, so that it ends
STOPPED_S = 30.0  # how long a mapper that is to stop continues a correction
_REMEMBERED = 64  # requests whose answer may have been lost

_log = structlog.get_logger(__name__)


class LiveCorrection:
    """Takes requests to correct the poses of a pipeline's map, and rebuilds it in the time between two frames."""

    def __init__(self, pipeline: MappingPipeline) -> None:
        self._pipeline = pipeline
        self._corrector = pipeline.corrector
        self._lock = threading.Lock()  # of what requests change
        self._outcomes: dict[str, tuple[int, int]] = {}  # by id of the request, the newest last: poses used, left out
        self._ended = False
        self._followed = 0  # corrections that the session knows of
        self._since_step = 0  # frames of the history
        self._odometry_sessions: OdometrySessions | None = None  # of the session

    @property
    def running(self) -> bool:
        """Whether a correction is under way."""
        return self._corrector.status.running

    def status(self) -> PartStatus:
        """For the mapper's status; no counts where no history is kept."""
        status = self._corrector.status
        failed = f"the last correction of poses was given up: {status.failure}" if status.failure else ""
        if not self._corrector.records:
            return PartStatus({}, (failed,))
        counters = {"corrections": status.completed, "correction_done": status.done, "correction_left": status.left}
        return PartStatus(counters, (failed,))

    def begin(self, request: CorrectPosesRequest) -> Correction:
        """Begin a correction, unless this very request has done so before; see ``MapCorrector.start``. Where it is
        refused (``CodecError``, ``MapError``, ``PoseError``), nothing has changed."""
        with self._lock:
            if request.id not in self._outcomes:
                if self._ended:
                    raise MapError("poses can be corrected no more: the stream has ended, and the map is being written")
                self._outcomes[request.id] = self._begin(request)
                for old in list(self._outcomes)[:-_REMEMBERED]:
                    del self._outcomes[old]
            return self.describe(*self._outcomes[request.id])

    def describe(self, used: int = 0, left_out: int = 0) -> Correction:
        """Where corrections stand."""
        status = asdict(self._corrector.status)
        return Correction(**status, used=used, left_out=left_out, epoch=self._pipeline.voxel_map.epoch)

    def advance(self, session: MapSession | None, *, mapped: bool) -> None:
        """Go on with a correction, for about the time of one frame; for the mapper's thread, between two frames.

        ``session`` follows the map once the correction is done. Where a frame was ``mapped`` since the last call, the
        history goes on by as much as it must, which is nothing where there was time to spare before; else none waits.
        """
        if session is not None:
            self._odometry_sessions = session.odometry_sessions
        if self.running:
            self._advance(max(0, HISTORY_A_STEP - self._since_step) if mapped else 1)
        self._since_step = 0 if mapped else self._since_step + 1
        self._follow(session)

    def finish(self, session: MapSession, stopped: Callable[[], bool], on_wait: Callable[[], None]) -> None:
        """End a correction that is under way, before the results are written; refuse those that come later.

        Once a stop was requested (``stopped``), it continues for ``STOPPED_S`` at most; what is left then is reported
        in the log and in ``session.unfinished_correction``.
        """
        with self._lock:
            self._ended = True
        deadline: float | None = None
        while self.running and (deadline is None or time.monotonic() < deadline):
            if deadline is None and stopped():
                deadline = time.monotonic() + STOPPED_S
            self._advance(1)
            on_wait()
        self._follow(session)
        status = self._corrector.status
        why = f"stopped after {status.done} of {status.total} frames" if status.running else status.failure
        if why:
            session.unfinished_correction = f"the last correction of poses is not in the map: {why}"
            _log.error("correction_unfinished", reason=session.unfinished_correction)

    def _begin(self, request: CorrectPosesRequest) -> tuple[int, int]:
        poses = self._to_frames(request)
        if self._odometry_sessions is not None:
            poses = self._odometry_sessions.in_map(poses)
        known = self._corrector.poses()
        stamps = {stamp_ns for _, stamp_ns in known}
        used = sum((key in known) if isinstance(key, tuple) else (key in stamps) for key in poses)
        self._corrector.start(poses, until_ns=request.until_ns)
        return used, len(request.stamps_ns) - used

    def _to_frames(self, request: CorrectPosesRequest) -> CorrectedPoses:
        """The poses by the frames they are of."""
        stamps, poses = request.stamps_ns, request.poses
        camera, names = request.camera.astype(np.int64), list(request.cameras)
        if not (stamps.shape == camera.shape == poses.shape[:1] and poses.shape[1:] == (4, 4)):
            shapes = f"{stamps.shape}, {camera.shape} and {poses.shape}"
            raise CodecError(f"correct_poses: stamps, cameras, poses of shapes {shapes}, not (N,), (N,), (N, 4, 4)")
        if len(set(names)) < len(names) or ("" in names and len(names) > 1) or (camera >= len(names)).any():
            raise CodecError(f"correct_poses: cameras {names} must differ, and each pose be of one of them")
        if len(set(zip(camera.tolist(), stamps.tolist(), strict=True))) < len(stamps):
            raise MapError("correct_poses: a frame is given twice")
        if request.within_ns:
            return self._nearest_frames(request, camera)
        keys = [(names[c], s) if names[c] else s for c, s in zip(camera.tolist(), stamps.tolist(), strict=True)]
        return dict(zip(keys, poses, strict=True))

    def _nearest_frames(
        self, request: CorrectPosesRequest, camera: NDArray[np.int64]
    ) -> dict[tuple[str, int], Float64]:
        known, stamps = self._corrector.poses(), request.stamps_ns
        cameras = sorted({name for name, _ in known})
        if request.cameras == ("",) and len(cameras) > 1:
            raise MapError(f"correct_poses: the map has frames of the cameras {', '.join(cameras)}; name one")
        found: dict[tuple[str, int], Float64] = {}
        for number, name in enumerate(request.cameras):
            keys = [key for key in known if name in ("", key[0])]
            found |= match_frames(keys, stamps[camera == number], request.poses[camera == number], request.within_ns)
        if not found and len(stamps) and self._corrector.records:
            raise MapError(
                f"correct_poses: none of {len(stamps)} poses was taken within {request.within_ns / 1e6:g} ms of a "
                f"frame in the history ({len(known)} frames"
                + (f" from {min(s for _, s in known) / 1e9:.6f} s" if known else "")
                + f"); the first is of {int(stamps[0]) / 1e9:.6f} s"
            )
        return found

    def _advance(self, frames: int) -> None:
        try:
            self._corrector.advance(frames)
        except MapError as error:  # given up and kept as ``failure``; mapping continues
            _log.warning("map_stays_uncorrected", reason=str(error))

    def _follow(self, session: MapSession | None) -> None:
        completed = self._corrector.status.completed
        if session is not None and completed != self._followed:
            self._followed = completed
            session.follow_correction()
