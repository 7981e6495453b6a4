"""Features on a grid of half the resolution, and the MLP that makes of them what colours and classes are read from."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.config import GridFieldConfig
from semantic_mapper.fields.grid.march import gather
from semantic_mapper.fields.nerf_math import encode_frequencies, encoded_size, relu_layers

POSITION_FREQUENCIES, DIRECTION_FREQUENCIES = 4, 2
COLOUR_WIDTH = 64
FEATURE_START = 0.1  # standard deviation


class Trunk(nn.Module):
    """[feature, gamma_4(x)] -> r, which no direction enters; [r, gamma_2(d)] -> colour.

    ``features`` (X/2, Y/2, Z/2, F) lie on every second vertex of the scene grid.
    """

    def __init__(self, config: GridFieldConfig) -> None:
        super().__init__()
        shape = [n // 2 + 1 for n in config.grid.shape]
        self.register_buffer("size", torch.tensor(config.grid.shape, dtype=torch.float32) - 1, persistent=False)
        self.features = nn.Parameter(FEATURE_START * torch.randn(*shape, config.features))
        self.body = relu_layers(config.features + encoded_size(3, POSITION_FREQUENCIES), config.trunk_width, 2)
        direction = encoded_size(3, DIRECTION_FREQUENCIES)
        self.head = nn.Sequential(
            relu_layers(config.trunk_width + direction, COLOUR_WIDTH, 1), nn.Linear(COLOUR_WIDTH, 3)
        )

    size: torch.Tensor

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """r (..., trunk_width) at voxel coordinates (..., 3) of the scene grid."""
        position = encode_frequencies((points / self.size * 2 - 1).clamp(-1, 1), POSITION_FREQUENCIES)
        return self.body(torch.cat((gather(self.features, points / 2), position), -1))

    def colour(self, r: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
        """Colours (R, K, 3) in [0, 1] of r (R, K, W), seen in directions (R, 3)."""
        towards = encode_frequencies(functional.normalize(direction, dim=-1), DIRECTION_FREQUENCIES)
        return torch.sigmoid(self.head(torch.cat((r, towards[:, None].expand(*r.shape[:2], -1)), -1)))
