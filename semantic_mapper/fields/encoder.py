"""The shared image encoder: a light residual U-Net that gives the F_j of S-Ray Eq. 5."""

from __future__ import annotations

import torch
from torch import nn
from torch.nn import functional

GROUPS = 8


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with group norm and a shortcut: (B, c_in, H, W) -> (B, c_out, H / stride, W / stride)."""

    def __init__(self, c_in: int, c_out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(c_in, c_out, 3, stride, 1, bias=False)
        self.norm1 = nn.GroupNorm(GROUPS, c_out)
        self.conv2 = nn.Conv2d(c_out, c_out, 3, 1, 1, bias=False)
        self.norm2 = nn.GroupNorm(GROUPS, c_out)
        self.stride = stride
        self.shortcut = nn.Identity() if stride == 1 and c_in == c_out else nn.Conv2d(c_in, c_out, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, c_in, H, W) -> (B, c_out, H / stride, W / stride)."""
        y = functional.relu(self.norm1(self.conv1(x)))
        # Not a strided 1x1 convolution: the backward pass of oneDNN's, channels-last on several threads, can write
        # past its buffers (torch 2.15, AVX-512, 3 images of 8 channels on 2 threads, for one).
        x = x[:, :, :: self.stride, :: self.stride]
        return functional.relu(self.norm2(self.conv2(y)) + self.shortcut(x))


class UpBlock(nn.Module):
    """Upsample, join the skip connection, one 3x3 convolution."""

    def __init__(self, c_in: int, c_skip: int, c_out: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(c_in + c_skip, c_out, 3, 1, 1, bias=False)
        self.norm = nn.GroupNorm(GROUPS, c_out)

    def forward(self, x: torch.Tensor, skip: torch.Tensor) -> torch.Tensor:
        """(B, c_in, h, w), (B, c_skip, H, W) -> (B, c_out, H, W)."""
        up = functional.interpolate(x, size=skip.shape[-2:], mode="bilinear", align_corners=False)
        return functional.relu(self.norm(self.conv(torch.cat((up, skip), dim=1))))


class ImageEncoder(nn.Module):
    """Residual U-Net, shared by all views.

    Args:
        width: Channels of the first stage; the stages hold width * (1, 2, 3, 4).
        blocks: Residual blocks a stage.
        feature_dim: C, channels of the output.
    """

    def __init__(self, width: int, blocks: tuple[int, ...], feature_dim: int) -> None:
        super().__init__()
        channels = [width * (i + 1) for i in range(len(blocks))]
        self.stem = nn.Sequential(nn.Conv2d(3, width, 5, 2, 2, bias=False), nn.GroupNorm(GROUPS, width), nn.ReLU())
        stages: list[nn.Module] = []
        c_in = width
        for i, (c_out, count) in enumerate(zip(channels, blocks, strict=True)):
            layers = [
                ResidualBlock(c_in if k == 0 else c_out, c_out, 2 if k == 0 and i > 0 else 1) for k in range(count)
            ]
            stages.append(nn.Sequential(*layers))
            c_in = c_out
        self.stages = nn.ModuleList(stages)
        self.ups = nn.ModuleList(
            UpBlock(channels[i + 1], channels[i], channels[i]) for i in reversed(range(len(blocks) - 1))
        )
        self.head = nn.Conv2d(channels[0], feature_dim, 3, 1, 1)
        # Channels-last convolutions take a quarter of the CPU time at these widths (forward and backward).
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]

    def forward(self, rgb: torch.Tensor) -> torch.Tensor:
        """(m, 3, H, W) in [0, 1] -> (m, C, H / 2, W / 2); H and W need not be multiples of the deepest stride."""
        x = self.stem(((rgb - 0.45) / 0.25).contiguous(memory_format=torch.channels_last))
        skips: list[torch.Tensor] = []
        for stage in self.stages:
            x = stage(x)
            skips.append(x)
        skips.pop()
        for up in self.ups:
            x = up(x, skips.pop())
        return self.head(x)
