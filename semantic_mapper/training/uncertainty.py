"""Where in its training images a field is in doubt: finetuning sends more rays there."""

from __future__ import annotations

# pyright: reportUnknownMemberType=false
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch.nn import functional

from semantic_mapper.fields.device import to_device
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.training.losses import IGNORE
from semantic_mapper.training.views import LabelledView, stack_sources

LEAST = 0.02  # doubt of a pixel that the field is sure of and right about: it may still be drawn


def with_uncertainty(model: LearnedField, views: Sequence[LabelledView]) -> list[LabelledView]:
    """The views with 1 - p(their label) at each labelled pixel, from the image features alone.

    Views of a kind of field that says nothing of images by themselves come back as they are.
    """
    device = next(model.parameters()).device
    training = model.training
    model.eval()
    with torch.inference_mode():
        logits = model.source_logits(model.encode(to_device(stack_sources(views), device)))
    model.train(training)
    if logits is None:
        return list(views)
    size = tuple(views[0].channel.shape)
    fraction = functional.interpolate(torch.softmax(logits, 1), size=size, mode="bilinear", align_corners=False).cpu()
    channel = torch.stack([view.channel for view in views])
    right = fraction.gather(1, channel.clamp_min(0)[:, None])[:, 0]
    doubt = torch.where(channel == IGNORE, 0.0, (1 - right).clamp_min(LEAST))
    return [replace(view, uncertainty=d.clone()) for view, d in zip(views, doubt, strict=True)]
