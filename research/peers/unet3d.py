"""The 3D U-Net of NeSF (Vora et al. 2022) over occupied cells, and its twin over a full grid.

Three levels of two 3^3 convolutions with ReLU, no normalization; strided 2^3 convolutions down, transposed ones up. The
paper concatenates skip connections; here they are summed, which halves the cost of the finest level.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import nn

from semantic_mapper.fields.nesf import CellLevel, Down, SubmanifoldConv, Up

LEVELS = 3


class UNet3d(nn.Module):
    """Features of cells in, features of cells out; the dense reference has the same parameters.

    Args:
        channels_in: C.
        channels_out: K, of a last linear layer.
        width: w; levels have (w, 2w), (2w, 4w) and (4w, 8w) features.
    """

    def __init__(self, channels_in: int, channels_out: int, width: int = 16) -> None:
        super().__init__()
        widths = [(width << n, width << (n + 1)) for n in range(LEVELS)]
        before = [channels_in, *(w for w, _ in widths[1:])]
        self.first = nn.ModuleList(SubmanifoldConv(b, a) for b, (a, _) in zip(before, widths, strict=True))
        self.second = nn.ModuleList(SubmanifoldConv(a, b) for a, b in widths)
        self.down = nn.ModuleList(Down(b, b) for _, b in widths[:-1])
        self.up = nn.ModuleList(Up(widths[n + 1][1], widths[n][1]) for n in range(LEVELS - 1))
        self.merge = nn.ModuleList(SubmanifoldConv(b, b) for _, b in widths[:-1])
        self.head = nn.Linear(widths[0][1], channels_out)

    def forward(self, x: torch.Tensor, levels: Sequence[CellLevel]) -> torch.Tensor:
        """Features (N, C) of the cells of ``cell_levels(cells, LEVELS)`` -> (N, K)."""
        kept: list[torch.Tensor] = []
        for n, level in enumerate(levels):
            x = torch.relu(self.second[n](torch.relu(self.first[n](x, level)), level))
            if n + 1 < LEVELS:
                kept.append(x)
                x = torch.relu(self.down[n](x, level))
        for n in reversed(range(LEVELS - 1)):
            x = torch.relu(self.up[n](x, levels[n]) + kept[n])
            x = torch.relu(self.merge[n](x, levels[n]))
        return self.head(x)

    def dense(self, x: torch.Tensor) -> torch.Tensor:
        """The reference for tests: features (1, C, X, Y, Z) of a full grid, sizes divisible by 4 -> (1, K, X, Y, Z)."""
        kept: list[torch.Tensor] = []
        for n in range(LEVELS):
            x = torch.relu(self.second[n].dense(torch.relu(self.first[n].dense(x))))  # pyright: ignore
            if n + 1 < LEVELS:
                kept.append(x)
                x = torch.relu(self.down[n].dense(x))  # pyright: ignore
        for n in reversed(range(LEVELS - 1)):
            x = torch.relu(self.up[n].dense(x) + kept[n])  # pyright: ignore
            x = torch.relu(self.merge[n].dense(x))  # pyright: ignore
        return self.head(x.movedim(1, -1)).movedim(-1, 1)
