"""The shared image encoder: light residual U-Nets that give the F_j of S-Ray Eq. 5."""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Self

import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.config import EncoderConfig
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.efficientnet import WIDTHS, EfficientNetLite0
from semantic_mapper.fields.source_maps import sure_depth
from semantic_mapper.fields.surface import SURFACE_CHANNELS, surface_maps
from semantic_mapper.types import SourceViews

COLOURS = 3
COLOUR_MEAN, COLOUR_DEVIATION = 0.45, 0.25
MEASURED_SHARE = 0.05  # of the pixels: with less measured depth a view counts as one without


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with batch norm and a shortcut: (B, c_in, H, W) -> (B, c_out, H / stride, W / stride)."""

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


class ResidualUNet(nn.Module):
    """(B, c_in, H, W) -> (B, c_out, H / 2, W / 2); H and W need not be multiples of the deepest stride."""

    def __init__(self, c_in: int, config: EncoderConfig, c_out: int) -> None:
        super().__init__()
        channels, blocks = config.channels, config.blocks
        self.stem = nn.Conv2d(c_in, channels[0], 5, 2, 2)
        stages: list[nn.Module] = []
        width = channels[0]
        for i, (out, count) in enumerate(zip(channels, blocks, strict=True)):
            layers = [ResidualBlock(width if k == 0 else out, out, 2 if k == 0 and i > 0 else 1) for k in range(count)]
            stages.append(nn.Sequential(*layers))
            width = out
        self.stages = nn.ModuleList(stages)
        # At the finest stage a residual block would cost as much as all of the others, and brings little.
        self.ups = nn.ModuleList(
            UpBlock(channels[i + 1], channels[i], refine=int(i > 0)) for i in reversed(range(len(blocks) - 1))
        )
        self.head = nn.Conv2d(channels[0], c_out, 3, 1, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, c_in, H, W) -> (B, c_out, H / 2, W / 2), sizes rounded up."""
        x = functional.relu(self.stem(x.contiguous(memory_format=torch.channels_last)))
        skips: list[torch.Tensor] = []
        for stage in self.stages:
            x = stage(x)
            skips.append(x)
        skips.pop()
        for up in self.ups:
            x = up(x, skips.pop())
        return self.head(x)


class PretrainedUNet(nn.Module):
    """The same shapes as ``ResidualUNet``, with EfficientNet-Lite0 in the place of its deeper stages.

    The backbone sees colours alone. Beside it a slim residual encoder sees all inputs, depth among them: where colours
    are not those of the training rooms, in photographs, depth is what a view can be known by. ``channels`` are the
    widths of that encoder and of the decoder, finest first, ``blocks`` the residual blocks of both at each stage; the
    coarsest stage is the backbone's alone.
    """

    def __init__(self, c_in: int, config: EncoderConfig, c_out: int) -> None:
        super().__init__()
        channels = config.channels
        self.stem = nn.Conv2d(c_in, channels[0], 5, 2, 2)
        widths = (channels[0], *channels[:-1])
        self.stages = nn.ModuleList(
            nn.Sequential(
                *(
                    ResidualBlock(widths[i] if k == 0 else out, out, 2 if k == 0 and i > 0 else 1)
                    for k in range(max(config.blocks[i], 1))
                )
            )
            for i, out in enumerate(channels[:-1])
        )
        self.backbone = EfficientNetLite0(len(channels))
        self.laterals = nn.ModuleList(nn.Conv2d(WIDTHS[i], out, 1) for i, out in enumerate(channels))
        self.ups = nn.ModuleList(
            UpBlock(channels[i + 1], channels[i], refine=config.blocks[i]) for i in reversed(range(len(channels) - 1))
        )
        self.head = nn.Conv2d(channels[0], c_out, 3, 1, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """(B, c_in, H, W) -> (B, c_out, H / 2, W / 2), sizes rounded up."""
        x = x.contiguous(memory_format=torch.channels_last)
        maps = self.backbone(x[:, :COLOURS] * COLOUR_DEVIATION + COLOUR_MEAN)
        skips = [lateral(features) for lateral, features in zip(self.laterals, maps, strict=True)]
        x = functional.relu(self.stem(x))
        for i, stage in enumerate(self.stages):
            x = stage(x)
            skips[i] = skips[i] + x
        x = skips.pop()
        for up in self.ups:
            x = up(x, skips.pop())
        return self.head(x)


class ImageEncoder(nn.Module):
    """U-Nets of either kind, shared by all views; each view is encoded by itself.

    Where the config asks for depth there are two: one for views with measured depth, which sees what
    ``surface.surface_maps`` makes of it beside the colours, and one for views without, which sees colours alone. Both
    give features of one kind. A single network that has to do with and without gives away much of what each can do.

    Batch norm, because on a CPU it costs half of what group norm does and learns faster. Its statistics come from the
    images only inside ``batch_statistics`` (where the encoder is trained on many different images at once); everywhere
    else, in training mode too, they are constants, so that a view's features do not depend on the views beside it.

    Args:
        config: Shape, and whether depth that was computed from pictures is shown to it.
        feature_dim: C, channels of the output.

    Raises:
        ConfigError: a shape that cannot be built.
    """

    def __init__(self, config: EncoderConfig, feature_dim: int) -> None:
        super().__init__()
        channels, blocks = config.channels, config.blocks
        pretrained = config.backbone == "efficientnet-lite0"
        least = 0 if pretrained else 1
        if not channels or len(channels) != len(blocks) or min(*channels, feature_dim) < 1 or min(blocks) < least:
            raise ConfigError(
                "encoder: channels and blocks need one positive number a stage each, and feature_dim has to be "
                f"positive; got {list(channels)}, {list(blocks)} and {feature_dim}"
            )
        if pretrained and (not 2 <= len(channels) <= len(WIDTHS) or blocks[-1] != 0):
            raise ConfigError(
                f"encoder: this backbone has 2 to {len(WIDTHS)} stages, the last one without blocks (0); got "
                f"{list(channels)} and {list(blocks)}"
            )
        unet = PretrainedUNet if pretrained else ResidualUNet
        self.colour_net = unet(COLOURS, config, feature_dim)
        self.depth_net = unet(COLOURS + SURFACE_CHANNELS, config, feature_dim) if config.depth else None
        self.takes_computed_depth = config.depth and config.computed_depth
        self._of_batch = False
        self._colours_frozen = False
        self._backbones_frozen = False
        # Channels-last convolutions take a quarter of the CPU time at these widths (forward and backward).
        self.to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
        self.train()  # which is where the norms learn that they are constants

    def forward(self, views: SourceViews) -> torch.Tensor:
        """Features (m, C, H / 2, W / 2) of m views; H and W need not be multiples of the deepest stride."""
        rgb = (views.rgb - COLOUR_MEAN) / COLOUR_DEVIATION
        if self.depth_net is None:
            return self.colour_net(rgb)
        views = sure_depth(views, computed=self.takes_computed_depth)
        measured = has_depth(views.depth_m)
        if not bool(measured.any()):
            return self.colour_net(rgb)
        maps = surface_maps(views.depth_m[measured], views.K[measured])
        with_depth = self.depth_net(torch.cat((rgb[measured], maps), dim=1))
        if bool(measured.all()):
            return with_depth
        without = self.colour_net(rgb[~measured])
        place = torch.cat((measured.nonzero()[:, 0], (~measured).nonzero()[:, 0]))
        return torch.cat((with_depth, without))[place.argsort()]

    def grow_depth(self) -> None:
        """Let the network that sees depth start as the one that does not: its first layer ignores depth for now.

        Raises:
            ConfigError: an encoder without such a network.
        """
        if self.depth_net is None:
            raise ConfigError("this encoder sees colours alone; set depth = true in [field.encoder]")
        grown = self.colour_net.state_dict()
        stem = torch.zeros_like(self.depth_net.stem.weight)
        stem[:, :COLOURS] = grown["stem.weight"]
        self.depth_net.load_state_dict(grown | {"stem.weight": stem})

    @property
    def uncalibrated(self) -> bool:
        """Whether its norms have never seen an image: constants of a fresh network mean nothing.

        Norms of a pretrained backbone that was frozen from the start have counted no batch, but have statistics.
        """
        return any(_is_fresh(norm) for norm in self._norms())

    def train(self, mode: bool = True) -> Self:
        """Training mode for all but the norms, whose statistics only change inside ``batch_statistics``."""
        super().train(mode)
        for norm in self._norms():
            norm.train(mode and self._of_batch)
        if self._colours_frozen:
            self.colour_net.eval()
        if self._backbones_frozen:
            for backbone in self.backbones():
                backbone.eval()
        return self

    def freeze_colours(self, frozen: bool) -> None:
        """Whether the network for colours alone keeps its weights and statistics, whatever is trained."""
        if frozen != self._colours_frozen:
            self._colours_frozen = frozen
            self.colour_net.requires_grad_(not frozen)
            if self._backbones_frozen:
                self.freeze_backbones()
            self.train(self.training)

    def freeze_backbones(self) -> None:
        """Let pretrained backbones keep their weights and statistics from now on, whatever is trained."""
        self._backbones_frozen = True
        for backbone in self.backbones():
            backbone.requires_grad_(False)
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

    def _norms(self) -> Iterator[nn.BatchNorm2d]:
        return (module for module in self.modules() if isinstance(module, nn.BatchNorm2d))


def _is_fresh(norm: nn.BatchNorm2d) -> bool:
    """Whether a norm is as it was built: it has counted no batch, and was given no statistics."""
    assert norm.running_mean is not None and norm.running_var is not None  # all norms here track their statistics
    counted = int(norm.num_batches_tracked or 0)
    return counted == 0 and not bool(norm.running_mean.any()) and bool((norm.running_var == 1).all())


def has_depth(depth_m: torch.Tensor) -> torch.Tensor:
    """(m,) bool: whether enough of each view (m, H, W) is measured to be worth looking at."""
    return (depth_m > 0).flatten(1).float().mean(1) >= MEASURED_SHARE


def calibrate(encoder: ImageEncoder, views: SourceViews) -> None:
    """Set the norms of a fresh encoder to the statistics of these views, with their depth and without; no weight
    changes. Where no view has depth, the network that would see it is shown a flat wall."""
    norms = [module for module in encoder.modules() if isinstance(module, nn.BatchNorm2d)]
    momenta = [norm.momentum for norm in norms]
    for norm in norms:
        norm.momentum = 1.0
    with encoder.batch_statistics(), torch.no_grad():
        encoder(replace(views, depth_m=torch.zeros_like(views.depth_m)))
        if encoder.depth_net is not None:
            measured = bool(has_depth(views.depth_m).any())
            encoder(views if measured else replace(views, depth_m=torch.ones_like(views.depth_m)))
    for norm, momentum in zip(norms, momenta, strict=True):
        norm.momentum = momentum
