"""What measured depth says of the surface at each pixel, seen from the ground: input of the image encoder.

The geocentric encoding of depth images by Gupta et al. ("Learning Rich Features from RGB-D Images", ECCV 2014): inverse
depth, height above the lowest point in view, and the angle of the surface to gravity. Gravity is found in each image by
itself, so neither the world's axes nor the mounting of the camera have to be known.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import math

import torch

SURFACE_CHANNELS = 5
REACH = 2  # pixels to either side between which a normal is taken, at 160 pixels of width
REFERENCE_WIDTH = 160
GRID = 40  # columns of the coarse grid that gravity and the lowest point are found on
LOWEST_SHARE = 0.02  # of the points lie below the one that counts as the lowest
NEAR_M = 0.2
STEPS_DEG = (45.0, 45.0, 45.0, 15.0, 15.0, 15.0, 15.0)  # how far from level or plumb a surface may be, step by step


def surface_maps(depth_m: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """Maps of the surface (m, 5, H, W) at each pixel; all 0 where depth is not measured.

    Channels: inverse depth (1 / m), 1 where depth is measured, height above the lowest point in view (m), cosine of
    the normal with up, cosine of the normal with the viewing axis (0 beside holes, where there is no normal).

    Args:
        depth_m: (m, H, W), 0 = none.
        K: (m, 3, 3) in pixels of (H, W).
    """
    # Not in bfloat16, whose mantissa of 8 bits would make steps of centimetres.
    with torch.no_grad(), torch.autocast(depth_m.device.type, enabled=False):
        if not bool((depth_m > 0).any()):  # also spares a field without depth the work
            return depth_m.new_zeros(len(depth_m), SURFACE_CHANNELS, *depth_m.shape[1:])
        measured = depth_m > 0
        points = _camera_points(depth_m, K)
        reach = max(1, round(REACH * depth_m.shape[-1] / REFERENCE_WIDTH))
        normal, known = surface_normals(points, measured, reach)
        stride = max(1, depth_m.shape[-1] // GRID)
        up = up_direction(normal[..., ::stride, ::stride], known[:, ::stride, ::stride])
        height = torch.einsum("mihw,mi->mhw", points, up)
        lowest = _lowest(height[:, ::stride, ::stride], measured[:, ::stride, ::stride])
        maps = (
            torch.where(measured, 1 / depth_m.clamp_min(NEAR_M), 0),
            measured.to(depth_m.dtype),
            torch.where(measured, height - lowest[:, None, None], 0),
            torch.einsum("mihw,mi->mhw", normal, up),
            normal[:, 2],
        )
        return torch.stack(maps, dim=1)


def surface_normals(points: torch.Tensor, measured: torch.Tensor, reach: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Normals from central differences, towards the camera: (m, 3, H, W), and where there is one (m, H, W).

    Args:
        points: (m, 3, H, W) camera coordinates, metres.
        measured: (m, H, W) bool.
        reach: Pixels between a pixel and the ones that its differences are taken from.
    """
    r = reach
    height, width = measured.shape[-2:]
    normal = torch.zeros_like(points)
    known = torch.zeros_like(measured)
    if min(height, width) <= 2 * r:
        return normal, known
    middle = (..., slice(r, -r), slice(r, -r))
    du = points[..., r:-r, 2 * r :] - points[..., r:-r, : -2 * r]
    dv = points[..., 2 * r :, r:-r] - points[..., : -2 * r, r:-r]
    # Written out, because torch's cross product and norm are slow along any but the last axis.
    (ax, ay, az), (bx, by, bz) = dv.unbind(1), du.unbind(1)
    x, y, z = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    length = torch.sqrt(x * x + y * y + z * z).clamp_min(1e-9)
    known[middle] = (
        measured[..., r:-r, r:-r]
        & measured[..., r:-r, 2 * r :]
        & measured[..., r:-r, : -2 * r]
        & measured[..., 2 * r :, r:-r]
        & measured[..., : -2 * r, r:-r]
    )
    normal[middle] = torch.stack((x / length, y / length, z / length), dim=1)
    return normal * known[:, None], known


def up_direction(normal: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """Up (m, 3) in camera axes: what most surfaces are level or plumb to.

    Gupta et al., "Perceptual Organization and Recognition of Indoor Scenes" (CVPR 2013), section 3: starting from the
    camera's own up, take the normals near to and near to square with it, and turn up to fit them; then the same with
    closer bounds. The camera may be inclined by up to 45 degrees.

    Args:
        normal: (m, 3, h, w) unit normals in camera axes (y down).
        known: (m, h, w) bool.
    """
    n = normal.flatten(2)  # (m, 3, P)
    weight = known.flatten(1).to(n.dtype)
    up = n.new_tensor((0.0, -1.0, 0.0)).expand(len(n), 3)
    identity = torch.eye(3, dtype=n.dtype, device=n.device)
    # Keeps up where it is in every direction that no surface speaks of.
    hold = 1e-3 * weight.sum(1).clamp_min(1)[:, None, None]
    for bound_deg in STEPS_DEG:
        cosine = torch.einsum("mip,mi->mp", n, up).abs()
        level = cosine > math.cos(math.radians(bound_deg))
        plumb = cosine < math.sin(math.radians(bound_deg))
        vote = weight * (plumb.to(n.dtype) - level.to(n.dtype))
        spread = (n * vote[:, None]) @ n.transpose(1, 2) + hold * (identity - up[:, :, None] * up[:, None, :])
        axis = torch.linalg.eigh(spread.double())[1][:, :, 0].to(n.dtype)
        up = torch.where((axis * up).sum(1, keepdim=True) < 0, -axis, axis)
    return up


def _camera_points(depth_m: torch.Tensor, K: torch.Tensor) -> torch.Tensor:
    """(m, 3, H, W) camera coordinates of the pixels; 0 where depth is not measured."""
    height, width = depth_m.shape[-2:]
    u = torch.arange(width, dtype=depth_m.dtype, device=depth_m.device)
    v = torch.arange(height, dtype=depth_m.dtype, device=depth_m.device)
    x = (u[None, None, :] - K[:, 0, 2, None, None]) / K[:, 0, 0, None, None]
    y = (v[None, :, None] - K[:, 1, 2, None, None]) / K[:, 1, 1, None, None]
    return torch.stack((x * depth_m, y * depth_m, depth_m), dim=1)


def _lowest(height: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
    """(m,) height that only ``LOWEST_SHARE`` of the measured points lie below; 0 where nothing is measured."""
    flat = torch.where(measured, height, torch.inf).flatten(1).sort(dim=1).values
    count = measured.flatten(1).sum(1)
    found = flat.gather(1, (count * LOWEST_SHARE).long()[:, None])[:, 0]
    return torch.where(count > 0, found, 0)
