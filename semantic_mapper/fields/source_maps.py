"""What every kind of field keeps of its source views besides features: colours and cameras at feature resolution."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch.nn import functional

from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.geometry_net import GEOMETRY_CHANNELS
from semantic_mapper.geometry import expect_shape
from semantic_mapper.rays import invert_pose_torch, pixel_grid
from semantic_mapper.types import SourceViews

UNSURE_SPREAD = 0.10  # spread of computed depth, as a fraction of it, from which on it counts as a hole


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
