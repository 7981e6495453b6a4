"""A camera and a source of poses as one source of frames; poses that cannot be true are refused and counted."""

from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from typing import Self

import msgspec
import numpy as np

from semantic_mapper.drivers.base import Camera, CameraImage, CorrectedWorld, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import PoseChecks
from semantic_mapper.drivers.poses.motion import StampedPose, apart
from semantic_mapper.errors import PoseError, ShapeError
from semantic_mapper.geometry import check_pose
from semantic_mapper.log_events import get_logger, is_power_of_two
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import MAX_POSE_SIGMA_M, Float64, PosedFrame

_DEFAULTS = PoseChecks()
REASONS = ("no_pose", "stale", "not_rotation", "outliers", "uninitialized")
MAX_TURN_DEG_S = 360.0  # faster than this between two images is a jump
SLACK_M, SLACK_DEG = 0.05, 3.0  # a pose may be off by so much at any rate
FAR = 2.0  # times what is allowed: a jump, whatever comes after it
# A camera's first frames are held back until this many of their poses in a row agree with each other: a single wrong
# pose, such as a robot's before it knows where it is, is no place to continue from.
INIT_CONSENSUS = 5

Judged = list[tuple[PosedFrame, str, str]]  # frames in the order of capture: why each is left out (counter, sentence)

_log = get_logger(__name__)


class PosedCamera:
    """The images of a camera, each with its pose.

    An image that gets none is left out, which shows as a gap in ``seq``. A camera's first frames are held back until
    some of their poses agree with each other, and are given then. ``T_rig_camera`` (4, 4): where the poses are those of
    a rig, and the camera sits there. ``scale_known``: whether poses are in metres.

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
    ) -> None:
        self._camera = camera
        self._scale_known = scale_known
        self._poses = poses
        self._checks = checks
        self._T_rig_camera = T_rig_camera
        self._counts: Counter[str] = Counter()
        self._filters: dict[str, tuple[int, PoseOutlierFilter]] = {}  # by camera, with the world of its poses
        self._last_ns: dict[str, int] = {}
        self._trouble = ""
        self._open = ExitStack()
        self._corrected: CorrectedWorld | None = None
        self.can_wait = camera.can_wait
        self.stop = camera.stop

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
        return own | {f"pose_{name}": count for name, count in self._poses.counters.items()}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Those of the camera and of the pose source, and why the last pose was refused."""
        return (*self._camera.warnings, *self._poses.warnings, *((self._trouble,) if self._trouble else ()))

    @property
    def last_poll_time(self) -> float:
        """The camera's; it comes round no more while a pose is awaited that never comes."""
        return self._camera.last_poll_time

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            stack.enter_context(self._poses)
            stack.enter_context(self._camera)
            self._open = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._open.close()

    def correction(self, final: bool = False) -> CorrectedWorld | None:
        """As of ``PoseSource``, with poses of the camera; frames given from then on are of the corrected world."""
        if final:
            self._follow_correction(final=True)
        corrected, self._corrected = self._corrected, None
        return corrected

    def __iter__(self) -> Iterator[PosedFrame]:
        """Frames in the order of capture.

        Raises CameraError: the camera is gone, or it cannot have poses from this source.
        """
        for image in self._camera:
            estimate = self._checked_pose(image)
            self._follow_correction()
            if estimate is None:
                continue
            world, outlier_filter = self._filters.get(image.camera_id, (0, None))
            if outlier_filter is None or world != estimate.world:
                if outlier_filter is not None:
                    why = "the camera began another world before its first poses were sure"
                    yield from self._passed(outlier_filter.give_up(why))
                # A pose that comes from the settings is believed at once.
                needed = 1 if estimate.source == "fixed" else INIT_CONSENSUS
                outlier_filter = PoseOutlierFilter(self._checks.max_speed_m_s, needed)
                self._filters[image.camera_id] = estimate.world, outlier_filter
            frame = PosedFrame(
                stamp_ns=image.stamp_ns,
                seq=image.seq,
                camera_id=image.camera_id,
                rgb=image.rgb,
                depth_m=image.depth_m,
                label=None,
                intrinsics=image.intrinsics,
                T_world_camera=np.asarray(estimate.T_world_camera, np.float64),
                pose_source=estimate.source,
                pose_sigma=float(estimate.sigma),
                world=estimate.world,
            )
            yield from self._passed(outlier_filter.take(frame))
        for _, outlier_filter in self._filters.values():
            yield from self._passed(outlier_filter.end())

    def _follow_correction(self, final: bool = False) -> None:
        corrected = self._poses.correction(final)
        if corrected is None:
            return
        for _, outlier_filter in self._filters.values():
            outlier_filter.follow(corrected.motion)
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
            self._trouble = ""  # the source says why
            return None
        if self._T_rig_camera is not None:
            estimate = replace(estimate, T_world_camera=estimate.T_world_camera @ self._T_rig_camera)
        try:
            check_pose(estimate.T_world_camera, f"image {image.seq} of '{image.camera_id}'")
        except (PoseError, ShapeError) as error:
            return self._refuse(image, "not_rotation", str(error))
        if not 0 <= estimate.sigma <= MAX_POSE_SIGMA_M:  # NaN, too
            return self._refuse(image, "not_rotation", f"its pose has an uncertainty of {estimate.sigma} m")
        return estimate

    def _passed(self, judged: Iterable[tuple[PosedFrame, str, str]]) -> Iterator[PosedFrame]:
        for frame, reason, why in judged:
            if reason:
                self._refuse(frame, reason, why)
            else:
                self._trouble = ""
                self._counts["frames"] += 1
                yield frame

    def _refuse(self, image: CameraImage | PosedFrame, reason: str, detail: str) -> None:
        """Count it; log it at each power of two."""
        self._counts[reason] += 1
        count = self._counts[reason]
        self._trouble = f"image {image.seq} of '{image.camera_id}' was left out ({reason}): {detail}"
        if is_power_of_two(count):
            _log.warning("image_left_out", reason=reason, count=count, detail=self._trouble)


class PoseOutlierFilter:
    """Which poses of one camera are believed: the first ones once some in a row agree, then those within reach.

    What is within reach grows with the time since the last pose that passed. A source that has jumped far and
    continues from there must not pass because of that; one that jumps back may.

    Frames are refused as "outliers", which cannot have been reached from poses that are believed, or "uninitialized",
    which did not agree with those after them while none was believed; "" = it passes. So many first poses in a row as
    ``needed`` have to agree.
    """

    def __init__(self, max_speed_m_s: float, needed: int) -> None:
        self._max_speed_m_s = max_speed_m_s
        self._needed = needed
        self._held: list[PosedFrame] = []  # first frames, each of which can have been reached from the one before
        self._contradicted = False  # others were given up before these
        self._last: StampedPose | None = None  # the last one that passed, or is held back
        self._elsewhere: StampedPose | None = None  # the last refused pose of those that go on from a far jump

    def take(self, frame: PosedFrame) -> Judged:
        """Judge the next frame, and with it those that were held back."""
        sample = StampedPose(frame.stamp_ns, frame.T_world_camera)
        if not self._needed and self._last is not None:
            why = self._refusal(self._last, sample)
            return [(frame, "outliers" if why else "", why)]
        jump = self._jump(self._last, sample) if self._held and self._last is not None else ""
        refused = self.give_up(f"the first poses do not agree with each other: {jump}") if jump else []
        self._held.append(frame)
        self._last = sample
        if len(self._held) < self._needed:
            return refused
        self._needed = 0
        return refused + self._pass_held()

    def follow(self, motion: Float64) -> None:
        """The world of the poses to come is another one: ``motion`` (4, 4) takes the last pose there."""
        if self._last is not None and not self._needed:
            self._last = replace(self._last, T=motion @ self._last.T)
        if self._elsewhere is not None:
            self._elsewhere = replace(self._elsewhere, T=motion @ self._elsewhere.T)

    def end(self) -> Judged:
        """No more will come: what is held back passes where no pose has contradicted it."""
        if self._contradicted:
            return self.give_up("too few of the last poses agree with each other")
        return self._pass_held()

    def give_up(self, why: str) -> Judged:
        """What is held back is left out."""
        held, self._held, self._contradicted = self._held, [], True
        return [(frame, "uninitialized", why) for frame in held]

    def _pass_held(self) -> Judged:
        held, self._held = self._held, []
        return [(frame, "", "") for frame in held]

    def _refusal(self, last: StampedPose, sample: StampedPose) -> str:
        """Why a pose is refused; empty where it passes."""
        if self._elsewhere is not None and not self._jump(self._elsewhere, sample):
            self._elsewhere = sample
            moved_m, turned_deg = apart(last.T, sample.T)
            return (
                f"the poses have jumped and continue from there, now {moved_m:.2f} m and {turned_deg:.0f} degrees from "
                f"the last one that was believed, {(sample.stamp_ns - last.stamp_ns) / 1e9:.1f} s ago; they are left "
                "out, since those of another world would spoil the map; if they are right now, start the launch again"
            )
        why = self._jump(last, sample)
        if not why:
            self._last = sample
        self._elsewhere = sample if why and self._jump(last, sample, FAR) else None
        return why

    def _jump(self, a: StampedPose, b: StampedPose, times: float = 1.0) -> str:
        """Why b cannot have been reached from a, with this many times the limits; empty where it can."""
        (moved_m, turned_deg), seconds = apart(a.T, b.T), (b.stamp_ns - a.stamp_ns) / 1e9
        allowed_m = times * (SLACK_M + self._max_speed_m_s * seconds)
        allowed_deg = times * (SLACK_DEG + MAX_TURN_DEG_S * seconds)
        if moved_m <= allowed_m and turned_deg <= allowed_deg:
            return ""
        return (
            f"the pose jumps by {moved_m:.2f} m and {turned_deg:.0f} degrees in {seconds:.3f} s; at most "
            f"{allowed_m:.2f} m and {allowed_deg:.0f} degrees are believed (max_speed_m_s)"
        )
