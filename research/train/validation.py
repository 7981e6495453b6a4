"""How good a field is on rooms that it is not trained on, with and without depth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import torch

from research.scenes import VALIDATION_SEEDS
from research.train.ranks import Ranks
from research.train.rooms import RoomPoolConfig, RoomViews, render_room
from research.train.step import StepConfig
from semantic_mapper.config import Config
from semantic_mapper.errors import ConfigError
from semantic_mapper.fields.device import to_device
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.volume import sample_guided, sample_inverse_depth
from semantic_mapper.training.views import LabelledView, query_rays, stack_sources


class ValidationConfig(Config, frozen=True):
    """Which views of the validation rooms are rendered, and how often."""

    times: int = 8  # over the whole budget
    rooms: int = 6  # the first ones of the validation seeds
    queries: int = 2  # views a room
    rays: int = 1000  # a view; without depth one in ``no_depth_thinning`` of them
    views: int = 8  # source views, the nearest on the path


@dataclass(frozen=True, slots=True)
class Scores:
    """Shares in 0..1 over all rays of a validation; ``blind``: source views and rays without any depth."""

    miou: float
    accuracy: float
    blind_miou: float
    blind_accuracy: float

    @property
    def rank(self) -> float:
        """What decides which weights are kept: one set has to do with and without depth, so both count alike."""
        return (self.miou + self.blind_miou) / 2


def validation_rooms(
    config: ValidationConfig, pool: RoomPoolConfig, ranks: Ranks, device: torch.device
) -> list[RoomViews]:
    """This rank's fraction of the validation rooms. Raises ConfigError: more rooms than there are, or none."""
    if not 1 <= config.rooms <= len(VALIDATION_SEEDS) or config.queries < 1 or config.views < 1 or config.rays < 1:
        raise ConfigError(f"ValidationConfig: need 1 to {len(VALIDATION_SEEDS)} rooms, and queries, views and rays")
    pool = msgspec.structs.replace(pool, computed_depth=0.0)  # scores are those with measured depth and without any
    seeds = VALIDATION_SEEDS[: config.rooms]
    return [render_room(seed, pool, device) for seed in seeds[ranks.rank :: ranks.world]]


def validate(
    model: LearnedField, rooms: Sequence[RoomViews], config: ValidationConfig, step: StepConfig, ranks: Ranks
) -> Scores:
    """Render rays of views that are no source views; all ranks together, and every rank gets the same scores.

    The rules are those of ``evaluation.metrics``: means over the classes that occur, "unknown" counts as wrong. Counted
    here on the training device, because that package needs more than a training machine has.

    Args:
        rooms: This rank's share.
        step: Says where rays are sampled.
    """
    classes = len(model.label_set)
    counts = torch.zeros(2, classes, classes + 1, dtype=torch.int64)
    model.eval()
    with torch.inference_mode():
        for room in rooms:
            generator = torch.Generator().manual_seed(room.seed)
            for query in _queries(room, config.queries):
                counts += _count(model, room, query, config, step, generator)
    model.train()
    counts = ranks.total(counts)
    return Scores(*_figures(counts[0]), *_figures(counts[1]))


def _queries(room: RoomViews, count: int) -> list[int]:
    """Evenly spread over the labelled views of the path, none at its ends."""
    labelled = room.labelled
    return sorted({labelled[(2 * k + 1) * len(labelled) // (2 * count)] for k in range(count)}) if labelled else []


def _count(
    model: LearnedField,
    room: RoomViews,
    query: int,
    config: ValidationConfig,
    step: StepConfig,
    generator: torch.Generator,
) -> torch.Tensor:
    """(2, L, L + 1) counts of (truth, prediction) with and without depth; the last column is "unknown"."""
    device = next(model.parameters()).device
    near_m, far_m = step.sampling.near_m, step.sampling.far_m
    others = sorted((i for i in range(len(room.views)) if i != query), key=lambda i: abs(i - query))[: config.views]
    if model.needs_own_view:
        others = [*others[: config.views - 1], query]
    sources = stack_sources([room.resident[i] for i in others])
    view: LabelledView = room.views[query]
    flat = (view.channel.flatten() >= 0).nonzero()[:, 0]
    flat = flat[torch.randint(len(flat), (config.rays,), generator=generator)]
    classes = len(model.label_set)
    counts: list[torch.Tensor] = []
    for blind in (False, True):
        chosen = flat[:: step.no_depth_thinning] if blind else flat  # a ray without a prior costs more, as in training
        prior = None if blind else view.depth_m.flatten()[chosen]
        rays, targets = query_rays(view, chosen, near_m=near_m, far_m=far_m, prior=prior)
        rays = to_device(rays, device)
        seen = replace(sources, depth_m=torch.zeros_like(sources.depth_m)) if blind else sources
        if blind:
            z = sample_inverse_depth(rays.near_m, rays.far_m, step.samples_without_depth)
        else:
            z = sample_guided(rays, step.sampling)
        render, _ = model.render_samples(rays, z, model.encode(seen))
        predicted = torch.where(render.known, render.logits.argmax(1), classes).cpu()
        cells = targets.channel * (classes + 1) + predicted
        counts.append(torch.bincount(cells, minlength=classes * (classes + 1)).view(classes, classes + 1))
    return torch.stack(counts)


def _figures(counts: torch.Tensor) -> tuple[float, float]:
    """mIoU and accuracy; NaN where nothing was counted."""
    right = counts[:, :-1].diagonal().double()
    occurring = counts.sum(1)
    union = occurring + counts[:, :-1].sum(0) - right
    if not bool(occurring.any()):
        return math.nan, math.nan
    return float((right / union)[occurring > 0].mean()), float(right.sum() / occurring.sum())
