"""Poses that fit the pictures: given poses as a prior, corners followed over keyframes, a sliding bundle."""

from collections import deque
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from semantic_mapper.bundle import keyframes
from semantic_mapper.bundle.tracks import Tracker, Tracks, prepare_image
from semantic_mapper.config import PoseRefinerConfig
from semantic_mapper.geometry import invert_pose, nearest_pose, pose_distance, transform
from semantic_mapper.imaging import working_intrinsics
from semantic_mapper.types import CameraIntrinsics, Float64, PosedFrame

_WINDOW = 20  # keyframes that are adjusted together
_CORNERS, _WIDTH = 300, 640  # followed in an image, and its width at most
_LEAST_POINTS = 20  # that must agree on a frame's pose
_MAX_SIGMAS = 4.0  # a pose that is further from the given one is not believed
_ITERATIONS = 8
# By which corners are off, beyond what refining leaves: from here on given poses have all of their sigma.
_MISFIT_RAD = 2.2e-3
_LEAST_SIGMAS = 0.05  # of it where they fit the pictures as well as refined ones
_MISFIT_FRAMES = 30  # that this is judged by; from a third of them on
_SCALE_SIGMA = 0.05  # of refined poses, before they are compared with given ones
_CORRELATED = 5.0  # keyframes whose given poses share an error
_CORRECTED_M, _CORRECTED_RAD = 1e-3, 5e-4  # smaller changes are not reported


@dataclass(frozen=True, slots=True, eq=False)
class RefinedPose:
    """What became of a frame's pose."""

    T_world_camera: Float64  # (4, 4) float64
    refined: bool  # whether the picture took part; the given pose, moved like the frames around it, where not
    # median distance in pixels of the frame between corners and where they would be by the given poses of this frame
    # and the last keyframe; NaN where too few corners are known
    given_error_px: float
    error_px: float  # the same by the refined poses


@dataclass(slots=True, eq=False)
class _Frame:
    """A frame whose pose may still change."""

    key: tuple[str, int]
    keyframe: keyframes.Keyframe
    T_keyframe_camera: Float64
    reported: Float64  # T_world_camera
    tracks: Tracks | None  # of a frame that no points were known for yet; None of all others


class PoseRefiner:
    """Refines the poses of one camera's frames, in the order of capture. Deterministic unless ``background``: then the
    bundle runs in a thread of its own, no frame waits for it, and results arrive with one of the next frames.
    """

    def __init__(self, intrinsics: CameraIntrinsics, config: PoseRefinerConfig, *, background: bool = False) -> None:
        self._config = config
        self._intrinsics = intrinsics
        self._tracker = Tracker(_CORNERS)
        self._map = keyframes.KeyframeMap(working_intrinsics(intrinsics, _WIDTH), _WINDOW)
        self._frames: list[_Frame] = []
        self._given: Float64 | None = None  # pose of the frame before
        self._refined = np.eye(4)
        self._sigma_m = config.sigma_m  # of the last given pose
        self._misfits: deque[float] = deque(maxlen=_MISFIT_FRAMES)  # of given poses beyond refined ones, radians
        self._worker = ThreadPoolExecutor(1, "pose bundle") if background else None
        self._pending: tuple[keyframes.BundleProblem, Future[keyframes.BundleResult]] | None = None

    def push(self, frame: PosedFrame) -> RefinedPose:
        """Refine the next frame's pose."""
        self._collect(wait=False)
        image = prepare_image(frame.rgb, self._map.intrinsics.width, self._map.intrinsics.height)
        given = nearest_pose(frame.T_world_camera)
        sigmas = self._sigmas(frame)
        self._sigma_m = sigmas[0]
        guess = given if self._given is None else nearest_pose(self._refined @ invert_pose(self._given) @ given)
        expected = self._map.predict(self._tracker.tracks, self._refined, guess)
        tracks = self._tracker.advance(image, expected)
        pose, refined = self._locate(tracks, guess, sigmas)
        given_px, error_px = self._disagreement(tracks, given, pose)
        if np.isfinite(given_px - error_px):
            self._misfits.append((given_px - error_px) / frame.intrinsics.fx)
        self._given, self._refined = given, pose
        is_keyframe = self._map.wants_keyframe(tracks)
        if is_keyframe:
            number = self._map.keyframes[-1].number + 1 if self._map.keyframes else 0
            self._map.add(keyframes.Keyframe(number, self._tracker.replenish(), pose, given, self._sigmas(frame)))
            self._adjust()
        last = self._map.keyframes[-1]
        relative = invert_pose(last.T_world_camera) @ self._refined
        late = None if refined or is_keyframe else tracks
        self._frames.append(_Frame((frame.camera_id, frame.stamp_ns), last, relative, self._refined, late))
        return RefinedPose(self._refined, refined, given_px, error_px)

    def corrections(self) -> dict[tuple[str, int], Float64]:
        """Better poses T_world_camera (4, 4) of earlier frames, by camera and stamp, since the last call: where their
        keyframe is in the window, and they changed by 1 mm or 0.03 degrees."""
        self._collect(wait=False)
        changed: dict[tuple[str, int], Float64] = {}
        for frame in self._frames:
            self._locate_late(frame)
            pose = frame.keyframe.T_world_camera @ frame.T_keyframe_camera
            moved_m, turned = pose_distance(frame.reported, pose)
            if moved_m > _CORRECTED_M or turned > _CORRECTED_RAD:
                changed[frame.key] = frame.reported = pose
        alive = {k.number for k in self._map.keyframes[-_WINDOW:]}
        self._frames = [frame for frame in self._frames if frame.keyframe.number in alive]
        return changed

    def to_given(self, T_world_camera: Float64) -> tuple[Float64, float]:
        """Where the given poses have a camera (4, 4) of the world of refined poses, as the keyframes in reach say in
        the mean; and what depth that is computed from refined poses has to be multiplied by. Refined poses fit each
        other but drift in place and scale; given ones do not drift."""
        refined, given = self._keyframe_poses()
        if not len(given):
            return T_world_camera, 1.0
        T, scale = align_poses(refined, given)
        moved = T @ T_world_camera
        moved[:3, 3] = scale * (moved[:3, 3] - T[:3, 3]) + T[:3, 3]
        return moved, scale

    @property
    def scale_spread(self) -> float:
        """One sigma of the scale of refined poses and of what is computed from them, a fraction: the error of given
        poses against the extent of the path that it comes from. Infinite before the camera has moved."""
        _, given = self._keyframe_poses()
        if not len(given):
            return np.inf
        places = given[:, :3, 3]
        extent = float(np.linalg.norm(places - places.mean(axis=0)))  # sqrt of the sum of squares over all keyframes
        return self._sigma_m / extent if extent > 0 else np.inf

    def _keyframe_poses(self) -> tuple[Float64, Float64]:
        """Refined and given poses (K, 4, 4) of the keyframes in reach."""
        refined = np.array([k.T_world_camera for k in self._map.keyframes]).reshape(-1, 4, 4)
        return refined, np.array([k.prior for k in self._map.keyframes]).reshape(-1, 4, 4)

    def close(self) -> None:
        """Wait for a bundle that is under way."""
        self._collect(wait=True)
        if self._worker is not None:
            self._worker.shutdown()

    def _sigmas(self, frame: PosedFrame) -> tuple[float, float]:
        """Metres and radians; less than the config says where given poses have fitted the pictures."""
        fraction = 1.0
        if 3 * len(self._misfits) >= _MISFIT_FRAMES:
            fraction = float(np.clip(np.median(self._misfits) / _MISFIT_RAD, _LEAST_SIGMAS, 1.0))
        return frame.pose_sigma or fraction * self._config.sigma_m, fraction * np.radians(self._config.sigma_deg)

    def _locate(self, tracks: Tracks, guess: Float64, sigmas: tuple[float, float]) -> tuple[Float64, bool]:
        found = self._map.locate(tracks, guess, _LEAST_POINTS)
        if found is None:
            return guess, False
        pose, wrong = found
        moved_m, turned = pose_distance(guess, pose)  # against the given motion since the frame before
        if np.hypot(moved_m / sigmas[0], turned / sigmas[1]) > _MAX_SIGMAS:
            return guess, False
        self._tracker.drop(wrong)
        return pose, True

    def _locate_late(self, frame: _Frame) -> None:
        """Find a frame's place among points that became known after it."""
        guess = frame.keyframe.T_world_camera @ frame.T_keyframe_camera
        found = None if frame.tracks is None else self._map.locate(frame.tracks, guess, _LEAST_POINTS)
        if found is not None:
            frame.T_keyframe_camera, frame.tracks = invert_pose(frame.keyframe.T_world_camera) @ found[0], None

    def _adjust(self) -> None:
        """Bundle now, or in the worker where that is free."""
        problem = None if self._pending is not None else self._map.bundle()
        if problem is None:
            return
        if self._worker is None:
            self._apply(problem, keyframes.adjust_bundle(problem, _ITERATIONS))
        else:
            self._pending = problem, self._worker.submit(keyframes.adjust_bundle, problem, _ITERATIONS)

    def _collect(self, wait: bool) -> None:
        if self._pending is not None and (wait or self._pending[1].done()):
            (problem, future), self._pending = self._pending, None
            self._apply(problem, future.result())

    def _apply(self, problem: keyframes.BundleProblem, found: keyframes.BundleResult) -> None:
        last = self._map.keyframes[-1]
        before = invert_pose(last.T_world_camera)
        self._map.apply(problem, found)
        self._refined = last.T_world_camera @ before @ self._refined

    def _disagreement(self, tracks: Tracks, given: Float64, refined: Float64) -> tuple[float, float]:
        """Median errors of this frame by given and by refined poses, from points as the last keyframe saw them."""
        mask, known = self._map.known(tracks)
        if mask.sum() < _LEAST_POINTS:
            return np.nan, np.nan
        last, small = self._map.keyframes[-1], self._map.intrinsics
        in_last = transform(invert_pose(last.T_world_camera), known)
        errors = [
            keyframes.reprojection_errors(transform(T, in_last), tracks.pixels[mask], small)
            for T in (invert_pose(given) @ last.prior, invert_pose(refined) @ last.T_world_camera)
        ]
        factor = self._intrinsics.width / small.width
        return factor * float(np.median(errors[0])), factor * float(np.median(errors[1]))


def align_poses(moved: Float64, to: Float64) -> tuple[Float64, float]:
    """Rigid T (4, 4) and scale that take poses (K, 4, 4) to others in the mean: the rotation from theirs, the rest from
    their places p, ``scale * T[:3, :3] @ p + T[:3, 3]``.

    Unlike a fit of places alone it is sure of the rotation where the camera has moved little, or straight on. The scale
    is near 1 where the places do not show it: where what is left of their distances is large against the path.
    """
    T = np.eye(4)
    T[:3, :3] = np.einsum("kij,klj->il", to[:, :3, :3], moved[:, :3, :3])
    T = nearest_pose(T)
    middle, to_middle = moved[:, :3, 3].mean(axis=0), to[:, :3, 3].mean(axis=0)
    a, b = (moved[:, :3, 3] - middle) @ T[:3, :3].T, to[:, :3, 3] - to_middle
    extent = float((a * a).sum())
    scale = 1.0
    if extent > 0:
        fit = float((a * b).sum()) / extent
        left = float(((b - fit * a) ** 2).mean(axis=0).sum())
        variance = left * _CORRELATED / extent
        scale += (fit - 1) * _SCALE_SIGMA**2 / (_SCALE_SIGMA**2 + variance)
    T[:3, 3] = to_middle - scale * T[:3, :3] @ middle
    return T, scale
