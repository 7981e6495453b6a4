"""Weights that a training run starts from instead of random ones."""

from __future__ import annotations

from pathlib import Path

import structlog

from semantic_mapper.config import to_plain
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.checkpoint import load_checkpoint
from semantic_mapper.fields.learned import LearnedField

_log = structlog.get_logger(__name__)


def take_over(field: LearnedField, path: Path) -> None:
    """Copy all weights of a file into ``field``.

    Raises:
        WeightsError: they cannot be read.
        ConfigError: they are of another kind, shape or label set.
    """
    start = load_checkpoint(path).model
    own = (field.kind, to_plain(field.config), field.label_set)
    if (start.kind, to_plain(start.config), start.label_set) != own:
        raise ConfigError(f"{path}: weights of another field than the config names, or of other classes")
    field.load_state_dict(start.state_dict())
    _log.info("training_starts_from", weights=path.name)


def take_over_encoder(field: LearnedField, path: Path) -> None:
    """Copy the image encoder of a file, whatever its kind, into ``field``.

    Raises:
        WeightsError: the file cannot be read.
        ConfigError: one of the two has no image encoder, or they differ in shape.
    """
    theirs, own = load_checkpoint(path).model.image_encoder, field.image_encoder
    if theirs is None or own is None:
        raise ConfigError(f"{path}: encoder_from needs fields with image encoders on both sides")
    weights = theirs.state_dict()
    shapes = {name: tensor.shape for name, tensor in own.state_dict().items()}
    if {name: tensor.shape for name, tensor in weights.items()} != shapes:
        raise ConfigError(f"{path}: its image encoder has another shape than the config asks for ([field.encoder])")
    own.load_state_dict(weights)
    _log.info("encoder_taken_over", weights=path.name)
