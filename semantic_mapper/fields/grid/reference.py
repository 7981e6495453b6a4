"""The compiled loops of the scene grid in plain torch: what tests compare them with, and the way on other devices."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from typing import TYPE_CHECKING

import torch
from torch.nn import functional

from semantic_mapper.fields.grid.kernels import STOP_BELOW

if TYPE_CHECKING:
    from semantic_mapper.fields.grid.march import GridRays

CELL = 4  # intervals a side of a cell that is occupied or not


def gather(values: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """``march.gather``: values (X, Y, Z, C) at points (..., 3) in voxels -> (..., C)."""
    size = points.new_tensor([n - 1 for n in values.shape[:3]])
    place = (points.reshape(1, -1, 1, 1, 3) / size * 2 - 1).flip(-1)  # grid_sample's x is the last axis
    volume = values.permute(3, 0, 1, 2)[None]
    read = functional.grid_sample(volume, place, mode="bilinear", padding_mode="border", align_corners=True)
    return read[0, :, :, 0, 0].T.reshape(*points.shape[:-1], values.shape[3])


def samples(
    values: torch.Tensor, occupied: torch.Tensor, rays: GridRays, step: float, bias: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """All samples: z (R, S), weight (R, S), and the light (R,) that gets through; without weight where none is."""
    z, valid = _lattice(values.shape, rays, step)
    top = z.new_tensor([n - 1 for n in values.shape[:3]])
    points = torch.minimum(rays.points(z).clamp(min=0), top)
    base = torch.minimum(points.long(), top.long() - 1)
    cell = base // CELL
    valid = valid & (occupied[cell[..., 0], cell[..., 1], cell[..., 2]] > 0)
    depth = step * functional.softplus(gather(values[..., :1], points)[..., 0] + bias) * valid
    before = torch.cumsum(depth, 1) - depth
    depth = depth * (torch.exp(-before) >= STOP_BELOW)
    before = torch.cumsum(depth, 1) - depth
    return z, torch.exp(-before) * -torch.expm1(-depth), torch.exp(-depth.sum(1))


def march(
    values: torch.Tensor, occupied: torch.Tensor, rays: GridRays, kept: int, step: float, bias: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """``march.march``: z and weight (R, kept), and light (R,)."""
    z, weight, light = samples(values, occupied, rays, step, bias)
    if z.shape[1] < kept:
        z, weight = (functional.pad(t, (0, kept - t.shape[1])) for t in (z, weight))
    order = weight.detach().topk(kept, dim=1).indices.sort(dim=1).values
    z, weight = z.gather(1, order), weight.gather(1, order)
    last = (z * (weight > 0)).amax(1, keepdim=True)
    order = (weight.detach() <= 0).to(torch.uint8).argsort(dim=1, stable=True)  # those without weight to the end
    return torch.where(weight > 0, z, last).gather(1, order), weight.gather(1, order), light


def _lattice(shape: torch.Size, rays: GridRays, step: float) -> tuple[torch.Tensor, torch.Tensor]:
    """z (R, S) of the samples of rays, and whether they are in the grid."""
    o, d = rays.origin, rays.direction
    top = o.new_tensor([n - 1 for n in shape[:3]])
    along = d.abs() < 1e-9
    safe = torch.where(along, torch.ones_like(d), d)
    a, b = -o / safe, (top - o) / safe
    inside = (~along | ((o >= 0) & (o <= top))).all(1)
    low = torch.where(along, -torch.inf, torch.minimum(a, b)).amax(1)
    high = torch.where(along, torch.inf, torch.maximum(a, b)).amin(1)
    start, end = torch.maximum(rays.near, low), torch.minimum(rays.far, high)
    interval = step / d.norm(dim=1)
    count = torch.ceil((end - start) / interval - rays.jitter) * (inside & (end > start))
    k = torch.arange(max(int(count.max()), 1), dtype=o.dtype, device=o.device)
    z = start[:, None] + (k + rays.jitter[:, None]) * interval[:, None]
    valid = k < count[:, None]
    return torch.where(valid, z, rays.near[:, None]), valid
