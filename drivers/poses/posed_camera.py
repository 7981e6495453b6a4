"""A camera and a source of poses as one source of frames; poses that cannot be true are refused and counted."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from types import TracebackType
from typing import Self

import msgspec
import numpy as np

from semantic_mapper.drivers.base import Camera, CameraImage, CorrectedWorld, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import PoseChecks
from semantic_mapper.drivers.poses.motion import StampedPose
from semantic_mapper.errors import PoseError, ShapeError
from semantic_mapper.geometry import check_pose, pose_distance
from semantic_mapper.log_events import get_logger, is_power_of_two
from semantic_mapper.transport.messages import SCALE_KEY, SCALE_UNKNOWN, StreamInfo
from semantic_mapper.types import MAX_POSE_SIGMA_M, Float64, PosedFrame

_DEFAULTS = PoseChecks()
EXACT = ("fixed",)  # sources whose poses come from the settings: the first one is believed at once
REASONS = ("no_pose", "stale", "not_rotation", "outliers", "uninitialized")
MAX_TURN_DEG_S = 360.0  # faster than this between two images is a jump
SLACK_M, SLACK_DEG = 0.05, 3.0  # a pose may be off by so much at any rate
FAR = 2.0  # times what is allowed: a jump, whatever comes after it
HELD = 3  # times ``init_consensus``: this many frames are held back at most while the first poses do not agree

_log = get_logger(__name__)


class PosedCamera:
    """The images of a camera, each with its pose.

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
        self._world_by_camera: dict[str, int] = {}  # of each camera's last pose
        self._camera = camera
        self._scale_known = scale_known
        self._poses = poses
        self._checks = checks
        self._T_rig_camera = T_rig_camera
        self._counts: Counter[str] = Counter()
        self._filters: dict[str, PoseOutlierFilter] = {}
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
        return own | {f"pose_{name}": count for name, count in self._poses.counters.items()}

    @property
    def warnings(self) -> tuple[str, ...]:
        """Those of the camera and of the pose source, and why the last pose was refused."""
        return (*self._camera.warnings, *self._poses.warnings, *((self._trouble,) if self._trouble else ()))

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
        """As of ``PoseSource``, with poses of the camera; frames given from then on are of the corrected world."""
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
            camera_id = image.camera_id
            estimate = self._checked_pose(image)
            self._follow_correction()
            if estimate is None:
                continue
            if self._world_by_camera.setdefault(camera_id, estimate.world) != estimate.world:
                self._world_by_camera[camera_id] = estimate.world
                if (old := self._filters.pop(camera_id, None)) is not None:
                    yield from self._passed(old.abandon(), camera_id)
            if camera_id not in self._filters:
                self._filters[camera_id] = PoseOutlierFilter(self._checks, exact=estimate.source in EXACT)
            yield from self._passed(self._filters[camera_id].take(_frame(image, estimate)), camera_id)
        for camera_id, outlier_filter in self._filters.items():
            yield from self._passed(outlier_filter.end(), camera_id)

    def _follow_correction(self, final: bool = False) -> None:
        corrected = self._poses.correction(final)
        if corrected is None:
            return
        for outlier_filter in self._filters.values():
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

    def _passed(self, result: FilterResult, camera_id: str) -> Iterator[PosedFrame]:
        for frame, why in result.outliers:
            self._refuse(frame, "outliers", why)
        for frame, why in result.uninitialized:
            self._refuse(frame, "uninitialized", why)
        if result.waiting:
            self._trouble = f"frames of '{camera_id}' are held back: {result.waiting}"
        elif result.passed:
            self._trouble = ""
        for frame in result.passed:
            self._counts["frames"] += 1
            yield frame

    def _refuse(self, image: CameraImage | PosedFrame, reason: str, detail: str) -> None:
        """Count it; log it at each power of two."""
        self._counts[reason] += 1
        count = self._counts[reason]
        self._trouble = f"image {image.seq} of '{image.camera_id}' was left out ({reason}): {detail}"
        if is_power_of_two(count):
            _log.warning("image_left_out", reason=reason, count=count, detail=self._trouble)


def _frame(image: CameraImage, estimate: PoseEstimate) -> PosedFrame:
    return PosedFrame(
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


@dataclass(frozen=True, slots=True, eq=False)
class FilterResult:
    """What becomes of a frame, and of those that were held back before it.

    Args:
        passed: Frames to give, in the order of capture.
        outliers, uninitialized: Frames to leave out, each with why: it cannot have been reached from poses that are
            believed; or no poses are believed yet, and it did not agree with those around it.
        waiting: Why frames are held back though they contradict each other; empty where they do not.
    """

    passed: tuple[PosedFrame, ...] = ()
    outliers: tuple[tuple[PosedFrame, str], ...] = ()
    uninitialized: tuple[tuple[PosedFrame, str], ...] = ()
    waiting: str = ""


class PoseOutlierFilter:
    """Which poses of one camera are believed: the first ones once some agree, then those that can have been reached.

    First frames stand in chains, in each of which a pose can be reached from the one before. A chain is believed when
    it is ahead of every other by ``init_consensus``: a wrong first pose loses against what follows it, and of two
    odometry sessions that take turns none is believed. From there, what is within reach grows with the time since
    the last pose that passed. A source that has jumped far and continues from there must not pass because of that; one
    that jumps back may.

    Args:
        checks: The limits.
        exact: The first pose is right.
    """

    def __init__(self, checks: PoseChecks, exact: bool = False) -> None:
        self._checks = checks
        self._agree = 1 if exact else checks.init_consensus
        self._chains: list[list[PosedFrame]] = []  # the one that was last added to is the last
        self._last: StampedPose | None = None  # that was believed; None while first frames are held back
        self._elsewhere: StampedPose | None = None  # the last refused pose, and ...
        self._agreeing = 0  # ... how many in a row agree with it, and ...
        self._far = False  # ... whether the first of them was so far that no quick movement explains it

    def take(self, frame: PosedFrame) -> FilterResult:
        """Judge the next frame."""
        sample = _sample(frame)
        if self._last is None:
            return self._take_first(frame, sample)
        reason = self._refusal(self._last, sample)
        return FilterResult(outliers=((frame, reason),)) if reason else FilterResult((frame,))

    def follow(self, motion: Float64) -> None:
        """The world of the poses to come is another one: ``motion`` (4, 4) takes the last pose there."""
        if self._last is not None:
            self._last = replace(self._last, T=motion @ self._last.T)
        if self._elsewhere is not None:
            self._elsewhere = replace(self._elsewhere, T=motion @ self._elsewhere.T)

    def abandon(self) -> FilterResult:
        """The world of the poses has ended: what is held back is left out."""
        why = "the camera began another world before its first poses were sure"
        return FilterResult() if self._last is not None else self._give_up(why)

    def end(self) -> FilterResult:
        """No more will come: what is held back passes where no pose has contradicted it."""
        if self._last is None and len(self._chains) == 1:
            return FilterResult(tuple(self._chains[0]))
        return FilterResult() if self._last is not None else self._give_up(self._contradiction())

    def _take_first(self, frame: PosedFrame, sample: StampedPose) -> FilterResult:
        """The frames of the chain that is believed now, or none."""
        # The chain that the frame follows most closely; not the longest: what is within reach of a chain grows while
        # another one grows.
        fractions = [(_reach(self._checks, _sample(chain[-1]), sample), chain) for chain in self._chains]
        fraction, chain = min(fractions, key=lambda found: found[0], default=(np.inf, []))
        chain = chain if fraction <= 1 else []
        chain.append(frame)
        others = [c for c in self._chains if c is not chain]
        self._chains = [*others, chain]
        if len(chain) - max((len(c) for c in others), default=0) >= self._agree:
            why = f"its pose does not agree with {len(chain)} others that agree with each other"
            self._last = sample
            return FilterResult(tuple(chain), outliers=tuple((f, why) for f in _in_order(others)))
        waiting = self._contradiction()
        if sum(len(c) for c in self._chains) < HELD * self._agree:
            return FilterResult(waiting=waiting)
        return self._give_up(waiting)

    def _give_up(self, why: str) -> FilterResult:
        held, self._chains = _in_order(self._chains), []
        return FilterResult(uninitialized=tuple((f, why) for f in held), waiting=why)

    def _contradiction(self) -> str:
        if len(self._chains) < 2:
            return ""
        before, after = sorted((_sample(chain[-1]) for chain in self._chains[-2:]), key=lambda s: s.stamp_ns)
        return (
            f"the first poses do not agree with each other ({_jump(self._checks, before, after)}); "
            f"none is believed before {self._agree} agree (init_consensus)"
        )

    def _refusal(self, last: StampedPose, sample: StampedPose) -> str:
        """Why a pose is refused; empty where it passes."""
        reason = _jump(self._checks, last, sample)
        follows = self._elsewhere is not None and not _jump(self._checks, self._elsewhere, sample)
        needed = self._checks.relocalize_after
        if follows and self._far:
            moved_m, turned_deg, seconds = _way(last, sample)
            way_out = (
                f"after {needed} of them that agree with each other they are believed (relocalize_after)"
                if needed
                else "if they are right now, start the launch again, or set checks = { relocalize_after = N } in the "
                "table `poses`: after a jump, N poses in a row that agree with each other are believed then, such as "
                "N = 30"
            )
            reason = (
                f"the poses have jumped and continue from there, now {moved_m:.2f} m and {turned_deg:.0f} degrees from "
                f"the last one that was believed, {seconds:.1f} s ago; they are left out, since those of another world "
                f"would spoil the map; {way_out}"
            )
        if reason:
            self._agreeing = self._agreeing + 1 if follows else 1
            if not follows:
                self._far = bool(_jump(self._checks, last, sample, FAR))
            self._elsewhere = sample
            if not 0 < needed < self._agreeing:
                return reason
            _log.warning("jump_accepted", reason=reason, agreeing=self._agreeing)
        self._last, self._elsewhere, self._agreeing = sample, None, 0
        return ""


def _sample(frame: PosedFrame) -> StampedPose:
    return StampedPose(frame.stamp_ns, frame.T_world_camera)


def _way(a: StampedPose, b: StampedPose) -> tuple[float, float, float]:
    """Metres, degrees and seconds from a to b."""
    moved_m, turned = pose_distance(a.T, b.T)
    return moved_m, float(np.rad2deg(turned)), (b.stamp_ns - a.stamp_ns) / 1e9


def _in_order(chains: list[list[PosedFrame]]) -> list[PosedFrame]:
    return sorted((frame for chain in chains for frame in chain), key=lambda f: f.stamp_ns)


def _allowed(checks: PoseChecks, seconds: float) -> tuple[float, float]:
    """Metres and degrees that are believed in that time."""
    return SLACK_M + checks.max_speed_m_s * seconds, SLACK_DEG + MAX_TURN_DEG_S * seconds


def _reach(checks: PoseChecks, a: StampedPose, b: StampedPose) -> float:
    """The way from a to b by what is allowed in that time; above 1 it is a jump."""
    moved_m, turned_deg, seconds = _way(a, b)
    allowed_m, allowed_deg = _allowed(checks, seconds)
    return max(moved_m / allowed_m, turned_deg / allowed_deg)


def _jump(checks: PoseChecks, a: StampedPose, b: StampedPose, times: float = 1.0) -> str:
    """Why b cannot have been reached from a, with this many times the limits; empty where it can."""
    if _reach(checks, a, b) <= times:
        return ""
    moved_m, turned_deg, seconds = _way(a, b)
    allowed_m, allowed_deg = (times * limit for limit in _allowed(checks, seconds))
    return (
        f"the pose jumps by {moved_m:.2f} m and {turned_deg:.0f} degrees in {seconds:.3f} s; at most "
        f"{allowed_m:.2f} m and {allowed_deg:.0f} degrees are believed (max_speed_m_s)"
    )
