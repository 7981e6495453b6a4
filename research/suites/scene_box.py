"""The config that a field should have to be fitted to the scene that some views show."""

from __future__ import annotations

import msgspec

from research.peers.seen_bounds import seen_bounds
from research.peers.semantic_nerf import SemanticNeRF, config_for_scene
from semantic_mapper.config import Config
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.scene.grid import GridField, grid_box
from semantic_mapper.types import SourceViews


def scene_config(field: LearnedField, views: SourceViews, far_m: float) -> Config:
    """Of this kind and shape; kinds of one scene in the box that holds what the views can see.

    Args:
        far_m: How far pixels without measured depth may see.
    """
    if isinstance(field, SemanticNeRF):
        return config_for_scene(views, far_m, field.config)
    if isinstance(field, GridField):
        low, high = seen_bounds(views, far_m)
        return msgspec.structs.replace(field.config, grid=grid_box(low, high, max(field.config.grid.shape)))
    return field.config
