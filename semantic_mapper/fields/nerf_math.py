"""Pieces of NeRF's MLP that several fields use."""

from __future__ import annotations

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
import math

import torch
from torch import nn

DENSITY_START = 2.0  # log density of an untrained network: 7 / m, a third of the light gone after 5 cm
DENSITY_LIMIT = 8.0  # 3,000 / m: opaque within 1 mm, and no overflow


def encode_frequencies(x: torch.Tensor, frequencies: int) -> torch.Tensor:
    """NeRF's gamma: (..., D) in [-1, 1] -> (..., D (1 + 2 F)), x itself and sin, cos of 2^k pi x for k = 0 .. F - 1."""
    rate = math.pi * 2.0 ** torch.arange(frequencies, dtype=x.dtype, device=x.device)
    angle = (x[..., None, :] * rate[:, None]).flatten(-2)  # (..., F D)
    return torch.cat((x, torch.sin(angle), torch.cos(angle)), dim=-1)


def encoded_size(dimensions: int, frequencies: int) -> int:
    """Channels that ``encode_frequencies`` gives."""
    return dimensions * (1 + 2 * frequencies)


def density_from(raw: torch.Tensor) -> torch.Tensor:
    """Network output -> density in 1 / m, positive.

    An exponential where NeRF has a ReLU: scenes are in metres here, and samples may stand a centimetre apart, so
    densities from 0.1 / m to 1,000 / m have to be in reach of one learning rate.
    """
    return torch.exp((raw + DENSITY_START).clamp(max=DENSITY_LIMIT))


def relu_layers(c_in: int, width: int, count: int) -> nn.Sequential:
    """``count`` linear layers, each with a ReLU: (..., c_in) -> (..., width).

    He's initialisation, as NeRF's successors have it: with torch's own, a plain MLP learns far slower.
    """
    layers: list[nn.Module] = []
    for i in range(count):
        layer = nn.Linear(c_in if i == 0 else width, width)
        nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.ReLU()]
    return nn.Sequential(*layers)
