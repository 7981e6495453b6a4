"""Steps of a finetuning with a frozen image encoder: features are computed once, a step costs its rays only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.device import to_device
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.training.losses import IGNORE, Loss, image_loss, ray_loss
from semantic_mapper.training.step import StepConfig, draw_rays
from semantic_mapper.training.views import LabelledView, stack_sources


def encode_once(model: LearnedField, views: Sequence[LabelledView], *, with_labels: bool) -> EncodedViews:
    """All views, with their labels or without, but without gradients; on the model's device."""
    device = next(model.parameters()).device
    with torch.no_grad():
        return model.encode(to_device(stack_sources(views, with_labels=with_labels), device))


def frozen_encoder_loss(
    model: LearnedField,
    encoded: EncodedViews,
    views: Sequence[LabelledView],
    query: int,
    sources: Sequence[int],
    config: StepConfig,
    generator: torch.Generator,
) -> Loss | None:
    """As ``training_loss``, from ``encode_once``; None where the query has no labelled pixel.

    Gradients flow into all but what ``encode`` does. Colours are not jittered and no depth of source views is withheld:
    both would need features of their own.
    """
    device = encoded.feature.device
    drawn = draw_rays(views[query], config, generator, len(model.label_set))
    if drawn is None:
        return None
    rays, targets, z = drawn
    chosen = encoded.select(torch.tensor(list(sources), device=device))
    if config.known_labels:
        chosen = replace(chosen, channel=_withheld(chosen.channel, query, sources, config, generator))
    render, _ = model.render_samples(to_device(rays, device), z.to(device), chosen)
    loss = ray_loss(render, to_device(targets, device), config.loss)
    logits = model.source_logits(chosen) if config.loss.source > 0 else None
    if logits is None:
        return loss
    channel = torch.stack([views[i].channel for i in sources]).to(device)
    return replace(loss, total=loss.total + config.loss.source * image_loss(logits, channel, config.loss.balance))


def _withheld(
    channel: torch.Tensor, query: int, sources: Sequence[int], config: StepConfig, generator: torch.Generator
) -> torch.Tensor:
    """Known labels (m, H, W) of the sources without the query's own and those of a random fraction of the others."""
    keep = torch.rand(len(sources), generator=generator) >= config.label_dropout
    keep &= torch.tensor([i != query for i in sources])
    return torch.where(keep.to(channel.device)[:, None, None], channel, IGNORE)
