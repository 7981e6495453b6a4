"""MVSNeRF's plane-swept cost volume over a reference view, and the 3D network that turns it into an encoding volume."""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from dataclasses import dataclass, replace

import torch
from torch import nn
from torch.nn import functional

from research.peers.rendering import weighted_moments
from semantic_mapper.fields.base import MIN_DEPTH_M, EncodedViews, gather, reproject, scaled_camera
from semantic_mapper.fields.volume import sample_inverse_depth
from semantic_mapper.rays import invert_pose_torch
from semantic_mapper.types import RayBatch

RADIAN_M = 0.7  # a turn of one radian makes a view as unlike another as this many metres (15 cm are 12 degrees)
COLOUR_CHANNELS = 4  # a view's colour at a voxel or sample, and whether the view sees it


@dataclass(frozen=True, slots=True)
class Sweep:
    """Planes of constant depth in the reference view, uniform in inverse depth between ``near_m`` and ``far_m``."""

    planes: int
    near_m: float
    far_m: float

    def place(self, z: torch.Tensor) -> torch.Tensor:
        """Depths in the reference view -> place between near (-1) and far (1), as ``grid_sample`` counts."""
        inverse = 1 / z.clamp_min(MIN_DEPTH_M)
        return 2 * (1 / self.near_m - inverse) / (1 / self.near_m - 1 / self.far_m) - 1


def query_camera(rays: RayBatch) -> tuple[torch.Tensor, torch.Tensor]:
    """Centre (3,) and optical axis (3,), unit length, of the camera that rays come from, in world coordinates.

    Every direction d of a camera with axis a has d . a = 1 (``RayBatch``), so any few rays of it give its axis by least
    squares, and a render in chunks knows one camera all the time. Rays of a single row or column leave one angle open:
    then it is the axis turned into their plane.
    """
    d = rays.direction.double()
    normal = d.T @ d / len(d)
    damping = 1e-9 * torch.eye(3, dtype=d.dtype, device=d.device) * normal.diagonal().sum()
    axis = torch.linalg.solve(normal + damping, d.mean(0))
    return rays.origin.mean(0), (axis / axis.norm()).to(rays.origin.dtype)


def nearest_views(rays: RayBatch, sources: EncodedViews, count: int) -> torch.Tensor:
    """Indices (min(count, m),) int64 of the source views nearest to the query camera, nearest first.

    The distance is that of the centres in metres plus ``RADIAN_M`` times the angle between the axes.
    """
    centre, axis = query_camera(rays)
    T_world_camera = invert_pose_torch(sources.T_camera_world)
    away = (T_world_camera[:, :3, 3] - centre).norm(dim=-1)
    angle = torch.acos((T_world_camera[:, :3, 2] @ axis).clamp(-1, 1))
    return torch.argsort(away + RADIAN_M * angle, stable=True)[:count]


def colours_and_masks(rgb: torch.Tensor, valid: torch.Tensor, slots: int) -> torch.Tensor:
    """Colours (m, R, N, 3) of the views and what they see (m, R, N), side by side: (R, N, 4 slots), m <= slots.

    Zeros where a view does not see the sample, and for views that there are fewer of than slots.
    """
    seen = valid[..., None].to(rgb.dtype)
    each = torch.cat((rgb * seen, seen), dim=-1).permute(1, 2, 0, 3).flatten(2)
    return functional.pad(each, (0, COLOUR_CHANNELS * slots - each.shape[-1]))


def cost_volume(used: EncodedViews, sweep: Sweep, slots: int) -> torch.Tensor:
    """Warp the views' features onto the planes of the first one; their variance, and the warped colours.

    Args:
        used: The views to use, the reference first.
        slots: Number of views that the network is made for, at least ``len(used)``.

    Returns:
        (1, C + 4 slots, planes, h, w), (h, w) half the size of the feature maps, rounded up. The variance at a voxel is
        that of the views that see it; the masks beside the colours tell how many those are.
    """
    coarse = _half_size(used)
    rays, height, width = _reference_rays(coarse)
    bounds = torch.ones(1, dtype=rays.origin.dtype, device=rays.origin.device)
    depth = sample_inverse_depth(sweep.near_m * bounds, sweep.far_m * bounds, sweep.planes)
    where = reproject(rays, depth.expand(len(rays.origin), -1), coarse)
    found = gather(coarse, where)
    seen = where.valid.to(found.feature.dtype)
    _, variance = weighted_moments(found.feature, seen / seen.sum(0).clamp_min(1))
    cost = torch.cat((variance, colours_and_masks(found.rgb, where.valid, slots)), dim=-1)  # (h w, planes, .)
    return cost.view(height, width, sweep.planes, -1).permute(3, 2, 0, 1)[None]


class EncodingVolumeNet(nn.Module):
    """3D U-Net of two levels: cost volume -> neural encoding volume, (1, c_in, D, h, w) -> (1, c_out, D, h, w)."""

    def __init__(self, c_in: int, c_out: int) -> None:
        super().__init__()
        self.first = _block(c_in, c_out, 1)
        self.down = nn.ModuleList((_block(c_out, 2 * c_out, 2), _block(2 * c_out, 4 * c_out, 2)))
        self.middle = nn.ModuleList((_block(2 * c_out, 2 * c_out, 1), _block(4 * c_out, 4 * c_out, 1)))
        self.up = nn.ModuleList((_block(4 * c_out, 2 * c_out, 1), _block(2 * c_out, c_out, 1)))

    def forward(self, cost: torch.Tensor) -> torch.Tensor:
        """See the class."""
        x = self.first(cost)
        skips: list[torch.Tensor] = []
        for down, middle in zip(self.down, self.middle, strict=True):
            skips.append(x)
            x = middle(down(x))
        for up in self.up:
            skip = skips.pop()
            # Convolve before the upsampling: the same receptive field at an eighth of the work.
            x = skip + functional.interpolate(up(x), size=skip.shape[-3:], mode="trilinear", align_corners=False)
        return x


def _block(c_in: int, c_out: int, stride: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv3d(c_in, c_out, 3, stride, 1, bias=False), nn.GroupNorm(max(1, c_out // 4), c_out), nn.ReLU()
    )


def _half_size(sources: EncodedViews) -> EncodedViews:
    height, width = sources.feature.shape[-2:]
    size = (-(-height // 2), -(-width // 2))
    return replace(
        sources,
        feature=functional.interpolate(sources.feature, size=size, mode="area"),
        rgb=functional.interpolate(sources.rgb, size=size, mode="area"),
        geometry=sources.geometry[:, :, : size[0], : size[1]],  # not used, but of the size of the features
        K=scaled_camera(sources.K, size[1] / width, size[0] / height),
    )


def _reference_rays(sources: EncodedViews) -> tuple[RayBatch, int, int]:
    """Rays through all pixels of the first view's feature map, row by row."""
    height, width = sources.feature.shape[-2:]
    K, like = sources.K[0], sources.K
    v, u = torch.meshgrid(
        torch.arange(height, dtype=like.dtype, device=like.device),
        torch.arange(width, dtype=like.dtype, device=like.device),
        indexing="ij",
    )
    x, y = (u.flatten() - K[0, 2]) / K[0, 0], (v.flatten() - K[1, 2]) / K[1, 1]
    T_world_camera = invert_pose_torch(sources.T_camera_world[0])
    direction = torch.stack((x, y, torch.ones_like(x)), dim=-1) @ T_world_camera[:3, :3].T
    none = torch.zeros_like(x)
    return RayBatch(T_world_camera[:3, 3].expand(len(x), 3), direction, none, none, none), height, width
