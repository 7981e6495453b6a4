"""One gradient step's worth of loss: a query view rendered from other views of the same scene. Shared by training and
finetuning."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch.nn import functional

from semantic_mapper.config import Config, SamplingConfig
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.sampling import sample_guided, sample_inverse_depth
from semantic_mapper.training.losses import IGNORE, Loss, LossConfig, ray_loss
from semantic_mapper.training.views import (
    LabelledView,
    RayTargets,
    draw_pixels,
    jitter_colours,
    query_rays,
    stack_sources,
    to_device,
    withhold_depth,
    withhold_labels,
)
from semantic_mapper.types import RayBatch, SourceViews


class StepConfig(Config, frozen=True):
    """How a training step draws its views, rays and samples."""

    rays: int = 1024
    views_min: int = 3  # source views of a step are drawn from views_min..views_max
    views_max: int = 5
    own_view_share: float = 0.3  # how often the query view is itself a source, as when the current frame is mapped
    balanced_share: float = 0.5  # share of rays drawn with all classes equally likely
    depth_withheld: float = 0.15  # share of source views, and of steps for the query's prior, without depth
    labels_withheld: float = 0.3  # share of source views without known labels
    prior_noise: float = 0.01  # sigma of the depth prior's error as a share of z
    blind_samples: int = 32  # samples a ray in steps without a depth prior
    colour_jitter: float = 0.2
    loss: LossConfig = LossConfig()
    sampling: SamplingConfig = SamplingConfig()


def pick_views(count: int, config: StepConfig, generator: torch.Generator) -> tuple[int, list[int]]:
    """Draw a query view and its source views from ``count`` views of one scene."""
    order = torch.randperm(count, generator=generator).tolist()
    query, others = order[0], order[1:]
    size = int(torch.randint(config.views_min, config.views_max + 1, (1,), generator=generator))
    sources = others[: max(1, size)] or [query]
    if float(torch.rand(1, generator=generator)) < config.own_view_share:
        sources = [*sources[: max(0, size - 1)], query]
    return query, sources


def training_loss(
    model: LearnedField,
    views: Sequence[LabelledView],
    query: int,
    sources: Sequence[int],
    config: StepConfig,
    generator: torch.Generator,
) -> Loss | None:
    """Loss of rays of ``views[query]`` rendered from ``views[sources]``; None where the query has no labelled pixel.

    Gradients flow into the whole model.
    """
    device = next(model.parameters()).device
    target = views[query]
    flat = draw_pixels(target.channel, config.rays, config.balanced_share, generator, len(model.label_set))
    if len(flat) == 0:
        return None
    stacked = withhold_depth(_sources(views, query, sources, config, generator), config.depth_withheld, generator)
    stacked = jitter_colours(stacked, config.colour_jitter, generator)
    encoded = model.encode(to_device(stacked, device))
    rays, targets, z = _draw_samples(target, flat, config, generator)
    rays, targets, z = to_device(rays, device), to_device(targets, device), z.to(device)
    render, _ = model.render_samples(rays, z, encoded)
    loss = ray_loss(render, targets, config.loss)
    if config.loss.source > 0:
        total = loss.total + config.loss.source * _source_loss(model, encoded, [views[i] for i in sources])
        loss = replace(loss, total=total)
    return loss


def _sources(
    views: Sequence[LabelledView], query: int, sources: Sequence[int], config: StepConfig, generator: torch.Generator
) -> SourceViews:
    """The source views with their labels, but for the query's own: a robot's current frame has none."""
    stacked = stack_sources([views[i] for i in sources], with_labels=True)
    assert stacked.channel is not None
    own = torch.tensor([i == query for i in sources])
    stacked = replace(stacked, channel=torch.where(own[:, None, None], IGNORE, stacked.channel))
    return withhold_labels(stacked, config.labels_withheld, generator)


def _draw_samples(
    target: LabelledView, flat: torch.Tensor, config: StepConfig, generator: torch.Generator
) -> tuple[RayBatch, RayTargets, torch.Tensor]:
    depth = target.depth_m.flatten()[flat]
    noise = 1 + config.prior_noise * torch.randn(len(flat), generator=generator)
    rays, targets = query_rays(
        target, flat, near_m=config.sampling.near_m, far_m=config.sampling.far_m, prior=depth * noise
    )
    if float(torch.rand(1, generator=generator)) < config.depth_withheld:
        z = sample_inverse_depth(rays.near_m, rays.far_m, config.blind_samples, generator)
    else:
        z = sample_guided(rays, config.sampling)
    return rays, targets, z


def _source_loss(model: LearnedField, encoded: EncodedViews, sources: Sequence[LabelledView]) -> torch.Tensor:
    """Class loss of the image features by themselves."""
    logits = model.source_logits(encoded)
    if logits is None:
        return encoded.feature.new_zeros(())
    device, size = logits.device, logits.shape[-2:]
    channel = torch.stack([v.channel for v in sources]).to(device)
    small = functional.interpolate(channel[:, None].float(), size=size, mode="nearest-exact")[:, 0].long()
    counted = (small != IGNORE).sum().clamp_min(1)
    return functional.cross_entropy(logits, small, ignore_index=IGNORE, reduction="sum") / counted
