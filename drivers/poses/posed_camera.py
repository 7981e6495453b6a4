"""A camera and a source of poses as one source of frames; poses that cannot be true are refused and counted."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

import msgspec
import numpy as np

from semantic_mapper.drivers.base import Camera, CameraImage, CorrectedWorld, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import PoseChecks
from semantic_mapper.drivers.poses.outlier_filter import FilterResult, PoseOutlierFilter
from semantic_mapper.errors import PoseError, ShapeError
from semantic_mapper.geometry import check_pose
from semantic_mapper.log_events import get_logger, is_power_of_two
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import MAX_POSE_SIGMA_M, Float64, PosedFrame

_DEFAULTS = PoseChecks()
EXACT = ("fixed",)  # sources whose poses come from the settings: the first one is not doubted
REASONS = ("no_pose", "stale", "not_rotation", "outliers", "uninitialized")

_log = get_logger(__name__)


@runtime_checkable
class DiagnosticPoseSource(PoseSource, Protocol):
    """A pose source that tells what is the matter; all of ``semantic_mapper.drivers.poses`` do."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence for each thing that does not work as it should now; any thread may ask."""
        ...

    @property
    def counters(self) -> dict[str, int]:
        """Totals since it was opened, by name."""
        ...


@runtime_checkable
class CorrectingPoseSource(PoseSource, Protocol):
    """A pose source that closes loops."""

    def correction(self, final: bool = False) -> CorrectedWorld | None:
        """New poses of past images, once after each change; ``final``: no more images will come."""
        ...


class PosedCamera:
    """A ``FrameSource``: the images of a camera, each with its pose.

    An image that gets none is left out, which shows as a gap in ``seq``. A camera's first frames are held back until
    some of their poses agree with each other (``init_consensus``), and are given then.

    Args:
        camera: Gives the images.
        poses: Gives their poses.
        checks: What to refuse.
        T_rig_camera: (4, 4) where the poses are those of a rig, and the camera sits there.
        scale_known: Whether poses are in metres.
        begins_world: The world of the poses begins with this source, and is another one each time.

    Attributes:
        counters: "frames" given; images left out: "no_pose" (the source has none), "stale" (the image is not later than
            the one before: late, doubled or out of order), "not_rotation" (NaN, mirror, scale), "outliers" (faster than
            the camera can have moved), "uninitialized" (at the beginning, while poses do not agree with each
            other). With "pose_" before them, those of the pose source.
    """

    def __init__(
        self,
        camera: Camera,
        poses: PoseSource,
        checks: PoseChecks = _DEFAULTS,
        *,
        T_rig_camera: Float64 | None = None,
        scale_known: bool = True,
        begins_world: bool = False,
    ) -> None:
        self._world = time.monotonic_ns() if begins_world else 0
        self._worlds: dict[str, int] = {}  # of each camera's last pose
        self._camera = camera
        self._scale_known = scale_known
        self._poses = poses
        self._checks = checks
        self._T_rig_camera = T_rig_camera
        self._counts: Counter[str] = Counter()
        self._gates: dict[str, PoseOutlierFilter] = {}
        self._last_ns: dict[str, int] = {}
        self._trouble = ""
        self._corrected: CorrectedWorld | None = None

    @property
    def info(self) -> StreamInfo:
        """The camera's; it says so where poses are not in metres."""
        info = self._camera.info
        if self._scale_known:
            return info
        return msgspec.structs.replace(info, metadata={**info.metadata, SCALE_KEY: SCALE_UNKNOWN})

    @property
    def counters(self) -> dict[str, int]:
        """Frames given and left out; see the class."""
        own = {name: self._counts[name] for name in ("frames", *REASONS)}
        if not isinstance(self._poses, DiagnosticPoseSource):
            return own
        return own | {f"pose_{name}": count for name, count in dict(self._poses.counters).items()}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Those of the camera and of the pose source, and why the last pose was refused."""
        told = self._poses.warnings if isinstance(self._poses, DiagnosticPoseSource) else ()
        return (*self._camera.warnings, *told, *((self._trouble,) if self._trouble else ()))

    @property
    def can_wait(self) -> bool:
        """The camera's."""
        return self._camera.can_wait

    @property
    def last_poll_time(self) -> float:
        """The camera's; it comes round no more while a pose is awaited that never comes."""
        return self._camera.last_poll_time

    def __enter__(self) -> Self:
        self._poses.__enter__()
        try:
            self._camera.__enter__()
        except BaseException as error:
            self._poses.__exit__(type(error), error, error.__traceback__)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self._camera.__exit__(kind, error, trace)
        finally:
            self._poses.__exit__(kind, error, trace)

    def stop(self) -> None:
        """End the iteration soon, from any thread or signal handler."""
        self._camera.stop()

    def correction(self, final: bool = False) -> CorrectedWorld | None:
        """Better poses of past frames, since the pose source has closed a loop; None where nothing has changed.

        To be asked for after each frame, which then is of the corrected world.

        Args:
            final: No more frames are wanted.
        """
        if final:
            self._follow_correction(final=True)
        corrected, self._corrected = self._corrected, None
        return corrected

    def __iter__(self) -> Iterator[PosedFrame]:
        """Frames in the order of capture.

        Raises:
            CameraError: the camera is gone, or it cannot have poses from this source.
        """
        for image in self._camera:
            estimate = self._checked_pose(image)
            self._follow_correction()
            if estimate is not None:
                if self._worlds.setdefault(image.camera_id, estimate.world) != estimate.world:
                    self._worlds[image.camera_id] = estimate.world
                    if (old := self._gates.pop(image.camera_id, None)) is not None:
                        yield from self._passed(old.abandon(), image.camera_id)
                gate = self._gates.setdefault(
                    image.camera_id, PoseOutlierFilter(self._checks, exact=estimate.source in EXACT)
                )
                yield from self._passed(gate.take(_frame(image, estimate)), image.camera_id)
        for camera_id, gate in self._gates.items():
            yield from self._passed(gate.end(), camera_id)

    def _follow_correction(self, final: bool = False) -> None:
        if not isinstance(self._poses, CorrectingPoseSource):
            return
        corrected = self._poses.correction(final)
        if corrected is None:
            return
        for gate in self._gates.values():
            gate.follow(corrected.motion)
        if self._T_rig_camera is not None:
            cameras = {stamp_ns: pose @ self._T_rig_camera for stamp_ns, pose in corrected.poses.items()}
            corrected = replace(corrected, poses=cameras)
        self._corrected = corrected

    def _checked_pose(self, image: CameraImage) -> PoseEstimate | None:
        if image.stamp_ns <= self._last_ns.get(image.camera_id, -1):
            return self._refuse(image, "stale", "its stamp is not after the one before")
        self._last_ns[image.camera_id] = image.stamp_ns
        estimate = self._poses.pose(image)
        if estimate is None:
            self._counts["no_pose"] += 1
            self._trouble = ""  # the source tells why
            return None
        estimate = replace(estimate, world=self._world + estimate.world)
        if self._T_rig_camera is not None:
            estimate = replace(estimate, T_world_camera=estimate.T_world_camera @ self._T_rig_camera)
        try:
            check_pose(estimate.T_world_camera, f"image {image.seq} of '{image.camera_id}'")
        except (PoseError, ShapeError) as error:
            return self._refuse(image, "not_rotation", str(error))
        if not 0 <= estimate.sigma <= MAX_POSE_SIGMA_M:  # NaN, too
            return self._refuse(image, "not_rotation", f"its pose has an uncertainty of {estimate.sigma} m")
        return estimate

    def _passed(self, verdict: FilterResult, camera_id: str) -> Iterator[PosedFrame]:
        for frame, why in verdict.outliers:
            self._refuse(frame, "outliers", why)
        for frame, why in verdict.uninitialized:
            self._refuse(frame, "uninitialized", why)
        if verdict.waiting:
            self._trouble = f"frames of '{camera_id}' are held back: {verdict.waiting}"
        elif verdict.passed:
            self._trouble = ""
        for frame in verdict.passed:
            self._counts["frames"] += 1
            yield frame

    def _refuse(self, image: CameraImage | PosedFrame, reason: str, detail: str) -> None:
        """Count it; tell of it at each power of two."""
        self._counts[reason] += 1
        count = self._counts[reason]
        self._trouble = f"image {image.seq} of '{image.camera_id}' was left out ({reason}): {detail}"
        if is_power_of_two(count):
            _log.warning("image_left_out", reason=reason, count=count, detail=self._trouble)


def _frame(image: CameraImage, estimate: PoseEstimate) -> PosedFrame:
    T_world_camera: Float64 = np.asarray(estimate.T_world_camera, np.float64)
    return PosedFrame(
        stamp_ns=image.stamp_ns,
        seq=image.seq,
        camera_id=image.camera_id,
        rgb=image.rgb,
        depth_m=image.depth_m,
        label=None,
        intrinsics=image.intrinsics,
        T_world_camera=T_world_camera,
        pose_source=estimate.source,
        pose_sigma=float(estimate.sigma),
        world=estimate.world,
    )
