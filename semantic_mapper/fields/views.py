"""Source views in torch: what fields encode, and what they hold where rays' samples are reprojected into them.

Source views come checked and at the size of feature maps (S-Ray Eq. 3 to 5).
"""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch.nn import functional

from semantic_mapper.errors import ShapeError
from semantic_mapper.fields.base import MAX_SOURCE_VIEWS, EncodedSize
from semantic_mapper.fields.numbers import GEOMETRY_CHANNELS, MIN_DEPTH_M, UNSURE_SPREAD
from semantic_mapper.geometry import expect_shape
from semantic_mapper.rays import invert_pose_torch
from semantic_mapper.types import Float64, RayBatch, SourceViews

SAME_CAMERA = 1e-3  # metres between the centres plus the error of a unit depth: float32 poses agree far better


@dataclass(frozen=True, slots=True, eq=False)
class EncodedViews:
    """Per-view maps of m source views, each independent of the others, so that a keyframe is encoded once."""

    feature: torch.Tensor  # (m, C, h, w) image features, the F_j of S-Ray Eq. 5.
    rgb: torch.Tensor  # (m, 3, h, w) in [0, 1], at feature resolution
    geometry: torch.Tensor  # (m, 5, h, w) mixture of logistics along each view ray; see ``sray``
    K: torch.Tensor  # (m, 3, 3) in pixels of (h, w)
    T_camera_world: torch.Tensor  # (m, 4, 4)
    channel: torch.Tensor  # (m, H, W) int16 known labels at the resolution of the images that were encoded, -1 = none

    def __len__(self) -> int:
        return int(self.feature.shape[0])

    @property
    def size(self) -> EncodedSize:
        """Of the feature and the label maps; views of one size can be rendered from together."""
        return tuple(self.feature.shape[1:]), tuple(self.channel.shape[1:])

    def at(self, T_world_camera: Float64) -> "EncodedViews":
        """One view with another pose (4, 4)."""
        like = self.T_camera_world
        pose = torch.tensor(T_world_camera, dtype=like.dtype, device=like.device)
        return replace(self, T_camera_world=invert_pose_torch(pose[None]))

    def select(self, index: torch.Tensor) -> "EncodedViews":
        """The views at ``index`` (k,) int64."""
        return EncodedViews(*(getattr(self, f.name)[index] for f in fields(self)))


def stack_views(views: Sequence[EncodedViews]) -> EncodedViews:
    """Join encoded views of equal resolution. Raises ShapeError: none or too many views, or different resolutions."""
    if not 1 <= sum(len(v) for v in views) <= MAX_SOURCE_VIEWS:
        raise ShapeError(f"a render takes 1 to {MAX_SOURCE_VIEWS} source views, got {sum(len(v) for v in views)}")
    sizes = {v.size for v in views}
    if len(sizes) != 1:
        raise ShapeError(f"source views must share one resolution, got {sorted(sizes)}")
    return EncodedViews(*(torch.cat([getattr(v, f.name) for v in views]) for f in fields(EncodedViews)))


def check_views(views: SourceViews) -> None:
    """Refuse source views whose tensors do not fit together.
    Raises ShapeError: naming the tensor, with expected and actual shape."""
    sizes = expect_shape(views.rgb, "M 3 H W", "source rgb")
    count, height, width = sizes["M"], sizes["H"], sizes["W"]
    expect_shape(views.K, f"{count} 3 3", "source K")
    expect_shape(views.T_world_camera, f"{count} 4 4", "source T_world_camera")
    for name in ("depth_m", "channel", "depth_sigma_m"):
        image = getattr(views, name)
        if image is not None:
            expect_shape(image, f"{count} {height} {width}", f"source {name}")


def sure_depth(views: SourceViews, *, computed: bool) -> SourceViews:
    """The views with the depth that a field can go by: what was computed and is not sure becomes a hole.
    ``computed``: whether the field has learned from computed depth; without, all of it becomes a hole."""
    if views.depth_sigma_m is None:
        return views
    sure = views.depth_sigma_m <= (UNSURE_SPREAD if computed else 0) * views.depth_m
    return replace(views, depth_m=views.depth_m * sure, depth_sigma_m=views.depth_sigma_m * sure)


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
    ``geometry``: (m, 5, h, w) mixture of logistics; None for fields that have none, which then hold zeros."""
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
    """R rays of N samples seen from m source views."""

    uv: torch.Tensor  # (m, R, N, 2) pixels of the feature maps
    z: torch.Tensor  # (m, R, N) depth in each source camera, metres
    valid: torch.Tensor  # (m, R, N) bool: in front of the camera and inside its image
    view_cosine: torch.Tensor  # (m, R, N) cosine between query ray and source view ray


@dataclass(frozen=True, slots=True, eq=False)
class Gathered:
    """What the source views hold at the reprojected samples: the contextual space M of Eq. 5 and its companions."""

    feature: torch.Tensor  # (m, R, N, C)
    rgb: torch.Tensor  # (m, R, N, 3)
    geometry: torch.Tensor  # (m, R, N, G)
    channel: torch.Tensor  # (m, R, N) int64 known label at the sample, -1 = none


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
    uv = where.uv.detach()
    flat = sources.geometry.flatten(2)  # (m, G, h w)
    index = _nearest(uv, height, width).view(views, 1, -1).expand(-1, flat.shape[1], -1)
    geometry = flat.gather(2, index).view(views, -1, rays, samples)
    rows, columns = sources.channel.shape[1:]
    at_label = (uv + 0.5) * uv.new_tensor((columns / width, rows / height)) - 0.5
    index = _nearest(at_label, rows, columns).flatten(1)
    channel = sources.channel.flatten(1).gather(1, index).view(where.z.shape).long()
    channels = sources.feature.shape[1]
    picked = picked.permute(0, 2, 3, 1)  # (m, R, N, C + 3)
    return Gathered(picked[..., :channels], picked[..., channels:], geometry.permute(0, 2, 3, 1), channel)


def _nearest(uv: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Row-major index (...) int64 of the pixels nearest to uv (..., 2)."""
    column, row = (uv[..., i].round().clamp(0, size - 1).long() for i, size in enumerate((width, height)))
    return row * width + column


def own_view(rays: RayBatch, sources: EncodedViews) -> tuple[torch.Tensor, torch.Tensor]:
    """The source view that each ray was taken from: index (R,) int64 of the best, and (R,) whether its camera is the
    ray's. A ray starts at the centre of its camera, and its direction has depth 1 there: no view turned on the spot."""
    R_camera_world, t_camera_world = sources.T_camera_world[:, :3, :3], sources.T_camera_world[:, :3, 3]
    start = torch.einsum("mij,rj->mri", R_camera_world, rays.origin) + t_camera_world[:, None]  # (m, R, 3)
    unit_depth = torch.einsum("mj,rj->mr", R_camera_world[:, 2], rays.direction)
    mismatch, index = (start.norm(dim=-1) + (unit_depth - 1).abs()).min(dim=0)
    return index, mismatch < SAME_CAMERA
