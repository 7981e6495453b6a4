"""Visual odometry: where a single camera without depth went, its scale from whatever gives one.

Two views with enough parallax begin the world; from there each picture is registered to the points that earlier ones
found, and a sliding bundle keeps points and keyframes in agreement. A picture that fits nowhere is lost: no pose, until
one looks like a keyframe again.
"""

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any, Self

import cv2
import numpy as np

from semantic_mapper.bundle.keyframes import Keyframe, KeyframeMap, adjust_bundle, triangulate
from semantic_mapper.bundle.scale import ScaleEstimator, find_floor
from semantic_mapper.bundle.tracks import Tracker, Tracks, prepare_image
from semantic_mapper.drivers.base import CameraImage, PoseEstimate, PoseSource
from semantic_mapper.drivers.poses.config import VisualPoses, gives_metres
from semantic_mapper.geometry import camera_matrix, interpolate_pose, invert_pose, transform
from semantic_mapper.imaging import working_intrinsics
from semantic_mapper.localization.features import match_features, pose_from_points
from semantic_mapper.log_events import get_logger
from semantic_mapper.mapping.picture_check import PictureQuality
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

_WIDTH, _CORNERS, _WINDOW = 640, 300, 10  # of the images that corners are followed in; keyframes adjusted together
_LEAST_POINTS = 15  # that must agree on a picture's pose
_BEGIN_CORNERS = 50  # that two views must share to begin the world
_BEGIN_FLOW = 0.05  # of the image's width that they move by at least
_BEGIN_PARALLAX_DEG = 1.5  # median angle between the rays of both views
_BEGIN_FITTING = 0.7  # of the shared corners
_FLAT = 0.9  # of them within a pixel of what one plane explains: two motions fit such views
_GAUGE = (1e-3, 1e-3)  # sigmas of the keyframes that the world begins with
_NONE = (np.inf, np.inf)
_ITERATIONS = 8
_PLACES = 200  # keyframes kept for finding back; of more, every second old one goes
_TRIED = 20  # of them that a lost picture is compared with, in turn
_REACH_PX = 3.0
_LEVEL = np.array(((0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0)))  # looking along x, z up
_DRIFT = 0.03  # of the way: what ``sigma`` grows by
_GAIN = 0.3  # of the way to a new scale that a keyframe goes
_UNKNOWN = (
    "scale: unknown: poses are up to scale, and nothing in the map is in metres; give the robot's odometry "
    '(scale = { kind = "topic", endpoint = ... }), a board (scale = { kind = "board", ... }) or camera_height_m'
)

_log = get_logger(__name__)


class VisualPoseSource(PoseSource):
    """Follows one camera by its pictures. Not for several threads at once, but any may read ``counters``, ``warnings``.

    The scale comes from ``reference``, coarse poses of the same camera in metres, where there is one.

    Attributes:
        counters: "tracked" images, "lost" ones, "waiting" ones before the world began, "relocalised", "keyframes",
            "without_scale": images that had no pose because the scale was not known yet; what ``PictureQuality``
            counts; with "scale_" before them, those of the reference.
    """

    def __init__(self, config: VisualPoses, reference: PoseSource | None = None) -> None:
        super().__init__()
        self._config = config
        self._reference = reference
        self._odometry: VisualOdometry | None = None
        self._checks = PictureQuality()
        self._estimator = ScaleEstimator()
        self._metric = False
        self._world_begun = False
        self._way = 0.0
        self._last: Float64 | None = None
        self._trouble = ""

    @property
    def scale(self) -> str:
        """Whether poses are in metres: "known", "unknown", or "awaited"."""
        if self._metric:
            return "known"
        return "awaited" if self._reference is not None or gives_metres(self._config) else "unknown"

    @property
    def warnings(self) -> tuple[str, ...]:
        """Why the last image had no pose, what is wrong with the pictures, and that the scale is not known."""
        reference = () if self._reference is None else self._reference.warnings
        unknown = (_UNKNOWN,) if self.scale == "unknown" else ()
        return (*((self._trouble,) if self._trouble else ()), *unknown, *self._checks.warnings, *reference)

    @property
    def counters(self) -> Counter[str]:
        """Totals; see the class."""
        scale = {} if self._reference is None else {f"scale_{n}": c for n, c in self._reference.counters.items()}
        return Counter({**self._counters, **self._checks.counters, **scale})

    def __enter__(self) -> Self:
        if self._reference is not None:
            self._reference.__enter__()
        return self

    def __exit__(self, *error: object) -> None:
        if self._reference is not None:
            self._reference.__exit__(*error)

    def pose(self, image: CameraImage) -> PoseEstimate | None:
        """Pose of the next image; None before the world begins, before the scale is known, and while lost.

        ``CameraError``: it is of another camera or size.
        """
        self._expect_one_camera(image)
        odometry = self._odometry = self._odometry or VisualOdometry(image.intrinsics, self._counters)
        reference = None if self._reference is None else self._reference.pose(image)
        self._checks.look(image.rgb)
        was_lost = odometry.lost
        pose = odometry.push(image.rgb, image.stamp_ns)
        if pose is None:
            self._estimator.interrupt()
            self._last = None
            self._trouble = "the visual odometry has not begun: move the camera sideways, before something with texture"
            if odometry.lost:
                also = f" ({'; '.join(self._checks.warnings)})" if self._checks.warnings else ""
                self._trouble = f"the visual odometry is lost{also}; show the camera a place that it has seen before"
                if not was_lost:
                    _log.warning("visual_odometry_lost", stamp_ns=image.stamp_ns, reason=self._trouble)
            return None
        pose = self._scaled(odometry, pose, None if reference is None else reference.T_world_camera)
        if self.scale == "awaited":
            self._counters["without_scale"] += 1
            floor = ", and let it see the floor" if self._config.camera_height_m else ""
            self._trouble = f"the scale is not known yet: move the camera on{floor}"
            return None
        self._trouble = ""
        if self._last is not None:
            self._way += float(np.linalg.norm(pose[:3, 3] - self._last[:3, 3]))
        self._last = pose
        return PoseEstimate(pose, "visual", _DRIFT * self._way)

    def _scaled(self, odometry: "VisualOdometry", pose: Float64, reference: Float64 | None) -> Float64:
        """The pose once what is known of the scale, and of where the world begins, is brought into the map."""
        if self._config.camera_height_m:
            return self._over_floor(odometry, pose)
        if self._reference is None:
            start = np.array(self._config.T_world_start)
            return pose if self._world_begun else self._begin_world(odometry, pose, 1.0, start)
        if reference is None:
            return pose
        self._estimator.add(reference[:3, 3], pose[:3, 3])
        scale = self._estimator.scale() if odometry.keyframe_added else None
        if scale is None:
            return pose
        factor, after = (float(scale**_GAIN), pose) if self._metric else (scale, reference)
        odometry.rescale(factor, pose, after, everything=not self._metric)
        self._estimator.rescaled(factor, pose, after)
        self._metric = True
        return after

    def _over_floor(self, odometry: "VisualOdometry", pose: Float64) -> Float64:
        """The pose once the distance from the floor is brought to what the camera's height over it is."""
        if not odometry.keyframe_added:
            return pose
        start = np.array(self._config.T_world_start)
        if np.array_equal(start, np.eye(4)):
            start[:3, :3], start[2, 3] = _LEVEL, self._config.camera_height_m
        found = odometry.floor_below(np.array((0.0, 0.0, 1.0)) if self._world_begun else start[2, :3])
        if found is None:
            return pose
        factor = self._config.camera_height_m / found
        self._metric = True
        if not self._world_begun:
            return self._begin_world(odometry, pose, factor, start)
        odometry.rescale(factor**_GAIN, pose, pose, everything=False)
        return pose

    def _begin_world(self, odometry: "VisualOdometry", pose: Float64, factor: float, start: Float64) -> Float64:
        """The map's first view, at the identity until now, is put to where the world begins."""
        odometry.rescale(factor, np.eye(4), start, everything=True)
        self._world_begun = True
        moved = pose.copy()
        moved[:3, 3] *= factor
        return start @ moved


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """A keyframe for finding back: its pose, its corners with points (M,), and what they look like (M, 32)."""

    T_world_camera: Float64
    tracks: Tracks
    points: Float64
    descriptors: UInt8


class VisualOdometry:
    """Follows one camera. The world begins at the first of the two views that begin it, and its unit is the median
    depth of what they see, until ``rescale`` sets another. ``counters`` are those of ``VisualPoseSource``.
    """

    def __init__(self, intrinsics: CameraIntrinsics, counters: Counter[str]) -> None:
        self._intrinsics = working_intrinsics(intrinsics, _WIDTH)
        self._counters = counters
        self._tracker = Tracker(_CORNERS)
        self._map = KeyframeMap(self._intrinsics, _WINDOW)
        self._first: Tracks | None = None  # of the view that the world may begin with
        self._places: list[_Place] = []
        self._next_try = 0
        self._past: list[tuple[int, Float64]] = []  # the last two poses
        self.lost = False  # of the last image
        self.keyframe_added = False  # whether the last image became one

    def push(self, rgb: UInt8, stamp_ns: int) -> Float64 | None:
        """Pose T_world_camera (4, 4) of the next image (H, W, 3); None while the world has not begun, or while lost."""
        image = prepare_image(rgb, self._intrinsics.width, self._intrinsics.height)
        self.keyframe_added = False
        if not self._map.keyframes:
            pose = self._begin(image)
        else:
            pose = self._relocalise(image) if self.lost else self._track(image, stamp_ns)
            self.lost = pose is None
        if pose is None:
            self._past = []
            self._counters["lost" if self.lost else "waiting"] += 1
            return None
        self._counters["tracked"] += 1
        self._past = [*self._past[-1:], (stamp_ns, pose)]
        return pose

    def rescale(self, factor: float, T_before: Float64, T_after: Float64, *, everything: bool) -> None:
        """Change the unit: what was at pose ``T_before`` is at ``T_after``, distances from it times ``factor``.

        ``everything``: places for finding back, too, that the map has left; they stay where they are otherwise.
        """

        def moved(pose: Float64) -> Float64:
            relative = invert_pose(T_before) @ pose
            relative[:3, 3] *= factor
            return T_after @ relative

        def moved_points(points: Float64) -> Float64:
            return transform(T_after, factor * transform(invert_pose(T_before), points))

        for keyframe in self._map.keyframes:
            keyframe.T_world_camera, keyframe.prior = moved(keyframe.T_world_camera), moved(keyframe.prior)
        for track, point in self._map.points.items():
            self._map.points[track] = moved_points(point)
        self._past = [(stamp, moved(pose)) for stamp, pose in self._past]
        if everything:
            self._places = [
                replace(p, T_world_camera=moved(p.T_world_camera), points=moved_points(p.points)) for p in self._places
            ]

    def floor_below(self, up: Float64) -> float | None:
        """How far the cameras of the last keyframes are above the floor that they see; None where they see none.

        ``up``: (3,) unit direction in the present world.
        """
        if not self._map.points:
            return None
        camera = np.median([k.T_world_camera[:3, 3] for k in self._map.keyframes], axis=0)
        floor = find_floor(np.stack(list(self._map.points.values())), camera, up)
        return None if floor is None else floor.below

    def _begin(self, image: UInt8) -> Float64 | None:
        tracks = self._tracker.advance(image)
        first = self._first
        shared = np.zeros(0, np.int64) if first is None else np.intersect1d(first.ids, tracks.ids)
        if first is None or len(shared) < _BEGIN_CORNERS:
            self._tracker = Tracker(_CORNERS)
            self._tracker.advance(image)
            self._first = self._tracker.replenish()
            return None
        a, b = first.pixels[first.rows(shared)], tracks.pixels[tracks.rows(shared)]
        found = None
        if np.median(np.linalg.norm(b - a, axis=1)) >= _BEGIN_FLOW * self._intrinsics.width:
            found = two_views(a, b, self._intrinsics)
        if found is None:
            return None
        pose, points, good = found
        unit = 1.0 / float(np.median(points[good, 2]))
        pose[:3, 3] *= unit
        self._map.add(Keyframe(0, first, np.eye(4), np.eye(4), _GAUGE))
        self._map.points = {int(i): unit * p for i, p in zip(shared[good], points[good], strict=True)}
        self._tracker.drop(shared[~good])
        self._places.append(self._place(image, self._tracker.tracks, pose))
        return self._add_keyframe(image, pose, _GAUGE)

    def _track(self, image: UInt8, stamp_ns: int) -> Float64 | None:
        guess = before = self._past[-1][1] if self._past else self._map.keyframes[-1].T_world_camera
        if len(self._past) > 1:
            (a_ns, a), (b_ns, b) = self._past
            guess = interpolate_pose(a, b, min((stamp_ns - a_ns) / max(b_ns - a_ns, 1), 3.0))
        expected = self._map.predict(self._tracker.tracks, before, guess)
        tracks = self._tracker.tracks
        found = self._map.locate(self._tracker.advance(image, expected), guess, _LEAST_POINTS)
        if found is None and len(self._past) > 1:  # the motion has changed: as if there was none
            expected = self._map.predict(tracks, before, before)
            found = self._map.locate(self._tracker.retry(image, tracks, expected), before, _LEAST_POINTS)
        if found is None:
            return None
        pose, wrong = found
        self._tracker.drop(wrong)
        return self._add_keyframe(image, pose, _NONE) if self._map.wants_keyframe(self._tracker.tracks) else pose

    def _add_keyframe(self, image: UInt8, pose: Float64, sigmas: tuple[float, float]) -> Float64:
        tracks = self._tracker.replenish()
        number = self._map.keyframes[-1].number + 1
        self._map.add(Keyframe(number, tracks, pose, pose, sigmas))
        problem = self._map.bundle()
        if problem is not None:
            self._map.apply(problem, adjust_bundle(problem, _ITERATIONS))
        pose = self._map.keyframes[-1].T_world_camera
        self._places.append(self._place(image, self._map.keyframes[-1].tracks, pose))
        if len(self._places) > _PLACES:
            del self._places[1 : _PLACES // 2 : 2]
        self._counters["keyframes"] += 1
        self.keyframe_added = True
        return pose

    def _place(self, image: UInt8, tracks: Tracks, pose: Float64) -> _Place:
        mask, points = self._map.known(tracks)
        kept, descriptors = _describe(image, tracks.pixels[mask])
        return _Place(pose, Tracks(tracks.ids[mask][kept], tracks.pixels[mask][kept]), points[kept], descriptors)

    def _relocalise(self, image: UInt8) -> Float64 | None:
        """Look for the keyframes that a lost picture resembles; go on from the best one."""
        tracker = self._tracker.fresh()
        tracker.advance(image)
        corners = tracker.replenish()
        kept, descriptors = _describe(image, corners.pixels)
        pixels = corners.pixels[kept]
        count = min(len(self._places), _TRIED)
        tried = [self._places[-1 - (self._next_try + i) % len(self._places)] for i in range(count)]
        self._next_try = (self._next_try + count) % len(self._places)
        best: tuple[_Place, Float64, Tracks] | None = None
        for place in tried:
            ours, theirs = match_features(descriptors, place.descriptors).T
            found = pose_from_points(place.points[theirs], pixels[ours], self._intrinsics, _LEAST_POINTS, _REACH_PX)
            if found is not None and (best is None or len(found[1]) > len(best[2].ids)):
                pose, rows = found
                ids, seen = place.tracks.ids[theirs[rows]], pixels[ours[rows]]
                order = np.argsort(ids)
                best = place, pose, Tracks(ids[order], seen[order])
        if best is None:
            return None
        place, pose, tracker.tracks = best
        number = self._map.keyframes[-1].number + 1
        self._map = KeyframeMap(self._intrinsics, _WINDOW)
        self._map.add(Keyframe(number, place.tracks, place.T_world_camera, place.T_world_camera, _GAUGE))
        self._map.points = {int(i): p for i, p in zip(place.tracks.ids, place.points, strict=True)}
        self._tracker = tracker
        self._counters["relocalised"] += 1
        return self._add_keyframe(image, pose, _NONE)


def two_views(a: Float64, b: Float64, intrinsics: CameraIntrinsics) -> tuple[Float64, Float64, Any] | None:
    """Motion between two views from corners that both see at pixels (N, 2): T_a_b (4, 4) with a way of length 1; points
    (N, 3) in the axes of a; (N,) which of them can be used. None where it is not sure: too little parallax (a camera
    that only turns), corners that agree on none, or that lie all on one plane, which two motions explain."""
    K = camera_matrix(intrinsics)
    cv2.setRNGSeed(1)
    H, flat = cv2.findHomography(a, b, cv2.RANSAC, 1.0)
    if H is not None and flat.mean() >= _FLAT:
        return None
    E, mask = cv2.findEssentialMat(a, b, K, cv2.RANSAC, 0.999, 1.0, 1000)
    if E is None or E.shape != (3, 3) or mask.mean() < _BEGIN_FITTING:
        return None
    _, R, t, _ = cv2.recoverPose(E, a, b, K, mask=mask.copy())
    T_b_a = np.eye(4)
    T_b_a[:3, :3], T_b_a[:3, 3] = R, np.ravel(t)
    T_a_b = invert_pose(T_b_a)
    points, good = triangulate(a, b, np.eye(4), T_a_b, intrinsics)
    good &= mask.ravel() > 0
    if good.sum() < _BEGIN_CORNERS // 2:
        return None
    to_b = points[good] - T_a_b[:3, 3]
    cosine = (points[good] * to_b).sum(axis=1) / np.linalg.norm(points[good], axis=1) / np.linalg.norm(to_b, axis=1)
    sure = np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) > _BEGIN_PARALLAX_DEG
    return (T_a_b, points, good) if sure and good.mean() > 0.5 * _BEGIN_FITTING else None


def _describe(image: UInt8, pixels: Float64) -> tuple[Any, UInt8]:
    """Rows of corners that can be described (those near the rim cannot), and their ORB descriptors (M, 32)."""
    orb: Any = cv2.ORB.create()
    corners = [cv2.KeyPoint(float(u), float(v), 31.0, 0.0, 1.0, 0, row) for row, (u, v) in enumerate(pixels)]
    corners, descriptors = orb.compute(cv2.GaussianBlur(image, (5, 5), 0), corners)
    rows = np.array([corner.class_id for corner in corners], np.int64)
    return rows, np.zeros((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors, np.uint8)
