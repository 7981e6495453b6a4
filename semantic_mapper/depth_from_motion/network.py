"""The network that turns what matching knows of a view into depth and its spread: a small U-Net."""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import NamedTuple

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn
from torch.nn import functional

from semantic_mapper.depth_from_motion.evidence import CANDIDATES, CHANNELS, MEMBRANE
from semantic_mapper.errors import WeightsError
from semantic_mapper.files import write_bytes

FORMAT, VERSION = "semantic-mapper-depth", "1"
WIDTHS = (16, 32, 48, 64)  # channels at the working size, at half of it, at a quarter, at an eighth
DILATIONS = (1, 2, 4, 1)  # of the layers at an eighth, which see nearly all of the image
STRIDE = 2 ** (len(WIDTHS) - 1)
MEMBRANE_FIRST = 2.0  # logit of the membrane before training
LEAST_LOG_SPREAD, MOST_LOG_SPREAD = -6.0, 1.0


class Prediction(NamedTuple):
    """What the network says of each pixel.

    Args:
        log_inverse: (B, h, w) logarithm of the inverse depth, as a fraction of the sweep's largest one.
        log_spread: (B, h, w) logarithm of the mean absolute error of ``log_inverse``.
    """

    log_inverse: Tensor
    log_spread: Tensor


class DepthNetwork(nn.Module):
    """Weighs the depths that matching offers for a pixel, and corrects their mean. Any size of image."""

    def __init__(self) -> None:
        super().__init__()
        full, half, quarter, eighth = WIDTHS
        self.enter = nn.Conv2d(CHANNELS, full, 1)
        self.at_full = Block(full)
        self.down_half, self.at_half = nn.Conv2d(full, half, 2, 2), nn.Sequential(Block(half), Block(half))
        self.down_quarter = nn.Conv2d(half, quarter, 2, 2)
        self.at_quarter = nn.Sequential(Block(quarter), Block(quarter))
        self.down_eighth = nn.Conv2d(quarter, eighth, 2, 2)
        self.at_eighth = nn.Sequential(*(Block(eighth, dilation) for dilation in DILATIONS))
        self.up_quarter, self.join_quarter = nn.Conv2d(eighth, quarter, 1), Block(quarter)
        self.up_half, self.join_half = nn.Conv2d(quarter, half, 1), Block(half)
        self.up_full, self.join_full = nn.Conv2d(half, full, 1), Block(full)
        candidates = CANDIDATES.stop - CANDIDATES.start
        self.head = nn.Conv2d(full, candidates + 2, 1)  # weights of the candidates, correction, logarithm of the spread
        nn.init.zeros_(self.head.weight)
        bias = torch.zeros(candidates + 2)
        bias[MEMBRANE - CANDIDATES.start], bias[-1] = MEMBRANE_FIRST, -2.5
        self.head.bias = nn.Parameter(bias)

    def forward(self, evidence: Tensor) -> Prediction:
        """Depth and spread of ``evidence`` (B, C, h, w)."""
        height, width = evidence.shape[2:]
        padded = functional.pad(evidence, (0, -width % STRIDE, 0, -height % STRIDE), mode="replicate")
        full = self.at_full(self.enter(padded))  # B 16 h w
        half = self.at_half(self.down_half(full))  # B 32 h/2 w/2
        quarter = self.at_quarter(self.down_quarter(half))  # B 48 h/4 w/4
        x = self.at_eighth(self.down_eighth(quarter))  # B 64 h/8 w/8
        x = self.join_quarter(quarter + _double(self.up_quarter(x)))
        x = self.join_half(half + _double(self.up_half(x)))
        x = self.join_full(full + _double(self.up_full(x)))
        out = self.head(x)[:, :, :height, :width].float()  # B 8 h w
        depths = evidence[:, CANDIDATES].float()
        chosen = (out[:, :-2].softmax(1) * depths).sum(1)
        return Prediction(chosen + out[:, -2], out[:, -1].clamp(LEAST_LOG_SPREAD, MOST_LOG_SPREAD))


class Block(nn.Module):
    """A residual 3x3 convolution."""

    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, channels, 3, padding=dilation, dilation=dilation)

    def forward(self, x: Tensor) -> Tensor:
        """(B, C, h, w) to the same."""
        return x + self.conv(functional.relu(x))


def _double(x: Tensor) -> Tensor:
    return functional.interpolate(x, scale_factor=2.0, mode="bilinear", align_corners=False)


def default_network_path() -> Path:
    """The weights that ship with the package."""
    return Path(str(resources.files("semantic_mapper"))) / "weights" / "depth.safetensors"


def save_network(network: DepthNetwork, path: Path) -> None:
    """Write the weights as float16, atomically.

    Raises:
        OSError: it cannot be written.
    """
    tensors = {name: t.half().contiguous() for name, t in network.state_dict().items()}
    write_bytes(path, save(tensors, {"format": FORMAT, "version": VERSION}))


def load_network(path: Path) -> DepthNetwork:
    """Read weights that ``save_network`` wrote.

    Raises:
        WeightsError: missing, damaged, or of another format, version or shape.
    """
    try:
        with safe_open(path, framework="pt") as stored:
            metadata = dict(stored.metadata() or {})
            tensors = {name: stored.get_tensor(name).float() for name in stored.keys()}  # noqa: SIM118 - not a dict
    except (SafetensorError, OSError) as error:
        raise WeightsError(
            f"{path}: no readable weights of computed depth ({error}); install the package again, or train them with "
            "`python -m tools.train_depth`"
        ) from error
    if (found := (metadata.get("format"), metadata.get("version"))) != (FORMAT, VERSION):
        raise WeightsError(
            f"{path}: not the weights of computed depth that this version reads ({FORMAT} {VERSION}), but {found}; "
            "install the package again, or train them with `python -m tools.train_depth`"
        )
    network = DepthNetwork()
    expected = {name: t.shape for name, t in network.state_dict().items()}
    if {name: t.shape for name, t in tensors.items()} != expected:
        raise WeightsError(f"{path}: tensors of another network; train them with `python -m tools.train_depth`")
    if not all(bool(t.isfinite().all()) for t in tensors.values()):
        raise WeightsError(f"{path}: weights that are not finite; train them with `python -m tools.train_depth`")
    network.load_state_dict(tensors)
    return network.eval().requires_grad_(False).to(memory_format=torch.channels_last)  # pyright: ignore[reportCallIssue]
