"""Shapes of the fields that ours are compared with."""

from __future__ import annotations

from semantic_mapper.config import Channels, Config, Layers


class SemanticNeRFConfig(Config, frozen=True):
    """Shape of Semantic-NeRF, and the box that it can describe: one scene."""

    width: Channels = 128
    depth: Layers = 4  # layers before the heads; the encoded position enters the middle one again
    position_frequencies: Layers = 10
    direction_frequencies: Layers = 4
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)  # of the box, world
    half_extent_m: float = 8.0  # half the side of the box
