"""A camera and a source of poses as one source of frames; poses that cannot be true are refused and counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from types import TracebackType
from typing import Protocol, Self, runtime_checkable

import numpy as np
import structlog

from drivers.base import Camera, CameraImage, PoseEstimate, PoseSource
from drivers.poses.config import PoseChecks
from drivers.poses.motion import StampedPose, turn_between
from semantic_mapper.errors import PoseError, ShapeError
from semantic_mapper.geometry import check_pose
from semantic_mapper.transport.messages import StreamInfo
from semantic_mapper.types import Float64, PosedFrame

_DEFAULTS = PoseChecks()
FAR = 2.0  # times what is allowed: a jump, whatever comes after it

_log = structlog.get_logger(__name__)


@runtime_checkable
class TellingPoseSource(PoseSource, Protocol):
    """A pose source that tells what is the matter; all of ``drivers.poses`` do."""

    @property
    def troubles(self) -> tuple[str, ...]:
        """One sentence for each thing that does not work as it should now; any thread may ask."""
        ...

    @property
    def counters(self) -> dict[str, int]:
        """Totals since it was opened, by name."""
        ...


class PosedCamera:
    """A ``FrameSource``: the images of a camera, each with its pose.

    An image that gets none is left out, which shows as a gap in ``seq``.

    Args:
        camera: Gives the images.
        poses: Gives their poses.
        checks: What to refuse.
        T_rig_camera: (4, 4) where the poses are those of a rig, and the camera sits there.

    Attributes:
        counters: "frames" given; images left out: "no_pose" (the source has none), "stale" (the image is not later than
            the one before: late, doubled or out of order), "not_rotation" (NaN, mirror, scale), "jumping" (faster than
            the camera can have moved). With "pose_" before them, those of the pose source.
    """

    def __init__(
        self,
        camera: Camera,
        poses: PoseSource,
        checks: PoseChecks = _DEFAULTS,
        *,
        T_rig_camera: Float64 | None = None,
    ) -> None:
        self._camera = camera
        self._poses = poses
        self._checks = checks
        self._T_rig_camera = T_rig_camera
        self._counts: Counter[str] = Counter()
        self._gates: dict[str, _JumpGate] = {}
        self._last_ns: dict[str, int] = {}
        self._trouble = ""

    @property
    def info(self) -> StreamInfo:
        """The camera's."""
        return self._camera.info

    @property
    def counters(self) -> dict[str, int]:
        """Frames given and left out; see the class."""
        own = {name: self._counts[name] for name in ("frames", "no_pose", "stale", "not_rotation", "jumping")}
        if not isinstance(self._poses, TellingPoseSource):
            return own
        return own | {f"pose_{name}": count for name, count in dict(self._poses.counters).items()}

    @property
    def troubles(self) -> tuple[str, ...]:
        """Those of the camera and of the pose source, and why the last pose was refused."""
        told = self._poses.troubles if isinstance(self._poses, TellingPoseSource) else ()
        return (*self._camera.troubles, *told, *((self._trouble,) if self._trouble else ()))

    @property
    def turned_at(self) -> float:
        """The camera's; it comes round no more while a pose is awaited that never comes."""
        return self._camera.turned_at

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

    def __iter__(self) -> Iterator[PosedFrame]:
        """Frames in the order of capture.

        Raises:
            CameraError: the camera is gone, or it cannot have poses from this source.
        """
        for image in self._camera:
            estimate = self._checked_pose(image)
            if estimate is not None:
                self._counts["frames"] += 1
                yield _frame(image, estimate)

    def _checked_pose(self, image: CameraImage) -> PoseEstimate | None:
        if image.stamp_ns <= self._last_ns.get(image.camera_id, -1):
            return self._refuse(image, "stale", "its stamp is not after the one before")
        self._last_ns[image.camera_id] = image.stamp_ns
        estimate = self._poses.pose(image)
        if estimate is None:
            self._counts["no_pose"] += 1
            self._trouble = ""  # the source tells why
            return None
        if self._T_rig_camera is not None:
            estimate = replace(estimate, T_world_camera=estimate.T_world_camera @ self._T_rig_camera)
        try:
            check_pose(estimate.T_world_camera, f"image {image.seq} of '{image.camera_id}'")
        except (PoseError, ShapeError) as error:
            return self._refuse(image, "not_rotation", str(error))
        if not np.isfinite(estimate.sigma) or estimate.sigma < 0:
            return self._refuse(image, "not_rotation", f"its pose has an uncertainty of {estimate.sigma} m")
        gate = self._gates.setdefault(image.camera_id, _JumpGate(self._checks))
        jump = gate.refusal(StampedPose(image.stamp_ns, estimate.T_world_camera))
        if jump:
            return self._refuse(image, "jumping", jump)
        self._trouble = ""
        return estimate

    def _refuse(self, image: CameraImage, reason: str, detail: str) -> None:
        """Count it; tell of it at each power of two."""
        self._counts[reason] += 1
        count = self._counts[reason]
        self._trouble = f"image {image.seq} of '{image.camera_id}' was left out ({reason}): {detail}"
        if count & (count - 1) == 0:
            _log.warning("image_left_out", reason=reason, count=count, detail=self._trouble)


class _JumpGate:
    """Lets poses pass that a camera can have reached from the last one; and the new place, once it is sure of it.

    What is within reach grows with the time since the last pose that passed. A source that has jumped far and goes on
    from there must not pass because of that; one that jumps back may.
    """

    def __init__(self, checks: PoseChecks) -> None:
        self._checks = checks
        self._last: StampedPose | None = None
        self._elsewhere: StampedPose | None = None  # the last refused pose, and ...
        self._agreeing = 0  # ... how many in a row agree with it, and ...
        self._far = False  # ... whether the first of them was so far that no quick movement explains it

    def refusal(self, sample: StampedPose) -> str:
        """Why a pose is refused; empty where it passes."""
        reason = "" if self._last is None else self._jump(self._last, sample)
        follows = self._elsewhere is not None and not self._jump(self._elsewhere, sample)
        if not reason and follows and self._far:
            reason = "it goes on from where the pose had jumped to"
        if reason:
            self._agreeing = self._agreeing + 1 if follows else 1
            if not follows and self._last is not None:
                self._far = bool(self._jump(self._last, sample, FAR))
            self._elsewhere = sample
            if not 0 < self._checks.settle < self._agreeing:
                return reason
            _log.warning("jump_accepted", reason=reason, agreeing=self._agreeing)
        self._last, self._elsewhere, self._agreeing = sample, None, 0
        return ""

    def _jump(self, a: StampedPose, b: StampedPose, times: float = 1.0) -> str:
        seconds = (b.stamp_ns - a.stamp_ns) / 1e9
        moved_m = float(np.linalg.norm(b.T[:3, 3] - a.T[:3, 3]))
        turned_deg = float(np.rad2deg(np.linalg.norm(turn_between(a.T, b.T))))
        allowed_m = times * (self._checks.slack_m + self._checks.max_speed_m_s * seconds)
        allowed_deg = times * (self._checks.slack_deg + self._checks.max_turn_deg_s * seconds)
        if moved_m <= allowed_m and turned_deg <= allowed_deg:
            return ""
        return (
            f"the pose jumps by {moved_m:.2f} m and {turned_deg:.0f} degrees in {seconds:.3f} s; at most "
            f"{allowed_m:.2f} m and {allowed_deg:.0f} degrees are believed (max_speed_m_s, max_turn_deg_s)"
        )


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
    )
