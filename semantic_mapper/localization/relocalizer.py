"""Where a frame without a pose is in a map: the place it shows, a pose from its features, and what the map says to it.

A pose is given only where features *and* depth agree with the map, and no other place fits nearly as well. One frame
may still be wrong: several have to say the same of where the map is (``find_consensus``).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import cv2
import numpy as np
import scipy  # loads `spatial` when it is first used

from semantic_mapper.geometry import (
    invert_pose,
    nearest_pixels,
    nearest_pose,
    pose_distance,
    project,
    scale_intrinsics,
    transform,
    unproject,
)
from semantic_mapper.localization.depth_alignment import Level, gauss_newton_step, make_level
from semantic_mapper.localization.features import Features, find_place_features, match_features, pose_from_points
from semantic_mapper.localization.places import MAX_FEATURES, Place, rank_places
from semantic_mapper.types import Bool, CameraIntrinsics, Float32, Float64, Int64, UInt8

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

_WIDTH = 160  # of both depth images that are aligned
_STEPS = 6  # on each ray cast
_REACHES_M = (0.15, 0.08, 0.05)  # in each round, with a ray cast of its own: points further from the map do not pull
_POINTS = 5000  # of the frame that are aligned, at most
_POINTS_A_VOTE = 10  # neighbouring points have the same error: that many count as one
_DEPTH_SIGMA_M, _FEATURE_SIGMA_PX = 0.01, 8.0
_HUBER = 2.0  # in sigmas
_AWAY_M = 0.5  # further from the first guess the alignment has lost it
_TOLERANCE_M, _TOLERANCE = 0.04, 0.025  # depths agree within the sum of both, the second as a fraction of the depth
_SURE = 0.7  # confidence from which on a class of the map counts

# What a pose must show to be believed. Set by views of 26 rooms: in the mirrored room a symmetric shelf or bed has up
# to 167 features for it; then 0.94 of the depth agrees at most, with a likeness of 0.6. In the room itself likeness is
# 0.79 or more in all but one of 500.
MIN_INLIERS = 12  # features that agree on the pose
MIN_SPREAD = 0.08  # their standard deviation in the image, as a fraction of its diagonal
MIN_OVERLAP, MIN_AGREE, MIN_LIKENESS, MIN_CLASSES = 0.4, 0.85, 0.75, 0.4  # see ``_Tried``, ``_class_agreement``
SURE_INLIERS, SURE_AGREE = 40, 0.92  # with fewer features than these, the depth has to agree by so much
MAX_RIVAL = 0.6  # features of another pose, as a fraction of those of the best
# By which fraction sizes across the view may differ from the map's. In a real kitchen it is 1 % at most; a focal length
# that is 15 % too long makes it 11 %.
MAX_STRETCH = 0.05

AGREEING = 3  # frames that must say the same
_AGREE_M, _AGREE_RAD = 0.08, np.deg2rad(3.0)  # what they may differ by
_RIVAL = 0.5  # of those that agree: so many that say something else are too many
_LOOKED_AT = np.array([(0, 0, 0), (-1, -0.75, 2), (1, -0.75, 2), (-1, 0.75, 2), (1, 0.75, 2)], np.float64)  # (5, 3)
_SPREAD_M, _FIT_ROUNDS = 0.02, 5  # of the fit of those that agree


class MapSurface(Protocol):
    """What can be seen from anywhere, such as ``VoxelMap``."""

    def ray_cast(self, T_world_camera: Float64, intrinsics: CameraIntrinsics) -> Any:
        """The map as a camera would see it: depth_m, rgb, label and confidence, (H, W) each."""


class Relocalized(NamedTuple):
    """A frame that was found: its pose ``T_map_camera`` (4, 4) float64, and how many features agree on it."""

    T_map_camera: Float64
    inliers: int


class NotFound(NamedTuple):
    """A frame that was not: why, in one word and in a sentence; features that agreed on the pose that was refused."""

    reason: str
    detail: str
    inliers: int = 0


class _Landmarks(NamedTuple):
    """Features of a frame that were found in the map: points (K, 3) there, and pixels (K, 2) of the frame."""

    points: Float64
    pixels: Float64


_NOTHING = _Landmarks(np.zeros((0, 3)), np.zeros((0, 2)))


@dataclass(frozen=True, slots=True, eq=False)
class _Tried:
    """A pose that was aligned, and how the frame lies on the map there."""

    guess: Float64  # what it was aligned from
    landmarks: _Landmarks  # that led to the guess
    pose: Float64  # as aligned
    support: _Landmarks  # features that agree on it
    view: Any  # the map as seen from there
    agreeing: Bool  # (h, w) where the depth is the map's
    overlap: float  # fraction of the measured pixels that show what the map has, too
    agree: float  # fraction of these whose depth is the map's
    # correlation of the brightness of frame and map where the depth agrees, -1..1; 0 where all is one grey
    likeness: float


class Relocalizer:
    """Finds frames in a map, the ``surface``, by its ``places``; ``ignore_id`` is of its classes. Deterministic."""

    def __init__(self, places: Sequence[Place], surface: MapSurface, ignore_id: int = 255) -> None:
        self._places = places
        self._surface = surface
        self._ignore_id = ignore_id

    def find(
        self,
        rgb: UInt8,
        depth_m: Float32 | None,
        intrinsics: CameraIntrinsics,
        classify: Callable[[], UInt8] | None = None,
        features: Features | None = None,
    ) -> Relocalized | NotFound:
        """Find a frame by rectified rgb (H, W, 3) uint8 and depth (H, W) float32 z as a sensor measured it, 0 = none.

        ``classify`` gives class ids (h, w) uint8 of the map's label set as something sees them in the frame, which have
        to be the map's; called where all else agrees. ``features`` of the frame, where they are known
        (``find_place_features``)."""
        if not self._places:
            return NotFound("no-places", "the map has nothing to find oneself by")
        if depth_m is None or float((depth_m > 0).mean()) < _LEAST_DEPTH:
            return NotFound("no-depth", "the frame has hardly any measured depth, and a picture alone proves no place")
        features = features or find_place_features(rgb, depth_m, MAX_FEATURES)
        tried: list[_Tried] = []
        for guess, landmarks in self._guesses(features, intrinsics):
            if not any(_same(guess, t.guess) or _same(guess, t.pose) for t in tried):
                result = self._try(guess, landmarks, features, rgb, depth_m, intrinsics)
                tried += [] if result is None else [result]
            if len(tried) == _TRIED:
                break
        if not tried:
            return NotFound("unknown", "no place of the map shows what the frame shows")
        best = max(tried, key=lambda t: len(t.support.points))
        count = len(best.support.points)
        refusal = self._refusal(best, tried, depth_m, intrinsics, classify)
        return Relocalized(best.pose, count) if refusal is None else NotFound(*refusal, count)

    def _try(
        self,
        guess: Float64,
        landmarks: _Landmarks,
        features: Features,
        rgb: UInt8,
        depth_m: Float32,
        intrinsics: CameraIntrinsics,
    ) -> _Tried | None:
        """Align a frame to the map and compare it; None where that leads away from the guess."""
        width = min(_WIDTH, intrinsics.width)
        small = scale_intrinsics(intrinsics, width, max(1, round(width * intrinsics.height / intrinsics.width)))
        size = (small.width, small.height)
        depth = np.asarray(cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST), np.float32)
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)
        pose = self._align(guess, landmarks, depth, small, intrinsics)
        if pose is None:
            return None
        view = self._surface.ray_cast(pose, small)
        measured = depth > 0
        both = measured & (view.depth_m > 0)
        agreeing = both & _depth_agrees(depth, view.depth_m)
        small_rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
        gray, theirs = (np.asarray(cv2.cvtColor(i, cv2.COLOR_RGB2GRAY), np.uint8) for i in (small_rgb, view.rgb))
        return _Tried(
            guess,
            landmarks,
            pose,
            self._support(features, pose, intrinsics),
            view,
            agreeing,
            overlap=float(both.sum()) / max(int(measured.sum()), 1),
            agree=float(agreeing.sum()) / max(int(both.sum()), 1),
            likeness=_correlation(gray, theirs, agreeing),
        )

    def _align(
        self, guess: Float64, landmarks: _Landmarks, depth_m: Float32, small: CameraIntrinsics, whole: CameraIntrinsics
    ) -> Float64 | None:
        """The pose near a guess at which the depth fits the map's ray cast best, point to plane, (4, 4); landmarks hold
        it where surfaces leave it free to slide. None where that leads away from the guess."""
        points = unproject(depth_m, small).reshape(-1, 3)
        points = points[points[:, 2] > 0]
        points = points[:: max(1, len(points) // _POINTS)]
        pose = guess
        for reach_m in _REACHES_M:
            T_world_view = pose
            view = make_level(self._surface.ray_cast(pose, small).depth_m, small)
            for _ in range(_STEPS):
                by_depth = _plane_equations(points, view, invert_pose(T_world_view) @ pose, reach_m)
                by_features = _landmark_equations(landmarks, whole, pose)
                step = gauss_newton_step(*(a + b for a, b in zip(by_depth, by_features, strict=True)))
                pose = nearest_pose(pose @ step)
                if not np.linalg.norm(pose[:3, 3] - guess[:3, 3]) < _AWAY_M:  # NaN, too
                    return None
                if np.abs(step - np.eye(4)).max() < 1e-4:
                    break
        return pose

    def _refusal(
        self,
        best: _Tried,
        tried: list[_Tried],
        depth_m: Float32,
        intrinsics: CameraIntrinsics,
        classify: Callable[[], UInt8] | None,
    ) -> tuple[str, str] | None:
        count = len(best.support.points)
        if count < MIN_INLIERS:
            return "few-features", f"{count} features agree on a pose, {MIN_INLIERS} have to"
        diagonal = float(np.hypot(intrinsics.width, intrinsics.height))
        if float(np.sqrt(best.support.pixels.var(axis=0).sum())) < MIN_SPREAD * diagonal:
            return "few-features", "the features that agree on a pose are all of one small thing"
        size = _relative_size(best.landmarks, depth_m, intrinsics)
        if abs(size - 1) > MAX_STRETCH:  # false for NaN
            return "calibration", (
                f"the frame shows things {size:.2f} times as large as the map has them: focal length or depth is wrong"
            )
        if best.overlap < MIN_OVERLAP or best.agree < (MIN_AGREE if count >= SURE_INLIERS else SURE_AGREE):
            return "contradicted", (
                f"{best.overlap:.0%} of the depth shows what the map has, and {best.agree:.0%} of that agrees"
            )
        if best.likeness < MIN_LIKENESS:
            return "looks-different", f"brightness of frame and map correlate by {best.likeness:.2f} only"
        rival = max((len(t.support.points) for t in tried if not _same(t.pose, best.pose)), default=0)
        if rival > MAX_RIVAL * count:
            return "ambiguous", f"another pose has {rival} features for it, this one {count}"
        classes = np.nan if classify is None else self._class_agreement(best, classify())
        if classes < MIN_CLASSES:  # false for NaN
            return "classes", f"{classes:.0%} of the pixels are of the map's class"
        return None

    def _class_agreement(self, tried: _Tried, label: UInt8) -> float:
        """Fraction of pixels of the map's class, where both are sure and the depth agrees; NaN: hardly any."""
        view = tried.view
        height, width = view.label.shape
        own = np.asarray(cv2.resize(label, (width, height), interpolation=cv2.INTER_NEAREST), np.uint8)
        known = tried.agreeing & (own != self._ignore_id) & (view.label != self._ignore_id) & (view.confidence >= _SURE)
        return float((own == view.label)[known].mean()) if known.mean() > 0.05 else float("nan")

    def _support(self, features: Features, pose: Float64, intrinsics: CameraIntrinsics) -> _Landmarks:
        """Features of a frame that the places round its pose have where they must be: at that pixel and depth."""
        apart = [sum(pose_distance(p.T_world_camera, pose)) for p in self._places]
        near = [i for i in np.argsort(apart, kind="stable")[:_GROUP] if apart[i] < _REACH_M]
        if not near or not len(features.pixels):
            return _NOTHING
        points = np.concatenate([self._world_points(i, slice(None)) for i in near])
        theirs = np.concatenate([self._places[i].descriptors for i in near]).astype(np.float32)
        seen = transform(invert_pose(pose), points)
        front = seen[:, 2] > 0.1
        if not front.any():
            return _NOTHING
        points, theirs, seen = points[front], theirs[front], seen[front]
        pixels = project(seen, intrinsics)
        off = np.linalg.norm(features.pixels[:, None] - pixels[None], axis=2)  # (N, M)
        deep = np.abs(features.depth_m[:, None] - seen[None, :, 2]) < _DEPTH_M + _DEPTH * seen[None, :, 2]
        ours = features.descriptors.astype(np.float32)
        square = (ours**2).sum(axis=1)[:, None] + (theirs**2).sum(axis=1)[None] - 2 * ours @ theirs.T
        square[(off > _SUPPORT * intrinsics.fx) | (~deep & (features.depth_m[:, None] > 0))] = np.inf
        best = square.argmin(axis=1)
        alike = np.flatnonzero(square.min(axis=1) < _ALIKE**2)
        return _Landmarks(points[best[alike]], features.pixels[alike])

    def _guesses(self, features: Features, intrinsics: CameraIntrinsics) -> list[tuple[Float64, _Landmarks]]:
        """Poses that features lead to, those with the most of them first."""
        descriptors = {key: place.descriptors for key, place in enumerate(self._places)}
        ranked = [key for key, _ in rank_places(features, descriptors, _CANDIDATES)]
        pairs = {key: match_features(features.descriptors, descriptors[key]) for key in ranked}
        guesses: list[tuple[Float64, _Landmarks]] = []
        for key in ranked:
            near = [k for k in ranked if self._near(k, key)][:_GROUP]
            points = np.concatenate([self._world_points(k, pairs[k][:, 1]) for k in near])
            pixels = np.concatenate([features.pixels[pairs[k][:, 0]] for k in near])
            found = pose_from_points(points, pixels, intrinsics, 6, _REPROJECTION * intrinsics.fx)
            if found is None:
                continue
            pose, inliers = found
            if np.linalg.norm(pose[:3, 3] - self._places[key].T_world_camera[:3, 3]) > _FAR_M:
                continue
            _, first = np.unique(np.rint(pixels[inliers]), axis=0, return_index=True)  # one pixel is one feature
            chosen = inliers[first]
            guesses.append((pose, _Landmarks(points[chosen], pixels[chosen])))
        guesses.sort(key=lambda guess: -len(guess[1].points))
        return guesses

    def _near(self, a: int, b: int) -> bool:
        return _within(self._places[a].T_world_camera, self._places[b].T_world_camera, _GROUP_M, _GROUP_RAD)

    def _world_points(self, key: int, which: Int64 | slice) -> Float64:
        place = self._places[key]
        return transform(place.T_world_camera, place.points[which].astype(np.float64))


def _relative_size(landmarks: _Landmarks, depth_m: Float32, intrinsics: CameraIntrinsics) -> float:
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


def _plane_equations(points: Float64, view: Level, T_view_camera: Float64, reach_m: float) -> tuple[Float64, Float64]:
    """Normal matrix (6, 6) and gradient (6,) of points (N, 3) to the planes of a view, for a turn and a shift of the
    camera in its own axes. Unlike in ``compare`` all depths count alike: the errors are the map's."""
    p = transform(T_view_camera, points)
    inside, rows, columns = nearest_pixels(p, view.intrinsics)
    there, facing = (a[rows, columns].astype(np.float64) for a in (view.points, view.normals))
    gap = np.where(inside & np.isfinite(facing[:, 0]), ((p - there) * facing).sum(axis=1), np.inf)
    near = np.abs(gap) < reach_m
    n = facing[near] @ T_view_camera[:3, :3]
    j = np.concatenate((np.cross(points[near], n), n), axis=1)
    return _weighted(j, gap[near], _DEPTH_SIGMA_M, _POINTS_A_VOTE)


def _landmark_equations(landmarks: _Landmarks, intrinsics: CameraIntrinsics, pose: Float64) -> tuple[Float64, Float64]:
    """The same of the landmarks' distances in the image."""
    p = transform(invert_pose(pose), landmarks.points)
    front = p[:, 2] > 0.05
    p = p[front]
    off = (project(p, intrinsics) - landmarks.pixels[front]).reshape(-1)
    x, y, z = p.T
    zero = np.zeros_like(z)
    across = np.stack((intrinsics.fx / z, zero, -intrinsics.fx * x / z**2), axis=1)
    down = np.stack((zero, intrinsics.fy / z, -intrinsics.fy * y / z**2), axis=1)
    by_point = np.stack((across, down), axis=1)  # (K, 2, 3)
    # A turn w and a shift t of the camera move the point in its axes by p x w - t.
    j = np.concatenate((np.cross(by_point, p[:, None]), -by_point), axis=2).reshape(-1, 6)
    return _weighted(j, off, _FEATURE_SIGMA_PX, 1)


def _weighted(j: Float64, off: Float64, sigma: float, a_vote: int) -> tuple[Float64, Float64]:
    """Normal matrix and gradient of residuals (N,) with their derivatives (N, 6), Huber."""
    weight = np.minimum(1.0, _HUBER * sigma / np.maximum(np.abs(off), 1e-12)) / (sigma**2 * a_vote)
    return (j * weight[:, None]).T @ j, (j * (weight * off)[:, None]).sum(axis=0)


def _depth_agrees(depth_m: Float32, map_m: Float32) -> Bool:
    """(h, w) whether a depth is that of the map or of a neighbour there: next to an edge it may show either surface."""
    limit = _TOLERANCE_M + _TOLERANCE * map_m
    low = np.where(map_m > 0, map_m - limit, np.float32(np.inf)).astype(np.float32)
    high = np.where(map_m > 0, map_m + limit, np.float32(0)).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    return np.asarray((depth_m > cv2.erode(low, kernel)) & (depth_m < cv2.dilate(high, kernel)), np.bool_)


def _correlation(a: UInt8, b: UInt8, where: Bool) -> float:
    if where.sum() < 50:
        return 0.0
    x, y = a[where].astype(np.float64), b[where].astype(np.float64)
    x, y = x - x.mean(), y - y.mean()
    size = float(np.sqrt((x @ x) * (y @ y)))
    return float(x @ y) / size if size > 0 else 0.0


def _within(a: Float64, b: Float64, way_m: float, turn_rad: float) -> bool:
    moved_m, turned = pose_distance(a, b)
    return moved_m < way_m and turned < turn_rad


def _same(a: Float64, b: Float64) -> bool:
    return _within(a, b, _SAME_M, _SAME_RAD)


class Sighting(NamedTuple):
    """A frame that was found: its pose (4, 4) in its own world, and where that puts its world in the map, (4, 4)."""

    T_map_world: Float64
    T_world_camera: Float64


class Consensus(NamedTuple):
    """What sightings say together: the largest group that says the same, and why it is not believed, "" where it is."""

    agreeing: list[Sighting]
    refusal: str


def sighting(T_map_camera: Float64, T_world_camera: Float64) -> Sighting:
    """A frame of this pose that was found at that one."""
    return Sighting(T_map_camera @ invert_pose(T_world_camera), T_world_camera)


def agreeing_with(one: Sighting, others: Sequence[Sighting]) -> list[Sighting]:
    """Those that say the same as ``one`` of where both cameras were; itself, too, if it is among them."""
    return [other for other in others if _agree(one, other)]


def find_consensus(seen: Sequence[Sighting]) -> Consensus:
    """What most sightings say, if enough do, and no others that agree with each other say something else."""
    best = _largest_group(seen)
    rival = _largest_group([s for s in seen if not agreeing_with(s, best)])
    refusal = ""
    if len(best) < AGREEING:
        refusal = f"{len(best)} of {AGREEING} frames agree on it"
    elif 2 * len(best) <= len(seen):
        refusal = f"{len(best)} of {len(seen)} frames that were found agree, more than half have to"
    elif len(rival) > _RIVAL * len(best):
        refusal = f"{len(best)} frames say one thing and {len(rival)} another, as of places that look alike"
    return Consensus(best, refusal)


def agreed(agreeing: Sequence[Sighting]) -> Float64:
    """T_map_world (4, 4) that fits all of those that agree best, far ones less: it takes what their cameras see."""
    old = np.concatenate([transform(s.T_world_camera, _LOOKED_AT) for s in agreeing])
    new = np.concatenate([transform(s.T_map_world @ s.T_world_camera, _LOOKED_AT) for s in agreeing])
    weights = np.ones(len(agreeing))
    T = np.eye(4)
    for _ in range(_FIT_ROUNDS):
        w = np.repeat(weights / weights.sum() / len(_LOOKED_AT), len(_LOOKED_AT))
        a, b = w @ old, w @ new
        T[:3, :3] = scipy.spatial.transform.Rotation.align_vectors(new - b, old - a, w)[0].as_matrix()
        T[:3, 3] = b - T[:3, :3] @ a
        off = np.linalg.norm(transform(T, old) - new, axis=1).reshape(len(agreeing), -1)
        weights = 1 / (1 + (off**2).mean(axis=1) / _SPREAD_M**2)
    return T


def _largest_group(seen: Sequence[Sighting]) -> list[Sighting]:
    """The most that agree with one of them; earlier ones first if equal."""
    return max((agreeing_with(one, seen) for one in seen), key=len, default=[])


def _agree(a: Sighting, b: Sighting) -> bool:
    poses = a.T_world_camera, b.T_world_camera
    return all(_within(a.T_map_world @ pose, b.T_map_world @ pose, _AGREE_M, _AGREE_RAD) for pose in poses)
