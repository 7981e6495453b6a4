"""The box of a scene grid: what the frames' depth reaches, or what their images show.

Without depth, points that several posed images show say how far they see: SIFT features, matched between images that
look at one place from two, and triangulated with the poses as they are.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from semantic_mapper.config import GridConfig
from semantic_mapper.errors import FrameError
from semantic_mapper.fields.scene.grid import grid_box
from semantic_mapper.geometry import camera_matrix, invert_pose, nearest_pixels, transform, unproject
from semantic_mapper.imaging import resize_depth, resize_rgb, working_intrinsics
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.config import GridFitConfig
from semantic_mapper.types import Float32, Float64, PosedFrame

LONG_SIDE = 96  # of scenes with depth
VOXELS = 2.5e6  # of a grid without depth: its box is flat, or has much air
MIN_PARALLAX = 1e-3  # distance of cameras as a fraction of the box, below which poses only turn
MARGIN = 0.02  # of the box that depth reaches, added on every side
OUTLIERS = 0.2  # per cent of the depth on either side that may lie outside of the box
EVERY = 7  # pixel, for the bounds of a box
TILES, LEAST_FEATURES = 4, 5  # of an image along each side, and how many features a tile has to have
CORNERS, MARGIN_OF_TILES = 1, 0.05  # per cent of their corners that may lie outside of the box; what is added to it
FRAMES, WIDTH, FEATURES = 60, 640, 1500
PARTNERS = (1, 2, 4, 8)  # of a frame: neighbours by distance, so that some are far enough away
RATIO = 0.8  # of the distances of the best and the second best match
LARGEST_ERROR_PX, LEAST_ANGLE_DEG = 1.5, 1.5

_log = get_logger(__name__)

Corners = tuple[tuple[float, float, float], tuple[float, float, float]]


def scene_box(frames: Sequence[PosedFrame], config: GridFitConfig) -> GridConfig:
    """The box that ``config`` asks for, or what the frames' depth reaches, or what their images show.
    Raises ConfigError: a box without a volume, or too large for ``voxel_m``."""
    if config.box_m is not None:
        low, high = config.box_m[:3], config.box_m[3:]
    elif any(f.depth_m is not None for f in frames):
        low, high = depth_bounds(frames)
    else:
        low, high = image_bounds(frames, config.far_m)
    sides = [b - a for a, b in zip(low, high, strict=True)]
    long_side = config.long_side or LONG_SIDE
    if config.long_side is None and config.box_m is None and all(f.depth_m is None for f in frames):
        long_side = max(LONG_SIDE, round(max(sides) * (VOXELS / math.prod(sides)) ** (1 / 3)))
    box = grid_box(low, high, long_side, config.voxel_m)
    wanted = max(sides) / (long_side - 1)
    if config.voxel_m is None and box.voxel_m > wanted * (1 + 1e-9):
        _log.warning(
            "voxels_grown", wanted_m=round(wanted, 4), voxel_m=round(box.voxel_m, 4), reason="16 M voxels at most"
        )
    return box


def check_parallax(frames: Sequence[PosedFrame], box: GridConfig) -> None:
    """Refuse cameras that stand in one place. Raises FrameError: they do."""
    position = np.array([f.T_world_camera[:3, 3] for f in frames])
    reach = float(np.linalg.norm(position - position.mean(0), axis=1).max())
    if reach < MIN_PARALLAX * box.voxel_m * max(box.shape):
        raise FrameError(
            f"all cameras stand within {reach:.3g} m: poses that only turn tell no depth. Move the camera; poses are "
            "T_world_camera, with translations in metres"
        )


def depth_bounds(frames: Sequence[PosedFrame]) -> Corners:
    """Corners of the box that the frames' depth reaches; one frame has some, at least."""
    points: list[Float32] = []
    for frame in frames:
        depth = resize_depth(frame, frame.intrinsics)
        measured = unproject(depth, frame.intrinsics)[depth > 0][::EVERY]
        points.append(transform(frame.T_world_camera, measured).astype(np.float32))
    low, high = np.percentile(np.concatenate(points), (OUTLIERS, 100 - OUTLIERS), axis=0)
    return _with_margin(low, high, MARGIN)


def image_bounds(frames: Sequence[PosedFrame], far_m: float) -> Corners:
    """Corners of the box that images without depth show: each of their tiles at the depth of its matched features.
    Where too few features match, what they see up to ``far_m``, with a warning."""
    points = sparse_points(frames)
    shown = [_tiles(f, points) for f in frames]
    if sum(len(s) > 0 for s in shown) < max(2, len(frames) / 2):
        _log.warning(
            "box_guessed",
            far_m=far_m,
            reason="no depth, and too few matching features to find out how far the images see; set grid.box_m",
        )
        every = np.concatenate([_frustum(f, far_m) for f in frames])
        return _with_margin(every.min(0), every.max(0), MARGIN)
    low, high = np.percentile(np.concatenate(shown), (CORNERS, 100 - CORNERS), axis=0)
    return _with_margin(low, high, MARGIN_OF_TILES)


def _with_margin(low: Float64, high: Float64, margin: float) -> Corners:
    metres = margin * float((high - low).max())
    return tuple((low - metres).tolist()), tuple((high + metres).tolist())


def _tiles(frame: PosedFrame, points: Float64) -> Float64:
    """Corners (N, 3) in the world of a frame's tiles, each at the median depth of the features in it."""
    k = frame.intrinsics
    in_camera = transform(invert_pose(frame.T_world_camera), points)
    seen, v, u = nearest_pixels(in_camera, k)
    z = in_camera[seen, 2]
    column, row = u[seen] * TILES // k.width, v[seen] * TILES // k.height
    found = [np.zeros((0, 3))]
    for i, j in np.ndindex(TILES, TILES):
        inside = z[(column == i) & (row == j)]
        if len(inside) >= LEAST_FEATURES:
            x = (np.array((i, i + 1, i, i + 1)) * k.width / TILES - k.cx) / k.fx
            y = (np.array((j, j, j + 1, j + 1)) * k.height / TILES - k.cy) / k.fy
            found.append(np.stack((x, y, np.ones(4)), axis=1) * np.median(inside))
    return transform(frame.T_world_camera, np.concatenate(found))


def _frustum(frame: PosedFrame, far_m: float) -> np.ndarray:
    """The camera and the corners of its image at ``far_m`` (5, 3) in the world."""
    k = frame.intrinsics
    u, v = np.array((0, k.width - 1) * 2), np.repeat((0, k.height - 1), 2)
    corners = np.stack(((u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(4)), axis=1) * far_m
    return transform(frame.T_world_camera, np.concatenate((np.zeros((1, 3)), corners)))


class _Features(NamedTuple):
    places: Float32  # (N, 2) pixels
    descriptors: Float32  # (N, D)
    P: Float64  # (3, 4) projection of points of the world
    centre: Float64  # (3,) of the camera


def sparse_points(frames: Sequence[PosedFrame]) -> Float64:
    """Points (N, 3) in the world that images show, triangulated; wrong poses leave few.
    ``frames``: with poses, of a scene that stands still; at most 60, evenly spread, are looked at."""
    step = max(1, -(-len(frames) // FRAMES))
    seen = [found for frame in frames[::step] if (found := _features(frame)) is not None]
    if len(seen) < 2:
        return np.zeros((0, 3))
    centres = np.array([f.centre for f in seen])
    pairs: set[tuple[int, int]] = set()
    for i, centre in enumerate(centres):
        order = np.argsort(np.linalg.norm(centres - centre, axis=1), kind="stable")
        pairs |= {(min(i, j), max(i, j)) for rank in PARTNERS if rank < len(order) and (j := int(order[rank])) != i}
    return np.concatenate([_triangulated(seen[i], seen[j]) for i, j in sorted(pairs)])


def _features(frame: PosedFrame) -> _Features | None:
    k = working_intrinsics(frame.intrinsics, min(WIDTH, frame.intrinsics.width))
    gray = cv2.cvtColor(resize_rgb(frame, k), cv2.COLOR_RGB2GRAY)
    points, descriptors = cv2.SIFT.create(FEATURES).detectAndCompute(gray, None)  # type: ignore[arg-type]
    if descriptors is None or len(points) < 2:
        return None
    places = np.array([point.pt for point in points], np.float32)
    pose = frame.T_world_camera
    return _Features(places, np.asarray(descriptors, np.float32), camera_matrix(k) @ invert_pose(pose)[:3], pose[:3, 3])


def _triangulated(a: _Features, b: _Features) -> Float64:
    """Points (N, 3) of features that match, lie on each other's epipolar lines, and before both cameras."""
    matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a.descriptors, b.descriptors, k=2)
    good = [m[0] for m in matches if len(m) == 2 and m[0].distance < RATIO * m[1].distance]
    if not good:
        return np.zeros((0, 3))
    at_a, at_b = a.places[[m.queryIdx for m in good]], b.places[[m.trainIdx for m in good]]
    homogeneous = cv2.triangulatePoints(a.P, b.P, at_a.T.astype(np.float64), at_b.T.astype(np.float64)).T
    w = homogeneous[:, 3:]
    xyz = homogeneous[:, :3] / np.where(np.abs(w) < 1e-12, 1e-12, w)
    to_a, to_b = a.centre - xyz, b.centre - xyz
    cosine = (to_a * to_b).sum(1) / np.maximum(np.linalg.norm(to_a, axis=1) * np.linalg.norm(to_b, axis=1), 1e-12)
    kept = cosine < np.cos(np.deg2rad(LEAST_ANGLE_DEG))
    for P, at in ((a.P, at_a), (b.P, at_b)):
        uvw = xyz @ P[:, :3].T + P[:, 3]
        error = np.linalg.norm(uvw[:, :2] / np.where(np.abs(uvw[:, 2:]) < 1e-12, 1e-12, uvw[:, 2:]) - at, axis=1)
        kept &= (uvw[:, 2] > 0) & (error < LARGEST_ERROR_PX)
    return xyz[kept]
