"""Steps on single images: the image encoder learns the classes before any ray is cast.

An image costs a fraction of what a step of rays from several views costs, and a step holds images of many rooms. So an
encoder learns several times faster this way, and the rays start from features that mean something.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from research.train.appearance import strew, vary_appearance
from semantic_mapper.config import AtLeastOne, Config, Fraction, Positive
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.device import to_device
from semantic_mapper.fields.encoder import ImageEncoder
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.training.losses import Loss, guess_loss, image_loss
from semantic_mapper.training.views import (
    LabelledView,
    jitter_colours,
    stack_sources,
    withhold_depth,
)
from semantic_mapper.types import SourceViews


class ImageStepConfig(Config, frozen=True):
    """The first part of training, on single images."""

    fraction: Fraction = 0.5  # of the budget; 0 = rays from the first step on
    later: Fraction = 0.0  # fraction of the steps after that which are still on images, at the rate of rays
    rooms: AtLeastOne = 8  # a step, of a rank
    images: AtLeastOne = 2  # of each
    learning_rate: Positive = 2e-3
    colours_first: Fraction = (
        0.5  # of this part, without any depth; the network that sees depth then grows from the other
    )
    # After that the network for colours rests: trained on a fraction of the images only, it would get worse. Then all
    # images have depth. False: it goes on with the images of ``depth_dropout``.
    frozen_colours: bool = True
    depth_dropout: Fraction = 0.3  # fraction of images without depth after that
    mirrored: Fraction = 0.5  # fraction of images
    cropped: Fraction = 0.0  # fraction of images of which a part is shown, half to all of each side, at full size
    colour_jitter: float = 0.25
    appearance: Fraction = 0.0  # fraction of images with another light, texture and sharpness; see ``appearance``
    clutter: Fraction = 0.0  # fraction of images with pieces of others strewn on them; see ``appearance.strew``
    balance: Fraction = 0.25  # see ``losses.image_loss``
    depth: float = 0.05  # weight of ``losses.guess_loss``: images without depth learn it, too


@dataclass(frozen=True, slots=True, eq=False)
class ImageBatch:
    """Images of several rooms, on the training device.

    Args:
        views: As the field is given them.
        channel: (m, H, W) int64, -1 = ignore.
        depth_m: (m, H, W) as the sensor measured it, also where the field is given none.
    """

    views: SourceViews
    channel: torch.Tensor
    depth_m: torch.Tensor


def image_batch(
    views: Sequence[LabelledView],
    config: ImageStepConfig,
    generator: torch.Generator,
    device: torch.device,
    *,
    colours_only: bool,
) -> ImageBatch:
    """These views as a step is given them, appearance and depth varied as ``config`` says.

    Args:
        colours_only: None of them with depth.
    """
    stacked = stack_sources(views, with_labels=True)
    assert stacked.channel is not None
    withheld = 1.0 if colours_only else 0.0 if config.frozen_colours else config.depth_dropout
    sources = withhold_depth(replace(stacked, channel=None), withheld, generator)
    sources = jitter_colours(to_device(sources, device), config.colour_jitter, generator)
    channel, depth_m = stacked.channel.to(device), stacked.depth_m.to(device)
    if config.clutter > 0:
        sources, channel = strew(sources, channel, config.clutter, generator)
        depth_m = depth_m * (channel >= 0)  # of what a piece hides, nothing is to be learned
    if config.appearance > 0:
        sources = vary_appearance(sources, channel, config.appearance, generator)
    return ImageBatch(sources, channel, depth_m)


def images_loss(model: LearnedField, batch: ImageBatch, config: ImageStepConfig) -> Loss:
    """Class loss of the images by themselves; gradients flow into the encoder and the classifier.

    Raises ConfigError: a kind of field that says nothing of an image by itself.
    """
    encoder = encoder_for_images(model)
    with encoder.batch_statistics():
        encoded = model.encode(batch.views)
        logits = model.source_logits(encoded)
    assert logits is not None  # or there would be no such encoder
    loss = image_loss(logits, batch.channel, config.balance)
    depth = torch.zeros_like(loss)
    if config.depth > 0 and encoded.geometry.any():  # a field without geometry holds zeros
        depth = guess_loss(encoded.geometry, batch.views.depth_m, batch.depth_m)
    return Loss(loss + config.depth * depth, loss, torch.zeros_like(loss), depth)


def encoder_for_images(model: LearnedField) -> ImageEncoder:
    """The image encoder of a field, where it can learn from single images.

    Raises ConfigError: a kind of field that says nothing of an image by itself.
    """
    encoder = model.image_encoder
    if encoder is None or not model.classifies_images:
        raise ConfigError(
            f"a field of kind '{model.kind}' does not classify single images, so it can only learn from rays: set "
            "fraction = 0 under [images] in the file that --config names, as recipes/cpu-rays.toml does, and take "
            "over a trained image encoder with --encoder"
        )
    return encoder
