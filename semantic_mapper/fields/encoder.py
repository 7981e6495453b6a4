"""The shared image encoder: light residual U-Nets that give the F_j of S-Ray Eq. 5.

Where it sees depth, it sees the geocentric encoding of Gupta et al. (ECCV 2014): inverse depth, height above the lowest
point in view, and the angle of the surface to gravity, which is found in each image by itself. Its backbone may be
EfficientNet-Lite0 (Tan and Le, ICML 2019), a network that has seen photographs before it sees rooms.
"""

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.config import EncoderConfig
from semantic_mapper.fields import numbers
from semantic_mapper.fields.surface_maps import has_depth, surface_maps
from semantic_mapper.fields.views import sure_depth
from semantic_mapper.types import SourceViews

COLOURS = 3
BACKBONE_WIDTHS = tuple(stage[-1][1] for stage in numbers.BACKBONE_STAGES)  # channels at strides 2, 4, 8, 16, 32
BACKBONE_STEM = 32


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with batch norm and a shortcut."""

    def __init__(self, c_in: int, c_out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(c_in, c_out, 3, stride, 1, bias=False)
        self.norm1 = nn.BatchNorm2d(c_out)
        self.conv2 = nn.Conv2d(c_out, c_out, 3, 1, 1, bias=False)
        self.norm2 = nn.BatchNorm2d(c_out)
        self.stride = stride
        self.shortcut = nn.Identity() if stride == 1 and c_in == c_out else nn.Conv2d(c_in, c_out, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, c_in, H, W) -> (B, c_out, H / stride, W / stride), sizes rounded up."""
        y = functional.relu(self.norm1(self.conv1(x)))
        # Not a strided 1x1 convolution: the backward pass of oneDNN's, channels-last on several threads, can write
        # past its buffers (torch 2.15, AVX-512, 3 images of 8 channels on 2 threads, for one).
        if self.stride > 1:
            x = functional.avg_pool2d(x, self.stride, ceil_mode=True)
        return functional.relu(self.norm2(self.conv2(y)) + self.shortcut(x))


class UpBlock(nn.Module):
    """Bring deep features to the width of the skip connection, upsample, add, refine."""

    def __init__(self, c_in: int, c_skip: int, *, refine: int) -> None:
        super().__init__()
        self.reduce = nn.Conv2d(c_in, c_skip, 1)
        blocks = [ResidualBlock(c_skip, c_skip, 1) for _ in range(refine)]
        self.refine = blocks[0] if refine == 1 else nn.Sequential(*blocks)

    def forward(self, x: torch.Tensor, skip: torch.Tensor) -> torch.Tensor:
        """(B, c_in, h, w), (B, c_skip, H, W) -> (B, c_skip, H, W); H is 2 h or 2 h - 1."""
        height, width = skip.shape[-2:]
        up = functional.interpolate(self.reduce(x), scale_factor=2.0, mode="nearest")[..., :height, :width]
        return self.refine(skip + up)


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=numbers.NORM_EPSILON)


class StridedConvolution(nn.Conv2d):
    """Of stride 2, padded as TensorFlow's "SAME" pads: one pixel more after the image than before where that is odd."""

    def __init__(self, c_in: int, c_out: int, kernel: int, groups: int) -> None:
        super().__init__(c_in, c_out, kernel, 2, 0, groups=groups, bias=False)

    def forward(self, input: torch.Tensor) -> torch.Tensor:  # noqa: A002 - as the base class names it
        """(B, c_in, H, W) -> (B, c_out, H / 2, W / 2), sizes rounded up."""
        height, width = (self.kernel_size[0] - 2 + size % 2 for size in input.shape[-2:])
        padded = functional.pad(input, (width // 2, width - width // 2, height // 2, height - height // 2))
        return super().forward(padded)


class InvertedResidual(nn.Module):
    """Expand, convolve each channel by itself, project; with a shortcut where shapes allow."""

    def __init__(self, c_in: int, c_out: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        inner = c_in * expansion
        self.expand = nn.Conv2d(c_in, inner, 1, bias=False) if expansion > 1 else None
        self.expand_norm = _norm(inner) if expansion > 1 else None
        self.depthwise = (
            StridedConvolution(inner, inner, kernel, inner)
            if stride == 2
            else nn.Conv2d(inner, inner, kernel, 1, kernel // 2, groups=inner, bias=False)
        )
        self.depthwise_norm = _norm(inner)
        self.project = nn.Conv2d(inner, c_out, 1, bias=False)
        self.project_norm = _norm(c_out)
        self.shortcut = stride == 1 and c_in == c_out

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, c_in, H, W) -> (B, c_out, H / stride, W / stride), sizes rounded up."""
        y = x
        if self.expand is not None and self.expand_norm is not None:
            y = functional.relu6(self.expand_norm(self.expand(y)))
        y = functional.relu6(self.depthwise_norm(self.depthwise(y)))
        y = self.project_norm(self.project(y))
        return x + y if self.shortcut else y


class EfficientNetLite0(nn.Module):
    """Colours in [0, 1] (B, 3, H, W) -> features at strides 2, 4, ... of ``BACKBONE_WIDTHS`` channels.
    ``stages``: how many of the five; the classifier of the published network and its last block are not built."""

    def __init__(self, stages: int = len(numbers.BACKBONE_STAGES)) -> None:
        super().__init__()
        self.stem = StridedConvolution(3, BACKBONE_STEM, 3, 1)
        self.stem_norm = _norm(BACKBONE_STEM)
        self.stages = nn.ModuleList(
            nn.Sequential(*(InvertedResidual(*block) for block in stage)) for stage in numbers.BACKBONE_STAGES[:stages]
        )

    def forward(self, rgb: torch.Tensor) -> list[torch.Tensor]:
        """One feature map a stage, the finest first."""
        x = functional.relu6(self.stem_norm(self.stem((rgb - numbers.BACKBONE_MEAN) / numbers.BACKBONE_DEVIATION)))
        maps: list[torch.Tensor] = []
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        return maps


class UNet(nn.Module):
    """A residual U-Net, or one whose deeper stages are EfficientNet-Lite0, which sees colours alone.

    Next to that backbone a slim residual encoder sees all inputs: where colours are not those of the training rooms,
    depth is what a view can be known by. The coarsest stage is the backbone's alone.
    """

    def __init__(self, c_in: int, config: EncoderConfig, c_out: int) -> None:
        super().__init__()
        channels, blocks, pretrained = config.channels, config.blocks, config.backbone != "residual"
        self.stem = nn.Conv2d(c_in, channels[0], 5, 2, 2)
        widths = (channels[0], *channels)
        stages = range(len(channels) - pretrained)
        self.stages = nn.ModuleList(
            nn.Sequential(
                ResidualBlock(widths[i], channels[i], 2 if i > 0 else 1),
                *(ResidualBlock(channels[i], channels[i], 1) for _ in range(blocks[i] - 1)),
            )
            for i in stages
        )
        self.backbone = self.laterals = None
        if pretrained:
            self.backbone = EfficientNetLite0(len(channels))
            self.laterals = nn.ModuleList(nn.Conv2d(BACKBONE_WIDTHS[i], out, 1) for i, out in enumerate(channels))
        # Without a backbone a residual block at the finest stage would cost as much as all others, and bring little.
        refine = blocks if pretrained else [int(i > 0) for i in range(len(blocks))]
        self.ups = nn.ModuleList(
            UpBlock(channels[i + 1], channels[i], refine=refine[i]) for i in reversed(range(len(channels) - 1))
        )
        self.head = nn.Conv2d(channels[0], c_out, 3, 1, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, c_in, H, W) -> (B, c_out, H / 2, W / 2), sizes rounded up."""
        x = x.contiguous(memory_format=torch.channels_last)
        skips: list[torch.Tensor] = []
        if self.backbone is not None and self.laterals is not None:
            maps = self.backbone(x[:, :COLOURS] * numbers.COLOUR_DEVIATION + numbers.COLOUR_MEAN)
            skips = [lateral(features) for lateral, features in zip(self.laterals, maps, strict=True)]
        x = functional.relu(self.stem(x))
        for i, stage in enumerate(self.stages):
            x = stage(x)
            if self.backbone is None:
                skips.append(x)
            else:
                skips[i] = skips[i] + x
        x = skips.pop()
        for up in self.ups:
            x = up(x, skips.pop())
        return self.head(x)


class ImageEncoder(nn.Module):
    """U-Nets shared by all views; each view is encoded by itself, into C = ``feature_dim`` channels.

    Where the config asks for depth there are two: one for views with measured depth, which sees what ``surface_maps``
    makes of it next to the colours, and one for views without. A single network for both would do either less well.
    Statistics of batch norm come from the images only inside ``batch_statistics`` (training on many images at once);
    else, in training mode too, they are constants, so that a view's features do not depend on the views next to it.
    """

    def __init__(self, config: EncoderConfig, feature_dim: int) -> None:
        super().__init__()
        self.colour_net = UNet(COLOURS, config, feature_dim)
        self.depth_net = UNet(COLOURS + numbers.SURFACE_CHANNELS, config, feature_dim) if config.depth else None
        self.takes_computed_depth = config.depth and config.computed_depth
        self._of_batch = False
        self._frozen: tuple[nn.Module, ...] = ()
        # Channels-last convolutions take a quarter of the CPU time at these widths (forward and backward).
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.train()  # which is where the norms learn that they are constants

    def forward(self, views: SourceViews) -> torch.Tensor:
        """Features (m, C, H / 2, W / 2) of m views; H and W need not be multiples of the deepest stride."""
        rgb = (views.rgb - numbers.COLOUR_MEAN) / numbers.COLOUR_DEVIATION
        if self.depth_net is None:
            return self.colour_net(rgb)
        views = sure_depth(views, computed=self.takes_computed_depth)
        depth = views.depth_m.detach().cpu().numpy()
        deep = [i for i, each in enumerate(depth) if has_depth(each)]
        if not deep:
            return self.colour_net(rgb)
        K = views.K.detach().cpu().numpy()
        maps = torch.from_numpy(np.stack([surface_maps(depth[i], K[i]) for i in deep])).to(rgb.device)
        measured = torch.zeros(len(rgb), dtype=torch.bool, device=rgb.device)
        measured[deep] = True
        with_depth = self.depth_net(torch.cat((rgb[measured], maps), dim=1))
        if bool(measured.all()):
            return with_depth
        without = self.colour_net(rgb[~measured])
        place = torch.cat((measured.nonzero()[:, 0], (~measured).nonzero()[:, 0]))
        return torch.cat((with_depth, without))[place.argsort()]

    @property
    def uncalibrated(self) -> bool:
        """Whether some norm is as it was built: it has counted no batch, and was given no statistics."""
        return any(
            not int(n.num_batches_tracked) and not bool(n.running_mean.any()) and bool((n.running_var == 1).all())
            for n in self.norms()
        )

    def train(self, mode: bool = True) -> Self:
        """Training mode for all but the norms, whose statistics only change inside ``batch_statistics``."""
        super().train(mode)
        for norm in self.norms():
            norm.train(mode and self._of_batch)
        for part in self._frozen:
            part.eval()
        return self

    def freeze(self, *parts: nn.Module) -> None:
        """Let these parts keep their weights and statistics from now on, whatever is trained, and all others learn."""
        self.requires_grad_(True)
        self._frozen = parts
        for part in parts:
            part.requires_grad_(False)
        self.train(self.training)

    @contextmanager
    def batch_statistics(self) -> Generator[None]:
        """Norms take their statistics from the images at hand, and keep running means of them for later."""
        mode = self.training
        self._of_batch = True
        self.train()
        try:
            yield
        finally:
            self._of_batch = False
            self.train(mode)

    def backbones(self) -> Iterator[EfficientNetLite0]:
        """Those of its networks that may start from ImageNet weights."""
        return (module for module in self.modules() if isinstance(module, EfficientNetLite0))

    def norms(self) -> Iterator[Any]:
        """Its ``BatchNorm2d``."""
        return (module for module in self.modules() if isinstance(module, nn.BatchNorm2d))


def calibrate(encoder: ImageEncoder, views: SourceViews) -> None:
    """Set the norms of a fresh encoder to the statistics of these views, with their depth and without; no weight
    changes. Where no view has depth, the network that would see it is shown a flat wall."""
    norms = list(encoder.norms())
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.momentum = 1.0
    with encoder.batch_statistics(), torch.no_grad():
        encoder(replace(views, depth_m=torch.zeros_like(views.depth_m)))
        if encoder.depth_net is not None:
            measured = any(map(has_depth, views.depth_m.cpu().numpy()))
            encoder(views if measured else replace(views, depth_m=torch.ones_like(views.depth_m)))
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
