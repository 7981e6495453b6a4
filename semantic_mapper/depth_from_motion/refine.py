"""The network of `network.py` on the package's own convolutions: depth and spread of a view from its evidence."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from torch import nn

from semantic_mapper.depth_from_motion.convolution import Convolution, add_doubled, pack_convolution
from semantic_mapper.depth_from_motion.evidence import CANDIDATES
from semantic_mapper.depth_from_motion.network import (
    LEAST_LOG_SPREAD,
    MOST_LOG_SPREAD,
    STRIDE,
    default_network_path,
    load_network,
)
from semantic_mapper.types import Float32


class RefinedDepth(NamedTuple):
    """What the network says of each pixel.

    Args:
        log_inverse: (h, w) float32 logarithm of the inverse depth, as a fraction of the sweep's largest one.
        spread: (h, w) float32 one-sigma spread of ``log_inverse``: that of the depth, relative to it.
    """

    log_inverse: Float32
    spread: Float32


@dataclass(frozen=True, slots=True, eq=False)
class DepthRefiner:
    """The trained network. Gives the same bits on any number of threads.

    Args:
        convolutions: By their names in the network.
    """

    convolutions: dict[str, Convolution]

    def __call__(self, evidence: Float32) -> RefinedDepth:
        """Depth and spread from the evidence (C, h, w) of ``gather_evidence``."""
        height, width = evidence.shape[1:]
        margins = ((0, -height % STRIDE), (0, -width % STRIDE), (0, 0))
        full = self._run("enter", np.pad(evidence.transpose(1, 2, 0), margins, mode="edge"))
        self._activate("at_full", full)
        half = self._run("down_half", full)
        self._activate("at_half", half)
        quarter = self._run("down_quarter", half)
        self._activate("at_quarter", quarter)
        x = self._run("down_eighth", quarter)
        self._activate("at_eighth", x)
        for level, image in (("quarter", quarter), ("half", half), ("full", full)):
            add_doubled(self._run(f"up_{level}", x), image)
            self._activate(f"join_{level}", image)
            x = image
        out = np.ascontiguousarray(self._run("head", x)[:height, :width].transpose(2, 0, 1))
        weights = np.exp(out[:-2] - out[:-2].max(0))
        chosen = (weights * evidence[CANDIDATES]).sum(0) / weights.sum(0)
        spread = np.exp(np.clip(out[-1], LEAST_LOG_SPREAD, MOST_LOG_SPREAD))
        return RefinedDepth(chosen + out[-2], spread)

    def _run(self, name: str, image: Float32) -> Float32:
        return np.ascontiguousarray(self.convolutions[name](np.ascontiguousarray(image)))

    def _activate(self, name: str, image: Float32) -> None:
        """Run the block of a name, or the row of them, on an image in place."""
        for key, convolution in self.convolutions.items():
            if key == f"{name}.conv" or (key.startswith(f"{name}.") and key.endswith(".conv")):
                convolution.add_activated(image)


def load_refiner(path: Path) -> DepthRefiner:
    """The network of a file of ``save_network``.

    Raises:
        WeightsError: missing, damaged, or of another format, version or shape.
    """
    found: dict[str, Convolution] = {}
    for name, layer in load_network(path).named_modules():
        if isinstance(layer, nn.Conv2d):
            assert layer.bias is not None
            weight, bias = layer.weight.numpy(), layer.bias.numpy()
            found[name] = pack_convolution(weight, bias, layer.stride[0], layer.dilation[0])
    return DepthRefiner(found)


@functools.cache
def default_refiner() -> DepthRefiner:
    """The one that ships with the package.

    Raises:
        WeightsError: as of ``load_refiner``.
    """
    return load_refiner(default_network_path())
