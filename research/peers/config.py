"""Shapes of the fields that ours are compared with."""

from __future__ import annotations

from typing import Annotated

import msgspec

from semantic_mapper.config import Channels, Config, EncoderConfig, Layers, Samples


class NeuRayConfig(Config, frozen=True):
    """Shape of NeuRay with a semantic head; the encoder is S-Ray's."""

    feature_dim: Channels = 32  # C
    encoder: EncoderConfig = EncoderConfig()


class MVSNeRFConfig(Config, frozen=True):
    """Shape of MVSNeRF with a semantic head; the encoder is S-Ray's."""

    feature_dim: Channels = 32  # channels whose variance the cost volume holds
    encoder: EncoderConfig = EncoderConfig()
    views: Annotated[int, msgspec.Meta(ge=1, le=16)] = (
        3  # source views used: those nearest to the query; the first of them is the reference
    )
    planes: Samples = 64  # of the sweep, uniform in inverse depth
    plane_near_m: float = 0.3
    plane_far_m: float = 8.0
    volume_channels: Channels = 8  # of the neural encoding volume
    width: Channels = 64  # of the MLP
    depth: Layers = 4  # layers of the MLP
    position_frequencies: Layers = 6


class SemanticNeRFConfig(Config, frozen=True):
    """Shape of Semantic-NeRF, and the box that it can describe: one scene."""

    width: Channels = 128
    depth: Layers = 4  # layers before the heads; the encoded position enters the middle one again
    position_frequencies: Layers = 10
    direction_frequencies: Layers = 4
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the box, world
    half_extent_m: float = 8.0  # half the side of the box
