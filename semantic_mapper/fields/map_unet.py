"""The network of ``nesf``: a 3D U-Net over the occupied cells of a map, of four levels that all have residual blocks.

Against the paper's U-Net (``unet3d``) it is narrow at the finest level, where nearly all cells are, and one level
deeper: it sees 1.9 m far at half the cost. Each block normalises the features of a cell on their own, so that what
surrounds a tile does not matter.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Sequence
from itertools import pairwise

import torch
from torch import nn

from semantic_mapper.fields.sparse_conv import CellLevel, Down, SubmanifoldConv, Up

LEVELS = 4
WIDTHS = (1, 2, 4, 4)  # of the levels, times the width
BLOCKS = (1, 2, 2, 2)  # on the way down; one on the way up


class Block(nn.Module):
    """``x + linear(relu(conv(norm(x))))``; the linear layer starts at zero."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(channels)
        self.conv = SubmanifoldConv(channels, channels)
        self.linear = nn.Linear(channels, channels)
        nn.init.zeros_(self.linear.weight)
        nn.init.zeros_(self.linear.bias)

    def forward(self, x: torch.Tensor, level: CellLevel) -> torch.Tensor:
        """Features (N, C) of the level's cells -> (N, C)."""
        return x + self.linear(torch.relu(self.conv(self.norm(x), level)))


class MapUNet(nn.Module):
    """Features of cells in, features of cells out.

    Args:
        channels_in: C.
        channels_out: K, of a last linear layer, which starts at zero.
        width: Features at the finest level.
    """

    def __init__(self, channels_in: int, channels_out: int, width: int = 16) -> None:
        super().__init__()
        widths = [width * times for times in WIDTHS]
        pairs = list(pairwise(widths))
        self.stem = nn.Linear(channels_in, widths[0])
        self.encoder = nn.ModuleList(
            nn.ModuleList(Block(w) for _ in range(count)) for w, count in zip(widths, BLOCKS, strict=True)
        )
        self.down = nn.ModuleList(Down(fine, coarse) for fine, coarse in pairs)
        self.up = nn.ModuleList(Up(coarse, fine) for fine, coarse in pairs)
        self.decoder = nn.ModuleList(Block(fine) for fine, _ in pairs)
        self.norm = nn.LayerNorm(widths[0])
        self.head = nn.Linear(widths[0], channels_out)
        nn.init.zeros_(self.head.weight)
        nn.init.zeros_(self.head.bias)

    def forward(self, x: torch.Tensor, levels: Sequence[CellLevel]) -> torch.Tensor:
        """Features (N, C) of the cells of ``cell_levels(cells, LEVELS)`` -> (N, K)."""
        x = self.stem(x)
        kept: list[torch.Tensor] = []
        for n, blocks in enumerate(self.encoder):
            for block in blocks:  # pyright: ignore[reportGeneralTypeIssues]
                x = block(x, levels[n])
            if n + 1 < LEVELS:
                kept.append(x)
                x = self.down[n](x, levels[n])
        for n in reversed(range(LEVELS - 1)):
            x = self.decoder[n](self.up[n](x, levels[n]) + kept[n], levels[n])
        return self.head(torch.relu(self.norm(x)))
