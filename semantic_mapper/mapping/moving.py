"""What moves is no surface: pixels where something is now that was free space a moment ago.

After Schmid et al., *Dynablox* (2023), but free space is what the camera itself saw within the last ``SETTLED_S``
seconds, kept as small depth images: where such a view looked past a point, something has come there. A thing that stays
becomes part of the map after this time.

A cell of ``CELLS`` across the image has the nearest depth of its pixels. It contradicts a view where all that the view
measured around the point lies behind it by more than ``MARGIN_M + MARGIN_PER_M * z``. A frame is first aligned with
views of these seconds; where that does not fit, or what it changes leaps from frame to frame, the poses are wrong and
nothing is found. Fewer than ``LEAST_CELLS`` such cells side by side are noise. What moves then grows along its own
surface into cells where no view of ``SURE_S`` ago or older saw a surface.

Not found: what moves away along the line of sight, what had moved before it was first seen, and what is slower than the
margin in ``SETTLED_S``. Such surface is cleared when frames see through it (``mapping/clearing.py``).

Alignment is Gauss-Newton from point to plane on small depth images, with a prior that the pose is right to within
``SIGMA_M`` and ``SIGMA_RAD``: a pose that drifts is corrected, one that jumps is not, and ``misfit`` says so. Wider
``CUTS`` correct more, and people who walk pull at the pose."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from semantic_mapper.config import MapperConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.geometry import invert_pose, transform
from semantic_mapper.imaging import FrameViews, is_measured
from semantic_mapper.labels import MOVING_NAMES, LabelSet
from semantic_mapper.types import Bool, Float32, Float64, Int64, PosedFrame, UInt8

CELLS = 80  # across the longer side of the image
EVERY_S, SETTLED_S = 0.2, 3.0  # between two views that are kept; how long they are
SURE_S = 0.8  # a surface that a view of so long ago saw at the same place does not move
MOST_VIEWS = 48  # of all cameras together
MARGIN_M, MARGIN_PER_M = 0.1, 0.03
LEAST_CELLS = 4
MOST_MISFIT = 0.4  # median distance from surfaces seen before, in margins; where it is more, the pose is wrong
LEAP_M, LEAP_RAD, LEAPS = 0.11, 0.035, 9  # change of what a pose is off by; where the median of so many is more, noise
FAR = 2.0  # ranges of the map: what is measured up to there shows free space; beyond, it may be no measurement
ALIGN_VIEWS, ALIGN_STRIDE = 4, 3  # views to align with; of cells that are used for it
GROWTH = 6  # cells
HOLES, LEAST_AROUND = 3, 5  # rounds in which cells are filled that have so many moving ones of the eight around
STEP_M, STEP_PER_M = 0.1, 0.02  # between neighbouring cells of one surface
KEPT_S = 1.0  # what moves is in the way of planners for so long after it was seen
STRIDE = 3  # pixels: 2 cm at 3 m, as voxels are
_FULL = 0.5  # fraction of the pixels of a cell that are measured, for it to say that space is free
_SECOND = 1_000_000_000
_EVERY_NS = round(EVERY_S * _SECOND)
CUTS = (1.0, 1.0, 0.5)  # margins within which residuals count, by iteration
SIGMA_M, SIGMA_RAD = 0.05, 0.026
_SIGMA_DEPTH_M, _INDEPENDENT = 0.03, 60.0  # of depth, and how many residuals are as good as independent
_EDGE = 0.1  # change of depth from cell to cell, as a fraction of it, from which on it is no surface
LEAST_POINTS, LEAST_FRACTION = 30, 0.2  # on surfaces that views saw: to judge at all; of those compared, to fit
_NEAREST_M = 0.1
EDGE_PX = 2  # around what moves, where depth may be between it and what is behind


class MovingSpace:
    """Where what is left out of the map was seen within the last ``KEPT_S`` seconds of frames; any thread may ask."""

    def __init__(self) -> None:
        self._parts: tuple[tuple[int, Float32], ...] = ()

    def add(self, frame: PosedFrame, moving: Bool) -> None:
        """Take over what moves in a frame with depth, (H, W), every ``STRIDE``-th pixel; forget what is older."""
        assert frame.depth_m is not None
        latest = max((stamp for stamp, _ in self._parts), default=frame.stamp_ns)
        latest = frame.stamp_ns if latest - frame.stamp_ns > KEPT_S * _SECOND else max(latest, frame.stamp_ns)
        parts = [(stamp, points) for stamp, points in self._parts if 0 <= latest - stamp <= KEPT_S * _SECOND]
        v, u = (STRIDE * i for i in np.nonzero(moving[::STRIDE, ::STRIDE]))
        if len(v):
            k, z = frame.intrinsics, frame.depth_m[v, u].astype(np.float64)
            points = z[:, None] * _rays(u, v, (k.fx, k.fy), (k.cx, k.cy))
            points = transform(frame.T_world_camera, points).astype(np.float32)
            parts.append((frame.stamp_ns, points[np.isfinite(points).all(axis=1) & (z > 0)]))
        self._parts = tuple(parts)

    def clear(self) -> None:
        """Forget all of it."""
        self._parts = ()

    @property
    def points(self) -> Float32:
        """(N, 3) in the world, metres."""
        return np.concatenate([np.empty((0, 3), np.float32), *(points for _, points in self._parts)])


class MovingFilter:
    """Finds what moves, for one map; ``pixels`` were left out so far, ``space`` is where that was within the last
    second. ``sees_moving``: a segmenter does. ``ConfigError``: ``moving.classes``, and none of the classes moves."""

    def __init__(self, config: MapperConfig, label_set: LabelSet, *, sees_moving: bool = False) -> None:
        self._config = config.moving
        self._motion = MotionDetector(config.voxel_map.depth_max_m)
        moving = [i for i, name in zip(label_set.ids, label_set.names, strict=True) if name in MOVING_NAMES]
        self._ids = moving if config.moving.classes else []
        self.uses_classes = config.moving.classes  # of the map, or of a segmenter
        if config.moving.classes and not self._ids and not sees_moving:
            raise ConfigError(
                f"moving.classes: none of the classes of '{label_set.name}' moves ({', '.join(sorted(MOVING_NAMES))} "
                "would); use weights that know one, a segmenter, or moving.motion"
            )
        self.pixels = 0
        self.space = MovingSpace()

    def find(self, frame: PosedFrame) -> Bool | None:
        """Pixels (H, W) of what moves by depth; None where nothing is looked for: a sensor has to have measured it."""
        if not ((self._config.motion or self._config.classes) and is_measured(frame)):
            return None
        return self._motion.find(frame) if self._config.motion else np.zeros(frame.rgb.shape[:2], np.bool_)

    def of_classes(self, label: UInt8) -> Bool:
        """Pixels (H, W) whose class moves by itself."""
        return np.isin(label, self._ids)

    def note(self, frame: PosedFrame, moving: Bool) -> None:
        """Count what was left out of a frame (its depth as it came), and keep for a second where that was."""
        self.pixels += int(moving.sum())
        self.space.add(frame, moving)

    def leave_out(self, views: FrameViews, moving: Bool) -> FrameViews:
        """The frame without depth where it shows what moves, and at its edges: neither surface nor seen through."""
        if not moving.any():
            return views
        depth_m = views.frame.depth_m
        assert depth_m is not None
        wider = cv2.dilate(moving.astype(np.uint8), np.ones((2 * EDGE_PX + 1,) * 2, np.uint8)) > 0
        return views.with_depth(np.where(wider, np.float32(0), depth_m))

    def clear(self) -> None:
        """Forget the last seconds: poses of frames to come are in another world."""
        self._motion.clear()
        self.space.clear()


class _Cells(NamedTuple):
    """Nearest depth of cells (h, w), metres, 0 = none, and whether most of it is measured."""

    near: Float32  # beyond the range of the map, too: what is before it is free
    inside: Float32  # the same within the range of the map
    full: Bool
    size: int  # pixels across


class SeenView(NamedTuple):
    """What one frame saw: where it was, and its cells (h, w), whose centres have whole numbers."""

    camera_id: str
    stamp_ns: int
    T_camera_world: Float64
    focal: tuple[float, float]  # in cells
    centre: tuple[float, float]
    near: Float32  # nearest depth of each cell
    around: Float32  # and of those around it; 0 where not all of it is measured
    slopes: Float32  # of ``depth_slopes``


class MotionDetector:
    """Finds what moves by depth alone. Deterministic; the only clock is the frames' stamps.

    ``poses_fit``: whether the pose of the last frame does, and those before it; else nothing is found."""

    def __init__(self, depth_max_m: float) -> None:
        self._depth_max_m = depth_max_m
        self._views: deque[SeenView] = deque(maxlen=MOST_VIEWS)
        self._corrections: dict[str, deque[Float64]] = {}  # of the poses of a camera, metres and radians
        self.poses_fit = True

    def clear(self) -> None:
        """Forget what was seen, where poses of frames to come are in another world."""
        self._views.clear()
        self._corrections.clear()

    def find(self, frame: PosedFrame) -> Bool:
        """Pixels (H, W) of what moves in a frame with measured depth; what it sees is remembered for later ones."""
        assert frame.depth_m is not None
        depth = frame.depth_m
        cells = _cells(depth, self._depth_max_m)
        latest = max((v.stamp_ns for v in self._views), default=frame.stamp_ns)
        if latest - frame.stamp_ns > SETTLED_S * _SECOND:
            self.clear()  # stamps have gone back
            latest = frame.stamp_ns
        latest = max(latest, frame.stamp_ns)
        kept = [v for v in self._views if latest - v.stamp_ns <= SETTLED_S * _SECOND]
        self._views = deque(kept, MOST_VIEWS)
        views = [v for v in kept if v.stamp_ns <= frame.stamp_ns]
        moving = np.zeros(cells.near.shape, np.bool_)
        aligned = _align(frame, cells, views)
        self.poses_fit = aligned is None or aligned.misfit <= MOST_MISFIT
        if not self.poses_fit:
            return np.zeros(depth.shape, np.bool_)
        if aligned is not None:
            frame = replace(frame, T_world_camera=aligned.T_world_camera)
            self.poses_fit = self._is_steady(frame.camera_id, aligned.moved)
        if self.poses_fit and views and (cells.inside > 0).any():
            free, seen = _seen_before(frame, cells, views)
            _, labels, stats, _ = cv2.connectedComponentsWithStats(free.astype(np.uint8), connectivity=8)
            large = np.asarray(stats)[:, cv2.CC_STAT_AREA] >= LEAST_CELLS
            large[0] = False  # what is not free
            grown = _grown(large[np.asarray(labels, np.int64)], cells.inside, ~(free | seen))
            moving = _filled(grown, cells.inside)
        last = max((v.stamp_ns for v in kept if v.camera_id == frame.camera_id), default=None)
        if last is None or frame.stamp_ns // _EVERY_NS > last // _EVERY_NS:  # whichever frame was the first one
            self._views.append(_view(frame, cells))
        return _pixels(moving, cells, depth)

    def _is_steady(self, camera_id: str, moved: Float64) -> bool:
        """Whether what poses of a camera are off by does not leap from frame to frame, as noise does."""
        last = self._corrections.setdefault(camera_id, deque(maxlen=LEAPS + 1))
        last.append(moved)
        leaps = np.abs(np.diff(np.array(last), axis=0))
        far = np.maximum(np.linalg.norm(leaps[:, :3], axis=1) / LEAP_M, np.linalg.norm(leaps[:, 3:], axis=1) / LEAP_RAD)
        return len(far) == 0 or float(np.median(far)) <= 1


def _align(frame: PosedFrame, cells: _Cells, views: list[SeenView]) -> Alignment | None:
    """Where the frame was by the views of its camera; None without such views."""
    views = [v for v in views if v.camera_id == frame.camera_id and v.near.shape == cells.near.shape]
    if not views:
        return None
    views = [views[i] for i in sorted({round(i) for i in np.linspace(0, len(views) - 1, ALIGN_VIEWS)})]
    v, u = (ALIGN_STRIDE * i for i in np.nonzero(cells.inside[::ALIGN_STRIDE, ::ALIGN_STRIDE]))
    return align_pose(_points(frame, cells, v, u).astype(np.float32), frame.T_world_camera, views)


def _points(frame: PosedFrame, cells: _Cells, v: Int64, u: Int64) -> Float64:
    """(N, 3) in the camera, of cells at rows ``v`` and columns ``u``."""
    return cells.inside[v, u][:, None] * _rays(u, v, *_intrinsics(frame, cells.size))


def _rays(u: Int64, v: Int64, focal: tuple[float, float], centre: tuple[float, float]) -> Float64:
    """(N, 3) directions with z = 1."""
    rays = np.stack(((u - centre[0]) / focal[0], (v - centre[1]) / focal[1], np.ones(len(u))), axis=1)
    return rays.astype(np.float64)


def _cells(depth: Float32, depth_max_m: float) -> _Cells:
    size = max(1, round(max(depth.shape) / CELLS))
    h, w = depth.shape[0] // size, depth.shape[1] // size
    known = (depth > 0) & (depth <= FAR * depth_max_m)  # not NaN
    values = np.where(known, depth, np.float32(np.inf))[: h * size, : w * size]
    near = values.reshape(h, size, w * size).min(axis=1).reshape(h, w, size).min(axis=2)
    count = known[: h * size, : w * size].reshape(h, size, w * size).sum(axis=1, dtype=np.uint16)
    full = count.reshape(h, w, size).sum(axis=2) >= _FULL * size * size
    near = np.where(np.isfinite(near), near, 0).astype(np.float32)
    return _Cells(near, np.where(near <= depth_max_m, near, np.float32(0)), full, size)


def _intrinsics(frame: PosedFrame, size: int) -> tuple[tuple[float, float], tuple[float, float]]:
    """Focal lengths and principal point in cells, whose centres have whole numbers."""
    k = frame.intrinsics
    return (k.fx / size, k.fy / size), ((k.cx + 0.5) / size - 0.5, (k.cy + 0.5) / size - 0.5)


def _view(frame: PosedFrame, cells: _Cells) -> SeenView:
    near = np.where(cells.full, cells.near, 0).astype(np.float32)
    around = cv2.erode(near, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0.0)
    lens, around = _intrinsics(frame, cells.size), np.asarray(around, np.float32)
    T_camera_world, slopes = invert_pose(frame.T_world_camera), depth_slopes(cells.inside)
    return SeenView(frame.camera_id, frame.stamp_ns, T_camera_world, *lens, cells.near, around, slopes)


def _seen_before(frame: PosedFrame, cells: _Cells, views: list[SeenView]) -> tuple[Bool, Bool]:
    """Cells (h, w) where a view saw free space, and where one of some time ago saw a surface."""
    v, u = np.nonzero(cells.inside)
    points = np.ascontiguousarray(transform(frame.T_world_camera, _points(frame, cells, v, u)).T, np.float32)
    free, seen = np.zeros(cells.near.shape, np.bool_), np.zeros(cells.near.shape, np.bool_)
    for view in views:
        T = view.T_camera_world.astype(np.float32)
        px, py, depth = T[:3, :3] @ points + T[:3, 3:]
        with np.errstate(divide="ignore", invalid="ignore"):
            x = np.rint(px / depth * view.focal[0] + view.centre[0])
            y = np.rint(py / depth * view.focal[1] + view.centre[1])
        h, w = view.near.shape
        at = np.flatnonzero((depth > 0) & (x >= 0) & (y >= 0) & (x < w) & (y < h))
        there, depth = (y[at].astype(np.int64), x[at].astype(np.int64)), depth[at]
        margin = MARGIN_M + MARGIN_PER_M * depth
        free[v[at], u[at]] |= view.around[there] > depth + margin
        if frame.stamp_ns - view.stamp_ns >= SURE_S * _SECOND:
            seen[v[at], u[at]] |= np.abs(view.near[there] - depth) <= margin
    return free, seen


def _grown(moving: Bool, depth: Float32, unknown: Bool) -> Bool:
    """What moves and cells along its surface that no view knows."""
    moving, unknown = moving.copy(), unknown & (depth > 0)
    step = STEP_M + STEP_PER_M * depth
    for _ in range(GROWTH):
        more = np.zeros_like(moving)
        for to, of in _NEIGHBOURS:
            more[to] |= moving[of] & (np.abs(depth[to] - depth[of]) < step[to])
        more &= unknown & ~moving
        if not more.any():
            break
        moving |= more
    return moving


def _filled(moving: Bool, depth: Float32) -> Bool:
    """Without holes: cells with what moves on most sides, and in one surface with it, move, too."""
    for _ in range(HOLES if moving.any() else 0):
        near = np.asarray(cv2.boxFilter(np.where(moving, depth, 0), -1, (3, 3), normalize=False))
        count = np.asarray(cv2.boxFilter(moving.astype(np.float32), -1, (3, 3), normalize=False))
        mean = near / np.maximum(count, 1)
        moving = moving | ((count >= LEAST_AROUND) & (np.abs(depth - mean) < STEP_M + STEP_PER_M * depth) & (depth > 0))
    return moving


_ALL, _LOW, _HIGH = slice(None), slice(None, -1), slice(1, None)
_DOWN, _RIGHT = ((_HIGH, _ALL), (_LOW, _ALL)), ((_ALL, _HIGH), (_ALL, _LOW))
_NEIGHBOURS = (_DOWN, _DOWN[::-1], _RIGHT, _RIGHT[::-1])


def _pixels(moving: Bool, cells: _Cells, depth: Float32) -> Bool:
    """Pixels (H, W) of moving cells and those next to them that are as near as what moves there."""
    if not moving.any():
        return np.zeros(depth.shape, np.bool_)
    farthest = np.where(moving, cells.inside * (1 + STEP_PER_M) + STEP_M, 0).astype(np.float32)
    farthest = np.asarray(cv2.dilate(farthest, np.ones((3, 3), np.uint8)))
    nearest = np.where(moving, cells.inside * (1 - STEP_PER_M) - STEP_M, np.float32(np.inf)).astype(np.float32)
    nearest = np.asarray(cv2.erode(nearest, np.ones((3, 3), np.uint8)))
    found = np.zeros(depth.shape, np.bool_)
    h, w = moving.shape[0] * cells.size, moving.shape[1] * cells.size
    tiles = depth[:h, :w].reshape(moving.shape[0], cells.size, moving.shape[1], cells.size)
    inside = (tiles < farthest[:, None, :, None]) & (tiles > nearest[:, None, :, None]) & (tiles > 0)
    found[:h, :w] = inside.reshape(h, w)
    return found


class Alignment(NamedTuple):
    """Where a pose is by what views saw."""

    T_world_camera: Float64  # (4, 4) corrected; as given where it does not fit or cannot be compared
    moved: Float64  # (6,) by how much: translation, metres, and rotation, radians, in the camera
    # median distance of points from the surface that views saw, in margins; points in front of it by more than a margin
    # do not count. inf where most is elsewhere, 0 where there is too little to compare with.
    misfit: float


def depth_slopes(depth_m: Float32) -> Float32:
    """(3, h, w) depth, metres, and its change from cell to cell along rows and columns; NaN at edges and holes."""
    z = np.where(depth_m > 0, depth_m, np.float32(np.nan))
    slopes = np.full((3, *z.shape), np.nan, np.float32)
    slopes[0, 1:-1, 1:-1] = z[1:-1, 1:-1]
    slopes[1, :, 1:-1] = (z[:, 2:] - z[:, :-2]) / 2
    slopes[2, 1:-1] = (z[2:] - z[:-2]) / 2
    slopes[0, ~(np.abs(slopes[1]) + np.abs(slopes[2]) < _EDGE * z)] = np.nan  # and where it is NaN
    return slopes


def align_pose(points: Float32, T_world_camera: Float64, views: Sequence[SeenView]) -> Alignment:
    """Correct a pose (4, 4) by what views of one size saw, by points (N, 3) that the frame measured, in its camera."""
    T, moved, misfit = T_world_camera, np.zeros(6), np.inf
    prior = np.repeat((SIGMA_M**-2, SIGMA_RAD**-2), 3)
    for cut in CUTS:
        jacobian, residual, weight, misfit = _residuals(points, T, views, cut)
        if not len(residual):
            return Alignment(T_world_camera, np.zeros(6), misfit)
        scale = _INDEPENDENT / (weight.sum() * _SIGMA_DEPTH_M**2)
        weighted = (scale * weight)[:, None] * jacobian
        change = np.linalg.solve(weighted.T @ jacobian + np.diag(prior), -weighted.T @ residual - prior * moved)
        moved += change
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = cv2.Rodrigues(change[3:])[0], change[:3]
        T = T @ step
    return Alignment(T, moved, misfit)


def _residuals(
    points: Float32, T_world_camera: Float64, views: Sequence[SeenView], cut: float
) -> tuple[Float64, Float64, Float64, float]:
    """Of points that count: d residual / d (translation, rotation) (M, 6) in the camera, residual (M,), weight (M,);
    and the misfit of all."""
    focal, centre = (np.array(values, np.float32) for values in zip(*((v.focal, v.centre) for v in views), strict=True))
    slopes = np.stack([v.slopes for v in views])
    T_view_camera = np.stack([v.T_camera_world for v in views]) @ T_world_camera
    R = T_view_camera[:, :3, :3].astype(np.float32)
    p = R @ points.T + T_view_camera[:, :3, 3:].astype(np.float32)  # V 3 N
    xy = p[:, :2] / np.maximum(p[:, 2:], _NEAREST_M) * focal[..., None] + centre[..., None]
    cell = np.rint(xy).astype(np.int32)
    h, w = slopes.shape[2:]
    x, y = cell[:, 0], cell[:, 1]
    view, number = np.nonzero((p[:, 2] > _NEAREST_M) & (x >= 0) & (y >= 0) & (x < w) & (y < h))
    depth, along_x, along_y = slopes.transpose(1, 0, 2, 3)[:, view, y[view, number], x[view, number]]
    off = xy[view, :, number] - cell[view, :, number]
    q = p[view, :, number]  # M 3
    residual = depth + along_x * off[:, 0] + along_y * off[:, 1] - q[:, 2]  # NaN at edges
    relative = residual / (MARGIN_M + MARGIN_PER_M * q[:, 2])
    fits, compared = int((np.abs(relative) < 1).sum()), int(np.isfinite(relative).sum())
    if fits < max(LEAST_POINTS, LEAST_FRACTION * compared):
        return np.empty((0, 6)), np.empty(0), np.empty(0), np.inf if compared >= LEAST_POINTS else 0.0
    misfit = float(np.median(np.abs(relative[relative < 1])))
    use = np.abs(relative) < cut
    q, view, number, residual = q[use], view[use], number[use], residual[use]
    slope = np.stack((along_x[use], along_y[use]), axis=1) * focal[view] / q[:, 2:]
    normal = np.concatenate((slope, -1 - (slope * q[:, :2]).sum(axis=1, keepdims=True) / q[:, 2:]), axis=1)
    # A slanted surface, and a distant one, is less sure; what nears the cut counts less.
    weight = (1 - (relative[use] / cut) ** 2) ** 2 / ((normal**2).sum(axis=1) * q[:, 2] ** 2)
    normal = np.einsum("mi,mij->mj", normal, R[view])  # in the camera of the frame
    jacobian = np.concatenate((normal, np.cross(points[number], normal)), axis=1)
    return jacobian.astype(np.float64), residual.astype(np.float64), weight.astype(np.float64), misfit
