"""RGB-D odometry: where a camera with depth went, from its images alone.

Each view is aligned to keyframes, not to the view before, so that errors add up from keyframe to keyframe only. Where
the camera comes back to old ones, a pose graph takes the errors back (``loop_closure``). The first guess continues
the last motion; where that leads nowhere, or the result off it, corners that view and keyframe or the last image share
give others. Directions of which the points show nothing (along a wall that fills the picture) follow the motion and the
corners, and the uncertainty grows. A view that lies on no keyframe is lost: no pose, until its corners are found in a
keyframe again. A camera that stays lost begins a new world, in which no loops are closed: the map is of the first one.

Same images, same poses and corrections, bit for bit.
"""

import time
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np

from semantic_mapper.drivers.base import CameraImage, CorrectedWorld, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import WAYS_OUT, OdometryPoses, can_be_found
from semantic_mapper.drivers.poses.loop_closure import (
    DRIFT,
    MIN_MATCHES,
    MIN_OVERLAP,
    PLACE_FEATURES,
    KeyframeGraph,
    LoopCloser,
    OdometryKeyframe,
    lies_on,
    within,
)
from semantic_mapper.drivers.poses.motion import StampedPose, apart
from semantic_mapper.errors import CameraError
from semantic_mapper.geometry import interpolate_pose, invert_pose, make_pose, rotation_vector
from semantic_mapper.localization.depth_alignment import (
    NOISE_M,
    POINTS_A_VOTE,
    Fit,
    Level,
    Target,
    align,
    fit,
    flat_directions,
    make_levels,
    thin_depth,
    thin_intrinsics,
)
from semantic_mapper.localization.features import Features, find_features, find_place_features, pose_from_features
from semantic_mapper.log_events import get_logger, is_power_of_two
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

WIDTH = 320  # images are thinned out to about this
DEPTH_MAX_M = 4.0
NEIGHBOURS = 3  # keyframes that a frame is aligned to
KEYFRAME_M = 0.35  # a new one when moved this far from the nearest, or ...
KEYFRAME_DEG = 20.0  # ... turned this far, or ...
KEYFRAME_OVERLAP = 0.55  # ... seeing less than this in common with it, or off its way by another one than before
MAX_STEP = 0.25, 15.0  # metres, degrees: a result further from its first guess is wrong
FEATURES = 500  # ORB corners an image, for first guesses and for finding back
RELOCALISE_KEYFRAMES = 20  # tried for each image while lost, in turn
_LEAST_DEPTH = 0.05  # fraction of the pixels that need depth
_RECENT_NS = 700_000_000  # after so long without a pose the last motion says nothing any more
_JUMP = 0.06, 4.0  # m, degrees from where the last motion leads, where another keyframe is nearest than before
_WORSE = 2.5  # times the noise of the fits before: a view that has left the last motion lies on nothing then
_LEAST_NOISE_M = 0.002
_NOISE_GAIN = 0.1
_GUESSED = 0.5  # of a step along what no point shows: how far it may be wrong
_LEVER_M = 0.3  # a radian of such a turn is as much as this shift
_STANDING_M = 0.005  # as much for a step by corners, or a camera that seems to stand: it is not lost for that
_UNSURE_M = 0.15  # an image that may be further off by such steps has no pose
_AWAY_NS = 2_000_000_000  # a camera that gave no image for so long may be anywhere
_LOST_NS = 5_000_000_000  # lost for so long, it begins a new world ...
_YOUNG = 5  # ... and at once in a world of fewer images: the first views may have shown too little
_PAUSE_NS = 2_000_000_000  # between two corrections: each is work for the map

_log = get_logger(__name__)


@dataclass(eq=False)
class _View:
    stamp_ns: int
    rgb: UInt8
    depth_m: Float32
    intrinsics: CameraIntrinsics
    levels: tuple[Level, ...]

    @cached_property
    def features(self) -> Features:
        """Its corners, found when they are needed."""
        return find_features(self.rgb, self.depth_m, FEATURES)


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """Where a view lies on keyframes."""

    T_world_camera: Float64  # (4, 4)
    nearest: OdometryKeyframe  # the keyframe that it was aligned to first
    fits: list[Fit]  # to the keyframes that it was aligned to
    unsure_m: float  # how far it may be off along what no point shows


class OdometryPoseSource(PoseSource):
    """Follows one RGB-D camera. Not for several threads at once, but any may read ``counters`` and ``warnings``.

    Attributes:
        counters: "tracked" images; "lost" ones; how often the camera was "relocalised"; "keyframes" made;
            "new_sessions" after the first; with ``loop_closure`` "loops_closed" and "loops_refused".
    """

    def __init__(self, config: OdometryPoses) -> None:
        super().__init__()
        self._config = config
        # That of another process, or of this one after it, is another world.
        self._world = time.monotonic_ns() if can_be_found(config) else 0
        self._corrected: CorrectedWorld | None = None
        self._closed_ns = -_PAUSE_NS
        self._lost_ns: int | None = None  # since when it is lost
        self._begin_world(closes_loops=config.loop_closure)

    def _begin_world(self, closes_loops: bool) -> None:
        self._graph = KeyframeGraph()
        self._closer = LoopCloser(self._graph, self._counters) if closes_loops else None
        self._past: list[StampedPose] = []  # the last two poses
        self._before: _View | None = None  # the image of the last pose
        self._images = 0  # with a pose in this world
        self._nearest = -1  # keyframe that the last image was aligned to first
        self._next_try = 0  # keyframe that is tried next while lost
        self._noise_m = 0.0  # mean of the last fits
        self._unsure_m = 0.0  # how far the last pose may be off along what no point shows

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """Pose of the next image; None while lost. ``CameraError``: it has no depth, or is of another camera."""
        if image.depth_m is None and self._camera is None:
            raise CameraError(
                f"camera '{image.camera_id}' has no depth: from its images alone the scale of its motion cannot be "
                f"known, and no map be made; {WAYS_OUT}"
            )
        self._expect_one_camera(image)
        self._close_loops(image.stamp_ns)
        view = self._view(image)
        if view is None:
            self._lose(image.stamp_ns, "it has hardly any depth")
            self._lost_ns = image.stamp_ns  # such images do not mean that the place is another one
            return None
        if not self._past:
            return self._begin(view)
        if image.stamp_ns - self._past[-1].stamp_ns > _AWAY_NS and not self._lost:
            self._lost_ns = image.stamp_ns
            _log.warning("odometry_lost", reason=f"no image came for more than {_AWAY_NS // 10**9} s")
        guesses = self._guesses_while_lost(view) if self._lost else self._guesses(view)
        found = next((found for guess in guesses if (found := self._try(view, guess)) is not None), None)
        # A result that is not where the last motion leads may be wrong.
        if found is None or not (self._lost or within(self._expected(view.stamp_ns), found.T_world_camera, _JUMP)):
            found = self._second_look(view, found, guesses)
        if found is None:
            return self._lose_or_begin(view, "it lies on no keyframe")
        if found.unsure_m > _UNSURE_M:
            self._unsure_m = found.unsure_m  # until it sees more
            return self._lose_or_begin(view, "it sees nothing that shows where along a surface it is")
        return self._accept(view, found)

    @property
    def _lost(self) -> bool:
        return self._lost_ns is not None

    def _second_look(self, view: _View, found: _Found | None, expected: list[Float64]) -> _Found | None:
        """The best fit among what was found and what the image before says; None where it is a bad one.

        The motion has changed at once, or the view lies on nothing. Sliding along a surface shows in a fit that is
        worse than those before; a pattern that repeats itself, in a motion that corners do not show.
        """
        results = [] if found is None else [found]
        last = self._past[-1]
        if view.stamp_ns - last.stamp_ns < _RECENT_NS:
            corners = self._corner_motion(view)
            expected = expected if corners is None else [last.T @ corners]
            tried = [self._try(view, guess) for guess in ([last.T] if corners is None else [*expected, last.T])]
            results += [result for result in tried if result is not None]
            results = [r for r in results if any(within(pose, r.T_world_camera, _JUMP) for pose in expected)]
        best = min(results, key=lambda r: r.fits[0].noise_m, default=None)
        noise_m = max(self._noise_m or NOISE_M, _LEAST_NOISE_M)
        return None if best is None or best.fits[0].noise_m > _WORSE * noise_m else best

    def _corner_motion(self, view: _View) -> Float64 | None:
        """T_before_camera (4, 4) from the last image that had a pose, by the corners of both; None without enough."""
        if self._before is None:
            return None
        match = pose_from_features(view.features, self._before.features, view.intrinsics, MIN_MATCHES)
        return None if match is None else match[0]

    def correction(self, final: bool = False) -> CorrectedWorld | None:
        """New poses of past images since loops were closed, or None."""
        while final and self._closer is not None and self._closer.busy:
            self._close_loops(None)
        if final:
            self._corrected = self._graph.correction(final) or self._corrected
        corrected, self._corrected = self._corrected, None
        return corrected

    def _close_loops(self, stamp_ns: int | None) -> None:
        """Look at one candidate; where keyframes move, the last poses move along, at most once in a while."""
        if self._closer is None:
            return
        due = stamp_ns is None or stamp_ns - self._closed_ns > _PAUSE_NS
        poses = self._closer.work(optimize=due)
        if poses is None:
            return
        self._closed_ns = self._closed_ns if stamp_ns is None else stamp_ns
        nearest = [self._graph.near(past.T, 1)[0] for past in self._past]
        moves = [poses[k.number] @ invert_pose(k.target.T_world_camera) for k in nearest]
        self._past = [replace(past, T=move @ past.T) for move, past in zip(moves, self._past, strict=True)]
        self._graph.move(poses)
        self._corrected = self._graph.correction(final=False) or self._corrected

    def _view(self, image: CameraImage) -> _View | None:
        """None without enough depth."""
        if image.depth_m is None:
            return None
        stride = max(1, round(image.intrinsics.width / WIDTH))
        intrinsics = thin_intrinsics(image.intrinsics, stride, stride // 2)
        depth = thin_depth(image.depth_m, stride, DEPTH_MAX_M)
        if float((depth > 0).mean()) < _LEAST_DEPTH:
            return None
        size = (intrinsics.width, intrinsics.height)
        rgb = np.asarray(cv2.resize(image.rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        return _View(image.stamp_ns, rgb, depth, intrinsics, make_levels(depth, intrinsics))

    def _begin(self, view: _View) -> PoseEstimate:
        pose = np.array(self._config.T_world_start)
        self._add_keyframe(view, pose, 0.0, None)
        return self._given(view, pose, 0.0)

    def _given(self, view: _View, pose: Float64, sigma_m: float) -> PoseEstimate:
        self._past, self._before = [*self._past[-1:], StampedPose(view.stamp_ns, pose)], view
        self._lost_ns, self._warnings = None, ()
        self._images += 1
        self._counters["tracked"] += 1
        return PoseEstimate(pose, "odometry", sigma_m, self._world)

    def _guesses(self, view: _View) -> list[Float64]:
        """The last motion continued, and what corners say; that first which lies better on the nearest keyframe."""
        expected = self._expected(view.stamp_ns)
        guesses = [expected, *self._guesses_of_features(view, self._graph.near(expected, NEIGHBOURS))]
        return sorted(guesses, key=lambda T: fit(view.levels, self._graph.near(T, 1)[0].target, T).cost_m)

    def _expected(self, stamp_ns: int) -> Float64:
        if len(self._past) < 2:
            return self._past[-1].T
        a, b = self._past
        return interpolate_pose(a.T, b.T, min((stamp_ns - a.stamp_ns) / (b.stamp_ns - a.stamp_ns), 3.0))

    def _guesses_while_lost(self, view: _View) -> list[Float64]:
        """What corners say of keyframes near the last pose, then of the others, this many an image in turn."""
        last = self._past[-1]
        near = self._graph.near(last.T, NEIGHBOURS)
        frames = [*self._graph.frames.values()]
        count = min(len(frames), RELOCALISE_KEYFRAMES)
        turn = [frames[(self._next_try + i) % len(frames)] for i in range(count)]
        self._next_try = (self._next_try + count) % len(frames)
        guesses = self._guesses_of_features(view, near + [k for k in turn if k not in near])
        return [last.T, *guesses] if view.stamp_ns - last.stamp_ns < _RECENT_NS else guesses

    def _guesses_of_features(self, view: _View, keyframes: list[OdometryKeyframe]) -> list[Float64]:
        """Those with the most corners in agreement first."""
        matches = [(k, pose_from_features(view.features, k.features, view.intrinsics, MIN_MATCHES)) for k in keyframes]
        found = [(match[1], k.target.T_world_camera @ match[0]) for k, match in matches if match is not None]
        return [pose for _, pose in sorted(found, key=lambda item: -item[0])]

    def _try(self, view: _View, guess: Float64) -> _Found | None:
        """Align a view to the keyframes near a guess; None where the result cannot be believed."""
        nearest, *others = self._graph.near(guess, NEIGHBOURS)
        used = [nearest, *(k for k in others if fit(view.levels, k.target, guess).overlap >= MIN_OVERLAP)]
        targets = [k.target for k in used]
        pose = align(view.levels, targets, guess)
        if pose is None or not within(guess, pose, MAX_STEP):
            return None
        fits = [fit(view.levels, t, pose) for t in targets]
        unsure_m = min(k.unsure_m for k in used)
        flat = flat_directions([f.normal_matrix for f in fits])
        if flat is not None:
            pose, unsure_m = self._go_on(view, pose, flat, guess)
            fits = [fit(view.levels, t, pose) for t in targets]
        return _Found(pose, nearest, fits, unsure_m) if lies_on(fits[0]) else None

    def _go_on(
        self, view: _View, pose: Float64, flat: tuple[Float64, Float64], guess: Float64
    ) -> tuple[Float64, float]:
        """The aligned pose with the turns and shifts that no point shows (projections ``flat``, in the camera's axes)
        as corners of the last image say, else as guessed; and how far it may be off there, metres."""
        corners = None if self._lost else self._corner_motion(view)
        last = self._past[-1].T
        wanted = guess if corners is None else last @ corners
        moved = pose @ make_pose(flat[0] @ rotation_vector(invert_pose(pose) @ wanted), np.zeros(3))
        shifts = pose[:3, :3] @ flat[1] @ pose[:3, :3].T
        moved[:3, 3] += shifts @ (wanted[:3, 3] - pose[:3, 3])
        step_m = float(np.linalg.norm(shifts @ (moved[:3, 3] - last[:3, 3])))
        step_m += _LEVER_M * float(np.linalg.norm(flat[0] @ rotation_vector(invert_pose(last) @ moved)))
        if corners is None and step_m > _STANDING_M:
            return moved, self._unsure_m + _GUESSED * step_m
        return moved, max(self._unsure_m, min(self._unsure_m + _STANDING_M, _UNSURE_M))

    def _accept(self, view: _View, found: _Found) -> PoseEstimate:
        pose, nearest, fits = found.T_world_camera, found.nearest, found.fits
        left_m = 0.0 if self._lost else apart(self._expected(view.stamp_ns), pose)[0]
        jumped, self._nearest = left_m > _JUMP[0] and nearest.number != self._nearest, nearest.number
        if self._lost:
            self._counters["relocalised"] += 1
            _log.info("odometry_relocalised", stamp_ns=view.stamp_ns)
            self._past = []
        self._unsure_m = found.unsure_m
        self._noise_m += _NOISE_GAIN * (fits[0].noise_m - self._noise_m) if self._noise_m else fits[0].noise_m
        way, turn = self._graph.distances(pose)
        reach = np.maximum(way / KEYFRAME_M, np.rad2deg(turn) / KEYFRAME_DEG)
        way_m = float(min(k.way_m + d for k, d in zip(self._graph.frames.values(), way, strict=True)))
        if reach.min() > 1 or fits[0].overlap < KEYFRAME_OVERLAP or jumped:
            self._add_keyframe(view, pose, way_m, nearest.number)
        elif self._closer is not None:
            self._graph.give(view.stamp_ns, nearest, pose)
        return self._given(view, pose, _sigma(fits, float(np.hypot(DRIFT * way_m, found.unsure_m))))

    def _add_keyframe(self, view: _View, pose: Float64, way_m: float, parent: int | None) -> None:
        number = self._counters["keyframes"]
        self._counters["keyframes"] += 1
        place = view.features
        if self._closer is not None:
            place = find_place_features(view.rgb, view.depth_m, PLACE_FEATURES)
        keyframe = OdometryKeyframe(number, Target(view.levels, pose), view.features, place, way_m, self._unsure_m)
        self._graph.frames[number] = keyframe
        if self._closer is not None:
            self._closer.add(keyframe, parent)
            self._graph.give(view.stamp_ns, keyframe, pose)
        self._graph.trim()

    def _lose(self, stamp_ns: int, reason: str) -> None:
        if self._lost_ns is None:
            self._lost_ns = stamp_ns
            _log.warning("odometry_lost", reason=reason)
        ways_on = "show the camera a place that it has seen before"
        if can_be_found(self._config):
            ways_on += f"; after {_LOST_NS // 10**9} s it begins a new world, which the mapper finds in its map"
        self._warnings = (f"the odometry is lost ({reason}); {ways_on}",)
        self._counters["lost"] += 1

    def _lose_or_begin(self, view: _View, reason: str) -> PoseEstimate | None:
        """No pose, or the first one of a new world."""
        lost_ns = 0 if self._lost_ns is None else view.stamp_ns - self._lost_ns
        if not can_be_found(self._config) or (self._images >= _YOUNG and lost_ns < _LOST_NS):
            return self._lose(view.stamp_ns, reason)
        self._counters["new_sessions"] += 1
        if is_power_of_two(self._counters["new_sessions"]):
            _log.warning("odometry_begins_new_world", reason=reason, images=self._images)
        self._corrected = self._graph.correction(final=True) or self._corrected
        # The map is of a world that has lasted: it would take no corrections of the next one.
        self._begin_world(closes_loops=self._closer is not None and self._images < _YOUNG)
        self._world += 1
        return self._begin(view)


def _sigma(fits: list[Fit], drift_m: float) -> float:
    """One-sigma uncertainty of the position in metres: of the points' noise, and of the keyframes' own poses."""
    total = sum((f.normal_matrix / max(f.noise_m, 1e-3) ** 2 for f in fits), np.zeros((6, 6))) / POINTS_A_VOTE
    covariance = np.linalg.pinv(total)[3:, 3:]
    return float(np.hypot(np.sqrt(max(np.trace(covariance), 0.0) / 3), drift_m))
