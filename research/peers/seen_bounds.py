"""What views of a scene can see."""

from __future__ import annotations

import torch

from semantic_mapper.rays import pixel_grid
from semantic_mapper.types import SourceViews


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
