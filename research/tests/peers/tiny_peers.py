"""Tiny peers."""

from __future__ import annotations

from research.peers.config import SemanticNeRFConfig
from semantic_mapper.config import Config
from semantic_mapper.fields.learned import LearnedField
from tests.fields.tiny_fields import TINY, tiny

PEERS: dict[str, Config] = {
    "semantic_nerf": SemanticNeRFConfig(width=16, position_frequencies=4, half_extent_m=4.0),
    "panoptic_uniform": TINY["panoptic"],
}


def tiny_peer(name: str) -> LearnedField:
    """Random weights, evaluation mode."""
    return tiny(name, config=PEERS[name])
