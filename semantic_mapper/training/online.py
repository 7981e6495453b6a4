"""Learning next to a mapper: labelled keyframes that come one by one, and rounds of finetuning on them.

The pool knows which keyframes to learn from, which to judge by, and which have been validated. In a round the image
encoder is frozen, so that whatever a mapper has encoded of its own keyframes stays valid, and new weights can be put in
the place of old ones at once.
"""

import functools
import operator
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace

import torch

from semantic_mapper.errors import FrameError, WeightsError
from semantic_mapper.evaluation.metrics import ConfusionMatrix, SegmentationMetrics
from semantic_mapper.fields.checkpoint import Checkpoint
from semantic_mapper.fields.learned import LearnedField
from semantic_mapper.fields.views import stack_views
from semantic_mapper.fields.weights import ENCODING_PARTS
from semantic_mapper.geometry import check_pose
from semantic_mapper.labels import LabelSet
from semantic_mapper.training.config import OnlineConfig
from semantic_mapper.training.finetune import HELD_OUT_SOURCES, finetune, render_as_mapped, views_that_see
from semantic_mapper.training.fit import OnProgress
from semantic_mapper.training.losses import IGNORE
from semantic_mapper.training.views import draw_pixels, stack_sources, view_from_frame, view_overlap
from semantic_mapper.types import PosedFrame

RAYS = 1024  # of each held-out keyframe
Key = tuple[str, int]  # camera_id, stamp_ns
MAX_TRIALS = 3  # rounds without success that a keyframe may take part in before it is dropped


@dataclass(frozen=True, slots=True)
class KeyframeSplit:
    """The keyframes of one round."""

    train: tuple[PosedFrame, ...]  # labelled keyframes to learn from
    held_out: tuple[PosedFrame, ...]  # labelled keyframes that are never learned from
    validated: frozenset[Key] = frozenset()  # keys of those with which the weights in use were found better


@dataclass(frozen=True, slots=True, eq=False)
class Kept:
    """A keyframe of the pool."""

    frame: PosedFrame  # with labels in the classes of the pool
    held_out: bool  # whether it is never learned from
    validated: bool = False  # whether weights were taken after a round with it
    trials: int = 0  # rounds without success since it came


class KeyframePool:
    """A bounded set of labelled keyframes in the classes of the weights' label set.
    Of ``held_out_every`` keyframes the last one is held out, for good; past ``capacity`` the oldest is dropped."""

    def __init__(self, label_set: LabelSet, *, held_out_every: int, capacity: int) -> None:
        self._label_set = label_set
        self._held_out_every = held_out_every
        self._capacity = capacity
        self._kept: dict[Key, Kept] = {}
        self._received = 0

    def __len__(self) -> int:
        return len(self._kept)

    @property
    def new(self) -> int:
        """Keyframes that have not been in a round."""
        return sum(not k.validated and not k.trials for k in self._kept.values())

    @property
    def kept(self) -> tuple[Kept, ...]:
        """All, the oldest first."""
        return tuple(self._kept.values())

    def add(self, frame: PosedFrame, label_set: LabelSet) -> None:
        """Add a keyframe, its classes translated by name; one of the same camera and time is replaced, and no longer
        validated. Raises FrameError, PoseError, LabelError: it cannot be learned from; nothing has changed."""
        frame = self._translated(frame, label_set)
        before = self._kept.pop(key_of(frame), None)
        self._received += before is None
        self._put(Kept(frame, self._received % self._held_out_every == 0 if before is None else before.held_out))

    def restore(self, kept: Kept, label_set: LabelSet) -> None:
        """Add a keyframe of an earlier pool with its state there; the oldest first.
        Raises FrameError, PoseError, LabelError: it cannot be learned from; nothing has changed."""
        kept = replace(kept, frame=self._translated(kept.frame, label_set))
        self._received += 1
        self._put(kept)

    def split(self) -> KeyframeSplit:
        """The keyframes of a round that begins now."""
        return KeyframeSplit(
            tuple(k.frame for k in self.kept if not k.held_out),
            tuple(k.frame for k in self.kept if k.held_out),
            frozenset(key for key, k in self._kept.items() if k.validated),
        )

    def validate(self, keys: Collection[Key]) -> None:
        """Weights of a round with these keyframes are in use."""
        for key in self._not_validated(keys):
            self._kept[key] = replace(self._kept[key], validated=True, trials=0)

    def reject(self, keys: Collection[Key], *, worse: bool) -> int:
        """A round with these keyframes had no success: those not validated get ``MAX_TRIALS`` such rounds, or none
        where it made the weights ``worse``. Returns how many were dropped."""
        for key in self._not_validated(keys):
            trials = MAX_TRIALS if worse else self._kept[key].trials + 1
            self._kept[key] = replace(self._kept[key], trials=trials)
        before = len(self._kept)
        self._kept = {key: kept for key, kept in self._kept.items() if kept.trials < MAX_TRIALS}
        return before - len(self._kept)

    def _not_validated(self, keys: Collection[Key]) -> list[Key]:
        return [key for key in keys if key in self._kept and not self._kept[key].validated]

    def _put(self, kept: Kept) -> None:
        self._kept[key_of(kept.frame)] = kept
        if len(self._kept) > self._capacity:
            del self._kept[next(iter(self._kept))]

    def _translated(self, frame: PosedFrame, label_set: LabelSet) -> PosedFrame:
        where = f"keyframe seq={frame.seq} of camera '{frame.camera_id}'"
        check_pose(frame.T_world_camera, where)
        if frame.label is None:
            raise FrameError(f"{where}: has no label image")
        label_set.to_channels(frame.label, where)  # refuses ids that its own label set lacks
        label = self._label_set.to_ids(self._label_set.channel_map_from(label_set))[frame.label]
        if not (label != self._label_set.ignore_id).any():
            raise FrameError(
                f"{where}: none of its pixels is of a class that the weights know; they know "
                f"{', '.join(self._label_set.names)}"
            )
        sizes = [f"{f.intrinsics.width}x{f.intrinsics.height}" for f in (frame, *(k.frame for k in self.kept[:1]))]
        if len(set(sizes)) > 1:
            raise FrameError(
                f"{where}: {sizes[0]} pixels, but those before have {sizes[1]}; keyframes must be of one size"
            )
        return replace(frame, label=label)


def key_of(frame: PosedFrame) -> Key:
    """What tells a keyframe from all others."""
    return frame.camera_id, frame.stamp_ns


@dataclass(frozen=True, slots=True, eq=False)
class OnlineResult:
    """Outcome of a round."""

    checkpoint: Checkpoint  # the new weights
    # mIoU on all held-out keyframes, new and in use, in 0..1
    score: float
    parent_score: float
    keys: frozenset[Key]  # keyframes that took part
    refusal: str = ""  # why the new weights are not worth offering; empty = they are
    # Whether they are refused because they do worse: then the labels are to blame. Others may only be too few.
    worse: bool = False


def learn(
    keyframes: KeyframeSplit,
    current: Checkpoint,
    config: OnlineConfig,
    on_progress: OnProgress | None = None,
    on_judged: Callable[[], None] = lambda: None,
) -> OnlineResult:
    """Finetune ``current`` on the keyframes, and compare both on those held out, each as the mapper would use it: with
    the labels of the keyframes that it was finetuned on known.

    ``keyframes``: at least two to learn from and one to judge by. ``on_progress, on_judged``: called after every step,
    and every held-out keyframe; what either raises ends the round. Raises FrameError: too few keyframes, or those held
    out have nothing to judge by. WeightsError: a kind of field whose encoder cannot rest, or an untrained one.
    """
    train, held_out = keyframes.train, keyframes.held_out
    if len(train) < 2 or not held_out:
        raise FrameError(f"learning needs 2 keyframes, and 1 to judge by, got {len(train)} and {len(held_out)}")
    encoder = current.model.image_encoder
    if current.model.kind not in ENCODING_PARTS or encoder is None or encoder.uncalibrated:
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
    refusal, worse = "", score < parent_score
    validated = [i for i, f in enumerate(held_out) if key_of(f) in keyframes.validated]
    if score < config.least_score:
        refusal = f"mIoU on held-out keyframes {score:.3f}: less than {config.least_score:g} (least_score)"
    elif score < parent_score + config.least_gain:
        refusal = (
            f"mIoU on held-out keyframes {score:.3f}, with the weights in use {parent_score:.3f}: less than "
            f"{config.least_gain:g} gained"
        )
    elif validated:
        new, old = (_total(m[i] for i in validated).total_accuracy for m in (after, before))
        if new is not None and old is not None and new < old - config.tolerance:
            worse = True
            refusal = (
                f"accuracy {new:.3f} on held-out keyframes that were validated, with the weights in use {old:.3f}: the "
                "new labels contradict the old ones"
            )
    if refusal and worse:  # one can speak of the other only where what is held out is seen by what is learned from
        views = [view_from_frame(f, current.label_set, config.finetune.width) for f in (*held_out, *train)]
        worse = bool(view_overlap(views)[: len(held_out), len(held_out) :].any())
    keys = frozenset(key_of(f) for f in (*train, *held_out))
    return OnlineResult(made, score, parent_score, keys, refusal, bool(refusal) and worse)


def judge(
    model: LearnedField,
    sources: Sequence[PosedFrame],
    held_out: Sequence[PosedFrame],
    config: OnlineConfig,
    on_judged: Callable[[], None] = lambda: None,
) -> list[ConfusionMatrix]:
    """What a field says of the held-out keyframes against their labels, at the same rays whatever the field. Each is
    rendered as a mapper would: from the ``sources``, with their labels, that see most of it, and from its own image."""
    sampling, label_set = config.finetune.step.sampling, model.label_set
    views = [view_from_frame(f, label_set, config.finetune.width) for f in (*sources, *held_out)]
    overlap = view_overlap(views)
    generator = torch.Generator().manual_seed(config.finetune.seed)
    matrices: list[ConfusionMatrix] = []
    model.eval()
    with torch.inference_mode():
        encoded = [model.encode(stack_sources([view], with_labels=True)) for view in views]
        for i, view in enumerate(views[len(sources) :], len(sources)):
            matrix = ConfusionMatrix(label_set)
            matrices.append(matrix)
            flat = draw_pixels(view.channel, RAYS, 0.5, generator, len(label_set))
            if len(flat) == 0:
                continue
            best = views_that_see(overlap[i, : len(sources)])[:HELD_OUT_SOURCES]
            looked_on = stack_views([*(encoded[j] for j in best), encoded[i]])
            render, channel = render_as_mapped(model, view, flat, looked_on, sampling)
            said = torch.where(render.known, render.logits.argmax(1), IGNORE)
            matrix.update(label_set.to_ids(channel.numpy()), label_set.to_ids(said.numpy()))
            on_judged()
    return matrices


def _total(matrices: Iterable[ConfusionMatrix]) -> SegmentationMetrics:
    return functools.reduce(operator.add, matrices).metrics()
