"""One gradient step's worth of loss: query views rendered from other views of the same scene.

``draw_batch`` makes all random draws, on the CPU; ``batch_loss`` computes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch

from research.train.view_draws import (
    degrade_view,
    join_sources,
    natural_weights,
    select_sources,
    withhold_labels,
)
from semantic_mapper.config import AtLeastOne, AtLeastTwo, AtLeastZero, Config, Fraction, SamplingConfig
from semantic_mapper.fields.base import MAX_SOURCE_VIEWS
from semantic_mapper.fields.device import to_device
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.views import EncodedViews
from semantic_mapper.training.losses import COLOUR, DEPTH, IGNORE, SEMANTIC, Loss, guess_loss, image_loss, ray_loss
from semantic_mapper.training.views import (
    LabelledView,
    RayTargets,
    draw_pixels,
    guided_rays,
    jitter_colours,
    mirrored_view,
    stack_sources,
    withhold_depth,
)
from semantic_mapper.types import RayBatch, SourceViews


class LossConfig(Config, frozen=True):
    """Weights of the parts of the loss."""

    semantic: float = SEMANTIC
    colour: float = COLOUR
    depth: float = DEPTH
    source: float = 0.25  # per-pixel class loss on labelled source views: teaches the shared encoder densely
    balance: float = 0.0  # of that loss, see ``image_loss``
    source_depth: float = 0.0  # on the depth that the field predicts for source views without any, see ``guess_loss``


class StepConfig(Config, frozen=True):
    """How a training step draws its views, rays and samples."""

    rays: AtLeastOne = 1024
    views_min: AtLeastOne = 3  # source views of a step are drawn from views_min..views_max
    views_max: AtLeastOne = 5
    own_view_fraction: Fraction = (
        0.3  # how often the query view is itself a source, as when the current frame is mapped
    )
    own_view_degraded: Fraction = (
        0.0  # how often that source is spoiled: blur, noise, exposure, covered parts, no depth
    )
    wide_fraction: Fraction = 0.0  # training: how often the nearer half of the path round the query has no source view
    balanced_fraction: Fraction = 0.5  # fraction of rays drawn with all classes equally likely
    natural_prior: bool = False  # rays count by how much likelier balancing made them: classes as frequent as they are
    depth_dropout: Fraction = 0.15  # fraction of source views, and of steps for the query's prior, without depth
    no_depth: Fraction = 0.0  # fraction of steps without any depth: neither source views nor prior have it
    known_labels: bool = True  # source views other than the query bring their labels, as keyframes of a finetuning do
    label_dropout: Fraction = 0.3  # fraction of source views without known labels
    prior_noise: AtLeastZero = 0.01  # sigma of the depth prior's error as a fraction of z
    samples_without_depth: AtLeastTwo = 32  # samples a ray in steps without a depth prior
    no_depth_thinning: AtLeastOne = (
        1  # in steps without a depth prior, where a ray costs more, one ray in n is rendered
    )
    colour_jitter: Fraction = 0.2
    mirrored: Fraction = 0.0  # fraction of steps in which the world is its mirror image
    loss: LossConfig = LossConfig()
    sampling: SamplingConfig = SamplingConfig()

    def __post_init__(self) -> None:
        if not 1 <= self.views_min <= self.views_max <= MAX_SOURCE_VIEWS:
            raise ValueError(
                f"need 1 <= views_min <= views_max <= {MAX_SOURCE_VIEWS}, got {self.views_min} and {self.views_max}"
            )


@dataclass(frozen=True, slots=True, eq=False)
class StepBatch:
    """What one query view of one scene brings to a step, on the training device.

    Args:
        sources: The source views, with what is withheld taken away.
        channel: (m, H, W) int64 labels of the source views, for the dense class loss; -1 = none.
        rays: R query rays.
        targets: What they should render to.
        z: (R, N) sample depths, ascending, metres.
        depth_m: (m, H, W) measured depth of the source views, also of those that the field is given none of.
    """

    sources: SourceViews
    channel: torch.Tensor
    rays: RayBatch
    targets: RayTargets
    z: torch.Tensor
    depth_m: torch.Tensor


def pick_views_on_path(
    queries: Sequence[int], count: int, config: StepConfig, generator: torch.Generator
) -> tuple[int, list[int]]:
    """Draw a query view of ``queries`` and its source views from ``count`` >= 2 views in the order of a camera's path.

    The source views are drawn from a stretch of the path round the query. Its length is drawn too, evenly on a
    logarithmic scale: from the nearest views alone (a dense recording) to the whole path (views far apart).
    """
    query = queries[int(torch.randint(len(queries), (1,), generator=generator))]
    others = sorted((i for i in range(count) if i != query), key=lambda i: abs(i - query))
    size = int(torch.randint(config.views_min, config.views_max + 1, (1,), generator=generator))
    size = max(1, min(size, len(others)))
    if config.wide_fraction > 0 and float(torch.rand(1, generator=generator)) < config.wide_fraction:
        others = others[min(len(others) // 2, len(others) - size) :]
    stretch = round(size * (len(others) / size) ** float(torch.rand(1, generator=generator)))
    order = torch.randperm(stretch, generator=generator)[:size].tolist()
    sources = [others[i] for i in order]
    if float(torch.rand(1, generator=generator)) < config.own_view_fraction:
        sources = [*sources[: max(0, size - 1)], query]
    return query, sources


def draw_batch(
    views: Sequence[LabelledView],
    query: int,
    sources: Sequence[int],
    config: StepConfig,
    generator: torch.Generator,
    classes: int,
    device: torch.device,
    resident: Sequence[LabelledView] | None = None,
) -> StepBatch | None:
    """Draw rays of ``views[query]`` and prepare ``views[sources]``; None where the query has no labelled pixel.

    Args:
        views: In host memory. The generator is of the CPU too, so that draws are the same whatever the device.
        classes: L of the label set.
        device: Of training.
        resident: The same views on ``device`` already; without them the sources are copied there.
    """
    if config.mirrored > 0 and float(torch.rand(1, generator=generator)) < config.mirrored:
        views = _mirrored(views, query, sources)
        resident = None if resident is None else _mirrored(resident, query, sources)
    blind = config.no_depth > 0 and float(torch.rand(1, generator=generator)) < config.no_depth
    drawn = draw_rays(views[query], config, generator, classes, blind=blind)
    if drawn is None:
        return None
    rays, targets, z = drawn
    stacked = _sources(resident or views, query, sources, config, generator)
    may_spoil = config.own_view_degraded > 0 and query in sources
    if may_spoil and float(torch.rand(1, generator=generator)) < config.own_view_degraded:
        stacked = degrade_view(stacked, list(sources).index(query), generator)
    stacked = withhold_depth(stacked, 1.0 if blind else config.depth_dropout, generator)
    stacked = jitter_colours(to_device(stacked, device), config.colour_jitter, generator)
    channel = torch.stack([(resident or views)[i].channel for i in sources])
    depth_m = torch.stack([(resident or views)[i].depth_m for i in sources])
    drawn = to_device(rays, device), to_device(targets, device), z.to(device)
    return StepBatch(stacked, channel.to(device), *drawn, depth_m.to(device))


def draw_rays(
    target: LabelledView, config: StepConfig, generator: torch.Generator, classes: int, *, blind: bool = False
) -> tuple[RayBatch, RayTargets, torch.Tensor] | None:
    """Rays of a view, what they should render to, and their sample depths; None where it has no labelled pixel.

    Args:
        classes: L of the label set.
        blind: Without depth priors.
    """
    flat = draw_pixels(target.channel, config.rays, config.balanced_fraction, generator, classes)
    if len(flat) == 0:
        return None
    rays, targets, z = guided_rays(
        target,
        flat,
        config.sampling,
        generator,
        noise=config.prior_noise,
        withheld=config.depth_dropout,
        samples_without_depth=config.samples_without_depth,
        blind=blind,
        thinning=config.no_depth_thinning,
    )
    if config.natural_prior:
        targets = replace(targets, weight=natural_weights(targets.channel, target.channel, config.balanced_fraction))
    return rays, targets, z


def batch_loss(
    model: LearnedField, batches: Sequence[StepBatch], config: LossConfig, *, encode_together: bool = False
) -> Loss:
    """Mean loss of several batches; gradients flow into the whole model.

    Args:
        encode_together: One call of ``encode`` for the views of all batches. Right only for kinds of fields that
            encode each view by itself; see ``encodes_views_separately``.
    """
    losses: list[Loss] = []
    for batch, encoded in zip(batches, _encode(model, batches, encode_together), strict=True):
        render, _ = model.render_samples(batch.rays, batch.z, encoded)
        loss = ray_loss(render, batch.targets, (config.semantic, config.colour, config.depth))
        if config.source > 0:
            logits = model.source_logits(encoded)
            if logits is not None:
                dense = image_loss(logits, batch.channel, config.balance)
                loss = replace(loss, total=loss.total + config.source * dense)
        if config.source_depth > 0 and encoded.geometry.any():  # a field without geometry holds zeros
            guess = guess_loss(encoded.geometry, batch.sources.depth_m, batch.depth_m)
            loss = replace(loss, total=loss.total + config.source_depth * guess)
        losses.append(loss)
    return mean_loss(losses)


def mean_loss(losses: Sequence[Loss]) -> Loss:
    """Mean of at least one loss, part by part."""
    if len(losses) == 1:
        return losses[0]
    parts = {f.name: torch.stack([getattr(loss, f.name) for loss in losses]).mean() for f in fields(Loss)}
    return Loss(**parts)


def encodes_views_separately(model: LearnedField, sources: SourceViews) -> bool:
    """Whether encoding ``sources`` (at least 2 views) together gives what encoding them in two calls gives."""
    first = torch.arange(len(sources.rgb)) < len(sources.rgb) // 2
    with torch.no_grad():
        together = model.encode(sources)
        for part in (first, ~first):
            index = part.nonzero()[:, 0].to(sources.rgb.device)
            alone = model.encode(select_sources(sources, index))
            for a, b in ((together.feature, alone.feature), (together.geometry, alone.geometry)):
                if float((a[index] - b).abs().max()) > 1e-2 * float(b.abs().max()):
                    return False
    return True


def _encode(model: LearnedField, batches: Sequence[StepBatch], together: bool) -> list[EncodedViews]:
    if not together or len(batches) == 1:
        return [model.encode(batch.sources) for batch in batches]
    encoded = model.encode(join_sources([batch.sources for batch in batches]))
    index = torch.arange(len(encoded), device=encoded.feature.device)
    return [encoded.select(part) for part in index.split([len(batch.sources.rgb) for batch in batches])]


def _mirrored(views: Sequence[LabelledView], query: int, sources: Sequence[int]) -> Sequence[LabelledView]:
    """The views of a step as their mirror images; the others are left as they are, for nobody looks at them."""
    wanted = {query, *sources}
    return [mirrored_view(view) if i in wanted else view for i, view in enumerate(views)]


def _sources(
    views: Sequence[LabelledView], query: int, sources: Sequence[int], config: StepConfig, generator: torch.Generator
) -> SourceViews:
    """The source views, with their labels if asked but for the query's own: a robot's current frame has none."""
    stacked = stack_sources([views[i] for i in sources], with_labels=config.known_labels)
    if stacked.channel is None:
        return stacked
    own = torch.tensor([i == query for i in sources], device=stacked.channel.device)
    stacked = replace(stacked, channel=torch.where(own[:, None, None], IGNORE, stacked.channel))
    return withhold_labels(stacked, config.label_dropout, generator)
