"""The losses of finetuning's steps: of rays of a query view rendered from other views, and of single images.

All draws are made on the CPU, so that they are the same whatever the device.
"""

from __future__ import annotations

# pyright: reportUnknownMemberType=false
from collections.abc import Sequence
from dataclasses import replace

import torch

from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.device import to_device
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.volume import around_computed, sample_guided, sample_inverse_depth
from semantic_mapper.training.config import StepConfig
from semantic_mapper.training.losses import IGNORE, guess_loss, image_loss, ray_loss
from semantic_mapper.training.views import (
    LabelledView,
    RayTargets,
    draw_pixels,
    jitter_colours,
    mirrored_view,
    query_rays,
    stack_sources,
    withhold_depth,
)
from semantic_mapper.types import RayBatch

LEAST_WORTH = 0.05  # of a view that sees nothing of the query: it may still be drawn, to learn what is no use
VIEWS_MIN, VIEWS_MAX = 3, 5  # source views of a step
OWN_VIEW_FRACTION = 0.3  # how often the query view is itself a source, as when the current frame is mapped
BALANCED_FRACTION = 0.5  # of rays drawn with all classes equally likely
DEPTH_DROPOUT = 0.15  # fraction of source views, and of steps for the query's prior, without depth
LABEL_DROPOUT = 0.3  # fraction of source views without known labels
PRIOR_NOISE = 0.01  # sigma of the depth prior's error as a fraction of z
COLOUR_JITTER = 0.2
SOURCE_LOSS = 0.25  # weight of the class loss on labelled source views: teaches the encoder densely
IMAGES = 4  # of a step on single images
MIRRORED = 0.5  # of them
IMAGE_BALANCE, IMAGE_DEPTH = 0.25, 0.05  # of steps on images: see ``image_loss``; weight of ``guess_loss``
PROBE_RATE = 0.03  # of Adam: rows of classes that are new to the weights start from nothing
PROBE_BALANCE = 0.5  # see ``image_loss``


def pick_views(
    queries: Sequence[int],
    overlap: torch.Tensor,
    generator: torch.Generator,
    own_view_fraction: float = OWN_VIEW_FRACTION,
) -> tuple[int, list[int]]:
    """Draw a query view of ``queries``, and its source views: the more one sees of the query, the likelier it is.

    Args:
        overlap: (n, n) of ``view_overlap``, of all views of one scene.
    """
    query = queries[int(torch.randint(len(queries), (1,), generator=generator))]
    worth = overlap[query] + LEAST_WORTH
    worth[query] = 0
    size = int(torch.randint(VIEWS_MIN, VIEWS_MAX + 1, (1,), generator=generator))
    size = max(1, min(size, len(overlap) - 1))
    sources = torch.multinomial(worth, size, generator=generator).tolist() if len(overlap) > 1 else [query]
    if float(torch.rand(1, generator=generator)) < own_view_fraction:
        sources = [*sources[: max(0, size - 1)], query]
    return query, sources


def step_on_rays(
    model: LearnedField,
    views: Sequence[LabelledView],
    query: int,
    sources: Sequence[int],
    config: StepConfig,
    generator: torch.Generator,
    encoded: EncodedViews | None = None,
) -> torch.Tensor | None:
    """Loss of rays of ``views[query]`` rendered from ``views[sources]``; None where the query has no labelled pixel.

    Gradients flow into the whole model; with ``encoded``, into all but what ``encode`` does.

    Args:
        encoded: Of ``encode_once``: the image encoder is frozen. Colours are not jittered and no depth of source views
            is withheld then: both would need features of their own.
    """
    drawn = draw_rays(views[query], config, generator, len(model.label_set))
    if drawn is None:
        return None
    device = next(model.parameters()).device
    rays, targets, z = to_device(drawn[0], device), to_device(drawn[1], device), drawn[2].to(device)
    if encoded is None:
        stacked = stack_sources([views[i] for i in sources], with_labels=config.known_labels)
        if stacked.channel is not None:
            stacked = replace(stacked, channel=_withheld(stacked.channel, query, sources, generator))
        stacked = withhold_depth(stacked, DEPTH_DROPOUT, generator)
        chosen = model.encode(jitter_colours(to_device(stacked, device), COLOUR_JITTER, generator))
    else:
        chosen = encoded.select(torch.tensor(list(sources), device=device))
        if config.known_labels:
            chosen = replace(chosen, channel=_withheld(chosen.channel, query, sources, generator))
    render, _ = model.render_samples(rays, z, chosen)
    loss = ray_loss(render, targets).total
    logits = model.source_logits(chosen)
    if logits is None:
        return loss
    channel = torch.stack([views[i].channel for i in sources]).to(device)
    return loss + SOURCE_LOSS * image_loss(logits, channel, 0.0)


def _withheld(channel: torch.Tensor, query: int, sources: Sequence[int], generator: torch.Generator) -> torch.Tensor:
    """Known labels (m, H, W) of the sources without those of a random fraction, and without the query's own: a robot's
    current frame has none."""
    keep = torch.rand(len(sources), generator=generator) >= LABEL_DROPOUT
    keep &= torch.tensor([i != query for i in sources])
    return torch.where(keep.to(channel.device)[:, None, None], channel, IGNORE)


def draw_rays(
    target: LabelledView, config: StepConfig, generator: torch.Generator, classes: int
) -> tuple[RayBatch, RayTargets, torch.Tensor] | None:
    """Rays of a view, what they should render to, and their sample depths; None where it has no labelled pixel.

    Args:
        classes: L of the label set.
    """
    flat = draw_pixels(target.channel, config.rays, BALANCED_FRACTION, generator, classes)
    if len(flat) == 0:
        return None
    noise = 1 + PRIOR_NOISE * torch.randn(len(flat), generator=generator)
    withheld = float(torch.rand(1, generator=generator)) < DEPTH_DROPOUT
    near_m, far_m = config.sampling.near_m, config.sampling.far_m
    depth_m = target.depth_m if target.computed_m is None else target.computed_m
    if withheld or not bool((depth_m > 0).any()):
        rays, targets = query_rays(target, flat, near_m=near_m, far_m=far_m, prior=None)
        return rays, targets, sample_inverse_depth(rays.near_m, rays.far_m, config.samples_without_depth, generator)
    # Computed depth has errors of its own.
    prior = depth_m.flatten()[flat] * noise if target.computed_m is None else depth_m.flatten()[flat]
    rays, targets = query_rays(target, flat, near_m=near_m, far_m=far_m, prior=prior)
    sampling = config.sampling if target.computed_m is None else around_computed(config.sampling)
    return rays, targets, sample_guided(rays, sampling)


def classifies_images(model: LearnedField) -> bool:
    """Whether a field of this kind says anything of single images."""
    # The class decides: the field itself would need views to encode, which are still missing where a run is checked.
    return type(model).source_logits is not LearnedField.source_logits


def step_on_images(model: LearnedField, views: Sequence[LabelledView], generator: torch.Generator) -> torch.Tensor:
    """Loss of what a field that classifies images makes of some of the views, each by itself.

    An image costs a fraction of what rays from several views cost; gradients flow into the encoder and the classifier.
    """
    views = [views[i] for i in torch.randperm(len(views), generator=generator).tolist()[:IMAGES]]
    views = [mirrored_view(v) if float(torch.rand(1, generator=generator)) < MIRRORED else v for v in views]
    # All without depth or none: norms take their statistics from images of one kind.
    colours_only = float(torch.rand(1, generator=generator)) < DEPTH_DROPOUT
    stacked = stack_sources(views, with_labels=True)
    device = next(model.parameters()).device
    sources = withhold_depth(replace(stacked, channel=None), float(colours_only), generator)
    sources = jitter_colours(to_device(sources, device), COLOUR_JITTER, generator)
    encoder = model.image_encoder
    assert encoder is not None and stacked.channel is not None
    with encoder.batch_statistics():
        encoded = model.encode(sources)
        logits = model.source_logits(encoded)
    assert logits is not None
    loss = image_loss(logits, stacked.channel.to(device), IMAGE_BALANCE)
    if encoded.geometry.any():  # a field without geometry holds zeros
        # Images without depth learn to guess it.
        loss = loss + IMAGE_DEPTH * guess_loss(encoded.geometry, sources.depth_m, stacked.depth_m.to(device))
    return loss


def encode_once(model: LearnedField, views: Sequence[LabelledView], *, with_labels: bool) -> EncodedViews:
    """All views, with their labels or without, but without gradients; on the model's device."""
    device = next(model.parameters()).device
    with torch.no_grad():
        return model.encode(to_device(stack_sources(views, with_labels=with_labels), device))


def fit_class_rows(model: LearnedField, encoded: EncodedViews, views: Sequence[LabelledView], steps: int) -> bool:
    """Fit the class rows of ``model`` to the labelled pixels of ``views``; nothing else changes.

    Convex, since the classifier is linear, and cheap, since nothing is rendered or encoded: what is left for the steps
    on rays is what they alone can do. Kinds of fields that say nothing of images by themselves are left as they are.

    Args:
        encoded: The same views, encoded by ``model``.
        views: Their labels count, at the size of the features.
        steps: Over all views at once.

    Returns:
        Whether anything was fitted.
    """
    rows = [model.get_parameter(name) for name in model.class_rows]
    channel = torch.stack([view.channel for view in views]).to(encoded.feature.device)
    optimiser = torch.optim.Adam(rows, PROBE_RATE)
    for _ in range(steps):
        logits = model.source_logits(encoded)
        if logits is None:
            return False
        gradients = torch.autograd.grad(image_loss(logits, channel, PROBE_BALANCE), rows)
        for row, gradient in zip(rows, gradients, strict=True):
            row.grad = gradient
        optimiser.step()
    optimiser.zero_grad()
    return steps > 0
