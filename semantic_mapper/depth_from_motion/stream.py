"""Depth for a stream of posed frames, as they come or a few frames late; and which frames each is matched with."""

import itertools
from collections import OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from semantic_mapper.config import DepthFromMotionConfig
from semantic_mapper.depth_from_motion.estimate import estimate_depth
from semantic_mapper.depth_from_motion.views import DepthEstimate, PreparedView, enlarge_estimate, prepare_view
from semantic_mapper.geometry import invert_pose, project, rotation_vector, transform
from semantic_mapper.log_events import get_logger
from semantic_mapper.types import CameraIntrinsics, Float32, Float64, PosedFrame

_log = get_logger(__name__)

Hint = Callable[[PosedFrame, CameraIntrinsics], DepthEstimate]

MAX_VIEWS = 24  # kept of one camera; half a megabyte each
MAX_CAMERAS = 32  # those that sent nothing for longest are forgotten
RECENT_VIEWS = 8  # of one camera, kept whatever they look at
NEIGHBOURS = 6  # earlier estimates that a new one is compared with
TURN_WEIGHT_M = 0.5  # a turn of one radian counts as this much way, where views are compared
USUAL_DEPTH_M = 2.0  # until something is known
WAIT_FACTOR = 4  # a frame whose camera is gone waits until this many times ``delay_frames`` frames wait

BASELINES = (0.06, 0.10, 0.15, 0.22)  # wanted ways aside of the frames that one is matched with, in depths
LEAST_BASELINE, MOST_BASELINE = 0.02, 0.5  # beyond these a frame tells nothing of depth, or looks too different
LEAST_OVERLAP = 0.4  # fraction of the reference that a source must see
OVERLAP_COST = 1.5  # of no overlap at all, against a baseline that is off by a factor of e
SAME_SIDE_COST = 0.25  # of a source on the same side as all that are chosen
GRID = 6  # points a side that stand for the reference


@dataclass(slots=True)
class _CameraViews:
    views: list[PreparedView] = field(default_factory=list[PreparedView])
    usual_m: float = USUAL_DEPTH_M  # of the last depth that was found


@dataclass(slots=True)
class _Waiting:
    frame: PosedFrame
    view: PreparedView | None  # None: has depth from a sensor
    hint: Hint | None
    later: int = 0  # frames of its camera that came after it


class DepthFromMotion:
    """Computes the depth of frames that have none, from the frames of the same camera before and after them.

    Memory is bounded: a fixed number of small views of each camera, and ``delay_frames`` whole frames.
    """

    def __init__(self, config: DepthFromMotionConfig) -> None:
        self._config = config
        self._cameras: OrderedDict[str, _CameraViews] = OrderedDict()
        self._waiting: deque[_Waiting] = deque()

    def push(self, frame: PosedFrame, hint: Hint | None = None) -> list[PosedFrame]:
        """Take a frame; returns the frames that are ready, oldest first, so that none is lost or overtaken.

        Each has ``depth_m`` and ``depth_sigma_m`` of its full size, all 0 where the camera has not moved enough. A
        frame with depth from a sensor passes through unchanged. ``hint`` gives the depth of a frame as a map has it,
        at the size of the intrinsics that it is called with; called when the frame's depth is computed.
        """
        view = None if frame.depth_m is not None else prepare_view(frame, self._config.width)
        for other in self._waiting:
            other.later += view is not None and other.frame.camera_id == frame.camera_id
        self._waiting.append(_Waiting(frame, view, hint))
        if view is not None:
            self._remember(frame.camera_id, view)
        delay, ready = self._config.delay_frames, list[PosedFrame]()
        while self._waiting:
            first = self._waiting[0]
            if first.view is not None and first.later < delay and len(self._waiting) <= WAIT_FACTOR * delay:
                break
            ready.append(self._complete(self._waiting.popleft()))
        return ready

    def correct_poses(self, poses: Mapping[tuple[str, int], Float64]) -> None:
        """Move earlier frames, by camera and stamp, to better poses T_world_camera (4, 4); unknown ones are left out.

        Depth is computed from them there from now on, and frames that wait come out there.
        """
        for camera_id, camera in self._cameras.items():
            for k, view in enumerate(camera.views):
                if (better := poses.get((camera_id, view.stamp_ns))) is not None:
                    camera.views[k] = replace(view, T_world_camera=better)
                    for waiting in self._waiting:
                        if waiting.view is view:
                            waiting.view = camera.views[k]

    def finish(self) -> list[PosedFrame]:
        """The frames that still wait, oldest first."""
        done = [self._complete(waiting) for waiting in self._waiting]
        self._waiting.clear()
        return done

    def _complete(self, waiting: _Waiting) -> PosedFrame:
        frame, view = waiting.frame, waiting.view
        if view is None:
            return frame
        frame = replace(frame, T_world_camera=view.T_world_camera)
        hint = waiting.hint(frame, view.intrinsics) if waiting.hint is not None else None
        camera = self._cameras.get(frame.camera_id, _CameraViews())
        others = [v for v in camera.views if v is not view]
        sources = choose_sources(view, others, None if hint is None else hint.depth_m, camera.usual_m)
        if not sources:  # the camera has not moved enough
            nothing = np.zeros(frame.rgb.shape[:2], np.float32)
            return replace(frame, depth_m=nothing, depth_sigma_m=nothing.copy())
        known = [other for other in others if other.estimate is not None]
        nearest = [known[k] for k in np.argsort(_distances(view, known), kind="stable")[:NEIGHBOURS]]
        estimate = estimate_depth(view, sources, self._config, hint, nearest)
        camera.usual_m = float(np.median(estimate.depth_m))
        camera.views[:] = [replace(view, estimate=estimate) if other is view else other for other in camera.views]
        full = enlarge_estimate(estimate, view.rgb, frame.rgb)
        return replace(frame, depth_m=full.depth_m, depth_sigma_m=full.sigma_m)

    def _remember(self, camera_id: str, view: PreparedView) -> None:
        camera = self._cameras.setdefault(camera_id, _CameraViews())
        self._cameras.move_to_end(camera_id)
        camera.views.append(view)
        if len(camera.views) > MAX_VIEWS + self._config.delay_frames:
            # Of all but the most recent views, the one that is nearest to its successor.
            old = camera.views[: 1 - RECENT_VIEWS - self._config.delay_frames]
            del camera.views[int(np.argmin([_distances(a, [b])[0] for a, b in itertools.pairwise(old)]))]
        if len(self._cameras) > MAX_CAMERAS:
            forgotten, _ = self._cameras.popitem(last=False)
            _log.warning("camera_forgotten", camera=forgotten, reason=f"depth is computed for {MAX_CAMERAS} cameras")


def _distances(view: PreparedView, others: list[PreparedView]) -> Float64:
    """Way from one view to others, turns counted as way."""
    inverse = invert_pose(view.T_world_camera)
    ways = [inverse @ other.T_world_camera for other in others]
    return np.array(
        [float(np.linalg.norm(T[:3, 3]) + TURN_WEIGHT_M * np.linalg.norm(rotation_vector(T))) for T in ways]
    )


def choose_sources(
    reference: PreparedView, candidates: Sequence[PreparedView], depth_m: Float32 | None, usual_m: float
) -> list[PreparedView]:
    """Candidates to match with, at most one for each baseline; none where the camera only turned or stood still.

    Candidates are other frames of the same camera; ``depth_m`` (h, w) is what is known of the reference's depth, 0 =
    none, and ``usual_m`` the depth where nothing is known.
    """
    if not candidates:
        return []
    points = _grid_points(reference, depth_m, usual_m)
    relations = [_relation(reference, candidate, points) for candidate in candidates]
    baseline, overlap, side = (np.array(part) for part in zip(*relations, strict=True))
    usable = (baseline >= LEAST_BASELINE) & (baseline <= MOST_BASELINE) & (overlap >= LEAST_OVERLAP)
    chosen: list[int] = []
    for wanted in BASELINES:
        free = [k for k in np.flatnonzero(usable) if k not in chosen]
        if not free:
            break
        cost = [
            abs(np.log(baseline[k] / wanted))
            + OVERLAP_COST * (1 - overlap[k])
            + (SAME_SIDE_COST * float(np.mean([side[k] @ side[c] for c in chosen])) if chosen else 0.0)
            for k in free
        ]
        chosen.append(int(free[int(np.argmin(cost))]))
    return [candidates[k] for k in chosen]


def _grid_points(reference: PreparedView, depth_m: Float32 | None, usual_m: float) -> Float64:
    """Points (N, 3) of the reference's frame, at depths that are known or usual."""
    k = reference.intrinsics
    v, u = np.meshgrid(
        np.linspace(0, k.height - 1, GRID + 2)[1:-1].round().astype(int),
        np.linspace(0, k.width - 1, GRID + 2)[1:-1].round().astype(int),
        indexing="ij",
    )
    z = np.full(u.shape, usual_m)
    if depth_m is not None and (depth_m > 0).any():
        here = depth_m[v, u]
        z = np.where(here > 0, here, np.median(depth_m[depth_m > 0]))
    return np.stack(((u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z), -1).reshape(-1, 3)


def _relation(reference: PreparedView, other: PreparedView, points: Float64) -> tuple[float, float, Float64]:
    """Baseline in depths, as parallax shows it (motion along the view counts little); overlap; direction aside."""
    T_other_reference = invert_pose(other.T_world_camera) @ reference.T_world_camera
    p = transform(T_other_reference, points)
    ahead = p[:, 2] > 0.05 * points[:, 2]
    k = other.intrinsics
    side = T_other_reference[:3, :3].T @ -T_other_reference[:3, 3]  # where the other is, seen from the reference
    length = float(np.linalg.norm(side))
    direction = side / length if length > 0 else side
    if not ahead.any():
        return 0.0, 0.0, direction
    uv = project(p[ahead], k)
    inside = (uv >= 0).all(1) & (uv[:, 0] <= k.width - 1) & (uv[:, 1] <= k.height - 1)
    turned = p[ahead] - T_other_reference[:3, 3]
    shift = p[ahead, :2] / p[ahead, 2:] - turned[:, :2] / np.maximum(turned[:, 2:], 1e-6)
    baseline = float(np.median(np.linalg.norm(shift[inside], axis=1))) if inside.any() else 0.0
    return baseline, float(inside.sum() / len(points)), direction
