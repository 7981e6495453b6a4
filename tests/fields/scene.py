"""A textured wall at z = 2 m seen from cameras on a line: the smallest scene in which reprojection can go wrong."""

import numpy as np
import torch

from semantic_mapper.fields.base import Rays
from semantic_mapper.geometry import camera_matrix
from semantic_mapper.rays import pixel_grid, pixel_rays
from semantic_mapper.types import CameraIntrinsics, RayBatch, SourceViews

INTRINSICS = CameraIntrinsics(40.0, 40.0, 23.5, 15.5, 48, 32)
WALL_M = 2.0


def wall_colour(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    return torch.stack(
        (0.5 + 0.4 * torch.sin(3 * x), 0.5 + 0.4 * torch.sin(4 * y), 0.5 + 0.4 * torch.cos(2 * x + y)), -1
    )


def pose_at(x: float, yaw: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = [[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]]
    T[0, 3] = x
    return T


def wall_view(T_world_camera: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    pose = torch.from_numpy(T_world_camera).float()
    rays = pixel_rays(pixel_grid(48, 32), INTRINSICS, pose, near_m=0.1, far_m=10)
    z = (WALL_M - rays.origin[:, 2]) / rays.direction[:, 2]
    hit = rays.origin + z[:, None] * rays.direction
    return wall_colour(hit[:, 0], hit[:, 1]).T.reshape(3, 32, 48), z.reshape(32, 48)


def wall_sources(poses: list[np.ndarray], *, with_depth: bool = True) -> SourceViews:
    rgb, depth = zip(*(wall_view(T) for T in poses), strict=True)
    stacked = torch.stack(depth)
    return SourceViews(
        torch.stack(rgb),
        stacked if with_depth else torch.zeros_like(stacked),
        torch.from_numpy(camera_matrix(INTRINSICS)).float().expand(len(poses), 3, 3).clone(),
        torch.stack([torch.from_numpy(T).float() for T in poses]),
    )


def wall_rays(T_world_camera: np.ndarray, step: int = 1, prior: float = WALL_M) -> RayBatch:
    pixels = pixel_grid(48, 32)[::step]
    return pixel_rays(
        pixels,
        INTRINSICS,
        torch.from_numpy(T_world_camera).float(),
        near_m=0.3,
        far_m=8.0,
        prior_depth_m=torch.full((len(pixels),), prior),
    )


def streamed_rays(rays: RayBatch) -> Rays:
    """Rays of one range, as the compiled renderer takes them."""
    origin, direction, prior = (
        np.ascontiguousarray(t.numpy()) for t in (rays.origin, rays.direction, rays.prior_depth_m)
    )
    measured = prior > 0 if rays.measured is None else rays.measured.numpy()
    return Rays(origin, direction, float(rays.near_m[0]), float(rays.far_m[0]), prior, measured)
