"""Few-step finetuning on labelled keyframes of one scene (S-Ray section 4.2).

Held-out rays decide which weights are kept.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Annotated, Any

import msgspec
import numpy as np
import torch

from semantic_mapper.config import (
    AtLeastOne,
    AtLeastZero,
    Config,
    Fraction,
    IRTVariant,
    NotNegative,
    Positive,
    SRayConfig,
    to_plain,
)
from semantic_mapper.errors import ConfigError, FrameError
from semantic_mapper.fields.base import EncodedViews
from semantic_mapper.fields.checkpoint import Checkpoint, adapt_model, anchor_from_frame
from semantic_mapper.fields.device import DeviceName, choose_device, encoder_in_bfloat16, to_device
from semantic_mapper.fields.encoder import calibrate
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.sampling import sample_guided
from semantic_mapper.fields.sray import SRay
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.budget import BestWeights, BudgetClock
from semantic_mapper.training.frozen_encoder import encode_once, frozen_encoder_loss
from semantic_mapper.training.grid_fit import GridFitConfig
from semantic_mapper.training.images import ImageStepConfig, classifies_images, image_batch, images_loss
from semantic_mapper.training.linear_probe import fit_class_rows
from semantic_mapper.training.losses import IGNORE, Loss, semantic_loss
from semantic_mapper.training.optimiser import make_optimiser, set_rates
from semantic_mapper.training.overlap import view_overlap
from semantic_mapper.training.schedule import cosine_rate
from semantic_mapper.training.step import StepConfig, pick_views, training_loss
from semantic_mapper.training.uncertainty import with_uncertainty
from semantic_mapper.training.views import (
    LabelledView,
    RayTargets,
    draw_pixels,
    mirrored_view,
    query_rays,
    stack_sources,
    view_from_frame,
)
from semantic_mapper.types import PosedFrame, RayBatch

_log = get_logger(__name__)

HELD_OUT_BLOCK = 16  # pixels a side: single held-out pixels would be known from their neighbours
FEW_STEPS = 10  # fewer are worth a warning: a slow machine, or a small budget
HELD_OUT_RAYS = 6144  # over all keyframes: a look must not cost more the more keyframes there are
HELD_OUT_SOURCES = 7  # that a held-out ray is rendered from, beside its own image: those that see most of its view
IMAGES = 4  # of a step on single images
MIRRORED = 0.5  # of them
# Times that the own image counts among the views after steps on images; without measured depth nearly alone, because
# the other views may look at something else there (docs/decisions/0018-images-in-finetuning.md).
OWN_VIEW_FACTOR = 4.0
OWN_VIEW_FACTOR_WITHOUT_DEPTH = 1e3


class IRTFitConfig(Config, frozen=True):
    """What an Implicit Ray-Transformer is made of (``irt.fit_irt``)."""

    variant: IRTVariant | None = None  # None = that of the weights to start from, else BC
    carry_labels: bool = (
        True  # to where the labelled frames' surface is seen again; False: labels only teach, as in the paper
    )


class PanopticFitConfig(Config, frozen=True):
    """How a Panoptic NeRF learns beyond its geometry (``panoptic.fit_panoptic``); 0 leaves a loss out."""

    rays: AtLeastOne = 1024  # a step
    semantics: AtLeastZero = 0.05  # weight of all that follows, against the colours'
    fixed: AtLeastZero = 1.0  # of pseudo labels against what boxes say (Eq. 5): moves density
    learned: AtLeastZero = 1.0  # of pseudo labels against what is learned (Eq. 6)
    points: AtLeastZero = 1.0  # of what is learned at points against what boxes say there (Eq. 6)
    depth: AtLeastZero = 0.1  # of rendered depth against the frames', apart from ``semantics``


class FinetuneConfig(Config, frozen=True):
    """Budget and optimiser of a finetuning."""

    # Wall-clock budget of all of it, looks at held-out rays included; 0 = only steps count (then a run repeats bit for
    # bit). The first look is made in any case.
    seconds: AtLeastZero = 300.0
    steps: NotNegative = 0  # step budget; 0 = only seconds count
    width: AtLeastOne = 320  # working width of the images
    learning_rate: AtLeastZero = 1e-3
    encoder_rate: Fraction = 1.0  # of the image encoder, as a fraction of it; 0 = only what reads its features learns
    final_learning_rate: AtLeastZero = 5e-5
    weight_decay: AtLeastZero = 1e-4
    gradient_clip: Positive = 10.0
    held_out_fraction: Annotated[float, msgspec.Meta(ge=0, lt=1)] = (
        0.1  # of each keyframe's pixels, in blocks, never trained on
    )
    held_out_rays: AtLeastOne = 512  # a keyframe, but no more than 6,144 in all
    evaluations: AtLeastOne = 10  # over the whole budget
    # Evaluations without a better loss before it stops early; 0 = the whole budget, come what may. Those during steps
    # on images do not count: what these teach does not show in rays until the rate has fallen.
    patience: NotNegative = 4
    bfloat16: bool = True  # the image encoder computes in it where that is fast (GPUs, CPUs with AMX)
    linear_probe_steps: NotNegative = 40  # steps of the classifier alone, on features as they are, before the first ray
    frozen_encoder_fraction: Fraction = (
        0.0  # of the budget, at its start, in which the image encoder is frozen, so that steps cost less
    )
    image_fraction: Fraction = (
        0.75  # of the budget behind that: steps on single images, where a kind classifies these; the rest is on rays
    )
    seed: NotNegative = 0
    device: DeviceName = "auto"
    step: StepConfig = StepConfig()
    grid: GridFitConfig = GridFitConfig()  # of kinds that stand on a scene grid (``scene_fit``)
    irt: IRTFitConfig = IRTFitConfig()
    panoptic: PanopticFitConfig = PanopticFitConfig()


@dataclass(frozen=True, slots=True)
class FinetuneProgress:
    """State after a step: ``fraction`` of the budget, last training loss, held-out loss and accuracy (NaN at first)."""

    step: int
    fraction: float
    loss: float
    held_out_loss: float
    held_out_accuracy: float
    best: bool


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
    on_progress: Callable[[FinetuneProgress], None] | None = None,
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
        stopped: Asked before every step; once it says so (anything true), the best weights so far are the result.
        seen_stamps_ns: Frames that ``start`` was fitted to; the result remembers them with its own.

    Raises:
        FrameError: fewer than two frames, or none with labels.
        ConfigError: no budget, or no GPU where one is requested.
    """
    if config.seconds <= 0 and config.steps <= 0:
        raise ConfigError("finetuning needs a budget: set seconds, steps, or both")
    labelled = [f for f in frames if f.label is not None]
    if len(frames) < 2 or not labelled:
        raise FrameError(
            f"finetuning needs at least 2 frames, one of them labelled, got {len(frames)} with {len(labelled)} "
            "labelled; label more frames"
        )
    clock = BudgetClock(config.seconds, config.steps, config.evaluations)
    torch.manual_seed(config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    model = SRay(SRayConfig(), label_set) if start is None else adapt_model(start, label_set)
    views = [view_from_frame(f, label_set, config.width) for f in frames]
    scene = _make_scene(views, config, generator)
    device = choose_device(config.device, 0)
    model.to(device)
    with encoder_in_bfloat16(model, device) if config.bfloat16 else nullcontext():
        best, steps, own_view = _run(model, scene, config, clock, generator, on_progress, stopped)
    model.load_state_dict(best.state)
    recipe: dict[str, Any] = {
        "kind": "finetune",
        "width": config.width,
        "config": to_plain(config),
        "steps": steps,
        "best_step": best.step,
        "seconds": round(clock.elapsed_s, 1),
        "held_out_loss": best.loss,
        "held_out_accuracy": best.accuracy,
        "own_view": own_view,
        "train_stamps_ns": sorted({int(f.stamp_ns) for f in labelled} | {int(s) for s in seen_stamps_ns}),
    }
    anchors = tuple(anchor_from_frame(f, config.width) for f in labelled)
    return Checkpoint(model.cpu().eval(), anchors, recipe)


def _run(
    model: LearnedField,
    scene: _Scene,
    config: FinetuneConfig,
    clock: BudgetClock,
    generator: torch.Generator,
    on_progress: Callable[[FinetuneProgress], None] | None,
    stopped: Callable[[], object],
) -> tuple[BestWeights, int, dict[str, float]]:
    optimiser = make_optimiser(model, config.learning_rate, config.weight_decay)
    alive, norms = _prepare_norms(model, scene.train)
    if model.image_encoder is not None and not alive:
        model.image_encoder.freeze_backbones()  # a few keyframes are no match for a million photographs
    patience = 0 if alive else config.patience  # random weights get worse before they get better

    def look() -> tuple[float, float]:
        if alive:
            _settle_norms(model, scene.train)
        return _evaluate(model, scene, config)

    own_view = _weigh_own_view(model, scene, config)
    with clock.looking():
        best = BestWeights(*look(), 0, copy.deepcopy(model.state_dict()))
    images_from, images_until = config.frozen_encoder_fraction, _end_of_images(model, config)
    step, stale = 0, 0
    best, encoded = (best, None) if alive else _linear_probe(model, scene, config, best)
    latest = (best.loss, best.accuracy)
    doubts = config.step.hard_example_fraction > 0
    scene.train = with_uncertainty(model, scene.train) if doubts else scene.train
    if not math.isfinite(best.loss):
        _log.warning("nothing_held_out", reason="too few labelled pixels; the last weights are kept, not the best")
    while (fraction := clock.used(step)) < 1 and (patience == 0 or stale < patience) and not stopped():
        rate = cosine_rate(fraction, config.learning_rate, config.final_learning_rate)
        set_rates(optimiser, rate, config.encoder_rate)
        with norms():
            if images_from <= fraction < images_until:
                loss = _draw_image_loss(model, [scene.train[i] for i in scene.queries], config.step, generator)
            else:
                kept = encoded if fraction < images_from else None
                loss = _draw_loss(model, scene, kept, config.step, generator)
        step += 1
        if loss is None:
            continue
        optimiser.zero_grad()
        loss.total.backward()  # pyright: ignore[reportUnknownMemberType]
        torch.nn.utils.clip_grad_norm_(model.parameters(), config.gradient_clip)
        optimiser.step()
        fraction = clock.used(step)
        improved = False
        if clock.look_due(fraction):
            with clock.looking():
                latest = look()
            improved = best.beaten_by(latest[0])
            stale = 0 if improved or fraction < images_until else stale + 1
            if improved:
                best = BestWeights(*latest, step, copy.deepcopy(model.state_dict()))
            scene.train = with_uncertainty(model, scene.train) if doubts else scene.train
        if on_progress is not None:
            on_progress(FinetuneProgress(step, min(fraction, 1.0), float(loss.total.detach()), *latest, improved))
    if step < FEW_STEPS and not stopped():
        _log.warning(
            "few_steps", steps=step, reason="the budget was used up before anything could be learned; raise it"
        )
    if stopped() and step > 0:  # what was learned since the last look
        latest = look()
        if best.beaten_by(latest[0]):
            best = BestWeights(*latest, step, copy.deepcopy(model.state_dict()))
    return best, step, own_view


def _draw_loss(
    model: LearnedField,
    scene: _Scene,
    encoded: EncodedViews | None,
    config: StepConfig,
    generator: torch.Generator,
) -> Loss | None:
    """Loss of a step, from kept features where there are some; None where the query has no labelled pixel."""
    query, sources = pick_views(scene.queries, scene.overlap, config, generator)
    if encoded is not None:
        return frozen_encoder_loss(model, encoded, scene.train, query, sources, config, generator)
    return training_loss(model, scene.train, query, sources, config, generator)


def _end_of_images(model: LearnedField, config: FinetuneConfig) -> float:
    """Fraction of the budget until which steps are on images; 0 where a kind says nothing of them, or the encoder is to
    stay what it is."""
    if config.encoder_rate == 0 or not classifies_images(model):
        return 0.0
    return config.frozen_encoder_fraction + (1 - config.frozen_encoder_fraction) * config.image_fraction


def _draw_image_loss(
    model: LearnedField, views: Sequence[LabelledView], config: StepConfig, generator: torch.Generator
) -> Loss:
    """Loss of a step on single images: what the field makes of each by itself."""
    views = [views[i] for i in torch.randperm(len(views), generator=generator).tolist()[:IMAGES]]
    views = [mirrored_view(v) if float(torch.rand(1, generator=generator)) < MIRRORED else v for v in views]
    # All without depth or none: norms take their statistics from images of one kind.
    colours_only = float(torch.rand(1, generator=generator)) < config.depth_dropout
    given = ImageStepConfig(colour_jitter=config.colour_jitter)
    device = next(model.parameters()).device
    return images_loss(model, image_batch(views, given, generator, device, colours_only=colours_only), given)


def _linear_probe(
    model: LearnedField,
    scene: _Scene,
    config: FinetuneConfig,
    start: BestWeights,
) -> tuple[BestWeights, EncodedViews | None]:
    """Fit the class rows alone, undone where held-out rays say that it did no good.

    Returns:
        The better state, and the views as they are encoded now, for a frozen encoder; None without either.
    """
    # Kept features leave a kind that classifies while it encodes nothing to learn.
    if model.needs_own_view or (config.linear_probe_steps == 0 and config.frozen_encoder_fraction == 0):
        return start, None
    encoded = encode_once(model, scene.train, with_labels=config.step.known_labels)
    if not fit_class_rows(model, encoded, scene.train, config.linear_probe_steps):
        return start, encoded
    after = BestWeights(*_evaluate(model, scene, config), 0, copy.deepcopy(model.state_dict()))
    if start.beaten_by(after.loss):
        return after, encoded
    model.load_state_dict(start.state)
    return start, encoded


def _prepare_norms(
    model: LearnedField, views: Sequence[LabelledView]
) -> tuple[bool, Callable[[], AbstractContextManager[None]]]:
    """Whether batch norms are alive, and what steps are made in; those of a fresh encoder are set by the views."""
    encoder = model.image_encoder
    if encoder is None or not encoder.uncalibrated:
        return False, nullcontext
    _settle_norms(model, views)
    return True, encoder.batch_statistics


def _settle_norms(model: LearnedField, views: Sequence[LabelledView]) -> None:
    """Norms that are alive take the statistics of all views: running means lag behind weights that change fast."""
    if model.image_encoder is not None:
        calibrate(model.image_encoder, to_device(stack_sources(views), next(model.parameters()).device))


def _make_scene(views: Sequence[LabelledView], config: FinetuneConfig, generator: torch.Generator) -> _Scene:
    train, held_out = zip(*(_split(v, config.held_out_fraction, generator) for v in views), strict=True)
    queries = [i for i, view in enumerate(train) if bool((view.channel != IGNORE).any())]
    return _Scene(train, held_out, queries or range(len(views)), view_overlap(views))


def _split(view: LabelledView, share: float, generator: torch.Generator) -> tuple[LabelledView, LabelledView]:
    """The view for training (held-out blocks ignored) and for evaluation (all but held-out blocks ignored)."""
    height, width = view.channel.shape
    mask = held_out_blocks(height, width, share, generator)
    ignored = torch.full_like(view.channel, IGNORE)
    return (
        replace(view, channel=torch.where(mask, ignored, view.channel)),
        replace(view, channel=torch.where(mask, view.channel, ignored)),
    )


def held_out_blocks(height: int, width: int, share: float, generator: torch.Generator) -> torch.Tensor:
    """Mask (H, W) of blocks of an image that are held out."""
    rows, columns = -(-height // HELD_OUT_BLOCK), -(-width // HELD_OUT_BLOCK)
    blocks = torch.rand(rows, columns, generator=generator) < share
    return blocks.repeat_interleave(HELD_OUT_BLOCK, 0).repeat_interleave(HELD_OUT_BLOCK, 1)[:height, :width]


def _evaluate(model: LearnedField, scene: _Scene, config: FinetuneConfig) -> tuple[float, float]:
    """Class loss and accuracy of held-out rays, rendered as a mapper would: from the view's own image, and from the
    others that see most of it, with their training labels if the config makes them known."""
    generator = torch.Generator().manual_seed(config.seed)
    rays_a_view = min(config.held_out_rays, max(1, HELD_OUT_RAYS // len(scene.queries)))
    model.eval()
    with torch.inference_mode():
        views = dict(enumerate(scene.held_out))
        found = _score(model, list(_rays_of(model, scene, views, config, rays_a_view, generator)))
    model.train()
    return found


@dataclass(frozen=True, slots=True, eq=False)
class _ViewRays:
    """Rays of one view: what they should render to, their sample depths, and the views to render them from."""

    rays: RayBatch
    targets: RayTargets
    z: torch.Tensor
    sources: EncodedViews


def _rays_of(
    model: LearnedField,
    scene: _Scene,
    views: Mapping[int, LabelledView],
    config: FinetuneConfig,
    rays_a_view: int,
    generator: torch.Generator,
) -> Iterator[_ViewRays]:
    """Rays of views that have labels, each with its own image as the last of its sources.

    Args:
        views: By their number in the scene; their labels are the targets.
    """
    sampling = config.step.sampling
    device = next(model.parameters()).device
    sources = stack_sources(scene.train, with_labels=config.step.known_labels)
    encoded = model.encode(to_device(sources, device))
    for i, view in views.items():
        flat = draw_pixels(view.channel, rays_a_view, 0.5, generator, len(model.label_set))
        if len(flat) == 0:
            continue
        prior = view.depth_m.flatten()[flat]
        rays, targets = query_rays(view, flat, near_m=sampling.near_m, far_m=sampling.far_m, prior=prior)
        others = [] if model.needs_own_view else _looking_on(scene, i)
        chosen = encoded.select(torch.tensor([*others, i], device=device))
        known = chosen.channel.clone()
        known[-1] = IGNORE  # a mapper's current frame has no labels
        z = sample_guided(rays, sampling).to(device)
        yield _ViewRays(to_device(rays, device), to_device(targets, device), z, replace(chosen, channel=known))


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


def _score(model: LearnedField, parts: Sequence[_ViewRays]) -> tuple[float, float]:
    """Mean loss of the views, infinite without any, and accuracy of their rays."""
    losses: list[float] = []
    right, counted = 0, 0
    for part in parts:
        render, _ = model.render_samples(part.rays, part.z, part.sources)
        losses.append(float(semantic_loss(render.logits, part.targets.channel)))
        right += int(((render.logits.argmax(1) == part.targets.channel) & render.known).sum())
        counted += len(part.z)
    return float(np.mean(losses)) if losses else float("inf"), right / max(counted, 1)


def _looking_on(scene: _Scene, view: int) -> list[int]:
    """Numbers of the other views that see most of a view."""
    order = scene.overlap[view].argsort(descending=True, stable=True)
    return order[order != view][:HELD_OUT_SOURCES].tolist()
