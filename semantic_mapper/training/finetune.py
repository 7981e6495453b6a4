"""Few-step finetuning on labelled keyframes of one scene (S-Ray section 4.2).

Held-out rays decide which weights are kept.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from semantic_mapper.config import SRayConfig, to_plain
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.checkpoint import Checkpoint, adapt_model, anchor_from_frame
from semantic_mapper.fields.device import choose_device, encoder_in_bfloat16, to_device
from semantic_mapper.fields.encoder import calibrate
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.volume import sample_guided
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.config import FinetuneConfig
from semantic_mapper.training.fit import (
    BestWeights,
    Budget,
    HeldOut,
    OnProgress,
    cosine_rate,
    fit,
    make_optimiser,
    set_rates,
)
from semantic_mapper.training.losses import IGNORE, semantic_loss
from semantic_mapper.training.step import (
    classifies_images,
    encode_once,
    fit_class_rows,
    pick_views,
    step_on_images,
    step_on_rays,
)
from semantic_mapper.training.views import (
    LabelledView,
    draw_pixels,
    query_rays,
    stack_sources,
    view_from_frame,
    view_overlap,
)
from semantic_mapper.types import PosedFrame

_log = get_logger(__name__)

FINAL_LEARNING_RATE, WEIGHT_DECAY, GRADIENT_CLIP = 5e-5, 1e-4, 10.0
PROBE_STEPS = 40  # of the classifier alone, on features as they are, before the first ray
HELD_OUT_BLOCK = 16  # pixels a side: single held-out pixels would be known from their neighbours
FEW_STEPS = 10  # fewer are worth a warning: a slow machine, or a small budget
HELD_OUT_RAYS = 6144  # over all keyframes: a look must not cost more the more keyframes there are
HELD_OUT_SOURCES = 7  # that a held-out ray is rendered from, next to its own image: those that see most of its view
# Times that the own image counts among the views after steps on images; without measured depth nearly alone, because
# the other views may look at something else there (docs/decisions/0018-images-in-finetuning.md).
OWN_VIEW_FACTOR = 4.0
OWN_VIEW_FACTOR_WITHOUT_DEPTH = 1e3


@dataclass(slots=True)
class _Scene:
    """The views to learn from (held-out blocks ignored), the same to look at (all else ignored), and who sees whom.

    Args:
        queries: Views with something to learn; the others are source views only.
        overlap: (n, n) of ``view_overlap``.
    """

    train: Sequence[LabelledView]
    held_out: Sequence[LabelledView]
    queries: Sequence[int]
    overlap: torch.Tensor


def finetune(
    frames: Sequence[PosedFrame],
    label_set: LabelSet,
    start: LearnedField | None,
    config: FinetuneConfig,
    on_progress: OnProgress | None = None,
    stopped: Callable[[], object] = bool,
    seen_stamps_ns: Iterable[int] = (),
) -> Checkpoint:
    """Fit a field to the labelled keyframes ``frames``; never worse on held-out rays than where it started.

    Args:
        frames: Keyframes with poses; at least 2, one of them labelled. Those without labels are source views only.
        label_set: Classes of their labels, and of the result.
        start: Weights to start from, adapted to ``label_set`` by class name; None = random. A field of which nothing is
            trained yet learns with batch norms that are alive.
        config: At least one of ``seconds`` and ``steps`` set.
        on_progress: Called after every step.
        stopped: Called before every step; once it returns anything true, the best weights so far are the result.
        seen_stamps_ns: Frames that ``start`` was fitted to; the result remembers them with its own.

    Raises:
        FrameError: fewer than two frames, or none with labels.
        ConfigError: no budget, or no GPU where one is requested.
    """
    check_budget(config)
    labelled = [f for f in frames if f.label is not None]
    if len(frames) < 2 or not labelled:
        raise FrameError(
            f"finetuning needs at least 2 frames, one of them labelled, got {len(frames)} with {len(labelled)} "
            "labelled; label more frames"
        )
    budget = Budget(config.seconds, config.steps, config.evaluations)
    torch.manual_seed(config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    model = SRay(SRayConfig(), label_set) if start is None else adapt_model(start, label_set)
    scene = _make_scene([view_from_frame(f, label_set, config.width) for f in frames], config, generator)
    device = choose_device(config.device, 0)
    model.to(device)
    with encoder_in_bfloat16(model, device):
        best, steps, own_view = _run(model, scene, config, budget, generator, on_progress, stopped)
    model.load_state_dict(best.state)
    recipe: dict[str, Any] = {
        "kind": "finetune",
        "width": config.width,
        "config": to_plain(config),
        "steps": steps,
        "best_step": best.step,
        "seconds": round(budget.elapsed_s, 1),
        "held_out_loss": best.loss,
        "held_out_accuracy": best.accuracy,
        "own_view": own_view,
        "train_stamps_ns": sorted({int(f.stamp_ns) for f in labelled} | {int(s) for s in seen_stamps_ns}),
    }
    anchors = tuple(anchor_from_frame(f, config.width) for f in labelled)
    return Checkpoint(model.cpu().eval(), anchors, recipe)


def check_budget(config: FinetuneConfig) -> None:
    """Refuse a fit without end.

    Raises:
        ConfigError: neither ``seconds`` nor ``steps`` is set.
    """
    if config.seconds <= 0 and config.steps <= 0:
        raise ConfigError("a fit needs a budget: set seconds, steps, or both")


def _run(
    model: LearnedField,
    scene: _Scene,
    config: FinetuneConfig,
    budget: Budget,
    generator: torch.Generator,
    on_progress: OnProgress | None,
    stopped: Callable[[], object],
) -> tuple[BestWeights, int, dict[str, float]]:
    """The best weights, the number of steps, and how much the own view counts."""
    optimiser = make_optimiser(model, config.learning_rate, WEIGHT_DECAY)
    encoder = model.image_encoder
    alive = encoder is not None and encoder.uncalibrated  # norms of a fresh encoder learn with the weights
    if alive:
        _settle_norms(model, scene.train)
    elif encoder is not None:
        encoder.freeze_backbones()  # a few keyframes are no match for a million photographs

    def look() -> tuple[float, float]:
        if alive:
            _settle_norms(model, scene.train)
        return _evaluate(model, scene, config)

    def state() -> dict[str, torch.Tensor]:
        return copy.deepcopy(model.state_dict())

    images_from, images_until = config.frozen_encoder_fraction, _end_of_images(model, config)
    own_view = _weigh_own_view(model, scene, config)
    with budget.looking():
        best = BestWeights(*look(), 0, state())
    # Random weights get worse before they get better.
    held_out = HeldOut(look, state, best, 0 if alive else config.patience, images_until)
    encoded = None if alive else _linear_probe(model, scene, config, held_out)
    if not math.isfinite(held_out.best.loss):
        _log.warning("nothing_held_out", reason="too few labelled pixels; the last weights are kept, not the best")
    labelled = [scene.train[i] for i in scene.queries]

    def learn(fraction: float) -> float | None:
        rate = cosine_rate(fraction, config.learning_rate, FINAL_LEARNING_RATE)
        set_rates(optimiser, rate, config.encoder_rate)
        with encoder.batch_statistics() if alive and encoder is not None else nullcontext():
            if images_from <= fraction < images_until:
                loss = step_on_images(model, labelled, generator)
            else:
                query, sources = pick_views(scene.queries, scene.overlap, generator)
                kept = encoded if fraction < images_from else None
                loss = step_on_rays(model, scene.train, query, sources, config.step, generator, kept)
        if loss is None:
            return None
        optimiser.zero_grad()
        loss.backward()  # pyright: ignore[reportUnknownMemberType]
        torch.nn.utils.clip_grad_norm_(model.parameters(), GRADIENT_CLIP)
        optimiser.step()
        return float(loss.detach())

    steps = fit(learn, budget, on_progress, stopped, held_out)
    if steps < FEW_STEPS and not stopped():
        _log.warning(
            "few_steps", steps=steps, reason="the budget was used up before anything could be learned; raise it"
        )
    return held_out.best, steps, own_view


def _end_of_images(model: LearnedField, config: FinetuneConfig) -> float:
    """Fraction of the budget until which steps are on images; 0 where a kind says nothing of them, or the encoder is to
    stay what it is."""
    if config.encoder_rate == 0 or not classifies_images(model):
        return 0.0
    return config.frozen_encoder_fraction + (1 - config.frozen_encoder_fraction) * config.image_fraction


def _linear_probe(model: LearnedField, scene: _Scene, config: FinetuneConfig, held_out: HeldOut) -> EncodedViews | None:
    """Fit the class rows alone, undone where held-out rays say that it did no good.

    Returns:
        The views as they are encoded now, for a frozen encoder; None of a kind that classifies while it encodes: kept
        features leave it nothing to learn.
    """
    if model.needs_own_view:
        return None
    encoded = encode_once(model, scene.train, with_labels=config.step.known_labels)
    if fit_class_rows(model, encoded, scene.train, PROBE_STEPS):
        after = _evaluate(model, scene, config)
        if held_out.best.beaten_by(after[0]):
            held_out.best = BestWeights(*after, 0, held_out.state())
        else:
            model.load_state_dict(held_out.best.state)
    return encoded


def _settle_norms(model: LearnedField, views: Sequence[LabelledView]) -> None:
    """Norms that are alive take the statistics of all views: running means lag behind weights that change fast."""
    if model.image_encoder is not None:
        calibrate(model.image_encoder, to_device(stack_sources(views), next(model.parameters()).device))


def _make_scene(views: Sequence[LabelledView], config: FinetuneConfig, generator: torch.Generator) -> _Scene:
    train: list[LabelledView] = []
    held_out: list[LabelledView] = []
    for view in views:
        height, width = view.channel.shape
        mask = held_out_blocks(height, width, config.held_out_fraction, generator)
        train.append(replace(view, channel=torch.where(mask, IGNORE, view.channel)))
        held_out.append(replace(view, channel=torch.where(mask, view.channel, IGNORE)))
    queries = [i for i, view in enumerate(train) if bool((view.channel != IGNORE).any())]
    return _Scene(train, held_out, queries or range(len(views)), view_overlap(views))


def held_out_blocks(height: int, width: int, fraction: float, generator: torch.Generator) -> torch.Tensor:
    """Mask (H, W) of blocks of an image that are held out."""
    rows, columns = -(-height // HELD_OUT_BLOCK), -(-width // HELD_OUT_BLOCK)
    blocks = torch.rand(rows, columns, generator=generator) < fraction
    return blocks.repeat_interleave(HELD_OUT_BLOCK, 0).repeat_interleave(HELD_OUT_BLOCK, 1)[:height, :width]


def _evaluate(model: LearnedField, scene: _Scene, config: FinetuneConfig) -> tuple[float, float]:
    """Class loss (infinite without any) and accuracy of held-out rays, rendered as a mapper would: from the view's own
    image, and from the others that see most of it, with their training labels if the config makes them known."""
    generator = torch.Generator().manual_seed(config.seed)
    rays_a_view = min(config.held_out_rays, max(1, HELD_OUT_RAYS // len(scene.queries)))
    sampling, device = config.step.sampling, next(model.parameters()).device
    losses: list[float] = []
    right, counted = 0, 0
    model.eval()
    with torch.inference_mode():
        encoded = model.encode(to_device(stack_sources(scene.train, with_labels=config.step.known_labels), device))
        for i, view in enumerate(scene.held_out):
            flat = draw_pixels(view.channel, rays_a_view, 0.5, generator, len(model.label_set))
            if len(flat) == 0:
                continue
            prior = view.depth_m.flatten()[flat]
            rays, targets = query_rays(view, flat, near_m=sampling.near_m, far_m=sampling.far_m, prior=prior)
            others = [] if model.needs_own_view else _views_that_see(scene, i)
            sources = encoded.select(torch.tensor([*others, i], device=device))
            known = sources.channel.clone()
            known[-1] = IGNORE  # a mapper's current frame has no labels
            z = sample_guided(rays, sampling).to(device)
            render, _ = model.render_samples(to_device(rays, device), z, replace(sources, channel=known))
            channel = targets.channel.to(device)
            losses.append(float(semantic_loss(render.logits, channel)))
            right += int(((render.logits.argmax(1) == channel) & render.known).sum())
            counted += len(flat)
    model.train()
    return float(np.mean(losses)) if losses else float("inf"), right / max(counted, 1)


def _views_that_see(scene: _Scene, view: int) -> list[int]:
    """Numbers of the other views that see most of a view."""
    order = scene.overlap[view].argsort(descending=True, stable=True)
    return order[order != view][:HELD_OUT_SOURCES].tolist()


def _weigh_own_view(model: LearnedField, scene: _Scene, config: FinetuneConfig) -> dict[str, float]:
    """Let the own image, which steps on images fit to this scene, count more than one view among others.

    Returns:
        The factors; empty where the encoder learns nothing of the scene, or where no view has depth: then every ray
        needs the other views.
    """
    has_images = _end_of_images(model, config) > config.frozen_encoder_fraction
    has_depth = any(bool((view.depth_m > 0).any()) for view in scene.train)
    if not (has_images and has_depth and model.weigh_own_view(OWN_VIEW_FACTOR, OWN_VIEW_FACTOR_WITHOUT_DEPTH)):
        return {}
    return {"factor": OWN_VIEW_FACTOR, "factor_without_depth": OWN_VIEW_FACTOR_WITHOUT_DEPTH}
