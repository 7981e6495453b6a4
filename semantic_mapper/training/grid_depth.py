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
from semantic_mapper.geometry import invert_pose, transform
from semantic_mapper.imaging import resize_depth
from semantic_mapper.training.frame_rays import FrameRays
from semantic_mapper.types import Bool, Float32, PosedFrame

TRUNCATION = 3.0  # voxels
BETA = 0.5  # voxels: spread of the Laplace distribution that turns distance into density
MARGIN = 0.02  # of the box that depth reaches, added on every side
OUTLIERS = 0.2  # per cent of the depth on either side that may lie outside of the box
EVERY = 7  # pixel, for the bounds of a box


def grid_of_depth(rays: FrameRays, config: GridConfig) -> SceneGrid:
    """A grid whose density is that of the measured surface; colours are grey.

    Density is Laplace-CDF(-distance) / beta with beta = half a voxel. What was not observed is haze, for images to
    clear or fill: ``distance_to_surface`` says where that is.
    """
    distance, observed = distance_to_surface(rays, config)
    grid = SceneGrid(config)
    density = np.where(distance > 0, 0.5 * np.exp(-np.abs(distance) / BETA), 1 - 0.5 * np.exp(-np.abs(distance) / BETA))
    per_voxel = density / BETA
    raw = np.log(np.expm1(np.maximum(per_voxel, 1e-9))) - BIAS
    values = np.where(observed, np.maximum(raw, NOTHING), HAZE).astype(np.float32)
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


def depth_bounds(
    frames: Sequence[PosedFrame], far_m: float
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Corners of the box that the frames' depth reaches; without any depth, what they can see up to ``far_m``."""
    points = [p for f in frames if f.depth_m is not None for p in _measured(f)]
    if points:
        low, high = np.percentile(points, (OUTLIERS, 100 - OUTLIERS), axis=0)
    else:
        corners = np.concatenate([_frustum(f, far_m) for f in frames])
        low, high = corners.min(0), corners.max(0)
    margin = MARGIN * float((high - low).max())
    return tuple((low - margin).tolist()), tuple((high + margin).tolist())


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
