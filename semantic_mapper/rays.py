"""Rays through pixels, and poses, in torch: differentiable, on any device. Conventions as in ``geometry``."""

import torch

from semantic_mapper.geometry import expect_shape
from semantic_mapper.types import CameraIntrinsics, RayBatch


def pixel_rays(
    pixels: torch.Tensor,
    intrinsics: CameraIntrinsics,
    T_world_camera: torch.Tensor,
    *,
    near_m: float,
    far_m: float,
    prior_depth_m: torch.Tensor | None = None,
    measured: torch.Tensor | None = None,
    stamp_ns: int | None = None,
) -> RayBatch:
    """Rays through pixels, in world coordinates (S-Ray Eq. 3 with z as the parameter).

    ``pixels`` are (R, 2) float32 as (u, v), the pose is float32; the others are as in ``RayBatch``, (R,).
    """
    count = expect_shape(pixels, "R 2", "pixels")["R"]
    x = (pixels[:, 0] - intrinsics.cx) / intrinsics.fx
    y = (pixels[:, 1] - intrinsics.cy) / intrinsics.fy
    d_camera = torch.stack((x, y, torch.ones_like(x)), dim=-1)  # (R, 3), z = 1
    direction = d_camera @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3].expand(count, 3)
    if prior_depth_m is None:
        prior_depth_m = torch.zeros_like(x)
    return RayBatch(
        origin=origin,
        direction=direction,
        near_m=torch.full_like(x, near_m),
        far_m=torch.full_like(x, far_m),
        prior_depth_m=prior_depth_m,
        measured=measured,
        stamp_ns=stamp_ns,
    )


def pixel_grid(width: int, height: int, device: torch.device | str = "cpu") -> torch.Tensor:
    """All pixels of an image, row by row: (H * W, 2) float32 as (u, v)."""
    v, u = torch.meshgrid(
        torch.arange(height, dtype=torch.float32, device=device),
        torch.arange(width, dtype=torch.float32, device=device),
        indexing="ij",
    )
    return torch.stack((u, v), dim=-1).reshape(-1, 2)


def invert_pose_torch(T_a_b: torch.Tensor) -> torch.Tensor:
    """Return ``T_b_a`` of a rigid transform (..., 4, 4), differentiable."""
    R_b_a = T_a_b[..., :3, :3].transpose(-1, -2)
    t_b_a = -(R_b_a @ T_a_b[..., :3, 3:])
    return torch.cat((torch.cat((R_b_a, t_b_a), -1), T_a_b[..., 3:, :]), -2)
