"""One round of learning next to a mapper: finetune on the keyframes so far, and judge by those that were held out.

The image encoder is frozen, so that whatever a mapper has encoded of its own keyframes stays valid, and new weights
can be put in the place of old ones at once.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import torch

from semantic_mapper.errors import FrameError, WeightsError
from semantic_mapper.evaluation.metrics import ConfusionMatrix, SegmentationMetrics
from semantic_mapper.fields.base import EncodedViews, stack_views
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.fields.learned import LearnedField, encode_alike
from semantic_mapper.fields.volume import sample_guided
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.config import OnlineConfig
from semantic_mapper.training.finetune import finetune
from semantic_mapper.training.fit import OnProgress
from semantic_mapper.training.keyframe_pool import Key, KeyframeSplit, key_of
from semantic_mapper.training.losses import IGNORE
from semantic_mapper.training.views import (
    LabelledView,
    draw_pixels,
    query_rays,
    stack_sources,
    view_from_frame,
    view_overlap,
)
from semantic_mapper.types import PosedFrame

SOURCES = 7  # keyframes that a held-out ray is rendered from, next to its own image
RAYS = 1024  # of each held-out keyframe


@dataclass(frozen=True, slots=True, eq=False)
class OnlineResult:
    """Outcome of a round.

    Args:
        checkpoint: The new weights.
        score, parent_score: mIoU on all held-out keyframes, new and in use, in 0..1.
        keys: Keyframes that took part.
        refusal: Why the new weights are not worth offering; empty = they are.
        worse: Whether they are refused because they do worse: then the labels are to blame. Others may only be too few.
    """

    checkpoint: Checkpoint
    score: float
    parent_score: float
    keys: frozenset[Key]
    refusal: str = ""
    worse: bool = False


def learn(
    keyframes: KeyframeSplit,
    current: Checkpoint,
    config: OnlineConfig,
    on_progress: OnProgress | None = None,
    on_judged: Callable[[], None] = lambda: None,
) -> OnlineResult:
    """Finetune ``current`` on the keyframes, and compare both on those held out.

    Each is judged as the mapper would use it: with the labels of the keyframes that it was finetuned on known.

    Args:
        keyframes: At least two to learn from and one to judge by.
        current: Weights in use.
        config: Of the round.
        on_progress: Called after every step.
        on_judged: Called after each held-out keyframe. What either raises ends the round.

    Raises:
        FrameError: too few keyframes, or those held out have nothing to judge by.
        WeightsError: a kind of field whose encoder cannot rest, or one that is not trained yet.
    """
    train, held_out = keyframes.train, keyframes.held_out
    if len(train) < 2 or not held_out:
        raise FrameError(f"learning needs 2 keyframes, and 1 to judge by, got {len(train)} and {len(held_out)}")
    encoder = current.model.image_encoder
    if not encode_alike(current.model, current.model) or encoder is None or encoder.uncalibrated:
        raise WeightsError(
            f"these weights (kind '{current.model.kind}') cannot be finetuned with a frozen encoder: start from "
            "trained S-Ray weights"
        )
    seen = current.train_stamps_ns | {f.stamp_ns for f in held_out}  # judged by: not to be scored on either
    made = finetune(train, current.label_set, current.model, config.finetune, on_progress, seen_stamps_ns=seen)
    known_before = {key_of(a) for a in current.anchors}
    others = [replace(f, label=None) for f in train if key_of(f) not in known_before]
    before = judge(current.model, (*current.anchors, *others), held_out, config, on_judged)
    after = judge(made.model, train, held_out, config, on_judged)
    if not any(matrix.counts.any() for matrix in after):
        raise FrameError("none of the held-out keyframes has a labelled pixel to judge by at this width")
    score, parent_score = (_total(m).miou or 0.0 for m in (after, before))
    made.recipe.update(
        kind="online",
        held_out_keyframes=len(held_out),
        score=score,
        parent_score=parent_score,
        validated=len(keyframes.validated),
    )
    refusal, worse = _refusal_by_score(score, parent_score, config), score < parent_score
    validated = [i for i, f in enumerate(held_out) if key_of(f) in keyframes.validated]
    if not refusal and validated:
        accuracy, parent_accuracy = (_total(m[i] for i in validated).total_accuracy for m in (after, before))
        refusal = _refusal_by_accuracy(accuracy, parent_accuracy, config)
        worse = True
    worse = bool(refusal) and worse and _shares_views(keyframes, current.label_set, config)
    keys = frozenset(key_of(f) for f in (*train, *held_out))
    return OnlineResult(made, score, parent_score, keys, refusal, worse)


def judge(
    model: LearnedField,
    sources: Sequence[PosedFrame],
    held_out: Sequence[PosedFrame],
    config: OnlineConfig,
    on_judged: Callable[[], None] = lambda: None,
) -> list[ConfusionMatrix]:
    """What a field says of the held-out keyframes against their labels, at the same rays whatever the field.

    Each is rendered as a mapper would: from the keyframes that see most of it, and from its own image without labels.

    Args:
        sources: Keyframes to render from, with the labels that are known to the field.
    """
    width, sampling = config.finetune.width, config.finetune.step.sampling
    label_set = model.label_set
    views = [view_from_frame(f, label_set, width) for f in (*sources, *held_out)]
    overlap = view_overlap(views)
    generator = torch.Generator().manual_seed(config.finetune.seed)
    matrices: list[ConfusionMatrix] = []
    model.eval()
    with torch.inference_mode():
        encoded = [_encode(model, view, known=True) for view in views[: len(sources)]]
        for i, view in enumerate(views[len(sources) :], len(sources)):
            matrix = ConfusionMatrix(label_set)
            matrices.append(matrix)
            best = overlap[i, : len(sources)].argsort(descending=True, stable=True)[:SOURCES]
            flat = draw_pixels(view.channel, RAYS, 0.5, generator, len(label_set))
            if len(flat) == 0:
                continue
            looked_on = stack_views([*(encoded[j] for j in best.tolist()), _encode(model, view, known=False)])
            prior = view.depth_m.flatten()[flat]
            rays, targets = query_rays(view, flat, near_m=sampling.near_m, far_m=sampling.far_m, prior=prior)
            render, _ = model.render_samples(rays, sample_guided(rays, sampling), looked_on)
            said = torch.where(render.known, render.logits.argmax(1), IGNORE)
            matrix.update(label_set.to_ids(targets.channel.numpy()), label_set.to_ids(said.numpy()))
            on_judged()
    return matrices


def _encode(model: LearnedField, view: LabelledView, *, known: bool) -> EncodedViews:
    return model.encode(stack_sources([view], with_labels=known))


def _shares_views(keyframes: KeyframeSplit, label_set: LabelSet, config: OnlineConfig) -> bool:
    """Whether anything held out is seen by keyframes that are learned from, so that one can speak of the other."""
    frames = (*keyframes.held_out, *keyframes.train)
    overlap = view_overlap([view_from_frame(f, label_set, config.finetune.width) for f in frames])
    held_out = len(keyframes.held_out)
    return bool(overlap[:held_out, held_out:].any())


def _refusal_by_score(score: float, parent_score: float, config: OnlineConfig) -> str:
    """Why weights of this mIoU are refused; empty = they are not."""
    if score < config.least_score:
        return f"mIoU on held-out keyframes {score:.3f}: less than {config.least_score:g} (least_score)"
    if score < parent_score + config.least_gain:
        return (
            f"mIoU on held-out keyframes {score:.3f}, with the weights in use {parent_score:.3f}: less than "
            f"{config.least_gain:g} gained"
        )
    return ""


def _refusal_by_accuracy(accuracy: float | None, parent_accuracy: float | None, config: OnlineConfig) -> str:
    """Why weights of this accuracy on validated keyframes are refused; empty = they are not. None = no pixel."""
    if accuracy is None or parent_accuracy is None or accuracy >= parent_accuracy - config.tolerance:
        return ""
    return (
        f"accuracy {accuracy:.3f} on held-out keyframes that were validated, with the weights in use "
        f"{parent_accuracy:.3f}: the new labels contradict the old ones"
    )


def _total(matrices: Iterable[ConfusionMatrix]) -> SegmentationMetrics:
    return functools.reduce(operator.add, matrices).metrics()
