"""Labels of a few frames, carried by depth to the points of rays that see the same surface."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import torch
from torch import nn

TOLERANCE = 0.03  # relative difference of depth at which a vote counts 1 / e
MIN_DEPTH_M = 0.05


class CarriedLabels(nn.Module):
    """Votes of F labelled frames for the class of a point of the world, by how well their depth agrees.

    Args:
        frames: F.
        size: Height and width of the frames.
        classes: L.
    """

    depth_m: torch.Tensor
    channel: torch.Tensor
    K: torch.Tensor
    T_camera_world: torch.Tensor

    def __init__(self, frames: int, size: tuple[int, int], classes: int) -> None:
        super().__init__()
        self.classes = classes
        self.register_buffer("depth_m", torch.zeros(frames, *size))
        self.register_buffer("channel", torch.full((frames, *size), -1, dtype=torch.int16))
        self.register_buffer("K", torch.eye(3, dtype=torch.float64).repeat(frames, 1, 1))
        self.register_buffer("T_camera_world", torch.eye(4, dtype=torch.float64).repeat(frames, 1, 1))

    @property
    def channels(self) -> int:
        """Of what ``forward`` gives."""
        return self.classes + 1

    def forward(self, xyz: torch.Tensor, counted: torch.Tensor) -> torch.Tensor:
        """Votes (R, L + 1) for points (R, 3): fractions by class, and how many there are, as n / (1 + n).

        Args:
            counted: (R, F) or (F,) weight of each frame; 0 = its labels are not known.
        """
        T, K = self.T_camera_world.float(), self.K.float()
        p = torch.einsum("fij,rj->rfi", T[:, :3, :3], xyz) + T[:, :3, 3]
        z = p[..., 2]
        safe = z.clamp_min(MIN_DEPTH_M)
        height, width = self.depth_m.shape[1:]
        u = (K[:, 0, 0] * p[..., 0] / safe + K[:, 0, 2]).round().long()
        v = (K[:, 1, 1] * p[..., 1] / safe + K[:, 1, 2]).round().long()
        inside = (z > MIN_DEPTH_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        index = v.clamp(0, height - 1) * width + u.clamp(0, width - 1)
        frame = torch.arange(len(K), device=xyz.device) * (height * width) + index
        depth, channel = self.depth_m.flatten()[frame], self.channel.flatten()[frame].long()
        seen = inside & (depth > 0) & (channel >= 0)
        weight = torch.exp(-(((depth - z) / (TOLERANCE * safe)) ** 2)) * seen * counted
        votes = torch.zeros(len(xyz), self.classes, device=xyz.device)
        votes.scatter_add_(1, channel.clamp_min(0), weight)
        total = votes.sum(1, keepdim=True)
        return torch.cat((votes / total.clamp_min(1e-3), total / (1 + total)), 1)
