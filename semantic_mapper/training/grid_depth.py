"""A scene grid from depth images alone: their averaged distance to the surface, as density."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Sequence

import numpy as np
import torch

from semantic_mapper.config import GridConfig
from semantic_mapper.fields.grid.kernels import fuse_grid_depth
from semantic_mapper.fields.grid.march import BIAS
from semantic_mapper.fields.grid.scene_grid import HAZE, NOTHING, SceneGrid
from semantic_mapper.geometry import invert_pose, nearest_pixels, transform
from semantic_mapper.imaging import resize_depth
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.frame_rays import FrameRays
from semantic_mapper.training.sparse_points import sparse_points
from semantic_mapper.types import Bool, Float32, Float64, PosedFrame

TRUNCATION = 3.0  # voxels
BETA = 0.5  # voxels: spread of the Laplace distribution that turns distance into density
MARGIN = 0.02  # of the box that depth reaches, added on every side
OUTLIERS = 0.2  # per cent of the depth on either side that may lie outside of the box
EVERY = 7  # pixel, for the bounds of a box
TILES, LEAST_FEATURES = 4, 5  # of an image along each side, and how many features a tile has to have
CORNERS, MARGIN_OF_TILES = 1, 0.05  # per cent of their corners that may lie outside of the box; what is added to it

_log = get_logger(__name__)


def grid_of_depth(rays: FrameRays, config: GridConfig, unseen: float = HAZE) -> SceneGrid:
    """A grid whose density is that of the measured surface; colours are grey.

    Density is Laplace-CDF(-distance) / beta with beta = half a voxel. What was not observed (``distance_to_surface``
    says where that is) has the raw density ``unseen``: haze, for images to clear or fill.
    """
    distance, observed = distance_to_surface(rays, config)
    grid = SceneGrid(config)
    density = np.where(distance > 0, 0.5 * np.exp(-np.abs(distance) / BETA), 1 - 0.5 * np.exp(-np.abs(distance) / BETA))
    per_voxel = density / BETA
    raw = np.log(np.expm1(np.maximum(per_voxel, 1e-9))) - BIAS
    values = np.where(observed, np.maximum(raw, NOTHING), unseen).astype(np.float32)
    with torch.no_grad():
        grid.values[..., 0] = torch.from_numpy(values)
    grid.update_occupied()
    return grid


def distance_to_surface(rays: FrameRays, config: GridConfig) -> tuple[Float32, Bool]:
    """Distance (X, Y, Z) in voxels, positive before the surface, at most ``TRUNCATION``; and where it was observed."""
    distance, weight = np.zeros(config.shape, np.float32), np.zeros(config.shape, np.float32)
    T_world_grid = np.diag((config.voxel_m, config.voxel_m, config.voxel_m, 1.0))
    T_world_grid[:3, 3] = config.origin_m
    for i, k in enumerate(rays.intrinsics):
        depth = rays.depth_m[rays.pixels_of(i)].reshape(rays.image_size(i))
        T_camera_grid = invert_pose(rays.T_world_camera[i].astype(np.float64)) @ T_world_grid
        pinhole = (k.fx, k.fy, k.cx, k.cy)
        arrays = (distance, weight, depth, np.ascontiguousarray(T_camera_grid[:3]))
        fuse_grid_depth(len(distance), *arrays, *pinhole, TRUNCATION * config.voxel_m)
    return distance * np.float32(TRUNCATION), weight > 0


Corners = tuple[tuple[float, float, float], tuple[float, float, float]]


def depth_bounds(frames: Sequence[PosedFrame]) -> Corners:
    """Corners of the box that the frames' depth reaches; one frame has some, at least."""
    points = np.concatenate([_measured(f) for f in frames if f.depth_m is not None])
    low, high = np.percentile(points, (OUTLIERS, 100 - OUTLIERS), axis=0)
    return _with_margin(low, high, MARGIN)


def image_bounds(frames: Sequence[PosedFrame], far_m: float) -> Corners:
    """Corners of the box that images without depth show: each of their tiles at the depth of its matched features.

    Where too few features match, what they see up to ``far_m``, with a warning.
    """
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


def _measured(frame: PosedFrame) -> Float32:
    """Some of the measured points (N, 3) in the world."""
    depth = resize_depth(frame, frame.intrinsics)
    v, u = np.nonzero(depth)
    v, u = v[::EVERY], u[::EVERY]
    z, k = depth[v, u].astype(np.float64), frame.intrinsics
    points = np.stack(((u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z), axis=1)
    return transform(frame.T_world_camera, points).astype(np.float32)


def _frustum(frame: PosedFrame, far_m: float) -> np.ndarray:
    """The camera and the corners of its image at ``far_m`` (5, 3) in the world."""
    k = frame.intrinsics
    u, v = np.array((0, k.width - 1) * 2), np.repeat((0, k.height - 1), 2)
    corners = np.stack(((u - k.cx) / k.fx, (v - k.cy) / k.fy, np.ones(4)), axis=1) * far_m
    return transform(frame.T_world_camera, np.concatenate((np.zeros((1, 3)), corners)))
