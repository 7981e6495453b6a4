"""Source views as fields see them: checked, at the size of feature maps, and gathered where rays' samples reproject."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from dataclasses import dataclass, replace

import torch
from torch.nn import functional

from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.geometry import expect_shape
from semantic_mapper.rays import invert_pose_torch, pixel_grid
from semantic_mapper.types import RayBatch, SourceViews

UNSURE_SPREAD = 0.10  # spread of computed depth, as a fraction of it, from which on it counts as a hole
GEOMETRY_CHANNELS = 5  # of a mixture of two logistics: mu_1, s_1, mu_2, s_2 in metres, weight of component 1
MIN_DEPTH_M = 0.05  # points nearer to a source camera than this count as behind it
SAME_CAMERA = 1e-3  # metres between the centres plus the error of a unit depth: float32 poses agree far better


def check_views(views: SourceViews) -> None:
    """Refuse source views whose tensors do not fit together.

    Raises:
        ShapeError: naming the tensor, with expected and actual shape.
    """
    sizes = expect_shape(views.rgb, "M 3 H W", "source rgb")
    count, height, width = sizes["M"], sizes["H"], sizes["W"]
    expect_shape(views.depth_m, f"{count} {height} {width}", "source depth_m")
    expect_shape(views.K, f"{count} 3 3", "source K")
    expect_shape(views.T_world_camera, f"{count} 4 4", "source T_world_camera")
    if views.channel is not None:
        expect_shape(views.channel, f"{count} {height} {width}", "source channel")
    if views.depth_sigma_m is not None:
        expect_shape(views.depth_sigma_m, f"{count} {height} {width}", "source depth_sigma_m")


def sure_depth(views: SourceViews, *, computed: bool) -> SourceViews:
    """The views with the depth that a field can go by: what was computed and is not sure becomes a hole.

    Args:
        computed: Whether the field has learned from computed depth; without, all of it becomes a hole.
    """
    if views.depth_sigma_m is None:
        return views
    worst = UNSURE_SPREAD * views.depth_m if computed else torch.zeros_like(views.depth_m)
    sure = views.depth_sigma_m <= worst
    return replace(views, depth_m=views.depth_m * sure, depth_sigma_m=views.depth_sigma_m * sure)


def seen_bounds(views: SourceViews, far_m: float) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lower and upper corner (3,) in the world of what views of a scene can see, their cameras included.

    Args:
        far_m: How far pixels without measured depth may see.
    """
    corners: list[torch.Tensor] = []
    height, width = views.rgb.shape[-2:]
    pixels = pixel_grid(width, height, views.rgb.device)[:, :2].to(views.K.dtype)
    for K, T_world_camera, depth in zip(views.K, views.T_world_camera, views.depth_m.flatten(1), strict=True):
        ray = torch.stack(
            ((pixels[:, 0] - K[0, 2]) / K[0, 0], (pixels[:, 1] - K[1, 2]) / K[1, 1], torch.ones_like(pixels[:, 0])), -1
        )
        reach = torch.where(depth > 0, depth, far_m)
        points = (ray * reach[:, None]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        corners += [points.amin(0), points.amax(0), T_world_camera[:3, 3]]
    low, high = torch.stack(corners).amin(0), torch.stack(corners).amax(0)
    return tuple(float(x) for x in low), tuple(float(x) for x in high)


def scaled_camera(K: torch.Tensor, scale_x: float, scale_y: float) -> torch.Tensor:
    """Pinhole matrices (m, 3, 3) of images resized by these factors; pixel centres stay integers."""
    scale = K.new_tensor((scale_x, scale_y))
    scaled = K.clone()
    scaled[:, :2, :2] = K[:, :2, :2] * scale[None, :, None]
    scaled[:, :2, 2] = (K[:, :2, 2] + 0.5) * scale - 0.5
    return scaled


def depth_at(views: SourceViews, height: int, width: int) -> torch.Tensor:
    """Measured depth (m, height, width). Nearest, not averaged: a mean of depths across an edge lies on no surface."""
    return functional.interpolate(views.depth_m[:, None], size=(height, width), mode="nearest-exact")[:, 0]


def spread_at(views: SourceViews, height: int, width: int) -> torch.Tensor | None:
    """Spread (m, height, width) of ``depth_at`` as a fraction of it, 0 where it was measured; None where all was."""
    if views.depth_sigma_m is None:
        return None
    spread = views.depth_sigma_m / views.depth_m.clamp_min(1e-3)
    return functional.interpolate(spread[:, None], size=(height, width), mode="nearest-exact")[:, 0]


def encoded_views(views: SourceViews, feature: torch.Tensor, geometry: torch.Tensor | None = None) -> EncodedViews:
    """Features (m, C, h, w) with the colours and cameras that belong to them, and no known labels.

    Args:
        geometry: (m, 5, h, w) mixture of logistics; None for fields that have none, which then hold zeros.
    """
    height, width = feature.shape[-2:]
    if geometry is None:
        geometry = feature.new_zeros(len(feature), GEOMETRY_CHANNELS, height, width)
    return EncodedViews(
        feature=feature,
        rgb=functional.interpolate(views.rgb, size=(height, width), mode="area"),
        geometry=geometry,
        K=scaled_camera(views.K, width / views.rgb.shape[-1], height / views.rgb.shape[-2]),
        T_camera_world=invert_pose_torch(views.T_world_camera),
        channel=torch.full_like(views.depth_m, -1, dtype=torch.int16),
    )


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


def own_view(rays: RayBatch, sources: EncodedViews) -> tuple[torch.Tensor, torch.Tensor]:
    """The source view that each ray was taken from, if any.

    A ray starts at the centre of its camera, and its direction has depth 1 in its camera, so a view that turned on the
    spot is distinguished too.

    Returns:
        index (R,) int64 of the best view, same (R,) bool: whether that view's camera is the ray's.
    """
    R_camera_world, t_camera_world = sources.T_camera_world[:, :3, :3], sources.T_camera_world[:, :3, 3]
    start = torch.einsum("mij,rj->mri", R_camera_world, rays.origin) + t_camera_world[:, None]  # (m, R, 3)
    unit_depth = torch.einsum("mj,rj->mr", R_camera_world[:, 2], rays.direction)
    mismatch, index = (start.norm(dim=-1) + (unit_depth - 1).abs()).min(dim=0)
    return index, mismatch < SAME_CAMERA
