"""Reproject the samples of whole query rays into every source view and gather what lies there (S-Ray Eq. 4 and 5)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch.nn import functional

from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.types import RayBatch

MIN_DEPTH_M = 0.05  # points nearer to a source camera than this count as behind it


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """R rays of N samples seen from m source views.

    Args:
        uv: (m, R, N, 2) pixels of the feature maps.
        z: (m, R, N) depth in each source camera, metres.
        valid: (m, R, N) bool: in front of the camera and inside its image.
        view_cosine: (m, R, N) cosine between query ray and source view ray.
    """

    uv: torch.Tensor
    z: torch.Tensor
    valid: torch.Tensor
    view_cosine: torch.Tensor


@dataclass(frozen=True, slots=True, eq=False)
class Gathered:
    """What the source views hold at the reprojected samples: the contextual space M of Eq. 5 and its companions.

    Args:
        feature: (m, R, N, C).
        rgb: (m, R, N, 3).
        geometry: (m, R, N, G).
        channel: (m, R, N) int64 known label at the sample, -1 = none.
    """

    feature: torch.Tensor
    rgb: torch.Tensor
    geometry: torch.Tensor
    channel: torch.Tensor


def reproject(rays: RayBatch, z: torch.Tensor, sources: EncodedViews) -> Reprojection:
    """Eq. 4 for every sample z (R, N) of every ray and every source view."""
    points = rays.origin[:, None, :] + z[..., None] * rays.direction[:, None, :]  # (R, N, 3) world
    R_camera_world, t_camera_world = sources.T_camera_world[:, :3, :3], sources.T_camera_world[:, :3, 3]
    p_camera = torch.einsum("mij,rnj->mrni", R_camera_world, points) + t_camera_world[:, None, None, :]
    depth = p_camera[..., 2]
    safe = depth.clamp_min(MIN_DEPTH_M)
    fx, fy = sources.K[:, 0, 0, None, None], sources.K[:, 1, 1, None, None]
    cx, cy = sources.K[:, 0, 2, None, None], sources.K[:, 1, 2, None, None]
    u = fx * p_camera[..., 0] / safe + cx
    v = fy * p_camera[..., 1] / safe + cy
    height, width = sources.feature.shape[-2:]
    valid = (depth > MIN_DEPTH_M) & (u > -0.5) & (u < width - 0.5) & (v > -0.5) & (v < height - 0.5)
    d_camera = torch.einsum("mij,rj->mri", R_camera_world, rays.direction)
    cosine = functional.cosine_similarity(p_camera, d_camera[:, :, None, :].expand_as(p_camera), dim=-1)
    return Reprojection(torch.stack((u, v), dim=-1), depth, valid, cosine)


def gather(sources: EncodedViews, where: Reprojection) -> Gathered:
    """Features and colours bilinearly; geometry and labels from the nearest pixel: neither mixes across edges."""
    views, rays, samples = where.z.shape
    height, width = sources.feature.shape[-2:]
    size = where.uv.new_tensor((width, height))
    grid = ((where.uv + 0.5) * (2 / size) - 1).clamp(-2, 2).view(views, rays, samples, 2)
    smooth = torch.cat((sources.feature, sources.rgb), dim=1)
    picked = functional.grid_sample(smooth, grid, padding_mode="border", align_corners=False)
    column = where.uv[..., 0].detach().round().clamp(0, width - 1).long()
    row = where.uv[..., 1].detach().round().clamp(0, height - 1).long()
    flat = sources.geometry.flatten(2)  # (m, G, h w)
    index = (row * width + column).view(views, 1, -1).expand(-1, flat.shape[1], -1)
    geometry = flat.gather(2, index).view(views, -1, rays, samples)
    channel = _nearest_channel(sources.channel, where.uv.detach(), height, width)
    channels = sources.feature.shape[1]
    picked = picked.permute(0, 2, 3, 1)  # (m, R, N, C + 3)
    return Gathered(picked[..., :channels], picked[..., channels:], geometry.permute(0, 2, 3, 1), channel)


def _nearest_channel(channel: torch.Tensor, uv: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Labels (m, H, W) at pixels uv (m, R, N, 2) of feature maps of (height, width): (m, R, N) int64."""
    rows, columns = channel.shape[1:]
    column = ((uv[..., 0] + 0.5) * (columns / width) - 0.5).round().clamp(0, columns - 1).long()
    row = ((uv[..., 1] + 0.5) * (rows / height) - 0.5).round().clamp(0, rows - 1).long()
    index = (row * columns + column).flatten(1)
    return channel.flatten(1).gather(1, index).view(uv.shape[:-1]).long()
