"""Finetuning on labelled keyframes of one scene (S-Ray section 4.2); held-out rays decide which weights are kept.

Steps draw rays of a query view rendered from other views, or single images. All draws are made on the CPU, so that they
are the same whatever the device. Kinds of fields that hold one scene are fitted in ways of their own (``FITTERS``).
"""

import copy
import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np
import torch

from semantic_mapper.config import SamplingConfig, SRayConfig, to_plain
from semantic_mapper.errors import FrameError
from semantic_mapper.fields.checkpoint import Checkpoint, adapt_model
from semantic_mapper.fields.device import choose_device, encoder_in_bfloat16, to_device
from semantic_mapper.fields.encoder import calibrate
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.scene.grid import GridField
from semantic_mapper.fields.scene.irt import IRT
from semantic_mapper.fields.scene.panoptic import Panoptic
from semantic_mapper.fields.sray import SRay
from semantic_mapper.fields.views import EncodedViews
from semantic_mapper.fields.volume import sample_guided
from semantic_mapper.fields.weights import anchor_from_frame
from semantic_mapper.labels import LabelSet
from semantic_mapper.log_events import get_logger
from semantic_mapper.training.config import FinetuneConfig, StepConfig
from semantic_mapper.training.fit import (
    Budget,
    FitTask,
    Fitted,
    HeldOut,
    OnProgress,
    cosine_rate,
    descend,
    fit,
    held_out_blocks,
    make_optimiser,
    set_rates,
)
from semantic_mapper.training.grid_fit import fit_scene
from semantic_mapper.training.irt import fit_irt
from semantic_mapper.training.losses import IGNORE, guess_loss, image_loss, ray_loss, semantic_loss
from semantic_mapper.training.panoptic import fit_panoptic
from semantic_mapper.training.views import (
    LabelledView,
    draw_pixels,
    guided_rays,
    jitter_colours,
    mirrored_view,
    query_rays,
    stack_sources,
    usable_frames,
    view_from_frame,
    view_overlap,
    withhold_depth,
)
from semantic_mapper.types import FieldRender, PosedFrame

_log = get_logger(__name__)

FINAL_LEARNING_RATE, WEIGHT_DECAY, GRADIENT_CLIP = 5e-5, 1e-4, 10.0
FEW_STEPS = 10  # fewer are worth a warning: a slow machine, or a small budget
HELD_OUT_RAYS = 6144  # over all keyframes: a look must not cost more the more keyframes there are
HELD_OUT_SOURCES = 7  # that a held-out ray is rendered from, next to its own image: those that see most of its view
# Times that the own image counts among the views after steps on images; without measured depth nearly alone, because
# the other views may look at something else there (docs/decisions/0018-images-in-finetuning.md).
OWN_VIEW_FACTOR = 4.0
OWN_VIEW_FACTOR_WITHOUT_DEPTH = 1e3
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
PROBE_STEPS = 40  # of the classifier alone, on features as they are, before the first ray
PROBE_BALANCE = 0.5  # see ``image_loss``

# Kinds that are fitted to a scene in a way of their own. Kinds that build on GridField add a row.
FITTERS: dict[str, Callable[[FitTask], Fitted]] = {
    GridField.kind: fit_scene,
    IRT.kind: fit_irt,
    Panoptic.kind: fit_panoptic,
}


def finetune(
    frames: Sequence[PosedFrame],
    label_set: LabelSet,
    start: LearnedField | None,
    config: FinetuneConfig,
    on_progress: OnProgress | None = None,
    stopped: Callable[[], object] = bool,
    seen_stamps_ns: Iterable[int] = (),
    kind: str | None = None,
) -> Checkpoint:
    """Fit a field to keyframes of one scene; never worse on held-out rays than where it started.

    Args:
        frames: With poses; those with impossible ones are left out. Labelled ones say the classes, the others help with
            geometry. At least 2, one of them labelled, but for ``kind`` "grid", which learns no classes.
        label_set: Classes of their labels, and of the result.
        start: Weights to start from, adapted to ``label_set`` by class name; None = random. Kinds that hold one scene
            take its config and its box alone, "panoptic" also its boxes.
        config: At least one of ``seconds`` and ``steps`` set.
        stopped: Called before every step; once it returns anything true, the best weights so far are the result.
        seen_stamps_ns: Frames that ``start`` was fitted to; the result remembers them with its own.
        kind: Of the field; None = that of ``start``, or S-Ray.

    Raises FrameError: too few frames or labels, or poses that do not fit the images. ConfigError: no budget, boxes that
    cannot be, or no GPU where one is requested. WeightsError: a ``start`` whose classes are others, of a kind that
    cannot be adapted.
    """
    budget = Budget(config.seconds, config.steps, config.evaluations, on_progress, stopped)
    fitter = FITTERS.get(kind or (SRay.kind if start is None else start.kind), _fit_keyframes)
    made = fitter(FitTask(usable_frames(frames), label_set, start, config, budget))
    recipe = {
        "kind": "scene fit" if made.model.holds_scene else "finetune",
        "width": config.width,
        "config": to_plain(config),
        "seconds": round(budget.elapsed_s, 1),
        **made.figures,
        "train_stamps_ns": sorted({int(f.stamp_ns) for f in made.labelled} | {int(s) for s in seen_stamps_ns}),
    }
    anchors = [] if made.model.holds_scene else [anchor_from_frame(f, config.width) for f in made.labelled]
    return Checkpoint(made.model.cpu().eval(), tuple(anchors), recipe)


@dataclass(slots=True)
class _Scene:
    """The views to learn from (held-out blocks ignored), the same to look at (all else ignored), and who sees whom."""

    train: Sequence[LabelledView]
    held_out: Sequence[LabelledView]
    queries: Sequence[int]  # views with something to learn; the others are source views only
    overlap: torch.Tensor  # (n, n) of ``view_overlap``


def _make_scene(views: Sequence[LabelledView], config: FinetuneConfig, generator: torch.Generator) -> _Scene:
    pairs = [
        (view, held_out_blocks(view.intrinsics.height, view.intrinsics.width, config.held_out_fraction, generator))
        for view in views
    ]
    train = [replace(view, channel=torch.where(mask, IGNORE, view.channel)) for view, mask in pairs]
    held_out = [replace(view, channel=torch.where(mask, view.channel, IGNORE)) for view, mask in pairs]
    queries = [i for i, view in enumerate(train) if bool((view.channel != IGNORE).any())]
    return _Scene(train, held_out, queries or range(len(views)), view_overlap(views))


def _fit_keyframes(task: FitTask) -> Fitted:
    """Fit S-Ray, or another field that encodes images, to labelled keyframes."""
    frames, label_set, start, config, budget = task
    labelled = task.labelled
    if len(frames) < 2 or not labelled:
        raise FrameError(
            f"finetuning needs at least 2 frames, one of them labelled, got {len(frames)} with {len(labelled)} "
            "labelled; label more frames"
        )
    torch.manual_seed(config.seed)
    generator = torch.Generator().manual_seed(config.seed)
    model = SRay(SRayConfig(), label_set) if start is None else adapt_model(start, label_set)
    scene = _make_scene([view_from_frame(f, label_set, config.width) for f in frames], config, generator)
    device = choose_device(config.device, 0)
    model.to(device)
    with encoder_in_bfloat16(model, device):
        held_out, steps, own_view = _run(model, scene, config, budget, generator)
    model.load_state_dict(held_out.best)
    return Fitted(model, held_out.figures(steps) | {"own_view": own_view}, labelled)


def _run(
    model: LearnedField, scene: _Scene, config: FinetuneConfig, budget: Budget, generator: torch.Generator
) -> tuple[HeldOut, int, dict[str, float]]:
    """The best weights, the number of steps, and how much the own view counts."""
    optimiser, encoder = make_optimiser(model, config.learning_rate, WEIGHT_DECAY), model.image_encoder
    alive = encoder is not None and encoder.uncalibrated  # norms of a fresh encoder learn with the weights
    if encoder is not None and not alive:
        encoder.freeze(*encoder.backbones())  # a few keyframes are no match for a million photographs

    def look() -> tuple[float, float]:
        if encoder is not None and alive:  # take the statistics of all views: running means lag behind the weights
            calibrate(encoder, to_device(stack_sources(scene.train), next(model.parameters()).device))
        return _evaluate(model, scene, config)

    # No steps on images where a kind says nothing of them, or the encoder is to stay what it is.
    images_from, images_until = config.frozen_encoder_fraction, 0.0
    if config.encoder_rate > 0 and model.classifies_images:
        images_until = images_from + (1 - images_from) * config.image_fraction
    # Steps on images fit the own image to this scene: it counts more than one view among others, unless no view has
    # depth, where every ray needs the others.
    own_view: dict[str, float] = {}
    has_depth = any(bool((view.depth_m > 0).any()) for view in scene.train)
    factors = (OWN_VIEW_FACTOR, OWN_VIEW_FACTOR_WITHOUT_DEPTH)
    if images_from < images_until and has_depth and model.weigh_own_view(*factors):
        own_view = dict(zip(("factor", "factor_without_depth"), factors, strict=True))
    # Random weights get worse before they get better.
    held_out = HeldOut(look, lambda: copy.deepcopy(model.state_dict()), 0 if alive else config.patience, images_until)
    with budget.looking():
        held_out.judge(0)
    encoded = None if alive else _linear_probe(model, scene, config, held_out)
    if not math.isfinite(held_out.loss):
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
        return None if loss is None else descend(optimiser, loss, GRADIENT_CLIP)

    steps = fit(learn, budget, held_out)
    if steps < FEW_STEPS and not budget.stopped():
        _log.warning("few_steps", steps=steps, reason="the budget was used up before anything was learned; raise it")
    return held_out, steps, own_view


def _linear_probe(model: LearnedField, scene: _Scene, config: FinetuneConfig, held_out: HeldOut) -> EncodedViews | None:
    """Fit the class rows alone, undone where held-out rays say that it did no good.

    Returns the views as they are encoded now, for a frozen encoder; None of a kind that classifies while it encodes.
    """
    if model.needs_own_view:
        return None
    device = next(model.parameters()).device
    with torch.no_grad():
        encoded = model.encode(to_device(stack_sources(scene.train, with_labels=config.step.known_labels), device))
    if fit_class_rows(model, encoded, scene.train, PROBE_STEPS) and not held_out.judge(0)[2]:
        model.load_state_dict(held_out.best)
    return encoded


def fit_class_rows(model: LearnedField, encoded: EncodedViews, views: Sequence[LabelledView], steps: int) -> bool:
    """Fit the class rows of ``model`` to the labelled pixels of ``views``, which it has ``encoded``; False = it cannot.
    Convex, since the classifier is linear, and cheap, since nothing is rendered or encoded."""
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


def _evaluate(model: LearnedField, scene: _Scene, config: FinetuneConfig) -> tuple[float, float]:
    """Class loss (infinite without any) and accuracy of held-out rays, rendered as a mapper would: from the view's own
    image, and from the others that see most of it, with their training labels if the config makes them known."""
    generator = torch.Generator().manual_seed(config.seed)
    rays_a_view = min(config.held_out_rays, max(1, HELD_OUT_RAYS // len(scene.queries)))
    device = next(model.parameters()).device
    losses: list[float] = []
    right, counted = 0, 0
    model.eval()
    with torch.inference_mode():
        encoded = model.encode(to_device(stack_sources(scene.train, with_labels=config.step.known_labels), device))
        for i, view in enumerate(scene.held_out):
            flat = draw_pixels(view.channel, rays_a_view, 0.5, generator, len(model.label_set))
            if len(flat) == 0:
                continue
            others = [] if model.needs_own_view else [j for j in views_that_see(scene.overlap[i]) if j != i]
            sources = encoded.select(torch.tensor([*others[:HELD_OUT_SOURCES], i], device=device))
            render, channel = render_as_mapped(model, view, flat, sources, config.step.sampling)
            losses.append(float(semantic_loss(render.logits, channel)))
            right += int(((render.logits.argmax(1) == channel) & render.known).sum())
            counted += len(flat)
    model.train()
    return float(np.mean(losses)) if losses else float("inf"), right / max(counted, 1)


def views_that_see(overlap: torch.Tensor) -> list[int]:
    """Numbers of views by how much of another they see (n,), most first."""
    return overlap.argsort(descending=True, stable=True).tolist()


def render_as_mapped(
    model: LearnedField, view: LabelledView, flat: torch.Tensor, sources: EncodedViews, sampling: SamplingConfig
) -> tuple[FieldRender, torch.Tensor]:
    """Pixels (R,) of a view as a mapper renders them, and their classes (R,).
    ``sources``: the last one is the view itself, whose labels a mapper does not know."""
    device = next(model.parameters()).device
    prior = view.depth_m.flatten()[flat]
    rays, targets = query_rays(view, flat, near_m=sampling.near_m, far_m=sampling.far_m, prior=prior)
    known = sources.channel.clone()
    known[-1] = IGNORE
    z = sample_guided(rays, sampling).to(device)
    render, _ = model.render_samples(to_device(rays, device), z, replace(sources, channel=known))
    return render, targets.channel.to(device)


def pick_views(
    queries: Sequence[int],
    overlap: torch.Tensor,
    generator: torch.Generator,
    own_view_fraction: float = OWN_VIEW_FRACTION,
) -> tuple[int, list[int]]:
    """Draw a query view of ``queries``, and its source views: the more one sees of the query, the likelier it is.
    ``overlap``: (n, n) of ``view_overlap``, of all views of one scene."""
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
    ``encoded``: all views, where the image encoder is frozen. Colours are not jittered and no depth of source views is
    withheld then: both would need features of their own."""
    view, device = views[query], next(model.parameters()).device
    flat = draw_pixels(view.channel, config.rays, BALANCED_FRACTION, generator, len(model.label_set))
    if len(flat) == 0:
        return None
    rays, targets, z = guided_rays(
        view,
        flat,
        config.sampling,
        generator,
        noise=PRIOR_NOISE,
        withheld=DEPTH_DROPOUT,
        samples_without_depth=config.samples_without_depth,
    )
    rays, targets, z = to_device(rays, device), to_device(targets, device), z.to(device)
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


def step_on_images(model: LearnedField, views: Sequence[LabelledView], generator: torch.Generator) -> torch.Tensor:
    """Loss of what a field that classifies images makes of some of the views, each by itself: an image costs a fraction
    of what rays from several views cost."""
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
