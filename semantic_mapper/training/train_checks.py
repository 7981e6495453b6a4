"""What is wrong with a training run before it begins: rooms take a while to render, and nobody should wait for a no."""

from __future__ import annotations

from pathlib import Path

from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.scenes import TRAIN_SEEDS
from semantic_mapper.training.images import encoder_for_images
from semantic_mapper.training.train_config import TrainConfig
from semantic_mapper.training.train_state import unfinished_step


def check_settings(config: TrainConfig) -> None:
    """Numbers that make no sense, whatever the kind of field.

    Raises:
        ConfigError: there are such.
    """
    if config.seconds <= 0 and config.steps <= 0:
        raise ConfigError("training needs a budget: set seconds, steps, or both")
    if config.rooms_per_step < 1 or config.log_steps < 1:
        raise ConfigError("rooms_per_step and log_steps must be at least 1")
    if not 0 <= config.seed < len(TRAIN_SEEDS):
        raise ConfigError(f"seed must be in 0..{len(TRAIN_SEEDS) - 1}, got {config.seed}")
    step = config.step
    if not 1 <= step.views_min <= step.views_max or step.rays < 1 or step.blind_thinning < 1:
        raise ConfigError("step: need 1 <= views_min <= views_max, rays >= 1 and blind_thinning >= 1")


def check_field(field: LearnedField, config: TrainConfig) -> None:
    """A field that cannot learn from the steps that the config asks for.

    Raises:
        ConfigError: it is such a one.
    """
    if field.image_encoder is None:
        # What it renders does not depend on the source views: it would learn the mean of all rooms.
        raise ConfigError(
            f"a field of kind '{field.kind}' holds a single scene in its weights, so it has nothing to learn for other "
            f"rooms; `semantic-mapper eval --suite rooms --protocol scratch --kind {field.kind}` fits it room by room"
        )
    if config.images.share > 0:
        encoder_for_images(field)


def check_nothing_is_overwritten(state: Path) -> None:
    """A new run where there is the state of another one, finished or not: it may have taken hours.

    Raises:
        ConfigError: there is one.
        WeightsError: there is one that cannot be read.
    """
    if not state.is_file():
        return
    stopped_at = unfinished_step(state)
    if stopped_at is None:
        raise ConfigError(
            f"{state}: a run has finished here; train it further with --resume and a larger budget, give the new run "
            "another --out, or delete that file to start anew"
        )
    raise ConfigError(
        f"{state}: a run was stopped here at step {stopped_at}; go on with --resume, or delete that file to start anew"
    )
