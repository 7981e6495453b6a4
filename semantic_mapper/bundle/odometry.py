"""Where a single camera went, from its pictures alone, up to scale (monocular visual odometry).

Two views with enough parallax begin the world; from there each picture is registered to the points that earlier ones
found, and a sliding bundle keeps points and keyframes in agreement. A picture that fits nowhere is lost: no pose, until
one looks like a keyframe again.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from semantic_mapper.bundle.adjustment import adjust_bundle
from semantic_mapper.bundle.keyframes import Keyframe, KeyframeMap, triangulate
from semantic_mapper.bundle.scale import floor_height
from semantic_mapper.bundle.tracks import Tracker, Tracks, prepare_image
from semantic_mapper.config import PoseRefinerConfig
from semantic_mapper.geometry import (
    camera_matrix,
    interpolate_pose,
    invert_pose,
    make_pose,
    scale_intrinsics,
    transform,
)
from semantic_mapper.types import CameraIntrinsics, Float64, UInt8

_LEAST_POINTS = 15  # that must agree on a picture's pose
_BEGIN_CORNERS = 50  # that two views must share to begin the world
_BEGIN_FLOW = 0.05  # of the image's width that they move by at least
_BEGIN_PARALLAX_DEG = 1.5  # median angle between the rays of both views
_BEGIN_FITTING = 0.7  # of the shared corners
_FLAT = 0.9  # of them within a pixel of what one plane explains: two motions fit such views, and a third view decides
_DECIDED = 1.3  # times the error of the right motion is that of the wrong one, at least
_MAX_BETWEEN = 40  # views kept since the first one
_GAUGE = (1e-3, 1e-3)  # sigmas of the keyframes that the world begins with
_NONE = (np.inf, np.inf)
_ITERATIONS = 8
_TRIED = 20  # keyframes that a lost picture is compared with, in turn
_REACH_PX = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class _Place:
    """A keyframe for finding back: its pose, its corners with points (M,), and what they look like (M, 32)."""

    T_world_camera: Float64
    tracks: Tracks
    points: Float64
    descriptors: UInt8


class VisualOdometry:
    """Follows one camera. The world begins at the first of the two views that begin it, and its unit is the median
    depth of what they see, until ``rescale`` sets another.

    Args:
        intrinsics: Of the images, rectified.
        config: How corners are followed, and how many keyframes are adjusted together.
        max_places: Keyframes kept for finding back; of more, every second old one goes.

    Attributes:
        counters: "tracked" images, "lost" ones, "waiting" ones before the world began, "relocalised", "keyframes".
        keyframe_added: Whether the last image became a keyframe.
    """

    def __init__(self, intrinsics: CameraIntrinsics, config: PoseRefinerConfig, max_places: int = 200) -> None:
        width = min(intrinsics.width, config.width)
        self._intrinsics = scale_intrinsics(intrinsics, width, round(intrinsics.height * width / intrinsics.width))
        self._config = config
        self._max_places = max_places
        self._tracker = Tracker(config.corners)
        self._map = KeyframeMap(self._intrinsics, config.window)
        self._first: Tracks | None = None  # of the view that the world may begin with
        self._between: list[Tracks] = []  # of the views since
        self._places: list[_Place] = []
        self._next_try = 0
        self._past: list[tuple[int, Float64]] = []  # the last two poses
        self.lost = False
        self.keyframe_added = False
        self.counters: Counter[str] = Counter()

    @property
    def began(self) -> bool:
        """Whether there is a world."""
        return bool(self._map.keyframes)

    def push(self, rgb: UInt8, stamp_ns: int) -> Float64 | None:
        """Pose T_world_camera (4, 4) of the next image (H, W, 3); None while the world has not begun, or while lost."""
        image = prepare_image(rgb, self._intrinsics.width, self._intrinsics.height)
        self.keyframe_added = False
        if not self.began:
            pose = self._begin(image)
            if pose is None:
                self.counters["waiting"] += 1
                return None
        else:
            pose = self._relocalise(image) if self.lost else self._track(image, stamp_ns)
            if pose is None:
                self.lost, self._past = True, []
                self.counters["lost"] += 1
                return None
        self.counters["tracked"] += 1
        self._past = [*self._past[-1:], (stamp_ns, pose)]
        return pose

    def rescale(self, factor: float, T_before: Float64, T_after: Float64, *, everything: bool) -> None:
        """Change the unit: what was at pose ``T_before`` is at ``T_after``, distances from it times ``factor``.

        Args:
            everything: Places for finding back, too; those that the map has left stay where they are otherwise.
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

        Args:
            up: (3,) unit direction in the present world.
        """
        if not self._map.points:
            return None
        camera = float(np.median([k.T_world_camera[:3, 3] @ up for k in self._map.keyframes]))
        floor = floor_height(np.stack(list(self._map.points.values())) @ up, camera)
        return None if floor is None else camera - floor

    def center_depth(self) -> float | None:
        """Median distance along the view of points in the middle third of the view that the world begins with; None
        without any, or once the view is no longer kept."""
        first = self._map.keyframes[0]
        if first.number:
            return None
        mask, points = self._map.known(first.tracks)
        z = transform(invert_pose(first.T_world_camera), points)[:, 2]
        size = np.array((self._intrinsics.width, self._intrinsics.height))
        middle = (np.abs(first.tracks.pixels[mask] - size / 2) < size / 6).all(axis=1)
        return float(np.median(z[middle])) if middle.any() else None

    def _begin(self, image: UInt8) -> Float64 | None:
        tracks = self._tracker.advance(image)
        first = self._first
        shared = np.zeros(0, np.int64) if first is None else np.intersect1d(first.ids, tracks.ids)
        if first is None or len(shared) < _BEGIN_CORNERS:
            self._tracker = Tracker(self._config.corners)
            self._tracker.advance(image)
            self._first, self._between = self._tracker.replenish(), []
            return None
        a, b = first.pixels[first.rows(shared)], tracks.pixels[tracks.rows(shared)]
        found = None
        if np.median(np.linalg.norm(b - a, axis=1)) >= _BEGIN_FLOW * self._intrinsics.width:
            found = two_views(a, b, self._intrinsics, self._half_way(shared, a, b))
        if found is None:
            self._between.append(tracks)
            if len(self._between) > _MAX_BETWEEN:
                del self._between[::2]
            return None
        self._between = []
        pose, points, good = found
        unit = 1.0 / float(np.median(points[good, 2]))
        pose[:3, 3] *= unit
        self._map.add(Keyframe(0, first, np.eye(4), np.eye(4), _GAUGE))
        self._map.points = {int(i): unit * p for i, p in zip(shared[good], points[good], strict=True)}
        self._tracker.drop(shared[~good])
        self._places.append(self._place(image, self._tracker.tracks, pose))
        return self._add_keyframe(image, pose, _GAUGE)

    def _half_way(self, shared: Any, a: Float64, b: Float64) -> Float64 | None:
        """Pixels (N, 2) of the shared tracks in the view between that has moved half as far; None without one."""
        half = 0.5 * float(np.median(np.linalg.norm(b - a, axis=1)))
        best: tuple[float, Float64] | None = None
        for tracks in self._between:
            pixels = tracks.pixels[tracks.rows(shared)]  # a track that is there now was there all the time
            off = abs(float(np.median(np.linalg.norm(pixels - a, axis=1))) - half)
            if best is None or off < best[0]:
                best = off, pixels
        return None if best is None else best[1]

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
        problem = self._map.problem()
        if problem is not None:
            self._map.apply(*problem, adjust_bundle(problem[0], _ITERATIONS))
        pose = self._map.keyframes[-1].T_world_camera
        self._places.append(self._place(image, self._map.keyframes[-1].tracks, pose))
        if len(self._places) > self._max_places:
            del self._places[1 : self._max_places // 2 : 2]
        self.counters["keyframes"] += 1
        self.keyframe_added = True
        return pose

    def _place(self, image: UInt8, tracks: Tracks, pose: Float64) -> _Place:
        mask, points = self._map.known(tracks)
        kept, descriptors = _describe(image, tracks.pixels[mask])
        ids, pixels = tracks.ids[mask][kept], tracks.pixels[mask][kept]
        return _Place(pose, Tracks(ids, pixels), points[kept], descriptors)

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
        best: tuple[int, _Place, Float64, Tracks] | None = None
        for place in tried:
            found = _match(place, pixels, descriptors, self._intrinsics)
            if found is not None and (best is None or len(found[1].ids) > best[0]):
                best = (len(found[1].ids), place, *found)
        if best is None:
            return None
        _, place, pose, tracks = best
        number = self._map.keyframes[-1].number + 1
        self._map = KeyframeMap(self._intrinsics, self._config.window)
        self._map.add(Keyframe(number, place.tracks, place.T_world_camera, place.T_world_camera, _GAUGE))
        self._map.points = {int(i): p for i, p in zip(place.tracks.ids, place.points, strict=True)}
        tracker.tracks = tracks
        self._tracker = tracker
        self.lost = False
        self.counters["relocalised"] += 1
        return self._add_keyframe(image, pose, _NONE)


def two_views(
    a: Float64, b: Float64, intrinsics: CameraIntrinsics, between: Float64 | None = None
) -> tuple[Float64, Float64, Any] | None:
    """Motion between two views from corners that both see at pixels (N, 2).

    Args:
        a, b: (N, 2) pixels in both.
        intrinsics: Of both.
        between: (N, 2) pixels in a third view, which decides where all corners lie on one plane.

    Returns:
        T_a_b (4, 4) with a way of length 1; points (N, 3) in the axes of a; (N,) which of them can be used. None where
        the motion is not sure: too little parallax (a camera that only turns), or corners that agree on none.
    """
    K = camera_matrix(intrinsics)
    cv2.setRNGSeed(1)
    H, flat = cv2.findHomography(a, b, cv2.RANSAC, 1.0)
    if H is not None and flat.mean() >= _FLAT:
        found = _flat_views(H, a, b, intrinsics, between)
        if found is None:
            return None
        T_a_b, points, good = found
    else:
        E, mask = cv2.findEssentialMat(a, b, K, cv2.RANSAC, 0.999, 1.0, 1000)
        if E is None or E.shape != (3, 3) or mask.mean() < _BEGIN_FITTING:
            return None
        _, R, t, _ = cv2.recoverPose(E, a, b, K, mask=mask.copy())
        T_a_b = _inverse_motion(R, t)
        points, good = triangulate(a, b, np.eye(4), T_a_b, intrinsics)
        good &= mask.ravel() > 0
    if good.sum() < _BEGIN_CORNERS // 2:
        return None
    to_b = points[good] - T_a_b[:3, 3]
    cosine = (points[good] * to_b).sum(axis=1) / np.linalg.norm(points[good], axis=1) / np.linalg.norm(to_b, axis=1)
    sure = np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1))) > _BEGIN_PARALLAX_DEG
    return (T_a_b, points, good) if sure and good.mean() > 0.5 * _BEGIN_FITTING else None


def _inverse_motion(R: Any, t: Any) -> Float64:
    """T_a_b (4, 4) with a way of length 1, of the rotation and the way of b from a as OpenCV has them."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3], T_b_a[:3, 3] = R, np.ravel(t) / max(float(np.linalg.norm(t)), 1e-12)
    return invert_pose(T_b_a)


def _flat_views(
    H: Any, a: Float64, b: Float64, intrinsics: CameraIntrinsics, between: Float64 | None
) -> tuple[Float64, Float64, Any] | None:
    """``two_views`` of one plane: of the motions that fit, the one whose points fit the view between, too.

    None where two fit it about as well, or there is no such view.
    """
    _, rotations, ways, _ = cv2.decomposeHomographyMat(H, camera_matrix(intrinsics))
    motions = [_inverse_motion(R, t) for R, t in zip(rotations, ways, strict=True)]
    found = [(T_a_b, *triangulate(a, b, np.eye(4), T_a_b, intrinsics)) for T_a_b in motions]
    most = max(int(good.sum()) for _, _, good in found)
    found = [f for f in found if f[2].sum() > 0.8 * most]
    if most < _LEAST_POINTS or (between is None and len(found) > 1):
        return None
    if between is None or len(found) == 1:
        return found[0]
    errors = [_registration_error(points[good], between[good], intrinsics) for _, points, good in found]
    order = np.argsort(errors)
    return found[int(order[0])] if errors[order[1]] > _DECIDED * errors[order[0]] else None


def _registration_error(points: Float64, pixels: Float64, intrinsics: CameraIntrinsics) -> float:
    """RMS pixels by which points (N, 3) are off in the view that they fit best."""
    K = camera_matrix(intrinsics)
    _, turn, shift = cv2.solvePnP(points, pixels, K, None, flags=cv2.SOLVEPNP_ITERATIVE)
    seen, _ = cv2.projectPoints(points, turn, shift, K, None)
    return float(np.sqrt((np.linalg.norm(seen[:, 0] - pixels, axis=1) ** 2).mean()))


def _describe(image: UInt8, pixels: Float64) -> tuple[Any, UInt8]:
    """Rows of corners that can be described (those near the rim cannot), and their ORB descriptors (M, 32)."""
    orb: Any = cv2.ORB.create()
    corners = [cv2.KeyPoint(float(u), float(v), 31.0, 0.0, 1.0, 0, row) for row, (u, v) in enumerate(pixels)]
    corners, descriptors = orb.compute(cv2.GaussianBlur(image, (5, 5), 0), corners)
    rows = np.array([corner.class_id for corner in corners], np.int64)
    return rows, np.zeros((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors, np.uint8)


def _match(
    place: _Place, pixels: Float64, descriptors: UInt8, intrinsics: CameraIntrinsics
) -> tuple[Float64, Tracks] | None:
    """Pose of an image that shows a place, and its corners under their numbers of there."""
    if min(len(place.points), len(pixels)) < _LEAST_POINTS:
        return None
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(descriptors, place.descriptors)
    if len(matches) < _LEAST_POINTS:
        return None
    ours, theirs = np.array([(m.queryIdx, m.trainIdx) for m in matches]).T
    cv2.setRNGSeed(1)
    K = camera_matrix(intrinsics)
    found, turn, shift, inliers = cv2.solvePnPRansac(
        place.points[theirs], pixels[ours], K, None, None, None, False, 300, _REACH_PX, 0.999, flags=cv2.SOLVEPNP_SQPNP
    )
    if not found or inliers is None or len(inliers) < _LEAST_POINTS:
        return None
    rows = np.asarray(inliers, np.int64).ravel()
    turn, shift = cv2.solvePnPRefineLM(place.points[theirs[rows]], pixels[ours[rows]], K, None, turn, shift)
    ids = place.tracks.ids[theirs[rows]]
    order = np.argsort(ids)
    return invert_pose(make_pose(turn, shift)), Tracks(ids[order], pixels[ours[rows]][order])
