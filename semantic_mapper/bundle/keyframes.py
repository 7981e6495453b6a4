"""Keyframes with the corners that they see, the points in space that these are of, and the bundle adjustment of both.

GTSAM finds poses and points that fit the pixels best, with given poses as priors, and old keyframes held.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from semantic_mapper.bundle.tracks import Tracks
from semantic_mapper.geometry import camera_matrix, invert_pose, make_pose, project, transform
from semantic_mapper.log_events import get_logger
from semantic_mapper.types import Bool, CameraIntrinsics, Float64, Int64

if TYPE_CHECKING:
    import gtsam

_LEAST_PARALLAX = np.radians(1.0)  # between the rays that a point is found from
_MAX_ERROR_PX = 3.0  # a sight that is further off is of something else
_SHARED_LEAST = 10  # points that an old keyframe must share with the window to hold it
_PNP_PX = 3.0
_FLOW = 0.04  # of the image's width that corners move by to the next keyframe
_LEFT = 0.6  # of the last keyframe's corners: fewer, and there is another keyframe
_LEAST_CORNERS = 20
_PIXEL_SIGMA = 0.7  # of a corner that is followed
_HUBER_SIGMAS = 1.5  # errors beyond count less
_PRIOR_HUBER_SIGMAS = 2.0
_HELD_SIGMA = 1e-4  # metres and radians, of keyframes that stay where they are
_TOLERANCE = 1e-4  # relative decrease of the cost that ends it

_log = get_logger(__name__)


@dataclass(slots=True, eq=False)
class Keyframe:
    """A frame that takes part in the bundle."""

    number: int  # counts keyframes from 0
    tracks: Tracks  # what it sees
    T_world_camera: Float64  # (4, 4), the best that is known
    prior: Float64  # (4, 4) as given; anything where ``prior_sigmas`` are infinite
    prior_sigmas: tuple[float, float]  # metres and radians


@dataclass(frozen=True, slots=True, eq=False)
class BundleProblem:
    """K keyframes, P points, N sights of them."""

    intrinsics: CameraIntrinsics  # of the images that the pixels are in
    poses: Float64  # (K, 4, 4) T_world_camera, first guesses
    held: Bool  # (K,) whether a keyframe stays at its first guess
    priors: Float64  # (K, 4, 4) T_world_camera as given
    prior_sigmas: Float64  # (K, 2) one sigma of these in metres and radians; infinite = none was given
    points: Float64  # (P, 3) first guesses, world
    keyframe: Int64  # (N,) rows of what sees
    point: Int64  # (N,) rows of what is seen
    pixels: Float64  # (N, 2) as (u, v)
    keyframes: Sequence[Keyframe] = ()  # of a map
    ids: Sequence[int] = ()  # of a map: the tracks of the points


class BundleResult(NamedTuple):
    """What a bundle adjustment found."""

    poses: Float64  # (K, 4, 4)
    points: Float64  # (P, 3)
    errors_px: Float64  # (N,) of each sight; infinite behind the camera


class KeyframeMap:
    """The last keyframes and their points; a bundle moves ``window`` of them, and as many before these hold it."""

    def __init__(self, intrinsics: CameraIntrinsics, window: int) -> None:
        self.intrinsics = intrinsics
        self.keyframes: list[Keyframe] = []
        self.points: dict[int, Float64] = {}  # id of a track -> (3,) world
        self._window = window

    def add(self, keyframe: Keyframe) -> None:
        """Append a keyframe, and find the points that it is the second or later one to see."""
        self.keyframes.append(keyframe)
        del self.keyframes[: -2 * self._window]
        self._triangulate()
        seen = np.concatenate([k.tracks.ids for k in self.keyframes])
        for gone in self.points.keys() - set(seen.tolist()):
            del self.points[gone]

    def known(self, tracks: Tracks) -> tuple[Bool, Float64]:
        """Which tracks (N,) have a point, and these points (M, 3)."""
        mask = np.array([i in self.points for i in tracks.ids.tolist()], bool)
        return mask, np.array([self.points[i] for i in tracks.ids[mask].tolist()]).reshape(-1, 3)

    def locate(self, tracks: Tracks, guess: Float64, least: int) -> tuple[Float64, Int64] | None:
        """T_world_camera (4, 4) of a frame from the points that it sees, and ids of tracks that do not agree with it;
        None where fewer than ``least`` agree."""
        mask, points = self.known(tracks)
        if mask.sum() < least:
            return None
        pixels, K = tracks.pixels[mask], camera_matrix(self.intrinsics)
        T_camera_world = invert_pose(guess)
        turn, shift = cv2.Rodrigues(T_camera_world[:3, :3])[0], T_camera_world[:3, 3:].copy()
        cv2.setRNGSeed(1)
        found, turn, shift, inliers = cv2.solvePnPRansac(
            points, pixels, K, None, turn, shift, True, 100, _PNP_PX, 0.99, flags=cv2.SOLVEPNP_ITERATIVE
        )
        if not found or inliers is None or len(inliers) < least:
            return None
        rows = np.asarray(inliers, np.int64).ravel()
        turn, shift = cv2.solvePnPRefineLM(points[rows], pixels[rows], K, None, turn, shift)
        off = np.ones(len(points), bool)
        off[rows] = False
        return invert_pose(make_pose(turn, shift)), tracks.ids[mask][off]

    def wants_keyframe(self, tracks: Tracks) -> bool:
        """Whether a frame that sees these corners should become the next keyframe."""
        if not self.keyframes:
            return True
        before = self.keyframes[-1].tracks
        shared = np.isin(before.ids, tracks.ids).sum()
        return shared < max(_LEFT * len(before.ids), _LEAST_CORNERS) or self.flow(tracks) > _FLOW

    def flow(self, tracks: Tracks) -> float:
        """Median motion of corners since the last keyframe, as a fraction of the image's width; NaN where few stay."""
        before = self.keyframes[-1].tracks
        _, now, then = np.intersect1d(tracks.ids, before.ids, assume_unique=True, return_indices=True)
        if len(now) < _LEAST_CORNERS:
            return np.nan
        moved = tracks.pixels[now] - before.pixels[then]
        return float(np.median(np.linalg.norm(moved, axis=1))) / self.intrinsics.width

    def predict(self, tracks: Tracks, T_world_before: Float64, T_world_camera: Float64) -> Float64:
        """Where the tracks of the image before are expected (N, 2): by their points, or by the rotation alone."""
        K = camera_matrix(self.intrinsics)
        R = T_world_camera[:3, :3].T @ T_world_before[:3, :3]
        rays = np.concatenate((tracks.pixels, np.ones((len(tracks.pixels), 1))), axis=1) @ np.linalg.inv(K).T @ R.T
        mask, points = self.known(tracks)
        rays[mask] = transform(invert_pose(T_world_camera), points)
        front = rays[:, 2] > 1e-3
        expected = tracks.pixels.copy()
        expected[front] = project(rays[front], self.intrinsics)
        return expected

    def bundle(self) -> BundleProblem | None:
        """The last keyframes and what they see, held by earlier ones; None where nothing is seen twice."""
        free = self.keyframes[-self._window :]
        wanted = set(np.concatenate([k.tracks.ids for k in free]).tolist()) & self.points.keys()
        old = [
            k
            for k in self.keyframes[: -self._window]
            if len(wanted.intersection(k.tracks.ids.tolist())) >= _SHARED_LEAST
        ]
        keyframes, ids = [*old, *free], sorted(wanted)
        number = {track: row for row, track in enumerate(ids)}
        sights = [
            (row, number[track], pixel)
            for row, k in enumerate(keyframes)
            for track, pixel in zip(k.tracks.ids.tolist(), k.tracks.pixels, strict=True)
            if track in number
        ]
        if not sights:
            return None
        rows, columns, pixels = zip(*sights, strict=True)
        held = np.arange(len(keyframes)) < len(old)
        held[0] |= not any(np.isfinite(k.prior_sigmas[0]) for k in keyframes)  # something must hold the others
        poses, priors = (np.array([getattr(k, name) for k in keyframes]) for name in ("T_world_camera", "prior"))
        sigmas, points = np.array([k.prior_sigmas for k in keyframes]), np.array([self.points[i] for i in ids])
        seen = np.array(rows), np.array(columns), np.array(pixels)
        return BundleProblem(self.intrinsics, poses, held, priors, sigmas, points, *seen, keyframes, ids)

    def apply(self, problem: BundleProblem, found: BundleResult) -> None:
        """Take over what a bundle found. Keyframes added since move with the last one that took part.
        Sights that are far off are dropped, and points with fewer than two left."""
        keyframes, ids = problem.keyframes, problem.ids
        moved = found.poses[-1] @ invert_pose(keyframes[-1].T_world_camera)
        for keyframe, pose in zip(keyframes, found.poses, strict=True):
            keyframe.T_world_camera = pose
        for keyframe in self.keyframes:
            if keyframe.number > keyframes[-1].number:
                keyframe.T_world_camera = moved @ keyframe.T_world_camera
        for track in self.points.keys() - set(ids):
            self.points[track] = transform(moved, self.points[track])
        for track, point in zip(ids, found.points, strict=True):
            if track in self.points:
                self.points[track] = point
        wrong = found.errors_px > _MAX_ERROR_PX
        for row in np.unique(problem.keyframe[wrong]).tolist():
            bad = np.array(ids)[problem.point[wrong & (problem.keyframe == row)]]
            keyframes[row].tracks = keyframes[row].tracks.without(bad)
        left = np.bincount(problem.point[~wrong], minlength=len(ids))
        for column in np.flatnonzero(left < 2).tolist():
            self.points.pop(ids[column], None)

    def _triangulate(self) -> None:
        """Points of the newest keyframe's tracks that have none: from the keyframe furthest back that sees each."""
        new = self.keyframes[-1]
        left = np.array([i not in self.points for i in new.tracks.ids.tolist()], bool)
        for other in self.keyframes[:-1]:
            both = left & np.isin(new.tracks.ids, other.tracks.ids)
            ids = new.tracks.ids[both]
            if not len(ids):
                continue
            left &= ~both
            a, b = other.tracks.pixels[other.tracks.rows(ids)], new.tracks.pixels[both]
            points, good = triangulate(a, b, other.T_world_camera, new.T_world_camera, self.intrinsics)
            self.points.update({int(i): p for i, p in zip(ids[good], points[good], strict=True)})


def triangulate(
    a: Float64, b: Float64, T_world_a: Float64, T_world_b: Float64, intrinsics: CameraIntrinsics
) -> tuple[Float64, Bool]:
    """Points (N, 3) seen at pixels (N, 2) of two views; and (N,) whether rays meet, in front and at a sure angle."""
    K = camera_matrix(intrinsics)
    P_a, P_b = K @ invert_pose(T_world_a)[:3], K @ invert_pose(T_world_b)[:3]
    homogeneous = cv2.triangulatePoints(P_a, P_b, a.T, b.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = np.nan_to_num((homogeneous[:3] / homogeneous[3]).T, posinf=0.0, neginf=0.0)
    good = np.ones(len(points), bool)
    for pixels, T in ((a, T_world_a), (b, T_world_b)):
        good &= reprojection_errors(transform(invert_pose(T), points), pixels, intrinsics) < _MAX_ERROR_PX
    to_a, to_b = T_world_a[:3, 3] - points, T_world_b[:3, 3] - points
    with np.errstate(divide="ignore", invalid="ignore"):
        cosine = (to_a * to_b).sum(axis=1) / (np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1))
    return points, good & (cosine < np.cos(_LEAST_PARALLAX))


def adjust_bundle(problem: BundleProblem, iterations: int) -> BundleResult:
    """Least squares of all sights and priors (Levenberg-Marquardt, Huber). Deterministic.
    At least one keyframe must be held or have a prior."""
    import gtsam  # 30 MB, which a mapper without bundle adjustment does not need
    from gtsam.symbol_shorthand import L, X

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    k = problem.intrinsics
    lens = gtsam.Cal3_S2(k.fx, k.fy, 0.0, k.cx, k.cy)
    noise = gtsam.noiseModel
    held = noise.Isotropic.Sigma(6, _HELD_SIGMA)
    for row, pose in enumerate(problem.poses):
        start.insert(X(row), gtsam.Pose3(pose))
        metres, radians = problem.prior_sigmas[row]
        if problem.held[row]:
            graph.add(gtsam.PriorFactorPose3(X(row), gtsam.Pose3(pose), held))
        elif np.isfinite(metres):
            sigmas = noise.Diagonal.Sigmas(np.array([radians] * 3 + [metres] * 3))
            robust = noise.Robust.Create(noise.mEstimator.Huber.Create(_PRIOR_HUBER_SIGMAS), sigmas)
            graph.add(gtsam.PriorFactorPose3(X(row), gtsam.Pose3(problem.priors[row]), robust))
    for row, point in enumerate(problem.points):
        start.insert(L(row), point)
    pixel = noise.Robust.Create(noise.mEstimator.Huber.Create(_HUBER_SIGMAS), noise.Isotropic.Sigma(2, _PIXEL_SIGMA))
    factor = gtsam.GenericProjectionFactorCal3_S2
    for seen, row, column in zip(problem.pixels, problem.keyframe.tolist(), problem.point.tolist(), strict=True):
        graph.add(factor(seen, pixel, X(row), L(column), lens, False, False))
    try:
        found = minimize(graph, start, iterations)
    except RuntimeError as error:  # what GTSAM raises where sights leave a direction open
        _log.warning("bundle_left_out", reason=str(error).strip()[:200])
        found = start
    poses = np.array([found.atPose3(X(row)).matrix() for row in range(len(problem.poses))])
    poses[problem.held] = problem.poses[problem.held]
    points = np.array([found.atPoint3(L(row)) for row in range(len(problem.points))]).reshape(-1, 3)
    R, t = poses[problem.keyframe, :3, :3], poses[problem.keyframe, :3, 3]
    p_camera = np.einsum("nji,nj->ni", R, points[problem.point] - t)
    return BundleResult(poses, points, reprojection_errors(p_camera, problem.pixels, problem.intrinsics))


def minimize(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, iterations: int) -> gtsam.Values:
    """Values of the least cost (Levenberg-Marquardt); GTSAM raises RuntimeError where a direction is left open."""
    import gtsam

    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, start, gtsam.LevenbergMarquardtParams())
    cost = optimizer.error()
    for _ in range(iterations):  # ``optimize`` would keep Python's other threads waiting until its end
        optimizer.iterate()
        before, cost = cost, optimizer.error()
        if before - cost <= _TOLERANCE * before:
            break
    return optimizer.values()


def reprojection_errors(p_camera: Float64, pixels: Float64, intrinsics: CameraIntrinsics) -> Float64:
    """Distances (N,) in pixels between points (N, 3) of the camera's frame and where they are seen (N, 2)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = p_camera[:, :2] / p_camera[:, 2:] * (intrinsics.fx, intrinsics.fy) + (intrinsics.cx, intrinsics.cy)
    errors = np.linalg.norm(uv - pixels, axis=1)
    return np.where((p_camera[:, 2] > 1e-3) & np.isfinite(errors), errors, np.inf)
