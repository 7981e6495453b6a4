"""What is wrong with a training run before it begins: rooms take a while to render, and nobody should wait for a no."""

from __future__ import annotations

from pathlib import Path

import torch

from research.scenes import TRAIN_SEEDS
from research.train.images import encoder_for_images
from research.train.step import encodes_views_separately
from research.train.train_config import TrainConfig
from research.train.train_state import unfinished_step
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.device import to_device
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.types import SourceViews


def check_settings(config: TrainConfig) -> None:
    """Numbers that make no sense, whatever the kind of field. Raises ConfigError: there are such."""
    if config.seconds <= 0 and config.steps <= 0:
        raise ConfigError("training needs a budget: set seconds, steps, or both")
    if config.rooms_per_step < 1 or config.log_steps < 1:
        raise ConfigError("rooms_per_step and log_steps must be at least 1")
    if not 0 <= config.seed < len(TRAIN_SEEDS):
        raise ConfigError(f"seed must be in 0..{len(TRAIN_SEEDS) - 1}, got {config.seed}")


def check_field(field: LearnedField, config: TrainConfig) -> None:
    """A field that cannot learn from the steps that the config asks for. Raises ConfigError: it is such a one."""
    if field.image_encoder is None:
        # What it renders does not depend on the source views: it would learn the mean of all rooms.
        raise ConfigError(
            f"a field of kind '{field.kind}' holds a single scene in its weights, so it has nothing to learn for other "
            f"rooms; `semantic-mapper-research suite rooms --protocol scratch --kind {field.kind}` fits it room by room"
        )
    if config.images.fraction > 0 or config.images.later > 0:
        encoder_for_images(field)
    if config.pool.computed_depth > 0 and not field.image_encoder.takes_computed_depth:
        raise ConfigError(
            "pool.computed_depth: this encoder is shown no computed depth; set depth = true and computed_depth = true "
            "in [field.encoder]"
        )
    parts = dict(field.named_modules())
    for name in config.bfloat16:
        if not name or name not in parts:
            children = ", ".join(child for child, _ in field.named_children())
            raise ConfigError(f"bfloat16: the field has no part '{name}'; there are {children}")
    if config.encode_together and not _encodes_views_separately(field):
        raise ConfigError(
            f"encode_together: fields of kind '{field.kind}' encode views in the light of each other, so the rooms of "
            "a step cannot share one call; leave it out"
        )


def _encodes_views_separately(field: LearnedField) -> bool:
    """See ``encodes_views_separately``; of made-up views, because it is a matter of the kind, not of the images."""
    generator = torch.Generator().manual_seed(0)
    rgb = torch.rand(4, 3, 48, 64, generator=generator)
    depth_m = 1 + torch.rand(4, 48, 64, generator=generator)
    K = torch.tensor([[44.0, 0.0, 31.5], [0.0, 44.0, 23.5], [0.0, 0.0, 1.0]]).repeat(4, 1, 1)
    poses = torch.eye(4).repeat(4, 1, 1)
    poses[:, 0, 3] = 0.05 * torch.arange(4)
    views = to_device(SourceViews(rgb, depth_m, K, poses), next(field.parameters()).device)
    training = field.training
    separately = encodes_views_separately(field.eval(), views)
    field.train(training)
    return separately


def check_nothing_is_overwritten(state: Path) -> None:
    """A new run where there is the state of another one, finished or not: it may have taken hours.

    Raises ConfigError: there is one. WeightsError: there is one that cannot be read.
    """
    if not state.is_file():
        return
    stopped_at = unfinished_step(state)
    if stopped_at is None:
        raise ConfigError(
            f"{state}: a run has finished here; train it further with --resume and a larger budget, give the new run "
            "another --out, or delete that file to restart"
        )
    raise ConfigError(
        f"{state}: a run was stopped here at step {stopped_at}; go on with --resume, or delete that file to restart"
    )
