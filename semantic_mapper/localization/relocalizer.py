"""Where a frame without a pose is in a map: the place it shows, a pose from its features, and what the map says to it.

A pose is given only where features *and* depth agree with the map, and no other place fits nearly as well. One frame
may still be wrong; ``Relocalization`` waits for several that agree with each other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from semantic_mapper.geometry import invert_pose, pose_distance, project, transform
from semantic_mapper.localization.depth_fit import (
    DepthFit,
    Landmarks,
    MapSurface,
    align_depth,
    compare_depth,
    small_depth,
)
from semantic_mapper.localization.features import Features, find_place_features, match_features, pose_from_points
from semantic_mapper.localization.places import MAX_FEATURES, Place, rank_places
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, UInt8

Reason = Literal[
    "no-places",
    "no-depth",
    "unknown",
    "few-features",
    "calibration",
    "contradicted",
    "looks-different",
    "classes",
    "ambiguous",
]
_CANDIDATES = 12  # places that are looked at
_GROUP_M, _GROUP_RAD = 1.2, np.deg2rad(50.0)  # places this near to a candidate lend it their matches
_GROUP = 4  # at most
_REPROJECTION = 4.0 / 525.0  # of the focal length
_SUPPORT = 8.0 / 525.0  # how far a feature may be from where the aligned pose has it: that fits the depth first
_LEAST_DEPTH = 0.1  # fraction of the pixels
_TRIED = 3  # poses that are compared with the map
_FAR_M = 10.0  # from the place that it is about, no pose is believed
_REACH_M = 1.5  # places whose views are this near may show what the frame shows; a radian counts like a metre
_DEPTH_M, _DEPTH = 0.06, 0.04  # by which the depths of a feature may differ
_ALIKE = 0.75 * 512.0  # distance of descriptors
_APART_M, _FLAT = 0.3, 0.8  # features that sizes are measured by are so far apart, most of it across the view
_PAIRS = 30  # of such features, at least
_SAME_M, _SAME_RAD = 0.3, np.deg2rad(10.0)  # poses further apart are two


# What a pose must show to be believed. Set by views of 26 rooms: in the mirrored room a symmetric shelf or bed has up
# to 167 features for it; then 0.94 of the depth agrees at most, with a likeness of 0.6. In the room itself likeness is
# 0.79 or more in all but one of 500.
MIN_INLIERS = 12  # features that agree on the pose
MIN_SPREAD = 0.08  # their standard deviation in the image, as a fraction of its diagonal
MIN_OVERLAP, MIN_AGREE, MIN_LIKENESS, MIN_CLASSES = 0.4, 0.85, 0.75, 0.4  # see ``DepthFit``
SURE_INLIERS, SURE_AGREE = 40, 0.92  # with fewer features than these, the depth has to agree by so much
MAX_RIVAL = 0.6  # features of another pose, as a fraction of those of the best
# By which fraction sizes across the view may differ from the map's. In a real kitchen it is 1 % at most; a focal length
# that is 15 % too long makes it 11 %.
MAX_STRETCH = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Relocalized:
    """A frame that was found.

    Args:
        T_map_camera: (4, 4) float64.
        inliers: Features that agree on it.
        fit: What its depth says.
    """

    T_map_camera: Float64
    inliers: int
    fit: DepthFit


@dataclass(frozen=True, slots=True, eq=False)
class NotFound:
    """A frame that was not.

    Args:
        reason: In one word.
        detail: In a sentence.
        T_map_camera: The pose that was refused, if there was one.
        inliers, fit: Of it.
    """

    reason: Reason
    detail: str
    T_map_camera: Float64 | None = None
    inliers: int = 0
    fit: DepthFit | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Guess:
    pose: Float64
    landmarks: Landmarks

    @property
    def inliers(self) -> int:
        return len(self.landmarks.points)


@dataclass(frozen=True, slots=True, eq=False)
class _Tried:
    guess: _Guess
    pose: Float64  # aligned
    fit: DepthFit
    support: Landmarks


class Relocalizer:
    """Finds frames in a map. Deterministic; changes nothing.

    Args:
        places: What the map keeps to find itself by.
        surface: The map.
        ignore_id: Of its classes.
    """

    def __init__(self, places: Sequence[Place], surface: MapSurface, ignore_id: int = 255) -> None:
        self._places = places
        self._surface = surface
        self._ignore_id = ignore_id

    def find(
        self, rgb: UInt8, depth_m: Float32 | None, intrinsics: CameraIntrinsics, label: UInt8 | None = None
    ) -> Relocalized | NotFound:
        """Find a frame.

        Args:
            rgb: (H, W, 3) uint8, rectified.
            depth_m: (H, W) float32 z as a sensor measured it, 0 = none.
            intrinsics: Of both.
            label: (h, w) uint8 class ids of the map's label set as something sees them in the frame; None = no idea.
        """
        if not self._places:
            return NotFound("no-places", "the map has nothing to find oneself by")
        if depth_m is None or float((depth_m > 0).mean()) < _LEAST_DEPTH:
            return NotFound("no-depth", "the frame has hardly any measured depth, and a picture alone proves no place")
        return self.find_features(find_place_features(rgb, depth_m, MAX_FEATURES), rgb, depth_m, intrinsics, label)

    def find_features(
        self, features: Features, rgb: UInt8, depth_m: Float32, intrinsics: CameraIntrinsics, label: UInt8 | None = None
    ) -> Relocalized | NotFound:
        """As ``find``, where the features of the frame are known."""
        if not self._places:
            return NotFound("no-places", "the map has nothing to find oneself by")
        depth, small = small_depth(depth_m, intrinsics)
        tried: list[_Tried] = []
        for guess in self._guesses(features, intrinsics):
            if any(_same(guess.pose, t.guess.pose) or _same(guess.pose, t.pose) for t in tried):
                continue
            pose = align_depth(self._surface, depth, small, guess.landmarks, intrinsics, guess.pose)
            if pose is None:
                continue
            fit = compare_depth(self._surface, depth, small, rgb, pose, label, self._ignore_id)
            tried.append(_Tried(guess, pose, fit, self._support(features, pose, intrinsics)))
            if len(tried) == _TRIED:
                break
        if not tried:
            return NotFound("unknown", "no place of the map shows what the frame shows")
        tried.sort(key=lambda t: -len(t.support.points))
        best = tried[0]
        count = len(best.support.points)
        refusal = self._refusal(best, tried, depth_m, intrinsics)
        if refusal is not None:
            return NotFound(refusal[0], refusal[1], best.pose, count, best.fit)
        return Relocalized(best.pose, count, best.fit)

    def check_classes(
        self, found: Relocalized, rgb: UInt8, depth_m: Float32, intrinsics: CameraIntrinsics, label: UInt8
    ) -> Relocalized | NotFound:
        """Refuse a frame that was found, where its classes are not the map's; arguments as of ``find``."""
        depth, small = small_depth(depth_m, intrinsics)
        fit = compare_depth(self._surface, depth, small, rgb, found.T_map_camera, label, self._ignore_id)
        if fit.classes < MIN_CLASSES:  # false for NaN
            return NotFound("classes", _other_classes(fit), found.T_map_camera, found.inliers, fit)
        return replace(found, fit=fit)

    def _refusal(
        self, best: _Tried, tried: list[_Tried], depth_m: Float32, intrinsics: CameraIntrinsics
    ) -> tuple[Reason, str] | None:
        fit, count = best.fit, len(best.support.points)
        if count < MIN_INLIERS:
            return "few-features", f"{count} features agree on a pose, {MIN_INLIERS} have to"
        diagonal = float(np.hypot(intrinsics.width, intrinsics.height))
        if float(np.sqrt(best.support.pixels.var(axis=0).sum())) < MIN_SPREAD * diagonal:
            return "few-features", "the features that agree on a pose are all of one small thing"
        size = _relative_size(best.guess.landmarks, depth_m, intrinsics)
        if abs(size - 1) > MAX_STRETCH:  # false for NaN
            return "calibration", (
                f"the frame shows things {size:.2f} times as large as the map has them: focal length or depth is wrong"
            )
        sure = count >= SURE_INLIERS
        if fit.overlap < MIN_OVERLAP or fit.agree < (MIN_AGREE if sure else SURE_AGREE):
            return "contradicted", (
                f"{fit.overlap:.0%} of the depth shows what the map has, and {fit.agree:.0%} of that agrees "
                f"({fit.through:.0%} sees through it, {fit.before:.0%} stands before it)"
            )
        if fit.likeness < MIN_LIKENESS:
            return "looks-different", f"brightness of frame and map correlate by {fit.likeness:.2f} only"
        if fit.classes < MIN_CLASSES:  # false for NaN
            return "classes", _other_classes(fit)
        rival = max((len(t.support.points) for t in tried[1:] if not _same(t.pose, best.pose)), default=0)
        if rival > MAX_RIVAL * count:
            return "ambiguous", f"another pose has {rival} features for it, this one {count}"
        return None

    def _support(self, features: Features, pose: Float64, intrinsics: CameraIntrinsics) -> Landmarks:
        """Features of a frame that the places round its pose have where they must be: at that pixel and depth."""
        apart = [sum(pose_distance(p.T_world_camera, pose)) for p in self._places]
        near = [i for i in np.argsort(apart, kind="stable")[:_GROUP] if apart[i] < _REACH_M]
        if not near or not len(features.pixels):
            return Landmarks(np.zeros((0, 3)), np.zeros((0, 2)))
        points = np.concatenate([self._world_points(i, np.arange(len(self._places[i].points))) for i in near])
        theirs = np.concatenate([self._places[i].descriptors for i in near]).astype(np.float32)
        seen = transform(invert_pose(pose), points)
        front = seen[:, 2] > 0.1
        if not front.any():
            return Landmarks(np.zeros((0, 3)), np.zeros((0, 2)))
        points, theirs, seen = points[front], theirs[front], seen[front]
        pixels = project(seen, intrinsics)
        off = np.linalg.norm(features.pixels[:, None] - pixels[None], axis=2)  # (N, M)
        deep = np.abs(features.depth_m[:, None] - seen[None, :, 2]) < _DEPTH_M + _DEPTH * seen[None, :, 2]
        ours = features.descriptors.astype(np.float32)
        square = (ours**2).sum(axis=1)[:, None] + (theirs**2).sum(axis=1)[None] - 2 * ours @ theirs.T
        square[(off > _SUPPORT * intrinsics.fx) | (~deep & (features.depth_m[:, None] > 0))] = np.inf
        best = square.argmin(axis=1)
        alike = np.flatnonzero(square.min(axis=1) < _ALIKE**2)
        return Landmarks(points[best[alike]], features.pixels[alike])

    def _guesses(self, features: Features, intrinsics: CameraIntrinsics) -> list[_Guess]:
        """Poses that features lead to, those with the most of them first."""
        descriptors = {key: place.descriptors for key, place in enumerate(self._places)}
        ranked = [key for key, _ in rank_places(features, descriptors, _CANDIDATES)]
        pairs = {key: match_features(features.descriptors, self._places[key].descriptors) for key in ranked}
        limit_px = _REPROJECTION * intrinsics.fx
        guesses: list[_Guess] = []
        for key in ranked:
            near = [k for k in ranked if self._near(k, key)][:_GROUP]
            points = np.concatenate([self._world_points(k, pairs[k][:, 1]) for k in near])
            pixels = np.concatenate([features.pixels[pairs[k][:, 0]] for k in near])
            found = pose_from_points(points, pixels, intrinsics, 6, limit_px)
            if found is None:
                continue
            pose, inliers = found
            if np.linalg.norm(pose[:3, 3] - self._places[key].T_world_camera[:3, 3]) > _FAR_M:
                continue
            _, first = np.unique(np.rint(pixels[inliers]), axis=0, return_index=True)  # one pixel is one feature
            chosen = inliers[first]
            guesses.append(_Guess(pose, Landmarks(points[chosen], pixels[chosen])))
        guesses.sort(key=lambda g: -g.inliers)
        return guesses

    def _near(self, a: int, b: int) -> bool:
        return _within(self._places[a].T_world_camera, self._places[b].T_world_camera, _GROUP_M, _GROUP_RAD)

    def _world_points(self, key: int, which: np.ndarray) -> Float64:
        place = self._places[key]
        return transform(place.T_world_camera, place.points[which].astype(np.float64))


def _relative_size(landmarks: Landmarks, depth_m: Float32, intrinsics: CameraIntrinsics) -> float:
    """Median of distances between features, in the frame against those in the map; NaN where there are too few."""
    u, v = np.rint(landmarks.pixels).astype(np.intp).T
    z = depth_m[v.clip(0, intrinsics.height - 1), u.clip(0, intrinsics.width - 1)].astype(np.float64)
    x, y = ((landmarks.pixels - (intrinsics.cx, intrinsics.cy)) / (intrinsics.fx, intrinsics.fy) * z[:, None]).T
    known = np.isfinite(z) & (z > 0)
    own, theirs = np.stack((x, y, z), axis=1)[known], landmarks.points[known]
    i, j = np.triu_indices(len(own), 1)
    apart = own[i] - own[j]
    length = np.linalg.norm(apart, axis=1)
    use = (length > _APART_M) & (np.linalg.norm(apart[:, :2], axis=1) > _FLAT * length)
    if use.sum() < _PAIRS:
        return float("nan")
    return float(np.median(length[use] / np.linalg.norm(theirs[i[use]] - theirs[j[use]], axis=1)))


def _other_classes(fit: DepthFit) -> str:
    return f"{fit.classes:.0%} of the pixels are of the map's class"


def _within(a: Float64, b: Float64, way_m: float, turn_rad: float) -> bool:
    moved_m, turned = pose_distance(a, b)
    return moved_m < way_m and turned < turn_rad


def _same(a: Float64, b: Float64) -> bool:
    return _within(a, b, _SAME_M, _SAME_RAD)
